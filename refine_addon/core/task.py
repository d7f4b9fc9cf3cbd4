"""What is asked of the pipeline, and what it answers."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, Literal

from .errors import RefineError
from .scoring.closed_form import ClosedForm
from .scoring.occlusion import Occlusion

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from .absorbing.absorb import Absorbed
    from .scores import Scores
    from .selection import Budget
    from .splats import Splats
    from .views import ViewSet

METHODS = ("closed-form", "occlusion", "auto")


@dataclass(frozen=True)
class Settings:
    """How to score.

    Attributes
    ----------
    method : {"closed-form", "occlusion", "auto"}
        Name of the scoring method: as if nothing hid anything, with what hides what, or the
        cheapest that agrees with the latter.
    views : int
        Use at most this many views, spread out evenly; 0 uses all.
    closed_form : ClosedForm
    occlusion : Occlusion
        Settings of the methods of those names.
    tolerance : float
        For "auto": share of the kept set that may differ from that of "occlusion".
    """

    method: Literal["closed-form", "occlusion", "auto"] = "closed-form"
    views: int = 64
    closed_form: ClosedForm = field(default_factory=ClosedForm)
    occlusion: Occlusion = field(default_factory=Occlusion)
    tolerance: float = 0.01

    def __post_init__(self) -> None:
        """Check the values.

        Raises
        ------
        RefineError
            If one cannot be.
        """
        if self.method not in METHODS:
            msg = f"method is {self.method!r}, expected one of {', '.join(METHODS)}"
            raise RefineError(msg)
        if not 0.0 <= self.tolerance <= 1.0:
            msg = f"tolerance is {self.tolerance}, expected a share, 0 to 1"
            raise RefineError(msg)
        if self.views < 0:
            msg = f"views is {self.views}, expected 0 (all) or more"
            raise RefineError(msg)

    @property
    def frustum(self) -> bool:
        """Whether the scores will count the views in whose image a splat lies; see `Scores`."""
        return self.method != "closed-form" or self.closed_form.frustum


DEFAULTS = Settings()


@dataclass(frozen=True, eq=False)
class Task:
    """All that deciding needs, as arrays: nothing of it is a file, or Blender's.

    Attributes
    ----------
    budget : Budget
        How much to remove.
    settings : Settings
        How to score.
    splats : Splats or None
        In the frame of the views; None where they are scored already and nothing absorbs.
    views : ViewSet or None
        None as for `splats`.
    scores : Scores or None
        Those that the splats have already; None scores them.
    protected : (N,) bool or None
        Splats never to remove, nor to change.
    absorb : bool
        Whether survivors absorb what is removed. The budget then says how many survive; which ones
        do, and as what, is found by what the views see of each, whatever the method.
    row_bytes, fixed_bytes : float, int
        See `Budget.removals`.
    """

    budget: Budget
    settings: Settings = DEFAULTS
    splats: Splats | None = None
    views: ViewSet | None = None
    scores: Scores | None = None
    protected: NDArray[np.bool_] | None = None
    absorb: bool = False
    row_bytes: float = 0.0
    fixed_bytes: int = 0

    def scene(self) -> tuple[Splats, ViewSet]:
        """Return splats and views.

        Raises
        ------
        RefineError
            If they were not given.
        """
        if self.splats is None or self.views is None:
            msg = "splats without scores need views to be scored, and absorbing needs both"
            raise RefineError(msg)
        return self.splats, self.views


@dataclass(frozen=True, eq=False)
class Result:
    """What a prune decided.

    Attributes
    ----------
    keep : (N,) bool
        Which splats stay.
    scores : Scores
        What decided; with `absorbed`, the scores that set how many survive, or which tenth is
        deleted first.
    absorbed : Absorbed or None
        The survivors, changed by what they absorbed.
    report : dict
        Counts, settings, weights, timings and versions, ready for JSON.
    """

    keep: NDArray[np.bool_]
    scores: Scores
    report: dict[str, Any]
    absorbed: Absorbed | None = None
