"""Levels of detail: nested, each from the one before, and from how far away each will do."""

import contextlib
import importlib
import math
from dataclasses import replace

import numpy as np
import pytest

from refine_addon.core import (
    Budget,
    Cancelled,
    ClosedForm,
    Levels,
    Merge,
    Occlusion,
    RefineError,
    lod,
    lod_file,
    prune,
    read_cameras,
    read_ply,
    read_splats,
    score,
)
from refine_addon.core.formats.ply_columns import values_by_name
from refine_addon.core.quality.psnr import psnr_against
from refine_addon.core.splats import ARRAYS
from tests.places import ROOM
from tests.strategies import ply_of

from .test_cleaning import cameras, wall

PRUNE = importlib.import_module("refine_addon.core.prune")
TWO = Levels((0.5, 0.25))
QUICK = ClosedForm()


def _merging():
    """Let merging seem better: so few splats can be deleted as well."""
    with pytest.MonkeyPatch.context() as patched:
        patched.setattr(PRUNE, "deletion_will_do", lambda *_: False)
        patched.setattr(PRUNE, "PLAIN", -1.0)
        patched.setattr(PRUNE._Prune, "_deletion_is_as_good", lambda *_: False)
        yield


merges, merging = pytest.fixture(_merging), contextlib.contextmanager(_merging)


def colourful():
    """Return the wall of 576 splats in as many colours."""
    colors = np.random.default_rng(5).uniform(-1.0, 1.0, (576, 3)).astype(np.float32)
    return replace(wall(), sh_dc=colors)


def equal(one, other):
    """Say whether two sets of splats are the same to the bit."""
    pairs = ((getattr(one, item), getattr(other, item)) for item in ARRAYS)
    return all(np.array_equal(a, b) for a, b in pairs)


def file_of(splats, path):
    """Write splats to a PLY."""
    columns = {name: np.float32(values) for name, values in values_by_name(splats).items()}
    path.write_bytes(ply_of(columns))
    return path


@pytest.fixture(scope="module")
def wall_file(tmp_path_factory):
    return file_of(colourful(), tmp_path_factory.mktemp("levels") / "a.ply")


@pytest.fixture(scope="module")
def merged():
    """Return three levels of merged splats, and what their progress told."""
    told, levels = [], Levels((0.5, 0.25, 0.15))
    with merging():
        made = lod(colourful(), cameras(), levels, progress=lambda f, _: told.append(f))
        return list(made), told


@pytest.mark.slow
def test_deleting_keeps_rows_of_the_level_before_as_they_were():
    """Of 576 splats, .5, .3 and .1 are 288, 173 (172.8) and 58 (57.6): rounded up, as with prune.
    One ranking decides, that of a prune by the same method: the kept sets are the same ones."""
    splats, views = colourful(), cameras(2)
    levels = list(lod(splats, views, Levels((0.5, 0.3, 0.1)), QUICK))
    assert [len(level.result.splats) for level in levels] == [288, 173, 58]
    assert [level.number for level in levels] == [1, 2, 3]
    before = np.ones(576, np.bool_)
    for level, ratio in zip(levels, (0.5, 0.7, 0.9), strict=True):
        assert level.result.merged is None
        assert equal(level.result.splats, splats.take(level.result.keep))
        assert not np.any(level.result.keep & ~before)
        alone = prune(splats, views, Budget(ratio=ratio), QUICK)
        np.testing.assert_array_equal(level.result.keep, alone.keep)
        before = level.result.keep


@pytest.mark.slow
def test_each_level_is_merged_from_the_one_before(merges, merged):
    """The first is made from the original, as prune's result is: equal to the bit.
    Rows of others are among those before; one that is unchanged there stayed the original's. What
    was merged before is not thinned by a tenth again. The PSNR is that against the original."""
    splats, levels = colourful(), merged[0]
    wanted = prune(splats, cameras(), Budget(keep=288), Merge())
    np.testing.assert_array_equal(levels[0].result.keep, wanted.keep)
    assert equal(levels[0].result.splats, wanted.merged.splats)
    assert levels[0].psnr == wanted.report["estimated_psnr"]

    before = levels[0]
    for level in levels[1:]:
        assert not np.any(level.result.keep & ~before.result.keep)
        was = before.result.merged.changed[level.result.keep[before.result.keep]]
        assert not np.any(was & ~level.result.merged.changed)
        still = np.flatnonzero(~level.result.merged.changed)
        rows = np.flatnonzero(level.result.keep)[still]
        assert equal(level.result.splats.take(still), splats.take(rows))
        told = level.result.merged
        assert told.merged + told.deleted + len(level.result.splats) == 576
        before = level
    assert levels[2].result.merged.changed.any()
    deleted = [level.result.merged.deleted for level in levels]
    assert deleted[1] - deleted[0] < 0.1 * 288
    sample = score(splats, cameras(), Occlusion()).ray_sample
    against = psnr_against(sample, levels[1].result.splats, cameras())
    assert levels[1].psnr == pytest.approx(against, abs=0.01)


