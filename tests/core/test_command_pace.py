"""What the command says of the time left, of several files, and of how it is called."""

from __future__ import annotations

import json
import re
import shlex

import pytest

from refine_addon import command
from refine_addon.command import options, terminal
from refine_addon.core.pace import Pace
from tests.strategies import plain_ply

PRUNE = ["--cameras", "cameras.json", "--method", "closed-form"]


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """Stand in a folder with three files of 60 splats and a camera."""
    monkeypatch.chdir(tmp_path)
    for name in ("a", "b", "c"):
        (tmp_path / f"{name}.ply").write_bytes(plain_ply(60, 1))
    camera = {
        "position": [0.0, 0.0, 0.0],
        "rotation": [[1, 0, 0], [0, 1, 0], [0, 0, 1]],
        "fx": 180.0,
        "fy": 180.0,
        "width": 40,
        "height": 30,
    }
    (tmp_path / "cameras.json").write_text(json.dumps([camera]))
    return tmp_path


def pace(sizes, *, passed):
    """Return the pace of files after so many seconds, before the first of them."""
    times = iter([100.0])
    return Pace(sizes, lambda: next(times, 100.0 + passed))


@pytest.mark.parametrize(
    ("passed", "fraction", "expected"),
    [
        (1.9, 0.5, ""),  # too early
        (10.0, 0.0, ""),  # no pace yet
        (10.0, 1.0, ""),  # nothing is left
        (10.0, 0.25, "about 30 s left"),  # 10 / .25 - 10
        (9.9, 0.25, "about 30 s left"),  # 29.7, rounded up
        (20.0, 0.25, "about 60 s left"),
        (20.4, 0.25, "about 1 min 10 s left"),  # 61.2 s
        (40.0, 0.25, "about 2 min left"),  # 120 s
        (100.0, 0.25, "about 5 min left"),  # 300 s
        (101.0, 0.25, "about 6 min left"),  # 303 s
        (3000.0, 0.25, "about 2 h 30 min left"),  # 9000 s
        (1200.0, 0.25, "about 1 h 0 min left"),  # 3600 s
    ],
)
def test_the_time_left_is_that_of_the_pace_so_far(passed, fraction, expected):
    """Seconds passed, times what is left over what is done."""
    one = pace([7], passed=passed)
    one.next()

    assert one.left(fraction) == expected


def test_the_time_left_rises_only_where_it_is_far_more():
    """10 s for half leave 10 s. Half at 12 s leaves 12, 1.2 of it; at 14 s 14, 1.4 of it."""
    now = [0.0]
    one = Pace([7], lambda: now[0])
    one.next()

    def left_at(seconds):
        now[0] = seconds
        return one.seconds_left(0.5)

    assert [left_at(seconds) for seconds in (10.0, 12.0, 14.0, 8.0)] == [10.0, 10.0, 14.0, 8.0]


def test_the_time_left_of_several_files_goes_by_their_bytes():
    """Half of the second of 10, 20 and 30 bytes: 20 of 60 in 10 s, so 40 more take 20 s."""
    several = pace([10, 20, 30], passed=10.0)
    several.next()
    several.next()

    assert several.left(0.5) == "about 20 s left in all"
    assert several.named("b.ply") == "file 2 of 3, b.ply"


def test_files_without_a_size_count_alike():
    """Of 0 bytes, as are files that cannot be read: half of the second of two in 9 s leaves 3."""
    several = pace([0, 0], passed=9.0)
    several.next()
    several.next()

    assert several.left(0.5) == "about 3 s left in all"


def test_progress_ends_with_the_time_left(monkeypatch):
    """And without a comma where it is not known yet."""
    drawn = []
    monkeypatch.setattr(terminal, "_is_terminal", lambda _stream: True)
    monkeypatch.setattr(terminal, "_write", lambda _name, text: drawn.append(text))
    draw = terminal.Terminal(quiet=False).progress(
        "in.ply", lambda fraction: "about 4 s left" if fraction else ""
    )
    draw(0.0, "scoring")
    draw(0.5, "scoring")

    lines = [line.removeprefix("\r\x1b[K") for line in drawn]
    assert lines == ["in.ply: scoring   0%", "in.ply: scoring  50%, about 4 s left"]


