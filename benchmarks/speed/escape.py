"""How long after Esc a render is over: *Render with Splats* beside plain F12.

    python -m benchmarks.speed.escape [--turns 4] [--blender trixie]

In a window of a real Blender under Xvfb, by a real key (tests/e2e/inside/escape.py): the committed
room, four times (160,000 splats), at 960 x 640, and a cube that Cycles renders. Esc is pressed amid
an animation of F12, amid the same with splats, and while splats alone are drawn. Told are seconds
by the clock until Blender hears of the key, until its render ends, and until all is over, so
nothing else may run; the last number is what was left to do, in seconds of the processor of all
threads but those of the software renderer, whatever else runs.
"""

from __future__ import annotations

import argparse
import tempfile
from collections.abc import Sequence
from pathlib import Path

from .main_thread import BINARIES, PROJECT, installed

KINDS = ("plain", "cycles", "splats")


def main(arguments: Sequence[str] | None = None) -> None:
    """Print the seconds of each turn."""
    parser = argparse.ArgumentParser(description="Time Esc amid renders.")
    parser.add_argument("--turns", type=int, default=4)
    parser.add_argument("--blender", choices=BINARIES, default=BINARIES[0])
    parser.add_argument("--kinds", nargs="+", choices=KINDS, default=KINDS)
    options = parser.parse_args(arguments)
    scene = PROJECT / "tests" / "data" / "room_small"
    with tempfile.TemporaryDirectory() as made:
        work = Path(made)
        blender = installed(options.blender, work)
        cloud, cameras = scene / "point_cloud.ply", scene / "cameras.json"
        blender.step("make_scene", cloud=cloud, cameras=cameras, blend=work / "room.blend")
        found = blender.window_step(
            "escape", work / "room.blend", simulate=False,
            turns=options.turns, kinds=" ".join(options.kinds),
        )  # fmt: skip
    for kind, turns in found.items():
        print(f"{kind}: heard, render ended, over, processor: {'; '.join(map(str, turns))}")


if __name__ == "__main__":
    main()