@pytest.mark.slow
@pytest.mark.parametrize("method", [Merge(), QUICK])
def test_protected_splats_are_in_all_levels_unchanged(merges, method):
    """60 of 576 are protected; the last level keeps 115 (115.2 rounds up to 116)."""
    splats, protected = colourful(), np.arange(576) % 10 == 3
    for level in lod(splats, cameras(2), Levels((0.5, 0.2)), method, protected=protected):
        assert level.result.keep[protected].all()
        found = level.result.splats.take(protected[level.result.keep])
        assert equal(found, splats.take(protected))
    assert len(level.result.splats) == 116


@pytest.mark.slow
@pytest.mark.parametrize("method", [Merge(), Occlusion()])
def test_levels_by_psnr_lie_near_it(method):
    """Deleting keeps at least it by the curve; merging comes as near as prune does, .7 dB.
    Between the shares of the curve, straight lines are off by some tenths on so small a scene."""
    splats, views = read_ply(ROOM / "point_cloud.ply").splats(), read_cameras(ROOM / "cameras.json")
    splats, views = splats.take(slice(0, None, 12)), views.take(range(0, 72, 9))
    levels = list(lod(splats, views, Levels(psnr=(34.0, 28.0)), method))
    assert levels[0].psnr == pytest.approx(34.0, abs=1.0)
    assert levels[1].psnr == pytest.approx(28.0, abs=1.0)
    assert len(levels[1].result.splats) < len(levels[0].result.splats) < len(splats)


def test_levels_that_cannot_be_are_refused():
    """Shares lie between 0 and 1, PSNR between 0 and 100 dB; both fall.
    .001 of 5 splats are none, but a level without any is no level."""
    for given, word in (
        ({}, "got none"),
        ({"shares": (1.0,)}, "less than 1"),
        ({"shares": (0.5, 0.0)}, "more than 0"),
        ({"shares": (math.nan,)}, "level is nan"),
        ({"shares": (0.25, 0.5)}, "0.5 comes after 0.25"),
        ({"shares": (0.5, 0.5)}, "expected less"),
        ({"psnr": (30.0, 40.0)}, "40.0 comes after 30.0"),
        ({"psnr": (100.0,)}, "less than 100 dB"),
        ({"shares": tuple(0.9**k for k in range(1, 18))}, "at most 16"),
    ):
        with pytest.raises(RefineError, match=word):
            Levels(**given)
    assert Levels((0.5, 0.001)).budgets(5) == [Budget(keep=3), Budget(keep=1)]


@pytest.mark.slow
def test_progress_only_rises_and_can_cancel(merged):
    """From 0 to 1, whatever the level; False ends it."""

    def deleting(method):
        told = []
        list(lod(colourful(), cameras(2), TWO, method, progress=lambda f, _: told.append(f)))
        return told

    for told, end in ((merged[1], 0.9), (deleting(Occlusion()), 0.99), (deleting(QUICK), 0.99)):
        assert told == sorted(told)
        assert 0.0 <= told[0] < 0.05
        assert end < told[-1] <= 1.0
    for method in (Merge(), Occlusion()):
        with pytest.raises(Cancelled):
            list(lod(colourful(), cameras(2), TWO, method, progress=lambda f, _: f < 0.3))


@pytest.mark.slow
def test_files_of_levels_hold_the_kept_rows_or_what_they_became(tmp_path, wall_file, merged):
    """The bytes are the source's; merged splats are rounded to float32 once.
    In any format; what it loses is noted."""
    out = tmp_path / "out"

    done = lod_file(wall_file, out, cameras(2), TWO, QUICK)

    assert sorted(path.name for path in out.iterdir()) == ["a.lod1.ply", "a.lod2.ply"]
    assert done["nested"] is True
    assert [entry["splats"] for entry in done["levels"]] == [288, 144]
    for entry in done["levels"]:
        assert (out / entry["file"]).stat().st_size == entry["bytes"]
    wanted = prune(colourful(), cameras(2), Budget(ratio=0.75), QUICK).keep
    rows = read_ply(wall_file).rows[wanted]
    np.testing.assert_array_equal(read_ply(out / "a.lod2.ply").rows, rows)

    done = lod_file(wall_file, tmp_path / "b.splat", cameras(2), Levels((0.5,)), QUICK)
    assert len(read_splats(tmp_path / "b.lod1.splat")) == 288
    assert any(".splat" in note for note in done["notes"])
    with merging():
        lod_file(wall_file, tmp_path, cameras(), TWO)
    became = merged[0][1].result.splats
    written = read_ply(tmp_path / "a.lod2.ply").splats()
    for name in ("means", "opacity_logits"):
        expected = getattr(became, name).astype(np.float32)
        np.testing.assert_array_equal(getattr(written, name), expected)


@pytest.mark.slow
def test_levels_that_were_written_go_where_writing_is_cancelled(tmp_path, wall_file):
    def stop(_, what):
        return what != "writing"

    with pytest.raises(Cancelled):
        lod_file(wall_file, tmp_path / "out", cameras(2), TWO, QUICK, progress=stop)
    assert list(tmp_path.iterdir()) == []
