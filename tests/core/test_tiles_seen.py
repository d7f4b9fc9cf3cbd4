"""Tiles pruned together by occlusion and with absorbing, against one file in memory."""

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
    RefineError,
    Settings,
    prune,
    prune_file,
    prune_tiles,
    read_cameras,
    read_ply,
)
from refine_addon.core.quality.psnr import psnr_against
from refine_addon.core.scoring import closed_form
from refine_addon.core.splats import joined
from refine_addon.core.tiles import absorbing, gaussians, seeing, units
from refine_addon.core.tiles.folder import Folder
from refine_addon.core.tiles.gaussians import SceneContext
from refine_addon.core.tiles.seeing import StoredRays
from refine_addon.core.tiles.workers import InProcess, Runner
from refine_addon.core.views import ViewSet
from refine_addon.core.visibility import projection
from refine_addon.core.visibility.ray_sample import validation_rays
from tests.strategies import plain_header, splat_names
from tests.tiles import COUNT, ROOM, cut, room_rows, told_by_plan, write

OCCLUSION = Settings(method="occlusion", views=12)


@pytest.fixture
def small(monkeypatch):
    """Make units, chunks and regions so small that 5000 splats have several of each."""
    told_by_plan(monkeypatch)
    monkeypatch.setattr(closed_form, "ROWS", 1000)
    monkeypatch.setattr(units, "ROWS", 1000)
    monkeypatch.setattr(gaussians, "CHUNK", 700)
    monkeypatch.setattr(absorbing, "REGION", 1500)


@pytest.fixture
def rows():
    """Give rows of the room, and one far away."""
    rows = room_rows()
    rows["x"][7] = 1e30
    return rows


@pytest.fixture(scope="module")
def views():
    """Give the room's cameras."""
    return read_cameras(ROOM / "cameras.json")


@pytest.fixture
def tiles(tmp_path, rows, small):
    """Write the rows as four files, and as one."""
    write(tmp_path / "whole.ply", rows)
    return cut(tmp_path, rows)


def read(folder, paths):
    """Return the rows of the outputs of some tiles."""
    return np.concatenate([read_ply(folder / path.name).rows for path in paths])


# Occlusion and what it estimates.


@pytest.mark.slow
@pytest.mark.parametrize(
    "budget", [Budget(ratio=0.7), Budget(psnr=36.0), Budget(min_seen=60)], ids=str
)
def test_of_tiles_the_same_rows_stay_as_of_one_file(tmp_path, tiles, views, budget):
    """To the byte, and the estimates are the same but for how rounding adds up."""
    request = PruneRequest(views, budget, OCCLUSION, survivors="unchanged")
    told = prune_tiles(tiles, tmp_path / "out", request)
    whole = prune_file(tmp_path / "whole.ply", tmp_path / "pruned.ply", request)

    expected = read_ply(tmp_path / "pruned.ply").rows
    assert read(tmp_path / "out", tiles).tobytes() == expected.tobytes()
    expected = {**whole.report["splats"]}
    del expected["unseen_removed"]  # what tiles do not tell
    assert told["splats"] == expected
    assert told["views"] == whole.report["views"]
    assert told["estimated_psnr"] == pytest.approx(whole.report["estimated_psnr"], abs=0.011)
    for key in ("psnr", "absorbed"):
        assert told["quality"][key] == pytest.approx(whole.report["quality"][key], abs=1e-6)
    # Tiles tell nothing of views between those that decided, and so not what these cannot know.
    notes = [note for note in whole.report["notes"] if "one view or none" not in note]
    assert told["notes"] == notes


