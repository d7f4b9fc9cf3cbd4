"""Pictures of views before and after pruning, drawn on the processor: a truth beside the estimate.

How they are drawn is said in `drawing`.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from .drawing import drawn
from .execute import Progress, part, silent
from .quality.psnr import psnr_of
from .rendering import NEAR_RELATIVE
from .splats import Splats
from .views import View, ViewSet
from .visibility import frustum, projection

LONGEST = 960
"""Pixels along the longer side of a picture, at most: views of more are drawn smaller."""

CAMERAS = 3
"""How many views are drawn at most, spread evenly over all."""

AMPLIFIED = 8
"""Factor by which the difference of two pictures is shown larger."""


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
    pictures: list[list[NDArray[np.float64]]] = []
    for splats, start in ((before, 0.0), (after, 0.5)):
        gaussians, scene, _ = projection.prepare(
            splats, views, progress=part(progress, start, start + 0.1), threads=threads
        )
        if not pictures:
            views = ViewSet(tuple(_fitted(view, scene) for view in views))
        rest, share = part(progress, start + 0.1, start + 0.5), 1.0 / len(views)
        pictures.append([
            drawn(
                splats, gaussians, scene, view,
                progress=part(rest, k * share, (k + 1) * share), threads=threads,
            )[:3]
            for k, view in enumerate(views)
        ])  # fmt: skip
    return [
        Comparison(view, _rounded(one), _rounded(other), _psnr(other, one, view))
        for view, one, other in zip(views, *pictures, strict=True)
    ]


def fitted(view: View) -> View:
    """View of the same field of view, at most `LONGEST` pixels along its longer side.

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
    fx, cx = view.fx * across, view.cx * across
    fy, cy = view.fy * down, view.cy * down
    return replace(view, fx=fx, fy=fy, cx=cx, cy=cy, width=width, height=height)


def _fitted(view, scene):
    """A view in the size of its picture, with the near plane that scoring gives it.

    Otherwise a scene of fewer splats, whose size is another, would begin elsewhere.
    """
    near, far = frustum.clip_planes(view, NEAR_RELATIVE * scene.size)
    return replace(fitted(view), near=near if near < far else view.near)


def _rounded(picture):
    """A picture of 0..1, (3, H, W), in 8 bits, (H, W, 3)."""
    return np.ascontiguousarray(np.rint(picture * 255.0).astype(np.uint8).transpose(1, 2, 0))


def _psnr(after, before, view):
    return psnr_of(after.reshape(3, -1), before.reshape(3, -1), view)
