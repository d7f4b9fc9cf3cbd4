"""The properties of a 3DGS PLY by name, converted to splats and back."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Any, NamedTuple, TypeAlias

import numpy as np
from numpy.lib.stride_tricks import as_strided
from numpy.typing import NDArray

from ..splats import LOG_ZERO, Model, Splats, above_constant

_USUAL = "x y z f_dc_0 f_dc_1 f_dc_2 opacity scale_0 scale_1 scale_2 rot_0 rot_1 rot_2 rot_3"
REQUIRED = tuple(_USUAL.split())
"""Properties that every splat has."""

THIRD_SCALE = "scale_2"  # the only one that discs (2DGS) may lack
REST_COUNTS = {0: 0, 9: 1, 24: 2, 45: 3, 72: 4}  # number of ``f_rest_*`` -> degree


def splats_from_columns(columns: Columns, model: Model = "default") -> Splats:
    """Splats of properties by name, (N,) each: all of `REQUIRED`, and any ``f_rest_*``.

    Harmonics are all of red, then green, then blue. Without ``scale_2``, which "2dgs" ignores, the
    splats are discs. The arrays are views where properties lie side by side, else copies.
    """
    names = columns.dtype.names or () if isinstance(columns, np.ndarray) else tuple(columns)
    count = sum(name.startswith("f_rest_") for name in names)
    rest = [f"f_rest_{index}" for index in range(count)]
    size = len(columns["x"])
    planes = _stack(columns, rest) if rest else np.zeros((size, 0), np.float32)
    flat = model == "2dgs" or THIRD_SCALE not in names
    scales = _stack(columns, REQUIRED[7 : 9 if flat else 10])
    if flat:
        scales = np.column_stack([scales, np.full(size, LOG_ZERO, scales.dtype)])
    return Splats(
        means=_stack(columns, ["x", "y", "z"]),
        log_scales=scales,
        quaternions=_stack(columns, ["rot_0", "rot_1", "rot_2", "rot_3"]),
        opacity_logits=columns["opacity"],
        sh_dc=_stack(columns, ["f_dc_0", "f_dc_1", "f_dc_2"]),
        sh_rest=planes.reshape(size, 3, count // 3).transpose(0, 2, 1),
        model="2dgs" if flat else model,
    )


def other_properties(names: Iterable[str]) -> list[str]:
    """Names of properties that belong neither to splats nor to normals."""
    usual = ("nx", "ny", "nz", *REQUIRED)
    return [name for name in names if name not in usual and not name.startswith("f_rest_")]


def empty_rows(count: int, degree: int) -> tuple[NDArray[Any], Splats]:
    """Rows, (count,), of a 3DGS PLY in float32, all 0, and their splats as views."""
    rows = np.zeros(count, [(name, "<f4") for name in _names(3 * above_constant(degree))])
    return rows, splats_from_columns(rows)


def values_by_name(splats: Splats) -> dict[str, NDArray[Any]]:
    """Views of splats as properties, (N,) each, by name, in the order of a 3DGS PLY."""
    planes = [plane for channel in splats.sh_rest.transpose(2, 1, 0) for plane in channel]
    first, last = [*splats.means.T, *splats.sh_dc.T], [*splats.log_scales.T, *splats.quaternions.T]
    values = [*first, *planes, splats.opacity_logits, *last]
    by_name = dict(zip(_names(len(planes)), values, strict=True))
    if splats.model == "2dgs":
        del by_name[THIRD_SCALE]
    return by_name


def _names(rest: int) -> list[str]:
    """Names of properties in the order of a 3DGS PLY, `rest` of them harmonics."""
    return [*REQUIRED[:6], *(f"f_rest_{index}" for index in range(rest)), *REQUIRED[6:]]


Columns: TypeAlias = "Mapping[str, NDArray[Any]] | NDArray[Any]"
"""Properties of N splats by name, (N,) each; or a structured array."""

Keep: TypeAlias = "NDArray[np.bool_] | None"
"""Kept rows among N, (N,); None stands for all."""


class Changed(NamedTuple):
    """New values of some rows among N."""

    rows: NDArray[np.int64]  # (n,), ascending
    columns: Mapping[str, NDArray[Any]]  # (n,) each, by the name of a property that is stored


Changes: TypeAlias = "Mapping[str, NDArray[Any]] | Changed | None"
"""Properties of N splats by name, (N,) each, to be set or appended; or those of some rows."""


def _stack(columns: Any, names: Sequence[str]) -> NDArray[Any]:
    """The named columns as (N, len(names)); a view if they are adjacent in each row."""
    first = columns[names[0]]
    if isinstance(columns, np.ndarray) and columns.dtype.fields and columns.ndim == 1:
        kinds, offsets = zip(*(columns.dtype.fields[name][:2] for name in names), strict=True)
        step = kinds[0].itemsize
        beside = tuple(range(offsets[0], offsets[0] + step * len(names), step))
        if len(set(kinds)) == 1 and offsets == beside and len(columns):
            layout = (len(first), len(names)), (first.strides[0], step)
            return as_strided(first, *layout, writeable=first.flags.writeable)
    kind = np.result_type(*(columns[name].dtype for name in names), np.float32)
    stacked = np.empty((len(first), len(names)), kind)
    with np.errstate(invalid="ignore"):  # signalling NaN converted to float64
        for index, name in enumerate(names):
            stacked[:, index] = columns[name]
    return stacked
