"""What the recipes tell to run in Blender is understood; docs/command.md has every option."""

import argparse
import shlex

import pytest

from refine_addon.command import checks
from refine_addon.command.options import complete, make_parser
from tests.examples import blocks
from tests.places import ROOM, ROOT

LINES = {
    document: [
        line.split("#")[0].partition("--command refine ")[2]
        for block in blocks(ROOT / document)
        for line in block.text.splitlines()
        if line.startswith("blender") and "--command refine " in line and "--help" not in line
    ]
    for document in ("README.md", "docs/recipes.md")
}


@pytest.mark.parametrize("document", LINES)
def test_recipes_for_blender_are_understood_and_refused_by_no_check(
    document, tmp_path, monkeypatch
):
    """Wrong usage would leave with code 2; whether objects are in the scene only Blender knows."""
    (tmp_path / "in.ply").symlink_to(ROOM / "point_cloud.ply")
    (tmp_path / "cameras.json").symlink_to(ROOM / "cameras.json")
    monkeypatch.chdir(tmp_path)
    assert LINES[document]

    for line in LINES[document]:
        options = make_parser().parse_args(shlex.split(line.replace("*.ply", "in.ply")))
        options.scene, options.blend = True, "scene.blend"
        complete(options)
        checks.check(options)


def option_rows():
    """Yield the rows of the table of options, from the parser: each option once, with its users."""
    (commands,) = (a for a in make_parser()._actions if isinstance(a, argparse._SubParsersAction))
    users = {}
    for name, command in commands.choices.items():
        for action in command._actions:
            words = [*action.option_strings[-1:], *([] if action.nargs == 0 else [action.metavar])]
            if action.dest != "help":
                users.setdefault((" ".join(words), action.help), []).append(name)
    for (words, text), names in users.items():
        yield f"| `{words}` | {', '.join(names)} | {text} |".replace("N|A", r"N\|A")


def test_the_table_of_options_is_that_of_the_parser():
    """Where it fails: the rows that it expects are those of docs/command.md."""
    lines = (ROOT / "docs/command.md").read_text(encoding="utf-8").splitlines()
    start = lines.index("| option | of | says |") + 2

    rows = list(option_rows())

    assert lines[start : start + len(rows)] == rows
    assert not lines[start + len(rows)].startswith("|")
