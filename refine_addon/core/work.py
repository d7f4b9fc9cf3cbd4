"""Chunked work on threads, with progress and cancellation."""

from __future__ import annotations

import ctypes
import os
import sys
import threading
import time
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor, wait
from contextlib import contextmanager, suppress
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

Progress = Callable[[float, str], "bool | None"]
"""Called as ``progress(fraction, what)``; returning ``False`` cancels."""

Result = TypeVar("Result")

REPLACES_MAPPED = os.name != "nt"
"""Whether a file that is mapped into memory can be replaced; Windows refuses."""

_HEAPS = -8  # M_ARENA_MAX of glibc's malloc.h
_HELD = 30_000_000  # bytes; above 32 MB, freeing a block does not raise glibc's threshold
_REPORT_INTERVAL = 0.1  # seconds between two reports while chunks take long
_own = threading.local()  # `checkpoint` calls the `check` of its own thread


class Cancelled(Exception):
    """Raised between two pieces of work when the progress callback returns ``False``."""


def silent(_fraction: float, _what: str) -> None:
    """Show nothing: the default progress callback."""


def report(progress: Progress, fraction: float, what: str) -> None:
    """Tell `progress`, and raise `Cancelled` if it answers ``False``."""
    if progress(fraction, what) is False:
        raise Cancelled


def part(progress: Progress, start: float, end: float) -> Progress:
    """Return a callback that maps fractions 0..1 to `start`..`end` of `progress`."""
    return lambda fraction, what: progress(start + (end - start) * fraction, what)


def checkpoint() -> None:
    """Let work be cancelled here: that of `for_chunks`, or else what `checked_by` encloses.

    Work with long chunks calls this several times a second. Outside of such work it does nothing.

    Raises
    ------
    Cancelled
        If the progress callback given to `for_chunks` answers ``False``.
    """
    check: Callable[[], None] | None = getattr(_own, "check", None)
    if check is not None:
        check()


@contextmanager
def checked_by(check: Callable[[], None]) -> Iterator[None]:
    """Make `checkpoint` call `check` in this thread, within the block."""
    before = getattr(_own, "check", None)
    _own.check = check
    try:
        yield
    finally:
        _own.check = before


def default_threads() -> int:
    """Return how many threads to use: the cores that this process may run on, at most 8."""
    if hasattr(os, "sched_getaffinity"):
        return min(len(os.sched_getaffinity(0)), 8)
    return min(os.cpu_count() or 1, 8)


def return_freed() -> None:
    """Return freed memory to the system, which the buffers of `each_chunk` keep from it.

    For the end of work that no more of its kind follows; only glibc needs to be asked.
    """
    if sys.platform == "linux":
        with suppress(OSError, AttributeError):  # another C library
            ctypes.CDLL(None).malloc_trim(0)


def share_heap() -> None:
    """Let all threads of this process allocate from one heap, for a process of our own.

    Each thread would have one of its own, which keeps what the thread freed even if all others need
    memory: 70 MB of 300 while 160,000 splats are absorbed. Only glibc does that.
    """
    if sys.platform == "linux":
        with suppress(OSError, AttributeError):  # another C library
            ctypes.CDLL(None).mallopt(_HEAPS, 1)


def chunks(total: int, chunk: int) -> Iterator[slice]:
    """Yield consecutive slices of ``range(total)``, all but the last of one length.

    Examples
    --------
    >>> [*chunks(5, 2)]
    [slice(0, 2, None), slice(2, 4, None), slice(4, 5, None)]
    """
    for start in range(0, total, chunk):
        yield slice(start, min(start + chunk, total))


def concatenated(parts: Sequence[NDArray[Any]], threads: int | None = None) -> NDArray[Any]:
    """Return arrays joined along their first axis, one at least, copied on several threads.

    Examples
    --------
    >>> concatenated([np.array([1, 2]), np.array([3])]).tolist()
    [1, 2, 3]
    """
    ends = np.cumsum([len(part) for part in parts])
    whole = np.empty((ends[-1], *parts[0].shape[1:]), parts[0].dtype)

    def copy(number: slice) -> None:
        values, end = parts[number.start], ends[number.start]
        whole[end - len(values) : end] = values

    for_chunks(copy, len(parts), 1, threads=threads)
    return whole


