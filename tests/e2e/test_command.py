"""`blender --command refine` of the installed zip: its results and its exit codes."""

from __future__ import annotations

import re
import signal
import subprocess
from pathlib import Path

import numpy as np
import pytest
from blenders import Binary, Blender, without_blender
from PIL import Image
from splat_rows import rows, rows_in


def refine(binary: Binary, *words: str | Path) -> subprocess.CompletedProcess[str]:
    """Run the extension's command in Blender."""
    return binary.blender("--command", "refine", *words)


def test_prune_removes_exactly_half_and_changes_no_row(
    binary: Binary, cloud: Path, cameras: Path, pruned: Path
):
    """floor(39,755 / 2) = 19,877 go; the rest stand in their old order, bit for bit.

    The file is the one that ``python -m refine_addon`` writes without Blender.
    """
    output = binary.work / "pruned.ply"

    words = ("prune", cloud, "--cameras", cameras, "--ratio", "0.5", "--method", "occlusion")
    done = refine(binary, *words, "-o", output)

    assert done.returncode == 0, done.stdout + done.stderr
    before, after = rows(cloud), rows(output)
    assert (len(before), len(after)) == (39_755, 39_755 - 19_877)
    assert after.dtype == before.dtype
    assert after.tobytes() == before[rows_in(after, before)].tobytes()
    assert output.read_bytes() == pruned.read_bytes()


def test_every_blender_writes_the_same_file(
    blender: Blender, cloud: Path, cameras: Path, pruned: Path
):
    """Blender's Python and NumPy are others than this one's; the file must not tell.

    The `bpy` wheels have no `--command`, so the step calls the function behind it.
    """
    output = blender.work / "pruned.ply"
    words = ["prune", cloud, "--cameras", cameras, "--ratio", "0.5"]
    words += ["--method", "occlusion", "-o", output]

    code = blender.step("command", arguments=words)

    assert code == 0
    assert output.read_bytes() == pruned.read_bytes()


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


def test_pictures_are_drawn_in_the_background_without_a_display(binary: Binary, blend: Path):
    """Three of 72 cameras, each before, after and different; the object is as it was.

    The room's estimate at half removed is about 38 dB over all views; these three are measured.
    """
    shown = binary.work / "shown"
    before = blend.read_bytes()

    done = binary.blender(
        *(blend, "--command", "refine", "prune", "--object", "Splats", "--ratio", "0.5"),
        *("--method", "occlusion", "--dry-run", "--pictures", shown),
    )

    assert done.returncode == 0, done.stdout + done.stderr
    assert len(list(shown.glob("Splats-*.png"))) == 9
    measured = re.search(r"pictures: (\S+) dB measured in 3 views", done.stdout)
    assert measured
    assert 33.0 < float(measured[1]) < 43.0
    with Image.open(next(shown.glob("*-before.png"))) as picture:
        assert picture.size == (240, 160)
        assert picture.convert("L").getextrema()[1] > 128
    assert blend.read_bytes() == before


def test_blends_cameras_decide_as_their_file_does(
    binary: Binary, blend: Path, cloud: Path, cameras: Path
):
    """One set of cameras by two ways; Blender's lens and matrix are float32, so ties may differ.

    Measured: all rows agree; with lenses 1 % longer 99.6 %, with cameras 1 cm off 99.8 %.
    """
    by_file, by_scene = binary.work / "file.ply", binary.work / "scene.ply"
    words = ("prune", cloud, "--ratio", "0.5", "--views", "0", "--method", "occlusion", "-o")

    from_scene = binary.blender(blend, "--command", "refine", *words, by_scene)
    from_file = without_blender(*words, by_file, "--cameras", cameras)

    assert from_scene.returncode == 0, from_scene.stdout + from_scene.stderr
    assert from_file.returncode == 0, from_file.stderr
    common = np.count_nonzero(rows_in(rows(by_scene), rows(by_file)))
    assert common >= 0.999 * len(rows(by_file))


SIGNALLED = """
import pathlib, signal, subprocess, sys, time

number, made = int(sys.argv[1]), pathlib.Path(sys.argv[2])

def listen():
    for each in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        signal.signal(each, signal.SIG_DFL)

process = subprocess.Popen(sys.argv[3:], preexec_fn=listen)
while process.poll() is None and not made.exists():
    time.sleep(0.01)
process.send_signal(number)
code = process.wait()
sys.exit(code if code >= 0 else f"killed by {-code}")
"""


@pytest.mark.parametrize(
    ("number", "reason"),
    [(signal.SIGINT, "cancelled"), (signal.SIGTERM, "terminated"), (signal.SIGHUP, "hung up")],
)
def test_stopped_at_work_it_leaves_nothing_and_says_so(
    binary: Binary, cloud: Path, cameras: Path, number: int, reason: str
):
    """The folder of the outputs is made first and goes again; scoring then takes seconds."""
    made = binary.work / "made"
    words = ("prune", cloud, "--cameras", cameras, "--method", "occlusion", "--views", "0")

    done = binary.run(
        *("python3", "-c", SIGNALLED, str(int(number)), made),
        *("blender", "--background", "--command", "refine", *words, "-o", made),
    )

    assert done.returncode == 128 + number, done.stdout + done.stderr
    assert f"refine: error: {reason}; nothing was left half-written\n" in done.stderr
    assert "Traceback" not in done.stdout + done.stderr
    assert not made.exists()


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
