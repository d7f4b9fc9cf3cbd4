"""Work in this thread, on threads, in processes or on a cluster, and its progress.

NumPy's loops release Python's global lock. Where loops are short, threads wait for it: two are only
1.2 times as fast as one, two processes nearly twice. Unlike those of `ProcessPoolExecutor`, the
processes import nothing of the caller, only this package, under the name that it has here (Blender
chooses that of an extension). They end after `IDLE` seconds. Progress is divided into `stages`,
whose lengths `seconds` predicts.
"""

from __future__ import annotations

import atexit
import ctypes
import json
import math
import mmap
import os
import pickle
import subprocess
import sys
import tempfile
import threading
import time
import weakref
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager, suppress
from dataclasses import replace
from functools import partial
from itertools import pairwise
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

Progress = Callable[[float, str], "bool | None"]
"""Called as ``progress(fraction, what)``; returning ``False`` cancels."""

Item = TypeVar("Item")
Outcome = TypeVar("Outcome")

SECONDS = {
    "read": 2.5e-6,
    "closed form": 6e-9,
    "measure": 0.36e-6,
    "cast": 0.08e-6,
    "order": 0.06e-6,
    "compare": 0.15e-6,
    "merge": 11e-6,
    "refit": 0.75e-6,
    "draw": 1e-6,
    "write": 0.5e-6,
}
"""Seconds on one core for a splat, or for a splat in a view where `seconds` gets views. Measured as
processor time of runs with 40,000 to 2 million splats."""

REPLACES_MAPPED = os.name != "nt"
"""Whether the system can replace a file that is mapped into memory; Windows cannot."""

IDLE = 8.0  # seconds without work after which a process ends, to free its memory; others start fast

WORTH, WORTH_READY = 2.0, 0.2
"""Least seconds of work on one core for which processes are started, a third of a second each, and
for which ready ones are used."""

_HEAPS = -8  # M_ARENA_MAX of glibc's malloc.h
_HELD = 30_000_000  # bytes, see `run`; freeing a block above 32 MB raises no threshold of glibc
_INTERVAL = 0.1  # seconds between two reports while a piece of work takes long
_SMALL = 1 << 21  # bytes of arrays that stay in memory
_ALIGNED = 64  # bytes, of arrays in a file
_SENT = 1 << 24  # most bytes of work sent to a cluster; arrays in files are sent as names
_AHEAD = 4  # pieces of work for each thread whose results may wait for those before them
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
importlib.import_module(name + ".core.execute").serve()
"""
"""Program of a process: modules get the names they have here, and packages are empty ones."""


class _Own(threading.local):
    """Settings for the work of one thread, see `within`."""

    check: Callable[[], None] = staticmethod(lambda: None)  # what `checkpoint` calls
    cluster: Any = None  # a `Cluster` to which `run` sends long work without large arrays
    cores: int | None = None  # number that work may use, if not as many as there are


_own = _Own()
_idle: list[_Process] = []
_lock = threading.Lock()
_maps: weakref.WeakSet[mmap.mmap] = weakref.WeakSet()


class Cancelled(Exception):
    """Raised between two pieces of work when the progress callback returns ``False``."""


class _LostError(Exception):
    """A process could not be started, or ended too early."""


def silent(_fraction: float, _what: str) -> None:
    """Ignore progress: the default callback."""


def report(progress: Progress, fraction: float, what: str) -> None:
    """Call `progress`; raise `Cancelled` if it returns ``False``."""
    if progress(fraction, what) is False:
        raise Cancelled


def part(progress: Progress, start: float, end: float) -> Progress:
    """Map fractions 0..1 to `start`..`end` of `progress`."""
    return lambda fraction, what: progress(start + (end - start) * fraction, what)


def seconds(kind: str, splats: float, views: float = 1) -> float:
    """Expected seconds of a stage on one core: a constant of `SECONDS` times splats and views."""
    return SECONDS[kind] * splats * views


def stages(progress: Progress, *expected: float) -> list[Progress]:
    """Divide `progress` into consecutive stages, each with its share of the expected seconds.

    >>> first, second = stages(lambda fraction, what: print(what, fraction), 1.0, 3.0)
    >>> first(1.0, "reading"), second(0.5, "scoring")
    reading 0.25
    scoring 0.625
    (None, None)
    """
    ends = np.cumsum([0.0, *expected]) / (sum(expected) or 1.0)
    return [part(progress, *pair) for pair in pairwise(ends.tolist())]


class TimeLeft:
    """Estimate of the time that a run still takes, which rises only if it was far too low."""

    def __init__(self, clock: Callable[[], float] = time.perf_counter) -> None:
        self._clock, self._start, self._last = clock, clock(), math.inf

    def seconds(self, fraction: float) -> float | None:
        """Seconds left with this fraction done, or None: in the first 2 s, and at 0 and 1."""
        passed = self._clock() - self._start
        if passed < 2.0 or not 0.0 < fraction < 1.0:
            return None
        left = passed * (1.0 - fraction) / fraction
        if not self._last < left < 1.3 * self._last:
            self._last = left
        return self._last


def in_time(duration: float) -> str:
    """Write seconds in the unit that suits them, rounded up.

    >>> in_time(2.1), in_time(61.0), in_time(301.0)
    ('3 s', '1 min 10 s', '6 min')
    """
    if duration <= 60:
        return f"{math.ceil(duration)} s"
    if duration <= 300:
        minutes, tens = divmod(math.ceil(duration / 10.0), 6)
        return f"{minutes} min {tens}0 s" if tens else f"{minutes} min"
    hours, minutes = divmod(math.ceil(duration / 60.0), 60)
    return f"{hours} h {minutes} min" if hours else f"{minutes} min"


def checkpoint() -> None:
    """Raise `Cancelled` if `run` was cancelled; long work calls this several times a second."""
    _own.check()


@contextmanager
def within(**own: Any) -> Iterator[None]:
    """Change settings of this thread, those of `_Own` that are not None, within the block."""
    before = {name: getattr(_own, name) for name in own}
    vars(_own).update({name: value for name, value in own.items() if value is not None})
    try:
        yield
    finally:
        vars(_own).update(before)


def default_threads() -> int:
    """Cores that work of this thread may use: those of the process, at most 8, or as `within`."""
    there = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count()
    return _own.cores or min(there or 1, 8)


def mapped(stream: Any) -> mmap.mmap:
    """Map a file, read-only."""
    pages = mmap.mmap(stream.fileno(), 0, access=mmap.ACCESS_READ)
    with _lock:
        _maps.add(pages)
    return pages


def in_file(item: Any) -> Any:
    """Map a copy of an array, or of a dataclass's, from a temporary file, if large and it fits."""
    if not isinstance(item, np.ndarray):
        held = {k: in_file(v) for k, v in vars(item).items() if isinstance(v, np.ndarray)}
        return replace(item, **held)
    if item.nbytes < _SMALL:
        return item
    with suppress(OSError), tempfile.TemporaryFile(prefix="refine-") as stream:
        stream.write(np.ascontiguousarray(item).data)
        stream.flush()
        return np.frombuffer(mapped(stream), item.dtype).reshape(item.shape)
    return item


