"""What lines of sight say splats are worth while others go, against lines drawn anew."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from refine_addon.core import ViewSet
from refine_addon.core.errors import Cancelled
from refine_addon.core.scoring import occlusion
from refine_addon.core.scoring.removal_rounds import KNOWN, Thinning
from refine_addon.core.seeing import projection, sight_lines
from refine_addon.core.seeing.measuring import Measured
from refine_addon.core.seeing.sight_lines import Lines, SightLines
from refine_addon.core.work import silent
from tests.core.test_occlusion import cloud, ring

RANDOM = np.random.default_rng(5)


def some_lines(count: int = 40, splats: int = 30) -> tuple[Lines, np.ndarray]:
    """Return lines that meet up to 20 of some splats each, the last of them nothing."""
    line, owner = [], []
    for number in range(count - 1):
        met = RANDOM.permutation(splats)[: RANDOM.integers(0, 21)]
        line += [number] * len(met)
        owner += met.tolist()
    alpha = RANDOM.uniform(0.01, 0.9, len(line)).astype(np.float32)
    lines = Lines(
        np.arange(count), np.zeros(1, np.int64), np.array(line, np.int32),
        np.array(owner, np.int32), alpha, np.log1p(-alpha), np.arange(splats),
    )  # fmt: skip
    return lines, RANDOM.uniform(0.0, 1.0, (3, splats)).astype(np.float32)


def drawn(lines: Lines, colors: np.ndarray, without: int = -1) -> np.ndarray:
    """Return the colour of each line, one after the other, (P, 3)."""
    picture, left = np.zeros((lines.count, 3)), np.ones(lines.count)
    for line, owner, alpha in zip(lines.line, lines.owner, lines.alpha, strict=True):
        if owner != without:
            picture[line] += left[line] * alpha * colors[:, owner]
            left[line] *= 1.0 - float(alpha)
    return picture


@pytest.mark.parametrize("piece", [1, 7, 1 << 15])
def test_a_loss_is_the_squared_change_of_the_lines_without_a_splat(monkeypatch, piece):
    monkeypatch.setattr(sight_lines, "_PIECE", piece)
    lines, colors = some_lines()
    whole = drawn(lines, colors)
    expected = [((drawn(lines, colors, k) - whole) ** 2).sum() for k in range(30)]
    white = np.ones((3, 30), np.float32)
    parts = [
        (drawn(lines, white) - drawn(lines, white * (np.arange(30) != k)))[:, 0].sum()
        for k in range(30)
    ]

    error, contribution = lines.losses(colors)

    # What lies behind less than 1e-4 of the light is left out.
    np.testing.assert_allclose(error, expected, rtol=1e-2, atol=1e-6)
    np.testing.assert_allclose(contribution, parts, rtol=1e-4, atol=1e-3)


def test_lines_that_meet_nothing_lose_nothing():
    lines, colors = some_lines()

    for each in lines.keeping(np.zeros(30, np.bool_)).losses(colors):
        np.testing.assert_array_equal(each, np.zeros(30))


@pytest.fixture
def scene():
    """Return ranking lines into a cloud from two views, one of weight 3, and what they measure."""
    one, two = ring(2)
    views = ViewSet((one, replace(two, weight=3.0)))
    splats = cloud()
    gaussians, frame, _ = projection.prepare(splats, views)
    sights = SightLines(views.by_distance(), gaussians, splats, ranking=True)
    sights.look_from(range(2), gaussians, frame, silent, None)
    count = len(gaussians)
    random = np.random.default_rng(2)
    sums = (random.uniform(0.5, 2.0, count) for _ in range(2))
    return sights, Measured(*sums, np.arange(count, dtype=np.int32))


def told(sights: SightLines, keep: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return error, contribution and number of lines of all Gaussians, with some of them there."""
    error, contribution, met = np.zeros((3, len(keep)))
    for lines, (view, weight) in zip(sights.lines, sights.views, strict=True):
        area = weight * view.width * view.height / lines.count
        colors = sights.colors(lines, view).astype(np.float32)
        met[lines.met] += np.bincount(lines.owner, minlength=len(lines.met))
        for total, some in zip(
            (error, contribution), lines.keeping(keep[lines.met]).losses(colors), strict=True
        ):
            total[lines.met] += area * some
    return error, contribution, met


def test_while_all_are_there_lines_are_weighed_against_what_was_measured(scene):
    sights, measured = scene
    every = np.arange(len(measured.seen))
    error, _, met = told(sights, np.ones(len(every), np.bool_))

    found = Thinning(sights, measured, silent, 1).measured(every, silent)

    expected = (met * error + KNOWN * measured.error) / (met + KNOWN)
    np.testing.assert_allclose(found.error, expected, rtol=1e-9)
    np.testing.assert_allclose(found.contribution, measured.contribution, rtol=1e-12)
    np.testing.assert_array_equal(found.seen, measured.seen)


