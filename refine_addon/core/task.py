"""The input and the result of the pipeline: `Settings`, `Task` and `Result`."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from .errors import RefineError
from .execute import Cancelled
from .merging.merge import Merged
from .refit.refit import check_rounds
from .scores import Scores
from .selection import Budget, RowBytes
from .splats import Splats, among_all
from .survivor_choice import SurvivorChoice, refuse_unknown
from .views import ViewSet, refuse_other
from .visibility.measuring import Sampling
from .visibility.ray_sample import RaySample
from .volumes import refuse_all

METHODS = ("occlusion", "closed-form")
"""The first is the default."""


@dataclass(frozen=True)
class Occlusion(Sampling):
    """Settings of the occlusion method: `rounds`, see `occlusion.score`."""

    rounds: int = 8


@dataclass(frozen=True)
class Settings:
    """How to score, and to refit.

    Attributes
    ----------
    method : {"occlusion", "closed-form"}
        Scoring method: "occlusion" takes into account what hides what; "closed-form" takes nothing
        as hidden, and is the fastest.
    views : int
        Use at most this many views, spread evenly; 0 uses all.
    occlusion : Occlusion
        Settings of this method.
    rounds : int, optional
        Refit up to so many times, see `refit_rounds`.
    """

    method: Literal["occlusion", "closed-form"] = "occlusion"
    views: int = 64
    occlusion: Occlusion = field(default_factory=Occlusion)
    rounds: int | None = None

    def __post_init__(self) -> None:
        """Check the values."""
        if self.method not in METHODS:
            raise RefineError(f"method is {self.method!r}, expected one of {', '.join(METHODS)}")
        if self.views < 0:
            raise RefineError(f"views is {self.views}, expected 0 (all) or more")
        check_rounds(self.rounds)

    @property
    def estimates(self) -> bool:
        """Whether scores by this method always estimate how close the pictures stay.

        The closed form only does where it is asked to, since that takes longer than scoring.
        """
        return self.method != "closed-form"


DEFAULTS = Settings()


def may_absorb(survivors: SurvivorChoice, settings: Settings, budget: Budget) -> bool:
    """Return whether survivors may absorb others.

    By default they may not where the method or the budget says how to delete.

    Parameters
    ----------
    survivors : {"auto", "unchanged", "absorb", "refit"}
    settings : Settings
    budget : Budget
    """
    if survivors == "auto":
        return settings.method == DEFAULTS.method and not budget.needs_scores
    return survivors != "unchanged"


@dataclass(frozen=True, eq=False)
class Origin:
    """The splats that those of a task became of, by absorbing and refitting.

    Attributes
    ----------
    splats : Splats
        As they were.
    ray_sample : RaySample or None
        What the views saw of them: the estimated PSNR is against that.
    between : RaySample or None
        The same of views between these.
    psnr : float or None
        The estimated PSNR that is left before the task, dB.
    """

    splats: Splats
    ray_sample: RaySample | None
    between: RaySample | None
    psnr: float | None


@dataclass(frozen=True, eq=False)
class Task:
    """What `decide` needs; all data are arrays, whether they came from a file or from Blender.

    Attributes
    ----------
    budget : Budget
        How much to remove.
    settings : Settings
        How to score.
    splats : Splats or None
        In the frame of the views; may be None if `scores` is given and nothing is absorbed.
    views : ViewSet or None
        May be None if `splats` may.
    scores : Scores or None
        Known scores of the splats; None computes them.
    protected : (N,) bool or None
        Splats that are neither removed nor changed.
    forced_out : (N,) bool or None
        Splats that go before all others, whatever they are worth, and count as removed; those that
        are protected stay. The rest is scored without them, and is what the pictures of a PSNR are
        compared with; nothing absorbs them.
    survivors : {"auto", "unchanged", "absorb", "refit"}
        What survivors may become, see `survivor_choice`. If they absorb others, the budget only
        decides how many survive; which ones, and their new values, come from merging, whatever the
        method. By default they absorb, but stay unchanged where that is as good.
    row_bytes, fixed_bytes : float or (N,) int64, int
        See `Budget.removals`.
    origin : Origin or None
        To absorb: what the splats were before they absorbed others; None where they did not.
    reusable : bool
        Whether the scores are to serve other budgets too. Else scoring by occlusion ends where this
        budget does.
    """

    budget: Budget
    settings: Settings = DEFAULTS
    splats: Splats | None = None
    views: ViewSet | None = None
    scores: Scores | None = None
    protected: NDArray[np.bool_] | None = None
    forced_out: NDArray[np.bool_] | None = None
    survivors: SurvivorChoice = "auto"
    row_bytes: RowBytes = 0.0
    fixed_bytes: int = 0
    origin: Origin | None = None
    reusable: bool = False

    def __post_init__(self) -> None:
        """Check what survivors may become, and that the views are such."""
        refuse_unknown(self.survivors)
        if self.views is not None:
            refuse_other(self.views)

    @property
    def absorb(self) -> bool:
        """Whether survivors may absorb the splats that are removed."""
        if self.survivors == "auto" and self.splats is None:  # only their scores are known
            return False
        return may_absorb(self.survivors, self.settings, self.budget)

    def scene(self) -> tuple[Splats, ViewSet]:
        """Return splats and views.

        Raises
        ------
        RefineError
            If they were not given.
        """
        if self.splats is None or self.views is None:
            raise RefineError(
                "splats without scores need views to be scored, and absorbing needs both"
            )
        return self.splats, self.views

    def forced(self) -> NDArray[np.bool_] | None:
        """Return which splats go before all others, (N,); None where there are none."""
        out = self.forced_out
        if out is not None and self.protected is not None:
            out = out & ~self.protected
        return None if out is None or not out.any() else out

    def without(self, forced: NDArray[np.bool_]) -> Task:
        """Return the task for what is left when some splats, (N,), have gone.

        Raises
        ------
        RefineError
            If nothing is, or some of it was not scored.
        """
        refuse_all(forced)
        rest, rows = ~forced, self.row_bytes
        return replace(
            self,
            budget=self.budget.after(int(np.count_nonzero(forced)), len(forced)),
            splats=None if self.splats is None else self.splats.take(rest),
            scores=None if self.scores is None else self.scores.of(rest),
            protected=None if self.protected is None else self.protected[rest],
            forced_out=None,
            row_bytes=rows[rest] if isinstance(rows, np.ndarray) else rows,
        )


@dataclass(frozen=True, eq=False, repr=False)
class Result:
    """The result of a prune.

    Attributes
    ----------
    keep : (N,) bool
        Which splats stay.
    scores : Scores
        The scores that decided which splats stay; of those that stay they may tell less, see
        `Scores.settled`. With `absorbed`: the scores that decided how many survive, or else which
        tenth was deleted first.
    absorbed : Merged or None
        The survivors as they became; None if all are what they were.
    report : dict
        Counts, settings, facts about the scores, timings and versions, ready for JSON.
    stopped : Cancelled or KeyboardInterrupt or None
        What ended refitting before it was done: the result is what it had reached by then. `decide`
        returns such a result, for its caller to offer; `prune` raises this.
    """

    keep: NDArray[np.bool_]
    scores: Scores
    report: dict[str, Any]
    absorbed: Merged | None = None
    stopped: Cancelled | KeyboardInterrupt | None = None

    def __repr__(self) -> str:
        """Return how many splats stay, what they became, and how close the pictures stay."""
        kept, became = int(np.count_nonzero(self.keep)), self.report["survivors"]["became"]
        psnr = self.report["estimated_psnr"]
        close = "" if psnr is None else f", {psnr:.1f} dB"
        return f"<Result: {kept:,} of {len(self.keep):,} splats kept, {became}{close}>"

    def survivors(self, splats: Splats) -> Splats:
        """Return the splats that stay, as they became; in the frame of the views.

        Parameters
        ----------
        splats : Splats
            All of them, in that frame.
        """
        return self.absorbed.splats if self.absorbed else splats.take(self.keep)

    def for_all(self, rest: NDArray[np.bool_]) -> Result:
        """Return a result for what was left of N splats, (N,) bool, as one for them all."""
        keep = among_all(self.keep, rest)
        total, kept = len(keep), int(np.count_nonzero(keep))
        self.report["splats"] |= {"before": total, "kept": kept, "removed": total - kept}
        absorbed = None if self.absorbed is None else replace(self.absorbed, keep=keep)
        return replace(self, keep=keep, scores=self.scores.for_all(rest), absorbed=absorbed)