@pytest.mark.slow
@pytest.mark.parametrize("model", ["antialiased", "2dgs"])
def test_tiles_of_every_model_are_pruned_as_one_file(tmp_path, tiles, views, model):
    """Scored to the byte; absorbed region by region, written as the model that they are."""
    request = PruneRequest(
        views, Budget(ratio=0.5), replace(OCCLUSION, views=6), survivors="unchanged", model=model
    )
    prune_tiles(tiles, tmp_path / "out", request)
    prune_file(tmp_path / "whole.ply", tmp_path / "pruned.ply", request)

    expected = read_ply(tmp_path / "pruned.ply").rows
    assert read(tmp_path / "out", tiles).tobytes() == expected.tobytes()
    assert {read_ply(tmp_path / "out" / tile.name).model for tile in tiles} == {model}

    prune_tiles(tiles, tmp_path / "merged", replace(request, survivors="absorb"))

    merged = [read_ply(tmp_path / "merged" / tile.name) for tile in tiles]
    assert {file.model for file in merged} == {model}
    assert sum(map(len, merged)) == COUNT - COUNT // 2


@pytest.mark.slow
def test_views_of_nothing_are_refused_as_of_one_file(tmp_path, tiles, views):
    """Near planes behind all splats: the message is that of one file, and nothing is left."""
    away = ViewSet(tuple(replace(view, near=1e6) for view in views))
    with pytest.raises(RefineError) as alone:
        prune_file(tmp_path / "whole.ply", None, PruneRequest(away, Budget(ratio=0.5), OCCLUSION))

    with pytest.raises(RefineError) as together:
        prune_tiles(tiles, tmp_path / "out", PruneRequest(away, Budget(ratio=0.5), OCCLUSION))

    assert str(together.value) == str(alone.value)
    assert not list((tmp_path / "out").glob("*"))


@pytest.mark.slow
@pytest.mark.parametrize("survivors", ["unchanged", "absorb"], ids=["deleted", "absorbed"])
def test_a_job_that_was_interrupted_goes_on_where_it_was(
    tmp_path, tiles, views, monkeypatch, survivors
):
    """What a block of views has measured is not measured again, and the bytes are the same.

    Interrupted once, and four times in one job, when a tenth, three tenths, ... are done.
    """
    budget, settings, done = Budget(ratio=0.5), replace(OCCLUSION, views=8), []
    measure = seeing.measure_footprints
    monkeypatch.setattr(
        seeing, "measure_footprints", lambda *some: done.append(some) or measure(*some)
    )

    def measured(folder, *stops):
        """Return how many views are measured until a job is done that is stopped some times."""
        done.clear()

        def interrupt(fraction, _what):
            if stops and fraction > stops[0]:
                raise KeyboardInterrupt

        def run():
            prune_tiles(
                tiles,
                tmp_path / folder,
                PruneRequest(views, budget, settings, survivors=survivors),
                progress=interrupt,
            )

        while stops:
            with pytest.raises(KeyboardInterrupt):
                run()
            stops = stops[1:]
        run()
        return len(done)

    needed = measured("once")
    for folder, stops in (("late", (0.7,)), ("often", (0.1, 0.3, 0.55, 0.7))):
        taken = measured(folder, *stops)

        assert needed <= taken <= needed + 2 * len(stops)  # the views of the blocks under way
        assert read(tmp_path / folder, tiles).tobytes() == read(tmp_path / "once", tiles).tobytes()
        assert sorted(path.name for path in (tmp_path / folder).iterdir()) == sorted(
            path.name for path in tiles
        )


# Absorbing.


