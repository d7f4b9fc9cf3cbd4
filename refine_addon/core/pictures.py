"""Pictures of views before and after pruning, drawn on the processor: a truth beside the estimate.

Every pixel is computed as a ray is (`seeing.cast`): footprints by EWA splatting, blended front to
back, colours of the direction of view. Pictures agree with those of the reference renderer of the
benchmarks to 75 dB and more.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from .estimate.psnr import psnr_of
from .rendering import NEAR_RELATIVE
from .seeing import frustum, projection
from .seeing.cast import hits
from .seeing.ray_sample import colors_from
from .seeing.ray_sums import in_front
from .seeing.rays import LOG_OPAQUE
from .views import ViewSet
from .work import Progress, for_chunks, part, silent

if TYPE_CHECKING:
    from typing import Any

    from numpy.typing import NDArray

    from .seeing.projection import Footprints, Gaussians
    from .seeing.scene import Scene
    from .splats import Splats
    from .views import View

LONGEST = 960
"""Pixels along the longer side of a picture, at most: views of more are drawn smaller."""

CAMERAS = 3
"""How many views are drawn at most, spread evenly over all."""

AMPLIFIED = 8
"""Factor by which the difference of two pictures is shown larger."""

_PIXELS = 1 << 15  # drawn at a time, about, which limits temporary memory
_PAIRS = 1 << 18  # pairs of footprint and pixel at a time


@dataclass(frozen=True, eq=False)
class Comparison:
    """What a view sees of splats before and after a change.

    Attributes
    ----------
    view : View
        In the size of the pictures.
    before, after : (H, W, 3) uint8
        Display-referred, as splats are trained; the top row first.
    psnr : float
        Of the pictures before they were rounded to 8 bits, dB, at most `quality.PSNR_CAP`.
    """

    view: View
    before: NDArray[np.uint8]
    after: NDArray[np.uint8]
    psnr: float

    @property
    def difference(self) -> NDArray[np.uint8]:
        """The absolute difference, `AMPLIFIED`, (H, W, 3)."""
        apart = np.abs(self.after.astype(np.int64) - self.before)
        return np.asarray(np.minimum(apart * AMPLIFIED, 255), np.uint8)


def compare(
    before: Splats,
    after: Splats,
    views: ViewSet,
    *,
    progress: Progress = silent,
    threads: int | None = None,
) -> list[Comparison]:
    """Draw two states of a scene in each view.

    Parameters
    ----------
    before, after : Splats
        In the frame of the views.
    views : ViewSet
        One longer than `LONGEST` is drawn in that size.
    progress : callable, optional
        ``progress(fraction, what)``; returning ``False`` cancels.
    threads : int, optional

    Returns
    -------
    list of Comparison
        In the order of the views.

    Raises
    ------
    Cancelled
        If `progress` answers ``False``.
    """
    gaussians, scene, _ = projection.prepare(
        before, views, progress=part(progress, 0.0, 0.1), threads=threads
    )
    drawn = ViewSet(tuple(_drawn(view, scene) for view in views))
    first = _pictures(before, gaussians, scene, drawn, part(progress, 0.1, 0.5), threads)
    gaussians, scene, _ = projection.prepare(
        after, drawn, progress=part(progress, 0.5, 0.6), threads=threads
    )
    second = _pictures(after, gaussians, scene, drawn, part(progress, 0.6, 1.0), threads)
    return [
        Comparison(view, _rounded(one), _rounded(other), _psnr(other, one, view))
        for view, one, other in zip(drawn, first, second, strict=True)
    ]


def fitted(view: View) -> View:
    """Return a view of the same field of view, at most `LONGEST` pixels along its longer side.

    Examples
    --------
    >>> from refine_addon.core.views import View
    >>> view = View(np.eye(3), np.zeros(3), 1000.0, 1000.0, 960.0, 540.0, 1920, 1080)
    >>> small = fitted(view)
    >>> small.width, small.height, small.fx, small.cy
    (960, 540, 500.0, 270.0)
    """
    scale = LONGEST / max(view.width, view.height)
    if scale >= 1.0:
        return view
    width, height = (max(round(size * scale), 1) for size in (view.width, view.height))
    across, down = width / view.width, height / view.height
    return replace(
        view,
        fx=view.fx * across,
        fy=view.fy * down,
        cx=view.cx * across,
        cy=view.cy * down,
        width=width,
        height=height,
    )


def _drawn(view: View, scene: Scene) -> View:
    """Return a view in the size of its picture, with the near plane that scoring gives it.

    Otherwise a scene of fewer splats, whose size is another, would begin elsewhere.
    """
    near, far = frustum.clip_planes(view, NEAR_RELATIVE * scene.size)
    return replace(fitted(view), near=near if near < far else view.near)


def _pictures(
    splats: Splats,
    gaussians: Gaussians,
    scene: Scene,
    views: ViewSet,
    progress: Progress,
    threads: int | None,
) -> list[NDArray[np.float64]]:
    """Return the picture of each view, (3, H, W), 0..1."""
    pictures = []
    for number, view in enumerate(views):
        progress_of_view = part(progress, number / len(views), (number + 1) / len(views))
        with np.errstate(under="ignore"):
            footprints = projection.project(gaussians, scene, view)
            colors = colors_from(splats, gaussians.index[footprints.index], view)
        pictures.append(_picture(footprints, colors, view, progress_of_view, threads))
    return pictures


def _picture(
    footprints: Footprints,
    colors: NDArray[np.float64],
    view: View,
    progress: Progress,
    threads: int | None,
) -> NDArray[np.float64]:
    """Return a picture, (3, H, W), 0..1, of footprints of these colours, (3, n), in a view."""

    def work(piece: slice) -> NDArray[np.float64]:
        rows = np.arange(piece.start, piece.stop)
        with np.errstate(under="ignore"):
            strip = _strip(footprints, colors, np.arange(view.width), rows)
        return strip.reshape(3, len(rows), view.width)

    rows = max(_PIXELS // view.width, 1)
    strips = for_chunks(work, view.height, rows, progress=progress, what="drawing", threads=threads)
    return np.concatenate(strips, axis=1).clip(0.0, 1.0)


def _strip(
    footprints: Footprints,
    colors: NDArray[np.float64],
    columns: NDArray[np.int64],
    rows: NDArray[np.int64],
) -> NDArray[np.float64]:
    """Return the colours of the pixels in C columns and R rows, ascending, (3, R * C).

    Footprints come front to back, some at a time; pixels through which nothing more is seen are
    left out of those that follow. Their colours are (3, n) float64.
    """
    pixels = len(columns) * len(rows)
    log_left, image = np.zeros(pixels), np.zeros((3, pixels))  # logarithm of the transmittance

    def unfinished(pixel: NDArray[np.int32]) -> NDArray[np.bool_]:
        return np.asarray((log_left > LOG_OPAQUE).take(pixel))

    for owner, pixel, alpha in hits(footprints, columns, rows, _PAIRS, unfinished):
        order = np.argsort(pixel.astype(np.min_scalar_type(pixels)), kind="stable")
        sorted_owner, sorted_pixel = owner[order], pixel[order]
        weight = _weights(sorted_pixel, alpha[order], log_left)
        for channel in range(3):
            light = weight * colors[channel].take(sorted_owner)
            image[channel] += np.bincount(sorted_pixel, light, pixels)
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


def _rounded(picture: NDArray[np.float64]) -> NDArray[np.uint8]:
    """Return a picture of 0..1, (3, H, W), in 8 bits, (H, W, 3)."""
    return np.ascontiguousarray(np.rint(picture * 255.0).astype(np.uint8).transpose(1, 2, 0))


def _psnr(after: NDArray[np.float64], before: NDArray[np.float64], view: View) -> float:
    return psnr_of(after.reshape(3, -1), before.reshape(3, -1), view)
