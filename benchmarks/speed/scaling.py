"""How a prune would scale with cores, by what it does one after the other.

    python -m benchmarks.speed.scaling SCENE_DIR --survivors absorb --ratio 0.9

One thread does everything; counted are seconds of the processor, so that other work on the machine
does not matter. Every piece of work that several cores could do at once (`work.each_chunk`) is
timed, and the pieces of each call are dealt out to 1, 2, 4, 8 and 16 cores, in their order, each to
the core that is free first; all else is serial (Amdahl's law). That is what is possible: pieces on
threads also wait for the interpreter's lock, and all of them for the memory. What is serial is told
by function, most first.
"""

from __future__ import annotations

import cProfile
import heapq
import pstats
import tempfile
import time
from pathlib import Path
from typing import TYPE_CHECKING, TypeVar

from refine_addon.core import Budget, prune_file, read_cameras, work
from refine_addon.core.operation.requests import PruneRequest
from refine_addon.core.task import Settings

from .recorded import prune_options

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Sequence

    from refine_addon.core.work import Progress

CORES = (1, 2, 4, 8, 16)
Result = TypeVar("Result")


class Division:
    """What of a run is done in pieces, and what is not.

    Attributes
    ----------
    calls : list of list of float
        Seconds of the pieces of each call.
    serial : cProfile.Profile
        Of all that is not in pieces.
    """

    def __init__(self) -> None:
        self.calls: list[list[float]] = []
        self.serial = cProfile.Profile(time.process_time)
        self._inside = False

    def watch(self) -> None:
        """Time the pieces of all calls from now on; of pieces within pieces the outer ones."""
        in_turn = work._in_turn  # noqa: SLF001 - what one thread does

        def timed(
            whole: Callable[[slice], Result],
            pieces: list[slice],
            step: int,
            progress: Progress,
            what: str,
        ) -> Iterator[Result]:
            if self._inside:
                return in_turn(whole, pieces, step, progress, what)
            seconds: list[float] = []
            self.calls.append(seconds)

            def of_piece(piece: slice) -> Result:
                self._inside = True
                self.serial.disable()
                start = time.process_time()
                try:
                    return whole(piece)
                finally:
                    seconds.append(time.process_time() - start)
                    self._inside = False
                    self.serial.enable()

            return in_turn(of_piece, pieces, step, progress, what)

        work._in_turn = timed  # noqa: SLF001


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


def main(arguments: Sequence[str] | None = None) -> None:
    """Run once, and print the model."""
    parser = prune_options("Model how a prune scales with cores.")
    parser.add_argument("--functions", type=int, default=12, help="serial ones to tell")
    options = parser.parse_args(arguments)
    views = read_cameras(options.scene / "cameras.json")
    request = PruneRequest(
        views, Budget(ratio=options.ratio), Settings(method=options.method),
        survivors=options.survivors,
    )  # fmt: skip
    division = Division()
    division.watch()
    with tempfile.TemporaryDirectory() as made:
        start = time.process_time()
        division.serial.enable()
        prune_file(options.scene / "point_cloud.ply", Path(made) / "out.ply", request, threads=1)
        division.serial.disable()
        total = time.process_time() - start
    serial = total - sum(map(sum, division.calls))
    print(f"{total:.1f} s, of which {serial:.1f} s ({serial / total:.1%}) serial")
    for cores in CORES:
        left = serial + sum(spread(call, cores) for call in division.calls)
        print(f"{cores:2} cores: {left:6.1f} s, {total / left:5.2f} x as fast")
    pstats.Stats(division.serial).sort_stats("tottime").print_stats(options.functions)


if __name__ == "__main__":
    main()
