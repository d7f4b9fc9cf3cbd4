"""Pictures of views before and after pruning, drawn on the processor: a truth beside the estimate.

The rules are those of the lines of sight (`scoring.sight_lines`), for every pixel in place of a
few: footprints by EWA splatting, blended front to back, colours of the direction of view. They
agree with the reference renderer of the benchmarks to 75 dB and more.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import pairwise
from typing import TYPE_CHECKING

import numpy as np

from .rendering import ALPHA_MAX, NEAR_RELATIVE
from .seeing import frustum, projection
from .seeing.sight_lines import DARK, boxes, colors_from, mahalanobis, psnr_of, reaches
from .views import ViewSet
from .work import Progress, checkpoint, for_chunks, part, silent

if TYPE_CHECKING:
    from typing import Any

    from numpy.typing import NDArray

    from .scene import Scene
    from .seeing.projection import Footprints, Gaussians
    from .splats import Splats
    from .views import View

LONGEST = 960
"""Pixels along the longer side of a picture, at most: views of more are drawn smaller."""

CAMERAS = 3
"""How many views are drawn at most, spread evenly over all."""

AMPLIFIED = 8
"""The difference of two pictures is shown so many times as large."""

_PIXELS = 1 << 15  # about so many are drawn at a time, which limits temporary memory
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


def fitted(view: View, longest: int = LONGEST) -> View:
    """Return a view with the same sight and at most so many pixels along the longer side.

    Examples
    --------
    >>> from refine_addon.core.views import View
    >>> view = View(np.eye(3), np.zeros(3), 1000.0, 1000.0, 960.0, 540.0, 1920, 1080)
    >>> small = fitted(view)
    >>> small.width, small.height, small.fx, small.cy
    (960, 540, 500.0, 270.0)
    """
    scale = longest / max(view.width, view.height)
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
    found = []
    for number, view in enumerate(views):
        ahead = part(progress, number / len(views), (number + 1) / len(views))
        with np.errstate(under="ignore"):
            footprints = projection.project(gaussians, scene, view)
            colors = colors_from(splats, gaussians.index[footprints.index], view)
        found.append(_picture(footprints, colors, view, ahead, threads))
    return found


def _picture(
    footprints: Footprints,
    colors: NDArray[np.float64],
    view: View,
    progress: Progress,
    threads: int | None,
) -> NDArray[np.float64]:
    """Return a picture, (3, H, W), 0..1.

    Parameters
    ----------
    footprints : Footprints
        In the view.
    colors : (3, n) float64
        Of the footprints.
    view : View
    progress : callable
    threads : int, optional
    """

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
    """Return the colours of the pixels in C columns and R rows, (3, R * C).

    Footprints come front to back, some at a time; pixels through which nothing more is seen are
    left out of those that follow.

    Parameters
    ----------
    footprints : Footprints
    colors : (3, n) float64
    columns, rows : (C,), (R,) int64
        Ascending.
    """
    pixels = len(columns) * len(rows)
    through, image = np.zeros(pixels), np.zeros((3, pixels))  # logarithm of the transmittance
    reach = reaches(footprints.alphas)
    (left, wide), (top, tall) = (
        boxes(footprints, reach, axis, places) for axis, places in enumerate((columns, rows))
    )
    some = np.flatnonzero(wide * tall > 0)
    ends = np.cumsum((wide * tall)[some])
    cuts = np.searchsorted(ends, np.arange(0, ends[-1] if len(ends) else 0, _PAIRS)).tolist()
    for start, end in pairwise([*cuts, len(some)] if cuts else []):
        checkpoint()
        block = some[start:end]
        own, across, down = _within(block, left, wide, top, tall)
        line = down * len(columns) + across
        open_ = np.flatnonzero((through > DARK).take(line))
        own, line = own[open_], line[open_]
        squared = mahalanobis(footprints, own, columns.take(across[open_]), rows.take(down[open_]))
        met = np.flatnonzero(squared < reach.take(own))
        own, line = own[met], line[met]
        alpha = footprints.alphas.take(own) * np.exp(squared[met] / np.float32(-2.0))
        order = np.argsort(line.astype(np.min_scalar_type(pixels)), kind="stable")
        own, line = own[order], line[order]
        alpha = np.minimum(alpha[order], np.float32(ALPHA_MAX))
        weight = _weights(line, alpha, through)
        for channel in range(3):
            image[channel] += np.bincount(line, weight * colors[channel].take(own), pixels)
    return image


def _within(
    block: NDArray[np.int64],
    left: NDArray[np.int64],
    wide: NDArray[np.int64],
    top: NDArray[np.int64],
    tall: NDArray[np.int64],
) -> tuple[NDArray[Any], NDArray[Any], NDArray[Any]]:
    """Return the pairs of some footprints and the pixels in their boxes, (p,) each.

    Parameters
    ----------
    block : (b,) int64
        Which footprints.
    left, wide, top, tall : (n,) int64
        The boxes of all; see `sight_lines.boxes`.

    Returns
    -------
    own, across, down
        Which footprint, and the places of the pixel among columns and rows.
    """
    count = (wide * tall)[block]
    own = np.repeat(block, count)
    number = np.arange(len(own), dtype=np.int32)
    number -= np.repeat((np.cumsum(count) - count).astype(np.int32), count)
    down, across = np.divmod(number, np.repeat(wide[block].astype(np.int32), count))
    across += left.astype(np.int32).take(own)
    down += top.astype(np.int32).take(own)
    return own, across, down


def _weights(
    line: NDArray[Any], alpha: NDArray[np.float32], through: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Return what part of its pixel each hit makes up, (h,), and darken what lies behind.

    Parameters
    ----------
    line : (h,) integer
        The pixel, ascending; the hits of one are front to back.
    alpha : (h,) float32
    through : (P,) float64
        Logarithm of the transmittance of each pixel in front of these hits; afterwards behind them.
    """
    if not len(line):
        return np.empty(0)
    dark = np.log1p(-alpha)
    behind = np.cumsum(dark, dtype=np.float64)
    first = np.flatnonzero(np.diff(line, prepend=-1))
    last = np.append(first[1:], len(line)) - 1
    before = (behind - dark)[first]  # the sum over all pixels before each
    front = behind - dark
    front -= np.repeat(before - through[line[first]], last + 1 - first)
    through[line[first]] += behind[last] - before
    return np.where(front > DARK, alpha * np.exp(front), 0.0)


def _rounded(picture: NDArray[np.float64]) -> NDArray[np.uint8]:
    """Return a picture of 0..1, (3, H, W), in 8 bits, (H, W, 3)."""
    return np.ascontiguousarray(np.rint(picture * 255.0).astype(np.uint8).transpose(1, 2, 0))


def _psnr(seen: NDArray[np.float64], whole: NDArray[np.float64], view: View) -> float:
    return psnr_of(seen.reshape(3, -1), whole.reshape(3, -1), view)
