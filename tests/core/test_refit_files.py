"""Kept splats that are refitted: from file to file, with levels, and what is said of it."""

from dataclasses import replace

import numpy as np
import pytest

from refine_addon.core import (
    Box,
    Budget,
    Levels,
    Refit,
    ViewSet,
    Zone,
    lod,
    lod_file,
    prune,
    prune_file,
    read_ply,
)
from refine_addon.core.execute import Cancelled
from refine_addon.core.quality.psnr import psnr_against
from refine_addon.core.refit import round_rays
from refine_addon.core.splats import ARRAYS
from refine_addon.core.visibility.cast import validation_rays
from tests.strategies import ply_of

from .test_prune import FEW, HALF, file, small, splats, views  # noqa: F401 - fixtures

REFIT = Refit(12)

pytestmark = pytest.mark.slow


@pytest.fixture(autouse=True, scope="module")
def few_rays():
    """Cast half of the rays, which is enough for 2,000 splats."""
    with pytest.MonkeyPatch.context() as patched:
        patched.setattr(round_rays, "MIN_RAYS", 1 << 16)
        yield


@pytest.fixture(scope="module")
def refitted(small, views, tmp_path_factory):
    """Return the file of the refitted half, and what was decided."""
    path = tmp_path_factory.mktemp("refitted") / "out.ply"
    return path, prune_file(small, path, views, HALF, REFIT)


def test_refitting_comes_closer_than_merging_and_says_by_how_much(splats, small, views, refitted):
    """The same rows stay; rays that neither went by say that the pictures are closer.

    Only what makes a splat changes in the file, and only of kept splats that the result names.
    """
    path, result = refitted
    merged, facts = prune(splats, views, HALF, FEW), result.report["refitted"]
    used, changed = views.spread(FEW.views), result.merged.changed
    rays = validation_rays(splats, used)
    found = [psnr_against(rays, each.splats, used) for each in (merged, result)]
    before, after = read_ply(small), read_ply(path)

    assert np.array_equal(result.keep, merged.keep)
    assert found[1] > found[0] + 1.0
    assert facts["psnr"] > facts["psnr_before"] + 1.0
    assert facts["rounds"] >= 1
    assert 0 < facts["changed"] <= np.count_nonzero(changed)
    assert facts["seconds"] > 0.0
    assert result.report["merged"] == merged.report["merged"]
    assert any("splats were refitted" in note for note in result.report["notes"])
    assert after.rows[~changed].tobytes() == before.rows[result.keep][~changed].tobytes()
    for name in ARRAYS:
        wanted = getattr(result.merged.splats, name).astype(np.float32)
        np.testing.assert_array_equal(getattr(after.splats(), name), wanted)


def test_rounds_are_as_many_as_asked_for_and_each_comes_closer(splats, views):
    told = [prune(splats, views, HALF, Refit(12, rounds)).report["refitted"] for rounds in (1, 3)]

    assert [facts["rounds"] for facts in told] == [1, 3]
    assert told[0]["psnr"] < told[1]["psnr"]


@pytest.mark.parametrize("method", [FEW, REFIT], ids=["merge", "refit"])
def test_kept_splats_of_doubles_are_doubles(small, views, tmp_path, method):
    """At an offset of 1e6, float32 knows steps of .0625: each kept splat has a place of its own.

    Every number written is what merging or refitting came to, to the last bit; unchanged rows stay,
    those of the tenth that is protected among them, and so does what is not of a splat.
    """
    rows = read_ply(small).rows
    columns = {name: rows[name].astype("f8") for name in rows.dtype.names}
    columns["x"] += 1e6
    columns["mine"] = np.arange(len(rows), dtype="i4")
    (tmp_path / "in.ply").write_bytes(ply_of(columns))
    shift = np.array([1e6, 0.0, 0.0])
    moved = ViewSet(tuple(replace(view, center=view.center + shift) for view in views))
    edge = np.quantile(columns["x"], 0.9)
    zone = Zone("protect", "tenth", Box((edge, -np.inf, -np.inf), (np.inf, np.inf, np.inf)))
    protected = columns["x"] >= edge
    asked = moved, Budget(ratio=0.6), method
    result = prune_file(tmp_path / "in.ply", tmp_path / "out.ply", *asked, zones=[zone])
    written, changed = read_ply(tmp_path / "out.ply"), result.merged.changed
    old = read_ply(tmp_path / "in.ply").rows[result.keep]

    assert len(written) == len(rows) - len(rows) * 6 // 10
    np.testing.assert_array_equal(written.rows["mine"], np.flatnonzero(result.keep))
    assert len(np.unique(written.rows["x"][changed])) == np.count_nonzero(changed) > 50
    assert result.keep[protected].all()
    assert not changed[protected[result.keep]].any()
    assert written.rows[~changed].tobytes() == old[~changed].tobytes()
    for name in ARRAYS:
        wanted = getattr(result.merged.splats, name)
        np.testing.assert_array_equal(getattr(written.splats(), name), wanted)
        assert wanted.dtype == np.float64
    assert any("merged into" in note for note in result.report["notes"])