def return_freed(*, mapped_only: bool = False) -> None:
    """Return memory of mapped files, and freed memory, which only glibc does not do by itself."""
    if sys.platform == "linux":
        with _lock:
            for pages in _maps:  # what is read is mapped again
                pages.madvise(mmap.MADV_DONTNEED)
        with suppress(OSError, AttributeError):  # another C library
            if not mapped_only:
                ctypes.CDLL(None).malloc_trim(0)


def share_heap() -> None:
    """Make all threads share one heap: glibc's separate ones keep 70 of 300 MB after freeing."""
    if sys.platform == "linux":
        with suppress(OSError, AttributeError):  # another C library
            ctypes.CDLL(None).mallopt(_HEAPS, 1)


def chunks(total: int, size: int) -> list[slice]:
    """Divide ``range(total)`` into consecutive slices, all but the last of one length."""
    return [slice(start, min(start + size, total)) for start in range(0, total, size)]


def run_all(work: Callable[[Item], Outcome], items: Iterable[Item], **how: Any) -> list[Outcome]:
    """`run`, with all results at once."""
    return list(run(work, items, **how))


def run(
    work: Callable[[Item], Outcome],
    items: Iterable[Item],
    *,
    progress: Progress = silent,
    what: str = "",
    threads: int | None = None,
    cost: float = 0.0,
) -> Iterator[Outcome]:
    """Call ``work(item)`` for each item, and yield the results in order, as soon as they are there.

    Results must not depend on where work runs. NumPy ignores what underflows in it everywhere. Work
    on several `threads`, by default `default_threads`, has one core each. In processes, only used
    if `cost`, the expected seconds on one core, is above 0, changes that it makes are lost.
    ``progress(fraction, what)`` is called in this thread between items and, on threads or if work
    calls `checkpoint`, ten times a second. When it cancels, running items end at their next
    `checkpoint`, processes at once.
    """
    # Freeing one 30 MB block raises glibc's mmap threshold, so that buffers are reused instead of
    # page-faulted. No effect on other systems.
    np.empty(_HELD, np.uint8)
    todo, done, before = list(items), 0, 0
    outer = _own.check  # the work that this is a part of may be cancelled

    def tell(more: int) -> None:
        outer()
        report(progress, (before + more) / len(todo), what)

    cluster = _own.cluster
    if cost and cluster is not None and len(packed := pickle.dumps(work)) <= _SENT:
        yield from cluster.run(packed, todo, tell)
        return
    threads = min(default_threads() if threads is None else threads, max(len(todo), 1))
    if _worth(cost, threads):
        with suppress(_LostError):  # no room for a process or a file: threads need neither
            for result in _in_processes(work, todo, threads, tell):
                yield result
                done += 1
            return
        before = done
    left = todo[before:]
    if threads <= 1 or len(left) <= 1:
        yield from _in_turn(work, left, tell)
    else:
        yield from _side_by_side(work, left, threads, tell)


