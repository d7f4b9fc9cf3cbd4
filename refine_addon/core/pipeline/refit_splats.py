"""Refitting what deleting or absorbing left, and what there is to say of it."""

from __future__ import annotations

import time
from dataclasses import dataclass, field, replace
from typing import Any

from ..execute import Cancelled, Progress, return_freed
from ..merging.merge import Merged
from ..pace import named
from ..quality.curve import in_words
from ..refit.refit import Refitted, refit_rounds
from ..survivor_choice import Became
from ..task import Task

DOING = "refitting"
"""What a progress callback is told while survivors are refitted: from here on a cancelled prune
still has something to offer; see `Result.stopped`."""


@dataclass(frozen=True, eq=False)
class Made:
    """What survivors of a task became.

    Attributes
    ----------
    absorbed : Merged
        Before refitting: by absorbing, or by deletion where that is better to begin with.
    psnr : float or None
        The estimated PSNR of what they became in the end, dB; None if too little is seen.
    psnr_between : float or None
        The same in views between those that decided, dB.
    refitted : Refitted or None
        By refitting; None where they were not refitted.
    seconds : float
        How long refitting took.
    before : dict of str to (float or None)
        Where refitting was asked for: the estimates before it, by what survivors had become, dB.
    began : {"unchanged", "absorb"}
        Which of these refitting began with.
    stopped : Cancelled or KeyboardInterrupt or None
        What ended refitting before it was done; see `Result.stopped`.
    """

    absorbed: Merged
    psnr: float | None = None
    psnr_between: float | None = None
    refitted: Refitted | None = None
    seconds: float = 0.0
    before: dict[Became, float | None] = field(default_factory=dict)
    began: Became = "absorb"
    stopped: Cancelled | KeyboardInterrupt | None = None

    @property
    def became(self) -> Became:
        """What survivors became."""
        return self.began if self.refitted is None else "refit"

    def measured(self) -> dict[Became, float | None]:
        """Return the estimates of the PSNR by what survivors became, dB."""
        return {**self.before, self.became: self.psnr}

    @property
    def survivors(self) -> Merged:
        """The survivors as they became in the end."""
        if self.refitted is None:
            return self.absorbed
        changed = self.absorbed.changed | self.refitted.changed
        return replace(self.absorbed, splats=self.refitted.splats, changed=changed)

    def facts(self) -> dict[str, Any]:
        """Return what a report says of refitting: nothing where survivors were not refitted."""
        if self.refitted is None:
            return {}
        return {"refitted": {"began": self.began, **self.refitted.facts(self.seconds)}}

    def notes(self) -> list[str]:
        """Return the same as sentences, for the user."""
        notes = []
        if self.refitted is not None:
            notes.append(self.refitted.note(self.seconds))
        if self.began == "unchanged":
            told = [in_words(psnr) for psnr in self.before.values() if psnr is not None]
            notes.append(f"refitting began with plain deletion: {told[0]}, absorbing {told[1]}")
        return [*notes, *getattr(self.stopped, "__notes__", ())]


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


def refit_made(task: Task, made: Made, progress: Progress, threads: int | None) -> Made:
    """Refit what was made of a task to what the views see of the unpruned splats.

    Parameters
    ----------
    task : Task
    made : Made
        Before refitting.
    progress : callable
        Is told `DOING`; where it cancels, and where a signal does, the rounds so far are returned.
    threads : int or None

    Returns
    -------
    Made
        With the PSNR by the rays that told what rounds gained; as it is where nothing was removed.
    """
    splats, views = task.scene()
    original = splats if task.origin is None else task.origin.splats
    absorbed, start = made.absorbed, time.perf_counter()
    if absorbed.keep.all() and task.origin is None:
        return made
    done: Refitted | None = None
    stopped = None
    return_freed()
    try:
        for reached in refit_rounds(
            absorbed.splats, original, views.spread(task.settings.views), task.settings.rounds,
            protected=None if task.protected is None else task.protected[absorbed.keep],
            progress=named(progress, DOING), threads=threads,
        ):  # fmt: skip
            done = reached
    except (Cancelled, KeyboardInterrupt) as stop:
        stopped = _noted(stop, 0 if done is None else done.rounds)
        if done is None or not done.rounds:
            return replace(made, stopped=stopped)
    assert done is not None
    seconds = time.perf_counter() - start
    return replace(made, psnr=done.psnr, refitted=done, seconds=seconds, stopped=stopped)


def _noted(stop: Cancelled | KeyboardInterrupt, rounds: int) -> Cancelled | KeyboardInterrupt:
    """Return what stopped refitting, with a note of that, and without what was worked on."""
    after = f"after round {rounds}" if rounds else "before its first round was done"
    stop.add_note(f"refitting was stopped {after}")
    return stop.with_traceback(None)
