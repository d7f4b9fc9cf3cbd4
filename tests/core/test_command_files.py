"""The command and the system: what cannot be entered, read, written or shown."""

import json
import os
import re
import subprocess
from pathlib import Path

import pytest

from refine_addon.command import main
from refine_addon.core import read_ply
from tests.strategies import plain_ply
from tests.users import own_folder

from .test_command import MADE, PRUNE, folder, pruned, run, told  # noqa: F401 - a fixture

pytest.importorskip("resource")  # POSIX: permissions, signals, descriptors


@pytest.mark.slow
def test_what_the_system_refuses_is_code_1_and_one_sentence_that_names_it(
    folder, monkeypatch, capsys
):
    """To a user for whom permissions hold; who may not load what the tests' user has, so before."""
    assert main([*PRUNE, "--dry-run", "--quiet"]) == 0
    given = {name: (folder / name).read_bytes() for name in ("in.ply", "cameras.json")}
    with own_folder() as place:
        monkeypatch.chdir(place)
        for name, data in given.items():
            (place / name).write_bytes(data)
        (place / "shut").mkdir(mode=0)
        (place / "fixed").mkdir(mode=0o555)
        (place / "shut.ply").touch(mode=0)
        for arguments, named in (
            (pruned("shut.ply"), "shut.ply"),
            (pruned(cameras="shut/c.json"), "shut/c.json"),
            (pruned(output="shut"), "shut/in.ply"),
            (pruned(output="fixed/out.ply"), "fixed/out.ply"),
            (pruned(output="fixed/made"), "fixed/made"),
            ([*MADE, "--report", "shut/r.json"], "shut/r.json"),
        ):
            assert main(arguments) == 1
            errors = capsys.readouterr().err
            assert re.fullmatch(rf"refine: error: {re.escape(named)}(/\S+)?: .+\n", errors), errors
        assert not (place / "out.ply").exists()


@pytest.mark.parametrize("arguments", [["info", "in.ply"], [*PRUNE, "--dry-run"], MADE])
def test_a_report_made_meanwhile_is_left_and_what_was_written_is_told(
    folder, monkeypatch, capsys, arguments
):
    theirs = lambda *_: (folder / "report.json").write_text("theirs")  # noqa: E731
    monkeypatch.setattr("refine_addon.command.run.Run.print", theirs)

    assert main([*arguments, "--report", "report.json"]) == 1

    said = capsys.readouterr().err
    assert said.startswith("refine: error: report.json: the report was not written (exists already")
    assert ("; the splats were\n" in said) == (folder / "out.ply").exists() == (arguments is MADE)
    assert (folder / "report.json").read_text() == "theirs"


def test_a_report_replaces_a_report_and_nothing_else(folder, capsys):
    """What is there must begin as a report does, or be empty as ``mktemp`` leaves it."""
    report = folder / "report.json"
    words = ["info", "in.ply", "--quiet", "--report", "report.json", "--overwrite"]

    report.write_bytes(b"")
    assert main(words) == 0
    report.write_text(json.dumps(json.loads(report.read_text())))  # as another program formats it
    assert main(words) == 0
    assert told()["splats"] == 60
    for content in (b"{}", b'{"frames": []}', b"ply\n", b"\0\1", (folder / "in.ply").read_bytes()):
        report.write_bytes(content)
        assert main(words) == 2
        assert "report.json: exists and is no report; choose another" in capsys.readouterr().err
        assert report.read_bytes() == content


NASTY = "a\x1b]0;title\x07\nb\x9b\u202e.ply"
HARMLESS = r"a\x1b]0;title\x07\nb\x9b\u202e.ply"
VISIBLE = set(map(chr, range(0x20, 0x7F)))


