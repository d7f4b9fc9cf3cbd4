"""`blender --command refine` of the installed zip: its results and its exit codes."""

from __future__ import annotations

import subprocess
import sys
from typing import TYPE_CHECKING

import numpy as np
import plyfile
import pytest
from blenders import PROJECT

if TYPE_CHECKING:
    from pathlib import Path

    from blenders import Binary, Blender


def rows(path: Path) -> np.ndarray:
    """Read the splats of a PLY file, a structured array with a field for each property."""
    return plyfile.PlyData.read(path)["vertex"].data


def rows_in(some: np.ndarray, all_of_them: np.ndarray) -> np.ndarray:
    """Find the rows that stand in another array; (N,) bool for ``all_of_them``, by their bytes."""
    return np.isin(all_of_them.view(f"V{all_of_them.itemsize}"), some.view(f"V{some.itemsize}"))


def refine(binary: Binary, *words: str | Path) -> subprocess.CompletedProcess[str]:
    """Run the extension's command in Blender."""
    return binary.blender("--command", "refine", *words)


def without_blender(*words: str | Path) -> subprocess.CompletedProcess[str]:
    """Run the same command of the checkout, in this Python."""
    command = [sys.executable, "-m", "refine_addon", *words]
    return subprocess.run(command, cwd=PROJECT, capture_output=True, text=True, check=False)


def test_prune_removes_exactly_half_and_changes_no_row(binary: Binary, cloud: Path, cameras: Path):
    """floor(39,755 / 2) = 19,877 go; the rest stand in their old order, bit for bit."""
    output = binary.work / "pruned.ply"

    done = refine(binary, "prune", cloud, "--cameras", cameras, "-o", output, "--ratio", "0.5")

    assert done.returncode == 0, done.stdout + done.stderr
    before, after = rows(cloud), rows(output)
    assert (len(before), len(after)) == (39_755, 39_755 - 19_877)
    assert after.dtype == before.dtype
    assert after.tobytes() == before[rows_in(after, before)].tobytes()


def test_prune_writes_the_same_file_without_blender(binary: Binary, cloud: Path, cameras: Path):
    """Blender's Python and numpy are others than this one's; the file must not tell."""
    ours, theirs = binary.work / "python.ply", binary.work / "blender.ply"
    words = ("prune", cloud, "--cameras", cameras, "--ratio", "0.5", "-o")

    in_blender = refine(binary, *words, theirs)
    in_python = without_blender(*words, ours)

    assert in_blender.returncode == 0, in_blender.stdout + in_blender.stderr
    assert in_python.returncode == 0, in_python.stdout + in_python.stderr
    assert theirs.read_bytes() == ours.read_bytes()


def test_modules_command_writes_the_same_file(blender: Blender, cloud: Path, cameras: Path):
    """The `bpy` wheels have no `--command`; their Python runs the same function."""
    ours, theirs = blender.work / "python.ply", blender.work / "blender.ply"
    words = [*map(str, ("prune", cloud, "--cameras", cameras, "--ratio", 0.5, "-o"))]

    code = blender.step("command", arguments=[*words, str(theirs)])
    in_python = without_blender(*words, ours)

    assert (code, in_python.returncode) == (0, 0), in_python.stderr
    assert theirs.read_bytes() == ours.read_bytes()


def test_failure_is_exit_code_1_and_one_line(binary: Binary, cameras: Path):
    """A missing input is the person's to mend: its name, and no traceback."""
    missing, output = binary.work / "missing.ply", binary.work / "pruned.ply"

    done = refine(binary, "prune", missing, "--cameras", cameras, "-o", output)

    assert done.returncode == 1
    assert "missing.ply" in done.stderr
    assert "Traceback" not in done.stdout + done.stderr
    assert not output.exists()


def test_an_existing_output_is_left_alone(binary: Binary, cloud: Path, cameras: Path):
    """Without --overwrite the command fails with 1 and the file keeps its bytes."""
    output = binary.work / "pruned.ply"
    output.write_bytes(b"precious")

    done = refine(binary, "prune", cloud, "--cameras", cameras, "-o", output)

    assert done.returncode == 1
    assert output.read_bytes() == b"precious"


@pytest.mark.parametrize(
    "wrong",
    [
        ("prune",),
        ("prune", "a.ply", "-o", "b.ply"),
        ("prune", "a.ply", "--cameras", "c.json", "-o", "b.ply", "--ratio", "1.5"),
    ],
    ids=["no input", "no cameras and no scene", "ratio"],
)
def test_wrong_usage_is_exit_code_2(binary: Binary, wrong: tuple[str, ...]):
    done = refine(binary, *wrong)

    assert done.returncode == 2, done.stdout + done.stderr
    assert "usage: refine" in done.stderr
    assert "Traceback" not in done.stdout + done.stderr


def test_object_of_a_blend_is_pruned_and_saved(binary: Binary, blend: Path):
    """After --save the file's object has 39,755 - 19,877 = 19,878 vertices."""
    done = binary.blender(
        *(blend, "--command", "refine", "prune", "--object", "Splats", "--save", "--ratio", "0.5")
    )

    assert done.returncode == 0, done.stdout + done.stderr
    assert binary.step("count", blend=blend, name="Splats") == {
        "vertices": 19_878,
        "cameras": 72,
    }


def test_object_without_save_leaves_the_blend_alone(binary: Binary, blend: Path):
    before = blend.read_bytes()
    output = binary.work / "pruned.ply"

    done = binary.blender(
        *(blend, "--command", "refine", "prune", "--object", "Splats", "--ratio", "0.5"),
        *("-o", output),
    )

    assert done.returncode == 0, done.stdout + done.stderr
    assert len(rows(output)) == 19_878
    assert blend.read_bytes() == before


def test_blends_cameras_decide_as_their_file_does(
    binary: Binary, blend: Path, cloud: Path, cameras: Path
):
    """One set of cameras by two ways; Blender's lens and matrix are float32, so ties may differ.

    Measured: all rows agree; with lenses 1 % longer 99.6 %, with cameras 1 cm off 99.8 %.
    """
    by_file, by_scene = binary.work / "file.ply", binary.work / "scene.ply"
    words = ("prune", cloud, "--ratio", "0.5", "--views", "0", "-o")

    from_scene = binary.blender(blend, "--command", "refine", *words, by_scene)
    from_file = without_blender(*words, by_file, "--cameras", cameras)

    assert from_scene.returncode == 0, from_scene.stdout + from_scene.stderr
    assert from_file.returncode == 0, from_file.stderr
    common = np.count_nonzero(rows_in(rows(by_scene), rows(by_file)))
    assert common >= 0.999 * len(rows(by_file))


@pytest.mark.parametrize("name", ["NoSuchObject", "Camera.000"])
def test_an_object_that_is_none_of_splats_fails_with_its_name(
    binary: Binary, blend: Path, name: str
):
    before = blend.read_bytes()

    done = binary.blender(
        *(blend, "--command", "refine", "prune", "--object", name, "--save"),
    )

    assert done.returncode == 1, done.stdout + done.stderr
    assert name in done.stderr
    assert "Traceback" not in done.stdout + done.stderr
    assert blend.read_bytes() == before
