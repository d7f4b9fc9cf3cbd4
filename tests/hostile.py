"""What a reader must do with a file that is wrong, and ways to make one."""

import contextlib
import json
import sys
import tracemalloc
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from refine_addon.core import RefineError, read_splats


def refused(
    path: Path,
    expected: str,
    data: bytes | None = None,
    *,
    read: Callable = read_splats,
    file: Path | None = None,
    memory: float = 5e6,
) -> str:
    """Return the message of `path`, or of `data` there: it names the file, or `file`, first.

    The reader took no memory beyond what small files account for.
    """
    if data is not None:
        path.write_bytes(data)
    tracemalloc.start()
    try:
        with np.errstate(all="raise"), pytest.raises(RefineError) as caught:
            read(path)
        peak = tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
    message = str(caught.value)
    del caught  # it holds this frame, and what was opened, until it is collected
    assert message.startswith(f"{file or path}: ")
    assert expected in message
    assert len(message) < 1000
    assert peak < memory
    return message


def with_value(content: Any, *path_and_value: Any) -> Any:
    """Return a copy of parsed JSON in which the value at a path is another."""
    *path, key, value = path_and_value
    content = json.loads(json.dumps(content))
    held = content
    for step in path:
        held = held[step]
    held[key] = value
    return content


def calls(work: Callable[[], object]) -> int:
    """Return how often functions are called, and return, in `work`: its time, on any machine."""
    events: list[None] = []
    sys.setprofile(lambda *_: events.append(None))
    try:
        work()
    finally:
        sys.setprofile(None)
    return len(events)


@contextlib.contextmanager
def files_of_at_most(size: int) -> Iterator[None]:
    """Let no file grow beyond so many bytes; what is written beyond them fails."""
    resource = pytest.importorskip("resource")
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, limits[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
