"""RAP (CVPR 2026, arXiv 2602.19753): a small network scores splats, without cameras or pictures.

It sees 15 features of a splat, most of them told relative to its 128 nearest neighbours. This is
code of our own after the description of the method; the trained weights are its authors' and come
with no licence, so they are no part of this project: `score` is given the path of the file.
"""

from __future__ import annotations

import io
import math
import pickle
import zipfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from refine_addon.core import spherical_harmonics
from refine_addon.core.errors import RefineError
from refine_addon.core.splats import SH_C0, Splats, base_color, opacity

FEATURES = 15
NEIGHBOURS = 128
DIRECTIONS = 60
"""Directions from which the colour of a splat is looked at, on a Fibonacci sphere."""

TAILS = (1.0, 99.0)
"""Percentiles that a feature is clipped to."""

_SMALLEST = 1e-12  # in place of 0 under a logarithm and a fraction
_CHUNK = 1 << 13

Layers = list[tuple["NDArray[np.float64]", "NDArray[np.float64]"]]


def score(splats: Splats, weights: Path) -> NDArray[np.float64]:
    """Score splats by a trained network, (N,) float64; higher stays.

    - RefineError: if `weights` is no such file.
    """
    values = features(splats)
    layers = read_weights(weights)
    for index, (matrix, bias) in enumerate(layers):
        values = values @ matrix.T + bias
        if index < len(layers) - 1:
            values = np.maximum(values, 0.0)
    return np.asarray(values[:, 0] - values[:, 1])


def features(splats: Splats) -> NDArray[np.float64]:
    """Return the features, (N, 15) float64, each in 0..1.

    In order: distance to the neighbours, spread of the colour over directions, the three scales
    (first all local, then all global), volume and opacity, each relative to the neighbours and as
    the logarithm relative to all; last, the constant colour relative to the neighbours.
    """
    near, distance = neighbours(splats.means)
    scales = np.exp(np.sort(np.asarray(splats.log_scales, np.float64), axis=1))
    groups = [
        distance[:, None],
        color_spread(splats)[:, None],
        scales,
        np.prod(scales, axis=1)[:, None],
        opacity(splats.opacity_logits)[:, None],
    ]
    columns = []
    for group in groups:
        columns += [_local(group, near), _global(group)]
    color = _local(base_color(splats.sh_dc), near)
    columns.append(np.mean(color, axis=1, keepdims=True))
    values = np.hstack(columns)
    low, high = np.percentile(values, TAILS, axis=0)
    return np.asarray((np.clip(values, low, high) - low) / np.maximum(high - low, _SMALLEST))


def neighbours(means: NDArray[Any]) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    """Return the nearest neighbours of each splat, (N, k), and the mean distance to them, (N,).

    k is 128, or all others where there are fewer.
    """
    points = np.asarray(means, np.float64)
    count = min(NEIGHBOURS, len(points) - 1)
    distances, near = cKDTree(points).query(points, count + 1)
    # The first of each is the splat itself, or one in the very same place.
    return near[:, 1:], np.mean(distances[:, 1:], axis=1)


def color_spread(splats: Splats) -> NDArray[np.float64]:
    """Return the standard deviation of the colour over directions, mean of the channels, (N,)."""
    basis = spherical_harmonics.basis(fibonacci(DIRECTIONS), splats.sh_degree)[:, 1:]
    spread = np.empty(len(splats))
    for piece in _pieces(len(splats)):
        constant = SH_C0 * np.asarray(splats.sh_dc[piece], np.float64) + 0.5
        rest = np.asarray(splats.sh_rest[piece], np.float64)
        color = constant[:, None, :] + np.einsum("dk,nkc->ndc", basis, rest)  # (n, directions, 3)
        spread[piece] = np.mean(np.std(np.clip(color, 0.0, 1.0), axis=1), axis=1)
    return spread


