"""The command where it is told to stop: Ctrl-C, a polite kill, a closed terminal."""

import os
import signal
import subprocess
import sys
import threading

import pytest

from refine_addon import command
from refine_addon.command import subcommands
from refine_addon.core import read_ply

from .test_command import MADE, ROOT, folder, names  # noqa: F401 - a fixture
from .test_command_files import read_all

pytestmark = pytest.mark.slow

SIGINT, SIGTERM, SIGHUP = SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
PRUNE = [*MADE, "--method", "closed-form"]
SECONDS = 120  # a hundredth is enough, unless a signal was lost
CANCELLED = b"refine: error: cancelled; nothing was left half-written\n"


def start(*words, ignored=(), **options):
    """Start Python on this checkout, as from a terminal, less the signals that are ignored."""

    def listen():
        # Whoever runs the tests in the background has Ctrl-C ignored, and programs inherit that.
        for number in SIGNALS:
            signal.signal(number, signal.SIG_IGN if number in ignored else signal.SIG_DFL)

    streams = {"stdin": subprocess.DEVNULL, "stdout": subprocess.PIPE, "stderr": subprocess.PIPE}
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    return subprocess.Popen(
        [sys.executable, *words], env=environment, preexec_fn=listen, **{**streams, **options}
    )


def ended(*words):
    """Run to the end; return the code, what was printed, and the errors."""
    with start(*words) as process:
        said = process.communicate(timeout=SECONDS)
    return process.returncode, *said


CALLED = """
import atexit, os, signal, sys
from refine_addon.__main__ import main

moment, calls = sys.argv.pop(1), 0

def count(frame, event, argument):
    global calls
    calls += event == "call"
    if moment in (str(calls), frame.f_code.co_name) and event == "call":
        sys.setprofile(None)
        os.kill(os.getpid(), signal.SIGINT)

@atexit.register
def tidy():
    if moment == "leaving":
        os.kill(os.getpid(), signal.SIGINT)
        print("left")

sys.setprofile(count)
sys.exit(main())
"""


def test_ctrl_c_while_refitting_writes_what_that_has_reached_but_in_a_dry_run(folder):
    """As many splats as asked for, in a whole file; the command ends all the same.

    The signal comes in the first round: kept splats have merged by then.
    """
    words = ["-c", CALLED, "_solve", *MADE, "--method", "refit"]

    code, _, told = ended(*words, "--dry-run")
    assert code == 130
    assert b"written with" not in told
    assert names(folder) == set()

    told = b"refine: error: cancelled; refitting was stopped before its first round was done; "
    told += b"out.ply is written with what that had reached; nothing was left half-written\n"
    assert ended(*words, "--keep", "20") == (130, b"", told)
    assert names(folder) == {"out.ply"}
    assert len(read_ply(folder / "out.ply")) == 20


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


@pytest.mark.parametrize(
    ("script", "moment"),
    [
        *((CALLED, moment) for moment in ("3", "3000", "30000", "parse_args", "score", "select")),
        *((IMPORTED, moment) for moment in ("1", "30", "200", "datetime")),
    ],
    ids=range(10),
)
def test_ctrl_c_at_any_moment_is_code_130_and_one_line(folder, script, moment):
    """A real SIGINT at the n-th call of a function of Python, or the first of a name.

    The imports are some 90,000 calls; parsing, reading and scoring follow. Or as the n-th module
    is looked up, of some 300. Some of NumPy's are among them, which says of an exception there
    that NumPy is broken: its compiled part imports datetime, and makes it an ImportError.
    """
    assert ended("-c", script, moment, *PRUNE) == (130, b"", CANCELLED)
    assert names(folder) == set()


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
        ([SIGINT], [], b"cancelled", b""),
        ([SIGTERM], [], b"terminated", b"old"),
        ([SIGHUP], [], b"hung up", b"old"),
        ([SIGHUP, SIGINT], [SIGHUP], b"cancelled", b""),
    ],
)
def test_stopped_in_the_middle_of_a_write_it_leaves_what_was_there(
    folder, sent, ignored, reason, before
):
    """Code 128 + n as a shell has it: 130, 143, 129; no temporary file, one line.

    Signals that come while it cleans up change nothing: somebody holds the keys down. ``nohup``
    ignores the closed terminal, and means it; Ctrl-C ends the run after all. On a pseudo-terminal
    the progress is wiped away before that line.
    """
    if before:
        (folder / "out.ply").write_bytes(before)
    words = ["--overwrite"] * bool(before)
    ours, theirs = os.openpty()
    with halfway(*words, ignored=ignored, stdin=subprocess.PIPE, stderr=theirs) as process:
        for number in sent:
            process.send_signal(number)
        assert process.stdout.readline() == b"cleaning\n"
        process.send_signal(SIGINT)
        process.send_signal(SIGTERM)
        process.communicate(b"\n", timeout=SECONDS)
    os.close(theirs)

    assert process.returncode == 128 + sent[-1]
    told = CANCELLED.replace(b"cancelled", reason).replace(b"\n", b"\r\n")
    assert read_all(ours).split(b"\r\x1b[K")[-1] == told
    assert names(folder) == ({"out.ply"} if before else set())
    assert not before or (folder / "out.ply").read_bytes() == before


def test_a_signal_while_python_tidies_up_comes_too_late(folder):
    """All is written and said: the code is 0."""
    assert ended("-c", CALLED, "leaving", *PRUNE, "--quiet") == (0, b"left\n", b"")
    assert names(folder) == {"out.ply"}


def test_whoever_listened_before_listens_after_a_fault_that_passes_through(monkeypatch):
    """Blender and the tests call the command among other things.

    What is ignored is not listened to, as under ``nohup make test``, so nothing is here.
    """
    heard, during = [lambda *_: None for _ in SIGNALS], []
    before = [signal.signal(n, handler) for n, handler in zip(SIGNALS, heard, strict=True)]

    def run(*_, **__):
        during.extend(map(signal.getsignal, SIGNALS))
        raise ValueError("a fault of ours")

    monkeypatch.setattr(subcommands, "run", run)
    try:
        with pytest.raises(ValueError, match="a fault of ours"):
            command.main([])
        assert [signal.getsignal(n) for n in SIGNALS] == heard
        assert len(during) == 3
        assert not set(during) & set(heard)
    finally:
        for number, handler in zip(SIGNALS, before, strict=True):
            signal.signal(number, handler)


def test_the_command_runs_on_a_thread_where_signals_cannot_be_listened_to(capsys):
    """Python refuses handlers there; the work does not need them."""
    codes = []
    thread = threading.Thread(target=lambda: codes.append(command.main(["--version"])))
    thread.start()
    thread.join()

    assert codes == [0]
    assert capsys.readouterr().out.startswith("refine ")
