"""Levels of detail: nested, each from the one before, and from how far away each will do."""

from __future__ import annotations

import importlib
import math
from dataclasses import replace
from pathlib import Path

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
    Splats,
    lod,
    lod_file,
    prune,
    read_cameras,
    read_ply,
    read_splats,
    score,
)
from refine_addon.core.formats.ply import SplatFile
from refine_addon.core.merging import merge as merging
from refine_addon.core.quality.psnr import psnr_against
from refine_addon.core.splats import ARRAYS

from .test_cleaning import cameras, wall

PRUNE = importlib.import_module("refine_addon.core.prune")
ROOM = Path(__file__).parents[1] / "data/room_small"
TWO = Levels((0.5, 0.25))
QUICK = ClosedForm()


@pytest.fixture
def merges(monkeypatch):
    """Let merging seem better: so few splats can be deleted as well."""
    monkeypatch.setattr(PRUNE, "deletion_will_do", lambda *_: False)
    monkeypatch.setattr(PRUNE, "PLAIN", -1.0)
    monkeypatch.setattr(PRUNE._Prune, "_deletion_is_as_good", lambda *_: False)


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
    names = ["x", "y", "z", "f_dc_0", "f_dc_1", "f_dc_2", "opacity"]
    names += [f"scale_{k}" for k in range(3)] + [f"rot_{k}" for k in range(4)]
    columns = (
        splats.means, splats.sh_dc, splats.opacity_logits[:, None], splats.log_scales,
        splats.quaternions,
    )  # fmt: skip
    lines = ["ply", "format binary_little_endian 1.0", f"element vertex {len(splats)}"]
    head = "\n".join([*lines, *(f"property float {name}" for name in names), "end_header", ""])
    path.write_bytes(head.encode() + np.hstack(columns).astype("<f4").tobytes())
    return path


@pytest.mark.slow
def test_deleting_keeps_rows_of_the_level_before_as_they_were():
    """Of 576 splats, .5, .3 and .1 are 288, 173 (172.8) and 58 (57.6): rounded up, as with prune.

    One ranking decides, that of a prune by the same method: the kept sets are the same ones.
    """
    splats, views = colourful(), cameras()

    levels = list(lod(splats, views, Levels((0.5, 0.3, 0.1)), Occlusion()))

    assert [len(level.result.splats) for level in levels] == [288, 173, 58]
    assert [level.number for level in levels] == [1, 2, 3]
    before = np.ones(576, np.bool_)
    for level, ratio in zip(levels, (0.5, 0.7, 0.9), strict=True):
        assert level.result.merged is None
        assert equal(level.result.splats, splats.take(level.result.keep))
        assert not np.any(level.result.keep & ~before)
        alone = prune(splats, views, Budget(ratio=ratio), Occlusion())
        np.testing.assert_array_equal(level.result.keep, alone.keep)
        before = level.result.keep


@pytest.mark.slow
def test_the_first_level_is_what_prune_merges(merges):
    """It is made from the original, as prune's result is: equal to the bit."""
    splats, views = colourful(), cameras()
    wanted = prune(splats, views, Budget(keep=288), Merge())

    first = next(lod(splats, views, Levels((0.5, 0.25))))

    np.testing.assert_array_equal(first.result.keep, wanted.keep)
    assert equal(first.result.splats, wanted.merged.splats)
    assert first.psnr == wanted.report["estimated_psnr"]


@pytest.mark.slow
def test_each_level_is_merged_from_the_one_before(merges):
    """Its rows are among those before; one that is unchanged there stayed the original's."""
    splats, views = colourful(), cameras()

    levels = list(lod(splats, views, Levels((0.6, 0.3, 0.15))))

    before = levels[0]
    for level in levels[1:]:
        assert not np.any(level.result.keep & ~before.result.keep)
        was = before.result.merged.changed[level.result.keep[before.result.keep]]
        assert not np.any(was & ~level.result.merged.changed)
        still = np.flatnonzero(~level.result.merged.changed)
        rows = np.flatnonzero(level.result.keep)[still]
        assert equal(level.result.splats.take(still), joined_in_double(splats.take(rows)))
        told = level.result.merged
        assert told.merged + told.deleted + len(level.result.splats) == 576
        before = level
    assert levels[2].result.merged.changed.any()


