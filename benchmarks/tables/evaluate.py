"""How good the pictures of a pruned scene are.

Pictures are compared clipped to 0..1, as a screen shows them:

- PSNR in dB, the mean over views of each view's. Identical images count as 100 dB rather than
  infinity, so that one view in which nothing changed does not hide the others.
- SSIM (Wang et al. 2004: Gaussian window of sigma 1.5), 1 is identical.
- FLIP (Andersson et al. 2020), at its default 67 pixels per degree, 0 is identical. It needs the
  package ``flip-evaluator``; without it the others are still measured.

A folder of a scene holds ``point_cloud.ply``, ``cameras.json`` and, optionally, ``split.json``
(``{"train": [names], "test": [names]}``; without it every 8th view is held out) and
``images/NAME.png`` or ``.jpg``. The train views decide what goes.
"""

from __future__ import annotations

import importlib.util
import json
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from PIL import Image
from skimage.metrics import structural_similarity

from refine_addon.core.cameras.read import read_cameras
from refine_addon.core.errors import RefineError
from refine_addon.core.formats.ply import read_ply
from refine_addon.core.scores import Scores
from refine_addon.core.selection import Budget, select
from refine_addon.core.splats import Splats
from refine_addon.core.views import ViewSet

from ..renderer import rasterizer

PSNR_CAP = 100.0
"""What identical images count as, dB; for comparison, rounding to 8 bits alone makes 59 dB."""
METRICS = ("psnr", "ssim", "flip")
HELD_OUT = 8
"""Without a split, every 8th view is held out, the first among them."""
PICTURE_TYPES = (".png", ".jpg", ".jpeg", ".JPG")
FLIP_MISSING = "FLIP needs the package flip-evaluator: pip install flip-evaluator"


@dataclass(frozen=True, eq=False)
class Quality:
    """Each metric for each view; all of one length.

    - values, dict of str to (V,) float64: Metric ("psnr", "ssim", "flip") -> its value in every
      view.
    """

    names: tuple[str, ...]
    values: dict[str, NDArray[np.float64]]

    @property
    def mean(self) -> dict[str, float]:
        """Mean over the views of each metric."""
        return {metric: float(np.mean(values)) for metric, values in self.values.items()}


@dataclass(frozen=True, eq=False)
class Evaluation:
    """What `Evaluator.evaluate` measures."""

    renders: Quality
    pictures: Quality | None


class Evaluator:
    """Compares changed versions of one scene; the original is rendered once.

    - pictures, mapping of str to (H, W, 3) floating, optional: Name of a view -> its picture, 0..1.
    """

    def __init__(
        self,
        original: Splats,
        views: ViewSet,
        pictures: Mapping[str, NDArray[np.float64]] | None = None,
        *,
        metrics: Sequence[str] = METRICS[:2],
        near: float = 0.2,
    ) -> None:
        """Render the original from every view."""
        if "flip" in metrics and not flip_installed():
            raise ModuleNotFoundError(FLIP_MISSING)
        self.views = views
        self.metrics = tuple(metrics)
        self.near = near
        self.pictures = dict(pictures or {})
        for view in views:
            shape = self.pictures.get(view.name, np.empty((view.height, view.width, 3))).shape
            if shape != (view.height, view.width, 3):
                msg = f"picture of view {view.name!r} is {shape}, expected {view.width} columns, "
                msg += f"{view.height} rows, 3 channels"
                raise ValueError(msg)
        self.references = self._render(original)

    def evaluate(self, changed: Splats) -> Evaluation:
        """Compare pictures of `changed` with those of the original and with the real ones."""
        images = self._render(changed)
        names = tuple(view.name for view in self.views)
        pairs = [(n, image, self.pictures[n]) for n, image in images.items() if n in self.pictures]
        renders = [(n, images[n], self.references[n]) for n in names]
        return Evaluation(self._quality(renders), self._quality(pairs) if pairs else None)

    def psnr(self, splats: Splats, scores: Scores, ratios: Sequence[float]) -> tuple[float, ...]:
        """Return the mean PSNR, dB, against the original with each share removed by `scores`."""
        kept = (splats.take(select(scores, Budget(ratio=ratio))) for ratio in ratios)
        return tuple(float(self.evaluate(left).renders.mean["psnr"]) for left in kept)

    def _render(self, splats: Splats) -> dict[str, NDArray[np.float64]]:
        prepared = rasterizer.gaussians_of(splats)
        return {
            view.name: np.clip(rasterizer.render(prepared, view, near=self.near), 0.0, 1.0)
            for view in self.views
        }

    def _quality(
        self, pairs: Iterable[tuple[str, NDArray[np.float64], NDArray[np.float64]]]
    ) -> Quality:
        rows = [(name, compare(image, other, self.metrics)) for name, image, other in pairs]
        return Quality(
            tuple(name for name, _ in rows),
            {metric: np.array([row[metric] for _, row in rows]) for metric in self.metrics},
        )


