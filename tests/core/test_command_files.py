"""The command and the system: what cannot be entered, read, written or shown."""

from __future__ import annotations

import json
import os
import re
import subprocess
import sys
import tempfile
from pathlib import Path

import pytest

from refine_addon import command
from refine_addon.command import main
from refine_addon.core import read_ply
from tests.strategies import plain_ply

resource = pytest.importorskip("resource")  # POSIX: permissions, limits, descriptors

ROOT = Path(__file__).parents[2]
CAMERAS = ["--cameras", "cameras.json"]
PRUNE = ["prune", "in.ply", *CAMERAS]
CAMERA = {
    "position": [0.0, 0.0, 0.0],
    "rotation": [[1, 0, 0], [0, 1, 0], [0, 0, 1]],
    "fx": 180.0,
    "fy": 180.0,
    "width": 40,
    "height": 30,
}


def fill(folder: Path) -> None:
    """Put 60 splats and a camera there."""
    (folder / "in.ply").write_bytes(plain_ply(60, 1))
    (folder / "cameras.json").write_text(json.dumps([CAMERA]))


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """Stand in a folder with 60 splats and a camera."""
    fill(tmp_path)
    monkeypatch.chdir(tmp_path)
    return tmp_path


def run(*arguments: str, program: tuple[str, ...] = ("-m", "refine_addon"), **options):
    """Run the command in a process of its own."""
    if not {"stdout", "stderr"} & set(options):
        options["capture_output"] = True
    return subprocess.run(
        [sys.executable, *program, *arguments],
        env={**os.environ, "PYTHONPATH": str(ROOT), "PYTHONUNBUFFERED": ""},
        timeout=600,
        check=False,
        **options,
    )


# What may not be entered, read or written.

SHUT = {
    "input": (["prune", "shut/in.ply", *CAMERAS, "-o", "out.ply"], "shut/in.ply"),
    "input that may not be read": (["prune", "shut.ply", *CAMERAS, "-o", "out.ply"], "shut.ply"),
    "input of info": (["info", "shut/in.ply"], "shut/in.ply"),
    "input of info that may not be read": (["info", "shut.ply"], "shut.ply"),
    "cameras": (["prune", "in.ply", "--cameras", "shut/c.json", "-o", "out.ply"], "shut/c.json"),
    "cameras that may not be read": (
        ["prune", "in.ply", "--cameras", "shut.json", "-o", "out.ply"],
        "shut.json",
    ),
    "cameras' folder": (["prune", "in.ply", "--cameras", "shut", "-o", "out.ply"], "shut"),
    "output": ([*PRUNE, "-o", "shut/out.ply"], "shut/out.ply"),
    "output where nothing may be made": ([*PRUNE, "-o", "fixed/out.ply"], "fixed/out.ply"),
    "output of scores": (["score", *PRUNE[1:], "-o", "shut/out.ply"], "shut/out.ply"),
    "folder of outputs": ([*PRUNE, "-o", "shut"], "shut/in.ply"),
    "folder of outputs in a folder": ([*PRUNE, "-o", "shut/made"], "shut/made"),
    "folder where none may be made": ([*PRUNE, "-o", "fixed/made"], "fixed/made"),
    "report": ([*PRUNE, "-o", "out.ply", "--report", "shut/r.json"], "shut/r.json"),
    "report that may not be read": (
        [*PRUNE, "-o", "out.ply", "--report", "shut.json", "--overwrite"],
        "shut.json",
    ),
    "report where nothing may be made": (
        [*PRUNE, "-o", "out.ply", "--report", "fixed/r.json"],
        "fixed/r.json",
    ),
}


# Run once first: nobody may load what belongs to the user who runs the tests.
AS_NOBODY = """
import contextlib, io, json, os, sys
from refine_addon import command

command.main(["prune", "in.ply", "--cameras", "cameras.json", "--dry-run", "--quiet"])
if os.geteuid() == 0:
    os.setgroups([])
    os.setgid(65534)
    os.setuid(65534)
for name, arguments in json.loads(sys.argv[1]).items():
    with contextlib.redirect_stderr(io.StringIO()) as errors:
        try:
            code = command.main(arguments)
        except Exception as error:
            code = repr(error)
    print(json.dumps([name, code, errors.getvalue()]))
"""


