"""Splats in files that are too many to be merged or refitted at once are divided into regions.

Each region is worked on by itself, by any process. What belongs to it waits in a folder of the job.
"""

from __future__ import annotations

import secrets
import shutil
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from .execute import checkpoint, chunks
from .splats import Splats, folder_of, on_disk

REGION = 1 << 20
"""Splats of a region at most; merging takes about 900 bytes of each."""

_ROWS = 1 << 16  # splats copied at a time
_SAMPLE = 1 << 14  # splats that decide along which axis a box is divided
_ASKEW = np.array([[2, -1, 2], [2, 2, -1], [-1, 2, 2]], np.float32) / np.float32(3.0)


def in_regions(splats: Splats, count: int) -> bool:
    """Whether so many of some splats are too many at once: they lie in files, not in memory."""
    return folder_of(splats) is not None and count > REGION


def divided(
    means: NDArray[np.floating[Any]], share: float = 1.0, *, askew: bool = False
) -> list[NDArray[np.int64]]:
    """Divide splats into boxes of about equally many, by planes at right angles to where they vary.

    Parameters
    ----------
    means : (n, 3) floating
        Where they are; what is not finite counts as the origin.
    share : float
        How many there may be in a box, in `REGION`.
    askew : bool
        Whether the planes lie askew.

    Returns
    -------
    list of (m,) int64
        Rows of each box, ascending.
    """
    with np.errstate(over="ignore"):  # doubles that are no floats
        place = np.asarray(means, np.float32)
    place = np.where(np.isfinite(place).all(axis=1, keepdims=True), place, np.float32(0.0))
    place = place @ (_ASKEW if askew else np.eye(3, dtype=np.float32))

    def halved(rows: NDArray[np.int64], count: int) -> list[NDArray[np.int64]]:
        if count <= 1:
            return [rows]
        sample = place[rows[:: max(len(rows) // _SAMPLE, 1)]]
        low, high = np.quantile(sample, (0.05, 0.95), axis=0)
        along = place[rows, int(np.argmax(high - low))]
        less = count // 2
        cut = len(rows) * less // count
        order = np.argpartition(along, cut)
        one, other = np.sort(rows[order[:cut]]), np.sort(rows[order[cut:]])
        return halved(one, less) + halved(other, count - less)

    return halved(np.arange(len(place)), -(-len(place) // max(int(share * REGION), 1)))


def look(_fraction: float, _what: str) -> None:
    """Progress within a region: nobody is told, but the work can be cancelled."""
    checkpoint()


def new_folder(splats: Splats) -> Path:
    """A new folder for what is made of splats in files, in that of their job."""
    job = folder_of(splats)
    assert job is not None
    folder = job / f"regions-{secrets.token_hex(4)}"
    folder.mkdir()
    return folder


def pieces(splats: Splats, order: NDArray[np.int64] | None = None) -> Iterator[Splats]:
    """Splats some at a time, to be written; all of them, or these rows."""
    count = len(splats) if order is None else len(order)
    return (splats.take(part if order is None else order[part]) for part in chunks(count, _ROWS))


def in_one(folder: Path, regions: Sequence[Splats], rows: NDArray[np.int64]) -> Splats:
    """Splats of all regions, ascending by their rows, beside the folder, which is removed."""
    every = on_disk(folder / "every", (piece for each in regions for piece in pieces(each)))
    result = on_disk(folder.with_name(f"{folder.name}-done"), pieces(every, np.argsort(rows)))
    shutil.rmtree(folder, ignore_errors=True)
    return result