def joined_in_double(splats):
    """Return splats in float64, which holds float32 exactly."""
    return Splats(**{f: getattr(splats, f).astype(np.float64) for f in ARRAYS})


@pytest.mark.slow
def test_what_was_merged_before_is_not_thinned_by_a_tenth_again(merges, monkeypatch):
    """Of 576, 57 are deleted before any merge; of the 288 left, none are, since 288 went already.

    The penalty goes by what has gone of the 519: 1 - 288/519, then 1 - 144/519.
    """
    given, shares, whole, plain = [], [], merging.merge, merging.merge_penalty
    monkeypatch.setattr(
        PRUNE,
        "merge",
        lambda *rest, **named: (
            given.append(len(rest[0]) - named["deleted"].sum()) or whole(*rest, **named)
        ),
    )
    monkeypatch.setattr(
        merging, "merge_penalty", lambda share: shares.append(share) or plain(share)
    )

    list(lod(colourful(), cameras(), Levels((0.5, 0.25))))

    assert given == [519, 288]
    assert shares == [1.0 - 288 / 519, 1.0 - 144 / 519]


@pytest.mark.slow
@pytest.mark.parametrize("method", [Merge(), Occlusion()])
def test_protected_splats_are_in_all_levels_unchanged(merges, method):
    """60 of 576 are protected; the last level keeps 115 (115.2 rounds up to 116)."""
    splats, protected = colourful(), np.arange(576) % 10 == 3

    for level in lod(splats, cameras(), Levels((0.5, 0.2)), method, protected=protected):
        assert level.result.keep[protected].all()
        there = protected[level.result.keep]
        wanted = splats.take(protected)
        found = level.result.splats.take(there)
        assert equal(found, joined_in_double(wanted) if level.result.merged else wanted)
    assert len(level.result.splats) == 116


@pytest.mark.slow
@pytest.mark.parametrize("method", [Merge(), Occlusion()])
def test_levels_by_psnr_lie_near_it(method):
    """Deleting keeps at least it by the curve; merging comes as near as prune does, .7 dB.

    Between the shares of the curve, straight lines are off by some tenths on so small a scene.
    """
    splats, views = read_ply(ROOM / "point_cloud.ply").splats(), read_cameras(ROOM / "cameras.json")
    splats, views = splats.take(slice(0, None, 8)), views.take(range(0, 72, 6))

    levels = list(lod(splats, views, Levels(psnr=(34.0, 28.0)), method))

    assert levels[0].psnr == pytest.approx(34.0, abs=1.0)
    assert levels[1].psnr == pytest.approx(28.0, abs=1.0)
    assert len(levels[1].result.splats) < len(levels[0].result.splats) < len(splats)


@pytest.mark.slow
def test_the_psnr_of_a_level_is_against_the_original(merges):
    """The estimate of the second level is that of its splats against all, not against the first."""
    splats, views = colourful(), cameras()
    levels = list(lod(splats, views, Levels((0.5, 0.2))))
    sample = score(splats, views, Occlusion()).ray_sample

    assert levels[1].psnr == pytest.approx(
        psnr_against(sample, levels[1].result.splats, views), abs=0.01
    )


@pytest.mark.parametrize(
    ("given", "word"),
    [
        ({}, "got none"),
        ({"shares": (0.5,), "psnr": (40.0,)}, "got both"),
        ({"shares": (1.0,)}, "less than 1"),
        ({"shares": (0.5, 0.0)}, "more than 0"),
        ({"shares": (math.nan,)}, "level is nan"),
        ({"shares": (0.25, 0.5)}, "0.5 comes after 0.25"),
        ({"shares": (0.5, 0.5)}, "expected less"),
        ({"psnr": (30.0, 40.0)}, "40.0 comes after 30.0"),
        ({"psnr": (100.0,)}, "less than 100 dB"),
        ({"shares": tuple(0.9**k for k in range(1, 18))}, "at most 16"),
    ],
)
def test_levels_that_cannot_be_are_refused(given, word):
    """Shares lie between 0 and 1, PSNR between 0 and 100 dB; both fall."""
    with pytest.raises(RefineError, match=word):
        Levels(**given)


def test_one_splat_stays_at_least():
    """.001 of 5 splats are none, but a level without any is no level."""
    assert Levels((0.5, 0.001)).budgets(5) == [Budget(keep=3), Budget(keep=1)]


