"""Rows of the committed room as tiles."""

from __future__ import annotations

import functools
from pathlib import Path

import numpy as np

from refine_addon.core import pace, read_ply
from refine_addon.core.formats.ply_header import with_count

ROOM = Path(__file__).parent / "data/room_small"
COUNT = 5000
CUTS = (0, 700, 700, 2600, COUNT)
"""Rows at which the room is cut: a short tile, an empty one, and two that span units of 1000."""


room = functools.cache(lambda: read_ply(ROOM / "point_cloud.ply"))


def room_rows():
    """Return `COUNT` rows of the room; some are equal, some cannot be drawn."""
    rows = room().rows[::7][:COUNT].copy()
    rows[900:1300] = rows[100]
    rows["x"][[5, 2000]] = np.nan
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


def joined(paths):
    """Return the rows of files as bytes."""
    return b"".join(read_ply(path).rows.tobytes() for path in paths)


def told_by_plan(monkeypatch):
    """Make runs tell how much of what was planned is done, not what the clock says of it.

    So what is interrupted at a share is the same step, however busy the machine is.
    """

    def tell(course, phase, fraction, what):
        if phase in course._phases[course._place :]:
            course._place = course._phases.index(phase)
            phase.fraction = max(phase.fraction, fraction)
        seconds = [each.seconds for each in course._phases]
        done = sum(seconds[: course._place]) + phase.fraction * phase.seconds
        course._fraction = max(course._fraction, done / max(sum(seconds), 1e-9))
        return course._progress(course._fraction, what)

    monkeypatch.setattr(pace._Course, "tell", tell)
