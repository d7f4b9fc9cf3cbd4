"""What engines have rendered, from files to layers: arrays alone, for any thread.

Layers are blended as splats are, in the colours that are shown, which only Blender makes of light.
So there are three steps: `read`, Blender's view transform of `Light.pictures`, `Light.layers`.
"""

from __future__ import annotations

from collections.abc import Sequence
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


class Light:
    """What was rendered, as light.

    Parameters
    ----------
    passes : sequence of Pass
    world : (3, H, W) float32, optional
        What is behind all of them.

    Attributes
    ----------
    pictures : list of (3, H, W) float32
        What the view transform is to be applied to: each pass as if it were opaque, and all as
        they are seen without splats.
    """

    def __init__(self, passes: Sequence[Pass], world: NDArray[np.float32] | None) -> None:
        self._passes = passes
        self.pictures = [each.colors / np.maximum(each.alphas, 1e-6) for each in passes]
        if not passes:
            self.pictures += [] if world is None else [world]
            self._seen = np.ones(())
            return
        stacked = in_order(passes)
        over, left = stacked.over_nothing(), stacked.left()[-1]
        self._seen = 1.0 - left if world is None else np.ones(())
        over = over / np.maximum(self._seen, 1e-6) if world is None else over + left * world
        self.pictures.append(over.astype(np.float32))

    def layers(self, shown: Sequence[NDArray[np.float32]]) -> Layers | None:
        """Layers by what `pictures` are shown as, None if there are none.

        Where there are no splats they show what Blender does: the background makes up for what
        blending shown colours does not.
        """
        if not shown:
            return None
        *opaque, whole = shown
        pairs = zip(opaque, self._passes, strict=True)
        passes = [each._replace(colors=each.alphas * colors) for colors, each in pairs]
        nothing = np.zeros_like(whole[0])
        layers = in_order(passes or [Pass(np.zeros_like(whole), nothing, nothing)])
        return replace(layers, background=self._seen * whole - layers.over_nothing())


def read(files: Sequence[tuple[Path, Path]], world: Path | None, far: float) -> Light:
    """Read and remove files of what was rendered: colours and depths of each pass, and the world.

    Depths from `far` on are those of nothing.

    Raises
    ------
    RefineError
        See `read_exr`.
    """
    found = []
    for colors, depths in files:
        one = _read(colors)
        away = one.depths if depths == colors else _read(depths).depths
        found.append(one._replace(depths=_known(away, one.alphas, far)))
    return Light(found, _read(world).colors if world else None)


def _read(path: Path) -> Pass:
    """Colours, alphas and depths of a file, which is removed."""
    channels = {name.split(".", 1)[-1]: values for name, values in read_exr(path).items()}
    path.unlink()
    colors = np.stack([channels[f"Combined.{letter}"] for letter in "RGB"])
    depths = channels["Depth.Z"] if "Depth.Z" in channels else channels["Depth.V"]
    return Pass(colors, channels["Combined.A"].clip(0.0, 1.0), depths)


def _known(
    depths: NDArray[np.float32], alphas: NDArray[np.float32], far: float
) -> NDArray[np.float32]:
    """Depth of what is seen in each pixel, (H, W), 0 where it has none.

    Engines write that of one ray a pixel, which may miss what others hit: at an edge the nearest
    depth beside it is taken. What is seen and has no depth anywhere near is taken to be in front.
    """
    known = np.where(depths >= far, np.float32(np.inf), depths)
    for _ in range(_ROUNDS):
        padded = np.pad(known, 1, constant_values=np.inf)
        height, width = known.shape
        around = [padded[y : y + height, x : x + width] for y in range(3) for x in range(3)]
        known = np.where(np.isinf(known), np.minimum.reduce(around), known)
    return np.where(np.isinf(known) | (alphas <= 0.0), np.float32(0.0), known)