@pytest.mark.slow
@pytest.mark.parametrize("ratio", [0.5, 0.8])
def test_absorbing_tiles_is_as_good_as_absorbing_one_file(tmp_path, views, monkeypatch, ratio):
    """Within .3 dB, with four regions of the room's 39,755 splats, cut into eight tiles."""
    monkeypatch.setattr(absorbing, "REGION", 10_000)
    file = read_ply(ROOM / "point_cloud.ply")
    tiles = cut(tmp_path, file.rows, np.linspace(0, len(file), 9).astype(int).tolist())
    settings = Settings(method="occlusion")
    told = prune_tiles(
        tiles,
        tmp_path / "out",
        PruneRequest(views, Budget(ratio=ratio), settings, survivors="absorb"),
    )
    splats = file.splats()
    whole = prune(splats, views, Budget(ratio=ratio), settings, survivors="absorb")

    rays = validation_rays(splats, views.spread(64))
    made = joined([read_ply(tmp_path / "out" / path.name).splats() for path in tiles])
    one = psnr_against(rays, whole.absorbed.splats, views.spread(64))
    psnr = psnr_against(rays, made, views.spread(64))
    assert psnr > one - 0.3
    assert len(made) == told["splats"]["kept"] == whole.report["splats"]["kept"]
    assert told["estimated_psnr"] == pytest.approx(psnr, abs=0.1)


@pytest.mark.slow
def test_what_three_views_do_not_show_is_as_good_from_elsewhere(tmp_path, views, monkeypatch):
    """Three of 72 views show a quarter of the room; half of it goes, and 16 other views judge.

    Regions that no view shows are merged like others, and keep what they would keep of one file.
    """
    monkeypatch.setattr(absorbing, "REGION", 10_000)
    few, others = ViewSet(views.views[:3]), ViewSet(views.views[10::4])
    splats = read_ply(ROOM / "point_cloud.ply").splats()
    rays = validation_rays(splats, others)
    whole = prune(splats, few, Budget(ratio=0.5), OCCLUSION, survivors="absorb")

    prune_tiles(
        [ROOM / "point_cloud.ply"],
        tmp_path,
        PruneRequest(few, Budget(ratio=0.5), OCCLUSION, survivors="absorb"),
    )

    made = read_ply(tmp_path / "point_cloud.ply").splats()
    assert np.count_nonzero(whole.scores.seen) < 0.3 * len(splats)
    one = psnr_against(rays, whole.absorbed.splats, others)
    assert psnr_against(rays, made, others) > one - 0.3


@pytest.mark.slow
def test_no_splat_is_merged_twice_and_none_is_lost(tmp_path, tiles, rows, views):
    """Kept, merged and deleted add up to all; survivors that did not change are their old bytes.

    Stages divide along other planes, so regions of a stage are not those of the one before.
    """
    told = prune_tiles(
        tiles,
        tmp_path / "out",
        PruneRequest(views, Budget(ratio=0.8), OCCLUSION, survivors="absorb"),
    )

    made, counts = read(tmp_path / "out", tiles), told["absorbed"]
    assert len(made) == told["splats"]["kept"] == COUNT // 5
    assert counts["merged"] + counts["deleted"] == COUNT - len(made)
    same = np.isin(made.view("V248"), rows.view("V248"))
    assert np.count_nonzero(~same) == counts["changed"] > 100
    assert counts["merged"] >= counts["changed"]
    assert np.isfinite([made[name] for name in made.dtype.names]).all()


