"""The job templates for render farms, run with real Blenders."""

from __future__ import annotations

import shlex
import subprocess
import sys
from pathlib import Path

import pytest
from blenders import PROJECT, Binary

from refine_addon.core import read_ply

OPENJD = Path(sys.executable).with_name("openjd")

pytestmark = pytest.mark.skipif(not OPENJD.exists(), reason="openjd-cli is not installed")


@pytest.mark.parametrize(
    ("template", "more"),
    [("each.yaml", {"Files": 2}), ("together.yaml", {})],
    ids=["each", "together"],
)
def test_blender_does_the_tasks_of_a_template(
    binary: Binary, cloud: Path, cameras: Path, template: str, more: dict[str, int]
):
    """The room twice, half of it to go: of each file by itself, of both by one budget together."""
    assets = binary.work / "assets"
    assets.mkdir()
    for name in ("a room.ply", "b.ply"):
        (assets / name).write_bytes(cloud.read_bytes())
    refine = binary.work / "refine"
    command = binary.entered("blender", "--background", "--command", "refine")
    refine.write_text(f'#!/bin/sh\nexec {shlex.join(map(str, command))} "$@"\n', "utf-8")
    refine.chmod(0o755)
    given = {
        "Assets": assets, "Cameras": cameras, "Output": binary.work / "out", "Refine": refine,
        "Options": "--ratio 0.5 --method closed-form", **more,
    }  # fmt: skip

    done = subprocess.run(
        [
            OPENJD, "run", PROJECT / "docs" / "farm" / template,
            *(f"--job-param={name}={value}" for name, value in given.items()),
        ],
        capture_output=True, text=True, check=False, timeout=300,
    )  # fmt: skip

    assert done.returncode == 0, done.stdout + done.stderr
    kept = [len(read_ply(path)) for path in sorted((binary.work / "out").iterdir())]
    total = len(read_ply(cloud))
    if template == "each.yaml":
        assert kept == [total - total // 2] * 2
    else:
        assert sum(kept) == total  # of equal splats those of the first file go first