@pytest.mark.slow
def test_control_characters_in_names_are_escaped_on_the_terminal_and_true_in_the_report(folder):
    """An escape sequence, a bell, a line end, C1's own escape, and writing from right to left."""
    (folder / "in.ply").rename(NASTY)
    words = ["prune", NASTY, *PRUNE[2:], "-o", "made", "--report", "report.json"]

    done = run(*words)
    missing = run("info", "x\x1b")
    for encoding in ("utf-8", "ascii"):  # bytes that are no UTF-8; a terminal of ASCII alone
        (folder / "b\udcff ü.ply").write_bytes(plain_ply())
        shown = run("info", "b\udcff ü.ply", encoding=encoding)
        assert (shown.returncode, shown.stderr) == (0, b"")
        assert b"\\udcff" in shown.stdout
    unknown = run("info", "x", "--nonsense\x1b\n")

    assert (done.returncode, done.stderr) == (0, b"")
    assert done.stdout.decode().startswith(f"{HARMLESS}: kept 30 of 60 splats")
    assert done.stdout.decode().splitlines()[0].endswith(f" -> made/{HARMLESS}")
    assert read_ply(f"made/{NASTY}")
    assert [told()["files"][name] for name in ("input", "output")] == [NASTY, f"made/{NASTY}"]
    assert (missing.returncode, unknown.returncode) == (1, 2)
    assert rb"refine: error: x\x1b: cannot be read" in missing.stderr
    assert unknown.stderr.endswith(b"unrecognized arguments: --nonsense\\x1b\\n\n")
    printed = b"".join(each.stdout + each.stderr for each in (done, missing, unknown))
    assert set(printed.decode()) <= VISIBLE | {"\n"}


def read_all(terminal):
    """Return what was written to a pseudo-terminal, which gives some 4 kB at a time, and close."""
    drawn = b""
    try:
        while some := os.read(terminal, 1 << 16):
            drawn += some
    except OSError:  # Linux's way to say that nothing more can come
        pass
    os.close(terminal)
    return drawn


@pytest.mark.slow
def test_progress_is_drawn_on_a_terminal_escaped_and_wiped_away(folder):
    """On a pseudo-terminal: lines that overwrite each other, the last of them empty."""
    pty = pytest.importorskip("pty")
    (folder / "in.ply").rename(NASTY)
    for more in ([], ["--quiet", "--overwrite"]):
        ours, theirs = pty.openpty()
        words = ["prune", NASTY, *PRUNE[2:], "-o", "out.ply", *more]
        done = run(*words, stdout=subprocess.PIPE, stderr=theirs)
        os.close(theirs)
        steps = read_all(ours).decode().split("\r\x1b[K")

        assert done.returncode == 0
        assert steps[0] == steps[-1] == ""
        for stage in ("scoring", "writing"):
            line = rf"{re.escape(HARMLESS)}: {stage} +\d+%"
            assert any(re.fullmatch(line, step) for step in steps) == (not more)
        assert set("".join(steps)) <= VISIBLE
        assert (b"\x1b" in done.stdout, bool(done.stdout)) == (False, not more)


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="no /dev/full here")
@pytest.mark.parametrize("words", [["--help"], ["info", "in.ply"], MADE])
def test_standard_output_on_a_full_disk_is_code_1_and_the_work_is_done(folder, words):
    with open("/dev/full", "w") as full:
        done = run(*words, stdout=full)

    expected = b"refine: error: standard output: No space left on device\n"
    assert (1, expected) == (done.returncode, done.stderr)
    assert (folder / "out.ply").exists() == (words is MADE)


@pytest.mark.slow
@pytest.mark.parametrize("case", ["gone --help", "gone info none.ply", "closed info none.ply"])
@pytest.mark.usefixtures("folder")
def test_a_stream_that_nobody_reads_changes_no_exit_code(case):
    """A pager that was left, ``2>&-``: Python would exit with 120."""
    how, *arguments = case.split()
    code = int("none.ply" in arguments)
    stream, other = ("stderr", "stdout") if code else ("stdout", "stderr")
    reader, gone = os.pipe()
    os.close(reader)
    target = gone if how == "gone" else os.open("/dev/null", os.O_RDWR)
    shut = (lambda: os.close(1 + code)) if how == "closed" else None
    done = run(*arguments, preexec_fn=shut, **{stream: target})
    for descriptor in {gone, target}:
        os.close(descriptor)

    assert done.returncode == code
    assert getattr(done, other) == b""
