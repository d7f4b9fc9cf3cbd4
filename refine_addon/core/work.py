"""Chunked work on threads, with progress and cancellation."""

from __future__ import annotations

import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import TypeVar

import numpy as np

from .errors import Cancelled

Progress = Callable[[float, str], "bool | None"]
"""Called as ``progress(fraction, what)``; returning ``False`` cancels."""

Result = TypeVar("Result")

_HELD = 30_000_000  # bytes; glibc heeds no block above 32 MB


def silent(_fraction: float, _what: str) -> None:
    """Show nothing: the default progress callback."""


def report(progress: Progress, fraction: float, what: str) -> None:
    """Tell `progress`, and raise `Cancelled` if it answers ``False``."""
    if progress(fraction, what) is False:
        raise Cancelled


def part(progress: Progress, start: float, end: float) -> Progress:
    """Return a callback whose 0..1 is `start`..`end` of `progress`."""
    return lambda fraction, what: progress(start + (end - start) * fraction, what)


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
        Called from this thread, between slices.
    threads : int, optional
        1 runs everything here; by default `default_threads`.

    Returns
    -------
    list
        One result a slice, in the order of the slices whatever the number of threads.

    Raises
    ------
    Cancelled
        If `progress` answers ``False``; work that has not begun is dropped.
    """
    # glibc hands each freed block to the system at once, and takes it back page by page, up to the
    # size of the largest that was ever freed: chunks are to find their memory where they left it.
    np.empty(_HELD, np.uint8)
    slices = [slice(start, min(start + chunk, total)) for start in range(0, total, chunk)]
    threads = default_threads() if threads is None else threads
    # About a hundred reports are enough for a bar, and each costs a draw.
    step = max(len(slices) // 100, 1)
    results: list[Result] = []
    if threads <= 1 or len(slices) <= 1:
        for index, piece in enumerate(slices):
            if index % step == 0:
                report(progress, index / len(slices), what)
            results.append(work(piece))
        return results
    with ThreadPoolExecutor(threads) as pool:
        futures = [pool.submit(work, piece) for piece in slices]
        try:
            for index, future in enumerate(futures):
                if index % step == 0:
                    report(progress, index / len(slices), what)
                results.append(future.result())
        except BaseException:
            for future in futures:
                future.cancel()
            raise
    return results
