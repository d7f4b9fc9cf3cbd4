"""How long scoring takes, how it grows, and what it needs of memory.

    python -m benchmarks.speed.scoring [--quick]

Every line is the median of the runs named in it, measured one after the other in one process. The
splats are the committed room's, repeated with a little noise, so that views see of them what they
see of a real scene; random clouds are seen by nearly every view and would flatter nobody.
"""

from __future__ import annotations

import argparse
import json
import math
import statistics
import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from refine_addon.core import ClosedForm, Splats, ViewSet, read_cameras, read_ply, score
from refine_addon.core.execute import default_threads
from refine_addon.core.scoring import occlusion

from ..baselines import splat_transform

ROOM = Path(__file__).parents[2] / "tests/data/room_small"


def repeated(splats: Splats, count: int) -> Splats:
    """Return `count` splats made of `splats`, again and again, each a centimetre elsewhere.

    They are smaller the more there are, so that the surfaces stay as covered as they were.
    """
    index = np.arange(count) % len(splats)
    noise = np.random.default_rng(0).normal(scale=0.01, size=(count, 3)).astype(np.float32)
    many = splats.take(index)
    smaller = np.float32(math.log(max(count / len(splats), 1.0)) / 2)
    return replace(many, means=many.means + noise, log_scales=many.log_scales - smaller)


def median_seconds(work: Callable[[], object], runs: int) -> float:
    """Return the median of `runs` runs, after one that does not count."""
    work()
    seconds = []
    for _ in range(runs):
        start = time.perf_counter()
        work()
        seconds.append(time.perf_counter() - start)
    return statistics.median(seconds)


def views_of_room() -> ViewSet:
    """Return 64 views of the room: the 63 that trained it and one more."""
    train = json.loads((ROOM / "split.json").read_text())["train"]
    return read_cameras(ROOM / "cameras.json").select([*train, "000"])


def main(arguments: Sequence[str] | None = None) -> None:
    """Print the measurements."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--quick", action="store_true", help="up to 1 M splats, 3 runs")
    options = parser.parse_args(arguments)
    largest, runs = (1_000_000, 3) if options.quick else (10_000_000, 5)
    room, views = read_ply(ROOM / "point_cloud.ply").splats(), views_of_room()
    print(f"{default_threads()} threads, NumPy {np.__version__}, medians of {runs} runs")

    print("\nclosed form, 64 views: seconds, and nanoseconds a splat and view")
    counts = [count for count in (100_000, 1_000_000, 3_000_000, 10_000_000) if count <= largest]
    for count in counts:
        splats = repeated(replace(room, sh_rest=room.sh_rest[:, :0]), count)
        seconds = median_seconds(lambda s=splats: score(s, views, ClosedForm()), runs)
        print(f"  {count:>11,} splats  {seconds:7.3f} s  {seconds / count / 64 * 1e9:6.2f} ns")

    print("\nclosed form, 1 M splats: seconds by number of views")
    splats = repeated(replace(room, sh_rest=room.sh_rest[:, :0]), 1_000_000)
    for number in (8, 16, 32, 64, 128, 256):
        many = views.take(np.arange(number) % 64)
        seconds = median_seconds(lambda v=many: score(splats, v, ClosedForm(views=0)), runs)
        print(f"  {number:4} views  {seconds:7.3f} s")

    print("\nocclusion, 64 views, one pass: seconds, and million splat-views a second")
    for count in (40_000, 400_000, 1_900_000):
        splats = repeated(replace(room, sh_rest=room.sh_rest[:, :0]), min(count, largest))
        repeats = 1 if options.quick else 3
        seconds = median_seconds(lambda s=splats: occlusion.score_once(s, views), repeats)
        rate = len(splats) * 64 / seconds / 1e6
        print(f"  {len(splats):>11,} splats  {seconds:7.2f} s  {rate:6.1f} M/s")

    peak = (splat_transform.memory("VmHWM") or 0) / 1e6
    print(f"\npeak memory of all of this: {peak:,.0f} MB")


if __name__ == "__main__":
    main()
