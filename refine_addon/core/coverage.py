"""How far the views that score speak for views that do not: the weight of a prior.

What no scoring view shows may be plain to see from elsewhere. So every splat gets a floor, the
closed form, which knows nothing of occlusion; the question is how much of it. Views spread densely
around a scene show all that can be seen, and the floor only keeps what is truly hidden; a few views
leave much to be guessed. The views answer it themselves: an eighth of them at a time is left out,
the others score with each weight of the floor, and the weight that loses least of what the views
left out measured is taken.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from collections.abc import Iterable

    from numpy.typing import NDArray

WEIGHTS = (0.0, *(float(weight) for weight in 10.0 ** np.arange(-4.0, 1.5, 0.5)))
"""What is tried, of the mean of the scores for a splat of mean worth that no view looks at."""

SHARES = (0.3, 0.5, 0.7, 0.9)
"""Shares removed at which it is judged."""

SAMPLE = 1 << 15
"""How many splats are enough to choose by."""


def floor(prior: NDArray[np.float64], seen: NDArray[np.int32], power: float) -> NDArray[np.float64]:
    """Return what a splat that these views do not show may be worth to others, (n,).

    Of n views that might have shown it none did: by the rule of succession the next one does with
    a chance of about 1 / (n + 1). The score has `power` factors that visibility enters.

    Parameters
    ----------
    prior : (n,) float64
        Worth if nothing hid anything.
    seen : (n,) int32
        In how many views the centre lies.
    power : float
    """
    return np.asarray(_unit(prior**power) / (1.0 + seen) ** power)


def with_floor(
    scores: NDArray[np.float64], floors: NDArray[np.float64], weight: float
) -> NDArray[np.float64]:
    """Return ``scores / mean + weight floors``, (n,)."""
    return _unit(scores) + weight * floors


def floor_weight(folds: Iterable[tuple[NDArray[np.float64], ...]]) -> float:
    """Return the weight that the floor should have.

    Parameters
    ----------
    folds : iterable of scores, floors, errors
        Scores by some views, floors by them, and for each of the others, (views, n), the errors
        of removing a splat. Views that see nothing say nothing.

    Returns
    -------
    float
        1 where no fold says anything.
    """
    losses = []
    for scores, floors, errors in folds:
        views = errors[errors.any(axis=1)]
        if scores.any() and len(views):
            tried = [_losses(with_floor(scores, floors, weight), views) for weight in WEIGHTS]
            losses.append(np.stack(tried, axis=1).mean(axis=2))
    if not losses:
        return 1.0
    # The smallest weight that is not worse than the best by more than one standard error of the
    # difference (Breiman et al. 1984): a floor must earn its place.
    table = np.concatenate(losses)  # (views, weights)
    worse = table - table[:, [np.argmin(table.mean(axis=0))]]
    allowed = worse.std(axis=0) / np.sqrt(max(len(table) - 1, 1))
    return WEIGHTS[int(np.argmax(worse.mean(axis=0) <= allowed))]


def _unit(values: NDArray[np.float64]) -> NDArray[np.float64]:
    mean = float(np.mean(values)) if len(values) else 0.0
    return values / mean if mean > 0.0 else np.zeros_like(values)


def _losses(scores: NDArray[np.float64], errors: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the logarithm of the share of each view's errors that goes, (views, SHARES)."""
    running = np.cumsum(errors[:, np.argsort(scores, kind="stable")], axis=1)
    places = [max(int(share * len(scores)) - 1, 0) for share in SHARES]
    return np.asarray(np.log(np.maximum(running[:, places] / running[:, -1:], 1e-12)))