@pytest.mark.parametrize("threads", [1, 3])
def test_what_is_left_grows_as_lines_tell_and_unmet_splats_as_all_do(scene, threads):
    """Removed at once or one half after the other: the same."""
    sights, measured = scene
    count = len(measured.seen)
    keep = np.arange(count) % 3 > 0
    left = np.flatnonzero(keep)
    before, now = told(sights, np.ones(count, np.bool_)), told(sights, keep)
    met = before[2][left]
    expected = []
    for sums, first, after in zip(
        (measured.error, measured.contribution), before, now, strict=False
    ):
        own, then, later = sums[left], first[left], after[left]
        prior = KNOWN / np.maximum(met, 1) * own
        expected.append(own * (later + prior * later.sum() / then.sum()) / (then + prior))
    expected[0] = (met * now[0][left] + KNOWN * expected[0]) / (met + KNOWN)
    at_once, halves = (Thinning(sights, measured, silent, threads) for _ in range(2))

    found = at_once.measured(left, silent)
    halves.measured(np.flatnonzero(keep | (np.arange(count) < count // 2)), silent)
    again = halves.measured(left, silent)

    assert now[0][left].sum() > 1.05 * before[0][left].sum()
    for name, values in zip(("error", "contribution"), expected, strict=True):
        np.testing.assert_allclose(getattr(found, name), values, rtol=1e-9)
        np.testing.assert_array_equal(getattr(again, name), getattr(found, name))
    np.testing.assert_array_equal(found.seen, measured.seen[left])


def test_what_no_line_meets_grows_as_all_others(scene):
    sights, measured = scene
    last = int(sights.lines[0].met[-1])
    sights.lines = [lines.keeping(lines.met != last) for lines in sights.lines]
    left = np.flatnonzero(
        (np.arange(len(measured.seen)) % 3 > 0) | (np.arange(len(measured.seen)) == last)
    )
    keep = np.zeros(len(measured.seen), np.bool_)
    keep[left] = True
    before, now = (told(sights, some)[0][left].sum() for some in (np.ones_like(keep), keep))

    found = Thinning(sights, measured, silent, 1).measured(left, silent)

    place = int(np.searchsorted(left, last))
    assert found.error[place] == pytest.approx(measured.error[last] * now / before)


def test_it_can_be_cancelled(scene):
    sights, measured = scene
    thinning = Thinning(sights, measured, silent, 1)

    with pytest.raises(Cancelled):
        Thinning(sights, measured, lambda *_: False, 1)
    with pytest.raises(Cancelled):
        thinning.measured(np.arange(5), lambda *_: False)


def test_lines_that_order_splats_are_others_than_those_that_judge():
    """Else an order would be judged by the noise that it was made of."""
    view = replace(ring()[0], width=2000, height=1500, fx=900.0, fy=900.0, cx=1000.0, cy=750.0)
    views = [(view, 0.5), (view, 0.5)]
    splats = cloud()
    gaussians, frame, _ = projection.prepare(splats, ViewSet((view,)))
    footprints = projection.project(gaussians, frame, view)

    judging, ordering = (
        [sight_lines.met(views, number, footprints, ranking=ranking) for number in (0, 1)]
        for ranking in (False, True)
    )

    places = [
        {(column, row) for lines in some for column in lines.columns for row in lines.rows}
        for some in (judging, ordering)
    ]
    assert len(places[1]) == pytest.approx(4 * len(places[0]), rel=0.02)
    assert len(places[0] & places[1]) < 0.02 * len(places[0])


def test_no_view_has_more_lines_than_numbers_of_16_bits_tell_apart():
    view = replace(ring()[0], width=2000, height=1500, fx=900.0, fy=900.0, cx=1000.0, cy=750.0)
    gaussians, frame, _ = projection.prepare(cloud(), ViewSet((view,)))
    footprints = projection.project(gaussians, frame, view)

    lines = sight_lines.met([(view, 1.0)], 0, footprints, ranking=True)

    assert 59_000 < lines.count < 1 << 16


def test_one_round_needs_no_lines_that_order():
    run = occlusion.Run(cloud(), ring(), occlusion.Occlusion(rounds=1))

    assert run.ranking is None


@pytest.mark.parametrize(("width", "height"), [(200_000, 1), (1, 200_000), (300, 200)])
def test_lines_are_no_more_than_asked_for_in_images_of_any_shape(width, height):
    view = replace(ring()[0], width=width, height=height)

    columns, rows = sight_lines.pixels(view, 0, 60_000)

    assert 30_000 < len(columns) * len(rows) <= 60_200


def test_a_single_view_has_no_more_to_note_than_one_of_eight(monkeypatch):
    """Of 65,536 lines an eighth of what may be met leaves fewer, where each meets much."""
    view = replace(ring()[0], width=2000, height=1500, fx=900.0, fy=900.0, cx=1000.0, cy=750.0)
    gaussians, frame, _ = projection.prepare(cloud(), ViewSet((view,)))
    footprints = projection.project(gaussians, frame, view)
    crowd = sight_lines.crowding(footprints, view)
    monkeypatch.setattr(sight_lines, "MOST_RANKED", 80_000 * crowd)

    one, of_eight = (
        sight_lines.met([(view, 1.0)] * count, 0, footprints, ranking=True).count
        for count in (1, 8)
    )

    assert one == pytest.approx(10_000, rel=0.02)
    assert of_eight == pytest.approx(65_536 / 8, rel=0.02)


def test_lines_are_let_go_as_splats_go():
    """16 bytes for each thing met, not twice that."""
    run = occlusion.Run(cloud(), ring(), occlusion.Occlusion(rounds=2))
    run.measure(range(run.measuring.count))
    assert run.ranking is not None

    run.rank(silent)

    assert run.ranking is None
