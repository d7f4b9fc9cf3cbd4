"""Chunked work on threads, with progress and cancellation."""

from __future__ import annotations

import os
import threading
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor, wait
from contextlib import contextmanager
from typing import TypeVar

import numpy as np

from .errors import Cancelled

Progress = Callable[[float, str], "bool | None"]
"""Called as ``progress(fraction, what)``; returning ``False`` cancels."""

Result = TypeVar("Result")

_HELD = 30_000_000  # bytes; glibc ignores blocks above 32 MB here
_PATIENCE = 0.1  # seconds between two reports while chunks take long
_own = threading.local()  # of each thread; its `check` is what `checkpoint` calls


def silent(_fraction: float, _what: str) -> None:
    """Show nothing: the default progress callback."""


def report(progress: Progress, fraction: float, what: str) -> None:
    """Tell `progress`, and raise `Cancelled` if it answers ``False``."""
    if progress(fraction, what) is False:
        raise Cancelled


def part(progress: Progress, start: float, end: float) -> Progress:
    """Return a callback whose 0..1 is `start`..`end` of `progress`."""
    return lambda fraction, what: progress(start + (end - start) * fraction, what)


def checkpoint() -> None:
    """Let a chunk of `for_chunks` be cancelled here; does nothing in any other thread.

    Work whose chunks take long calls this several times a second.

    Raises
    ------
    Cancelled
        If the progress callback of that `for_chunks` answers ``False``.
    """
    check: Callable[[], None] | None = getattr(_own, "check", None)
    if check is not None:
        check()


@contextmanager
def _checked_by(check: Callable[[], None]) -> Iterator[None]:
    """Have `checkpoint` call `check` in this thread."""
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
        Runs on several threads at once; NumPy's loops release the interpreter.
    total, chunk : int
        Length to cover and length of one slice.
    progress, what
        Called from this thread, between slices and, where they take long, ten times a second;
        with one thread only where the work calls `checkpoint`.
    threads : int, optional
        1 runs everything here; by default `default_threads`.

    Returns
    -------
    list
        One result a slice, in the order of the slices whatever the number of threads.

    Raises
    ------
    Cancelled
        If `progress` answers ``False``; work that has not begun is dropped, and what has begun
        ends at its next `checkpoint`.
    """
    # Freeing one block of this size makes glibc keep freed blocks up to it instead of handing them
    # to the system, so the buffers of the next chunk are not mapped in again page by page.
    np.empty(_HELD, np.uint8)
    slices = [slice(start, min(start + chunk, total)) for start in range(0, total, chunk)]
    threads = default_threads() if threads is None else threads
    # About a hundred reports are enough for a bar, and each costs a draw.
    step = max(len(slices) // 100, 1)
    if threads <= 1 or len(slices) <= 1:
        return _in_turn(work, slices, step, progress, what)
    return _side_by_side(work, slices, step, progress, what, threads)


def _in_turn(
    work: Callable[[slice], Result], slices: list[slice], step: int, progress: Progress, what: str
) -> list[Result]:
    results: list[Result] = []
    told = 0.0

    def tell() -> None:
        nonlocal told
        told = time.monotonic()
        report(progress, len(results) / len(slices), what)

    def check() -> None:
        if time.monotonic() - told >= _PATIENCE:
            tell()

    with _checked_by(check):
        for index, piece in enumerate(slices):
            if index % step == 0:
                tell()
            results.append(work(piece))
    return results


def _side_by_side(
    work: Callable[[slice], Result],
    slices: list[slice],
    step: int,
    progress: Progress,
    what: str,
    threads: int,
) -> list[Result]:
    cancelled = threading.Event()

    def check() -> None:
        if cancelled.is_set():
            raise Cancelled

    def checked(piece: slice) -> Result:
        with _checked_by(check):
            return work(piece)

    results: list[Result] = []
    with ThreadPoolExecutor(threads) as pool:
        futures = [pool.submit(checked, piece) for piece in slices]
        try:
            for index, future in enumerate(futures):
                if index % step == 0:
                    report(progress, index / len(slices), what)
                while not future.done() and not wait([future], _PATIENCE).done:
                    report(progress, index / len(slices), what)
                results.append(future.result())
        except BaseException:
            cancelled.set()
            for future in futures:
                future.cancel()
            raise
    return results
