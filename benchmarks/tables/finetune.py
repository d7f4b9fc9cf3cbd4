"""What training on the photos wins back once splats are gone: the paper's fine-tuning table.

Adam on the photos of the scoring views, one photo an iteration, all of them in turn, in an order
drawn anew each time; measured on the held-out photos. Optimised is all that a splat has: mean, log
scales, rotation (as small turns), the opacity's logit, all harmonics; at the rates of the
reference implementation (Kerbl et al. 2023), for positions those of its last iterations, and by its
loss, ``0.8 L1 + 0.2 (1 - SSIM)``. Gradients are exact (`renderer/gradients.py`), in float64. No
splat is added, split or removed meanwhile.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter

from refine_addon.core.splats import Splats, drawable, opacity, rotation_matrices
from refine_addon.core.views import View, ViewSet

from ..renderer import rasterizer
from ..renderer.footprints import camera_of, gaussians
from ..renderer.gradients import HARMONICS, LOGIT, MEAN, SCALE, TURN, gradient
from .evaluate import Evaluator

ITERATIONS = 500
RATIOS = (0.7, 0.9)
METHODS = ("refine-distance", "occlusion", "merge", "refit")
"""Whose results are trained, by their names in `methods`."""
RATES = {"mean": 1.6e-6, "scale": 5e-3, "turn": 2e-3, "logit": 0.05, "dc": 2.5e-3, "rest": 1.25e-4}
"""Learning rates; that of the means in parts of the scene's extent. A quaternion's .001 is a turn
of .002."""
SSIM_SHARE = 0.2
_DECAY, _DECAY_SQUARES, _SMALLEST = 0.9, 0.999, 1e-15  # of Adam, as in the reference implementation
_C1, _C2 = 0.01**2, 0.03**2


@dataclass(frozen=True)
class Tuned:
    """What training won back for one method.

    - before, after: PSNR against the held-out photos, dB.
    """

    name: str
    ratio: float
    before: float
    after: float
    seconds: float


def tune(
    splats: Splats,
    views: ViewSet,
    photos: Mapping[str, NDArray[np.float64]],
    iterations: int = ITERATIONS,
) -> Splats:
    """Train splats on photos.

    - views: Those without a photo are left out.
    - photos, mapping of str to (H, W, 3) float64: Name of a view -> its photo, 0..1.

    - returned, Splats: Those that can be drawn, in float64.
    """
    now = splats.take(drawable(splats))
    usable = [view for view in views if view.name in photos]
    parameters = _Parameters(now)
    rates = _rates(parameters.values.shape[1], extent(views))
    mean, square = np.zeros_like(parameters.values), np.zeros_like(parameters.values)
    for number, view in zip(range(1, iterations + 1), _in_turn(usable), strict=False):
        slope = parameters.slope(view, photos[view.name])
        mean += (1.0 - _DECAY) * (slope - mean)
        square += (1.0 - _DECAY_SQUARES) * (slope * slope - square)
        spread = np.sqrt(square / (1.0 - _DECAY_SQUARES**number)) + _SMALLEST
        parameters.move(-rates / (1.0 - _DECAY**number) * mean / spread)
    return parameters.splats()


def extent(views: ViewSet) -> float:
    """Return 1.1 times the largest distance of a view from their mean, as the reference does."""
    centers = views.centers
    return 1.1 * float(np.max(np.linalg.norm(centers - centers.mean(axis=0), axis=1)))


def _in_turn(views: Sequence[View]) -> Iterator[View]:
    random = np.random.default_rng(0)
    while True:
        for index in random.permutation(len(views)):
            yield views[index]


def _rates(columns: int, length: float) -> NDArray[np.float64]:
    rates = np.full(columns, RATES["rest"])
    rates[MEAN:SCALE] = RATES["mean"] * length
    rates[SCALE:TURN] = RATES["scale"]
    rates[TURN:LOGIT] = RATES["turn"]
    rates[LOGIT] = RATES["logit"]
    rates[HARMONICS : HARMONICS + 3] = RATES["dc"]
    return rates


class _Parameters:
    """The parameters of splats as one matrix, (N, 10 + 3 K), whose turns are always 0."""

    def __init__(self, splats: Splats) -> None:
        harmonics = np.concatenate([splats.sh_dc[:, None, :], splats.sh_rest], axis=1)
        columns = [
            splats.means,
            splats.log_scales,
            np.zeros((len(splats), LOGIT - TURN)),
            splats.opacity_logits[:, None],
            harmonics.reshape(len(splats), -1),
        ]
        self.values = np.hstack(columns).astype(np.float64)
        quaternions = np.array(splats.quaternions, np.float64)
        quaternions[~quaternions.any(axis=1)] = [1.0, 0.0, 0.0, 0.0]
        self.quaternions = quaternions / np.linalg.norm(quaternions, axis=1, keepdims=True)

    def splats(self) -> Splats:
        """Return them as splats."""
        values, count = self.values, len(self.values)
        harmonics = values[:, HARMONICS:].reshape(count, -1, 3)
        return Splats(
            values[:, MEAN:SCALE],
            values[:, SCALE:TURN],
            self.quaternions,
            values[:, LOGIT],
            harmonics[:, 0],
            harmonics[:, 1:],
        )

    def slope(self, view: View, photo: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the gradient of the loss of one view, (N, 10 + 3 K)."""
        now = self.splats()
        scales = np.exp(now.log_scales)
        harmonics = self.values[:, HARMONICS:].reshape(len(scales), -1, 3)
        scene = gaussians(
            now.means, scales, now.quaternions, opacity(now.opacity_logits), harmonics
        )
        axes = rotation_matrices(now.quaternions) * scales[:, None, :]
        camera = camera_of(view)
        image = rasterizer.render(scene, camera)
        return gradient(scene, axes, camera, loss(image, photo)[1])

    def move(self, step: NDArray[np.float64]) -> None:
        """Add a step; turns go into the quaternions."""
        turns = step[:, TURN:LOGIT]
        self.values += step
        self.values[:, TURN:LOGIT] = 0.0
        self.quaternions = turned(self.quaternions, turns)


