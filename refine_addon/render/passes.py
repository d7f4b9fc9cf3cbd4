"""What engines have rendered, from files to layers: arrays alone, for any thread.

Layers are blended as splats are, in the colours that are shown, which only Blender makes of light.
So there are three steps: `read`, Blender's view transform of its pictures, its layers.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..core.images import read_exr
from ..core.pictures import Layers, in_order

_ROUNDS = 2
"""Pixels by which known depths are spread to pixels at edges without one."""


class Pass(NamedTuple):
    """What was rendered together: colours times alpha, (3, H, W), alphas and depths, (H, W)."""

    colors: NDArray[np.float32]
    alphas: NDArray[np.float32]
    depths: NDArray[np.float32]


Blended = tuple[list[NDArray[np.float32]], Callable[[Sequence[NDArray[np.float32]]], Layers]]


def read(files: Sequence[tuple[Path, Path]], world: Path | None, far: float) -> Blended:
    """Read and remove files of what was rendered.

    Parameters
    ----------
    files : sequence of (Path, Path)
        Colours and depths of each pass.
    world : Path or None
        What is behind all of them.
    far : float
        Depths from which on there is nothing.

    Returns
    -------
    pictures : list of (3, H, W) float32
        What the view transform is to be applied to.
    layers : callable
        Gives layers by what these are shown as.

    Raises
    ------
    RefineError
        See `read_exr`.
    """
    passes = []
    for colors, depths in files:
        one = _read(colors)
        away = one.depths if depths == colors else _read(depths).depths
        passes.append(one._replace(depths=_known(away, one.alphas, far)))
    return _blended(passes, _read(world).colors if world else None)


def _blended(passes: Sequence[Pass], world: NDArray[np.float32] | None) -> Blended:
    """Each pass as if it were opaque, and all as they are seen without splats; see `read`."""
    nothing = np.zeros_like(passes[0].colors if passes else world)
    seen = [each for each in passes if each.alphas.any()]
    passes = seen or [Pass(nothing, nothing[0], nothing[0])]
    stacked = in_order(passes)
    over, left = stacked.over_nothing(), stacked.left()[-1]
    share = np.ones_like(left) if world is not None else 1.0 - left
    over = over / np.maximum(share, 1e-6) if world is None else over + left * world

    def layers(shown: Sequence[NDArray[np.float32]]) -> Layers:
        """Where there are no splats they show what Blender does.

        The background makes up for what blending shown colours does not.
        """
        pairs = zip(seen, shown, strict=False)
        opaque = [each._replace(colors=each.alphas * colors) for each, colors in pairs]
        layers = in_order(opaque or passes)
        return replace(layers, background=share * shown[-1] - layers.over_nothing())

    straight = [each.colors / np.maximum(each.alphas, 1e-6) for each in seen]
    return [*straight, over.astype(np.float32)], layers


def _read(path: Path) -> Pass:
    """Colours, alphas and depths of a file, which is removed."""
    channels = {name.split(".", 1)[-1]: values for name, values in read_exr(path).items()}
    path.unlink()
    colors = np.stack([channels[f"Combined.{letter}"] for letter in "RGB"])
    depths = channels["Depth.Z"] if "Depth.Z" in channels else channels["Depth.V"]
    return Pass(colors, channels["Combined.A"].clip(0.0, 1.0), depths)


def _known(depths, alphas, far):
    """Depth of what is seen in each pixel, (H, W), 0 where it has none.

    Engines write that of one ray a pixel, which may miss what others hit: at an edge the nearest
    depth beside it is taken. What is seen and has no depth anywhere near is taken to be in front.
    """
    known = np.where(depths >= far, np.float32(np.inf), depths)
    for _ in range(_ROUNDS):
        padded = np.pad(known, 1, constant_values=np.inf)
        around = np.lib.stride_tricks.sliding_window_view(padded, (3, 3)).min(axis=(2, 3))
        known = np.where(np.isinf(known), around, known)
    return np.where(np.isinf(known) | (alphas <= 0.0), np.float32(0.0), known)
