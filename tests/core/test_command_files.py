"""The command and the system: what cannot be entered, read, written or shown."""

from __future__ import annotations

import json
import os
import re
import subprocess
import tempfile
from pathlib import Path

import pytest

from refine_addon.command import main
from refine_addon.core import read_ply
from tests.strategies import plain_ply

from .test_command import MADE, PRUNE, folder, pruned, run, told  # noqa: F401 - a fixture

resource = pytest.importorskip("resource")  # POSIX: permissions, limits, descriptors

# What may not be entered, read or written: the words, and what the error begins with.
SHUT = [
    (pruned("shut/in.ply"), "shut/in.ply"),
    (pruned("shut.ply"), "shut.ply"),
    (["info", "shut.ply"], "shut.ply"),
    (pruned(cameras="shut/c.json"), "shut/c.json"),
    (pruned(cameras="shut.json"), "shut.json"),
    (pruned(output="shut/out.ply"), "shut/out.ply"),
    (pruned(output="fixed/out.ply"), "fixed/out.ply"),
    (pruned(output="shut"), "shut/in.ply"),
    (pruned(output="fixed/made"), "fixed/made"),
    ([*MADE, "--report", "shut/r.json"], "shut/r.json"),
    ([*MADE, "--report", "shut.json", "--overwrite"], "shut.json"),
]

# Run once first: nobody may load what belongs to the user who runs the tests.
AS_NOBODY = """
import contextlib, io, json, os, sys
from refine_addon import command

command.main(["prune", "in.ply", "--cameras", "cameras.json", "--dry-run", "--quiet"])
if os.geteuid() == 0:
    os.setgroups([])
    os.setgid(65534)
    os.setuid(65534)
for arguments in json.loads(sys.argv[1]):
    with contextlib.redirect_stderr(io.StringIO()) as errors:
        try:
            code = command.main(arguments)
        except Exception as error:
            code = repr(error)
    print(json.dumps([code, errors.getvalue()]))
"""


@pytest.mark.slow
def test_what_the_system_refuses_is_code_1_and_one_sentence_that_names_it(folder):
    """To a user for whom permissions hold: folders and files that are shut, and one that is full.

    Not in one of pytest's folders, which others cannot enter.
    """
    with tempfile.TemporaryDirectory() as name:
        place = Path(name)
        place.chmod(0o777)
        (place / "shut").mkdir()
        for path in ("in.ply", "cameras.json"):
            (place / path).write_bytes((folder / path).read_bytes())
        for kind in (".ply", ".json", "/in.ply", "/cameras.json"):
            (place / f"shut{kind}").write_bytes(b"ply\n")
            (place / f"shut{kind}").chmod(0)
        (place / "shut").chmod(0)
        (place / "fixed").mkdir(mode=0o555)
        words = json.dumps([arguments for arguments, _ in SHUT])
        done = run(words, program=("-c", AS_NOBODY), cwd=place)
        (place / "shut").chmod(0o700)  # so that it can be removed
        assert (done.returncode, done.stderr) == (0, b"")
        assert not (place / "out.ply").exists()

    answers = [json.loads(line) for line in done.stdout.splitlines()]
    for (arguments, place), (code, errors) in zip(SHUT, answers, strict=True):
        assert code == 1, arguments
        assert re.fullmatch(rf"refine: error: {re.escape(place)}(/\S+)?: .+\n", errors), errors


# The report.


@pytest.mark.slow
def test_a_report_that_fails_in_the_end_says_that_the_splats_were_written(folder):
    """No file may grow beyond 1,000 bytes: one splat fits with its header, the report does not."""
    done = run(
        *MADE, "--keep", "1", "--report", "report.json",
        program=("-B", "-m", "refine_addon"),  # whose compiled modules would be cut off as well
        preexec_fn=lambda: resource.setrlimit(resource.RLIMIT_FSIZE, (1_000, 1_000)),
    )  # fmt: skip

    expected = "refine: error: report.json: the report was not written (File too large)"
    assert done.stderr.decode() == f"{expected}; the splats were\n"
    assert done.returncode == 1
    assert len(read_ply("out.ply")) == 1
    assert sorted(path.name for path in folder.iterdir()) == ["cameras.json", "in.ply", "out.ply"]


