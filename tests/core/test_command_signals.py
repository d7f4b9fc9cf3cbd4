"""The command where it is told to stop: Ctrl-C, a polite kill, a closed terminal."""

from __future__ import annotations

import itertools
import os
import signal
import subprocess
import sys
import threading
import time
import tomllib
from importlib import metadata
from pathlib import Path

import pytest

from refine_addon import command
from refine_addon.command import flow

ROOT = Path(__file__).parents[2]
ROOM = ROOT / "tests/data/room_small"

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(os.name != "posix", reason="needs signals"),
]

CAMERAS = ["--cameras", str(ROOM / "cameras.json")]
# Some seconds of work, so that it is never done before a signal comes.
LONG = ["prune", str(ROOM / "point_cloud.ply"), *CAMERAS, "-o", "out.ply", "--method", "occlusion"]
CANCELLED = b"refine: error: cancelled; nothing was left half-written\n"


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """Stand in an empty folder."""
    monkeypatch.chdir(tmp_path)
    return tmp_path


def start(
    *words: str, ignored: tuple[int, ...] = (), stderr: int = subprocess.PIPE
) -> subprocess.Popen[bytes]:
    """Start Python on this checkout, as from a terminal, less the signals that are ignored."""

    def listen() -> None:
        # Whoever runs the tests in the background has Ctrl-C ignored, and programs inherit that.
        for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
            signal.signal(number, signal.SIG_IGN if number in ignored else signal.SIG_DFL)

    return subprocess.Popen(
        [sys.executable, *words],
        env={**os.environ, "PYTHONPATH": str(ROOT)},
        stdout=subprocess.PIPE,
        stderr=stderr,
        preexec_fn=listen,  # noqa: PLW1509 - this process has no other thread
    )


SCRIPT = """
import sys
from refine_addon.__main__ import main
print("here", flush=True)
sys.exit(main())
"""


def test_ctrl_c_at_any_moment_of_the_start_is_code_130_and_one_line(folder):
    """From the script's first line on, by the clock: imports, parsing, reading, scoring.

    An idle machine takes about 0.3 s to load NumPy and the rest, a busy one 1 s.
    """
    for delay in (0.0, 0.002, 0.01, 0.03, 0.1, 0.2, 0.3, 0.6):
        with start("-c", SCRIPT, *LONG) as process:
            assert process.stdout.readline() == b"here\n"
            time.sleep(delay)
            process.send_signal(signal.SIGINT)
            said = process.communicate(timeout=30)

        assert (process.returncode, *said) == (130, b"", CANCELLED), delay
    assert list(folder.iterdir()) == []


COUNTED = """
import os, runpy, signal, sys

moment, imports = int(sys.argv.pop(1)), 0

def count(event, arguments):
    global imports
    if event == "import" and (imports or arguments[0] == "refine_addon.command"):
        imports += 1
        if imports == moment:
            os.kill(os.getpid(), signal.SIGINT)

sys.addaudithook(count)
runpy.run_module("refine_addon", run_name="__main__", alter_sys=True)
"""


@pytest.mark.usefixtures("folder")
def test_ctrl_c_at_any_import_is_code_130_and_one_line():
    """A real SIGINT as the n-th module is looked up, of the some 300 that the command loads.

    Some of NumPy's are among them, which says of an exception there that NumPy is broken.
    """
    for moment in (1, 2, 4, 10, 30, 60, 120, 200):
        with start("-c", COUNTED, str(moment), *LONG) as process:
            said = process.communicate(timeout=30)

        assert (process.returncode, *said) == (130, b"", CANCELLED), moment


AMID_NUMPY = """
import os, runpy, signal, sys

def stop(event, arguments):
    if event == "import" and arguments[0] == "datetime" and "numpy" in sys.modules:
        os.kill(os.getpid(), signal.SIGINT)

sys.addaudithook(stop)
runpy.run_module("refine_addon", run_name="__main__", alter_sys=True)
"""


@pytest.mark.usefixtures("folder")
def test_ctrl_c_amid_the_import_of_numpy_is_code_130_and_one_line():
    """NumPy's compiled part imports datetime, and turns what is raised there into an ImportError.

    That would end in a traceback that says not to import NumPy from its source directory.
    """
    with start("-c", AMID_NUMPY, *LONG) as process:
        said = process.communicate(timeout=30)

    assert (process.returncode, *said) == (130, b"", CANCELLED)


