"""The dial: four ways to prune, from instant to best. A method is its settings."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any, ClassVar

from .errors import RefineError
from .refit import refit


@dataclass(frozen=True)
class Method:
    """What all methods share; `views` are spread evenly, 0 uses all."""

    name: ClassVar[str]  # the word for it in panel, command and report

    changes: ClassVar[bool] = False  # whether kept splats may change; else rows stay to the bit

    views: int = 64

    def __post_init__(self) -> None:
        if self.views < 0:
            raise RefineError(f"views is {self.views}, expected 0 (all) or more")

    def facts(self) -> dict[str, Any]:
        """Name and settings as plain JSON values."""
        return {"method": self.name, **asdict(self)}


class ClosedForm(Method):
    """REFINE's formula, which takes nothing as hidden; deletes the lowest scores."""

    name = "closed-form"


class Occlusion(Method):
    """Scores that know what hides what; deletes the lowest."""

    name = "occlusion"


class Merge(Method):
    """Occlusion, and what goes is merged into what stays; deletes where that is as good."""

    name = "merge"
    changes = True


@dataclass(frozen=True)
class Refit(Method):
    """Merge, then fit the kept splats to what all splats looked like.

    `rounds` is the most, each to other rays; None ends where a round brings little for its time.
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