def compare(
    image: NDArray[np.float64], reference: NDArray[np.float64], metrics: Sequence[str]
) -> dict[str, float]:
    """Compare two images.

    - image, reference, (H, W, 3) floating: 0..1, sRGB.

    Examples
    --------
    >>> black = np.zeros((16, 16, 3))
    >>> compare(black + 0.1, black, ["psnr"])["psnr"].__round__(6)
    20.0
    >>> compare(black, black, ["psnr", "ssim"])
    {'psnr': 100.0, 'ssim': 1.0}
    """
    measure = {"psnr": _psnr, "ssim": _ssim, "flip": _flip}
    return {metric: measure[metric](image, reference) for metric in metrics}


def flip_installed() -> bool:
    """Say whether FLIP can be measured here."""
    return importlib.util.find_spec("flip_evaluator") is not None


def _psnr(image: NDArray[np.float64], reference: NDArray[np.float64]) -> float:
    error = float(np.mean((image - reference) ** 2))
    return PSNR_CAP if error == 0.0 else min(PSNR_CAP, -10.0 * float(np.log10(error)))


def _ssim(image: NDArray[np.float64], reference: NDArray[np.float64]) -> float:
    return float(
        structural_similarity(
            image,
            reference,
            data_range=1.0,
            channel_axis=2,
            gaussian_weights=True,
            sigma=1.5,
            use_sample_covariance=False,
        )
    )


def _flip(image: NDArray[np.float64], reference: NDArray[np.float64]) -> float:
    import flip_evaluator

    arrays = (np.ascontiguousarray(a, np.float32) for a in (reference, image))
    return float(flip_evaluator.evaluate(*arrays, "LDR", applyMagma=False)[1])


@dataclass(frozen=True, eq=False)
class Scene:
    """A benchmark scene.

    - train, test: The views that decide, and those held out.
    - pictures, dict of str to (H, W, 3) float64: Name of a view -> its picture, 0..1; empty where
      there are none.
    """

    splats: Splats
    train: ViewSet
    test: ViewSet
    pictures: dict[str, NDArray[np.float64]]


def read_scene(folder: Path | str) -> Scene:
    """Read a folder as the module's docstring describes it."""
    folder = Path(folder)
    views = read_cameras(folder / "cameras.json")
    train, test = _split(folder / "split.json", [view.name for view in views])
    pictures = {}
    for name in [*train, *test]:
        files = [folder / "images" / f"{name}{suffix}" for suffix in PICTURE_TYPES]
        # Names may bring their own suffix.
        files.append(folder / "images" / name)
        found = next((file for file in files if file.is_file()), None)
        if found is not None:
            pictures[name] = np.asarray(Image.open(found).convert("RGB"), np.float64) / 255.0
    splats = read_ply(folder / "point_cloud.ply").splats()
    return Scene(splats, views.select(train), views.select(test), pictures)


def _split(file: Path, names: Sequence[str]) -> tuple[list[str], list[str]]:
    """Return the names of the train and of the test views."""
    if not file.exists():
        return [name for k, name in enumerate(names) if k % HELD_OUT], list(names[::HELD_OUT])
    try:
        split = json.loads(file.read_text(encoding="utf-8"))
        return split["train"], split["test"]
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise RefineError(
            f"{file}: expected lists of names 'train' and 'test' ({error!r})"
        ) from error
