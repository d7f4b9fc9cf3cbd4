"""What engines have rendered, from files to layers: arrays alone, for any thread.

Layers are blended as splats are, in the colours that are shown, which only Blender makes of light.
So there are three steps: `Rendered.read`, Blender's view transform of `Light.pictures`,
`Light.layers`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
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


@dataclass
class Rendered:
    """What was rendered of a frame, in files of all passes.

    Attributes
    ----------
    far : float
        Depths from which on there is nothing.
    parts : list of (Path, Path)
        For each group of objects the file with its colours, and the one with its depths.
    world : Path or None
        What is behind all of them.
    """

    far: float
    parts: list[tuple[Path, Path]] = field(default_factory=list)
    world: Path | None = None

    def read(self) -> Light:
        """Read the files.

        Raises
        ------
        RefineError
            See `read_exr`.
        """
        found = []
        for colors, depths in self.parts:
            passes = _read(colors)
            combined, away = passes["Combined"], passes if depths == colors else _read(depths)
            alphas = combined[3].clip(0.0, 1.0)
            found.append(Pass(combined[:3], alphas, _known(away["Depth"][0], alphas, self.far)))
        return Light(found, _read(self.world)["Combined"][:3] if self.world else None)


class Light:
    """What was rendered, as light.

    Parameters
    ----------
    found : sequence of Pass
    world : (3, H, W) float32, optional

    Attributes
    ----------
    pictures : list of (3, H, W) float32
        What the view transform is to be applied to: each pass as if it were opaque, and all as
        they are seen without splats.
    """

    def __init__(self, found: Sequence[Pass], world: NDArray[np.float32] | None) -> None:
        self._found, self._world = found, world
        self._left = np.ones(())
        self.pictures = [each.colors / np.maximum(each.alphas, 1e-6) for each in found]
        if not found:
            self.pictures += [world] if world is not None else []
            return
        stacked = in_order(found)
        over, self._left = stacked.over_nothing(), stacked.left()[-1]
        if world is not None:
            over += self._left * world
        else:
            over /= np.maximum(1.0 - self._left, 1e-6)
        self.pictures.append(over.astype(np.float32))

    def layers(self, shown: Sequence[NDArray[np.float32]]) -> Layers | None:
        """Return layers by what `pictures` are shown as, None if there are none.

        Where there are no splats they show what Blender does: the background makes up for what
        blending shown colours does not.
        """
        if not shown:
            return None
        *opaque, whole = shown
        if not opaque:
            nothing = np.zeros((1, *whole.shape[1:]), np.float32)
            return Layers(np.zeros_like(whole)[None], nothing, nothing, whole)
        pairs = zip(opaque, self._found, strict=True)
        layers = in_order([each._replace(colors=each.alphas * colors) for colors, each in pairs])
        seen = 1.0 if self._world is not None else 1.0 - self._left
        return replace(layers, background=seen * whole - layers.over_nothing())


def _read(path: Path) -> dict[str, NDArray[np.float32]]:
    """Return the passes of a file, (channels, H, W) each, and remove it."""
    channels = read_exr(path)
    path.unlink()
    found: dict[str, NDArray[np.float32]] = {}
    for kind, letters in (("Combined", "RGBA"), ("Depth", "ZV")):
        rows = [
            values
            for letter in letters
            for channel, values in channels.items()
            if channel.endswith(f".{kind}.{letter}")
        ]
        found[kind] = np.stack(rows) if rows else np.empty((0, 0, 0), np.float32)
    return found


def _known(
    depths: NDArray[np.float32], alphas: NDArray[np.float32], far: float
) -> NDArray[np.float32]:
    """Return the depth of what is seen in each pixel, (H, W), 0 where it has none.

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
