"""Rows of 3DGS PLY files, compared by their bytes."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import plyfile


def rows(path: Path) -> np.ndarray:
    """Read the splats of a PLY file, a structured array with a field for each property."""
    return plyfile.PlyData.read(path)["vertex"].data


def rows_in(some: np.ndarray, all_of_them: np.ndarray) -> np.ndarray:
    """Find the rows that stand in another array; (N,) bool for ``all_of_them``, by their bytes."""
    return np.isin(all_of_them.view(f"V{all_of_them.itemsize}"), some.view(f"V{some.itemsize}"))
