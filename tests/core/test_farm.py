"""The job templates for render farms, run by Open Job Description's own command."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from refine_addon.core import read_ply
from refine_addon.core.formats.ply import with_count

ROOT = Path(__file__).parents[2]
ROOM = ROOT / "tests/data/room_small"
OPENJD = Path(sys.executable).with_name("openjd")
COUNTS = {"a tile.ply": 300, "b.ply": 200}

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(not OPENJD.exists(), reason="openjd-cli is not installed"),
]


@pytest.fixture
def folder(tmp_path):
    """Make a folder with two assets, one of whose names has a space."""
    (tmp_path / "assets").mkdir()
    file = read_ply(ROOM / "point_cloud.ply")
    for (name, count), rows in zip(
        COUNTS.items(), np.split(file.rows[:5000:10], [300]), strict=True
    ):
        data = with_count(file.header, count) + rows.tobytes()
        (tmp_path / "assets" / name).write_bytes(data)
    return tmp_path


def openjd(action, template, folder, **parameters):
    """Let the command check or run a template, with Python in place of Blender."""
    given = {
        "Assets": folder / "assets", "Cameras": ROOM / "cameras.json", "Output": folder / "out",
        "Refine": f"{sys.executable} -m refine_addon", **parameters,
    }  # fmt: skip
    words = [f"--job-param={name}={value}" for name, value in given.items()]
    return subprocess.run(
        [OPENJD, action, ROOT / "docs" / "farm" / template, *(words if action == "run" else [])],
        env=os.environ | {"PYTHONPATH": str(ROOT)},
        capture_output=True, text=True, check=False, timeout=600,
    )  # fmt: skip


@pytest.mark.parametrize("template", ["each.yaml", "together.yaml"])
def test_a_template_keeps_to_the_specification(template, folder):
    """As the command's own check says."""
    done = openjd("check", template, folder)

    assert done.returncode == 0, done.stdout + done.stderr


def test_a_folder_is_pruned_one_task_a_file(folder):
    """Half of each file goes: 150 of 300 and 100 of 200 stay."""
    options = "--ratio 0.5 --method closed-form"
    done = openjd("run", "each.yaml", folder, Files=2, Options=options)

    assert done.returncode == 0, done.stdout + done.stderr
    assert [len(read_ply(folder / "out" / name)) for name in COUNTS] == [150, 100]


def test_a_task_without_a_file_fails(folder):
    """The submitter counted three, there are two."""
    options = "--ratio 0.5 --method closed-form"
    done = openjd("run", "each.yaml", folder, Files=3, Options=options)

    assert done.returncode != 0
    assert "has 2 .ply files, expected at least 3" in done.stdout


def test_tiles_are_pruned_by_one_budget(folder):
    """100 of 500 stay, in shares of which both files together are the whole."""
    done = openjd("run", "together.yaml", folder, Options="--keep 100")

    assert done.returncode == 0, done.stdout + done.stderr
    assert sum(len(read_ply(folder / "out" / name)) for name in COUNTS) == 100
