"""Who does the steps of a job: workers of a Dask cluster, on this machine or on others.

Only steps and their results travel: sums, counts and names. Workers read the tiles and read and
write the folder of the job, which all of them must see under the same path. Dask does the steps of
a lost worker again elsewhere, and a step that is done twice writes the same bytes.
"""

from __future__ import annotations

import contextlib
import functools
import pickle
import threading
import uuid
from collections import deque
from typing import TYPE_CHECKING, Any

from ...version import VERSION
from ..errors import RefineError
from ..work import Progress, report
from .steps import unseen_files
from .workers import Interrupted

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

    from .steps import Job
    from .units import Tile
    from .workers import Call

_AHEAD = 3
"""Groups of steps a thread of a worker that are handed out ahead: so many wait here at most."""

_TOGETHER = 16
"""Most steps in a group: each group takes scheduler and coordinator about 15 ms."""

_TURNS = 4
"""Groups a thread at least, where there are as many steps, so that all end at about one time."""

_PATIENCE = 0.2
"""Seconds between two looks whether to go on."""

_MEMORY = {
    "distributed.nanny.pre-spawn-environ.MALLOC_TRIM_THRESHOLD_": 1 << 28,
    "distributed.nanny.pre-spawn-environ.MALLOC_MMAP_THRESHOLD_": 1 << 25,
}
"""Dask lets glibc hand back memory at once, in bytes; arrays of a chunk would be page-faulted anew
for each chunk, which takes longer than the work."""

_CONNECT = 10
"""Seconds to find a scheduler."""


@contextlib.contextmanager
def cluster(workers: int | None = None, scheduler: str | None = None) -> Iterator[Cluster]:
    """Start workers in processes of their own, or use those of a scheduler.

    Parameters
    ----------
    workers : int, optional
        How many to start here, of one thread each.
    scheduler : str, optional
        Address of a scheduler, such as ``tcp://10.0.0.1:8786``.

    Yields
    ------
    Cluster
        For ``prune_tiles(..., workers=...)``.

    Raises
    ------
    RefineError
        If Dask is not installed, or the scheduler not to be found.
    """
    try:
        import dask  # noqa: PLC0415 - an optional extra
        import distributed  # noqa: PLC0415
    except ImportError as error:
        msg = "workers need Dask: pip install 'refine-addon[distributed]'"
        raise RefineError(msg) from error
    with contextlib.ExitStack() as held:
        if scheduler is None:
            held.enter_context(dask.config.set(_MEMORY))
            scheduler = held.enter_context(
                distributed.LocalCluster(
                    n_workers=workers, threads_per_worker=1, processes=True,
                    dashboard_address=None, memory_limit=None, silence_logs=50,
                )
            )  # fmt: skip
        try:
            client = held.enter_context(distributed.Client(scheduler, timeout=_CONNECT))
        except (OSError, ValueError) as error:
            msg = f"{scheduler}: no Dask scheduler answers there ({error})"
            raise RefineError(msg) from error
        yield Cluster(client)


class Cluster:
    """Does steps on the workers of a Dask cluster.

    Parameters
    ----------
    client : distributed.Client
    """

    def __init__(self, client: Any) -> None:  # noqa: ANN401 - Dask has no types
        self._client = client

    def check(self, job: Job, tiles: list[Tile]) -> None:
        """Ask every worker whether it sees the files of a job.

        Raises
        ------
        RefineError
            If there is no worker, or one does not see a file or has another version; by its name.
        """
        try:
            answers = self._client.run(_answer, VERSION, job, tiles, on_error="return")
        except Exception as error:
            msg = f"the workers do not answer: {error}"
            raise RefineError(msg) from error
        if not answers:
            msg = "the scheduler has no workers"
            raise RefineError(msg)
        for worker, answer in answers.items():
            wrong = answer
            if isinstance(answer, BaseException):
                wrong = f"it cannot run refine {VERSION}: {answer}"
            if wrong:
                msg = f"worker {worker}: {wrong}; workers need the same files under the same paths"
                raise RefineError(msg)

    def __call__(
        self, job: object, calls: Sequence[Call], progress: Progress, what: str
    ) -> Iterator[Any]:
        """Yield what each call returns, in their order.

        Raises
        ------
        Interrupted
            If workers were lost again and again.
        """
        from distributed import CancelledError, KilledWorker  # noqa: PLC0415 - as above
        from distributed.comm import CommClosedError  # noqa: PLC0415

        packed = pickle.dumps(job)  # once: the arrays of all views take Dask some milliseconds
        threads = max(sum(self._client.nthreads().values()), 1)
        size = max(1, min(_TOGETHER, len(calls) // (_TURNS * threads)))
        groups = [calls[start : start + size] for start in range(0, len(calls), size)]
        waiting: deque[Any] = deque()
        left, done = deque(groups), 0.0
        try:
            for group in groups:
                while left and len(waiting) < _AHEAD * threads:
                    waiting.append(self._submit(packed, left.popleft()))
                results = self._result(waiting[0], progress, done, what)
                waiting.popleft()
                for call, result in zip(group, results, strict=True):
                    done += call.share
                    yield result
        except (KilledWorker, CancelledError, CommClosedError) as error:
            msg = f"workers were lost ({error}); the same command goes on where this one was"
            raise Interrupted(msg) from error
        finally:
            self._client.cancel([*waiting])

    def _submit(self, packed: bytes, group: Sequence[Call]) -> Any:  # noqa: ANN401 - Dask's future
        key = f"{group[0].step}-{uuid.uuid4().hex}"
        return self._client.submit(_do, packed, [*group], key=key)

    def _result(self, future: Any, progress: Progress, done: float, what: str) -> Any:  # noqa: ANN401
        """Return the result of a future, and ask meanwhile whether to go on."""
        ended = threading.Event()
        future.add_done_callback(lambda _: ended.set())
        report(progress, done, what)
        while not ended.wait(_PATIENCE):
            report(progress, done, what)
        return future.result()


def _do(packed: bytes, group: Sequence[Call]) -> list[Any]:
    """Do steps of a job one after the other, in a worker."""
    job = _unpacked(packed)
    return [call.do(job, threads=1) for call in group]


@functools.lru_cache(maxsize=2)
def _unpacked(packed: bytes) -> object:
    return pickle.loads(packed)  # noqa: S301 - Dask itself sends pickles


def _answer(version: str, job: Job, tiles: list[Tile]) -> str:
    """Say what is wrong with this worker; "" if nothing is."""
    if version != VERSION:
        return f"it has refine {VERSION}, this is {version}"
    return unseen_files(job, tiles)
