"""Kept splats that are refitted: from file to file, with levels, and what is said of it."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from refine_addon.core import (
    Budget,
    Levels,
    Merge,
    Refit,
    ViewSet,
    lod,
    lod_file,
    prune,
    prune_file,
    read_ply,
)
from refine_addon.core.execute import Cancelled
from refine_addon.core.quality.psnr import psnr_against
from refine_addon.core.refit.round_rays import RoundRays
from refine_addon.core.splats import ARRAYS
from refine_addon.core.visibility.cast import validation_rays
from tests.strategies import ply_of

from .test_prune import file, small, views  # noqa: F401 - fixtures

ROOM = Path(__file__).parents[1] / "data/room_small"
FEW, REFIT = Merge(12), Refit(12)
HALF = Budget(ratio=0.5)

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def refitted(small, views, tmp_path_factory):
    """Return the file of the refitted half, and what was decided."""
    path = tmp_path_factory.mktemp("refitted") / "out.ply"
    return path, prune_file(small, path, views, HALF, REFIT)


def test_refitting_comes_closer_than_merging_and_says_by_how_much(small, views, refitted):
    """The same rows stay; rays that neither went by say that the pictures are closer."""
    splats = read_ply(small).splats()
    merged = prune(splats, views, HALF, FEW)
    result, facts = refitted[1], refitted[1].report["refitted"]
    used = views.spread(FEW.views)
    rays = validation_rays(splats, used)

    found = [psnr_against(rays, each.splats, used) for each in (merged, result)]

    assert np.array_equal(result.keep, merged.keep)
    assert found[1] > found[0] + 1.0
    assert facts["psnr"] > facts["psnr_before"] + 1.0
    assert facts["rounds"] >= 1
    assert 0 < facts["changed"] <= np.count_nonzero(result.merged.changed)
    assert facts["seconds"] > 0.0
    assert result.report["merged"] == merged.report["merged"]
    assert any("splats were refitted" in note for note in result.report["notes"])


def test_rounds_are_as_many_as_asked_for_where_each_gains(small, views):
    """More rounds come closer on rays that none of them went by."""
    splats = read_ply(small).splats()
    told = [prune(splats, views, HALF, Refit(12, rounds)).report["refitted"] for rounds in (1, 3)]

    assert [facts["rounds"] for facts in told] == [1, 3]
    assert told[0]["psnr"] < told[1]["psnr"]


def test_the_file_holds_what_was_refitted_and_the_rest_bit_for_bit(small, refitted):
    """Only what makes a splat may change, and only of kept splats that the result names."""
    path, result = refitted
    before, after = read_ply(small), read_ply(path)

    changed, kept = result.merged.changed, before.rows[result.keep]

    assert after.rows[~changed].tobytes() == kept[~changed].tobytes()
    for item in ARRAYS:
        wanted = getattr(result.merged.splats, item).astype(np.float32)
        np.testing.assert_array_equal(getattr(after.splats(), item), wanted)


def test_doubles_stay_doubles_and_what_is_not_of_a_splat_stays(small, views, tmp_path):
    """At an offset of 1e6, float32 knows steps of .0625: each kept splat has a place of its own."""
    rows = read_ply(small).rows
    columns = {name: rows[name].astype("f8") for name in rows.dtype.names}
    columns["x"] += 1e6
    columns["mine"] = np.arange(len(rows), dtype="i4")
    (tmp_path / "in.ply").write_bytes(ply_of(columns))
    shift = np.array([1e6, 0.0, 0.0])
    moved = ViewSet(tuple(replace(view, center=view.center + shift) for view in views))

    result = prune_file(tmp_path / "in.ply", tmp_path / "out.ply", moved, HALF, REFIT)

    written = read_ply(tmp_path / "out.ply")
    np.testing.assert_array_equal(written.rows["mine"], np.flatnonzero(result.keep))
    np.testing.assert_array_equal(written.splats().means, result.merged.splats.means)
    assert written.splats().means.dtype == np.float64
    assert len(np.unique(written.rows["x"])) > 100


def test_protected_splats_keep_their_bits(small, views):
    """Every third; beside them others are refitted."""
    splats = read_ply(small).splats()
    protected = np.arange(len(splats)) % 3 == 0

    result = prune(splats, views, HALF, REFIT, protected=protected)

    spared = protected[result.keep]
    assert result.keep[protected].all()
    assert not result.merged.changed[spared].any()
    assert result.merged.changed[~spared].any()
    for item in ARRAYS:
        found = getattr(result.merged.splats, item)[spared]
        np.testing.assert_array_equal(found, getattr(splats, item)[protected])


def test_where_nothing_goes_nothing_is_refitted(small, views):
    """All rows are what they were."""
    splats = read_ply(small).splats()

    result = prune(splats, views, Budget(ratio=0.0), REFIT)

    assert not result.merged.changed.any()
    assert "refitted" not in result.report


def test_a_psnr_is_reached_with_fewer_splats_than_by_merging(small, views):
    """To a dB by the estimate; the curve of refitting is tried, then put right by what it gave."""
    splats = read_ply(small).splats()

    merged, refitted = (prune(splats, views, Budget(psnr=38.0), method) for method in (FEW, REFIT))

    assert refitted.report["estimated_psnr"] == pytest.approx(38.0, abs=1.0)
    assert refitted.report["estimated_psnr"] > merged.report["estimated_psnr"]
    assert np.count_nonzero(refitted.keep) < np.count_nonzero(merged.keep)


def test_levels_are_refitted_to_the_original(small, views):
    """The second, too, though it is made from the first: it is closer than without refitting."""
    splats = read_ply(small).splats()

    plain, better = (lod(splats, views, Levels((0.5, 0.25)), method) for method in (FEW, REFIT))

    for one, other in zip(plain, better, strict=True):
        assert len(one.result.splats) == len(other.result.splats)
        assert other.psnr > one.psnr + 0.5


def test_progress_rises_and_can_end_while_refitting(small, views):
    """Progress that refitting tells lies between those of merging and of the estimate."""
    splats, told = read_ply(small).splats(), []

    def listen(share, what):
        told.append((share, what))
        return what != "refitting"

    with pytest.raises(Cancelled):
        prune(splats, views, HALF, REFIT, progress=listen)

    shares = [share for share, _ in told]
    assert shares == sorted(shares)
    assert told[-1][1] == "refitting"
    assert 0.05 < told[-1][0] < 0.95  # by what merging 5,000 splats costs beside refitting


class Round:
    """Progress that cancels once a round of refitting was done, and counts what is told after."""

    def __init__(self, monkeypatch, rounds):
        self.done, self.told_after, self.rounds = -1, 0, rounds
        cast_errors = RoundRays.psnr

        def count(rays, *arguments):
            psnr = cast_errors(rays, *arguments)
            self.done += 1
            return psnr

        monkeypatch.setattr(RoundRays, "psnr", count)

    def __call__(self, _share, what):
        """Cancel once the rounds are done."""
        over = what == "refitting" and self.done >= self.rounds
        self.told_after += over
        return not over


@pytest.mark.parametrize(("rounds", "became"), [(1, "refit"), (-1, "merge")])
def test_what_was_reached_is_the_result_where_refitting_is_cancelled(
    small, views, monkeypatch, rounds, became
):
    """After a round what that reached, before it what merging left, each with its own PSNR."""
    splats = read_ply(small).splats()
    listen = Round(monkeypatch, rounds)

    result = prune(splats, views, HALF, REFIT, partial=True, progress=listen)

    whole = prune(splats, views, HALF, REFIT)
    told = result.report
    assert isinstance(result.stopped, Cancelled)
    assert listen.told_after == 1
    np.testing.assert_array_equal(result.keep, whole.keep)
    assert told["method"]["done"] == became
    assert told["method"]["psnr"]["merge"] == whole.report["method"]["psnr"]["merge"]
    assert (told.get("refitted", {}).get("rounds", 0) == 1) == (rounds == 1)
    assert told["estimated_psnr"] <= whole.report["estimated_psnr"] + 0.3
    assert any("refitting was stopped" in note for note in told["notes"])


def test_a_file_of_what_was_reached_is_written_where_refitting_is_cancelled(
    small, views, monkeypatch, tmp_path
):
    """As large as asked for, and named in what is raised; without an output nothing is."""
    listen = Round(monkeypatch, 1)

    with pytest.raises(Cancelled) as stop:
        prune_file(small, tmp_path / "out.ply", views, HALF, REFIT, progress=listen)
    with pytest.raises(Cancelled) as bare:
        prune_file(small, None, views, HALF, REFIT, progress=listen)

    notes = stop.value.__notes__
    assert len(read_ply(tmp_path / "out.ply")) == 994
    assert notes[0] == "refitting was stopped after round 1"
    assert notes[1] == f"{tmp_path / 'out.ply'} is written with what that had reached"
    assert not any("written" in note for note in bare.value.__notes__)


def test_a_psnr_that_is_cancelled_has_the_last_try_that_was_done(small, views, monkeypatch):
    """The first try comes close enough, or is the only one; a later one that is cut off is not."""
    splats, listen = read_ply(small).splats(), Round(monkeypatch, 1)

    result = prune(splats, views, Budget(psnr=38.0), REFIT, partial=True, progress=listen)

    assert isinstance(result.stopped, Cancelled)
    assert 0 < np.count_nonzero(result.keep) < len(splats)


def test_levels_that_are_cancelled_while_refitting_are_none(small, views, tmp_path, monkeypatch):
    """All of them or none, whatever the first had reached."""
    levels, listen = Levels((0.5, 0.25)), Round(monkeypatch, 1)

    with pytest.raises(Cancelled):
        lod_file(small, tmp_path / "out", views, levels, REFIT, progress=listen)

    assert not (tmp_path / "out").exists()


def test_refitting_begins_with_deletion_where_that_is_better(small, views):
    """Two views see a third of the splats: half can be deleted with hardly a trace."""
    splats, two = read_ply(small).splats(), ViewSet(tuple(views)[:2])

    result = prune(splats, two, HALF, REFIT)

    told = result.report["method"]["psnr"]
    assert result.report["refitted"]["began"] == "occlusion"
    assert result.report["merged"] == {"changed": 0, "merged": 0, "deleted": 994}
    assert told["refit"] > told["delete"] > told["merge"] + 10.0
    assert any("began with plain deletion" in note for note in result.report["notes"])