def turned(quaternions: NDArray[np.float64], turns: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return unit quaternions, (N, 4), after a small turn about the axes of the world, (N, 3)."""
    w, v = quaternions[:, :1], quaternions[:, 1:]
    half = 0.5 * turns
    scalar = w - np.sum(half * v, axis=1, keepdims=True)
    result = np.hstack([scalar, v + w * half + np.cross(half, v)])
    return result / np.linalg.norm(result, axis=1, keepdims=True)


def loss(
    image: NDArray[np.float64], photo: NDArray[np.float64]
) -> tuple[float, NDArray[np.float64]]:
    """Return 0.8 times the mean absolute difference plus 0.2 (1 - SSIM), and its gradient.

    - image, photo, (H, W, 3) float64

    - returned gradient, (H, W, 3) float64: By the pixels of `image`.
    """
    share, slope = _ssim(image, photo)
    difference = image - photo
    value = (1.0 - SSIM_SHARE) * float(np.mean(np.abs(difference))) + SSIM_SHARE * (1.0 - share)
    return value, (1.0 - SSIM_SHARE) * np.sign(difference) / image.size - SSIM_SHARE * slope


def _ssim(x: NDArray[np.float64], y: NDArray[np.float64]) -> tuple[float, NDArray[np.float64]]:
    """Return the mean SSIM (Wang et al. 2004, Eq. 13) and its gradient by x.

    With means m, variances v and covariance c in windows, ``S = a b / (d e)``,
    ``a = 2 mx my + C1``, ``b = 2 c + C2``, ``d = mx^2 + my^2 + C1``, ``e = vx + vy + C2``. The
    windows are symmetric and 0 beyond the border, so gradients by windowed values are windowed in
    turn.
    """
    mx, my = _windowed(x), _windowed(y)
    vx, vy = _windowed(x * x) - mx * mx, _windowed(y * y) - my * my
    a, b = 2.0 * mx * my + _C1, 2.0 * (_windowed(x * y) - mx * my) + _C2
    d, e = mx * mx + my * my + _C1, vx + vy + _C2
    s = a * b / (d * e)
    by_square = -s / e  # by the windowed x^2
    by_product = 2.0 * a / (d * e)  # by the windowed x y
    by_mean = 2.0 * my * b / (d * e) - 2.0 * mx * s / d - 2.0 * mx * by_square - my * by_product
    slope = _windowed(by_mean) + 2.0 * x * _windowed(by_square) + y * _windowed(by_product)
    return float(s.mean()), slope / s.size


def _windowed(values: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the means of Gaussian windows of 11 pixels, sigma 1.5, 0 beyond the border."""
    return np.asarray(gaussian_filter(values, (1.5, 1.5, 0.0), mode="constant", radius=(5, 5, 0)))


def measure(
    reduced: Callable[[str, float], Splats],
    names: Sequence[str],
    training: tuple[ViewSet, Mapping[str, NDArray[np.float64]]],
    evaluator: Evaluator,
    iterations: int = ITERATIONS,
) -> list[Tuned]:
    """Train what methods leave.

    - reduced: ``(name of a method, share removed) -> Splats``.
    - training: The views that train, and their photos by name.
    - evaluator: Of the held-out views, with their photos.

    - ValueError: if no held-out view has a photo.
    """
    rows = []
    for name in names:
        for ratio in RATIOS:
            left = reduced(name, ratio)
            start = time.perf_counter()
            done = tune(left, *training, iterations)
            seconds = time.perf_counter() - start
            before, after = (_photo_psnr(evaluator, splats) for splats in (left, done))
            rows.append(Tuned(name, ratio, before, after, seconds))
            print(f"  {name} {ratio:.0%}, tuned: {before:.2f} -> {after:.2f} dB", flush=True)
    return rows


def _photo_psnr(evaluator: Evaluator, splats: Splats) -> float:
    found = evaluator.evaluate(splats).pictures
    if found is None:
        raise ValueError("fine-tuning needs photos of held-out views, got none")
    return found.mean["psnr"]