def test_nothing_loads_numpy_before_signals_are_listened_to():
    """Whoever imports the command has no NumPy yet: `main` loads it within its `Listener`."""
    check = "import sys, refine_addon.command; sys.exit('numpy' in sys.modules)"

    with start("-c", check) as process:
        process.communicate(timeout=30)

    assert process.returncode == 0


def test_the_installed_script_is_what_python_runs():
    """`refine` of pyproject.toml is the function that ``python -m refine_addon`` calls."""
    scripts = tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))["project"]["scripts"]
    entry = metadata.EntryPoint("refine", scripts["refine"], "console_scripts")

    with start("-c", SCRIPT, "--version") as process:
        printed, _ = process.communicate(timeout=30)

    assert entry.value == "refine_addon.__main__:main"
    assert callable(entry.load())
    assert printed.startswith(b"here\nrefine ")


STOPPED = """
import sys, time
from pathlib import Path
from refine_addon import command
from refine_addon.core.formats import ply

write, unlink = ply.write_rows, Path.unlink

def slow(stream, *arguments):
    write(stream, *arguments)
    stream.flush()
    print("halfway", flush=True)
    time.sleep(60)

def slow_unlink(path, **options):
    print("cleaning", flush=True)
    time.sleep(0.5)
    unlink(path, **options)

ply.write_rows, Path.unlink = slow, slow_unlink
sys.exit(command.main(sys.argv[1:]))
"""
WRITE = ["prune", str(ROOM / "point_cloud.ply"), *CAMERAS, "-o", "out.ply", "--views", "4"]


@pytest.fixture
def halfway(folder):  # noqa: ARG001
    """Return a function that starts a run and waits until rows are in its temporary file."""

    def begin(*words, **options):
        process = start("-c", STOPPED, *WRITE, *words, **options)
        assert process.stdout.readline() == b"halfway\n"
        return process

    return begin


@pytest.mark.parametrize("overwrite", [False, True])
@pytest.mark.parametrize(
    ("number", "reason"),
    [
        (signal.SIGINT, "cancelled"),
        (signal.SIGTERM, "terminated"),
        (getattr(signal, "SIGHUP", 0), "hung up"),
    ],
)
def test_stopped_in_the_middle_of_a_write_it_leaves_what_was_there(
    folder, halfway, number, reason, overwrite
):
    """Code 128 + n as a shell has it: 130, 143, 129; no temporary file, one line."""
    if overwrite:
        (folder / "out.ply").write_bytes(b"old")
    with halfway(*(["--overwrite"] if overwrite else [])) as process:
        process.send_signal(number)
        _, errors = process.communicate(timeout=30)

    assert process.returncode == 128 + number
    assert errors.decode() == f"refine: error: {reason}; nothing was left half-written\n"
    if overwrite:
        assert (folder / "out.ply").read_bytes() == b"old"
    assert [path.name for path in folder.iterdir()] == ["out.ply"] * overwrite


def read_to_the_end(terminal):
    """Yield what was written to a pseudo-terminal, which gives some 4 kB at a time."""
    try:
        while some := os.read(terminal, 1 << 16):
            yield some
    except OSError:  # Linux's way to say that nothing more can come
        return


def test_ctrl_c_wipes_away_the_progress_before_it_says_so(halfway):
    """On a pseudo-terminal: the last line drawn is the error, and the error alone."""
    pty = pytest.importorskip("pty")
    ours, theirs = pty.openpty()
    with halfway(stderr=theirs) as process:
        process.send_signal(signal.SIGINT)
        process.communicate(timeout=30)
    os.close(theirs)
    drawn = b"".join(read_to_the_end(ours))
    os.close(ours)

    assert drawn.split(b"\r\x1b[K")[-1] == CANCELLED.replace(b"\n", b"\r\n")


