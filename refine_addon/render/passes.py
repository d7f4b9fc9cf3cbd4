"""Rendered passes, from files to layers: arrays only, for any thread.
Layers blend as splats do, in shown colours; hence `read`, Blender's view transform, its layers."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..core.images import read_exr
from ..core.pictures import Layers, in_order

_ROUNDS = 2  # Pixels that known depths spread into edges without one


class Pass(NamedTuple):
    """Rendered together: colours times alpha, (3, H, W), alphas and depths, (H, W)."""

    colors: NDArray[np.float32]
    alphas: NDArray[np.float32]
    depths: NDArray[np.float32]


Blended = tuple[list[NDArray[np.float32]], Callable[[Sequence[NDArray[np.float32]]], Layers]]


def read(files: Sequence[tuple[Path, Path]], world: Path | None, far: float) -> Blended:
    """Read and remove files, (colours, depths) of each pass and of the world behind.
    The pictures, (3, H, W) float32, for the view transform, and a callable that makes layers of the
    transformed ones. Depths from `far` on hold nothing."""
    passes = []
    for colors, depths in files:
        one = _read(colors)
        away = one.depths if depths == colors else _read(depths).depths
        passes.append(one._replace(depths=_known(away, one.alphas, far)))
    return _blended(passes, _read(world).colors if world else None)


def _blended(passes: Sequence[Pass], world: NDArray[np.float32] | None) -> Blended:
    """Each pass as if opaque, and all blended without splats; see `read`."""
    nothing = np.zeros_like(passes[0].colors if passes else world)
    seen = [each for each in passes if each.alphas.any()]
    passes = seen or [Pass(nothing, nothing[0], nothing[0])]
    stacked = in_order(passes)
    over, left = stacked.over_nothing(), stacked.left()[-1]
    share = np.ones_like(left) if world is not None else 1.0 - left
    over = over / np.maximum(share, 1e-6) if world is None else over + left * world

    def layers(shown: Sequence[NDArray[np.float32]]) -> Layers:
        """Layers that look like Blender's without splats: the background corrects the blending."""
        pairs = zip(seen, shown, strict=False)
        opaque = [each._replace(colors=each.alphas * colors) for each, colors in pairs]
        layers = in_order(opaque or passes)
        return replace(layers, background=share * shown[-1] - layers.over_nothing())

    straight = [each.colors / np.maximum(each.alphas, 1e-6) for each in seen]
    return [*straight, over.astype(np.float32)], layers


def _read(path: Path) -> Pass:
    channels = {name.split(".", 1)[-1]: values for name, values in read_exr(path).items()}
    path.unlink()
    colors = np.stack([channels[f"Combined.{letter}"] for letter in "RGB"])
    depths = channels["Depth.Z"] if "Depth.Z" in channels else channels["Depth.V"]
    return Pass(colors, channels["Combined.A"].clip(0.0, 1.0), depths)


def _known(depths, alphas, far):
    """Depth of each pixel, (H, W), 0 where empty.
    Engines trace one ray, which may miss: edges take the nearest depth, others are in front."""
    known = np.where(depths >= far, np.float32(np.inf), depths)
    for _ in range(_ROUNDS):
        padded = np.pad(known, 1, constant_values=np.inf)
        around = np.lib.stride_tricks.sliding_window_view(padded, (3, 3)).min(axis=(2, 3))
        known = np.where(np.isinf(known), around, known)
    return np.where(np.isinf(known) | (alphas <= 0.0), np.float32(0.0), known)
