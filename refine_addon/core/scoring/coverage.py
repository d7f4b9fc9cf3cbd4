"""The floor of occlusion scores: what a splat may be worth to views that were not given.

A splat that no given view shows may be visible from elsewhere. So every splat gets a floor, the
closed form, which ignores occlusion, times a weight. If views cover the scene densely, a small
weight is best, since splats that no view shows are truly hidden. With few views, more is unknown
and a larger weight is best.

The weight is chosen by cross-validation: an eighth of the views is left out, the others score with
every weight in `FLOOR_WEIGHTS`, and the weight is taken whose order removes the least error as the
left-out views measured it. There is one weight for each share removed (`SHARES`), since the same
floor is negligible beside the last scores but exceeds the first ones.

Left-out views resemble the others: if all views stand in one corner of a room, they agree that the
rest of it is worth nothing. So from half removed on the weight is at least `LEAST_FLOOR_WEIGHTS`.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence

import numpy as np
from numpy.typing import NDArray

from ..visibility.projection import Gaussians
from ..visibility.scene import MIX, fingerprint

FLOOR_WEIGHTS = (0.0, *(float(weight) for weight in 10.0 ** np.arange(-5.0, 0.5, 0.5)))
"""Weights that are tried. At weight 1, a splat of average prior that lies in no view gets a floor
as high as the mean score."""

SHARES = (0.1, 0.3, 0.5, 0.7, 0.9)
"""Shares removed, each with its own weight: the one that loses least if this share is removed."""

LEAST_FLOOR_WEIGHTS = (0.0, 0.0, 0.03, 0.03, 0.03)
"""Smallest weight for each of `SHARES`: it costs tenths of a dB on views like those given, and
gains up to 20 dB on other views."""

SAMPLE = 1 << 16
"""How many splats are enough to choose the floor's weights."""

TIED = 0.002
"""Weights whose losses differ by about this much count as equally good; the mean of their
logarithms is taken, so that a change in the last digits does not switch to another weight."""

DOUBTS = (0.03, 0.03, 0.0, 0.0, 0.0)
"""What a weight ten times as large must gain to be preferred, as a share of the error removed, for
each of `SHARES`: the first losses are uncertain by as much, and a floor that is not needed costs
quality."""

_NO_WEIGHT = 10.0**-5.5  # stands for 0 in a mean of logarithms


def floor(prior: NDArray[np.float64], seen: NDArray[np.int32], power: float) -> NDArray[np.float64]:
    """Worth of each splat to views that were not given, (n,).

    A splat's centre lies in `seen` views. If none of them shows the splat, the next view shows it
    with a probability of about ``1 / (1 + seen)``, by the rule of succession.

    Parameters
    ----------
    prior : (n,) float64
        Worth of each splat if nothing were hidden.
    seen : (n,) int32
        In how many views the centre lies.
    power : float
        Exponent of the prior: 1 + p, as the score is ``error contribution^p``.
    """
    return np.asarray(_unit(prior**power) / (1.0 + seen))


def _with_floor(scores, floors, weight):
    """``scores / mean(scores) + weight floors``, (n,)."""
    return _unit(scores) + weight * floors


def floor_weights(folds: Iterable[tuple[NDArray[np.float64], ...]]) -> list[float]:
    """Best weight of the floor for each of `SHARES`.

    Parameters
    ----------
    folds : iterable of scores, floors, errors
        Scores, (n,), and floors, (n,), by all views but some; and the error of each splat in each
        view left out, (views, n). Views without any error are ignored.

    Returns
    -------
    list of float
        All 1 if every view is ignored.
    """
    losses = []
    for scores, floors, errors in folds:
        views = errors[errors.any(axis=1)]  # (v, n)
        if scores.any() and len(views):
            tried = [
                _losses(_with_floor(scores, floors, weight), views) for weight in FLOOR_WEIGHTS
            ]
            losses.append(np.stack(tried, axis=1))  # (v, weights, shares)
    if not losses:
        return [1.0] * len(SHARES)
    table = np.mean(np.concatenate(losses), axis=0)  # (weights, shares)
    logs = np.log(np.maximum(FLOOR_WEIGHTS, _NO_WEIGHT))  # (weights,)
    table += np.outer(logs / math.log(10.0), DOUBTS)
    nearly = np.exp(np.maximum((table.min(axis=0) - table) / TIED, -50.0))  # 1 for the best
    best = np.exp(logs @ nearly / nearly.sum(axis=0))  # (shares,)
    return [max(pair) for pair in zip(best.tolist(), LEAST_FLOOR_WEIGHTS, strict=True)]


def sample(gaussians: Gaussians, count: int = SAMPLE) -> NDArray[np.int64]:
    """Rows of `count` splats, or of all if there are fewer, ascending.

    They are chosen by a hash of opacity and colour, so the choice is the same every time, whatever
    the order of the splats and the frame of the scene.

    Parameters
    ----------
    gaussians : Gaussians
    count : int
    """
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

    Parameters
    ----------
    scores, floors, ties : (n,) array
        Of equal scores, the splat with the lower value in `ties` goes first.
    floor_weights : sequence of float
        Used one after the other.
    stops : array of int
        For each weight, how many splats have gone when the next weight takes over; ascending.
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
    """Logarithm of the share of each view's error that is removed, (v, shares).

    The lowest scores, (n,), are removed first, equal ones together; the errors of each splat in
    each of v views are (v, n).
    """
    places = [max(int(share * len(scores)) - 1, 0) for share in SHARES]
    last = np.partition(scores, places)[places]  # (shares,), the highest score that is removed
    removed = errors @ (scores[:, None] <= last).astype(np.float64)  # (v, shares)
    return np.asarray(np.log(np.maximum(removed / errors.sum(axis=1)[:, None], 1e-12)))
