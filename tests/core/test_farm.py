"""The job templates for render farms, run by Open Job Description's own command."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

from refine_addon.core import read_ply
from refine_addon.core.formats.ply import with_count
from tests.places import ROOM, ROOT

OPENJD = Path(sys.executable).with_name("openjd")

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(not OPENJD.exists(), reason="openjd-cli is not installed"),
]


def test_tasks_prune_a_file_each_and_one_without_a_file_fails(tmp_path):
    """The submitter counted two files, there is one, whose name has a space: 150 of 300 stay.

    Python stands in place of Blender, with which `tests/e2e` run the templates.
    """
    (tmp_path / "assets").mkdir()
    file = read_ply(ROOM / "point_cloud.ply")
    rows = with_count(file.header, 300) + file.rows[:3000:10].tobytes()
    (tmp_path / "assets/a tile.ply").write_bytes(rows)
    given = {
        "Assets": tmp_path / "assets", "Cameras": ROOM / "cameras.json", "Files": 2,
        "Options": "--ratio 0.5 --method closed-form",
        "Output": tmp_path / "out", "Refine": f"{sys.executable} -m refine_addon",
    }  # fmt: skip
    words = [f"--job-param={name}={value}" for name, value in given.items()]

    done = subprocess.run(
        [OPENJD, "run", ROOT / "docs/farm/each.yaml", *words],
        env=os.environ | {"PYTHONPATH": str(ROOT)},
        capture_output=True, text=True, check=False, timeout=600,
    )  # fmt: skip

    assert done.returncode != 0
    assert "has 1 .ply files, expected at least 2" in done.stdout
    assert len(read_ply(tmp_path / "out/a tile.ply")) == 150
