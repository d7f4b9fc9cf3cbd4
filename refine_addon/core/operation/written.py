"""How close the pictures stay with what a file of a lossy format holds."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..affine import is_uniform, transformed
from ..formats.registry import format_named, read_splats
from ..quality.psnr import psnr_against
from ..scores import Scores
from ..splats import Splats
from ..views import ViewSet


def written_facts(
    path: Path,
    scores: Scores,
    views: ViewSet,
    *,
    matrix: NDArray[np.float64] | None = None,
    threads: int | None = None,
) -> dict[str, Any]:
    """Return what a report says of a file that was written; nothing of a plain PLY, which is exact.

    Parameters
    ----------
    path : Path
        The file; it is read again.
    scores : Scores
        Of the splats that it was made of; their validation rays tell the PSNR.
    views : ViewSet
        Those of the rays.
    matrix : (4, 4) float64, optional
        From the frame of the file to that of the views; by default they are the same.
    threads : int, optional

    Returns
    -------
    dict
        ``written_psnr``: the estimated PSNR in dB against the pictures of all splats, with what the
        format rounds and leaves out; None where nothing tells it, where the file may not be read
        (see `written_splats`), or the matrix scales directions differently, which harmonics cannot
        express.

    Raises
    ------
    RefineError
        See `read_splats`.
    """
    if format_named(path) is None:
        return {}
    splats = None if scores.ray_sample is None else written_splats(path, matrix)
    if scores.ray_sample is None or splats is None:
        return {"written_psnr": None}
    psnr = psnr_against(scores.ray_sample, splats, views, threads=threads)
    return {"written_psnr": None if psnr is None else round(psnr, 2)}


def written_splats(path: Path, matrix: NDArray[Any] | None = None) -> Splats | None:
    """Return what a file of a lossy format holds, in the frame of the views.

    None for a plain PLY, which is exact; for a file that may not be read, since one that replaced
    another has its permissions; and where `matrix` scales directions differently.
    """
    matrix = np.eye(4) if matrix is None else matrix
    try:
        path.open("rb").close()
    except PermissionError:
        return None
    if format_named(path) is None or not is_uniform(matrix):
        return None
    splats = read_splats(path).splats()
    return splats if np.array_equal(matrix, np.eye(4)) else transformed(splats, matrix)
