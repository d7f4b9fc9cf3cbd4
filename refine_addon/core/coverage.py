"""How far the views that score speak for views that do not: the weight of a prior.

What no scoring view shows may be plain to see from elsewhere. So every splat gets a floor, the
closed form, which knows nothing of occlusion; the question is how much of it. Views spread densely
around a scene show all that can be seen, and the floor only keeps what is truly hidden; a few views
leave much to be guessed. The views answer it themselves: one half of them scores with each weight
of the prior, and the weight that loses least of what the other half measured is taken.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from numpy.typing import NDArray

WEIGHTS = (0.0, *(float(weight) for weight in 10.0 ** np.arange(-5.0, 0.5, 0.5)))
"""What is tried, of the mean of the scores."""

SHARES = (0.3, 0.5, 0.7, 0.9)
"""Shares removed at which it is judged."""

DOUBLED = 0.25
"""All views need so much of the weight that half of them need: it falls about hundredfold from 4
to 31 views, three doublings (measured on the committed scene's scoring views)."""

_SAMPLE = 1 << 16


def with_prior(
    scores: NDArray[np.float64], prior: NDArray[np.float64], weight: float
) -> NDArray[np.float64]:
    """Return ``scores / mean + weight prior / mean``, (n,)."""
    return _unit(scores) + weight * _unit(prior)


def prior_weight(
    halves: tuple[NDArray[np.float64], NDArray[np.float64]],
    errors: tuple[NDArray[np.float64], NDArray[np.float64]],
    prior: NDArray[np.float64],
) -> float:
    """Return the weight that the prior should have beside the scores of all views.

    Parameters
    ----------
    halves : two of (n,) float64
        Scores by either half of the views.
    errors : two of (n,) float64
        What removing a splat costs either half of the views.
    prior : (n,) float64
        Neighbours in the scene should be near each other: every k-th is judged.
    """
    step = -(-len(prior) // _SAMPLE)
    sample = slice(None, None, step)
    chosen = []
    for mine, other in ((0, 1), (1, 0)):
        truth = errors[other][sample]
        if not truth.any() or not halves[mine][sample].any():
            return WEIGHTS[-1]
        losses = [
            _loss(with_prior(halves[mine][sample], prior[sample], weight), truth)
            for weight in WEIGHTS
        ]
        chosen.append(losses)
    best = int(np.argmin(np.mean(chosen, axis=0)))
    # The largest that was tried is the best of them: nothing says that it is too much.
    return WEIGHTS[best] * (DOUBLED if best < len(WEIGHTS) - 1 else 1.0)


def _unit(values: NDArray[np.float64]) -> NDArray[np.float64]:
    mean = float(np.mean(values)) if len(values) else 0.0
    return values / mean if mean > 0.0 else np.zeros_like(values)


def _loss(scores: NDArray[np.float64], truth: NDArray[np.float64]) -> float:
    """Mean over `SHARES` of the logarithm of the share of `truth` that would go."""
    running = np.cumsum(truth[np.argsort(scores, kind="stable")])
    going = running[[max(int(share * len(truth)) - 1, 0) for share in SHARES]]
    return float(np.mean(np.log(np.maximum(going / running[-1], 1e-12))))