@pytest.mark.slow
@pytest.mark.parametrize("method", [Merge(), Occlusion()])
def test_progress_only_rises_and_can_cancel(method):
    """From 0 to 1, whatever the level; False ends it."""
    told, levels = [], Levels((0.5, 0.2))
    list(lod(colourful(), cameras(), levels, method, progress=lambda f, _: told.append(f)))

    assert told == sorted(told)
    assert 0.0 <= told[0] < 0.05
    assert 0.9 < told[-1] <= 1.0
    with pytest.raises(Cancelled):
        list(lod(colourful(), cameras(), levels, method, progress=lambda f, _: f < 0.5))


def test_files_of_levels_are_written(tmp_path):
    """The bytes of kept rows are the source's."""
    source = file_of(colourful(), tmp_path / "a.ply")
    out = tmp_path / "out"

    done = lod_file(source, out, cameras(2), TWO, QUICK)

    assert sorted(path.name for path in out.iterdir()) == ["a.lod1.ply", "a.lod2.ply"]
    assert done["nested"] is True
    assert [entry["splats"] for entry in done["levels"]] == [288, 144]
    for entry in done["levels"]:
        assert (out / entry["file"]).stat().st_size == entry["bytes"]
    rows = read_ply(source).rows
    wanted = prune(colourful(), cameras(2), Budget(ratio=0.75), QUICK).keep
    np.testing.assert_array_equal(read_ply(out / "a.lod2.ply").rows, rows[wanted])


@pytest.mark.slow
def test_files_of_merged_levels_hold_what_kept_splats_became(tmp_path, merges):
    """In float32, rounded once."""
    source = file_of(colourful(), tmp_path / "a.ply")
    levels = list(lod(read_ply(source).splats(), cameras(), TWO))

    lod_file(source, tmp_path, cameras(), Levels((0.5, 0.25)))

    written = read_ply(tmp_path / "a.lod2.ply").splats()
    np.testing.assert_array_equal(written.means, levels[1].result.splats.means.astype(np.float32))
    np.testing.assert_array_equal(
        written.opacity_logits, levels[1].result.splats.opacity_logits.astype(np.float32)
    )


@pytest.mark.parametrize("suffix", [".splat", ".glb", ".compressed.ply"])
def test_levels_are_written_in_any_format(tmp_path, suffix):
    """As many splats, in a file that is read by its content, with what the format loses noted."""
    source = file_of(colourful(), tmp_path / "a.ply")
    levels = Levels((0.5,))

    done = lod_file(source, tmp_path / f"b{suffix}", cameras(2), levels, QUICK)

    assert done["levels"][0]["file"] == f"b.lod1{suffix}"
    assert len(read_splats(tmp_path / f"b.lod1{suffix}")) == 288
    assert any(suffix in note for note in done["notes"])


@pytest.mark.parametrize("name", ["a.lod1.ply", "a.lod2.ply"])
def test_no_file_is_replaced_unless_told(tmp_path, name):
    """Said before any work, and nothing else is written."""
    source = file_of(colourful(), tmp_path / "a.ply")
    (tmp_path / name).write_text("mine")

    with pytest.raises(RefineError, match="exists already"):
        lod_file(source, tmp_path, cameras(), Levels((0.5, 0.25)))

    assert sorted(path.name for path in tmp_path.iterdir()) == sorted(["a.ply", name])
    lod_file(source, tmp_path, cameras(2), TWO, QUICK, overwrite=True)
    assert (tmp_path / name).read_bytes()[:4] != b"mine"


def failing_second(monkeypatch, error):
    """Let the second file that is written raise."""
    whole, calls = SplatFile.write, []

    def write(self, *rest, **named):
        calls.append(1)
        if len(calls) == 2:
            raise error
        return whole(self, *rest, **named)

    monkeypatch.setattr(SplatFile, "write", write)


@pytest.mark.parametrize("error", [RefineError("no space"), KeyboardInterrupt()])
def test_levels_that_were_written_go_where_a_later_one_fails(tmp_path, monkeypatch, error):
    """The folder that was made for them goes too."""
    source = file_of(colourful(), tmp_path / "a.ply")
    failing_second(monkeypatch, error)

    with pytest.raises(type(error)):
        lod_file(source, tmp_path / "out", cameras(2), TWO, QUICK)

    assert [path.name for path in tmp_path.iterdir()] == ["a.ply"]
