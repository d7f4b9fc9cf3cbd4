"""About how long it takes to prune, by what survivors become, once splats were scored."""

from __future__ import annotations

import numpy as np

from ..survivor_choice import Became

ROUNDS = 2.5
"""Scoring by *occlusion* takes so many times as long as measuring all splats once."""

SHARES = (0.1, 0.3, 0.5, 0.55, 0.7, 0.9)
"""Shares removed for which the next two hold; between them they are interpolated."""

ABSORBING = (0.1, 0.5, 0.65, 1.4, 1.8, 2.4)
"""How many times as long as measuring once absorbing takes after that: more stages, more time.

These and the next are processor times of `room_small`, of one thread."""

REFITTING = (20.0, 17.0, 8.5, 10.5, 7.5, 5.0)
"""The same of refitting."""


def expected_seconds(scored: float, share: float, *, once: bool) -> dict[Became, float]:
    """Return about how long pruning takes, by what survivors become; seconds, without files.

    Parameters
    ----------
    scored : float
        How long scoring took, seconds.
    share : float
        Of the splats that goes.
    once : bool
        Whether all splats were measured once; else they were scored by *occlusion*.

    Examples
    --------
    >>> expected_seconds(1.0, 0.5, once=True)
    {'unchanged': 2.5, 'absorb': 1.65, 'refit': 10.15}
    """
    measured = scored if once else scored / ROUNDS
    absorbing, refitting = (
        measured * float(np.interp(share, SHARES, times)) for times in (ABSORBING, REFITTING)
    )
    absorb = measured + absorbing
    return {"unchanged": ROUNDS * measured, "absorb": absorb, "refit": absorb + refitting}
