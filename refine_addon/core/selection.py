"""Which splats are kept, by their scores: budgets, protected splats and ties."""

from __future__ import annotations

import math
from dataclasses import dataclass
from fractions import Fraction

import numpy as np
from numpy.typing import NDArray

from .errors import RefineError
from .quality.curve import PSNR_CAP, Quality
from .scores import Scores


@dataclass(frozen=True)
class Budget:
    """How much to remove: exactly one of these.

    Attributes
    ----------
    ratio : float in [0, 1), share to remove: exactly ``floor(ratio * N)`` splats
    keep : int, number of kept splats, at least 1; all if there are fewer
    max_mb : float, largest size of the file, megabytes of 1e6 bytes
    psnr : float, least estimated PSNR of the views' pictures against the unpruned splats', dB

    Raises
    ------
    RefineError : unless exactly one is given, in its range

    >>> Budget(ratio=0.29).removals(100)
    29
    """

    ratio: float | None = None
    keep: int | None = None
    max_mb: float | None = None
    psnr: float | None = None

    def __post_init__(self) -> None:
        given = [name for name, value in vars(self).items() if value is not None]
        if len(given) != 1:
            raise RefineError(f"expected one of {', '.join(vars(self))}, got {given or 'none'}")
        value = getattr(self, self.kind)
        expected, holds = {
            "ratio": ("0 <= ratio < 1", 0 <= value < 1),
            "keep": ("a whole number of at least 1", value >= 1 and value % 1 == 0),
            "max_mb": ("a positive number", 0 < value < math.inf),
            "psnr": (f"more than 0 and less than {PSNR_CAP:g} dB", 0 < value < PSNR_CAP),
        }[self.kind]
        if not holds:
            raise RefineError(f"{self.kind} is {value}, expected {expected}")

    @property
    def kind(self) -> str:
        """Name of the value that is given."""
        return next(name for name, value in vars(self).items() if value is not None)

    def after(self, gone: int, count: int) -> Budget:
        """Budget for the rest of `count` splats, of which `gone` are removed already.

        The removed ones count as removed by this budget.

        >>> Budget(ratio=0.5).after(20, 100), Budget(ratio=0.5).after(70, 100).removals(30)
        (Budget(ratio=None, keep=50, max_mb=None, psnr=None), 0)
        """
        if self.ratio is None:
            return self
        return Budget(keep=count - max(self.removals(count) or 0, gone))

    def removals(self, count: int, row_bytes: float = 0.0, fixed_bytes: int = 0) -> int | None:
        """Number of splats to remove, of `count`; None for a PSNR, where the scores decide.

        For `max_mb`, `row_bytes` is the size of a splat in the file and `fixed_bytes` that of the
        rest; `RefineError` if a single splat does not fit.
        """
        if self.ratio is not None:
            # The decimal as written: in binary, floor(0.29 * 100) is 28.
            return math.floor(Fraction(repr(float(self.ratio))) * count)
        if self.keep is not None:
            return max(count - int(self.keep), 0)
        if self.max_mb is not None:
            room = math.floor(Fraction(repr(float(self.max_mb))) * 10**6) - fixed_bytes
            if not row_bytes:
                raise RefineError("max_mb needs to know how many bytes a splat takes in the file")
            if room < row_bytes:
                raise RefineError(
                    f"max_mb is {self.max_mb}, too small for one splat of {row_bytes:.0f} bytes"
                )
            return max(count - math.floor(room / Fraction(row_bytes)), 0)
        return None


def select(
    scores: Scores,
    budget: Budget,
    *,
    protected: NDArray[np.bool_] | None = None,
    row_bytes: float = 0.0,
    fixed_bytes: int = 0,
) -> NDArray[np.bool_]:
    """Which splats are kept: the lowest scores are removed, of equal ones the first in the file.

    Parameters
    ----------
    scores : Scores, of N splats
    budget : Budget
    protected : (N,) bool, optional; always kept, others are removed instead if there are any
    row_bytes, fixed_bytes : see `Budget.removals`

    Returns
    -------
    (N,) bool

    Raises
    ------
    RefineError
        If more would be removed than `Scores.settled`, or there is no curve for a PSNR.
    """
    values = scores.values
    # Rows that may go.
    rows = np.arange(len(values)) if protected is None else np.flatnonzero(~protected)
    removals = budget.removals(len(values), row_bytes, fixed_bytes)
    if removals is None:
        removals = math.floor(quality_of(scores).share(budget.psnr or 0.0) * len(values))
    keep = np.ones(len(values), np.bool_)
    if removals := min(removals, len(rows)):
        some = np.where(np.isnan(values[rows]), np.float32(np.inf), values[rows])
        edge = np.partition(some, removals - 1)[removals - 1]
        gone, ties = some < edge, np.flatnonzero(some == edge)
        gone[ties[: removals - np.count_nonzero(gone)]] = True
        keep[rows[gone]] = False
    if (settled := scores.settled) is not None:
        # A PSNR that all of the curve reaches may be reached beyond its end, too.
        beyond = budget.psnr is not None and budget.psnr <= quality_of(scores).psnr[-1]
        if beyond or not keep[np.argsort(values, kind="stable")[settled:]].all():
            raise RefineError(
                f"these scores were computed for a budget that removes up to {settled} of "
                f"{len(keep)} splats, and this one removes more: score again, for all budgets"
            )
    return keep


def quality_of(scores: Scores) -> Quality:
    """The curve of the estimated PSNR; `RefineError` if the scores have none."""
    if scores.quality is None:
        raise RefineError(
            "these scores have no estimate of the pictures' quality: score again with a PSNR as "
            "budget, or choose another budget where the views see too little"
        )
    return scores.quality


def rank(values: NDArray[np.float32]) -> NDArray[np.float64]:
    """Place of each splat in the order of removal, (N,) float64, from 0 (first) to 1 (last).

    A single splat has 1. For display in Blender, whose float32 cannot tell more than 2^24 splats
    apart; `select` uses scores and rows.
    """
    count = len(values)
    if count == 1:
        return np.ones(1)
    ranks = np.empty(count)
    ranks[np.argsort(values, kind="stable")] = np.linspace(0.0, 1.0, count)
    return ranks