def test_a_psnr_is_reached_with_fewer_splats_than_by_merging(splats, views):
    """To a dB by the estimate; the curve of refitting is tried, then put right by what it gave."""
    merged, refitted = (prune(splats, views, Budget(psnr=38.0), method) for method in (FEW, REFIT))

    assert refitted.report["estimated_psnr"] == pytest.approx(38.0, abs=1.0)
    assert refitted.report["estimated_psnr"] > merged.report["estimated_psnr"]
    assert np.count_nonzero(refitted.keep) < np.count_nonzero(merged.keep)


def test_levels_are_refitted_to_the_original(splats, views):
    """The second, too, though it is made from the first: it is closer than without refitting."""
    plain, better = (lod(splats, views, Levels((0.5, 0.25)), method) for method in (FEW, REFIT))
    for one, other in zip(plain, better, strict=True):
        assert len(one.result.splats) == len(other.result.splats)
        assert other.psnr > one.psnr + 0.5


def test_progress_rises_and_can_end_while_refitting(splats, views):
    """Progress that refitting tells lies between those of merging and of the estimate."""
    told = []

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
    """Progress that cancels once some rounds of refitting were done."""

    def __init__(self, monkeypatch, rounds):
        self.done, self.rounds, psnr = -1, rounds, round_rays.RoundRays.psnr

        def count(*arguments):
            found = psnr(*arguments)
            self.done += 1
            return found

        monkeypatch.setattr(round_rays.RoundRays, "psnr", count)

    def __call__(self, _share, what):
        """Tell whether to go on."""
        return what != "refitting" or self.done < self.rounds


@pytest.mark.parametrize(("rounds", "became"), [(1, "refit"), (-1, "merge")])
def test_what_was_reached_is_the_result_where_refitting_is_cancelled(
    splats, views, refitted, monkeypatch, rounds, became
):
    """After a round what that reached, before it what merging left, each with its own PSNR."""
    listen, whole = Round(monkeypatch, rounds), refitted[1]
    result = prune(splats, views, HALF, REFIT, partial=True, progress=listen)
    told = result.report
    assert isinstance(result.stopped, Cancelled)
    np.testing.assert_array_equal(result.keep, whole.keep)
    assert told["method"]["done"] == became
    assert told["method"]["psnr"]["merge"] == whole.report["method"]["psnr"]["merge"]
    assert (told.get("refitted", {}).get("rounds", 0) == 1) == (rounds == 1)
    assert told["estimated_psnr"] <= whole.report["estimated_psnr"] + 0.3
    assert any("refitting was stopped" in note for note in told["notes"])


def test_a_psnr_that_is_cancelled_is_what_was_done_and_levels_are_none(
    splats, small, views, tmp_path, monkeypatch
):
    """The first try comes close enough; a later one that is cut off is none."""
    listen = Round(monkeypatch, 1)
    result = prune(splats, views, Budget(psnr=38.0), REFIT, partial=True, progress=listen)
    assert isinstance(result.stopped, Cancelled)
    assert 0 < np.count_nonzero(result.keep) < len(splats)
    listen.done = -1
    with pytest.raises(Cancelled):
        lod_file(small, tmp_path / "out", views, Levels((0.5, 0.25)), REFIT, progress=listen)
    assert not (tmp_path / "out").exists()


def test_refitting_begins_with_deletion_where_that_is_better(splats, views):
    """Two views see a third of the splats: half can be deleted with hardly a trace."""
    result = prune(splats, ViewSet(tuple(views)[:2]), HALF, REFIT)
    told = result.report["method"]["psnr"]
    assert result.report["refitted"]["began"] == "occlusion"
    assert result.report["merged"] == {"changed": 0, "merged": 0, "deleted": 994}
    assert told["refit"] > told["delete"] > told["merge"] + 5.0
    assert any("began with plain deletion" in note for note in result.report["notes"])
