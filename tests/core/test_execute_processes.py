"""Work on threads and in processes: the same results in order, cancelled, nothing left behind."""

import os
import subprocess
import sys
import threading
import time
import types
from functools import partial
from pathlib import Path

import numpy as np
import pytest

# Of modules, not of the package: a process that runs `row` imports these too, from the same places.
from refine_addon.core import execute
from refine_addon.core.cameras.read import read_cameras
from refine_addon.core.errors import RefineError
from refine_addon.core.execute import WORTH, Cancelled, checkpoint, chunks, run, run_all
from refine_addon.core.formats.ply import read_ply
from refine_addon.core.methods import Merge, Occlusion
from refine_addon.core.prune import prune
from refine_addon.core.selection import Budget
from tests.places import ROOM

LONG = 600.0  # seconds; a tenth of it is more than any machine needs to notice
MUCH = 1e3  # seconds of work: worth processes


@pytest.fixture(autouse=True)
def _no_process_stays():
    yield
    execute.end_idle()


def row(array: np.ndarray, number: int) -> tuple[int, np.ndarray]:
    """Where this ran, and a part of an array."""
    print("what work prints is no result")
    return os.getpid(), array[number] * 2


def rows(count: int, cost: float = MUCH, threads: int = 2):
    return run(partial(row, np.zeros((count, 1))), range(count), cost=cost, threads=threads)


def where(*how) -> set[int]:
    """The processes that do the work."""
    return {pid for pid, _ in rows(4, *how)}


def slow(_number: int) -> None:
    time.sleep(LONG)


def refuse(number: int) -> int:
    if number == 2:
        raise RefineError("broken")
    return number


def end_elsewhere(here: int, number: int) -> int:
    """End the process, unless it is the one that asked for this."""
    if os.getpid() != here and number == 1:
        os._exit(1)
    return number


def gone(pid: int) -> bool:
    """Say whether a process has ended, within a minute."""
    end = time.monotonic() + 60
    while time.monotonic() < end:
        try:
            os.kill(pid, 0)
            if "\nState:\tZ" in Path(f"/proc/{pid}/status").read_text(encoding="ascii"):
                return True
        except OSError:
            return True
        time.sleep(0.05)
    return False


# On threads.


def endless(_piece: slice) -> None:
    end = time.monotonic() + LONG
    while time.monotonic() < end:
        time.sleep(0.001)
        checkpoint()


def chunked(_piece: slice) -> None:
    """Work in chunks of which nobody is told."""
    for _ in range(round(LONG)):
        run_all(lambda _: time.sleep(0.01), chunks(100, 1), threads=1)


@pytest.mark.parametrize("threads", [1, 2])
@pytest.mark.parametrize("work", [endless, chunked])
def test_work_that_takes_long_is_cancelled_within_a_chunk(work, threads):
    """The first report begins it, the second stops it; a checkpoint outside then does nothing."""
    calls, start = iter(range(100)), time.monotonic()
    with pytest.raises(Cancelled):
        run_all(work, chunks(2, 1), progress=lambda *_: next(calls) < 1, threads=threads)
    assert time.monotonic() - start < LONG / 10
    checkpoint()


@pytest.mark.parametrize("threads", [1, 2])
def test_an_error_stops_the_chunks_that_run(threads):
    """The first chunk fails while the second runs; nothing waits for the end of that one."""
    running, start = threading.Event(), time.monotonic()

    def work(piece: slice) -> None:
        if piece.start:
            running.set()
            endless(piece)
        elif threads > 1:
            running.wait()
        raise ValueError("broken")

    with pytest.raises(ValueError, match="broken"):
        run_all(work, chunks(2, 1), threads=threads)

    assert time.monotonic() - start < LONG / 10


# In processes.


@pytest.mark.slow
@pytest.mark.parametrize("order", ["C", "F"])
def test_processes_return_what_this_one_would_in_order(order, monkeypatch):
    """Eleven rows by two processes; of the path of modules imports ignore what is no string."""
    monkeypatch.setattr(sys, "path", [*sys.path, Path("/y"), "/nowhere"])
    array = np.asarray(np.random.default_rng(0).random((11, 1000)), order=order)
    pids, found = zip(*run(partial(row, array), range(11), cost=MUCH, threads=2), strict=True)
    np.testing.assert_array_equal(found, array * 2)
    assert len({*pids, os.getpid()}) == 3
    assert list(run(refuse, range(0), cost=MUCH, threads=2)) == []


