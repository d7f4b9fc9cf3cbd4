"""Tiles whose survivors are refitted, against one file in memory."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.lib.recfunctions import drop_fields

from refine_addon.core import (
    Budget,
    PruneRequest,
    Settings,
    prune_file,
    prune_tiles,
    read_cameras,
    read_ply,
)
from refine_addon.core.quality.psnr import psnr_against
from refine_addon.core.refit import round_rays
from refine_addon.core.refit.refit import Refit
from refine_addon.core.refit.round_rays import Window
from refine_addon.core.scoring import closed_form
from refine_addon.core.splats import joined
from refine_addon.core.tiles import absorbing, gaussians, refitting, units
from refine_addon.core.views import ViewSet
from refine_addon.core.visibility import projection
from refine_addon.core.visibility.cast import cast
from refine_addon.core.visibility.ray_sample import validation_rays
from tests.strategies import plain_header, splat_names
from tests.tiles import COUNT, ROOM, cut, room_rows, told_by_plan, write

OCCLUSION = Settings(method="occlusion", views=8)
HALF = Budget(ratio=0.5)


@pytest.fixture(autouse=True)
def small(monkeypatch):
    """Make units, chunks and regions so small that 5000 splats have several of each; few rays."""
    told_by_plan(monkeypatch)
    monkeypatch.setattr(closed_form, "ROWS", 1000)
    monkeypatch.setattr(units, "ROWS", 1000)
    monkeypatch.setattr(gaussians, "CHUNK", 700)
    monkeypatch.setattr(absorbing, "REGION", 1500)
    monkeypatch.setattr(round_rays, "MIN_RAYS", 1 << 14)


@pytest.fixture
def views():
    """Give the room's cameras."""
    return read_cameras(ROOM / "cameras.json")


@pytest.fixture
def tiles(tmp_path):
    """Write rows of the room as four files, and as one."""
    write(tmp_path / "whole.ply", room_rows())
    return cut(tmp_path, room_rows())


def read(folder, paths):
    """Return the rows of the outputs of some tiles."""
    return np.concatenate([read_ply(folder / path.name).rows for path in paths])


def request(views, budget=HALF, settings=OCCLUSION):
    return PruneRequest(views, budget, settings, survivors="refit")


@pytest.mark.slow
@pytest.mark.parametrize(("ratio", "rounds"), [(0.1, None), (0.5, None), (0.5, 1)])
def test_refitting_a_single_region_is_refitting_one_file(
    tmp_path, tiles, views, monkeypatch, ratio, rounds
):
    """Where one region holds all splats, every row is the same to the byte; also if none merged.

    With chunks as they are: of pieces of another length, sums may round otherwise.
    """
    monkeypatch.setattr(absorbing, "REGION", COUNT)
    monkeypatch.setattr(gaussians, "CHUNK", 1 << 16)
    asked = request(views, Budget(ratio=ratio), replace(OCCLUSION, refit=Refit(rounds)))

    told = prune_tiles(tiles, tmp_path / "out", asked)
    whole = prune_file(tmp_path / "whole.ply", tmp_path / "pruned.ply", asked)

    facts, expected = told["refitted"], whole.report["refitted"]
    assert {**facts, "seconds": 0.0} == {**expected, "seconds": 0.0}
    assert facts["psnr"] >= facts["psnr_before"]
    assert rounds is None or facts["rounds"] == rounds
    assert told["absorbed"] == whole.report["absorbed"]
    assert (
        read(tmp_path / "out", tiles).tobytes() == read_ply(tmp_path / "pruned.ply").rows.tobytes()
    )
    assert told["estimated_psnr"] == pytest.approx(whole.report["estimated_psnr"], abs=0.011)


@pytest.mark.slow
def test_refitting_regions_is_as_good_as_refitting_one_file(tmp_path, tiles, views):
    """Within 1.3 dB by rays of all views: regions of 600 survivors are border for the most part.

    Larger ones come closer (docs/scale.md). The report tells how many rows changed; all others are
    their old bytes.
    """
    told = prune_tiles(tiles, tmp_path / "out", request(views))
    prune_file(tmp_path / "whole.ply", tmp_path / "pruned.ply", request(views))
    absorb = replace(request(views), survivors="absorb")
    absorbed = prune_tiles(tiles, tmp_path / "absorbed", absorb)

    used = views.spread(8)
    rays = validation_rays(read_ply(tmp_path / "whole.ply").splats(), used)
    made = joined([read_ply(tmp_path / "out" / path.name).splats() for path in tiles])
    one = psnr_against(rays, read_ply(tmp_path / "pruned.ply").splats(), used)
    psnr = psnr_against(rays, made, used)
    facts = told["refitted"]
    assert psnr > one - 1.3
    assert told["estimated_psnr"] == pytest.approx(psnr, abs=0.1)
    assert facts["psnr_before"] == absorbed["estimated_psnr"]
    assert facts["psnr"] == told["estimated_psnr"] > absorbed["estimated_psnr"] + 1.0
    assert told["absorbed"] == absorbed["absorbed"]
    same = np.isin(read(tmp_path / "out", tiles).view("V248"), room_rows().view("V248"))
    assert facts["changed"] <= np.count_nonzero(~same) <= len(made) == COUNT // 2
    assert any("survivors were refitted" in note for note in told["notes"])