@pytest.mark.parametrize("model", ["default", "2dgs"])
@pytest.mark.parametrize("count", [1, 2, 3, 5, 9, 700])
def test_a_few_splats_are_seen_as_they_are_among_all(views, model, count):
    """A tile may hold one splat that reaches into a view: its footprint is the same to the bit.

    BLAS multiplies a matrix by one column otherwise than by many.
    """
    splats = replace(read_ply(ROOM / "point_cloud.ply").splats(), model=model)
    gaussians, scene, _ = projection.prepare(splats, views)
    view = views.views[0]
    of_all, depths = projection.footprints_and_depths(gaussians, scene, view)
    few = of_all.index[len(of_all.index) // 2 :][:count]

    of_few, depths_of_few = projection.footprints_and_depths(gaussians.take(few), scene, view)

    where = np.searchsorted(of_all.index, few[of_few.index])
    assert len(where) == count
    np.testing.assert_array_equal(depths_of_few, depths[where])
    expected = of_all.take(where)
    for item in ("centers", "major", "minor", "alphas", "discs"):
        np.testing.assert_array_equal(getattr(of_few, item), getattr(expected, item))


@pytest.mark.slow
@pytest.mark.parametrize("ratio", [0.5, 0.8])
def test_absorbing_a_single_region_is_absorbing_one_file(
    tmp_path, tiles, views, monkeypatch, ratio
):
    """Where one region holds all that are left, every row is the same to the byte.

    At 80 % there are three stages, before two of which the views measure again.
    """
    monkeypatch.setattr(absorbing, "REGION", COUNT)
    budget = Budget(ratio=ratio)
    told = prune_tiles(
        tiles, tmp_path / "out", PruneRequest(views, budget, OCCLUSION, survivors="absorb")
    )
    request = PruneRequest(views, budget, OCCLUSION, survivors="absorb")
    whole = prune_file(tmp_path / "whole.ply", tmp_path / "pruned.ply", request)

    assert told["absorbed"] == whole.report["absorbed"]
    assert told["absorbed"]["changed"] > 100
    expected = read_ply(tmp_path / "pruned.ply").rows
    assert read(tmp_path / "out", tiles).tobytes() == expected.tobytes()
    assert told["estimated_psnr"] == pytest.approx(whole.report["estimated_psnr"], abs=0.011)


def test_a_stage_leaves_enough_to_choose_from():
    """Merges count half a splat each, so no stage may ask for more than half of the splats."""
    assert absorbing.ALONE >= 0.5


def test_stored_rays_know_which_are_wanted(tmp_path, views):
    """All views' at first; none of those that lie in the folder."""
    context = SceneContext(Folder(tmp_path), views, None, None)
    stored = gaussians.StoredGaussians(context.folder.inner(""), np.arange(3))

    rays = StoredRays(context, Runner(InProcess()), [], stored)
    rays.noted.add(1)

    assert [rays.wants(number) for number in range(3)] == [True, False, True]
    assert rays.seeing() == []


@pytest.mark.slow
def test_what_is_deleted_alone_needs_no_merging(tmp_path, tiles, views):
    """Up to a tenth is deleted as in memory: the same rows, and nothing changes."""
    told = prune_tiles(
        tiles,
        tmp_path / "out",
        PruneRequest(views, Budget(ratio=0.1), OCCLUSION, survivors="absorb"),
    )
    whole = prune_file(
        tmp_path / "whole.ply",
        tmp_path / "pruned.ply",
        PruneRequest(views, Budget(ratio=0.1), OCCLUSION, survivors="absorb"),
    )

    assert told["absorbed"] == whole.report["absorbed"]
    expected = read_ply(tmp_path / "pruned.ply").rows
    assert read(tmp_path / "out", tiles).tobytes() == expected.tobytes()


@pytest.mark.slow
@pytest.mark.usefixtures("small")
def test_tiles_of_other_degrees_absorb_one_another(tmp_path, rows, views):
    """Each keeps its own properties, and no number is lost that it has room for."""
    write(tmp_path / "a.ply", rows[:2500])
    flat = drop_fields(rows[2500:], [name for name in rows.dtype.names if "rest" in name])
    names = splat_names(0)
    plain = np.empty(len(flat), [(name, "<f4") for name in names])
    for name in names:
        plain[name] = flat[name]
    (tmp_path / "b.ply").write_bytes(plain_header(len(plain), names) + plain.tobytes())
    paths = [tmp_path / "a.ply", tmp_path / "b.ply"]

    told = prune_tiles(
        paths,
        tmp_path / "out",
        PruneRequest(views, Budget(ratio=0.6), OCCLUSION, survivors="absorb"),
    )

    made = [read_ply(tmp_path / "out" / path.name).splats() for path in paths]
    assert [splats.sh_rest.shape[1] for splats in made] == [15, 0]
    assert sum(map(len, made)) == told["splats"]["kept"] == COUNT * 2 // 5
    assert np.isfinite(made[0].sh_rest).all()
    assert np.abs(made[0].sh_rest).max() > 0.1


@pytest.mark.parametrize(
    ("budget", "words"),
    [(Budget(threshold=0.5), "a threshold needs"), (Budget(psnr=40.0), "a PSNR needs")],
)
def test_budgets_that_absorbing_tiles_cannot_meet_are_refused(
    tmp_path, tiles, views, budget, words
):
    """Before anything is read."""
    with pytest.raises(RefineError, match=words):
        prune_tiles(
            tiles, tmp_path / "out", PruneRequest(views, budget, OCCLUSION, survivors="absorb")
        )
    assert not (tmp_path / "out").exists()


@given(st.integers(1, 400), st.integers(1, 60), st.integers(0, 3), st.integers(0, 9))
def test_regions_divide_all_splats(count, most, stage, seed):
    """Each splat is in one region; none has more than it may, and none is much smaller."""
    means = np.random.default_rng(seed).normal(size=(count, 3)).astype(np.float32)
    means[::17] = np.nan

    found = absorbing.divided(means, most, stage)

    assert sorted(np.concatenate(found).tolist()) == list(range(count))
    sizes = [len(rows) for rows in found]
    assert max(sizes) <= most
    assert max(sizes) - min(sizes) <= 1 + max(sizes) // 2
    assert all((np.diff(rows) > 0).all() for rows in found)


def test_regions_of_one_stage_cross_those_of_the_next():
    """Of 1000 splats in a cube, halves along an axis and askew: each pair has some in common."""
    means = np.random.default_rng(1).uniform(size=(1000, 3)).astype(np.float32)

    first, second = (absorbing.divided(means, 500, stage) for stage in (0, 1))

    common = [len(np.intersect1d(one, other)) for one in first for other in second]
    assert min(common) > 50


# What a view loads.


@pytest.mark.slow
def test_a_view_loads_no_chunk_behind_it(tmp_path, tiles, views, monkeypatch):
    """Of 100 chunks all are loaded by some view, and a fifth of the times none was needed."""
    monkeypatch.setattr(gaussians, "CHUNK", 50)
    loaded, load = [], SceneContext.chunk
    monkeypatch.setattr(
        SceneContext,
        "chunk",
        lambda context, number: loaded.append(number) or load(context, number),
    )
    once = Settings(method="occlusion", views=12, occlusion=replace(OCCLUSION.occlusion, rounds=1))

    prune_tiles(tiles, tmp_path / "out", PruneRequest(views, Budget(ratio=0.5), once), threads=1)

    chunks = len(set(loaded))
    assert 90 < chunks <= 100
    assert len(loaded) < 0.8 * 12 * chunks


@given(st.integers(0, 200))
def test_no_box_is_left_out_that_a_splat_reaches_from(seed):
    """Boxes of 20 splats each, anywhere around a camera: every one that has a footprint touches."""
    random = np.random.default_rng(seed)
    views = read_cameras(ROOM / "cameras.json")
    file = read_ply(ROOM / "point_cloud.ply")
    splats = file.splats().take(random.permutation(len(file))[:400])
    splats = replace(splats, log_scales=splats.log_scales + random.normal(1.0, 1.0))
    gaussians, scene, _ = projection.prepare(splats, views)
    view = views.views[seed % len(views)]
    pieces = np.array_split(np.arange(len(gaussians)), 20)
    boxes = []
    for piece in pieces:
        means, largest = gaussians.means[:, piece], gaussians.largest[piece].max()
        boxes.append([*means.min(axis=1), *means.max(axis=1), largest])

    touching = projection.boxes_touch(np.array(boxes, np.float32), scene, view)

    for box, piece in zip(touching, pieces, strict=True):
        assert box or not len(
            projection.footprints_and_depths(gaussians.take(piece), scene, view)[1]
        )