@pytest.mark.parametrize("arguments", [["info", "in.ply"], [*PRUNE, "--dry-run"]])
def test_a_report_that_fails_in_the_end_does_not_speak_of_splats_that_were_not_written(
    folder, monkeypatch, capsys, arguments
):
    """Made by somebody else while the work went on; it is left alone."""
    monkeypatch.setattr(
        "refine_addon.command.run.Terminal.say",
        lambda *_: (folder / "report.json").write_text("theirs"),
    )

    assert main([*arguments, "--report", "report.json"]) == 1

    said = capsys.readouterr().err
    assert said.startswith("refine: error: report.json: the report was not written (exists already")
    assert "splats were" not in said
    assert (folder / "report.json").read_text() == "theirs"


def test_a_report_replaces_a_report_and_nothing_else(folder, capsys):
    """What is there must begin as a report does, or be empty as ``mktemp`` leaves it.

    A link stays, and the file that it points to is made.
    """
    report = folder / "report.json"
    words = ["info", "in.ply", "--quiet", "--report", "report.json", "--overwrite"]

    report.write_bytes(b"")
    assert main(words) == 0
    assert main(words) == 0
    report.write_text(json.dumps(json.loads(report.read_text())))  # as another program formats it
    assert main(words) == 0
    for content in (b"{}", b'{"frames": []}', b"ply\n", b"\0\1", (folder / "in.ply").read_bytes()):
        report.write_bytes(content)
        assert main(words) == 2
        assert "report.json exists and is no report: write to another" in capsys.readouterr().err
        assert report.read_bytes() == content

    (folder / "link.json").symlink_to("other.json")
    assert main(["info", "in.ply", "--report", "link.json"]) == 0
    assert (folder / "link.json").is_symlink()
    assert told("other.json")["splats"] == 60


# What is shown.

NASTY = "a\x1b]0;title\x07\nb\x9b\u202e.ply"
HARMLESS = r"a\x1b]0;title\x07\nb\x9b\u202e.ply"
VISIBLE = set(map(chr, range(0x20, 0x7F)))


@pytest.mark.slow
def test_control_characters_in_names_are_escaped_on_the_terminal_and_true_in_the_report(folder):
    """An escape sequence, a bell, a line end, C1's own escape, and writing from right to left."""
    (folder / "in.ply").rename(NASTY)
    words = ["prune", NASTY, *PRUNE[2:], "-o", "made", "--report", "report.json"]

    done = run(*words)
    missing = run("info", f"made/{NASTY}", "x\x1b")
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


# Where nobody listens.


@pytest.mark.slow
@pytest.mark.parametrize(
    ("how", "arguments", "code"),
    [
        ("gone", ["--help"], 0),
        ("full", ["info", "in.ply"], 0),
        ("closed", ["info", "in.ply"], 0),
        ("gone", ["info", "none.ply"], 1),
        ("closed", ["info", "none.ply"], 1),
    ],
)
@pytest.mark.usefixtures("folder")
def test_a_stream_that_takes_nothing_changes_no_exit_code(how, arguments, code):
    """A pager that was left, a full disk, ``2>&-``: Python would exit with 120."""
    stream, other = ("stderr", "stdout") if code else ("stdout", "stderr")
    if how == "full" and not Path("/dev/full").exists():
        pytest.skip("no /dev/full here")
    reader, writer = os.pipe()
    os.close(reader)
    device = Path("/dev/full" if how == "full" else os.devnull)
    with os.fdopen(writer, "wb") as gone, device.open("wb") as full:
        done = run(
            *arguments,
            preexec_fn=(lambda: os.close(1 + bool(code))) if how == "closed" else None,
            **{stream: gone if how == "gone" else full, other: subprocess.PIPE},
        )

    assert done.returncode == code
    assert getattr(done, other) == b""


def test_an_output_that_is_another_input_by_a_link_is_refused(folder, capsys):
    """It would be replaced before it is read."""
    (folder / "b.ply").write_bytes(plain_ply())
    (folder / "out").mkdir()
    (folder / "out/in.ply").symlink_to(folder / "b.ply")

    assert main(["prune", "in.ply", "b.ply", *PRUNE[2:], "-o", "out", "--overwrite"]) == 2

    assert "by a link, which is read too" in capsys.readouterr().err
    assert (folder / "b.ply").read_bytes() == plain_ply()
