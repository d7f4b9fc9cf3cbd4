"""What every scoring method returns."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from .errors import RefineError
from .quality.alignment import Alignment
from .quality.curve import Quality
from .splats import among_all
from .visibility.cast import RaySample

_DISTINCT = 1 << 24  # largest number of equal steps from 0 to 1 that are distinct in float32


@dataclass(frozen=True, eq=False)
class Scores:
    """How much each of N splats matters to the pictures of the views.

    Attributes
    ----------
    values : (N,) float32
        Finite, >= 0; 0 only for undrawable splats and those that were not scored. Each method has
        its own scale.
    seen : (N,) int32
        In how many of the views used the splat's centre lies.
    views_used : int
        How many views were used.
    undrawable : int
        How many splats cannot be drawn.
    facts : dict of str to Any
        Numbers of the method that explain the scores, for the report.
    notes : tuple of str
        What the user should know about how the scores were computed.
    method : str
        Name of the method asked for, as in `Settings.method`; "" where it is not known.
    views_given : int
        How many views were given; those used were chosen from them.
    ray_sample : RaySample, optional
        Validation rays, which tell the PSNR of any choice of the splats that were scored.
    between : RaySample, optional
        Rays of views between those that scored.
    quality : Quality, optional
        The PSNR over the share removed in the order of the scores.
    alignment : Alignment, optional
        How the views stand to the splats.
    settled : int, optional
        How many splats, from those with the lowest scores on, are in their final order; None for
        all. Scores that were computed for one budget end where that does.
    scored : (N,) bool, optional
        Which splats were scored; None for all. The others had to go (`for_all`).
    """

    values: NDArray[np.float32]
    seen: NDArray[np.int32]
    views_used: int
    undrawable: int
    facts: dict[str, Any] = field(default_factory=dict)
    notes: tuple[str, ...] = ()
    method: str = ""
    views_given: int = 0
    ray_sample: RaySample | None = None
    between: RaySample | None = None
    quality: Quality | None = None
    alignment: Alignment | None = None
    settled: int | None = None
    scored: NDArray[np.bool_] | None = None

    def for_all(self, rest: NDArray[np.bool_]) -> Scores:
        """Return these scores as scores of all N splats, of which some had gone before.

        Parameters
        ----------
        rest : (N,) bool
            Which were scored. The others get the score 0.
        """
        values, seen = among_all(self.values, rest), among_all(self.seen, rest)
        settled = None if self.settled is None else self.settled + len(rest) - len(self.values)
        scored = rest if self.scored is None else among_all(self.scored, rest)
        return replace(self, values=values, seen=seen, settled=settled, scored=scored)

    def of(self, rest: NDArray[np.bool_]) -> Scores:
        """Return the scores of some splats: the inverse of `for_all`.

        Parameters
        ----------
        rest : (N,) bool

        Raises
        ------
        RefineError
            If some of them were not scored.
        """
        self.refuse_unscored(rest)
        count = int(np.count_nonzero(rest))
        # Of a scene with other splats they tell nothing.
        ray_sample, between = (
            None if rays is None or len(rays.splats) != count else rays
            for rays in (self.ray_sample, self.between)
        )
        settled = None if self.settled is None else max(self.settled - (len(rest) - count), 0)
        return replace(
            self, values=self.values[rest], seen=self.seen[rest], ray_sample=ray_sample,
            between=between, settled=settled, scored=None,
        )  # fmt: skip

    def refuse_unscored(self, rest: NDArray[np.bool_] | None = None) -> None:
        """Raise `RefineError` if some of the splats in question, (N,) bool, have no score.

        By default all are.
        """
        if self.scored is None:
            return
        unscored = ~self.scored if rest is None else rest & ~self.scored
        if unscored.any():
            raise RefineError(
                f"{np.count_nonzero(unscored)} splats had to go when the others were scored, and "
                "need not go now; score again"
            )


def shares_gone(places: NDArray[np.int64], count: int) -> NDArray[np.float32]:
    """Return, for each place in the order of removal, the share of `count` splats then removed.

    Above 2^24 splats float32 has fewer numbers near 1 than there are places. A share that would
    equal the next one is lowered to the nearest smaller number, so that no two places tie. The
    highest shares are then a little too low; the lowest stay exact.

    Parameters
    ----------
    places : (N,) int64
        From 1, removed first, to `count`, removed last.
    count : int

    Returns
    -------
    (N,) float32
        In (0, 1]; larger for a later place.

    Examples
    --------
    >>> shares_gone(np.array([1, 2, 4]), 4).tolist()
    [0.25, 0.5, 1.0]
    """
    shares = (places / count).astype(np.float32)
    if count <= _DISTINCT:
        return shares
    # Neighbouring positive floats are neighbouring integers if their bits are read as such.
    highest = np.float32(1.0).view(np.int32) - (count - places)
    return np.minimum(shares.view(np.int32), highest).astype(np.int32).view(np.float32)
