"""Work in processes of their own, where threads would wait for each other.

NumPy's loops run without Python's lock, but work made of many short loops keeps passing it on: two
threads of such work are a fifth faster than one, two processes nearly twice as fast. The processes
run this same Python and this same package, wherever it lies, and nothing of the calling program, so
no script needs a guard around its main part. They are kept for the next call, and end when they
have had nothing to do for `IDLE` seconds, or when this process ends. What they print is lost.
"""

from __future__ import annotations

import atexit
import json
import mmap
import os
import pickle
import queue
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path
from typing import Any, BinaryIO, NamedTuple, TypeVar

from .work import (
    REPLACES_MAPPED,
    Progress,
    default_threads,
    each_chunk,
    for_chunks,
    part,
    return_freed,
    silent,
)

Result = TypeVar("Result")

IDLE = 8.0
"""Seconds without work after which a process ends, and gives back its memory; others start fast."""

WORTH, WORTH_READY = 2.0, 0.2
"""Seconds of work, on one core, from which on it is worth doing in processes: if they are yet to be
started, which takes each a third of a second, and if they are there."""

_PACKAGE, _FOLDER = __name__.rpartition(".core.")[0], Path(__file__).resolve().parents[1]

_BEGIN = """
import importlib, json, sys, types
name, folder, sys.path[:] = json.loads(sys.argv[1])
above = name.split(".")[:-1]
places = {".".join(above[: i + 1]): [] for i in range(len(above))}
places |= {name: [folder], name + ".core": [folder + "/core"]}
for package, place in places.items():
    module = sys.modules[package] = types.ModuleType(package)
    module.__path__ = place
importlib.import_module(name + ".core.processes").serve()
"""
"""What a process runs: it finds modules under the names that they have here, where an add-on is
part of other packages, and runs none of the packages' own code."""

_ALIGNED = 64  # bytes, of arrays in a file
_idle: list[_Process] = []
_lock = threading.Lock()


class _Task(NamedTuple):
    """Work for a process.

    What was pickled, and the file of the arrays, each from one byte to another.
    """

    pickled: bytes
    path: str
    places: list[tuple[int, int]]


class _LostError(Exception):
    """A process could not be started, or ended too early."""


def for_each(
    work: Callable[[int], Result],
    count: int,
    seconds: float,
    *,
    progress: Progress = silent,
    what: str = "",
    threads: int | None = None,
) -> Iterator[Result]:
    """Call ``work(number)`` for each of ``range(count)``, and yield its results in order.

    Parameters
    ----------
    work : callable
        Can be pickled, and so can its results; what it changes is lost. Its results must not depend
        on where it runs.
    count : int
    seconds : float
        About how long all of it takes on one core; work that is not worth processes is done on
        threads.
    progress, what
        See `work.for_chunks`.
    threads : int, optional
        How many cores to use; 1 does everything in this thread.

    Yields
    ------
    object
        Each result as soon as those before it are there.

    Raises
    ------
    Cancelled
        If `progress` answers ``False``; processes end at once.
    """
    number = min(default_threads() if threads is None else threads, count)
    begin = 0
    if number > 1 and seconds >= _least(number) and _possible():
        try:
            for result in _apart(work, count, number, progress, what):
                yield result
                begin += 1
        except _LostError:
            pass  # no room for a process or a file: threads need neither
        else:
            return
    left = count - begin
    yield from each_chunk(
        lambda piece: work(begin + piece.start), left, 1,
        progress=part(progress, begin / max(count, 1), 1.0), what=what, threads=threads,
    )  # fmt: skip


def start(seconds: float, threads: int | None = None) -> None:
    """Start the processes that `for_each` will want soon, so that they are there by then.

    Parameters
    ----------
    seconds, threads
        See `for_each`.
    """
    number = default_threads() if threads is None else threads
    if number > 1 and seconds >= _least(number) and _possible():
        with suppress(_LostError):
            team = _taken(number)
            with _lock:
                _idle.extend(team)


def _least(number: int) -> float:
    """Return from how many seconds of work on it is worth having `number` processes."""
    with _lock:
        return WORTH_READY if sum(process.ready for process in _idle) >= number else WORTH


def _possible() -> bool:
    """Return whether this process was started by a Python that can be started again."""
    frozen = getattr(sys, "frozen", False)
    return not frozen and Path(sys.executable or "").name.lower().startswith("python")


def _apart(
    work: Callable[[int], Result], count: int, number: int, progress: Progress, what: str
) -> Iterator[Result]:
    """Do the work of `for_each` in `number` processes.

    Raise `_LostError` if they, or the file that they share, cannot be had.
    """
    with _shared(work) as (task, folder):
        team = _taken(number)
        free: queue.SimpleQueue[_Process] = queue.SimpleQueue()
        for process in team:
            free.put(process)

        def call(piece: slice) -> Result:
            process = free.get()
            try:
                process.tell(piece.start)
                return process.answer()
            finally:
                free.put(process)

        def stop() -> None:
            for process in team:
                process.kill()

        try:
            _tell_all(team, task)
            if REPLACES_MAPPED:
                folder.cleanup()  # nothing is left if this process is killed now
            yield from each_chunk(
                call, count, 1, progress=progress, what=what, threads=number, stop=stop
            )
            _tell_all(team, None)
        except BaseException:
            stop()
            raise
    with _lock:
        _idle.extend(team)


def _tell_all(team: list[_Process], task: object) -> None:
    """Tell all of a team what to call from now on, and wait until they know; None: nothing more.

    Raise `_LostError` if one cannot do that: it has ended, or does not find a module that this
    process has.
    """
    for process in team:
        process.tell(task)
    for process in team:
        try:
            process.answer()
        except Exception as error:
            raise _LostError from error


