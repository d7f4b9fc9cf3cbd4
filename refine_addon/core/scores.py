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
    values : (N,) float32, finite, >= 0, on the method's scale; 0 if undrawable or not scored
    seen : (N,) int32, in how many of the views used the splat's centre lies
    undrawable : int, how many splats cannot be drawn
    facts : dict, numbers of the method for the report
    notes : tuple of str, what the user should know
    views_given : int, of which those used were chosen
    ray_sample : RaySample, validation rays: the PSNR of any choice of the splats scored
    between : RaySample, of views in between
    quality : Quality, the PSNR over the share removed in the order of the scores
    alignment : Alignment, how the views stand to the splats
    settled : int, how many of the lowest scores are in final order; None for all
    scored : (N,) bool, which splats were scored; None for all, see `for_all`
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
        """These scores for all N splats, of which those in `rest`, (N,), have one; others get 0."""
        values, seen = among_all(self.values, rest), among_all(self.seen, rest)
        settled = None if self.settled is None else self.settled + len(rest) - len(self.values)
        scored = rest if self.scored is None else among_all(self.scored, rest)
        return replace(self, values=values, seen=seen, settled=settled, scored=scored)

    def of(self, rest: NDArray[np.bool_]) -> Scores:
        """Scores of the splats in `rest`, (N,) bool; `RefineError` if some were not scored."""
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
        """Raise `RefineError` if splats in `rest`, (N,) bool, by default all, have no score."""
        if self.scored is None:
            return
        unscored = ~self.scored if rest is None else rest & ~self.scored
        if unscored.any():
            raise RefineError(
                f"{np.count_nonzero(unscored)} splats had to go when the others were scored, and "
                "need not go now; score again"
            )


def shares_gone(places: NDArray[np.int64], count: int) -> NDArray[np.float32]:
    """Share of `count` splats removed at each place, (N,) from 1, in the order of removal, float32.

    Above 2^24 splats float32 has too few numbers near 1: the highest shares are then lowered to the
    nearest smaller ones, so that no two places tie; the lowest stay exact.
    """
    shares = (places / count).astype(np.float32)
    if count <= _DISTINCT:
        return shares
    # Neighbouring positive floats are neighbouring integers if their bits are read as such.
    highest = np.float32(1.0).view(np.int32) - (count - places)
    return np.minimum(shares.view(np.int32), highest).astype(np.int32).view(np.float32)
