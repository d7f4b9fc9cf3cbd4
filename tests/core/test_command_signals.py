"""The command where it is told to stop: Ctrl-C, a polite kill, a closed terminal."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import threading
from pathlib import Path

import numpy as np
import pytest

from refine_addon import command
from refine_addon.command import subcommands
from refine_addon.core import read_ply

from .test_command_files import read_all

ROOT = Path(__file__).parents[2]
ROOM = ROOT / "tests/data/room_small"

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(os.name != "posix", reason="needs signals"),
]

PRUNE = ["prune", "in.ply", "--cameras", str(ROOM / "cameras.json"), "-o", "out.ply"]
PRUNE += ["--method", "closed-form"]
SECONDS = 120
"""Nothing here takes a hundredth of it, unless a signal was lost."""
CANCELLED = b"refine: error: cancelled; nothing was left half-written\n"


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """Stand in a folder with every hundredth splat of the room."""
    monkeypatch.chdir(tmp_path)
    file = read_ply(ROOM / "point_cloud.ply")
    file.write(tmp_path / "in.ply", np.arange(len(file)) % 100 == 0)
    return tmp_path


def outputs(folder):
    return sorted(path.name for path in folder.iterdir() if path.name != "in.ply")


def start(*words, ignored=(), stderr=subprocess.PIPE, stdin=subprocess.DEVNULL):
    """Start Python on this checkout, as from a terminal, less the signals that are ignored."""

    def listen():
        # Whoever runs the tests in the background has Ctrl-C ignored, and programs inherit that.
        for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
            signal.signal(number, signal.SIG_IGN if number in ignored else signal.SIG_DFL)

    return subprocess.Popen(
        [sys.executable, *words],
        env={**os.environ, "PYTHONPATH": str(ROOT)},
        stdin=stdin,
        stdout=subprocess.PIPE,
        stderr=stderr,
        preexec_fn=listen,
    )


def ended(*words):
    """Run to the end; return the code, what was printed, and the errors."""
    with start(*words) as process:
        said = process.communicate(timeout=SECONDS)
    return process.returncode, *said


CALLED = """
import os, signal, sys
from refine_addon.__main__ import main

moment, calls = sys.argv.pop(1), 0

def count(frame, event, argument):
    global calls
    calls += event == "call"
    if moment in (str(calls), frame.f_code.co_name) and event == "call":
        sys.setprofile(None)
        os.kill(os.getpid(), signal.SIGINT)

sys.setprofile(count)
sys.exit(main())
"""


@pytest.mark.parametrize(
    "moment", ["3", "3000", "30000", "parse_args", "read_cameras", "score", "select"]
)
def test_ctrl_c_at_any_moment_is_code_130_and_one_line(folder, moment):
    """A real SIGINT at the n-th call of a function of Python, or the first of a name.

    The imports are some 90,000 calls; parsing, reading and scoring follow.
    """
    assert ended("-c", CALLED, moment, *PRUNE) == (130, b"", CANCELLED)
    assert outputs(folder) == []


def test_ctrl_c_while_refitting_writes_what_that_has_reached_but_in_a_dry_run(folder):
    """As many splats as asked for, in a whole file; the command ends all the same.

    The signal comes in the first round: kept splats have merged by then.
    """
    words = ["-c", CALLED, "_solve", *PRUNE[:6], "--method", "refit", "--views", "8"]

    code, _, told = ended(*words, "--dry-run")
    assert code == 130
    assert b"written with" not in told
    assert outputs(folder) == []

    told = b"refine: error: cancelled; refitting was stopped before its first round was done; "
    told += b"out.ply is written with what that had reached; nothing was left half-written\n"
    assert ended(*words, "--keep", "100") == (130, b"", told)
    assert outputs(folder) == ["out.ply"]
    assert len(read_ply(folder / "out.ply")) == 100


IMPORTED = """
import os, runpy, signal, sys

moment, imports = sys.argv.pop(1), 0

def count(event, arguments):
    global imports
    if event == "import" and (imports or arguments[0] == "refine_addon.command"):
        imports += 1
        if str(imports) == moment or arguments[0] == moment and "numpy" in sys.modules:
            os.kill(os.getpid(), signal.SIGINT)

sys.addaudithook(count)
runpy.run_module("refine_addon", run_name="__main__", alter_sys=True)
"""


@pytest.mark.parametrize("moment", ["1", "30", "200", "datetime"])
@pytest.mark.usefixtures("folder")
def test_ctrl_c_at_any_import_is_code_130_and_one_line(moment):
    """A real SIGINT as the n-th module is looked up, of the some 300 that the command loads.

    Some of NumPy's are among them, which says of an exception there that NumPy is broken: its
    compiled part imports datetime, and turns what is raised there into an ImportError.
    """
    assert ended("-c", IMPORTED, moment, *PRUNE) == (130, b"", CANCELLED)


def test_nothing_loads_numpy_before_signals_are_listened_to():
    """Whoever imports the command has no NumPy yet: `main` loads it within `listening`."""
    check = "import sys, refine_addon.command; sys.exit('numpy' in sys.modules)"

    assert ended("-c", check)[0] == 0


STOPPED = """
import sys, time
from pathlib import Path
from refine_addon import command
from refine_addon.core.formats import ply

