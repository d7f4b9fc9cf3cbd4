"""What a run tells of the time left, by phases that it goes through.

Recorded runs are replayed: which phases they had, with which counts, and at which second each was
how far (`benchmarks.speed.recorded`).
"""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from refine_addon.core.costs import SECONDS, Cost
from refine_addon.core.execute import silent
from refine_addon.core.pace import Pace, named, phases

RUNS = json.loads((Path(__file__).parents[1] / "data/paces.json").read_text())

NEAR = 0.3
"""By which share of the time left it may be missed, from a tenth of the run on."""

SLACK = 0.05
"""Near the end it may be missed by this share of the whole run instead, or by `SHORT`."""

SHORT = 1.0  # seconds


MISSED = {
    ("room, 159,423 splats, auto, absorb, 0.5, 2", 3.0),
    ("room_small, 39,755 splats, auto, absorb over tiles, 0.5, 1", 3.0),
}
"""Runs, and how much slower, of which the time left is up to half off for a moment."""


class Clock:
    """A clock that is set by hand, seconds."""

    def __init__(self):
        self.now = 0.0

    def __call__(self):
        """Return the second that it was set to."""
        return self.now


def replayed(run, slower=1.0):
    """Return what a run was told: second, share that has passed, and time left, seconds."""
    clock, told = Clock(), []
    pace = Pace([1], clock)
    pace.next()

    def progress(fraction, _what):
        told.append((clock.now, fraction, pace.seconds_left(fraction)))

    def whole(*plans):
        return phases(progress, *plans, threads=run["threads"], clock=clock)

    made = [None]
    for seconds, number, what in run["events"]:
        clock.now = slower * seconds
        if isinstance(what, list):
            plans = [[Cost(*cost) for cost in plan] for plan in what]
            made += whole(*plans) if made[number] is None else phases(made[number], *plans)
        else:
            made[number](what, "scoring")
    return told


def misses(run, slower=1.0):
    """Return each second of a run at which the time left was told wrongly, with both times."""
    total = slower * run["seconds"]
    return [
        (round(now, 1), round(left, 1), round(total - now, 1))
        for now, _, left in replayed(run, slower)
        if left is not None and now >= total / 10
        and abs(left - (total - now))
        > max(NEAR * (total - now), SLACK * total, SHORT)
    ]  # fmt: skip


@pytest.mark.parametrize("name", RUNS)
@pytest.mark.parametrize("slower", [1.0, 3.0, 0.4])
def test_the_time_left_of_a_recorded_run_is_true(name, slower):
    """Within `NEAR` from a tenth on, on the machine of the costs, and on slower and faster ones."""
    assert bool(misses(RUNS[name], slower)) is ((name, slower) in MISSED)


@pytest.mark.parametrize("name", RUNS)
def test_what_a_recorded_run_is_told_goes_one_way(name):
    """The share that has passed never falls; the time left never rises from a tenth on."""
    told, tenth = replayed(RUNS[name]), RUNS[name]["seconds"] / 10
    shares = [share for _, share, _ in told]
    left = [left for now, _, left in told if left is not None and now >= tenth]

    assert shares == sorted(shares)
    assert left == sorted(left, reverse=True)
    assert all(share <= 1.0 for share in shares)


def test_recorded_runs_are_of_all_methods_and_sizes():
    """By each method and kind of survivor, of tiles too, 40,000 splats to a million."""
    splats, method, ways = ({name.split(", ")[place] for name in RUNS} for place in (1, 2, 3))
    counts = {int(words.split()[0].replace(",", "")) for words in splats}

    assert method == {"auto", "occlusion", "closed-form"}
    assert {"unchanged", "absorb", "refit"} <= ways
    assert "absorb over tiles" in ways
    smallest, largest = min(counts), max(counts)
    assert smallest < 40_000
    assert largest >= 1_000_000