@pytest.mark.slow
@pytest.mark.skipif(not Path("/proc/self/maps").exists(), reason="asks Linux what is mapped")
def test_processes_are_kept_for_the_next_work_without_that_of_the_last():
    """A tenth of the work is then worth them. Arrays of work that is done are no longer mapped."""
    execute.within(cores=2)(execute.start)(MUCH)
    first = where(WORTH / 2)
    found = rows(4, WORTH / 2)
    pid, _ = next(found)
    during = Path(f"/proc/{pid}/maps").read_text(encoding="utf-8")
    again = {pid for pid, _ in found}
    assert os.getpid() not in first
    assert {pid, *again} == first
    assert "/arrays" in during
    assert "/arrays" not in Path(f"/proc/{pid}/maps").read_text(encoding="utf-8")


@pytest.mark.slow
def test_work_stays_here_if_processes_are_not_worth_it_or_not_to_be_had(monkeypatch):
    """One core; little work; a program that is no Python; no room for a process, or on the disk."""

    def full(*_arguments: object, **_options: object) -> None:
        raise OSError(11, "Resource temporarily unavailable")

    here = {os.getpid()}
    assert where(MUCH, 1) == where(0.1, 2) == here
    for place, name, value in [
        (sys, "executable", "/opt/blender/blender"),
        (subprocess, "Popen", full),
        (execute.tempfile, "TemporaryDirectory", full),
    ]:
        with monkeypatch.context() as patched:
            patched.setattr(place, name, value)
            assert where() == here


@pytest.mark.slow
def test_work_that_processes_cannot_do_is_done_here(monkeypatch):
    """Number 1 ends every process that tries it; a module made at run time is here alone."""
    module = types.ModuleType("made_here")
    exec("def double(number): return 2 * number", vars(module))
    module.double.__module__ = "made_here"
    monkeypatch.setitem(sys.modules, "made_here", module)
    ended = run(partial(end_elsewhere, os.getpid()), range(5), cost=MUCH, threads=2)
    assert list(ended) == [0, 1, 2, 3, 4]
    assert list(run(module.double, range(4), cost=MUCH, threads=2)) == [0, 2, 4, 6]


@pytest.mark.slow
def test_what_the_work_raises_is_raised_here_and_ends_processes():
    """Numbers 0 and 1 come first; a caller may also give up the rest."""
    found = run(refuse, range(4), cost=MUCH, threads=2)
    assert [next(found), next(found)] == [0, 1]
    with pytest.raises(RefineError, match="broken"):
        next(found)
    found = rows(9)
    pid, _ = next(found)
    found.close()
    assert gone(pid)


@pytest.mark.slow
def test_cancelling_ends_processes_at_once():
    """Work that would take ten minutes, and never looks whether to go on."""
    calls, start = iter(range(100)), time.monotonic()
    with pytest.raises(Cancelled):
        list(run(slow, range(4), cost=MUCH, progress=lambda *_: next(calls) < 3, threads=2))
    assert time.monotonic() - start < LONG / 10


@pytest.mark.slow
@pytest.mark.skipif(os.name == "nt", reason="asks the system about processes by signals")
def test_a_process_that_is_killed_leaves_no_other_and_no_file(tmp_path):
    """Killed between two results, it can tell nobody and clear nothing away."""
    program = """
import os
from tests.core.test_execute_processes import rows
pid, _ = next(rows(9))
os.write(1, str(pid).encode())
os.kill(os.getpid(), 9)
"""
    said = subprocess.run(
        [sys.executable, "-c", program],
        stdout=subprocess.PIPE, env={**os.environ, "TMPDIR": str(tmp_path)}, check=False,
    )  # fmt: skip
    assert gone(int(said.stdout.split(b"\n")[-1]))
    assert not list(tmp_path.iterdir())


@pytest.mark.slow
@pytest.mark.parametrize("method", [Occlusion(), Merge()])
def test_processes_keep_the_same_splats_as_one_thread(method, monkeypatch):
    """To the bit, with every view measured in a process."""
    monkeypatch.setattr(execute, "WORTH", 0.0)
    monkeypatch.setattr(execute, "WORTH_READY", 0.0)
    splats = read_ply(ROOM / "point_cloud.ply").splats().take(np.arange(0, 39755, 20))
    views = read_cameras(ROOM / "cameras.json").spread(20)
    one, two = (prune(splats, views, Budget(ratio=0.5), method, threads=n) for n in (1, 2))
    assert len(execute._idle) == 2
    assert one.scores.values.tobytes() == two.scores.values.tobytes()
    assert one.keep.tobytes() == two.keep.tobytes()
