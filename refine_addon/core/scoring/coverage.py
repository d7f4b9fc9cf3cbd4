"""How far the views that score speak for views that do not: the weight of a prior.

What no scoring view shows may be plain to see from elsewhere. So every splat gets a floor, the
closed form, which knows nothing of occlusion; the question is how much of it. Views spread densely
around a scene show all that can be seen, and the floor only keeps what is truly hidden; a few views
leave much to be guessed. The views answer it themselves: an eighth of them at a time is left out,
the others score with each weight of the floor, and the weight that loses least of what the views
left out measured is taken. The more splats go, the more the floor may weigh: what goes first is
next to nothing, and a floor that is little to the last is a wall to the first.

Views can only answer for views like them. All of them in one corner of a room agree that the rest
of it is not worth a thing; so from half removed on there is always some floor, `LEAST_WEIGHTS`.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence

    from numpy.typing import NDArray

    from .projection import Gaussians

WEIGHTS = (0.0, *(float(weight) for weight in 10.0 ** np.arange(-5.0, 0.5, 0.5)))
"""What is tried, of the mean of the scores for a splat of mean worth that no view looks at."""

SHARES = (0.1, 0.3, 0.5, 0.7, 0.9)
"""Shares removed for each of which a weight is chosen, by what goes up to there."""

LEAST_WEIGHTS = (0.0, 0.0, 0.03, 0.03, 0.03)
"""The least that the floor weighs at each of `SHARES`: it costs tenths of a dB on views like those
that score, and is worth up to 20 dB on others."""

TIED = 0.002
"""Weights whose losses differ by this much or less are nearly as good: what is taken is the mean of
their logarithms, so that a change in the last digits does not jump from one to another."""

SAMPLE = 1 << 15
"""How many splats are enough to choose by."""

_NO_WEIGHT = 10.0**-5.5  # stands for none in a mean of logarithms
_MIX = np.uint64(0x9E3779B97F4A7C15)  # 2^64 over the golden ratio: spreads what differs little


def floor(prior: NDArray[np.float64], seen: NDArray[np.int32], power: float) -> NDArray[np.float64]:
    """Return what a splat that these views do not show may be worth to others, (n,).

    Of n views that might have shown it none did: by the rule of succession the next one does with
    a chance of about 1 / (n + 1).

    Parameters
    ----------
    prior : (n,) float64
        Worth if nothing hid anything.
    seen : (n,) int32
        In how many views the centre lies.
    power : float
    """
    return np.asarray(_unit(prior**power) / (1.0 + seen))


def with_floor(
    scores: NDArray[np.float64], floors: NDArray[np.float64], weight: float
) -> NDArray[np.float64]:
    """Return ``scores / mean + weight floors``, (n,)."""
    return _unit(scores) + weight * floors


def floor_weights(folds: Iterable[tuple[NDArray[np.float64], ...]]) -> list[float]:
    """Return the weights that the floor should have, one for each of `SHARES`.

    Parameters
    ----------
    folds : iterable of scores, floors, errors
        Scores by some views, floors by them, and for each of the others, (views, n), the errors
        of removing a splat. Views that see nothing say nothing.

    Returns
    -------
    list of float
        1 where no fold says anything.
    """
    losses = []
    for scores, floors, errors in folds:
        views = errors[errors.any(axis=1)]
        if scores.any() and len(views):
            tried = [_losses(with_floor(scores, floors, weight), views) for weight in WEIGHTS]
            losses.append(np.stack(tried, axis=1))
    if not losses:
        return [1.0] * len(SHARES)
    table = np.mean(np.concatenate(losses), axis=0)  # (weights, shares)
    nearly = np.exp(np.maximum((table.min(axis=0) - table) / TIED, -50.0))
    logs = np.log(np.maximum(WEIGHTS, _NO_WEIGHT))
    best = np.exp(logs @ nearly / nearly.sum(axis=0))
    return [max(pair) for pair in zip(best.tolist(), LEAST_WEIGHTS, strict=True)]


def sample(gaussians: Gaussians, count: int = SAMPLE) -> NDArray[np.int64]:
    """Return `count` of the splats, or all, ascending: by chance, but always the same ones.

    Which they are depends on a hash of opacity and colour, which neither the order of the splats
    nor a motion of the scene changes.

    Parameters
    ----------
    gaussians : Gaussians
    count : int
    """
    total = len(gaussians)
    if total <= count:
        return np.arange(total)
    key = np.zeros(total, np.uint64)
    for values in (gaussians.alphas, *gaussians.colors.T):
        key = (key ^ np.ascontiguousarray(values, np.float32).view(np.uint32)) * _MIX
        key ^= key >> np.uint64(29)
    # Splats that are all alike are taken evenly from the whole scene.
    order = np.arange(total, dtype=np.uint64) * _MIX
    key = key >> np.uint64(32) << np.uint64(32) | order >> np.uint64(32)
    return np.sort(np.argpartition(key, count)[:count])


def order(
    scores: NDArray[np.float64],
    floors: NDArray[np.float64],
    ties: NDArray[np.float32],
    weights: Sequence[float],
    stops: NDArray[np.int64],
) -> NDArray[np.int64]:
    """Return all n splats in the order in which they go, exact up to the last of `stops`.

    Parameters
    ----------
    scores, floors, ties : (n,) array
        `ties` decides between those that are equal.
    weights : sequence of float
        Of the floor.
    stops : array of int
        How many have gone when each weight is done with; ascending.
    """
    left, going = np.arange(len(scores)), [np.arange(0)]
    for weight, count in zip(weights, np.diff(stops, prepend=0), strict=True):
        if count > 0:
            left = left[np.lexsort((ties[left], with_floor(scores, floors, weight)[left]))]
            going.append(left[:count])
            left = left[count:]
    return np.concatenate([*going, left])


def _unit(values: NDArray[np.float64]) -> NDArray[np.float64]:
    mean = float(np.mean(values)) if len(values) else 0.0
    return values / mean if mean > 0.0 else np.zeros_like(values)


def _losses(scores: NDArray[np.float64], errors: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the logarithm of the share of each view's errors that goes, (views, SHARES)."""
    running = np.cumsum(errors[:, np.argsort(scores, kind="stable")], axis=1)
    places = [max(int(share * len(scores)) - 1, 0) for share in SHARES]
    return np.asarray(np.log(np.maximum(running[:, places] / running[:, -1:], 1e-12)))
