"""What SOG files hold, version 2, as it is written: ``meta.json`` and images of a pixel a splat."""

from __future__ import annotations

import json
import math
import zipfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from ..errors import RefineError
from ..rendering import MODELS
from ..splats import Splats, opacity, unit_quaternions
from .format import codes, near_ones_together, split_largest
from .images import codec_for

NAME, VERSION = "SOG", 2
GENERATOR = "REFINE for Blender"
META = "meta.json"
IMAGES = (
    *("means_l.webp", "means_u.webp", "quats.webp", "scales.webp", "sh0.webp"),
    *("shN_labels.webp", "shN_centroids.webp"),
)
"""Names of the files that are written; those of harmonics where there are any."""

ACROSS = 64  # entries of the palette in a row of its image
LABEL_BITS = 16  # of the number of an entry of the palette: two channels of an image
TABLE = 256  # values of a table, whose places are a byte
COORDINATE = 65535.0  # largest code of a coordinate: two bytes, in two images
ROTATIONS = 252  # in the alpha of a rotation: this, and which component is the largest

_NO_SIZE = -20.0  # log scale written for anything smaller, since tables hold finite numbers
_MOST_PIXELS = 16383  # of a side of a WebP image


def write(stream: BinaryIO, splats: Splats) -> None:
    """Write splats as a SOG file, sorted so that neighbours in space are neighbours in images.

    Raises
    ------
    RefineError
        See `contents`.
    """
    path = Path(str(getattr(stream, "name", NAME)))
    # A ZipInfo has no date of today, so a file is the same whenever it is made.
    with zipfile.ZipFile(stream, "w") as archive:
        for name, data in contents(path, splats.take(near_ones_together(splats.means))):
            archive.writestr(zipfile.ZipInfo(name), data)


def contents(path: Path, splats: Splats) -> Iterator[tuple[str, bytes]]:
    """Yield the files that hold splats, with their names: `META`, then the images.

    Parameters
    ----------
    path : Path
        What errors name.
    splats : Splats
        In the order in which the file has them.

    Raises
    ------
    RefineError
        If there is no library for images, or there are more splats than pixels in them.
    """
    size = _image_size(len(splats))
    codec = codec_for(path)
    low, high, lower, upper = _coordinates(splats.means)
    scale_table, scales = _tabulated(np.maximum(splats.log_scales, _NO_SIZE))
    color_table, colors = _tabulated(splats.sh_dc)
    with np.errstate(under="ignore"):
        alpha = codes(opacity(splats.opacity_logits))
    meta: dict[str, Any] = {
        "version": VERSION,
        "asset": {"generator": GENERATOR},
        "count": len(splats),
        "means": {
            "mins": low.tolist(),
            "maxs": high.tolist(),
            "files": ["means_l.webp", "means_u.webp"],
        },
        "scales": {"codebook": scale_table.tolist(), "files": ["scales.webp"]},
        "quats": {"files": ["quats.webp"]},
        "sh0": {"codebook": color_table.tolist(), "files": ["sh0.webp"]},
    }
    if splats.model != MODELS[0]:
        meta["model"] = splats.model
    images = {
        "means_l.webp": _image(size, lower),
        "means_u.webp": _image(size, upper),
        "quats.webp": _image(size, _rotation_pixels(splats.quaternions)),
        "scales.webp": _image(size, scales),
        "sh0.webp": _image(size, np.column_stack([colors, alpha])),
    }
    if splats.sh_degree:
        meta["shN"], images["shN_labels.webp"], images["shN_centroids.webp"] = _grouped_harmonics(
            splats.sh_rest, size
        )
    yield META, json.dumps(meta).encode()
    for name, image in images.items():
        yield name, codec.encode(image)


