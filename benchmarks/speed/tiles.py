"""How long tiles take that are pruned together, and what memory the process needs.

    python -m benchmarks.speed.tiles [--splats 10000000] [--tiles 10] [--workers 0 1 2]
    python -m benchmarks.speed.tiles --method merge

The tiles are the committed room's rows without harmonics above the constant one, 56 bytes each, a
room beside the other along a street. The room's cameras stand in all rooms, in each as many, so a
tile is seen by its own and by those that look along the street; with ``--one-room`` all of them
stand in the middle one. They are compared with reading and writing the same bytes: `cat` of all
tiles into one file.

Memory is that of the process and those that it starts, without what is mapped of files. Seconds of
the processor tell what a busy machine hides.
"""

from __future__ import annotations

import argparse
import json
import os
import shutil
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from refine_addon.core import METHODS, read_ply
from refine_addon.core.formats.ply import new_header
from refine_addon.core.formats.ply_columns import REQUIRED

from ..baselines import splat_transform

ROOT = Path(__file__).parents[2]
ROOM = ROOT / "tests/data/room_small"

ASIDE = 12.0
"""How far a room is from the next, world units."""


def make_tiles(folder: Path, splats: int, tiles: int) -> list[Path]:
    """Write so many tiles with so many splats altogether."""
    room = read_ply(ROOM / "point_cloud.ply").rows
    random = np.random.default_rng(0)
    kind = np.dtype([(name, "<f4") for name in REQUIRED])
    paths = []
    for tile in range(tiles):
        count = splats // tiles
        path = folder / f"tile_{tile:03d}.ply"
        with path.open("wb") as stream:
            stream.write(new_header(np.dtype([(name, "<f4") for name in REQUIRED]), count))
            for start in range(0, count, len(room)):
                some = room[: count - start]
                rows = np.empty(len(some), kind)
                for name in REQUIRED:
                    rows[name] = some[name]
                for axis in "xyz":
                    rows[axis] += random.normal(scale=0.02, size=len(rows)).astype(np.float32)
                rows["x"] += np.float32(ASIDE * (tile - tiles // 2))
                stream.write(rows.data)
        paths.append(path)
    return paths


def make_cameras(path: Path, tiles: int) -> None:
    """Write the room's cameras, spread over the rooms of `make_tiles`."""
    cameras = json.loads((ROOM / "cameras.json").read_text())
    shuffled = np.random.default_rng(0).permutation(len(cameras))
    for camera, place in zip(cameras, shuffled.tolist(), strict=True):
        camera["position"][0] += ASIDE * (place * tiles // len(cameras) - tiles // 2)
    path.write_text(json.dumps(cameras))


def main(arguments: Sequence[str] | None = None) -> None:
    """Print what each way takes."""
    parser = argparse.ArgumentParser(description="Time tiles that are pruned together.")
    parser.add_argument("--splats", type=int, default=10_000_000)
    parser.add_argument("--tiles", type=int, default=10)
    parser.add_argument(
        "--workers", type=int, nargs="*", default=[0], help="0: none of Dask's; any again"
    )
    parser.add_argument("--method", choices=METHODS, default="closed-form")
    parser.add_argument("--one-room", action="store_true", help="all cameras in the middle room")
    parser.add_argument("--folder", type=Path, help="on the disk to measure; default the system's")
    options = parser.parse_args(arguments)
    with tempfile.TemporaryDirectory(dir=options.folder) as made:
        folder = Path(made)
        paths = make_tiles(folder, options.splats, options.tiles)
        size = sum(path.stat().st_size for path in paths)
        print(f"{options.splats:,} splats, {options.tiles} tiles, {size / 1e6:.0f} MB")
        print(f"load average {os.getloadavg()[0]:.1f}, {os.cpu_count()} cores")
        cameras = folder / "cameras.json"
        make_cameras(cameras, 1 if options.one_room else options.tiles)
        copy = ["sh", "-c", 'cat "$@" > "$0"', folder / "copy", *paths]
        prune = [sys.executable, "-m", "refine_addon", "prune", *paths, "--together", "--ratio"]
        prune += ["0.5", "--cameras", cameras, "--method", options.method]
        output = folder / "out"
        commands = [("copy", copy)]
        for workers in options.workers:
            more = ["--workers", str(workers)] if workers else []
            commands.append((f"{workers} workers", [*prune, "-o", output, *more]))
        for name, command in commands:
            seconds, busy, peak = splat_transform.measured(command)
            shutil.rmtree(output, ignore_errors=True)
            print(
                f"{name:10} {seconds:7.1f} s, processor {busy:7.1f} s, {peak:6.0f} MB",
                flush=True,
            )


if __name__ == "__main__":
    main()
