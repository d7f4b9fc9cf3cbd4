"""Lambda: how much geometry, colour and opacity count in a scene (REFINE, Eq. 17-20)."""

from __future__ import annotations

import math
from dataclasses import dataclass

TERMS = ("geometry", "color", "opacity")

CALIBRATION = (10.73, 56.06, 100.67)
"""Means of the three statistics over the calibration scenes of REFINE's authors."""

RATIO_LIMIT = 1e6
"""Axis ratios above this count as this, so that one flat disk does not make the mean infinite."""

_NOISE = 1e-12  # a smaller statistic counts as 0: rounding leaves about this much of a zero


@dataclass(frozen=True)
class Statistics:
    """The statistics that decide lambda, over all drawable splats of a scene.

    Attributes
    ----------
    anisotropy : float
        F_gem, mean of longest over shortest axis.
    luma_variance : float
        F_col, variance of the luma, which lies in 0..1.
    translucency : float
        F_opa times 4, mean of 4 alpha (1 - alpha), in 0..1.
    """

    anisotropy: float
    luma_variance: float
    translucency: float


def lambdas(statistics: Statistics, *, offset: float = 0.0) -> tuple[float, float, float]:
    """Return lambda of geometry, colour and opacity: each in [0, 1], their sum 1.

    ``lt_gem = ln(F_gem + offset) / 10.73``, ``lt_col = 100 F_col / 56.06`` and
    ``lt_opa = 100 F_opa / 100.67``, divided by their sum (REFINE, Eq. 17-20, with the constants of
    the authors' code). A negative logarithm counts as 0; it occurs where splats are round and the
    shortest axis has an offset in F_gem. If all three are 0, all lambdas are equal.

    Parameters
    ----------
    statistics : Statistics
    offset : float
        Added to F_gem inside the logarithm.

    Examples
    --------
    >>> [round(value, 3) for value in lambdas(Statistics(10.73, 0.05, 0.5))]
    [0.274, 0.111, 0.615]
    """
    geometry = statistics.anisotropy + offset
    raw = [
        max(math.log(geometry), 0.0) / CALIBRATION[0] if geometry > 0.0 else 0.0,
        100.0 * max(statistics.luma_variance, 0.0) / CALIBRATION[1],
        100.0 * max(statistics.translucency, 0.0) / CALIBRATION[2],
    ]
    raw = [value if value > _NOISE else 0.0 for value in raw]
    total = sum(raw)
    if total <= 0.0:
        return (1 / 3, 1 / 3, 1 / 3)
    return (raw[0] / total, raw[1] / total, raw[2] / total)