def fibonacci(count: int) -> NDArray[np.float64]:
    """Return evenly spread directions, (count, 3)."""
    place = np.arange(count) + 0.5
    up = 1.0 - 2.0 * place / count
    around = place * math.pi * (3.0 - math.sqrt(5.0))
    radius = np.sqrt(1.0 - up * up)
    return np.stack([radius * np.cos(around), radius * np.sin(around), up], axis=1)


def _local(values: NDArray[np.float64], near: NDArray[np.int64]) -> NDArray[np.float64]:
    """Return by how many standard deviations of its neighbours each splat exceeds their mean."""
    relative = np.empty(values.shape)
    for piece in _pieces(len(values)):
        around = values[near[piece]]  # (n, k, columns)
        spread = np.maximum(np.std(around, axis=1), _SMALLEST)
        relative[piece] = (values[piece] - np.mean(around, axis=1)) / spread
    return relative


def _global(values: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return by how many standard deviations each logarithm exceeds the mean of all."""
    logs = np.log(np.maximum(values, _SMALLEST))
    return (logs - np.mean(logs, axis=0)) / np.maximum(np.std(logs, axis=0), _SMALLEST)


def _pieces(count: int) -> Iterator[slice]:
    return (slice(start, start + _CHUNK) for start in range(0, count, _CHUNK))


def read_weights(path: Path) -> Layers:
    """Return weight (out, in) and bias (out,) of every layer of a network that PyTorch saved.

    The file is a zip: a pickle names the tensors, and each lies in a member of its own. Of what a
    pickle can call, only what rebuilds tensors is allowed, and that by functions of our own.

    - RefineError: if the file is not that, or not a network from 15 features to 2 outputs.
    """
    try:
        with zipfile.ZipFile(path) as archive:
            pickled = next(name for name in archive.namelist() if name.endswith("/data.pkl"))
            reader = _Tensors(archive, pickled.removesuffix("data.pkl"))
            tensors = list(reader.load().values())
    except (OSError, zipfile.BadZipFile, pickle.UnpicklingError, StopIteration) as error:
        raise RefineError(f"{path}: expected weights that PyTorch saved ({error!r})") from error
    layers = list(zip(tensors[::2], tensors[1::2], strict=False))
    widths = [FEATURES, *(len(bias) for _, bias in layers)]
    fitting = [
        matrix.shape == (out, width)
        for (matrix, _), width, out in zip(layers, widths, widths[1:], strict=False)
    ]
    if not layers or not all(fitting) or widths[-1] != 2 or len(tensors) % 2:
        msg = f"{path}: expected layers from {FEATURES} features to 2 outputs, got tensors of "
        msg += f"shapes {[tensor.shape for tensor in tensors]}"
        raise RefineError(msg)
    return layers


class _Tensors(pickle.Unpickler):
    """Reads tensors of float32 as arrays."""

    def __init__(self, archive: zipfile.ZipFile, folder: str) -> None:
        super().__init__(io.BytesIO(archive.read(f"{folder}data.pkl")))
        self._archive, self._folder = archive, folder

    def find_class(self, module: str, name: str) -> Any:
        """Return what stands for a name in the pickle."""
        known: dict[tuple[str, str], Any] = {
            ("collections", "OrderedDict"): _Dictionary,
            ("torch._utils", "_rebuild_tensor_v2"): _array,
            ("torch", "FloatStorage"): np.dtype("<f4"),
        }
        if (module, name) not in known:
            raise pickle.UnpicklingError(f"{module}.{name} is not allowed")
        return known[module, name]

    def persistent_load(self, pid: Any) -> NDArray[np.float32]:
        """Return the numbers of one tensor."""
        _, dtype, member, *_ = pid
        return np.frombuffer(self._archive.read(f"{self._folder}data/{member}"), dtype)


class _Dictionary(dict[str, Any]):
    """A dictionary that may get attributes, as PyTorch's have."""


def _array(
    storage: NDArray[np.float32], offset: int, shape: tuple[int, ...], *_: object
) -> NDArray[np.float64]:
    return storage[offset : offset + math.prod(shape)].reshape(shape).astype(np.float64)
