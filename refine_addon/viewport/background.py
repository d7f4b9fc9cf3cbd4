"""One thread for what takes longer than a frame: arrays only, Blender's data is not safe there."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from functools import cache
from typing import ParamSpec, TypeVar

Result = TypeVar("Result")
Given = ParamSpec("Given")


def start(
    work: Callable[Given, Result], *values: Given.args, **options: Given.kwargs
) -> Future[Result]:
    """Run a call on the thread, after those before it."""
    return _pool().submit(work, *values, **options)


def stop() -> None:
    """Drop what has not begun, and let the thread end."""
    if _pool.cache_info().currsize:
        _pool().shutdown(wait=False, cancel_futures=True)
        _pool.cache_clear()


@cache
def _pool() -> ThreadPoolExecutor:
    return ThreadPoolExecutor(1, "refine-view")