def _image_size(count: int) -> tuple[int, int]:
    """Return height and width of images for `count` pixels: nearly square, width divisible by 4."""
    width = 4 * (-(-math.isqrt(max(count - 1, 0)) // 4) + 1)
    if width > _MOST_PIXELS:
        raise RefineError(f"{count} splats: {NAME} holds {(_MOST_PIXELS // 4 * 4) ** 2}")
    return -(-count // width), width


def _image(size: tuple[int, int], values: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Return an image (height, width, 4) of a pixel for each splat, opaque where nothing is said.

    `values`, (N, C) uint8, are the first C channels of each pixel.
    """
    image = np.zeros((*size, 4), np.uint8)
    image[..., 3] = 255
    image.reshape(-1, 4)[: len(values), : values.shape[1]] = values
    return image


def _coordinates(
    means: NDArray[Any],
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.uint8], NDArray[np.uint8]]:
    """Return the range of the logarithms of positions (N, 3), and their codes within it.

    The range is two (3,) float64, the codes are two (N, 3) uint8: their lower and upper bytes.
    """
    means = np.asarray(means, np.float64)
    logs = np.sign(means) * np.log1p(np.abs(means))
    low, high = logs.min(axis=0), logs.max(axis=0)
    extent = np.where(high > low, high - low, 1.0)
    code = np.rint((logs - low) / extent * COORDINATE).astype(np.uint16)
    return low, low + extent, (code & 255).astype(np.uint8), (code >> 8).astype(np.uint8)


def _rotation_pixels(quaternions: NDArray[Any]) -> NDArray[np.uint8]:
    """Return pixels (N, 4): the three smaller components, and which is left out."""
    largest, others = split_largest(unit_quaternions(quaternions))
    return np.column_stack([codes(others * math.sqrt(0.5) + 0.5), largest + ROTATIONS]).astype(
        np.uint8
    )


def _grouped_harmonics(
    sh_rest: NDArray[Any], size: tuple[int, int]
) -> tuple[dict[str, Any], NDArray[np.uint8], NDArray[np.uint8]]:
    """Return what ``meta.json`` says of harmonics (N, K, 3), and two images: labels, palette."""
    count = len(sh_rest)
    labels = _grouped(sh_rest.reshape(count, -1))
    entries = int(labels.max()) + 1
    table, centroids = _centroids(sh_rest, labels, entries)
    held = {
        "count": entries,
        "bands": math.isqrt(sh_rest.shape[1]),
        "codebook": table.tolist(),
        "files": ["shN_centroids.webp", "shN_labels.webp"],
    }
    pixels = np.column_stack([labels & 255, labels >> 8]).astype(np.uint8)
    return held, _image(size, pixels), centroids


def _tabulated(values: NDArray[Any]) -> tuple[NDArray[np.float32], NDArray[np.uint8]]:
    """Return a table of 256 values and the place of the nearest for each of `values`.

    Half of the table are equal steps from the least to the largest value, so that no value is off
    by more than half a step; the other half are quantiles of the values.
    """
    flat = np.sort(values, axis=None)
    half = TABLE // 2
    shares = np.linspace(0.0, 1.0, half)
    even = flat[0] + (float(flat[-1]) - float(flat[0])) * shares
    quantiles = flat[np.rint(shares * (len(flat) - 1)).astype(np.intp)]
    table = np.sort(np.concatenate([even, quantiles])).astype(np.float32)
    bounds = (table[1:].astype(np.float64) + table[:-1]) / 2.0
    return table, np.searchsorted(bounds, values).astype(np.uint8)


def _grouped(rows: NDArray[Any]) -> NDArray[np.int64]:
    """Return a group for each of N rows (N, D): similar rows share one. Numbers start at 0.

    All rows are one group first; every group is halved at its mean along the axis in which it
    varies most, again and again, until there are 65,536 or as many as half of the rows.
    """
    columns = np.ascontiguousarray(np.asarray(rows, np.float32).T)  # (D, N)
    labels = np.zeros(rows.shape[0], np.int64)
    for _ in range(min(LABEL_BITS, int(rows.shape[0]).bit_length() - 1)):
        axis, middle = _widest(columns, labels)
        above = columns[axis[labels], np.arange(len(labels))] > middle[labels]
        labels = np.unique(2 * labels + above, return_inverse=True)[1].reshape(-1)
    return labels


def _widest(
    columns: NDArray[np.float32], labels: NDArray[np.int64]
) -> tuple[NDArray[np.intp], NDArray[np.float64]]:
    """Return in which of D columns (D, N) each group varies most, and its mean there, (G,) each."""
    sizes = np.bincount(labels)
    groups = len(sizes)
    largest = np.full(groups, -1.0)
    axis, middle = np.zeros(groups, np.intp), np.zeros(groups)
    for index, column in enumerate(columns):
        with np.errstate(under="ignore"):
            mean = np.bincount(labels, column, groups) / sizes
            square = np.bincount(labels, np.square(column, dtype=np.float64), groups) / sizes
            variance = square - np.square(mean)
        wider = variance > largest
        largest[wider], axis[wider], middle[wider] = variance[wider], index, mean[wider]
    return axis, middle


def _centroids(
    sh_rest: NDArray[Any], labels: NDArray[np.int64], entries: int
) -> tuple[NDArray[np.float32], NDArray[np.uint8]]:
    """Return the table and the image of a palette: the mean harmonics of each group."""
    coefficients = sh_rest.shape[1]
    sizes = np.bincount(labels, minlength=entries)
    means = np.empty((entries, coefficients, 3))
    for k in range(coefficients):
        for channel in range(3):
            column = np.asarray(sh_rest[:, k, channel], np.float64)
            means[:, k, channel] = np.bincount(labels, column, entries) / sizes
    table, places = _tabulated(means)
    rows = -(-entries // ACROSS)
    image = np.zeros((rows * ACROSS, coefficients, 4), np.uint8)
    image[..., 3] = 255
    image[:entries, :, :3] = places
    return table, image.reshape(rows, ACROSS * coefficients, 4)