@pytest.fixture(scope="module")
def refused():
    """Give what the command answers to a user for whom permissions hold, who may not do a thing."""
    # Not one of pytest's folders, which others cannot enter.
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        folder.chmod(0o777)
        fill(folder)
        (folder / "shut").mkdir()
        for kind in (".ply", ".json", ".dat", "/in.ply", "/cameras.json"):
            (folder / f"shut{kind}").write_bytes(b"ply\n")
            (folder / f"shut{kind}").chmod(0)
        (folder / "shut").chmod(0)
        (folder / "fixed").mkdir(mode=0o555)
        words = {case: arguments for case, (arguments, _) in SHUT.items()}
        done = run(json.dumps(words), program=("-c", AS_NOBODY), cwd=folder)
        (folder / "shut").chmod(0o700)  # so that it can be removed
        assert (done.returncode, done.stderr) == (0, b"")
        assert not (folder / "out.ply").exists()
        answers = map(json.loads, done.stdout.splitlines())
        yield {case: (code, errors) for case, code, errors in answers}


@pytest.mark.slow
@pytest.mark.parametrize("case", SHUT)
def test_what_the_system_refuses_is_code_1_and_one_sentence_that_names_it(refused, case):
    """A folder that cannot be entered, a file that cannot be read, a folder that takes no files."""
    code, errors = refused[case]

    assert code == 1
    assert re.fullmatch(rf"refine: error: {re.escape(SHUT[case][1])}(/\S+)?: .+\n", errors), errors


# The report.


