"""How long the rest of a run takes.

A run is divided into phases, one after the other, each with what it is expected to cost, by counts
that are known when it begins. As phases pass, what they really take puts right what is expected of
the rest: that of the same kind, and, less, all others, since this machine is faster or slower than
the one that the costs are from. A phase may be divided again once more is known about it.

What a run's progress callback is told is the share of the time that has passed.
"""

from __future__ import annotations

import math
import time
from collections import defaultdict
from collections.abc import Callable, Iterable, Sequence
from itertools import chain

from .costs import Plan, by_views
from .execute import Progress, default_threads, silent

_MINUTE, _TENS_TO = 60, 300  # seconds; up to the latter, times are told in tens of seconds

_EARLY = 2.0  # seconds before which a pace says little
_RISE = 1.3  # the time left rises if it is so much more than was told; what is less is noise
_SURE = 0.05  # share of a kind's cost after which what it took counts as much as what others took
_SURE_OF_GROUP = 0.03  # the same of kinds that look at views, or of the others, against all kinds
_SURE_OF_MACHINE = 0.01  # the same of all kinds, against the machine that the costs are from


class Pace:
    """Files of a run, one after the other, and the time that the others will take.

    Parameters
    ----------
    sizes : sequence of int
        Bytes of each; a file is taken to need time in proportion.
    clock : callable, optional
        Returns seconds.
    """

    def __init__(
        self, sizes: Sequence[int], clock: Callable[[], float] = time.perf_counter
    ) -> None:
        self._sizes = [max(size, 1) for size in sizes]
        self._begun = 0
        self._clock = clock
        self._start = 0.0
        self._told = math.inf

    def next(self) -> None:
        """Go on to the next file; time passes from the first one on."""
        if not self._begun:
            self._start = self._clock()
        self._begun += 1

    def named(self, name: str) -> str:
        """Return the name of the file under way, with its place among several."""
        count = len(self._sizes)
        return name if count == 1 else f"file {self._begun} of {count}, {name}"

    def left(self, fraction: float) -> str:
        """Return how long all that is left takes, in words; "" where it is too early to tell.

        Parameters
        ----------
        fraction : float
            How much of the time that the file under way takes has passed, 0 to 1.
        """
        seconds = self.seconds_left(fraction)
        if seconds is None:
            return ""
        return f"about {in_time(seconds)} left{' in all' if len(self._sizes) > 1 else ''}"

    def seconds_left(self, fraction: float) -> float | None:
        """Return the same in seconds. It rises only if it is far more than what was told before."""
        before, current = sum(self._sizes[: self._begun - 1]), self._sizes[self._begun - 1]
        done, total = before + fraction * current, sum(self._sizes)
        passed = self._clock() - self._start
        if passed < _EARLY or not 0.0 < done < total:
            return None
        left = passed * (total - done) / done
        if not self._told < left < _RISE * self._told:
            self._told = left
        return self._told


class Phase:
    """One phase of a run: its progress callback. Made by `phases`."""

    def __init__(self, course: _Course, plan: Plan, what: str = "") -> None:
        self.plan, self.what = plan, what
        self.costs = [(cost.kind, cost.seconds(course.threads)) for cost in plan]
        self.seconds = sum(seconds for _, seconds in self.costs)  # expected
        self.fraction = 0.0  # that is done
        self.spent = 0.0  # seconds
        self.spent_before = 0.0  # of these, until `fraction` rose last
        self._course = course

    def __call__(self, fraction: float, what: str) -> bool | None:
        """Tell the run how much of this phase is done."""
        return self._course.tell(self, fraction, self.what or what)

    def divided(self, plans: Iterable[Plan]) -> list[Phase]:
        """Return the phases that this one consists of."""
        return self._course.divide(self, [Phase(self._course, plan, self.what) for plan in plans])


def phases(
    progress: Progress,
    *plans: Plan,
    threads: int | None = None,
    clock: Callable[[], float] = time.perf_counter,
) -> Sequence[Progress]:
    """Divide work into phases, one after the other; return a progress callback for each.

    Parameters
    ----------
    progress : callable
        Of the work: a phase of a run, or what a run is to tell how much of its time has passed.
    *plans : list of Cost
        What is expected of each phase. A phase that is not reached costs nothing.
    threads : int, optional
        How many cores a new run uses.
    clock : callable, optional
        Returns seconds.
    """
    if progress is silent:
        return [silent] * len(plans)
    whole = progress if isinstance(progress, Phase) else _Course(progress, threads, clock).whole
    return whole.divided(plans)