def test_a_second_ctrl_c_does_not_stop_the_cleaning_up(folder, halfway):
    """Somebody who holds the keys down: the first is heeded, the others change nothing."""
    with halfway() as process:
        process.send_signal(signal.SIGINT)
        assert process.stdout.readline() == b"cleaning\n"
        process.send_signal(signal.SIGINT)
        process.send_signal(signal.SIGTERM)
        _, errors = process.communicate(timeout=30)

    assert (process.returncode, errors) == (130, CANCELLED)
    assert list(folder.iterdir()) == []


def test_a_signal_that_is_ignored_stays_ignored(folder, halfway):
    """``nohup`` ignores the closed terminal, and means it; Ctrl-C ends the run after all."""
    with halfway(ignored=(signal.SIGHUP,)) as process:
        process.send_signal(signal.SIGHUP)
        time.sleep(0.2)
        assert process.poll() is None
        process.send_signal(signal.SIGINT)
        _, errors = process.communicate(timeout=30)

    assert (process.returncode, errors) == (130, CANCELLED)
    assert list(folder.iterdir()) == []


AT_ONCE = """
import ctypes, os, sys
from refine_addon import command
from refine_addon.command import flow

def run(*_, **__):
    # One call of C for both: Python looks for signals only when it is over.
    list(map(ctypes.PyDLL(None).kill, [os.getpid()] * 2, map(int, sys.argv[1:])))

flow.run = run
sys.exit(command.main([], last=True))
"""


@pytest.mark.usefixtures("folder")
def test_of_two_signals_at_once_the_first_says_the_code():
    """Python calls handlers by the signals' numbers: 1, 2, 15, whichever came first."""
    numbers = (signal.SIGHUP, signal.SIGINT, signal.SIGTERM)
    for first, second in itertools.permutations(numbers, 2):
        with start("-c", AT_ONCE, str(int(first)), str(int(second))) as process:
            _, errors = process.communicate(timeout=30)

        assert process.returncode == 128 + first, (first, second)
        assert errors.count(b"nothing was left half-written\n") == 1


LEAVING = """
import atexit, sys, time
from refine_addon.__main__ import main

def leave():
    print("leaving", flush=True)
    time.sleep(0.5)

atexit.register(leave)
sys.exit(main())
"""


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, getattr(signal, "SIGHUP", 0)])
def test_a_signal_while_python_tidies_up_comes_too_late(folder, number):
    """All is written and said: the code is 0."""
    with start("-c", LEAVING, *WRITE, "--quiet") as process:
        assert process.stdout.readline() == b"leaving\n"
        process.send_signal(number)
        said = process.communicate(timeout=30)

    assert (process.returncode, *said) == (0, b"", b"")
    assert [path.name for path in folder.iterdir()] == ["out.ply"]


def handlers() -> list[object]:
    """Return who listens."""
    return [signal.getsignal(n) for n in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)]


@pytest.fixture
def _none_ignored():
    """Ignore no signal: ``nohup make test`` does, and what is ignored is not listened to."""
    before = {n: signal.signal(n, signal.SIG_DFL) for n in (signal.SIGTERM, signal.SIGHUP)}
    before[signal.SIGINT] = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    for number, handler in before.items():
        signal.signal(number, handler)


@pytest.mark.usefixtures("_none_ignored")
@pytest.mark.parametrize("outcome", [0, KeyboardInterrupt(), ValueError("a fault of ours")])
def test_whoever_listened_before_listens_afterwards(monkeypatch, outcome):
    """Blender and the tests call the command among other things; a fault passes through."""
    before, during = handlers(), []

    def run(*_, **__):
        during.extend(handlers())
        if isinstance(outcome, BaseException):
            raise outcome
        return outcome

    monkeypatch.setattr(flow, "run", run)

    if isinstance(outcome, ValueError):
        with pytest.raises(ValueError, match="a fault of ours"):
            command.main([])
    else:
        assert command.main([]) == (130 if outcome else 0)

    assert handlers() == before
    assert all(now != then for now, then in zip(during, before, strict=True))


def test_the_command_runs_on_a_thread_where_signals_cannot_be_listened_to(capsys):
    """Python refuses handlers there; the work does not need them."""
    codes = []
    thread = threading.Thread(target=lambda: codes.append(command.main(["--version"])))
    thread.start()
    thread.join()

    assert codes == [0]
    assert capsys.readouterr().out.startswith("refine ")