@pytest.mark.slow
def test_a_job_that_was_interrupted_while_refitting_goes_on_where_it_was(
    tmp_path, tiles, views, monkeypatch
):
    """Regions that are done are not refitted again, and the bytes are the same."""
    monkeypatch.setattr(absorbing, "REGION", 2600)
    few = request(views, settings=replace(OCCLUSION, views=4))
    done, refit_on = [], refitting.refit_on
    monkeypatch.setattr(
        refitting, "refit_on", lambda *some, **more: done.append(some) or refit_on(*some, **more)
    )
    stops = iter([0.5, 0.6, 0.7])
    stop = next(stops)

    def interrupt(fraction, _what):
        if fraction > stop:
            raise KeyboardInterrupt

    prune_tiles(tiles, tmp_path / "once", few)
    needed = len(done)
    done.clear()
    while stop < 1.0:
        with pytest.raises(KeyboardInterrupt):
            prune_tiles(tiles, tmp_path / "often", few, progress=interrupt)
        stop = next(stops, 1.0)
    prune_tiles(tiles, tmp_path / "often", few)

    assert needed == 2  # regions
    assert needed <= len(done) <= needed + 3  # those under way
    assert read(tmp_path / "often", tiles).tobytes() == read(tmp_path / "once", tiles).tobytes()


@pytest.mark.slow
def test_what_no_view_shows_is_refitted_to_nothing(tmp_path, tiles, views):
    """One view of the room: it shows regions in part, and rows beyond it stay as they were."""
    one = ViewSet(views.views[:1])
    absorb = replace(request(one), survivors="absorb")
    prune_tiles(tiles, tmp_path / "absorbed", absorb)

    told = prune_tiles(tiles, tmp_path / "out", request(one))

    before, after = (read(tmp_path / name, tiles) for name in ("absorbed", "out"))
    assert np.count_nonzero(before != after) == told["refitted"]["changed"]
    assert 0 < told["refitted"]["changed"] < len(after) // 2


@pytest.mark.slow
def test_regions_of_other_degrees_are_settled_together(tmp_path, views):
    """Two rooms side by side, one without view-dependent colours: no region holds both."""
    rows = room_rows()
    write(tmp_path / "a.ply", rows[:2500])
    flat = drop_fields(rows[2500:], [name for name in rows.dtype.names if "rest" in name])
    names = splat_names(0)
    plain = np.empty(len(flat), [(name, "<f4") for name in names])
    for name in names:
        plain[name] = flat[name]
    plain["x"] += 100.0
    (tmp_path / "b.ply").write_bytes(plain_header(len(plain), names) + plain.tobytes())

    told = prune_tiles([tmp_path / "b.ply", tmp_path / "a.ply"], tmp_path / "out", request(views))

    made = [read_ply(tmp_path / "out" / name).splats() for name in ("a.ply", "b.ply")]
    assert [splats.sh_rest.shape[1] for splats in made] == [15, 0]
    assert sum(map(len, made)) == told["splats"]["kept"] == COUNT // 2
    assert np.abs(made[0].sh_rest).max() > 0.1


@given(st.integers(0, 200))
def test_a_window_leaves_out_no_footprint_that_reaches_into_it(seed):
    """Rays through a part of an image hit the same with what may reach into it, and with all."""
    random = np.random.default_rng(seed)
    cameras = read_cameras(ROOM / "cameras.json")
    file = read_ply(ROOM / "point_cloud.ply")
    splats = file.splats().take(random.permutation(len(file))[:400])
    splats = replace(splats, log_scales=splats.log_scales + random.normal(1.0, 1.0))
    shown, scene, _ = projection.prepare(splats, cameras)
    view = cameras.views[seed % len(cameras)]
    left, top = (int(random.integers(0, size - 8)) for size in (view.width, view.height))
    window = Window(view, 0, 1.0, 64.0, 1e9, left, top, 8, 8)

    some, depth = projection.footprints_and_depths(shown, scene, view, window.part)

    every = projection.project(shown, scene, view)
    columns, pixel_rows = window.pixels(1.0, 3)
    assert columns.min() >= left
    assert columns.max() < left + 8
    found, expected = (
        cast(footprints, columns, pixel_rows)
        for footprints in (projection.front_to_back([(some, depth)]), every)
    )
    np.testing.assert_array_equal(found.hit, expected.hit)
    np.testing.assert_array_equal(found.alpha, expected.alpha)
    assert len(depth) <= len(every.index)
