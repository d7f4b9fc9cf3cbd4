"""Stored columns of splats, updated with what survivors became, for files and meshes.

This module stands above formats and absorbing, so that neither has to know the other.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from .affine import transformed
from .formats.ply_columns import ChangedColumns, Columns
from .merging.merge import Merged


def survivor_columns(
    stored: Columns | NDArray[Any],
    absorbed: Merged | None,
    matrix: NDArray[Any] | None = None,
) -> Mapping[str, NDArray[Any]]:
    """Return stored columns with the values of changed survivors put in.

    Parameters
    ----------
    stored : mapping of str to (N,), or structured array
        All properties of the splats before absorbing, such as `SplatFile.rows`; not changed.
    absorbed : Merged or None
        Of these splats; None where survivors stay what they are: no column changes.
    matrix : (4, 4) floating, optional
        From the frame of the survivors to that of the columns; by default they are the same.

    Returns
    -------
    mapping of str to (N,)
        The properties that make a splat, each in its stored type, rounded once. Rows of all other
        splats, unchanged or removed, are equal to the stored ones to the bit.

    Examples
    --------
    To write the survivors, as they became, to a file::

        columns = survivor_columns(file.rows, result.absorbed)
        file.write("out.ply", result.keep, columns=columns)
    """
    if absorbed is None:
        return {}
    changed = np.flatnonzero(absorbed.changed)
    rows = np.flatnonzero(absorbed.keep)[changed]
    survivors = absorbed.splats.take(changed)
    if matrix is not None and not np.array_equal(matrix, np.eye(4)):
        survivors = transformed(survivors, matrix)
    return ChangedColumns(stored, rows, survivors)
