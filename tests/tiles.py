"""Rows of the committed room as tiles."""

from __future__ import annotations

import functools
from pathlib import Path

import numpy as np

from refine_addon.core import read_ply
from refine_addon.core.formats.ply import with_count

ROOM = Path(__file__).parent / "data/room_small"
COUNT = 5000
CUTS = (0, 700, 700, 2600, COUNT)
"""Rows at which the room is cut: a short tile, an empty one, and two that are read in pieces."""


room = functools.cache(lambda: read_ply(ROOM / "point_cloud.ply"))


def room_rows():
    """Give `COUNT` rows of the room; some are equal, some cannot be drawn, one is far away."""
    rows = room().rows[::7][:COUNT].copy()
    rows[900:1300] = rows[100]
    rows["x"][[5, 2000]] = np.nan
    rows["x"][7] = 1e30
    rows["opacity"][10:400:7] = -np.inf
    rows["scale_0"][4000] = np.inf
    return rows


def write(path, rows):
    """Write rows of the room as a file."""
    path.write_bytes(with_count(room().header, len(rows)) + rows.tobytes())


def cut(folder, rows, cuts=CUTS):
    """Write rows as files that are cut at some of them; the names are not in their order."""
    paths = [folder / f"{name}.ply" for name in "badcfehg"[: len(cuts) - 1]]
    for path, start, stop in zip(paths, cuts, cuts[1:], strict=False):
        write(path, rows[start:stop])
    return paths


def rows_in(folder, paths):
    """Give the rows of the outputs of some tiles."""
    return np.concatenate([read_ply(folder / path.name).rows for path in paths])
