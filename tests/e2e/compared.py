"""How close splats and pictures of the screen are to what they should be."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import plyfile
from PIL import Image

from benchmarks.renderer.rasterizer import render
from refine_addon.core.formats.ply import read_ply
from refine_addon.core.views import View


def fewer(cloud: Path, folder: Path) -> Path:
    """Write every fourth splat of a file to another; what is done to them takes less time."""
    file = read_ply(cloud)
    file.write(folder / "few.ply", np.arange(len(file)) % 4 == 0)
    return folder / "few.ply"


def rows(path: Path) -> np.ndarray:
    """Read the splats of a PLY file, a structured array with a field for each property."""
    return plyfile.PlyData.read(path)["vertex"].data


def rows_in(some: np.ndarray, all_of_them: np.ndarray) -> np.ndarray:
    """Find the rows that stand in another array; (N,) bool for ``all_of_them``, by their bytes."""
    return np.isin(all_of_them.view(f"V{all_of_them.itemsize}"), some.view(f"V{some.itemsize}"))


def view_in(seen: dict[str, Any], picture: Path) -> np.ndarray:
    """Return what a picture of the screen shows of a view, (H, W, 3) in 0..1.

    ``seen`` says where the view lies, as `inside/view.py` tells it.
    """
    (width, height), left, top = seen["size"], seen["left"], seen["top"]
    with Image.open(picture) as screen:
        return np.asarray(screen.convert("RGB"))[top : top + height, left : left + width] / 255.0


def reference(seen: dict[str, Any], cloud: Path) -> np.ndarray:
    """Return what the reference renderer shows of a file of splats there, on black."""
    view, window = np.array(seen["view"]), np.array(seen["window"])
    width, height = seen["size"]
    rotation = np.diag([1.0, -1.0, -1.0]) @ view[:3, :3]
    rotation /= np.linalg.norm(rotation, axis=1, keepdims=True)  # float32
    camera = View(
        rotation=rotation,
        center=-rotation.T @ np.diag([1.0, -1.0, -1.0]) @ view[:3, 3],
        fx=window[0, 0] * width / 2,
        fy=window[1, 1] * height / 2,
        cx=(1.0 - window[0, 2]) * width / 2,
        cy=(1.0 + window[1, 2]) * height / 2,
        width=width,
        height=height,
    )
    near = window[2, 3] / (window[2, 2] - 1.0)
    return render(read_ply(cloud).splats(), camera, near=near).clip(0.0, 1.0)


def psnr(one: np.ndarray, other: np.ndarray) -> float:
    """Return how close pictures are, dB; 99 if they are the same."""
    error = np.mean((one - other) ** 2)
    return float(-10.0 * np.log10(error)) if error else 99.0
