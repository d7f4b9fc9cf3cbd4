"""*Render with Splats* of the installed zip, in windows and in the background."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from blenders import Binary
from compared import psnr
from PIL import Image

from benchmarks.renderer.rasterizer import render
from refine_addon.core.cameras.read import read_cameras
from refine_addon.core.formats.ply import read_ply


@pytest.fixture(scope="module")
def expected(cloud: Path, cameras: Path) -> np.ndarray:
    """Give what the reference renderer shows of the room by camera 0."""
    view, splats = read_cameras(cameras)[0], read_ply(cloud).splats()
    return render(splats, view, near=0.1).clip(0.0, 1.0)


def test_renders_show_splats_among_meshes(binary: Binary, blend: Path, expected: np.ndarray):
    """At least 40 dB between the render and the reference renderer, off the red cube.

    So it is where the shader draws the splats, as with a graphics card, and between both.

    Every setting is as before, also after Esc, which ends an animation and a render of 160,000
    splats: Cycles on two threads within two seconds of processor, the drawing of splats within one,
    what draws the window left out. F12 says that it leaves splats out.

    Meanwhile nothing else can be started, a bar says why, and the scene menu lists no copies.
    """
    found = binary.window_step("render", blend, simulate=False, pictures=binary.work)

    assert found["size"] == [240, 160]
    during, afterwards = found["refusal"]
    assert during.startswith("Rendering: wait until it is over, or press Esc")
    assert afterwards == ""
    assert not found["can export"]
    assert found["scenes"] == ["Scene"]
    assert found["alike"] == [True] * 4
    assert found["began"]
    assert found["stopped"]
    of_cycles, of_splats = found["busy"]
    assert of_cycles < 2.0
    assert of_splats < 1.0
    assert found["notice"]
    # Else Blender before 5.0 may free, as it goes on, what a render draws with.
    assert binary.name != "trixie" or (found["in_windows"] and all(found["in_windows"]))
    assert {path.name for path in binary.work.glob("frame_*")} == {"frame_01.png", "frame_02.png"}
    by_cpu, by_card = (
        np.load(binary.work / f"{by}.npy")[..., :3] for by in ("rendered", "by_card")
    )
    frame = np.asarray(Image.open(binary.work / "frame_02.png"))[..., :3] / 255.0
    for picture in (by_cpu, by_card, frame):
        splats = ~_near_red(picture)
        assert psnr(picture[splats], expected[splats]) > 40.0
    assert psnr(by_cpu, by_card) > 40.0


def _near_red(picture: np.ndarray) -> np.ndarray:
    """Return where a picture is red, or mixed with it at the edges."""
    red = (picture[..., 0] > 0.7) & (picture[..., 1:] < 0.3).all(axis=-1)
    assert 0.01 < red.mean() < 0.5
    for _ in range(3):
        red[1:] |= red[:-1]
        red[:-1] |= red[1:]
        red[:, 1:] |= red[:, :-1]
        red[:, :-1] |= red[:, 1:]
    return red


def test_the_command_renders_without_a_window(binary: Binary, blend: Path, expected: np.ndarray):
    """The current frame, 1, where ``-o`` says; at least 40 dB from the reference renderer."""
    done = binary.blender(
        *(blend, "--render-output", binary.work / "shot_##", "--command", "refine", "render")
    )

    assert done.returncode == 0, done.stdout + done.stderr
    assert f"frame 1: {binary.work / 'shot_01.png'}" in done.stdout
    picture = np.asarray(Image.open(binary.work / "shot_01.png"))[..., :3] / 255.0
    assert psnr(picture, expected) > 40.0