def _in_turn(work, items, tell):
    step, reported = max(len(items) // 100, 1), 0.0  # enough reports for a progress bar

    def check(least=_INTERVAL):
        nonlocal reported
        if time.monotonic() - reported >= least:
            reported = time.monotonic()
            tell(done)

    for done, item in enumerate(items):
        if done % step == 0:
            check(-math.inf)
        with within(check=check), np.errstate(under="ignore"):
            result = work(item)
        yield result


def _side_by_side(work, items, threads, tell, stop=lambda: None):
    """Do work on several threads; `stop` ends what no `checkpoint` does."""
    cancelled = threading.Event()

    def check():
        if cancelled.is_set():
            raise Cancelled

    def checked(item):
        with within(check=check, cores=1):
            return work(item)

    def cancel(futures):
        cancelled.set()
        for future in futures:
            future.cancel()
        stop()

    with ThreadPoolExecutor(threads) as pool:
        yield from sent_ahead(
            lambda item: pool.submit(checked, item), items, _AHEAD * threads, tell, cancel
        )


def sent_ahead(submit: Any, items: Sequence[Any], ahead: int, tell: Any, cancel: Any) -> Iterator:
    """Yield results of futures of ``submit(item)`` in order; so many items are sent `ahead`.

    ``tell(done)`` is called ten times a second. After an error ``cancel(futures)`` gets the others.
    """
    left, futures, step = deque(items), deque[Any](), max(len(items) // 100, 1)
    try:
        for done in range(len(items)):
            if done % step == 0:
                tell(done)
            while left and len(futures) < ahead:
                futures.append(submit(left.popleft()))
            ended = threading.Event()
            futures[0].add_done_callback(lambda _, ended=ended: ended.set())
            while not ended.wait(_INTERVAL):
                tell(done)
            yield futures.popleft().result()
    except BaseException:
        cancel([*futures])
        raise


def start(cost: float) -> None:
    """Start the processes that `run` will use soon for work of the same `cost`."""
    number = default_threads()
    if _worth(cost, number):
        with suppress(_LostError), _lock:
            _fill_idle(number)


def _worth(cost, number):
    """Whether work is worth `number` processes, and the program that runs here is a Python."""
    with _lock:
        least = WORTH_READY if sum(process.ready for process in _idle) >= number else WORTH
    python = Path(sys.executable or "").name.lower().startswith("python")
    return number > 1 and cost and cost >= least and python and not getattr(sys, "frozen", False)


def _in_processes(work, items, number, tell):
    """Do work in `number` processes; `_LostError` if they, or their file, cannot be had."""
    with _lost(OSError):
        folder = tempfile.TemporaryDirectory(prefix="refine-", ignore_cleanup_errors=True)
    with folder:
        task = _stored(work, Path(folder.name) / "arrays")
        with _lock:
            _fill_idle(number)
            team, _idle[:] = _idle[:number], _idle[number:]
        free = deque(team)

        def call(item):
            process = free.popleft()  # there is one for each thread
            try:
                process.tell(("call", item))
                return process.answer()
            finally:
                free.append(process)

        stop = partial(_kill, team)
        try:
            _tell_all(team, ("task", task))
            if REPLACES_MAPPED:
                folder.cleanup()  # nothing is left if this process is killed now
            yield from _side_by_side(call, items, number, tell, stop)
            _tell_all(team, ("task", None))
        except BaseException:
            stop()
            raise
    with _lock:
        _idle.extend(team)


@contextmanager
def _lost(*kinds):
    """Raise `_LostError` instead of errors of some kinds."""
    try:
        yield
    except kinds as error:
        raise _LostError from error


def _tell_all(team: list[_Process], message: tuple[str, Any]) -> None:
    """Send a message to all processes of a team, and wait for their answers."""
    for process in team:
        process.tell(message)
    for process in team:
        with _lost(Exception):  # it has ended, or cannot import a module that this process has
            process.answer()


def _fill_idle(number: int) -> None:
    """Start processes until so many have nothing to do, or raise `_LostError`; needs the lock."""
    ready = [process for process in _idle if process.ready]
    _kill(set(_idle) - set(ready))
    _idle[:] = ready
    with _lost(OSError):
        while len(_idle) < number:
            _idle.append(_Process())


def _kill(team: Iterable[_Process]) -> None:
    for process in team:
        process.kill()


@atexit.register
def end_idle() -> None:
    """End the processes that have nothing to do."""
    with _lock:
        while _idle:
            _idle.pop().kill()


class _Process:
    """One process, as seen from here; `OSError` if it cannot be started."""

    def __init__(self) -> None:
        away: dict[str, Any] = {"start_new_session": True}  # Ctrl-C reaches this process alone
        if sys.platform == "win32":
            flags = subprocess.CREATE_NO_WINDOW | subprocess.CREATE_NEW_PROCESS_GROUP
            away = {"creationflags": flags}
        # Imports ignore what is no string. `abspath`, unlike `Path.resolve`, takes loops of links.
        path = [os.path.abspath(each) for each in sys.path if isinstance(each, str)]
        unwritten = ["-B"] * sys.dont_write_bytecode
        # Each uses one core.
        single = {f"{library}_NUM_THREADS": "1" for library in ("OPENBLAS", "OMP", "MKL")}
        self._popen: Any = subprocess.Popen(
            [sys.executable, "-I", "-S", *unwritten, "-c", _BEGIN,
             json.dumps([_PACKAGE, str(_FOLDER), path])],
            stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL,
            env={**os.environ, **single}, **away,
        )  # fmt: skip
        self._used = time.monotonic()

    @property
    def ready(self) -> bool:
        """Whether it will still be there when it gets something to do."""
        return self._popen.poll() is None and time.monotonic() - self._used < IDLE / 2

    def tell(self, message: tuple[str, Any]) -> None:
        """Send a task or an item; `_LostError` if the process has ended."""
        self._used = time.monotonic()
        with _lost(OSError, ValueError):  # ended, or killed here
            pickle.dump(message, self._popen.stdin, protocol=5)
            self._popen.stdin.flush()

    def answer(self) -> Any:
        """Result of the work; raises its error, or `_LostError` if the process ended."""
        with _lost(Exception):
            done, result = pickle.load(self._popen.stdout)
        self._used = time.monotonic()
        if not done:
            raise result
        return result

    def kill(self) -> None:
        with suppress(OSError), self._popen:  # closes pipes, with messages in them, and waits
            self._popen.kill()


def _stored(work, path):
    """Arguments of `_unpacked` for some work; its arrays go to a file that all processes map."""
    arrays: list[pickle.PickleBuffer] = []
    pickled = pickle.dumps(work, protocol=5, buffer_callback=arrays.append)
    places = []
    with _lost(OSError), path.open("wb") as stream:
        for array in arrays:
            stream.write(bytes(-stream.tell() % _ALIGNED))
            begin = stream.tell()
            stream.write(array.raw())
            places.append((begin, stream.tell()))
        stream.write(bytes(1))  # an empty file cannot be mapped
    arrays.clear()  # which may be copies
    return_freed()
    return pickled, str(path), places


def _unpacked(pickled, path, places):
    """The work that `_stored` has written."""
    with Path(path).open("rb") as stream:
        pages = memoryview(mapped(stream))
    return pickle.loads(pickled, buffers=[pages[begin:end] for begin, end in places])


def serve() -> None:
    """Answer requests of another process, until it ends or sends none for `IDLE` seconds."""
    requests, answers = sys.stdin.buffer, os.fdopen(os.dup(1), "wb")
    os.dup2(2, 1)  # so that nothing printed gets among the answers
    work: Any = None
    _own.cores = 1
    while True:
        watch = threading.Timer(IDLE, os._exit, (0,))
        watch.daemon = True
        watch.start()
        try:
            kind, message = pickle.load(requests)
        except EOFError:
            sys.exit()
        finally:
            watch.cancel()
        try:
            if kind == "call":
                result = True, run_all(work, [message])[0]
            else:
                work = None  # first, so that only the arrays of one task are in memory
                return_freed()
                work = _unpacked(*message) if message else None
                result = True, None
        except BaseException as error:  # raised again in the other process
            result = False, error
        pickle.dump(result, answers, protocol=5)
        answers.flush()
