"""Pictures of views before and after pruning, drawn on the processor: a truth beside the estimate.

How they are drawn is said in `drawing`. As files they are ``NAME-CAMERA-before.png`` and so on.
"""

from __future__ import annotations

import contextlib
import itertools
import re
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from .drawing import drawn
from .errors import RefineError
from .execute import Progress, part, silent
from .images import png
from .quality.psnr import psnr_of
from .rendering import NEAR_RELATIVE
from .splats import Splats
from .views import View, ViewSet
from .visibility import frustum, projection
from .whole_file import new_folder, refuse_existing, whole_file

LONGEST = 960
"""Pixels along the longer side of a picture, at most: views of more are drawn smaller."""

CAMERAS = 3
"""How many views are drawn at most, spread evenly over all."""

AMPLIFIED = 8
"""Factor by which the difference of two pictures is shown larger."""

KINDS = ("before", "after", "difference")
"""The three pictures of a view; each is the end of a file name."""

_IMAGE = re.compile(r"\.(png|jpe?g|webp|tiff?|exr|bmp)$", re.IGNORECASE)
"""The suffix of a photo, after which imported cameras are named."""

_LABEL = 80
"""Bytes of a camera's name that its files have: its end. Systems take names of 255 bytes."""


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


@dataclass(frozen=True)
class PictureFiles:
    """Where the pictures of one prune go.

    Attributes
    ----------
    folder : Path
        Made if it is not there.
    name : str
        Of the splats: the first part of the files' names.
    overwrite : bool
        Whether files may be replaced.
    """

    folder: Path
    name: str
    overwrite: bool = False

    @contextlib.contextmanager
    def opened(self, views: ViewSet) -> Iterator[None]:
        """Make the folder, and refuse what could not be written, before the work.

        Raises
        ------
        RefineError
            See `refine_addon.core.whole_file.new_folder` and `refuse_existing`.
        """
        with new_folder(self.folder):
            for paths in self._paths(views.spread(CAMERAS)):
                for path in paths.values():
                    refuse_existing(path, overwrite=self.overwrite)
            yield

    def write(
        self,
        before: Splats,
        after: Splats,
        views: ViewSet,
        *,
        progress: Progress = silent,
        threads: int | None = None,
    ) -> dict[str, Any]:
        """Draw `CAMERAS` of the views and write their pictures.

        Parameters
        ----------
        before, after, progress, threads
            See `compare`.
        views : ViewSet
            Those that decided.

        Returns
        -------
        dict
            What the report says: the mean PSNR that was measured, and of each view its camera, its
            size, its PSNR and its files.

        Raises
        ------
        RefineError
            If a file cannot be written; by then the prune is done.
        Cancelled
            If `progress` answers ``False``.
        """
        views = views.spread(CAMERAS)
        comparisons = compare(before, after, views, progress=progress, threads=threads)
        facts = []
        try:
            for made, files in zip(comparisons, self._paths(views), strict=True):
                for kind, path in files.items():
                    with whole_file(path, overwrite=self.overwrite) as stream:
                        stream.write(png(getattr(made, kind)))
                size, names = [made.view.width, made.view.height], {k: str(files[k]) for k in files}
                camera = {"camera": made.view.name, "size": size, "psnr": round(made.psnr, 2)}
                facts.append(camera | names)
        except RefineError as error:
            raise RefineError(f"{error}; the pruning itself is done") from error
        mean = sum(comparison.psnr for comparison in comparisons) / len(comparisons)
        return {"psnr": round(mean, 2), "amplified": AMPLIFIED, "views": facts}

    def _paths(self, views: ViewSet) -> list[dict[str, Path]]:
        """Files of each view, by `KINDS`."""
        return [
            {kind: self.folder / f"{_plain(self.name)}-{label}-{kind}.png" for kind in KINDS}
            for label in _labels([view.name for view in views])
        ]


def measured_in_words(facts: dict[str, Any]) -> str:
    """What was measured in pictures, as one sentence.

    >>> views = [{"psnr": 38.0}, {"psnr": 36.0}]
    >>> measured_in_words({"psnr": 37.0, "amplified": 8, "views": views})
    '37.0 dB measured in 2 views (36.0 to 38.0); differences are shown 8 times as large'
    """
    values = [view["psnr"] for view in facts["views"]]
    many = f"{len(values)} views ({min(values):.1f} to {max(values):.1f})"
    where = many if len(values) > 1 else "one view"
    return (
        f"{facts['psnr']:.1f} dB measured in {where}; differences are shown {facts['amplified']} "
        "times as large"
    )


def _labels(names: list[str]) -> list[str]:
    """A different part of a file name for each camera.

    >>> _labels(["left/0.png", "left/0.png", ""])
    ['left_0', 'left_0_2', 'view']
    """
    labels: list[str] = []
    for name in names:
        end = _plain(_IMAGE.sub("", name)).encode()[-_LABEL:].decode(errors="ignore") or "view"
        ends = itertools.chain([end], (f"{end}_{number}" for number in itertools.count(2)))
        labels.append(next(label for label in ends if label not in labels))
    return labels


def _plain(name: str) -> str:
    """A name with only what every system takes within the name of a file."""
    return re.sub(r"[^\w.() -]", "_", name)