def test_work_that_takes_longer_than_expected_makes_the_rest_of_its_kind_longer():
    """A phase that takes 4 times as long as expected: 10 s; the other of its kind takes 10 more.

    Before it, one of another kind takes as long as is expected, 5 s, so 15 of 25 s are over.
    """
    (measuring, merging) = (seconds_of("measuring", 5.0), seconds_of("merging", 2.5))
    clock, told = Clock(), []
    first, second, third = phases(
        lambda fraction, _what: told.append(fraction),
        [measuring], [merging], [merging], threads=1, clock=clock,
    )  # fmt: skip
    for phase, begin, end in ((first, 0.0, 5.0), (second, 5.0, 15.0)):
        for step in range(100):
            clock.now = begin + (end - begin) * step / 100
            phase(step / 100, "")
    clock.now = 15.0
    third(0.0, "")

    assert told[-1] == pytest.approx(0.6, abs=0.02)
    assert told == sorted(told)


def test_a_scene_of_which_views_see_much_says_little_of_other_work():
    """Activating as expected, 1 s of 20; measuring 4 times as long, 16 s for 4 expected.

    Comparing (5 s expected) looks at views, too, and takes 20; merging (10 s) some 10: a third to
    half of the time is over. By one pace for all kinds it would be .28.
    """
    kinds = ("activating", 1.0), ("measuring", 4.0), ("merging", 10.0), ("comparing", 5.0)
    clock, told = Clock(), []
    first, second, third, _ = phases(
        lambda fraction, _what: told.append(fraction),
        *([seconds_of(*each)] for each in kinds), threads=1, clock=clock,
    )  # fmt: skip
    first(0.0, "")
    clock.now = 1.0
    second(0.0, "")
    clock.now = 17.0
    third(0.0, "")

    assert told[-1] == pytest.approx(17 / (17 + 10 + 20), abs=0.05)


def test_a_phase_that_is_not_reached_takes_no_time():
    """Of 1, 8 and 1 s the second is left out: at 1 s one more is left."""
    clock, told = Clock(), []
    first, _, third = phases(
        lambda fraction, _what: told.append(fraction),
        *([seconds_of("measuring", seconds)] for seconds in (1.0, 8.0, 1.0)),
        threads=1, clock=clock,
    )  # fmt: skip
    first(0.0, "")
    clock.now = 1.0
    first(1.0, "")
    third(0.0, "")

    assert told == pytest.approx([0.0, 0.1, 0.5])


def test_a_phase_that_says_nothing_for_long_is_waited_for():
    """Expected to take 10 s, half of it is over after 5, though it only said that it began."""
    clock, told = Clock(), []
    (only,) = phases(
        lambda fraction, _what: told.append(fraction), [seconds_of("merging", 10.0)],
        threads=1, clock=clock,
    )  # fmt: skip
    only(0.0, "")
    clock.now = 5.0
    only(0.0, "")

    assert told == pytest.approx([0.0, 0.5])


def test_a_phase_can_be_divided_while_it_lasts():
    """4 s of 8 turn out to be 1 and 1 s: at 5 s, 1 of 6 s is left."""
    clock, told = Clock(), []
    first, second = phases(
        lambda fraction, _what: told.append(fraction),
        [seconds_of("measuring", 4.0)], [seconds_of("measuring", 4.0)],
        threads=1, clock=clock,
    )  # fmt: skip
    first(0.0, "")
    clock.now = 4.0
    first(1.0, "")
    begun, last = phases(second, *(2 * [[seconds_of("measuring", 1.0)]]))
    begun(0.0, "")
    clock.now = 5.0
    last(0.0, "")

    assert told == pytest.approx([0.0, 0.5, 2 / 3, 5 / 6])


def test_phases_are_called_what_they_are_and_can_be_named():
    """By what the work says, or by one name for all of it, also where it is divided."""
    told = []

    def progress(_fraction, what):
        told.append(what)

    plan = [seconds_of("merging", 1.0)]
    one, other = phases(progress, plan, plan)
    one(0.0, "scoring")
    named(other, "refitting")
    phases(other, plan)[0](0.5, "casting rays")
    named(progress, "refitting")(0.5, "scoring")

    assert told == ["scoring", "refitting", "refitting"]


def test_a_phase_hands_on_that_work_is_cancelled():
    """What the run's callback answers, each phase answers; silent work stays silent."""
    (phase,) = phases(lambda _fraction, _what: False, [seconds_of("merging", 1.0)])

    assert phase(0.5, "") is False
    assert phases(silent, [], []) == [silent, silent]


def seconds_of(kind, seconds):
    """Return the cost of work that takes so many seconds of one core, of a kind without views."""
    return Cost(kind, seconds / sum(SECONDS[kind][1:3]))
