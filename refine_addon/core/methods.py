"""The dial: four ways to prune, from instant to best, each a class of settings."""

from __future__ import annotations

from dataclasses import asdict, dataclass, field, replace
from typing import Any, ClassVar

from .errors import RefineError
from .refit import refit
from .views import ViewSet


@dataclass(frozen=True)
class Method:
    """Settings of all methods.

    At most `views` views decide, spread evenly; 0 uses all. Where there are fewer, and those left
    out lose much more, views between and beside them decide, too, unless `exact` (a locked shot).
    """

    name: ClassVar[str]  # in panel, command and report

    changes: ClassVar[bool] = False  # whether kept splats may change; if not, rows stay to the bit

    views: int = 64
    exact: bool = field(default=False, kw_only=True)

    def __post_init__(self) -> None:
        if self.views < 0:
            raise RefineError(f"views is {self.views}, expected 0 (all) or more")

    def used(self, views: ViewSet) -> ViewSet:
        """Those of `views` that decide; exact if the method is."""
        used = views.spread(self.views)
        return replace(used, exact=used.exact or self.exact)

    def between(self, used: ViewSet) -> int:
        """Most views halfway between those used that may decide, too: two for each."""
        fewer = max((self.views or Method.views) - len(used), 0)
        return 0 if used.exact else min(2 * len(used), fewer)

    def deleting(self) -> Occlusion:
        """Occlusion with the same settings."""
        return Occlusion(self.views, exact=self.exact)

    def facts(self) -> dict[str, Any]:
        """Name and settings as plain JSON values."""
        return {"method": self.name, **asdict(self)}


class ClosedForm(Method):
    """Scores by REFINE's formula, without occlusion; deletes the lowest."""

    name = "closed-form"


class Occlusion(Method):
    """Scores with occlusion; deletes the lowest."""

    name = "occlusion"


class Merge(Method):
    """Scores with occlusion; merges splats into kept ones, or deletes where that is as good."""

    name = "merge"
    changes = True


@dataclass(frozen=True)
class Refit(Method):
    """Merges, then fits the kept splats to the pictures of all splats.

    `rounds` is the most, each with other rays; None ends when a round gains little for its time.
    """

    name = "refit"
    changes = True
    rounds: int | None = None

    def __post_init__(self) -> None:
        super().__post_init__()
        refit.check_rounds(self.rounds)


METHODS: dict[str, type[Method]] = {
    each.name: each for each in (ClosedForm, Occlusion, Merge, Refit)
}
"""By name, from instant to best."""

DEFAULT = Merge()
