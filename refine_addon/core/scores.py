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
from .views import ViewSet
from .visibility.cast import RaySample

TELLING = 12
"""Fewest views by which it is told what views elsewhere lose: by 8 it was up to 5 dB too high."""

_DISTINCT = 1 << 24  # largest number of equal steps from 0 to 1 that are distinct in float32


@dataclass(frozen=True, eq=False)
class Scores:
    """How much each of N splats contributes to the pictures of the views.

    Attributes
    ----------
    values : (N,) float32, finite, >= 0, on the method's scale; 0 if undrawable or not scored
    seen : (N,) int32, number of the views used in which the splat's centre lies
    views_used : int
    undrawable : int, number of splats that cannot be drawn
    facts : dict, numbers of the method for the report
    notes : tuple of str, sentences for the user
    method : str, name of the method
    views_given : int, number of views from which those used were chosen
    views_between : int, number of views between and beside these that decide, too
    ray_sample : RaySample, validation rays, which estimate the PSNR of any choice of the splats
    between : RaySample, likewise for views in between
    quality : Quality, estimated PSNR by the share removed, in the order of the scores
    alignment : Alignment, whether the views fit the splats
    settled : int, number of the lowest scores that are in final order; None for all
    scored : (N,) bool, which splats were scored; None for all, see `for_all`
    deciding : ViewSet, the views used and those between and beside them that decide, too
    """

    values: NDArray[np.float32]
    seen: NDArray[np.int32]
    views_used: int
    undrawable: int
    facts: dict[str, Any] = field(default_factory=dict)
    notes: tuple[str, ...] = ()
    method: str = ""
    views_given: int = 0
    views_between: int = 0
    ray_sample: RaySample | None = None
    between: RaySample | None = None
    quality: Quality | None = None
    alignment: Alignment | None = None
    settled: int | None = None
    scored: NDArray[np.bool_] | None = None
    deciding: ViewSet | None = None

    @property
    def tells(self) -> bool:
        """Whether `between` is near enough to what is lost in views elsewhere, see `TELLING`."""
        return self.views_used >= TELLING

    def for_all(self, rest: NDArray[np.bool_]) -> Scores:
        """Scores of all N splats, from these of the splats in `rest`, (N,) bool; others get 0."""
        values, seen = among_all(self.values, rest), among_all(self.seen, rest)
        settled = None if self.settled is None else self.settled + len(rest) - len(self.values)
        scored = rest if self.scored is None else among_all(self.scored, rest)
        return replace(self, values=values, seen=seen, settled=settled, scored=scored)

    def of(self, rest: NDArray[np.bool_]) -> Scores:
        """Scores of the splats in `rest`, (N,) bool; `RefineError` if some were not scored."""
        self.refuse_unscored(rest)
        count = int(np.count_nonzero(rest))
        settled = None if self.settled is None else max(self.settled - (len(rest) - count), 0)
        values, seen = self.values[rest], self.seen[rest]
        scores = replace(self, values=values, seen=seen, settled=settled, scored=None)
        if self.ray_sample is not None and len(self.ray_sample.splats) == count:
            return scores
        return replace(scores, ray_sample=None, between=None)  # rays hold for one set of splats

    def refuse_unscored(self, rest: NDArray[np.bool_] | None = None) -> None:
        """Raise `RefineError` if splats in `rest`, (N,) bool, by default all, have no score."""
        if self.scored is None:
            return
        unscored = ~self.scored if rest is None else rest & ~self.scored
        if unscored.any():
            raise RefineError(
                f"{np.count_nonzero(unscored)} splats were removed when the others were scored, "
                "and are not now; score again"
            )


def shares_gone(places: NDArray[np.int64], count: int) -> NDArray[np.float32]:
    """Share of `count` splats removed up to each place in the order, (N,) from 1, as float32.

    Above 2^24 splats float32 has too few numbers near 1: the highest shares are then lowered to the
    nearest smaller ones, so that no two places tie; the lowest stay exact.
    """
    shares = (places / count).astype(np.float32)
    if count <= _DISTINCT:
        return shares
    # Neighbouring positive floats are neighbouring integers if their bits are read as such.
    highest = np.float32(1.0).view(np.int32) - (count - places)
    return np.minimum(shares.view(np.int32), highest).astype(np.int32).view(np.float32)
