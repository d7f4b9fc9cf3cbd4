"""The moving picture of the README and those of the store: ``python docs/store_pictures.py SCENE``.

The budget's slider moves in the real panel, over what stays of a scene, in a window of Blender.
Writes ``docs/slider.webp``, ``docs/store/featured.jpg`` and ``docs/store/icon.png``.
"""

from __future__ import annotations

import shutil
import sys
import tempfile
from pathlib import Path

import numpy as np
from PIL import Image

DOCS = Path(__file__).resolve().parent
sys.path.insert(0, str(DOCS.parent))

from benchmarks.speed.main_thread import BINARIES, installed

SHARES = [10, 30, 50, 60, 70, 80, 85, 90, 95]
"""Of the splats removed, percent: from left to right and back."""
FEATURED = SHARES.index(70)

SIZE, SHOWN = (1920, 1080), (1280, 720)
"""Of the window, and of the moving picture, pixels."""

ICON, BLOBS = (
    256,
    (
        (0.35, 0.38, 0.16, 0.065, 0.5, (1.0, 0.75, 0.2)),
        (0.66, 0.34, 0.14, 0.06, -0.7, (0.95, 0.4, 0.25)),
        (0.54, 0.69, 0.17, 0.07, -0.3, (0.3, 0.6, 1.0)),
    ),
)
"""Pixels of the icon, and its splats: middle, standard deviations, angle, colour."""


def frames(scene: Path) -> list[Image.Image]:
    """Pictures of the window, one for each of `SHARES`."""
    with tempfile.TemporaryDirectory() as folder:
        work = Path(folder)
        blender = installed(BINARIES[0], work)
        cloud, cameras = (
            shutil.copy(scene / name, work) for name in ("point_cloud.ply", "cameras.json")
        )
        names = {"cloud": cloud, "cameras": cameras, "pictures": work}
        blender.window_step("slider", size=SIZE, shares=SHARES, **names)
        return [Image.open(file).convert("RGB") for file in sorted(work.glob("*.png"))]


def icon() -> Image.Image:
    """A few splats on nothing."""
    rows, columns = (np.mgrid[:ICON, :ICON] + 0.5) / ICON
    color, left = np.zeros((ICON, ICON, 3)), np.ones((ICON, ICON, 1))
    for x, y, long, short, turn, paint in BLOBS:
        along = np.cos(turn) * (columns - x) + np.sin(turn) * (rows - y)
        across = np.cos(turn) * (rows - y) - np.sin(turn) * (columns - x)
        alpha = np.exp(-0.5 * ((along / long) ** 2 + (across / short) ** 2))[..., None]
        color, left = color + left * alpha * np.array(paint), left * (1.0 - alpha)
    rgba = np.concatenate([color / np.maximum(1.0 - left, 1e-6), 1.0 - left], axis=2)
    return Image.fromarray((rgba.clip(0.0, 1.0) * 255.0).round().astype(np.uint8))


def main(scene: Path) -> None:
    """Take the pictures and keep them."""
    store, moving = DOCS / "store", DOCS / "slider.webp"
    icon().save(store / "icon.png")
    taken = frames(scene)
    taken[FEATURED].save(store / "featured.jpg", quality=88)
    shown = [picture.resize(SHOWN, Image.Resampling.LANCZOS) for picture in taken]
    how = {"save_all": True, "duration": 600, "loop": 0, "quality": 80, "method": 6}
    shown[0].save(moving, append_images=[*shown[1:], *shown[-2:0:-1]], **how)
    print(f"{moving}: {moving.stat().st_size / 1e6:.2f} MB")


if __name__ == "__main__":
    main(Path(sys.argv[1]))