def named(progress: Progress, what: str) -> Progress:
    """Return a progress callback that calls all that is done by one name."""
    if isinstance(progress, Phase):
        progress.what = what
        return progress
    return lambda fraction, _what: progress(fraction, what)


class _Course:
    """The phases of a run, and what they took so far."""

    def __init__(self, progress: Progress, threads: int | None, clock: Callable[[], float]) -> None:
        self.threads = default_threads() if threads is None else max(threads, 1)
        self.whole = Phase(self, [])
        self._phases, self._place = [self.whole], 0  # those in turn, and which is under way
        self._progress, self._clock = progress, clock
        self._start = self._last = clock()
        self._fraction = 0.0

    def divide(self, phase: Phase, parts: list[Phase]) -> list[Phase]:
        """Put phases in the place of one, which may be under way."""
        self._pass_time()
        if phase in self._phases:
            place = self._phases.index(phase)
            self._phases[place : place + 1] = parts or [phase]
        return parts

    def tell(self, phase: Phase, fraction: float, what: str) -> bool | None:
        """Tell the whole run's callback what share of its time has passed."""
        self._pass_time()
        if phase in self._phases[self._place :]:
            self._place = self._phases.index(phase)
            if fraction > phase.fraction:
                phase.fraction, phase.spent_before = fraction, phase.spent
        passed = self._last - self._start
        total = passed + self._left()
        share = passed / total if total > 0.0 else 0.0
        self._fraction = max(self._fraction, share)
        return self._progress(self._fraction, what)

    def _pass_time(self) -> None:
        """Count what passed since this was called last to the phase that was under way."""
        now = self._clock()
        self._phases[self._place].spent += now - self._last
        self._last = now

    def _left(self) -> float:
        """Return how long the rest is expected to take, seconds."""
        factor = self._factors()
        current, *later = self._phases[self._place :]
        waiting = current.spent - current.spent_before
        rest = (1.0 - current.fraction) * _expected([current], factor) - waiting
        return max(rest, 0.0) + _expected(later, factor)

    def _factors(self) -> Callable[[str], float]:
        """Return a function that gives how much longer a kind of work takes than its cost says."""
        spent, done, planned = (defaultdict[str, float](float) for _ in range(3))
        for place, phase in enumerate(self._phases[: self._place + 1]):
            ended = place < self._place
            if not phase.seconds or (ended and not phase.spent):
                continue  # nothing was expected of it, or it was not reached
            fraction, seconds = 1.0, phase.spent
            if not ended:
                fraction, seconds = phase.fraction, phase.spent_before
            for kind, expected in phase.costs:
                done[kind] += fraction * expected
                spent[kind] += seconds * expected / phase.seconds
        for kind, expected in chain.from_iterable(phase.costs for phase in self._phases):
            planned[kind] += expected

        def among(kinds: Iterable[str], sure: float, before: float) -> float:
            of_kinds = [*kinds]
            all_planned, all_done, all_spent = (
                sum(each[kind] for kind in of_kinds) for each in (planned, done, spent)
            )
            sure *= all_planned
            return (all_spent + sure * before) / (all_done + sure) if sure else before

        machine = among(planned, _SURE_OF_MACHINE, 1.0)
        groups = {
            group: among((kind for kind in planned if by_views(kind) is group),
                         _SURE_OF_GROUP, machine)
            for group in (False, True)
        }  # fmt: skip
        return lambda kind: among([kind], _SURE, groups[by_views(kind)])


def _expected(phases: Iterable[Phase], factor: Callable[[str], float]) -> float:
    """Return how long phases are expected to take, seconds."""
    return sum(factor(kind) * seconds for phase in phases for kind, seconds in phase.costs)


def in_time(seconds: float) -> str:
    """Return a time in the unit that suits it, rounded up.

    >>> in_time(2.1), in_time(61.0), in_time(301.0)
    ('3 s', '1 min 10 s', '6 min')
    """
    if seconds <= _MINUTE:
        return f"{math.ceil(seconds)} s"
    if seconds <= _TENS_TO:
        minutes, tens = divmod(math.ceil(seconds / 10.0), 6)
        return f"{minutes} min {tens}0 s" if tens else f"{minutes} min"
    hours, minutes = divmod(math.ceil(seconds / _MINUTE), 60)
    return f"{hours} h {minutes} min" if hours else f"{minutes} min"