@pytest.mark.usefixtures("folder")
def test_of_several_files_the_place_is_said(capsys):
    """The second of three is cut off: it is named as an error, and the third is still the third."""
    with open("b.ply", "r+b") as stream:
        stream.truncate(1000)

    code = command.main(["prune", "a.ply", "b.ply", "c.ply", *PRUNE, "--output-dir", "out"])

    said = capsys.readouterr()
    assert code == 1
    assert re.findall(r"^file.*?:", said.out, re.MULTILINE) == [
        "file 1 of 3, a.ply:",
        "file 3 of 3, c.ply:",
    ]
    assert said.err.startswith("refine: error: b.ply: ")


def test_splats_that_lie_in_no_view_are_counted(folder, capsys):
    """One of 60 is put behind the camera; more may lie outside of its frame, as the report says."""
    file = folder / "a.ply"
    data = bytearray(file.read_bytes())
    start = data.index(b"end_header\n") + len(b"end_header\n")
    data[start + 8 : start + 12] = b"\x00\x00\xc8\xc2"  # z = -100
    file.write_bytes(data)

    for arguments in (
        ["prune", "a.ply", *PRUNE, "-o", "out.ply", "--report", "prune.json"],
        ["score", "a.ply", *PRUNE, "-o", "scored.ply", "--report", "score.json"],
    ):
        assert command.main(arguments) == 0

        report = json.loads((folder / f"{arguments[0]}.json").read_text())["results"][0]
        unseen = report["splats"]["unseen"]
        assert unseen >= 1
        assert f"\n  {unseen} of 60 splats lie in no view\n" in capsys.readouterr().out


@pytest.mark.parametrize("name", ["prune", "score", "clean", "lod"])
def test_the_report_names_the_cameras_that_decided(folder, name):
    """The file that was given, under the name that it was given by."""
    target = {"lod": ["-o", "levels"], "clean": []}.get(name, ["-o", "out.ply"])
    arguments = [name, "a.ply", "--cameras", "cameras.json", *target, "--report", "r.json"]
    assert command.main(arguments) == 0

    entry = json.loads((folder / "r.json").read_text())["results"][0]
    assert entry["cameras"] == {"source": "file", "file": "cameras.json"}


@pytest.mark.parametrize("name", options.EXAMPLES)
def test_the_examples_under_each_help_are_taken_by_the_parser(capsys, name):
    """Each example is shown, and its words parse as the subcommand that it stands under."""
    assert command.main([name, "--help"]) == 0
    text = capsys.readouterr().out
    examples = text.partition("\nexamples:\n")[2].splitlines()

    assert len(examples) == len(options.EXAMPLES[name]) >= 1
    for example in examples:
        words = shlex.split(example)
        arguments = words[words.index("refine") + 1 :]
        assert options.make_parser().parse_args(arguments).command == name


WRONG = {
    "--source=sometimes": "expected one of visible, active, selected, frames, collection:NAME",
    "--source=visible:x": "expected one of visible",
    "--source=collection": "expected one of visible",
    "--source=collection:": "expected one of visible",
    "--source=": "expected one of visible",
    "--frames=1": "expected A:B:STEP or A:B in whole numbers, got '1'",
    "--frames=1:2:3:4": "expected A:B:STEP or A:B in whole numbers",
    "--frames=a:b": "expected A:B:STEP or A:B in whole numbers",
    "--frames=1:1.5": "expected A:B:STEP or A:B in whole numbers",
    "--frames=5:4": "expected at least one frame, got '5:4', which starts after it ends",
    "--frames=1:9:0": "a step of at least 1, got '1:9:0'",
    "--frames=1:9:-1": "a step of at least 1",
    "--frames=1:1048575": "frames from -1048574 to 1048574",
    "--frames=-1048575:0": "frames from -1048574 to 1048574",
    "--source=visible": "--source goes with --object; for INPUT files give --cameras",
    "--frames=1:2": "--frames goes with --object; for INPUT files give --cameras",
}


@pytest.mark.usefixtures("folder")
@pytest.mark.parametrize("option", WRONG)
def test_a_choice_of_cameras_that_cannot_be_is_refused(capsys, option):
    """As wrong usage, code 2, with what was expected."""
    assert command.main(["prune", "a.ply", option, "-o", "out.ply"]) == 2
    assert WRONG[option] in capsys.readouterr().err


@pytest.mark.parametrize(
    ("text", "frames"),
    [("1:9:4", [1, 5, 9]), ("1:8:4", [1, 5]), ("3:5", [3, 4, 5]), ("-2:-2:7", [-2])],
)
def test_frames_hold_both_ends(text, frames):
    """The last one where the step meets it."""
    given = options.make_parser().parse_args(["prune", "--object", "x", f"--frames={text}"])

    assert list(given.frames) == frames
