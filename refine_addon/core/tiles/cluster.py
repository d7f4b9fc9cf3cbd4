"""Work done on the workers of a Dask cluster, on this machine or on others.

Arrays in files are sent as names, so workers must see the job's folder under the same path. Dask
repeats the work of a lost worker on another.
"""

from __future__ import annotations

import asyncio
import contextlib
import functools
import pickle
import signal
import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from multiprocessing import resource_tracker
from pathlib import Path
from typing import Any, NamedTuple

from ...version import VERSION
from ..errors import RefineError
from ..execute import chunks, run_all, sent_ahead, within
from ..mapped import Interrupted
from ..whole_file import explained
from .files import Tile, bytes_of, waiting_in

_AHEAD = 3  # groups of items for each thread that are sent ahead, whose results may wait here
_TOGETHER = 16  # most items in a group: each group takes scheduler and coordinator about 15 ms
_TURNS = 4  # least groups for each thread, so that all end at about the same time
_ALONE = 60.0  # seconds without any worker after which a job ends

_MEMORY = {
    "distributed.nanny.pre-spawn-environ.MALLOC_TRIM_THRESHOLD_": 1 << 28,
    "distributed.nanny.pre-spawn-environ.MALLOC_MMAP_THRESHOLD_": 1 << 25,
}
"""Bytes. With Dask's own values glibc returns memory at once, and page faults in the arrays of each
chunk take longer than the work."""

_CONNECT = 10  # seconds to find a scheduler, and a worker
_TRIES = 3  # times that workers are checked if all are lost meanwhile


@contextlib.contextmanager
def cluster(workers: int | str) -> Iterator[Cluster]:
    """Start `workers` processes of one thread each, or use the scheduler at that address."""
    try:
        import dask
        import distributed
    except ImportError as error:
        raise RefineError("workers need Dask: pip install 'refine-addon[distributed]'") from error
    with contextlib.ExitStack() as held:
        scheduler: Any = workers
        if not isinstance(workers, str):
            held.enter_context(dask.config.set(_MEMORY))
            try:
                local = _uninterrupted(
                    distributed.LocalCluster, n_workers=workers, threads_per_worker=1,
                    processes=True, dashboard_address=None, memory_limit=None, silence_logs=50,
                )  # fmt: skip
                scheduler = held.enter_context(local)
            except Exception as error:
                problem = f"workers ended while they were started ({error})"
                raise Interrupted(f"{problem}; try again") from error
        problem = "no Dask scheduler answers there"
        with explained(scheduler, problem, errors=Exception):  # what answers may be misread
            client = held.enter_context(distributed.Client(scheduler, timeout=_CONNECT))
        yield Cluster(client)


def _uninterrupted(make: Callable[..., Any], **how: Any) -> Any:
    """Run `make` without Ctrl-C, raised later: a half-started cluster could not be closed."""
    with ThreadPoolExecutor(1, initializer=_block_ctrl_c) as pool:
        future = pool.submit(make, **how)
        try:
            return future.result()
        except KeyboardInterrupt:
            with contextlib.suppress(Exception):
                future.result().close()
            raise


def _block_ctrl_c() -> None:
    """Keep a terminal's Ctrl-C from this thread and the processes that it starts."""
    if hasattr(signal, "pthread_sigmask"):  # not on Windows
        resource_tracker.ensure_running()  # starting it, Python unblocks these signals
        signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})


class Cluster(NamedTuple):
    """The workers of a Dask cluster; see `execute.within`."""

    client: Any

    def check(self, job: Path, tiles: Sequence[Tile], kind: Any = RefineError) -> None:
        """Raise an error of a `kind` if a worker lacks files or the version, or there is none.

        It is `Interrupted` if the workers do not answer.
        """
        for _ in range(_TRIES):
            try:
                self.client.wait_for_workers(1, timeout=_CONNECT)
                answers = self.client.run(_answer, VERSION, job, tiles, on_error="return")
            except TimeoutError as error:
                raise kind("the scheduler has no workers") from error
            except Exception as error:
                raise Interrupted(f"the workers do not answer: {error}") from error
            # An OSError is of a worker that was lost meanwhile.
            there = [pair for pair in answers.items() if not isinstance(pair[1], OSError)]
            for worker, answer in there:
                if isinstance(answer, BaseException):
                    answer = f"it cannot run refine {VERSION}: {answer}"
                if answer:
                    wanted = "workers need the same files under the same paths"
                    raise kind(f"worker {worker}: {answer}; {wanted}")
            if there:
                return
        raise Interrupted("the workers were lost again and again")

    def run(self, packed: bytes, items: Sequence[Any], tell: Callable[[int], None]) -> Iterator:
        """Yield results of pickled work on items, in order; `Interrupted` if workers are lost."""
        from distributed import CancelledError, KilledWorker
        from distributed.comm import CommClosedError

        threads = max(sum(self.client.nthreads().values()), 1)
        size = max(1, min(_TOGETHER, len(items) // (_TURNS * threads)))
        groups, seen = [items[each] for each in chunks(len(items), size)], time.monotonic()

        def look(done: int) -> None:
            nonlocal seen
            tell(done * size)
            alone = time.monotonic() - seen
            if alone > _ALONE / 10.0 and self.client.nthreads():
                seen = time.monotonic()
            elif alone > _ALONE:
                raise Interrupted("all workers were lost")

        submit = functools.partial(self.client.submit, _run, packed, pure=False)
        try:
            for results in sent_ahead(submit, groups, _AHEAD * threads, look, self.client.cancel):
                yield from results
                seen = time.monotonic()
        except (KilledWorker, CancelledError, CommClosedError) as error:
            raise Interrupted(f"workers were lost ({error})") from error


def _run(packed: bytes, items: Sequence[Any]) -> list[Any]:
    with within(cores=1):
        return run_all(_unpacked(packed), items, threads=1)


_unpacked = functools.lru_cache(maxsize=2)(pickle.loads)


async def _answer(version: str, job: Path, tiles: Sequence[Tile]) -> str:
    if version != VERSION:
        return f"it has refine {VERSION}, this is {version}"
    # Not on the worker's own thread: requests for many tiles would make it look dead.
    return await asyncio.to_thread(_missing, job, tiles)


def _missing(job: Path, tiles: Sequence[Tile]) -> str:
    """Sentence that names the job's files that this process cannot see, or ""."""
    if not waiting_in(job).exists():
        return f"{job} is not there"
    for tile in tiles:
        with contextlib.suppress(RefineError, OSError):
            [*bytes_of(tile, 0, tile.header)]
            continue
        return f"{tile.path} is not there, or another file"
    return ""
