"""Pictures of splats, alone or among meshes, drawn on the processor; before and after as files.

Pixels are computed as rays are (`visibility.cast`): EWA footprints (Zwicker et al. 2001), blended
front to back, with colours by direction. They agree with the benchmarks' reference renderer to
75 dB and more.
"""

from __future__ import annotations

import contextlib
import itertools
import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from .errors import RefineError
from .execute import Progress, chunks, run_all, silent, stages
from .images import png
from .quality.psnr import psnr_of
from .splats import NEAR_RELATIVE, SH_C0, Splats
from .views import View, ViewSet
from .visibility import frustum, projection
from .visibility.cast import colors_from, hits
from .visibility.rays import LOG_OPAQUE, in_front
from .visibility.scene import Scene
from .whole_file import new_folder, refuse_existing, whole_file

LONGEST = 960  # pixels along the longer side of a picture, at most
CAMERAS = 3  # how many views are drawn at most, spread evenly over all
AMPLIFIED = 8  # factor by which differences are shown larger

KINDS = ("before", "after", "difference")
"""The three pictures of a view; each ends a file name: ``NAME-CAMERA-before.png``."""

_IMAGE = re.compile(r"\.(png|jpe?g|webp|tiff?|exr|bmp)$", re.IGNORECASE)
"""The suffix of a photo, after which imported cameras are named."""

_LABEL = 80  # bytes at the end of a camera's name used in file names; systems take 255 in all
_PIXELS = 1 << 15  # drawn at a time, about, which limits temporary memory
_PAIRS = 1 << 18  # pairs of footprint and pixel at a time


@dataclass(frozen=True, eq=False)
class Layers:
    """K pictures with a depth for each pixel, such as of meshes; splats with nearer centres are in
    front.
    """

    colors: NDArray[Any]  # (K, 3, H, W), display-referred, 0..1, premultiplied; top row first
    alphas: NDArray[Any]  # (K, H, W), 0..1
    depths: NDArray[Any]  # (K, H, W), along the view's axis, world units; ascending in K
    background: NDArray[Any] | None = None  # (3, H, W), infinitely far away, display-referred

    def left(self) -> NDArray[np.float64]:
        """Transmittance of the first 0 to K layers together, (K + 1, H, W)."""
        left = np.ones((len(self.alphas) + 1, *self.alphas.shape[1:]))
        np.cumprod(1.0 - self.alphas, axis=0, out=left[1:])
        return left

    def over_nothing(self) -> NDArray[np.float64]:
        """The layers blended, premultiplied and without the background, (3, H, W)."""
        return np.asarray(np.einsum("kchw,khw->chw", self.colors, self.left()[:-1]))


def in_order(layers: Sequence[tuple[NDArray[Any], NDArray[Any], NDArray[Any]]]) -> Layers:
    """Layers of (colours, alphas, depths), sorted by depth in each pixel; ties keep their order."""
    colors, alphas, depths = (np.stack(arrays) for arrays in zip(*layers, strict=True))
    order = np.argsort(depths, axis=0, kind="stable")
    alphas, depths = (np.take_along_axis(of_each, order, 0) for of_each in (alphas, depths))
    return Layers(np.take_along_axis(colors, order[:, None], 0), alphas, depths)


def draw(
    splats: Splats,
    view: View,
    layers: Layers | None = None,
    scene: Scene | None = None,
    *,
    progress: Progress = silent,
) -> NDArray[np.float64]:
    """Draw splats, and layers of the image's size among them, (4, H, W) of 0..1.

    Red, green and blue are display-referred and premultiplied; the layers' background does not add
    to alpha. `scene` is the frame to compute in, by default that of splats and view.
    """
    preparing, drawing = stages(progress, 0.1, 0.9)
    gaussians, scene, _ = projection.prepare(splats, ViewSet((view,)), scene, progress=preparing)
    return _drawn(splats, gaussians, scene, view, layers, drawing)


def seen_from(splats: Splats, center: NDArray[np.float64]) -> Splats:
    """Splats with the colours they show towards a point, (3,) in their frame, in all directions."""
    if not splats.sh_degree:
        return splats
    with np.errstate(all="ignore"):  # of splats that cannot be drawn
        colors = colors_from(splats, np.arange(len(splats)), center)
    return replace(splats.up_to_degree(0), sh_dc=(colors.T - 0.5) / SH_C0)