def for_chunks(
    work: Callable[[slice], Result],
    total: int,
    chunk: int,
    *,
    progress: Progress = silent,
    what: str = "",
    threads: int | None = None,
) -> list[Result]:
    """Call ``work(slice)`` for consecutive slices of ``range(total)`` and return its results.

    Parameters
    ----------
    work : callable
        Called on several threads at once; NumPy's loops release the interpreter lock.
    total, chunk : int
        Length to cover and length of one slice.
    progress, what
        Called from this thread between slices, and ten times a second while a slice takes long;
        with one thread, the latter only if the work calls `checkpoint`.
    threads : int, optional
        1 runs everything in this thread; by default `default_threads`.

    Returns
    -------
    list
        One result for each slice, in the order of the slices.

    Raises
    ------
    Cancelled
        If `progress` answers ``False``. Slices that have not begun are dropped; those that have
        begun end at their next `checkpoint`.
    """
    return list(each_chunk(work, total, chunk, progress=progress, what=what, threads=threads))


def each_chunk(
    work: Callable[[slice], Result],
    total: int,
    chunk: int,
    *,
    progress: Progress = silent,
    what: str = "",
    threads: int | None = None,
    stop: Callable[[], None] | None = None,
) -> Iterator[Result]:
    """Do the same as `for_chunks`, and yield each result as soon as those before it are there.

    Parameters
    ----------
    work, total, chunk, progress, what, threads
        See `for_chunks`.
    stop : callable, optional
        Called if the work on several threads is given up: ends what no `checkpoint` does.

    Yields
    ------
    object
        One result for each slice, in the order of the slices.

    Raises
    ------
    Cancelled
        See `for_chunks`.
    """
    # Freeing one 30 MB block raises glibc's mmap threshold, so chunk buffers are reused instead of
    # page-faulted. No effect on other systems.
    np.empty(_HELD, np.uint8)
    pieces = [*chunks(total, chunk)]
    threads = default_threads() if threads is None else threads
    # About a hundred reports are enough for a progress bar; each may cost a redraw.
    step = max(len(pieces) // 100, 1)
    if threads <= 1 or len(pieces) <= 1:
        yield from _in_turn(work, pieces, step, progress, what)
    else:
        yield from _side_by_side(work, pieces, step, progress, what, threads, stop)


def _in_turn(
    work: Callable[[slice], Result], pieces: list[slice], step: int, progress: Progress, what: str
) -> Iterator[Result]:
    """Do the work of `for_chunks` in this thread."""
    done = 0
    told = 0.0  # when `progress` was last called, seconds

    def tell() -> None:
        nonlocal told
        told = time.monotonic()
        report(progress, done / len(pieces), what)

    def check() -> None:
        if time.monotonic() - told >= _REPORT_INTERVAL:
            tell()

    for done, piece in enumerate(pieces):
        if done % step == 0:
            checkpoint()  # what this is a part of may be cancelled
            tell()
        with checked_by(check):
            result = work(piece)
        yield result


def _side_by_side(
    work: Callable[[slice], Result],
    pieces: list[slice],
    step: int,
    progress: Progress,
    what: str,
    threads: int,
    stop: Callable[[], None] | None,
) -> Iterator[Result]:
    """Do the work of `for_chunks` on several threads."""
    cancelled = threading.Event()

    def check() -> None:
        if cancelled.is_set():
            raise Cancelled

    def checked(piece: slice) -> Result:
        with checked_by(check):
            return work(piece)

    with ThreadPoolExecutor(threads) as pool:
        futures = deque(pool.submit(checked, piece) for piece in pieces)
        try:
            for index in range(len(pieces)):
                if index % step == 0:
                    report(progress, index / len(pieces), what)
                future = futures.popleft()  # and forget the result once it is used
                while not future.done() and not wait([future], _REPORT_INTERVAL).done:
                    report(progress, index / len(pieces), what)
                yield future.result()
                del future
        except BaseException:
            cancelled.set()
            for future in futures:
                future.cancel()
            if stop is not None:
                stop()
            raise
