"""How prunes would scale with cores, by what they do one after the other.

    python -m benchmarks.speed.scaling SCENE_DIR [--methods merge refit ...] [--ratio 0.9]

One thread does everything; counted are seconds of the processor, so that other work on the machine
does not matter. Every piece of work that several cores could do at once (`execute.run`) is
timed, and the pieces of each call are dealt out to 1, 2, 4, 8 and 16 cores, in their order, each to
the core that is free first; all else is serial (Amdahl's law). That is what is possible: pieces on
threads also wait for the interpreter's lock, and all of them for the memory. ``--functions`` tells
what is serial by function, and what was done in pieces. ``--two`` also runs the whole command on
one core and on two, and prints seconds of the clock, for a machine that does nothing else.
"""

from __future__ import annotations

import argparse
import cProfile
import heapq
import pstats
import tempfile
import time
from collections import defaultdict
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

from refine_addon.core import METHODS, Budget, Method, execute, prune_file, read_cameras

CORES = (2, 4, 8, 16)


class Division:
    """What of a run is done in pieces, and what is not.

    - calls, list of (str, list of float): What each call does, and seconds of its pieces.
    - serial: Of all that is not in pieces.
    """

    def __init__(self) -> None:
        self.calls: list[tuple[str, list[float]]] = []
        self.serial = cProfile.Profile(time.process_time)
        self._inside = False

    def watch(self) -> None:
        """Time the pieces of all calls from now on; of pieces within pieces the outer ones."""
        in_turn = execute._in_turn

        def timed(
            work: Callable[[Any], Any], items: list[Any], tell: Callable[[int], None]
        ) -> Iterator[Any]:
            if self._inside:
                return in_turn(work, items, tell)
            seconds: list[float] = []
            self.calls.append((getattr(work, "__qualname__", type(work).__name__), seconds))

            def of_piece(item: Any) -> Any:
                self._inside = True
                self.serial.disable()
                start = time.process_time()
                try:
                    return work(item)
                finally:
                    seconds.append(time.process_time() - start)
                    self._inside = False
                    self.serial.enable()

            return in_turn(of_piece, items, tell)

        execute._in_turn = timed


def spread(seconds: Sequence[float], cores: int) -> float:
    """Return how long pieces take on several cores, each taken by the one that is free first.

    Examples
    --------
    >>> spread([3.0, 1.0, 1.0], 1), spread([3.0, 1.0, 1.0], 2)
    (5.0, 3.0)
    """
    free = [0.0] * cores
    for each in seconds:
        heapq.heappushpop(free, free[0] + each)
    return max(free)


def pruned(scene: Path, ratio: float, method: Method, threads: int) -> None:
    """Prune a scene from file to file."""
    source, views = scene / "point_cloud.ply", read_cameras(scene / "cameras.json")
    with tempfile.TemporaryDirectory() as made:
        output = Path(made) / "out.ply"
        prune_file(source, output, views, Budget(ratio=ratio), method, threads=threads)


def modelled(scene: Path, ratio: float, method: Method) -> tuple[Division, float]:
    """How a prune is divided, done by one thread, and seconds of the processor."""
    division = Division()
    in_turn = execute._in_turn
    division.watch()
    try:
        start = time.process_time()
        division.serial.enable()
        pruned(scene, ratio, method, 1)
        division.serial.disable()
        return division, time.process_time() - start
    finally:
        execute._in_turn = in_turn


def clocked(scene: Path, ratio: float, method: Method, threads: int) -> float:
    """How long a prune takes, seconds of the clock."""
    start = time.perf_counter()
    pruned(scene, ratio, method, threads)
    return time.perf_counter() - start


def main(arguments: Sequence[str] | None = None) -> None:
    """Run each method once, and print the model."""
    parser = argparse.ArgumentParser(description="Model how prunes scale with cores.")
    parser.add_argument("scene", type=Path, help="folder of point_cloud.ply and cameras.json")
    parser.add_argument("--methods", choices=METHODS, nargs="+", default=[*METHODS])
    parser.add_argument("--ratio", type=float, default=0.5)
    parser.add_argument("--functions", type=int, default=0, help="serial ones to tell")
    parser.add_argument("--two", action="store_true", help="also measure one core and two")
    options = parser.parse_args(arguments)
    print("| | 1 core | serial | " + " | ".join(f"{cores} cores" for cores in CORES) + " |")
    print("|---|" + "---:|" * (len(CORES) + 2))
    for name in options.methods:
        asked = options.scene, options.ratio, METHODS[name]()
        division, total = modelled(*asked)
        serial = total - sum(sum(seconds) for _, seconds in division.calls)
        faster = [
            total / (serial + sum(spread(seconds, cores) for _, seconds in division.calls))
            for cores in CORES
        ]
        told = " | ".join(f"{factor:.2f} x" for factor in faster)
        print(f"| {name} | {total:.1f} s | {serial / total:.1%} | {told} |", flush=True)
        if options.functions:
            _tell(division, options.functions)
        if options.two:
            one, two = (clocked(*asked, threads) for threads in (1, 2))
            print(f"{name}: {one:.1f} s by one, {two:.1f} s by two: {one / two:.2f} x", flush=True)


def _tell(division: Division, count: int) -> None:
    """Print what of a run is serial, and what was done in pieces, most first."""
    pstats.Stats(division.serial).sort_stats("tottime").print_stats(count)
    pieces: dict[str, list[float]] = defaultdict(list)
    for name, seconds in division.calls:
        pieces[name] += seconds
    for name, seconds in sorted(pieces.items(), key=lambda pair: -sum(pair[1]))[:count]:
        print(f"{sum(seconds):8.2f} s in {len(seconds):5} pieces  {name}")


if __name__ == "__main__":
    main()