def _drawn(splats, gaussians, scene, view, layers, progress):
    """`draw` for splats prepared by `projection.prepare`."""
    with np.errstate(under="ignore"):
        footprints = projection.project(gaussians, scene, view)
        colors = colors_from(splats, gaussians.index[footprints.index], view.center)
        places = projection.coordinates(gaussians.means, scene, view)
        depths = scene.size * places[2, footprints.index]
    columns = np.arange(view.width)

    def work(piece: slice) -> NDArray[np.float64]:
        rows = np.arange(piece.start, piece.stop)
        cut = None if layers is None else _Cut(layers, depths, piece)
        pixels = len(columns) * len(rows)
        log_left, image = np.zeros(pixels), np.zeros((4, pixels))  # logarithm of the transmittance
        # Footprints come front to back, some at a time; in opaque pixels no more are computed.
        for owner, pixel, alpha in hits(footprints, columns, rows, _PAIRS, log_left, LOG_OPAQUE):
            order = np.argsort(pixel.astype(np.min_scalar_type(pixels)), kind="stable")
            owner, pixel, alpha = owner[order], pixel[order], alpha[order]
            shares = 1.0 if cut is None else cut.shares(owner, pixel, alpha)
            # Splats that layers hide take nothing from the background.
            weight = shares * _weights(pixel, alpha * (shares > 0.0), log_left)
            for channel in range(3):
                light = weight * colors[channel].take(owner)
                image[channel] += np.bincount(pixel, light, pixels)
        image[3] = 1.0 - np.exp(log_left)
        if cut is not None:
            cut.insert(image, log_left)
        return image.reshape(4, len(rows), view.width)

    pieces = chunks(view.height, max(_PIXELS // view.width, 1))
    strips = run_all(work, pieces, progress=progress, what="drawing")
    return np.concatenate(strips, axis=1).clip(0.0, 1.0)


class _Cut:
    """Layers among the splats in a strip of R rows, P pixels."""

    def __init__(self, layers, depths, rows):
        def flat(planes):
            return planes[..., rows, :].reshape(*planes.shape[:-2], -1)

        self._depths, self._limits = depths, flat(layers.depths)  # (n,) of footprints, (K, P)
        self._left, self._colors = flat(layers.left()), flat(layers.colors)  # (K + 1, P), (K, 3, P)
        self._background = None if layers.background is None else flat(layers.background)
        self._log_front = np.zeros(self._limits.shape)  # transmittance of splats in front of each

    def shares(self, footprint, pixel, alpha):
        """Transmittance of layers before each hit, (h,); adds the hits to what is before layers."""
        # Number of layers in front of each splat in its pixel.
        before = np.count_nonzero(self._depths[footprint] >= self._limits[:, pixel], axis=0)
        log_passed = np.log1p(-alpha)
        for layer, log_front in enumerate(self._log_front):
            log_front += np.bincount(pixel, log_passed * (before <= layer), len(log_front))
        return self._left[before, pixel]

    def insert(self, image, log_left):
        """Add the layers to the splats' picture, (4, P), of this transmittance, (P,)."""
        passed = np.exp(log_left)
        for layer, log_front in enumerate(self._log_front):
            image[:3] += self._left[layer] * np.exp(log_front) * self._colors[layer]
        if self._background is not None:
            image[:3] += passed * self._background
        image[3] = 1.0 - passed * self._left[-1]


def _weights(pixel, alpha, log_left):
    """Weight of each hit in its pixel, (h,); updates `log_left`, (P,), to that behind the hits."""
    # Hits come pixel by pixel, ascending, and front to back in each.
    log_passed = np.log1p(-alpha).astype(np.float64)
    first = np.flatnonzero(np.diff(pixel, prepend=-1))
    counts = np.diff(np.append(first, len(pixel)))
    log_front = in_front(log_passed, counts)
    log_front += np.repeat(log_left[pixel[first]], counts)
    last = first + counts - 1
    log_left[pixel[first]] = log_front[last] + log_passed[last]
    return np.where(log_front > LOG_OPAQUE, alpha * np.exp(log_front), 0.0)


class Comparison(NamedTuple):
    """Pictures of a view before and after a change."""

    view: View  # in the size of the pictures
    before: NDArray[np.uint8]  # (H, W, 3), display-referred, top row first
    after: NDArray[np.uint8]
    psnr: float  # dB, before rounding to 8 bits, at most `PSNR_CAP`

    @property
    def difference(self) -> NDArray[np.uint8]:
        """The absolute difference, `AMPLIFIED`, (H, W, 3)."""
        apart = np.abs(self.after.astype(np.int64) - self.before)
        return np.asarray(np.minimum(apart * AMPLIFIED, 255), np.uint8)


def compare(
    before: Splats, after: Splats, views: ViewSet, *, progress: Progress = silent
) -> list[Comparison]:
    """Draw two states of a scene in each view, at most `LONGEST` pixels long; see `draw`."""
    pictures: list[list[NDArray[np.float64]]] = []
    for splats, half in zip((before, after), stages(progress, 1.0, 1.0), strict=True):
        preparing, *rest = stages(half, 0.2, *[0.8 / len(views)] * len(views))
        gaussians, scene, _ = projection.prepare(splats, views, progress=preparing)
        if not pictures:
            views = ViewSet(tuple(fitted(view, scene.size) for view in views))
        pictures.append([
            _drawn(splats, gaussians, scene, view, None, each)[:3]
            for view, each in zip(views, rest, strict=True)
        ])  # fmt: skip
    return [
        Comparison(view, _rounded(one), _rounded(other), psnr_of(other, one, view))
        for view, one, other in zip(views, *pictures, strict=True)
    ]


def fitted(view: View, scene_size: float) -> View:
    """View of the same field of view, at most `LONGEST` pixels along its longer side.

    It has the near plane of scoring in a scene of this size: fewer splats would move it.
    """
    scale = min(LONGEST / max(view.width, view.height), 1.0)
    width, height = (max(round(size * scale), 1) for size in (view.width, view.height))
    across, down = width / view.width, height / view.height
    fx, cx = view.fx * across, view.cx * across
    fy, cy = view.fy * down, view.cy * down
    near, far = frustum.clip_planes(view, NEAR_RELATIVE * scene_size)
    near = near if near < far else view.near
    return replace(view, fx=fx, fy=fy, cx=cx, cy=cy, width=width, height=height, near=near)


def _rounded(picture):
    """A picture (3, H, W) of 0..1 as (H, W, 3) uint8."""
    return np.ascontiguousarray(np.rint(picture * 255.0).astype(np.uint8).transpose(1, 2, 0))


class PictureFiles(NamedTuple):
    """Folder for the pictures of a prune; file names begin with `name`, that of the splats."""

    folder: Path
    name: str
    overwrite: bool = False

    @contextlib.contextmanager
    def opened(self, views: ViewSet) -> Iterator[None]:
        """Make the folder, and raise `RefineError` for files that could not be written."""
        with new_folder(self.folder):
            for paths in self._paths(views.spread(CAMERAS)):
                for path in paths.values():
                    refuse_existing(path, overwrite=self.overwrite)
            yield

    def write(
        self, before: Splats, after: Splats, views: ViewSet, *, progress: Progress = silent
    ) -> dict[str, Any]:
        """Draw and write `CAMERAS` of the views; returns PSNRs in dB and files for the report."""
        views = views.spread(CAMERAS)
        comparisons = compare(before, after, views, progress=progress)
        entries = []
        try:
            for pair, files in zip(comparisons, self._paths(views), strict=True):
                for kind, path in files.items():
                    with whole_file(path, overwrite=self.overwrite) as stream:
                        stream.write(png(getattr(pair, kind)))
                size, names = [pair.view.width, pair.view.height], {k: str(files[k]) for k in files}
                camera = {"camera": pair.view.name, "size": size, "psnr": round(pair.psnr, 2)}
                entries.append(camera | names)
        except RefineError as error:
            raise RefineError(f"{error}; the pruning itself is done") from error
        mean = sum(comparison.psnr for comparison in comparisons) / len(comparisons)
        return {"psnr": round(mean, 2), "amplified": AMPLIFIED, "views": entries}

    def _paths(self, views: ViewSet) -> list[dict[str, Path]]:
        return [
            {kind: self.folder / f"{_plain(self.name)}-{label}-{kind}.png" for kind in KINDS}
            for label in _labels([view.name for view in views])
        ]


def measured_in_words(report: dict[str, Any]) -> str:
    """Sentence on the PSNR of pictures, from what `PictureFiles.write` returned.

    >>> views = [{"psnr": 38.0}, {"psnr": 36.0}]
    >>> measured_in_words({"psnr": 37.0, "amplified": 8, "views": views})
    '37.0 dB measured in 2 views (36.0 to 38.0); differences are shown 8 times as large'
    """
    values = [view["psnr"] for view in report["views"]]
    many = f"{len(values)} views ({min(values):.1f} to {max(values):.1f})"
    where = many if len(values) > 1 else "one view"
    return (
        f"{report['psnr']:.1f} dB measured in {where}; differences are shown {report['amplified']} "
        "times as large"
    )


def _labels(names: list[str]) -> list[str]:
    """Part of a file name for each camera, different for each.

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
    """Name with only characters that every system takes in a file name."""
    return re.sub(r"[^\w.() -]", "_", name)
