"""Work in processes of their own: the same results in order, and nothing left behind."""

from __future__ import annotations

import os
import platform
import subprocess
import sys
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
from refine_addon.core.execute import Cancelled, run
from refine_addon.core.formats.ply import read_ply
from refine_addon.core.methods import Merge, Occlusion
from refine_addon.core.prune import prune
from refine_addon.core.selection import Budget

pytestmark = pytest.mark.slow

ROOM = Path(__file__).parents[1] / "data/room_small"
LONG = 600.0  # seconds; a tenth of it is more than any machine needs to notice
MUCH = 1e3  # seconds of work: worth processes


@pytest.fixture(autouse=True)
def _no_process_stays():
    yield
    execute.end_idle()


def row(array: np.ndarray, number: int) -> tuple[int, np.ndarray]:
    """Return where this ran, and a part of an array."""
    print("what work prints is no result")
    return os.getpid(), array[number] * 2


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


def memory_of(pid: int) -> int:
    """Return how much memory a process has that is no file's, bytes."""
    status = Path(f"/proc/{pid}/status").read_text(encoding="ascii")
    return 1024 * int(status.split("RssAnon:")[1].split()[0])


def filled(_number: int) -> tuple[int, int]:
    """Fill five arrays of 8 MB; return which process did, and what it takes then."""
    arrays = [np.ones(1 << 20) for _ in range(5)]
    took = memory_of(os.getpid())
    del arrays
    return os.getpid(), took


def gone(pid: int) -> bool:
    """Return whether a process has ended, within a minute."""
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


@pytest.mark.parametrize("order", ["C", "F"])
def test_processes_return_what_this_one_would_in_order(order):
    """Eleven rows by two processes: each row is doubled, and none was doubled here."""
    array = np.asarray(np.random.default_rng(0).random((11, 1000)), order=order)

    where, rows = zip(*run(partial(row, array), range(11), cost=MUCH, threads=2), strict=True)

    np.testing.assert_array_equal(rows, array * 2)
    assert len(set(where)) == 2
    assert os.getpid() not in where


def test_processes_are_kept_for_the_next_work():
    """Once they are there, a tenth of the work is worth them too."""
    array = np.zeros((4, 1))

    first = {pid for pid, _ in run(partial(row, array), range(4), cost=MUCH, threads=2)}
    again = {
        pid for pid, _ in run(partial(row, array), range(4), cost=execute.WORTH / 2, threads=2)
    }

    assert again == first


@pytest.mark.skipif(not Path("/proc/self/maps").exists(), reason="asks Linux what is mapped")
def test_processes_forget_the_work_when_it_is_done():
    """The arrays are no longer mapped, so they take neither memory nor disk."""
    found = run(partial(row, np.zeros((4, 1))), range(4), cost=MUCH, threads=2)
    pid, _ = next(found)
    maps = Path(f"/proc/{pid}/maps")
    assert "/arrays" in maps.read_text(encoding="utf-8")

    list(found)

    assert "/arrays" not in maps.read_text(encoding="utf-8")


@pytest.mark.skipif(
    platform.libc_ver()[0] != "glibc" or not Path("/proc/self/status").exists(),
    reason="what other C libraries keep is not known",
)
def test_idle_processes_return_the_memory_that_their_work_took():
    """Of 40 MB that glibc would keep for the next call, less than a quarter is left."""
    took = dict(run(filled, range(8), cost=MUCH, threads=2))

    for pid, before in took.items():
        assert memory_of(pid) < before - 30_000_000


def test_processes_that_were_started_ahead_do_the_work():
    """They are there, so little work is worth them too."""
    execute.start(MUCH, 2)

    found = run(partial(row, np.zeros((4, 1))), range(4), cost=execute.WORTH / 2, threads=2)

    assert os.getpid() not in {pid for pid, _ in found}


@pytest.mark.parametrize(
    ("seconds", "threads", "python"),
    [(MUCH, 1, sys.executable), (0.1, 2, sys.executable), (MUCH, 2, "/opt/blender/blender")],
)
def test_work_stays_here_if_processes_are_not_worth_it_or_not_to_be_had(
    seconds, threads, python, monkeypatch
):
    """One core; little work; and a program that is no Python, so starting it again is no way."""
    monkeypatch.setattr(sys, "executable", python)

    found = run(partial(row, np.zeros((4, 1))), range(4), cost=seconds, threads=threads)

    assert {pid for pid, _ in found} == {os.getpid()}


def test_where_no_process_can_be_started_threads_do_the_work(monkeypatch):
    """As on a system that has no more room for one."""

    def full(*_arguments: object, **_options: object) -> None:
        raise OSError(11, "Resource temporarily unavailable")

    monkeypatch.setattr(subprocess, "Popen", full)

    assert list(run(refuse, range(2), cost=MUCH, threads=2)) == [0, 1]


