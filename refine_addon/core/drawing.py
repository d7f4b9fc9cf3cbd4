"""What a view sees of splats, drawn on the processor, also among other things.

Every pixel is computed as a ray is (`seeing.cast`): footprints by EWA splatting, blended front to
back, colours of the direction of view. Pictures agree with those of the reference renderer of the
benchmarks to 75 dB and more.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from . import spherical_harmonics
from .seeing import projection
from .seeing.cast import hits
from .seeing.ray_sample import colors_from
from .seeing.ray_sums import in_front
from .seeing.rays import LOG_OPAQUE
from .splats import SH_C0
from .views import ViewSet
from .work import Progress, for_chunks, part, silent

if TYPE_CHECKING:
    from typing import Any

    from numpy.typing import NDArray

    from .seeing.projection import Footprints
    from .seeing.scene import Scene
    from .splats import Splats
    from .views import View

_PIXELS = 1 << 15  # drawn at a time, about, which limits temporary memory
_PAIRS = 1 << 18  # pairs of footprint and pixel at a time


@dataclass(frozen=True, eq=False)
class Layer:
    """A picture of other things with a depth a pixel, such as meshes that splats stand among.

    A splat is in front of a pixel of it where its centre is nearer, else behind.

    Attributes
    ----------
    colors : (3, H, W) floating
        Display-referred, 0..1, times alpha.
    alphas : (H, W) floating
        How much it hides of what is behind, 0..1.
    depths : (H, W) floating
        Along the view's axis, world units.
    background : (3, H, W) floating, optional
        What it lets through of what is infinitely far away, display-referred.
    """

    colors: NDArray[Any]
    alphas: NDArray[Any]
    depths: NDArray[Any]
    background: NDArray[Any] | None = None


def draw(
    splats: Splats,
    view: View,
    layer: Layer | None = None,
    scene: Scene | None = None,
    *,
    progress: Progress = silent,
    threads: int | None = None,
) -> NDArray[np.float64]:
    """Return what a view sees of splats, and of a layer among them.

    Parameters
    ----------
    splats : Splats
        In the frame of the view.
    view : View
    layer : Layer, optional
        In the size of the view.
    scene : Scene, optional
        The frame to compute in; by default that of the splats and the view.
    progress : callable, optional
        ``progress(fraction, what)``; returning ``False`` cancels.
    threads : int, optional

    Returns
    -------
    (4, H, W) float64
        Display-referred red, green and blue, times alpha, and alpha, 0..1; the top row first. What
        shows of the background of the layer adds to the colours and not to alpha.

    Raises
    ------
    Cancelled
        If `progress` answers ``False``.
    """
    gaussians, scene, _ = projection.prepare(
        splats, ViewSet((view,)), scene, progress=part(progress, 0.0, 0.1), threads=threads
    )
    with np.errstate(under="ignore"):
        footprints = projection.project(gaussians, scene, view)
        colors = colors_from(splats, gaussians.index[footprints.index], view)
        depths = scene.size * projection.depths(gaussians, scene, view)[footprints.index]
    among = None if layer is None else (layer, depths)
    rest = part(progress, 0.1, 1.0)
    return picture(footprints, colors, view, among, progress=rest, threads=threads)


def seen_from(splats: Splats, center: NDArray[np.float64]) -> Splats:
    """Return the splats with the colours that they show to a place, the same in all directions.

    Parameters
    ----------
    splats : Splats
    center : (3,) float64
        In their frame.
    """
    if not splats.sh_degree:
        return splats
    with np.errstate(all="ignore"):  # of splats that cannot be drawn
        direction = splats.means.astype(np.float64) - center
        length = np.linalg.norm(direction, axis=1, keepdims=True)
        direction /= np.maximum(length, np.finfo(np.float64).tiny)
        colors = spherical_harmonics.colors(direction, splats.sh_dc, splats.sh_rest)
    return replace(splats.up_to_degree(0), sh_dc=(colors - 0.5) / SH_C0)


def picture(
    footprints: Footprints,
    colors: NDArray[np.float64],
    view: View,
    among: tuple[Layer, NDArray[Any]] | None = None,
    *,
    progress: Progress,
    threads: int | None,
) -> NDArray[np.float64]:
    """Return what `draw` does, of footprints.

    Parameters
    ----------
    footprints : Footprints
    colors : (3, n) float64
        Of the footprints.
    view : View
    among : (Layer, (n,) floating), optional
        A layer, and the depths of the footprints in world units.
    progress, threads
        See `draw`.
    """

    def work(piece: slice) -> NDArray[np.float64]:
        rows = np.arange(piece.start, piece.stop)
        cut = None if among is None else _Cut(*among, piece)
        with np.errstate(under="ignore"):
            strip = _strip(footprints, colors, np.arange(view.width), rows, cut)
        return strip.reshape(4, len(rows), view.width)

    rows = max(_PIXELS // view.width, 1)
    strips = for_chunks(work, view.height, rows, progress=progress, what="drawing", threads=threads)
    return np.concatenate(strips, axis=1).clip(0.0, 1.0)


class _Cut:
    """A layer between the splats of a strip of R rows, in P pixels."""

    def __init__(self, layer: Layer, depths: NDArray[Any], rows: slice) -> None:
        self._depths = depths  # (n,), of the footprints
        self._limits = layer.depths[rows].reshape(-1)  # (P,)
        self._left = 1.0 - layer.alphas[rows].reshape(-1).astype(np.float64)
        self._colors = layer.colors[:, rows].reshape(3, -1)
        back = layer.background
        self._background = None if back is None else back[:, rows].reshape(3, -1)
        self._log_front = np.zeros(len(self._left))  # transmittance of the splats in front of it

    def shows(self, footprint: NDArray[np.int64], pixel: NDArray[np.int32]) -> NDArray[np.bool_]:
        """Return which splats it does not hide, (p,)."""
        return (self._left.take(pixel) > 0.0) | self._in_front(footprint, pixel)

    def shares(
        self, footprint: NDArray[np.int64], pixel: NDArray[Any], alpha: NDArray[np.float32]
    ) -> NDArray[np.float64]:
        """Return how much of each hit it lets through, (h,), and note what is in front of it."""
        front = self._in_front(footprint, pixel)
        log_passed = np.where(front, np.log1p(-alpha), 0.0)
        self._log_front += np.bincount(pixel, log_passed, len(self._left))
        return np.where(front, 1.0, self._left.take(pixel))

    def insert(self, image: NDArray[np.float64], log_left: NDArray[np.float64]) -> None:
        """Add it to the picture of the splats, (4, P), whose transmittance is (P,)."""
        passed = np.exp(log_left)
        image[:3] += np.exp(self._log_front) * self._colors
        if self._background is not None:
            image[:3] += passed * self._background
        image[3] = 1.0 - passed * self._left

    def _in_front(self, footprint: NDArray[np.int64], pixel: NDArray[Any]) -> NDArray[np.bool_]:
        return np.asarray(self._depths.take(footprint) < self._limits.take(pixel))


def _strip(
    footprints: Footprints,
    colors: NDArray[np.float64],
    columns: NDArray[np.int64],
    rows: NDArray[np.int64],
    cut: _Cut | None = None,
) -> NDArray[np.float64]:
    """Return the pixels in C columns and R rows, ascending, as `draw` does, (4, R * C).

    Footprints come front to back, some at a time; pixels through which nothing more is seen are
    left out of those that follow. Their colours are (3, n) float64.
    """
    pixels = len(columns) * len(rows)
    log_left, image = np.zeros(pixels), np.zeros((4, pixels))  # logarithm of the transmittance

    def wanted(footprint: NDArray[np.int64], pixel: NDArray[np.int32]) -> NDArray[np.bool_]:
        unfinished = (log_left > LOG_OPAQUE).take(pixel)
        return unfinished if cut is None else unfinished & cut.shows(footprint, pixel)

    for owner, pixel, alpha in hits(footprints, columns, rows, _PAIRS, wanted):
        order = np.argsort(pixel.astype(np.min_scalar_type(pixels)), kind="stable")
        sorted_owner, sorted_pixel, sorted_alpha = owner[order], pixel[order], alpha[order]
        weight = _weights(sorted_pixel, sorted_alpha, log_left)
        if cut is not None:
            weight *= cut.shares(sorted_owner, sorted_pixel, sorted_alpha)
        for channel in range(3):
            light = weight * colors[channel].take(sorted_owner)
            image[channel] += np.bincount(sorted_pixel, light, pixels)
    image[3] = 1.0 - np.exp(log_left)
    if cut is not None:
        cut.insert(image, log_left)
    return image


def _weights(
    pixel: NDArray[Any], alpha: NDArray[np.float32], log_left: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Return the share of its pixel that each hit makes up, (h,), and darken what lies behind.

    Hits come pixel by pixel, ascending, and front to back in each. `log_left`, (P,), is the
    logarithm of the transmittance of each pixel in front of these hits; afterwards behind them.
    """
    if not len(pixel):
        return np.empty(0)
    log_passed = np.log1p(-alpha).astype(np.float64)
    first = np.flatnonzero(np.diff(pixel, prepend=-1))
    counts = np.diff(np.append(first, len(pixel)))
    log_front = in_front(log_passed, counts)
    log_front += np.repeat(log_left[pixel[first]], counts)
    last = first + counts - 1
    log_left[pixel[first]] = log_front[last] + log_passed[last]
    return np.where(log_front > LOG_OPAQUE, alpha * np.exp(log_front), 0.0)
