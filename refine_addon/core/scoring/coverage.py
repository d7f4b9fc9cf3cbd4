"""The floor of occlusion scores: what a splat may be worth to views that were not given.

What no given view shows may be plain to see from others. So each score gets a floor: the closed
form, which ignores occlusion, less where more views hold the splat, times a weight. Each of
`SHARES` has its weight, chosen by cross-validation: an eighth of the views is left out, the others
score with each of `FLOOR_WEIGHTS`. The weight with which the eighth loses least is the best.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence

import numpy as np
from numpy.typing import NDArray

from ..visibility.projection import Gaussians
from ..visibility.scene import MIX, fingerprint

FLOOR_WEIGHTS = (0.0, *(float(weight) for weight in 10.0 ** np.arange(-5.0, 0.5, 0.5)))
"""Weights tried. At 1, a splat in no view, of mean prior, gets the mean score as its floor."""

SHARES = (0.1, 0.3, 0.5, 0.7, 0.9)
"""Shares removed, each with the weight that loses least there."""

LEAST_FLOOR_WEIGHTS = (0.0, 0.0, 0.03, 0.03, 0.03)
"""Least weight for each of `SHARES`, as views left out resemble those given: it costs tenths of a
dB on such views, and gains up to 20 dB on others."""

SAMPLE = 1 << 16
"""Splats that are enough to choose the floor's weights."""

TIED = 0.002
"""A weight whose loss is this much above the least counts 1 / e in the mean of logarithms."""

DOUBTS = (0.03, 0.03, 0.0, 0.0, 0.0)
"""What a tenfold weight must gain in a loss (`_losses`), by `SHARES`, since losses are noisy."""

_NO_WEIGHT = 10.0**-5.5  # stands for 0 in a mean of logarithms


def floor(prior: NDArray[np.float64], seen: NDArray[np.int32], power: float) -> NDArray[np.float64]:
    """Worth of each splat to views not given, (n,), of mean 1 if `seen` is 0 (docs/method.md, 6).

    If none of `seen` views that hold the centre shows it, the next does with probability
    ``1 / (1 + seen)``, by the rule of succession. `prior` is the closed form without frustum test
    and neighbourhoods, `power` is 1 + p for scores ``error contribution^p``.
    """
    return np.asarray(_unit(prior**power) / (1.0 + seen))


def _with_floor(scores, floors, weight):
    """``scores / mean(scores) + weight floors``, (n,)."""
    return _unit(scores) + weight * floors


def floor_weights(
    folds: Iterable[tuple[NDArray[np.float64], ...]],
    whole: tuple[NDArray[np.float64], NDArray[np.float64]],
) -> tuple[list[float], float]:
    """Best weight of the floor for each of `SHARES`, and what views lose more if left out, dB.

    Weights are 1 and the loss is 0 if no view left out has an error. A fold is scores and floors,
    (n,), by the views that stay, and errors in the others, (views, n); `whole` are scores and
    floors by all. The loss is the mean from a half removed, at these weights.
    """
    losses, left_out = [], []
    for scores, floors, errors in folds:
        views = errors[errors.any(axis=1)]  # (v, n)
        if scores.any() and len(views):
            tried = [
                _losses(_with_floor(scores, floors, weight), views) for weight in FLOOR_WEIGHTS
            ]
            losses.append(np.stack(tried, axis=1))  # (v, weights, shares)
            left_out.append(views)
    if not losses:
        return [1.0] * len(SHARES), 0.0
    table = np.mean(np.concatenate(losses), axis=0)  # (weights, shares)
    least = table.min(axis=0)
    logs = np.log(np.maximum(FLOOR_WEIGHTS, _NO_WEIGHT))  # (weights,)
    table += np.outer(logs / math.log(10.0), DOUBTS)
    nearly = np.exp(np.maximum((table.min(axis=0) - table) / TIED, -50.0))  # 1 for the best
    best = np.exp(logs @ nearly / nearly.sum(axis=0))  # (shares,)
    weights = [max(pair) for pair in zip(best.tolist(), LEAST_FLOOR_WEIGHTS, strict=True)]
    errors, more = np.concatenate(left_out), []
    for number in range(SHARES.index(0.5), len(SHARES)):
        losing = _losses(_with_floor(*whole, weights[number]), errors)[:, number]
        more.append(least[number] - np.mean(losing))
    return weights, float(np.mean(more)) * 10.0 / math.log(10.0)


def sample(gaussians: Gaussians, count: int = SAMPLE) -> NDArray[np.int64]:
    """Ascending rows of at most `count` splats, by a hash that neither order nor frame changes."""
    total = len(gaussians)
    if total <= count:
        return np.arange(total)
    key = fingerprint(np.asarray(gaussians.alphas), *np.asarray(gaussians.colors).T)  # (N,)
    # The lower half depends on the row, so equal splats are taken evenly from the whole scene.
    order = np.arange(total, dtype=np.uint64) * MIX
    key = key >> np.uint64(32) << np.uint64(32) | order >> np.uint64(32)
    return np.sort(np.argpartition(key, count)[:count])


def order(
    scores: NDArray[np.float64],
    floors: NDArray[np.float64],
    ties: NDArray[np.float32],
    floor_weights: Sequence[float],
    stops: NDArray[np.int64],
) -> NDArray[np.int64]:
    """All n rows in the order of removal, exact up to the last of `stops`.

    Of equal scores the lower of `ties` goes first. At each stop, ascending, the next of
    `floor_weights` takes over.
    """
    left, going = np.arange(len(scores)), [np.arange(0)]
    for weight, count in zip(floor_weights, np.diff(stops, prepend=0), strict=True):
        if count > 0:
            values = _with_floor(scores, floors, weight)[left]
            # Only those that may go need to be sorted.
            low = values <= np.partition(values, count - 1)[count - 1]
            rows, values = left[low], values[low]
            rows = rows[np.lexsort((ties[rows], values))]
            going.append(rows[:count])
            left = np.concatenate([rows[count:], left[~low]])
    return np.concatenate([*going, left])


def _unit(values):
    """Values over their mean, (n,); zeros if the mean is 0."""
    mean = float(np.mean(values)) if len(values) else 0.0
    return values / mean if mean > 0.0 else np.zeros_like(values)


def _losses(scores, errors):
    """Logarithm of the share of each view's error removed, (v, shares), equal scores together."""
    places = [max(int(share * len(scores)) - 1, 0) for share in SHARES]
    last = np.partition(scores, places)[places]  # (shares,), the highest score that is removed
    removed = errors @ (scores[:, None] <= last).astype(np.float64)  # (v, shares)
    return np.asarray(np.log(np.maximum(removed / errors.sum(axis=1)[:, None], 1e-12)))