def _taken(number: int) -> list[_Process]:
    """Return processes that nobody else uses: idle ones, and new ones; or raise `_LostError`."""
    with _lock:
        team = [process for process in _idle if process.ready]
        for process in set(_idle) - set(team):
            process.kill()
        _idle[:] = team[number:]
        team = team[:number]
    try:
        while len(team) < number:
            team.append(_Process())
    except OSError as error:
        for process in team:
            process.kill()
        raise _LostError from error
    return team


@atexit.register
def end_idle() -> None:
    """End the processes that have nothing to do."""
    with _lock:
        for process in _idle:
            process.kill()
        _idle.clear()


class _Process:
    """One process, as seen from here; `OSError` if it cannot be started."""

    def __init__(self) -> None:
        away: dict[str, Any] = {"start_new_session": True}  # Ctrl-C reaches this process alone
        if sys.platform == "win32":
            flags = subprocess.CREATE_NO_WINDOW | subprocess.CREATE_NEW_PROCESS_GROUP
            away = {"creationflags": flags}
        # Imports ignore what is no string. `Path.resolve` raises on loops of links, this does not.
        path = [os.path.abspath(each) for each in sys.path if isinstance(each, str)]
        told = json.dumps([_PACKAGE, str(_FOLDER), path])
        unwritten = ["-B"] * sys.dont_write_bytecode
        # Each uses one core.
        single = {f"{library}_NUM_THREADS": "1" for library in ("OPENBLAS", "OMP", "MKL")}
        self._popen = subprocess.Popen(
            [sys.executable, "-I", "-S", *unwritten, "-c", _BEGIN, told],
            stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL,
            env={**os.environ, **single}, **away,
        )  # fmt: skip
        assert self._popen.stdin
        assert self._popen.stdout
        self._to, self._from = self._popen.stdin, self._popen.stdout
        self._used = time.monotonic()

    @property
    def ready(self) -> bool:
        """Whether it will still be there when it gets something to do."""
        return self._popen.poll() is None and time.monotonic() - self._used < IDLE / 2

    def tell(self, message: object) -> None:
        """Send a task, None for none any more, or the number of a call; see `answer`.

        Raise `_LostError` if the process has ended.
        """
        self._used = time.monotonic()
        try:
            pickle.dump(message, self._to, protocol=5)
            self._to.flush()
        except (OSError, ValueError) as error:  # ended, or killed here
            raise _LostError from error

    def answer(self) -> Any:
        """Wait for the answer to what was told; return what the work returns, or raise its error.

        Raise `_LostError` if the process has ended, or its answer means nothing here.
        """
        try:
            done, result = pickle.load(self._from)
        except Exception as error:
            raise _LostError from error
        self._used = time.monotonic()
        if not done:
            raise result
        return result

    def kill(self) -> None:
        """End it now, whatever it does."""
        self._popen.kill()
        self._popen.wait()
        for pipe in (self._to, self._from):
            with suppress(OSError):  # what was still to be told
                pipe.close()


@contextmanager
def _shared(work: object) -> Iterator[tuple[_Task, tempfile.TemporaryDirectory[str]]]:
    """Write the arrays of `work` to a file, which all processes map; yield `_Task` and its folder.

    Raise `_LostError` if the file cannot be written.
    """
    arrays: list[pickle.PickleBuffer] = []
    pickled = pickle.dumps(work, protocol=5, buffer_callback=arrays.append)
    places = []
    with ExitStack() as held:
        try:
            folder = tempfile.TemporaryDirectory(prefix="refine-", ignore_cleanup_errors=True)
            held.enter_context(folder)
            path = Path(folder.name) / "arrays"
            with path.open("wb") as stream:
                for array in arrays:
                    stream.write(bytes(-stream.tell() % _ALIGNED))
                    start = stream.tell()
                    stream.write(array.raw())
                    places.append((start, stream.tell()))
                stream.write(bytes(1))  # an empty file cannot be mapped
        except OSError as error:
            raise _LostError from error
        arrays.clear()  # copies, where what is pickled made some
        return_freed()
        yield _Task(pickled, str(path), places), folder


def _unpacked(task: _Task) -> Callable[[int], Any]:
    """Return the work that `_shared` has written."""
    with Path(task.path).open("rb") as stream:
        mapped = memoryview(mmap.mmap(stream.fileno(), 0, access=mmap.ACCESS_COPY))
    arrays = [mapped[start:end] for start, end in task.places]
    work: Callable[[int], Any] = pickle.loads(task.pickled, buffers=arrays)
    return work


def serve() -> None:
    """Do what another process asks for, until it ends or falls silent."""
    told, answers = sys.stdin.buffer, os.fdopen(os.dup(1), "wb")
    os.dup2(2, 1)  # whatever is printed is no answer
    work: Callable[[int], Any] | None = None
    while True:
        message = _next(told)
        try:
            if isinstance(message, int):
                assert work
                result = True, _called(work, message)
            else:
                work = None  # first, so that the arrays of both never are there at once
                work = _unpacked(message) if message else None
                if work is None:
                    return_freed()
                result = True, None
        except BaseException as error:
            result = False, error
        pickle.dump(result, answers, protocol=5)
        answers.flush()


def _called(work: Callable[[int], Result], number: int) -> Result:
    """Return what the work returns; as on threads, memory is kept for the next call."""
    return for_chunks(lambda _: work(number), 1, 1, threads=1)[0]


def _next(told: BinaryIO) -> Any:
    """Return the next message; end this process if none comes for long."""
    watch = threading.Timer(IDLE, os._exit, (0,))
    watch.daemon = True
    watch.start()
    try:
        return pickle.load(told)
    except EOFError:
        sys.exit()
    finally:
        watch.cancel()