def test_where_the_file_has_no_room_threads_do_the_work(monkeypatch):
    """As on a full disk."""

    def full(*_arguments: object, **_options: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(execute.tempfile, "TemporaryDirectory", full)

    assert list(run(refuse, range(2), cost=MUCH, threads=2)) == [0, 1]


def test_the_work_of_a_process_that_was_killed_is_done_here():
    """Number 1 ends every process that tries it; the results are complete all the same."""
    assert list(run(partial(end_elsewhere, os.getpid()), range(5), cost=MUCH, threads=2)) == [
        *range(5)
    ]


def test_what_the_work_raises_is_raised_here():
    """Numbers 0 and 1 come first, as in this thread; then the error with its words."""
    found = run(refuse, range(4), cost=MUCH, threads=2)

    assert [next(found), next(found)] == [0, 1]
    with pytest.raises(RefineError, match="broken"):
        next(found)


def test_cancelling_ends_processes_at_once():
    """Work that would take ten minutes, and never looks whether to go on."""
    calls = iter(range(100))
    start = time.monotonic()

    with pytest.raises(Cancelled):
        list(
            run(
                slow,
                range(4),
                cost=MUCH,
                progress=lambda _fraction, _what: next(calls) < 3,
                threads=2,
            )
        )

    assert time.monotonic() - start < LONG / 10


def test_results_that_nobody_fetches_leave_no_process():
    """A caller that fails between two results gives up the rest."""
    found = run(partial(row, np.zeros((9, 1))), range(9), cost=MUCH, threads=2)
    pid, _ = next(found)

    found.close()

    assert gone(pid)


@pytest.mark.skipif(os.name == "nt", reason="asks the system about processes by signals")
def test_a_process_that_is_killed_leaves_no_other_and_no_file(tmp_path):
    """Killed between two results, it can tell nobody and clear nothing away."""
    program = """
import os
from functools import partial
import numpy as np
from refine_addon.core.execute import run
from tests.core.test_execute_processes import MUCH, row
pid, _ = next(run(partial(row, np.zeros((9, 1))), range(9), cost=MUCH, threads=2))
os.write(1, str(pid).encode())
os.kill(os.getpid(), 9)
"""
    said = subprocess.run(
        [sys.executable, "-c", program],
        stdout=subprocess.PIPE, env={**os.environ, "TMPDIR": str(tmp_path)}, check=False,
    )  # fmt: skip

    assert gone(int(said.stdout.split(b"\n")[-1]))
    assert not list(tmp_path.iterdir())


def test_odd_entries_of_the_path_of_modules_do_not_matter(monkeypatch):
    """Imports ignore what is no string, and folders that are not there."""
    monkeypatch.setattr(sys, "path", [*sys.path, 5, b"/x", Path("/y"), "/nowhere"])

    found = run(partial(row, np.zeros((4, 1))), range(4), cost=MUCH, threads=2)

    assert os.getpid() not in {pid for pid, _ in found}


def test_work_that_no_other_process_can_load_is_done_here(monkeypatch):
    """A module that only this process has, as one that is made while it runs."""
    module = types.ModuleType("made_here")
    exec("def double(number): return 2 * number", vars(module))
    module.double.__module__ = "made_here"
    monkeypatch.setitem(sys.modules, "made_here", module)

    assert list(run(module.double, range(4), cost=MUCH, threads=2)) == [0, 2, 4, 6]


def test_no_work_has_no_results():
    """As in a scoring of which every block is known already."""
    assert list(run(refuse, range(0), cost=MUCH, threads=2)) == []


def test_an_addon_under_another_name_finds_itself():
    """Blender imports extensions as parts of ``bl_ext``; there is no such package to import."""
    program = f"""
import sys, types, importlib
for name in ("bl_ext", "bl_ext.user_default"):
    sys.modules[name] = types.ModuleType(name)
    sys.modules[name].__path__ = []
name = "bl_ext.user_default.refine"
package = sys.modules[name] = types.ModuleType(name)
package.__path__ = [{str(Path(execute.__file__).parents[1])!r}]
processes = importlib.import_module(name + ".core.execute")
Budget = importlib.import_module(name + ".core.selection").Budget
number_of = importlib.import_module(name + ".core.report").size_in_words
print(*processes.run(number_of, range(3), cost={MUCH}, threads=2), sep=";")
print(len(processes._idle))
"""
    said = subprocess.run([sys.executable, "-c", program], capture_output=True, check=True)

    assert said.stdout.split(b"\n")[1].strip() == b"2"
    assert said.stdout.startswith(b"0")


@pytest.mark.parametrize("method", [Occlusion(), Merge()])
def test_processes_keep_the_same_splats_as_one_thread(method, monkeypatch):
    """To the bit, with every view measured in a process however little work it is."""
    monkeypatch.setattr(execute, "WORTH", 0.0)
    monkeypatch.setattr(execute, "WORTH_READY", 0.0)
    splats = read_ply(ROOM / "point_cloud.ply").splats().take(np.arange(0, 39755, 20))
    views = read_cameras(ROOM / "cameras.json").spread(20)

    one, two = (
        prune(splats, views, Budget(ratio=0.5), method, threads=threads) for threads in (1, 2)
    )

    assert len(execute._idle) == 2
    assert one.scores.values.tobytes() == two.scores.values.tobytes()
    assert one.keep.tobytes() == two.keep.tobytes()
