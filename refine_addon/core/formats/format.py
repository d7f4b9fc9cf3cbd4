"""Interface of a splat format other than plain PLY, and conversions that formats share."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any, BinaryIO, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..errors import RefineError
from ..execute import chunks
from ..splats import MODELS, SH_C0, Model, Splats, assign, base_color, opacity, opacity_logits
from .ply import SplatFile, new_header, with_model
from .ply_columns import empty_rows

CHUNK = 1 << 15
"""Splats converted at a time: 8 MB at degree 3. A multiple of `compressed_ply.SPLATS`."""


class Format(NamedTuple):
    """A format of splat files, other than plain PLY."""

    name: str
    suffix: str  # in lower case
    matches: Callable[[Path, bytes], bool]
    read: Callable[[Path, NDArray[np.uint8]], SplatFile]
    # Gets splats that can all be drawn; None if the format is only read.
    write: Callable[[BinaryIO, Splats], None] | None = None
    degree: int = 0  # highest of the harmonics
    loss: str = ""  # what is lost, as a sentence whose subject is the suffix
    models: tuple[Model, ...] = MODELS[:1]  # those that a file can name
    # Positions, (N, 3) -> how far writing moves the one it moves farthest; None if always little.
    moves: Callable[[NDArray[Any]], float] | None = None


def new_file(
    path: Path,
    read: tuple[str, int],
    count: int,
    degree: int,
    parts: Iterable[Splats],
    model: Model = "default",
) -> SplatFile:
    """Plain PLY of `count` splats, in parts of at most `degree`; `read`: input's format, bytes."""
    rows, splats = empty_rows(count, degree)
    start = 0
    with np.errstate(all="ignore"):  # while parts are computed, too: files may hold any numbers
        for part in parts:
            target = splats.take(slice(start, start + len(part)))
            assign(target.up_to_degree(part.sh_degree), part)
            start += len(part)
    header = with_model(new_header(rows.dtype, count), model)
    return SplatFile(path, rows, header, format=read[0], stored_bytes=read[1])


def pieces(count: int) -> list[slice]:
    """Slices of ``range(count)``, `CHUNK` long."""
    return chunks(count, CHUNK)


def codes(shares: NDArray[Any]) -> NDArray[np.uint8]:
    """Shares, (...), clipped to 0..1, as codes 0..255, uint8, rounded to the nearest."""
    return np.asarray(np.rint(np.clip(shares, 0.0, 1.0) * 255), np.uint8)


def color_codes(splats: Splats, curve: Callable[..., Any] = np.asarray) -> NDArray[np.uint8]:
    """Colours, each through a `curve`, and opacities in 8 bits each, (N, 4) uint8."""
    colors = curve(base_color(splats.sh_dc))
    return codes(np.column_stack([colors, opacity(splats.opacity_logits)]))


def from_colors(shares: NDArray[Any]) -> tuple[NDArray[Any], NDArray[Any]]:
    """Logits, (N,), and constant harmonics, (N, 3), of colours and opacities, (N, 4), 0..1."""
    return opacity_logits(shares[:, 3]), (shares[:, :3] - 0.5) / SH_C0


def refuse_short(path: Path, needed: int, held: int, what: str) -> None:
    """Raise `RefineError` if `what` needs more bytes than the `held` ones of the file."""
    if needed > held:
        raise RefineError(f"{path}: truncated: {what} need {needed} bytes, the file has {held}")


def split_largest(q: NDArray[np.float64]) -> tuple[NDArray[np.intp], NDArray[np.float64]]:
    """Index, (N,), of the largest component of unit quaternions, (N, 4), and the others, (N, 3).

    Of equal ones the first is the largest; signs are flipped where it is negative (`join_largest`).
    """
    largest = np.abs(q).argmax(axis=1)
    others = np.take_along_axis(q, _OTHERS[largest], axis=1)
    negative = np.take_along_axis(q, largest[:, None], axis=1) < 0.0
    return largest, np.where(negative, -others, others)


def join_largest(largest: NDArray[np.intp], others: NDArray[np.float64]) -> NDArray[np.float64]:
    """Unit quaternions, (N, 4) float64; the inverse of `split_largest`."""
    left = np.maximum(1.0 - np.einsum("ij,ij->i", others, others), 0.0)
    q = np.empty((len(others), 4))
    np.put_along_axis(q, _OTHERS[largest], others, axis=1)
    np.put_along_axis(q, largest[:, None], np.sqrt(left)[:, None], axis=1)
    return q


_OTHERS = np.array([[1, 2, 3], [0, 2, 3], [0, 1, 3], [0, 1, 2]])  # left-out component -> the others