write, unlink = ply.write_rows, Path.unlink

def slow(stream, *arguments, **options):
    write(stream, *arguments, **options)
    stream.flush()
    print("halfway", flush=True)
    time.sleep(60)

def slow_unlink(path, **options):
    print("cleaning", flush=True)
    sys.stdin.readline()
    unlink(path, **options)

ply.write_rows, Path.unlink = slow, slow_unlink
sys.exit(command.main(sys.argv[1:]))
"""


def halfway(*words, **options):
    """Start a run and wait until rows are in its temporary file."""
    process = start("-c", STOPPED, *PRUNE, *words, **options)
    assert process.stdout.readline() == b"halfway\n"
    return process


@pytest.mark.parametrize(
    ("sent", "ignored", "reason", "before"),
    [
        (["SIGINT"], [], b"cancelled", b""),
        (["SIGTERM"], [], b"terminated", b"old"),
        (["SIGHUP"], [], b"hung up", b"old"),
        (["SIGHUP", "SIGINT"], ["SIGHUP"], b"cancelled", b""),
    ],
)
def test_stopped_in_the_middle_of_a_write_it_leaves_what_was_there(
    folder, sent, ignored, reason, before
):
    """Code 128 + n as a shell has it: 130, 143, 129; no temporary file, one line.

    Signals that come while it cleans up change nothing: somebody holds the keys down. ``nohup``
    ignores the closed terminal, and means it; Ctrl-C ends the run after all.
    """
    numbers = [getattr(signal, name) for name in sent]
    if before:
        (folder / "out.ply").write_bytes(before)
    shut = tuple(getattr(signal, name) for name in ignored)
    with halfway(*["--overwrite"] * bool(before), ignored=shut, stdin=subprocess.PIPE) as process:
        for number in numbers:
            process.send_signal(number)
        assert process.stdout.readline() == b"cleaning\n"
        process.send_signal(signal.SIGINT)
        process.send_signal(signal.SIGTERM)
        _, errors = process.communicate(b"\n", timeout=SECONDS)

    assert process.returncode == 128 + numbers[-1]
    assert errors == CANCELLED.replace(b"cancelled", reason)
    assert outputs(folder) == (["out.ply"] if before else [])
    assert not before or (folder / "out.ply").read_bytes() == before


@pytest.mark.usefixtures("folder")
def test_ctrl_c_wipes_away_the_progress_before_it_says_so():
    """On a pseudo-terminal: the last line drawn is the error, and the error alone."""
    pty = pytest.importorskip("pty")
    ours, theirs = pty.openpty()
    with halfway(stderr=theirs) as process:
        process.send_signal(signal.SIGINT)
        process.communicate(timeout=SECONDS)
    os.close(theirs)

    assert read_all(ours).split(b"\r\x1b[K")[-1] == CANCELLED.replace(b"\n", b"\r\n")


LEAVING = """
import atexit, sys
from refine_addon.__main__ import main

def leave():
    print("leaving", flush=True)
    sys.stdin.readline()

atexit.register(leave)
sys.exit(main())
"""


def test_a_signal_while_python_tidies_up_comes_too_late(folder):
    """All is written and said: the code is 0."""
    with start("-c", LEAVING, *PRUNE, "--quiet", stdin=subprocess.PIPE) as process:
        assert process.stdout.readline() == b"leaving\n"
        process.send_signal(signal.SIGINT)
        said = process.communicate(b"\n", timeout=SECONDS)

    assert (process.returncode, *said) == (0, b"", b"")
    assert outputs(folder) == ["out.ply"]


@pytest.mark.parametrize("outcome", [0, KeyboardInterrupt(), ValueError("a fault of ours")])
def test_whoever_listened_before_listens_afterwards(monkeypatch, outcome):
    """Blender and the tests call the command among other things; a fault passes through.

    What is ignored is not listened to, as under ``nohup make test``, so nothing is here.
    """
    numbers = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
    heard, during = [lambda *_: None for _ in numbers], []
    before = [signal.signal(n, handler) for n, handler in zip(numbers, heard, strict=True)]

    def run(*_, **__):
        during.extend(map(signal.getsignal, numbers))
        if isinstance(outcome, BaseException):
            raise outcome
        return outcome

    monkeypatch.setattr(subcommands, "run", run)
    try:
        if isinstance(outcome, ValueError):
            with pytest.raises(ValueError, match="a fault of ours"):
                command.main([])
        else:
            assert command.main([]) == (130 if outcome else 0)
        assert [signal.getsignal(n) for n in numbers] == heard
        assert not set(during) & set(heard)
        assert len(during) == 3
    finally:
        for number, handler in zip(numbers, before, strict=True):
            signal.signal(number, handler)


def test_the_command_runs_on_a_thread_where_signals_cannot_be_listened_to(capsys):
    """Python refuses handlers there; the work does not need them."""
    codes = []
    thread = threading.Thread(target=lambda: codes.append(command.main(["--version"])))
    thread.start()
    thread.join()

    assert codes == [0]
    assert capsys.readouterr().out.startswith("refine ")
