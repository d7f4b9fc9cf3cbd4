"""Refitting what absorbing made, and what there is to say of it."""

from __future__ import annotations

import time
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

from ..estimate.quality import in_words
from ..refitting.refit import refit

if TYPE_CHECKING:
    from ..absorbing.absorb import Absorbed
    from ..refitting.refit import Refitted
    from ..survivor_choice import Became
    from ..task import Task
    from ..work import Progress


@dataclass(frozen=True, eq=False)
class Made:
    """What survivors of a task became.

    Attributes
    ----------
    absorbed : Absorbed
        By absorbing alone.
    psnr : float or None
        The estimated PSNR of what they became in the end, dB; None if too little is seen.
    refitted : Refitted or None
        By refitting; None where they were not refitted.
    seconds : float
        How long refitting took.
    """

    absorbed: Absorbed
    psnr: float | None = None
    refitted: Refitted | None = None
    seconds: float = 0.0

    @property
    def became(self) -> Became:
        """What survivors became."""
        return "absorb" if self.refitted is None else "refit"

    def measured(self) -> dict[Became, float | None]:
        """Return the estimates of the PSNR by what survivors became, dB."""
        if self.refitted is None:
            return {"absorb": self.psnr}
        return {"absorb": self.refitted.psnr_before, "refit": self.psnr}

    @property
    def survivors(self) -> Absorbed:
        """The survivors as they became in the end."""
        if self.refitted is None:
            return self.absorbed
        changed = self.absorbed.changed | self.refitted.changed
        return replace(self.absorbed, splats=self.refitted.splats, changed=changed)

    def facts(self) -> dict[str, Any]:
        """Return what a report says of refitting: nothing where survivors were not refitted."""
        return {} if self.refitted is None else {"refitted": self.refitted.facts(self.seconds)}

    def notes(self) -> list[str]:
        """Return the same as sentences, for the user."""
        return [] if self.refitted is None else [self.refitted.note(self.seconds)]


def unchanged_note(plain: float | None, tried: Made | None) -> str:
    """Return why survivors stay unchanged by default, for the user.

    Parameters
    ----------
    plain : float or None
        The estimated PSNR with splats deleted, dB.
    tried : Made or None
        What absorbing made; None where it was not tried.
    """
    why = "the views see too little to tell what absorbing would gain"
    if tried is not None and tried.psnr is not None:
        more = "no more" if plain is not None and tried.psnr <= plain else "hardly more"
        why = f"absorbing reaches {in_words(tried.psnr)}, {more}"
    elif plain is not None:
        why = "nobody would see what absorbing gains"
    return f"survivors stay unchanged: {why}"


def refit_absorbed(task: Task, made: Made, progress: Progress, threads: int | None) -> Made:
    """Refit what absorbing made of a task to what the views see of the unpruned splats.

    Parameters
    ----------
    task : Task
    made : Made
        By absorbing alone.
    progress : callable
    threads : int or None

    Returns
    -------
    Made
        Without an estimate of the PSNR; as it is where nothing was removed.
    """
    splats, views = task.scene()
    original = splats if task.origin is None else task.origin.splats
    absorbed, start = made.absorbed, time.perf_counter()
    if absorbed.keep.all() and task.origin is None:
        return made
    done = refit(
        absorbed.splats, original, views.spread(task.settings.views),
        protected=None if task.protected is None else task.protected[absorbed.keep],
        progress=progress, threads=threads,
    )  # fmt: skip
    return Made(absorbed, None, done, time.perf_counter() - start)