@pytest.mark.slow
def test_a_report_that_fails_in_the_end_says_that_the_splats_were_written(folder):
    """No file may grow beyond 1,000 bytes: one splat fits with its header, the report does not."""
    limit = 1_000
    done = run(
        *PRUNE, "-o", "out.ply", "--keep", "1", "--report", "report.json",
        program=("-B", "-m", "refine_addon"),  # whose compiled modules would be cut off as well
        preexec_fn=lambda: resource.setrlimit(resource.RLIMIT_FSIZE, (limit, limit)),
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

    assert command.main([*arguments, "--report", "report.json"]) == 1

    said = capsys.readouterr().err
    assert said.startswith("refine: error: report.json: the report was not written (exists already")
    assert "splats were" not in said
    assert (folder / "report.json").read_text() == "theirs"


def test_a_report_replaces_a_report_and_nothing_else(folder, capsys):
    """What is there must begin as a report does, or be empty as ``mktemp`` leaves it."""
    report = folder / "report.json"
    words = ["info", "in.ply", "--quiet", "--report", "report.json", "--overwrite"]

    report.write_bytes(b"")
    assert command.main(words) == 0
    assert command.main(words) == 0
    report.write_text(json.dumps(json.loads(report.read_text())))  # as another program formats it
    assert command.main(words) == 0
    for content in (b"{}", b'{"frames": []}', b"ply\n", b"\0\1", (folder / "in.ply").read_bytes()):
        report.write_bytes(content)
        assert command.main(words) == 2
        said = capsys.readouterr().err
        assert "report.json exists and is no report: write to another name" in said
        assert report.read_bytes() == content


def test_a_report_is_written_through_a_link(folder):
    """The file that the link points to is made, the link stays."""
    (folder / "reports").mkdir()
    (folder / "link.json").symlink_to("reports/report.json")

    assert command.main(["info", "in.ply", "--report", "link.json"]) == 0

    assert (folder / "link.json").is_symlink()
    assert json.loads((folder / "reports/report.json").read_text())["results"]


# What is shown.

NASTY = "a\x1b]0;title\x07\nb\x9b\u202e.ply"
HARMLESS = r"a\x1b]0;title\x07\nb\x9b\u202e.ply"


@pytest.mark.slow
def test_control_characters_in_names_are_escaped_on_the_terminal_and_true_in_the_report(folder):
    """An escape sequence, a bell, a line end, C1's own escape, and writing from right to left."""
    (folder / "in.ply").rename(NASTY)
    words = ["prune", NASTY, *CAMERAS, "-o", "made", "--report", "report.json"]

    done = run(*words)
    again = run(*words, "--overwrite", "--save")
    missing = run("info", f"made/{NASTY}", "x\x1b")
    unknown = run("info", "x", "--nonsense\x1b\n")

    assert (done.returncode, done.stderr) == (0, b"")
    assert done.stdout.decode().startswith(f"{HARMLESS}: kept 30 of 60 splats")
    assert done.stdout.decode().splitlines()[0].endswith(f" -> made/{HARMLESS}")
    assert read_ply(f"made/{NASTY}")
    (entry,) = json.loads((folder / "report.json").read_text())["results"]
    assert (entry["files"]["input"], entry["files"]["output"]) == (NASTY, f"made/{NASTY}")
    assert again.returncode == unknown.returncode == 2
    assert missing.returncode == 1
    assert rb"refine: error: x\x1b: cannot be read" in missing.stderr
    assert unknown.stderr.endswith(b"unrecognized arguments: --nonsense\\x1b\\n\n")
    printed = b"".join(each.stdout + each.stderr for each in (done, again, missing, unknown))
    assert set(printed.decode()) <= {"\n", *map(chr, range(0x20, 0x7F))}


@pytest.mark.slow
def test_control_characters_are_escaped_in_what_is_drawn(folder):
    """On a pseudo-terminal: every escape sequence is the one that clears the line."""
    pty = pytest.importorskip("pty")
    (folder / "in.ply").rename(NASTY)
    ours, theirs = pty.openpty()
    done = run(
        *("prune", NASTY, *CAMERAS, "-o", "out.ply"), stdout=subprocess.DEVNULL, stderr=theirs
    )
    os.close(theirs)
    drawn = os.read(ours, 1 << 16)
    os.close(ours)

    assert done.returncode == 0
    assert f"{HARMLESS}: scoring".encode() in drawn
    assert set(drawn.replace(b"\r\x1b[K", b"")) <= set(range(0x20, 0x7F))


# Where nobody listens.


@pytest.mark.slow
@pytest.mark.parametrize(
    ("arguments", "stream", "code"),
    [
        (["--help"], "stdout", 0),
        (["info", "in.ply"], "stdout", 0),
        (["info", "none.ply"], "stderr", 1),
    ],
)
@pytest.mark.parametrize("how", ["gone", "full", "closed"])
@pytest.mark.usefixtures("folder")
def test_a_stream_that_takes_nothing_changes_no_exit_code(arguments, stream, code, how):
    """A pager that was left, a full disk, ``2>&-``: Python would exit with 120."""
    other = "stderr" if stream == "stdout" else "stdout"
    number = {"stdout": 1, "stderr": 2}[stream]
    if how == "full" and not Path("/dev/full").exists():
        pytest.skip("no /dev/full here")
    reader, writer = os.pipe()
    os.close(reader)
    device = Path("/dev/full" if how == "full" else os.devnull)
    with os.fdopen(writer, "wb") as gone, device.open("wb") as full:
        done = run(
            *arguments,
            preexec_fn=(lambda: os.close(number)) if how == "closed" else None,
            **{stream: gone if how == "gone" else full, other: subprocess.PIPE},
        )

    assert done.returncode == code
    assert b"Traceback" not in (getattr(done, other) or b"")
    assert b"Exception ignored" not in (getattr(done, other) or b"")


def test_an_output_that_is_another_input_by_a_link_is_refused(tmp_path, capsys):
    """It would be replaced before it is read."""
    inputs = [tmp_path / "in" / name for name in ("a.ply", "b.ply")]
    (tmp_path / "in").mkdir()
    (tmp_path / "out").mkdir()
    for path in inputs:
        path.write_bytes(b"ply\n")
    (tmp_path / "out/a.ply").symlink_to(inputs[1])
    words = ["--cameras", str(tmp_path / "c.json"), "-o", str(tmp_path / "out")]

    code = main(["prune", *map(str, inputs), *words, "--ratio", ".5", "--overwrite"])

    assert code == 2
    assert "by a link, which is read too" in capsys.readouterr().err
    assert inputs[1].read_bytes() == b"ply\n"


def test_a_report_is_none_of_the_pictures(tmp_path, capsys):
    words = ["--pictures", str(tmp_path), "--report", str(tmp_path / "a-000-after.png")]

    code = main(["prune", "a.ply", "-o", "b.ply", "--cameras", "c.json", "--ratio", ".5", *words])

    assert code == 2
    assert "may be one of the pictures" in capsys.readouterr().err
