"""Many files pruned as one scene, against one file in memory; on disks, behind URLs, on Dask."""

from __future__ import annotations

import contextlib
import errno
import io
import os
import pickle
import re
import shutil
import signal
import sys
import threading
import time
from dataclasses import replace
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from types import SimpleNamespace
from typing import ClassVar

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.lib.recfunctions import drop_fields

from refine_addon.command import main
from refine_addon.core import (
    Budget,
    ClosedForm,
    Merge,
    Occlusion,
    RefineError,
    Refit,
    mapped,
    prune,
    prune_file,
    prune_tiles,
    read_cameras,
    read_ply,
    read_splats,
    score,
)
from refine_addon.core.mapped import Interrupted, Mapped, note, noted, on_disk, once
from refine_addon.core.merging import merge
from refine_addon.core.quality.psnr import psnr_against
from refine_addon.core.refit import round_rays
from refine_addon.core.scoring import occlusion
from refine_addon.core.selection import select
from refine_addon.core.splats import joined, with_model
from refine_addon.core.tiles import cluster, source, storage, writing
from refine_addon.core.tiles import prune as tiles_prune
from refine_addon.core.views import ViewSet
from refine_addon.core.visibility import projection
from refine_addon.core.visibility.cast import cast, validation_rays
from refine_addon.core.whole_file import Url
from tests.strategies import plain_header, plain_ply, ply_of, splat_names
from tests.tiles import COUNT, ROOM, cut, room_rows, rows_in, write

HALF = Budget(ratio=0.5)
CLOSED, OCCLUSION, MERGE = ClosedForm(8), Occlusion(8), Merge(8)


@pytest.fixture(autouse=True)
def small(monkeypatch):
    """Make pieces and boxes so small that 5000 splats have several of each."""
    monkeypatch.setattr(source, "ROWS", 1000)
    monkeypatch.setattr(mapped, "_ROWS", 300)
    monkeypatch.setattr(writing, "ROWS", 900)
    monkeypatch.setattr(projection, "CHUNK", 700)


@pytest.fixture(scope="module")
def views():
    """Give the room's cameras."""
    return read_cameras(ROOM / "cameras.json")


@pytest.fixture
def tiles(tmp_path):
    """Write rows of the room as four files, and as one."""
    write(tmp_path / "whole.ply", room_rows())
    return cut(tmp_path, room_rows())


def asked(views, budget=HALF, method=CLOSED, **more):
    return {"views": views, "budget": budget, "method": method, **more}


# The law: tiles give the rows of one file.

BUDGETS = [
    Budget(ratio=0.6),
    Budget(ratio=0.1),  # among the equal ones, which are those from the 253rd to the 653rd
    Budget(ratio=0.0),
    Budget(keep=1),
    Budget(max_mb=0.4),
    Budget(threshold=0.05),
    Budget(min_seen=30),
    Budget(psnr=36.0),
]
WAYS = [
    *((CLOSED, budget) for budget in BUDGETS),
    (OCCLUSION, Budget(ratio=0.7)),
    (OCCLUSION, Budget(min_seen=60)),
    (OCCLUSION, Budget(psnr=36.0)),
    (MERGE, Budget(ratio=0.1)),
    (MERGE, Budget(psnr=36.0)),
    (MERGE, Budget(ratio=0.8)),
    (Refit(8), Budget(ratio=0.5)),
]


@pytest.mark.parametrize(("method", "budget"), WAYS, ids=str)
def test_of_tiles_the_same_rows_stay_as_of_one_file(tmp_path, tiles, views, method, budget):
    """Every row to the byte, in the order of the files, and the report says the same of them.

    For a size, the four headers take bytes that one does not: here the rows left are compared with
    those of as many in one file.
    """
    told = prune_tiles(tiles, tmp_path / "out", **asked(views, budget, method))

    if budget.max_mb:
        assert 0 <= 400_000 - told["files"]["output_bytes"] < 2 * 248
        budget = Budget(keep=told["splats"]["kept"])
    whole = prune_file(
        tmp_path / "whole.ply", tmp_path / "pruned.ply", **asked(views, budget, method)
    ).report
    assert (
        rows_in(tmp_path / "out", tiles).tobytes()
        == read_ply(tmp_path / "pruned.ply").rows.tobytes()
    )
    del whole["splats"]["unseen_removed"]
    for key in ("splats", "weights", "views", "estimated_psnr", "quality"):
        assert told[key] == whole[key]
    assert {path.name for path in (tmp_path / "out").iterdir()} == {path.name for path in tiles}


@pytest.mark.slow
@pytest.mark.parametrize("model", ["antialiased", "2dgs"])
def test_tiles_of_every_model_are_pruned_as_one_file(tmp_path, tiles, views, model):
    """Merged to the byte, and written as the model that they are."""
    request = asked(views, HALF, MERGE, model=model)
    prune_tiles(tiles, tmp_path / "out", **request)
    prune_file(tmp_path / "whole.ply", tmp_path / "pruned.ply", **request)

    expected = read_ply(tmp_path / "pruned.ply").rows
    assert rows_in(tmp_path / "out", tiles).tobytes() == expected.tobytes()
    assert {read_ply(tmp_path / "out" / tile.name).model for tile in tiles} == {model}


def test_splats_at_the_threshold_stay(tmp_path, tiles, views):
    """401 splats are equal: those below them go, and none of them."""
    values = score(read_ply(tmp_path / "whole.ply").splats(), views, CLOSED).values

    told = prune_tiles(tiles, None, **asked(views, Budget(threshold=float(values[900]))))

    assert np.count_nonzero(values == values[900]) == 401
    assert told["splats"]["removed"] == np.count_nonzero(values < values[900])


def test_a_report_says_what_stays_of_each_tile(tmp_path, tiles, views):
    """Counts and bytes add up to those of all, and bytes are those of the files.

    Without a folder the same sizes are told, and nothing is written.
    """
    before = sorted(tmp_path.rglob("*"))
    dry = prune_tiles(tiles, None, **asked(views))
    assert sorted(tmp_path.rglob("*")) == before

    report = prune_tiles(tiles, tmp_path / "out", **asked(views))

    each = report["tiles"]
    assert [tile["output_bytes"] for tile in dry["tiles"]] == [t["output_bytes"] for t in each]
    assert [tile["input"] for tile in each] == [str(path) for path in tiles]
    assert [tile["before"] for tile in each] == [700, 0, 1900, 2400]
    assert sum(tile["kept"] for tile in each) == report["splats"]["kept"] == COUNT // 2
    assert sum(tile["unseen"] for tile in each) == report["splats"]["unseen"]
    for tile in each:
        output = Path(tile["output"])
        assert (len(read_ply(output)), output.stat().st_size) == (
            tile["kept"],
            tile["output_bytes"],
        )


@pytest.mark.parametrize("megabytes", [0.1, 0.35, 10.0])
def test_of_tiles_of_other_degrees_each_splat_counts_as_the_longest_row(tmp_path, views, megabytes):
    """The lowest go until the rest fits, however the others are stored.

    The files have degree 3, 1 and 0; scores do not depend on the harmonics above the constant one.
    """
    rows = room_rows()
    paths, longest = [], 0
    for index, degree in enumerate((3, 1, 0)):
        file = tmp_path / f"{degree}.ply"
        file.write_bytes(plain_ply(400, degree))
        data = read_ply(file)
        some = data.rows.copy()
        for name in set(rows.dtype.names) & set(some.dtype.names) - {"nx", "ny", "nz"}:
            if not name.startswith("f_rest"):
                some[name] = rows[name][index * 400 : index * 400 + 400]
        file.write_bytes(data.header + some.tobytes())
        paths.append(file)
        longest = max(longest, some.dtype.itemsize)
    write(tmp_path / "whole.ply", rows[:1200])
    scores = score(read_ply(tmp_path / "whole.ply").splats(), views, CLOSED)
    fixed = sum(read_ply(path).fixed_bytes for path in paths)
    budget = Budget(max_mb=megabytes)
    keep = select(scores, budget, row_bytes=longest, fixed_bytes=fixed)

    report = prune_tiles(paths, tmp_path / "out", **asked(views, budget))

    for path, part in zip(paths, np.split(keep, 3), strict=True):
        expected = read_ply(path).rows[part]
        assert read_ply(tmp_path / "out" / path.name).rows.tobytes() == expected.tobytes()
    assert report["files"]["output_bytes"] <= megabytes * 1e6


@pytest.mark.slow
def test_tiles_of_other_degrees_merge_with_one_another(tmp_path, views):
    """Each keeps its own properties, and no number is lost that it has room for."""
    rows, names = room_rows(), splat_names(0)
    write(tmp_path / "a.ply", rows[:2500])
    flat = drop_fields(rows[2500:], [name for name in rows.dtype.names if "rest" in name])
    plain = np.empty(len(flat), [(name, "<f4") for name in names])
    for name in names:
        plain[name] = flat[name]
    (tmp_path / "b.ply").write_bytes(plain_header(len(plain), names) + plain.tobytes())
    paths = [tmp_path / "a.ply", tmp_path / "b.ply"]

    told = prune_tiles(paths, tmp_path / "out", **asked(views, Budget(ratio=0.6), MERGE))

    made = [read_ply(tmp_path / "out" / path.name).splats() for path in paths]
    assert [splats.sh_rest.shape[1] for splats in made] == [15, 0]
    assert sum(map(len, made)) == told["splats"]["kept"] == COUNT * 2 // 5
    assert np.isfinite(made[0].sh_rest).all()
    assert np.abs(made[0].sh_rest).max() > 0.1


def test_splats_of_tiles_have_types_and_degree_of_all(tmp_path):
    """Three tiles of 5, 4 and 6 splats, of degrees 0, 1 and 0, the last of doubles."""
    for name, count, degree in (("a", 5, 0), ("b", 4, 1), ("c", 6, 0)):
        (tmp_path / f"{name}.ply").write_bytes(plain_ply(count, degree, seed=count))
    rows = read_ply(tmp_path / "c.ply").rows
    doubles = {name: (1 / 3 + rows[name]).astype(float) for name in rows.dtype.names}
    (tmp_path / "c.ply").write_bytes(ply_of(doubles))
    tiles = source.tiles_at([tmp_path / f"{name}.ply" for name in "abc"])

    splats = source.copied(tiles, tmp_path / "splats", lambda *_: None, 1)

    assert len(splats) == 15
    assert splats.means.dtype == np.float64
    assert splats.sh_rest.shape == (15, 3, 3)
    np.testing.assert_array_equal(splats.means[:5], read_ply(tmp_path / "a.ply").splats().means)
    np.testing.assert_array_equal(splats.means[9:, 0], doubles["x"])


# Larger scenes: region by region.


@pytest.mark.slow
@pytest.mark.parametrize("ratio", [0.05, 0.5, 0.8])
def test_merging_by_regions_is_as_good_as_merging_one_file(tmp_path, views, monkeypatch, ratio):
    """Within .3 dB, with four regions of the room's 39,755 splats, cut into eight tiles.

    Of 5 %, which are deleted alone, the same rows stay to the byte.
    """
    monkeypatch.setattr(mapped, "REGION", 10_000)
    file = read_ply(ROOM / "point_cloud.ply")
    tiles = cut(tmp_path, file.rows, np.linspace(0, len(file), 9).astype(int).tolist())
    method, splats = Merge(), file.splats()
    told = prune_tiles(tiles, tmp_path / "out", **asked(views, Budget(ratio=ratio), method))
    whole = prune(splats, views, Budget(ratio=ratio), method)

    rays = validation_rays(splats, views.spread(64))
    made = joined([read_ply(tmp_path / "out" / path.name).splats() for path in tiles])
    one = psnr_against(rays, whole.splats, views.spread(64))
    psnr = psnr_against(rays, made, views.spread(64))
    assert psnr > one - 0.3
    assert len(made) == told["splats"]["kept"] == whole.report["splats"]["kept"]
    assert min(told["estimated_psnr"], 60.0) == pytest.approx(min(psnr, 60.0), abs=0.1)
    if ratio < 0.1:
        found = rows_in(tmp_path / "out", tiles)
        assert found.tobytes() == file.rows[whole.keep].tobytes()


@pytest.mark.slow
def test_what_three_views_do_not_show_is_as_good_from_elsewhere(tmp_path, views, monkeypatch):
    """Three of 72 views show a quarter of the room; half of it goes, and 16 other views judge.

    Regions that no view shows are merged like others, and keep what they would keep of one file.
    """
    monkeypatch.setattr(mapped, "REGION", 10_000)
    few, others = ViewSet(views.views[:3]), ViewSet(views.views[10::4])
    splats = read_ply(ROOM / "point_cloud.ply").splats()
    rays = validation_rays(splats, others)
    whole = prune(splats, few, HALF, Merge())

    prune_tiles([ROOM / "point_cloud.ply"], tmp_path / "out", **asked(few, HALF, Merge()))

    made = read_ply(tmp_path / "out/point_cloud.ply").splats()
    assert np.count_nonzero(whole.scores.seen) < 0.3 * len(splats)
    one = psnr_against(rays, whole.splats, others)
    assert psnr_against(rays, made, others) > one - 0.3


@pytest.mark.slow
def test_no_splat_is_merged_twice_and_none_is_lost(tmp_path, tiles, views, monkeypatch):
    """Kept, merged and deleted add up to all; kept splats that did not change are their old bytes.

    Stages divide along other planes, so regions of a stage are not those of the one before.
    """
    monkeypatch.setattr(mapped, "REGION", 900)
    told = prune_tiles(tiles, tmp_path / "out", **asked(views, Budget(ratio=0.8), MERGE))

    made, counts = rows_in(tmp_path / "out", tiles), told["merged"]
    assert len(made) == told["splats"]["kept"] == COUNT // 5
    assert counts["merged"] + counts["deleted"] == COUNT - len(made)
    same = np.isin(made.view("V248"), room_rows().view("V248"))
    assert np.count_nonzero(~same) == counts["changed"] > 100
    assert counts["merged"] >= counts["changed"]
    assert np.isfinite([made[name] for name in made.dtype.names]).all()


@pytest.mark.slow
def test_refitting_by_regions_is_as_good_as_refitting_one_file(tmp_path, tiles, views, monkeypatch):
    """Within 1.3 dB by rays of all views: regions of 600 splats are border for the most part.

    Larger ones come closer (docs/scale.md).
    """
    monkeypatch.setattr(round_rays, "MIN_RAYS", 1 << 14)
    monkeypatch.setattr(mapped, "REGION", 1500)
    told = prune_tiles(tiles, tmp_path / "out", views, HALF, Refit(8))
    before = prune_tiles(tiles, tmp_path / "merged", views, HALF, MERGE)
    prune_file(tmp_path / "whole.ply", tmp_path / "pruned.ply", views, HALF, Refit(8))

    used = views.spread(8)
    rays = validation_rays(read_ply(tmp_path / "whole.ply").splats(), used)
    made = joined([read_ply(tmp_path / "out" / path.name).splats() for path in tiles])
    one = psnr_against(rays, read_ply(tmp_path / "pruned.ply").splats(), used)
    psnr = psnr_against(rays, made, used)
    assert psnr > one - 1.3
    assert told["estimated_psnr"] == pytest.approx(psnr, abs=0.1)
    assert psnr > before["estimated_psnr"] + 1.0
    assert told["merged"] == before["merged"]
    same = np.isin(rows_in(tmp_path / "out", tiles).view("V248"), room_rows().view("V248"))
    assert told["refitted"]["changed"] <= np.count_nonzero(~same) <= len(made) == COUNT // 2


@pytest.mark.slow
def test_what_no_view_shows_is_refitted_to_nothing(tmp_path, tiles, views, monkeypatch):
    """Two views of the room show regions in part; splats beyond them stay as they were."""
    monkeypatch.setattr(mapped, "REGION", 1500)
    two = ViewSet(views.views[:2])

    told = prune_tiles(tiles, tmp_path / "out", **asked(two, HALF, Refit(8)))

    made = rows_in(tmp_path / "out", tiles)
    assert 0 < told["refitted"]["changed"] < len(made) // 2
    assert np.isfinite([made[name] for name in made.dtype.names]).all()


@given(st.integers(1, 400), st.integers(1, 60), st.booleans(), st.integers(0, 9))
def test_regions_divide_all_splats(count, most, askew, seed):
    """Each splat is in one region; none has more than it may, and none is much smaller."""
    means = np.random.default_rng(seed).normal(size=(count, 3)).astype(np.float32)
    means[::17] = np.nan

    found = mapped.divided(means, most / mapped.REGION, askew=askew)

    assert sorted(np.concatenate(found).tolist()) == list(range(count))
    sizes = [len(rows) for rows in found]
    assert max(sizes) <= most
    assert max(sizes) - min(sizes) <= 1 + max(sizes) // 2
    assert all((np.diff(rows) > 0).all() for rows in found)


def test_regions_of_one_stage_cross_those_of_the_next():
    """Of 1000 splats in a cube, halves along an axis and askew: each pair has some in common."""
    means = np.random.default_rng(1).uniform(size=(1000, 3)).astype(np.float32)

    share = 500 / mapped.REGION
    first, second = (mapped.divided(means, share, askew=askew) for askew in (False, True))

    common = [len(np.intersect1d(one, other)) for one in first for other in second]
    assert min(common) > 50


def test_a_stage_leaves_enough_to_choose_from():
    """Merges count half a splat each, so no stage may ask for more than half of the splats."""
    assert merge.ALONE_BY_REGIONS >= 0.5


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
    window = round_rays.Window(view, 0, 1.0, 64.0, 1e9, left, top, 8, 8)

    some = projection.project(shown, scene, view, window.part)

    every = projection.project(shown, scene, view)
    columns, pixel_rows = window.pixels(1.0, 3)
    assert columns.min() >= left
    assert columns.max() < left + 8
    found, expected = (cast(footprints, columns, pixel_rows) for footprints in (some, every))
    np.testing.assert_array_equal(found.hit, expected.hit)
    np.testing.assert_array_equal(found.alpha, expected.alpha)
    assert len(some.index) <= len(every.index)


# Splats in files.


@pytest.mark.parametrize("model", ["default", "antialiased", "2dgs"])
def test_splats_in_files_are_seen_as_in_memory(tmp_path, views, model):
    """Footprints are equal to the bit, in another process too, and what is sent there is small."""
    splats = with_model(read_ply(ROOM / "point_cloud.ply").splats(), model)
    pieces = (splats.take(slice(start, start + 7000)) for start in range(0, len(splats), 7000))
    there = on_disk(tmp_path / "splats", pieces)

    gaussians, scene, good = projection.prepare(splats, views)
    stored, same_scene, same_good = projection.prepare(there, views)

    packed = pickle.dumps(stored)
    assert len(packed) < 5000
    np.testing.assert_array_equal(same_good, good)
    for view in views.views[:8]:
        expected = vars(projection.project(gaussians, scene, view))
        found = vars(projection.project(pickle.loads(packed), same_scene, view))
        for name, values in expected.items():
            np.testing.assert_array_equal(found[name], values)
    assert len(list(tmp_path.iterdir())) == 2
    del stored
    assert [path.name for path in tmp_path.iterdir()] == ["splats"]


def test_a_view_reads_no_box_behind_it(tmp_path, views, monkeypatch):
    """Of 100 boxes all are read for some view, and a tenth of the times none was needed."""
    monkeypatch.setattr(projection, "CHUNK", 400)
    splats = on_disk(tmp_path / "splats", [read_ply(ROOM / "point_cloud.ply").splats()])
    gaussians, scene, _ = projection.prepare(splats, views)
    read = [first for view in views.views[::6] for first, _ in gaussians.parts(scene, view, view)]

    assert 90 < len(gaussians.boxes) <= 100
    assert len(set(read)) > 90
    assert len(read) < 0.9 * 12 * len(gaussians.boxes)


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
        assert box or not len(projection.project(gaussians.take(piece), scene, view).index)


@pytest.mark.parametrize("model", ["default", "2dgs"])
@pytest.mark.parametrize("count", [1, 2, 3, 5, 9, 700])
def test_a_few_splats_are_seen_as_they_are_among_all(views, model, count):
    """A box may hold one splat that reaches into a view: its footprint is the same to the bit.

    BLAS multiplies a matrix by one column otherwise than by many.
    """
    splats = replace(read_ply(ROOM / "point_cloud.ply").splats(), model=model)
    gaussians, scene, _ = projection.prepare(splats, views)
    view = views.views[0]
    of_all = projection.project(gaussians, scene, view)
    few = of_all.index[len(of_all.index) // 2 :][:count]  # front to back

    of_few = projection.project(gaussians.take(few), scene, view)

    assert of_few.index.tolist() == list(range(count))
    where = len(of_all.index) // 2 + of_few.index
    expected = of_all.take(where)
    for item in ("centers", "major", "minor", "alphas", "discs"):
        np.testing.assert_array_equal(getattr(of_few, item), getattr(expected, item))


@pytest.mark.parametrize("shape", [(7,), (7, 3), (7, 0, 3)])
def test_an_array_in_a_file_is_indexed_as_one_in_memory(tmp_path, shape):
    """By numbers, slices, masks and rows, written in two pieces."""
    whole = np.random.default_rng(0).normal(size=shape).astype(np.float32)
    pieces = [{"a": whole[:4]}, {"a": whole[4:]}]

    array = mapped.write(tmp_path / "folder", pieces)["a"]

    assert (array.shape, array.dtype, len(array)) == (shape, np.float32, 7)
    for key in (3, slice(2, 5), np.array([6, 0, 0]), whole.reshape(7, -1).sum(axis=1) > 0, ...):
        np.testing.assert_array_equal(array[key], whole[key])
    np.testing.assert_array_equal(np.asarray(pickle.loads(pickle.dumps(array))), whole)
    if array.size:
        array.path.write_bytes(b"short")
        with pytest.raises(Interrupted, match="a: is damaged"):
            Mapped(array.path, array.dtype, array.shape)


def test_what_stages_returned_is_kept(tmp_path):
    """Nothing, too; what is truncated, or names a damaged array, counts as not done."""
    made = []
    for stage in ("one", "one", "two"):
        assert once(tmp_path, stage, lambda name=stage: made.append(name)) is None
    assert made == ["one", "two"]
    array = mapped.write(tmp_path / "arrays", [{"a": np.arange(9)}])
    note(tmp_path, "array", array)
    assert noted(tmp_path, "array")[0]
    os.truncate(tmp_path / "arrays/a", 10)
    assert noted(tmp_path, "array") == (False, None)
    whole = (tmp_path / "one.done").read_bytes()
    for size in range(len(whole)):
        (tmp_path / "one.done").write_bytes(whole[:size])
        assert noted(tmp_path, "one") == (False, None)


# What is refused.


@pytest.mark.parametrize(
    ("method", "budget", "words"),
    [
        (CLOSED, Budget(threshold=1e30), "would remove all 5000 splats"),
        (CLOSED, Budget(max_mb=0.001), "too small for one splat of 248 bytes"),
    ],
)
def test_what_cannot_be_is_refused_and_leaves_nothing(
    tmp_path, tiles, views, method, budget, words
):
    """After the work, folders that were there are as empty as they were; others are gone."""
    (tmp_path / "there").mkdir()
    for folder in ("there", "new/deep"):
        with pytest.raises(RefineError, match=words):
            prune_tiles(tiles, tmp_path / folder, **asked(views, budget, method))

    assert not list((tmp_path / "there").iterdir())
    assert not (tmp_path / "new").exists()


@pytest.mark.slow
def test_views_of_nothing_are_refused_as_of_one_file(tmp_path, tiles, views):
    """Near planes behind all splats: the message is that of one file, and nothing is left."""
    away = ViewSet(tuple(replace(view, near=1e6) for view in views))
    with pytest.raises(RefineError) as alone:
        prune_file(tmp_path / "whole.ply", None, **asked(away, method=OCCLUSION))

    with pytest.raises(RefineError) as together:
        prune_tiles(tiles, tmp_path / "out", **asked(away, method=OCCLUSION))

    assert str(together.value) == str(alone.value)


def at_fault(path, tiles):
    """Give tiles, one of which is at fault, and what is said of it."""
    kind = path.name
    if kind == "missing":
        return [*tiles, path], "missing: cannot be read"
    if kind == "folder":
        path.mkdir()
        return [*tiles, path], "folder: is a folder, expected a PLY file"
    if kind == "short.ply":
        path.write_bytes(tiles[0].read_bytes()[:-100])
        return [*tiles, path], "short.ply: truncated"
    if kind == "text.ply":
        header, _, _ = plain_ply(1).partition(b"end_header")
        header = header.replace(b"binary_little_endian", b"ascii") + b"end_header\n"
        path.write_bytes(header + b" ".join([b"0"] * header.count(b"property")) + b"\n")
        return [*tiles, path], "text.ply: is ascii 1.0, expected a plain binary PLY"
    if kind == "twice":
        return [*tiles, tiles[2]], r"d\.ply: is given twice$"
    if kind in ("symlink_to", "hardlink_to"):
        getattr(path, kind)(tiles[0])
        return [*tiles, path], rf"{kind}: is given twice, also as .*b\.ply"
    if kind == "model":
        rest = tiles[1].read_bytes().removeprefix(b"ply\n")
        tiles[1].write_bytes(b"ply\ncomment SplatRenderMode: mip\n" + rest)
        return tiles, rf"{tiles[1]}: its splats are antialiased, those of {tiles[0]} default"
    if kind == "none":
        return [], "none of 0 tiles has a splat"
    if kind == "empty":
        return tiles[1:2], "none of 1 tiles has a splat"
    (path.parent / "more").mkdir()
    again = path.parent / "more" / tiles[1].name
    again.write_bytes(tiles[1].read_bytes())
    return [*tiles, again], f"another tile is called {again.name} too"


@pytest.mark.parametrize(
    "kind",
    [
        "missing", "folder", "short.ply", "text.ply", "twice", "symlink_to", "hardlink_to", "model",
        "none", "empty", "name",
    ],
)  # fmt: skip
def test_one_tile_at_fault_stops_all(tmp_path, tiles, views, kind):
    """It is named, and no tile is written; where nothing is written, too, names aside."""
    given, words = at_fault(tmp_path / kind, tiles)

    with pytest.raises(RefineError, match=words):
        prune_tiles(given, tmp_path / "out", **asked(views))
    if kind != "name":
        with pytest.raises(RefineError, match=words):
            prune_tiles(given, None, **asked(views))

    assert not list((tmp_path / "out").glob("*"))


def test_files_that_exist_stay_until_they_may_be_replaced(tmp_path, tiles, views):
    """One of four is there already: none is written; then all of them are."""
    there = tmp_path / "out" / tiles[3].name
    there.parent.mkdir()
    there.write_bytes(b"mine")

    with pytest.raises(RefineError, match="exists already"):
        prune_tiles(tiles, tmp_path / "out", **asked(views))

    assert [*(tmp_path / "out").iterdir()] == [there]
    assert there.read_bytes() == b"mine"
    prune_tiles(tiles, tmp_path / "out", **asked(views, overwrite=True))
    assert len(list((tmp_path / "out").iterdir())) == 4


def test_tiles_are_not_replaced_while_they_are_read(tmp_path, tiles, views):
    """A run that goes on after a kill would prune again what was pruned already."""
    with pytest.raises(RefineError, match="is read until all tiles are written"):
        prune_tiles(tiles, tmp_path, **asked(views, overwrite=True))


def test_a_tile_that_changes_meanwhile_stops_all(tmp_path, tiles, views):
    """Written again, of the same length: its rows may no longer be those that were scored."""

    def progress(_fraction, what):
        if what == "scoring":
            tiles[2].write_bytes(tiles[2].read_bytes())

    with pytest.raises(RefineError, match="was changed while it was worked on"):
        prune_tiles(tiles, tmp_path / "out", **asked(views), progress=progress)

    assert not list((tmp_path / "out").glob("*"))


def test_tiles_that_would_be_one_file_by_links_are_refused(tmp_path, tiles, views):
    """One of them would be lost: also where the file is not there yet."""
    out = tmp_path / "out"
    out.mkdir()
    for tile in tiles[:2]:
        (out / tile.name).symlink_to("real.ply")

    with pytest.raises(RefineError, match=r"is the same file as .*, by a link"):
        prune_tiles(tiles, out, **asked(views))
    assert sorted(path.name for path in out.iterdir()) == sorted(tile.name for tile in tiles[:2])


def test_a_link_to_another_disk_is_refused_before_the_work(tmp_path, tiles, views, monkeypatch):
    """Tiles wait beside their targets and are renamed: not from disk to disk."""
    out, other = tmp_path / "out", tmp_path / "other"
    for folder in (out, other):
        folder.mkdir()
    (out / tiles[1].name).symlink_to(other / "far.ply")
    stat = Path.stat

    def elsewhere(self, **options):
        found = stat(self, **options)
        if self != other:
            return found
        return SimpleNamespace(st_dev=found.st_dev + 1, st_mode=found.st_mode)

    monkeypatch.setattr(Path, "stat", elsewhere)

    with pytest.raises(RefineError, match="is a link to another disk"):
        prune_tiles(tiles, out, **asked(views))


# What is done after an interruption.


def stopping(at, error=KeyboardInterrupt):
    """Give a progress callback that stops when it is told of a step for the second time."""
    told = []

    def progress(_fraction, what):
        told.append(what)
        if told.count(at) > 1:
            raise error

    return progress


def bytes_in(folder):
    return {path.name: path.read_bytes() for path in folder.iterdir()}


@pytest.mark.parametrize("stop", ["reading", "scoring", "writing"])
def test_a_job_that_was_interrupted_goes_on_behind_the_last_stage(
    tmp_path, tiles, views, monkeypatch, stop
):
    """What was read is not read again, what was decided not decided; the bytes are the same."""
    prune_tiles(tiles, tmp_path / "once", **asked(views))
    with pytest.raises(KeyboardInterrupt):
        prune_tiles(tiles, tmp_path / "out", **asked(views), progress=stopping(stop), threads=1)
    assert not list((tmp_path / "out").glob("*.ply"))
    if stop != "reading":
        monkeypatch.setattr(tiles_prune, "copied", None)
    if stop == "writing":
        monkeypatch.setattr(tiles_prune, "prune", None)

    prune_tiles(tiles, tmp_path / "out", **asked(views))

    assert bytes_in(tmp_path / "out") == bytes_in(tmp_path / "once")


@pytest.mark.parametrize(("method", "stop"), [(OCCLUSION, "selecting"), (MERGE, "merging")])
def test_scores_by_occlusion_are_a_stage(tmp_path, tiles, views, monkeypatch, method, stop):
    """What views saw is kept with the rays, which tell the estimates."""
    request = asked(views, HALF, method)
    once_told = prune_tiles(tiles, tmp_path / "once", **request)

    def progress(_fraction, what):
        if what == stop:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        prune_tiles(tiles, tmp_path / "out", **request, progress=progress)
    monkeypatch.setattr(occlusion.coverage, "floor_weights", None)
    told = prune_tiles(tiles, tmp_path / "out", **request)

    assert bytes_in(tmp_path / "out") == bytes_in(tmp_path / "once")
    for key in ("estimated_psnr", "estimated_psnr_between", "quality", "views", "weights"):
        assert told[key] == once_told[key]


def renaming_stops(monkeypatch, name, error):
    """Make renaming to a name fail."""
    publish = storage.publish

    def stop(made, path, **options):
        if path.name == name:
            raise error
        publish(made, path, **options)

    monkeypatch.setattr(storage, "publish", stop)


@pytest.mark.parametrize(
    ("error", "raised"),
    [(KeyboardInterrupt(), KeyboardInterrupt), (RefineError("the disk failed"), Interrupted)],
)
def test_a_job_that_was_stopped_while_it_renamed_goes_on(
    tmp_path, tiles, views, monkeypatch, error, raised
):
    """One of four files is in its place already; the same call renames the others."""
    out = tmp_path / "out"
    with monkeypatch.context() as patched:
        renaming_stops(patched, tiles[1].name, error)
        with pytest.raises(raised):
            prune_tiles(tiles, out, **asked(views))
    assert [path.name for path in out.glob("*.ply")] == [tiles[0].name]

    monkeypatch.setattr(writing, "rows_of", None)  # nothing is written again
    report = prune_tiles(tiles, out, **asked(views))

    assert {path.name for path in out.iterdir()} == {path.name for path in tiles}
    assert sum(len(read_ply(out / path.name)) for path in tiles) == COUNT // 2
    for tile in report["tiles"]:
        assert tile["output_bytes"] == Path(tile["output"]).stat().st_size


def test_ctrl_c_after_the_last_tile_was_renamed_comes_too_late(tmp_path, tiles, views, monkeypatch):
    """The folder of the job goes all the same: nothing is left that would go on."""
    rmtree, calls = shutil.rmtree, []

    def stop_at_first(path, **options):
        if (path / "tiles").exists():
            calls.append(path)
            rmtree(path / "tiles", **options)
            raise KeyboardInterrupt
        rmtree(path, **options)

    monkeypatch.setattr(shutil, "rmtree", stop_at_first)

    report = prune_tiles(tiles, tmp_path / "out", **asked(views))

    assert len(calls) == 1
    assert report["splats"]["written"] == COUNT // 2
    assert {path.name for path in (tmp_path / "out").iterdir()} == {path.name for path in tiles}


def test_a_file_in_the_place_of_a_renamed_tile_is_not_replaced(tmp_path, tiles, views, monkeypatch):
    """Between two runs another program wrote it: it is refused, and with `overwrite` replaced."""
    out = tmp_path / "out"
    with monkeypatch.context() as patched:
        renaming_stops(patched, tiles[1].name, KeyboardInterrupt())
        with pytest.raises(KeyboardInterrupt):
            prune_tiles(tiles, out, **asked(views))
    (out / tiles[0].name).write_bytes(b"mine")

    with pytest.raises(RefineError, match="exists already"):
        prune_tiles(tiles, out, **asked(views))
    assert (out / tiles[0].name).read_bytes() == b"mine"
    prune_tiles(tiles, out, **asked(views, overwrite=True))

    assert sum(len(read_ply(out / path.name)) for path in tiles) == COUNT // 2


@pytest.mark.parametrize(
    ("overwrite", "words"), [(False, "exists already"), (True, "is a folder, expected a file")]
)
def test_what_appears_in_the_place_of_a_tile_meanwhile_stops_before_the_first(
    tmp_path, tiles, views, monkeypatch, overwrite, words
):
    """A file, or a folder that nothing can replace: no tile is renamed, and none is lost."""
    out = tmp_path / "out"
    there = out / tiles[3].name

    def progress(_fraction, what):
        if what == "writing" and not there.exists():
            (Path.mkdir if overwrite else Path.touch)(there)

    request = asked(views, overwrite=overwrite)
    with pytest.raises(Interrupted, match=f"{words}.*; the same command goes on"):
        prune_tiles(tiles, out, **request, progress=progress)
    assert [*out.glob("*.ply")] == [there]
    (Path.rmdir if overwrite else Path.unlink)(there)
    monkeypatch.setattr(writing, "rows_of", None)  # nothing is written again
    prune_tiles(tiles, out, **request)

    assert {path.name for path in out.iterdir()} == {path.name for path in tiles}


@pytest.mark.parametrize("calls", [1, 4, 8, 12])
def test_on_a_full_disk_what_is_done_stays(tmp_path, tiles, views, monkeypatch, calls):
    """Wherever it fills up, the file is named, and the same call goes on once there is room."""
    prune_tiles(tiles, tmp_path / "once", **asked(views))
    done, guarded = [], mapped.writing

    @contextlib.contextmanager
    def filling(path):
        done.append(path)
        with guarded(path):
            if len(done) >= calls:
                raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
            yield

    with monkeypatch.context() as patched:
        patched.setattr(mapped, "writing", filling)
        patched.setattr(writing, "writing", filling)
        with pytest.raises(Interrupted) as stopped:
            prune_tiles(tiles, tmp_path / "out", **asked(views), threads=1)
    words = f"{done[-1]}: no space left on the disk; the same command goes on where this one was"
    assert str(stopped.value) == words

    prune_tiles(tiles, tmp_path / "out", **asked(views))
    assert bytes_in(tmp_path / "out") == bytes_in(tmp_path / "once")


def test_an_array_that_a_power_cut_truncated_is_made_again(tmp_path, tiles, views):
    """The next run copies the tiles again, and ends with the same bytes."""
    prune_tiles(tiles, tmp_path / "once", **asked(views))
    with pytest.raises(KeyboardInterrupt):
        prune_tiles(tiles, tmp_path / "out", **asked(views), progress=stopping("scoring"))
    (damaged,) = (tmp_path / "out").rglob("splats/log_scales")
    os.truncate(damaged, 300)

    prune_tiles(tiles, tmp_path / "out", **asked(views))

    assert bytes_in(tmp_path / "out") == bytes_in(tmp_path / "once")


def test_a_tile_with_the_longest_name_is_pruned(tmp_path, tiles, views):
    """255 bytes: what is noted of a tile does not have its name."""
    long = tmp_path / f"{'x' * 251}.ply"
    tiles[0].rename(long)

    prune_tiles([long, *tiles[1:]], tmp_path / "out", **asked(views))

    assert (tmp_path / "out" / long.name).exists()


def test_another_job_does_not_take_over_what_is_left(tmp_path, tiles, views):
    """Of another budget, the folder has another name."""
    with pytest.raises(KeyboardInterrupt):
        prune_tiles(tiles, tmp_path / "out", views, HALF, CLOSED, progress=stopping("writing"))
    report = prune_tiles(tiles, tmp_path / "out", **asked(views, Budget(ratio=0.25)))

    assert report["splats"]["removed"] == COUNT // 4


def test_two_runs_do_not_work_in_one_folder(tmp_path):
    """The second is told so, and takes nothing away from the first."""
    job = tmp_path / "job"
    with (
        tiles_prune._opened(job, None),
        pytest.raises(RefineError, match="another run"),
        tiles_prune._opened(job, None),
    ):
        pass
    assert not job.exists()


# Behind URLs.

NAMES = ("a.ply", "b.ply")
URLS = [f"memory://in/{name}" for name in NAMES]


@pytest.fixture
def fsspec():
    """Give fsspec, with nothing in its memory, afterwards too."""
    fsspec = pytest.importorskip("fsspec")
    memory = fsspec.filesystem("memory")
    memory.rm("/", recursive=True) if memory.ls("/") else None
    yield fsspec
    memory.store.clear()
    memory.pseudo_dirs[:] = [""]


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """Stand in a folder with two tiles; the second has elements before and after its splats."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(source, "ROWS", 100)
    random = np.random.default_rng(1)
    (tmp_path / "a.ply").write_bytes(plain_ply(130, seed=1))
    rows = random.normal(size=(170, len(splat_names(1)))).astype("<f4")
    whole = plain_header(170, splat_names(1))
    whole = whole.replace(b"element vertex", b"element cell 3\nproperty uchar id\nelement vertex")
    whole = whole.replace(b"end_header", b"element more 2\nproperty short id\nend_header")
    (tmp_path / "b.ply").write_bytes(whole + b"abc" + rows.tobytes() + b"more")
    return tmp_path


@pytest.fixture
def memory(fsspec, folder):
    """Give the file system in memory, with the two tiles."""
    system = fsspec.filesystem("memory")
    for name in NAMES:
        system.pipe_file(f"/in/{name}", (folder / name).read_bytes())
    return system


def here(folder, views, *more):
    """Give the bytes of the tiles pruned on the disk."""
    prune_tiles(NAMES, folder / "here", **asked(views, HALF, *more))
    return [(folder / "here" / name).read_bytes() for name in NAMES]


@pytest.mark.parametrize("more", [(CLOSED,), (MERGE,)], ids=["deleted", "merged"])
def test_behind_urls_the_same_bytes_are_written(folder, memory, views, more):
    """Tiles and folder are in memory; nothing else is left there, nor here."""
    report = prune_tiles(URLS, "memory://out/deep", **asked(views, HALF, *more))

    assert not list(folder.glob(".refine*"))
    assert sorted(memory.find("/out")) == [f"/out/deep/{name}" for name in NAMES]
    found = [memory.cat_file(f"/out/deep/{name}") for name in NAMES]
    assert found == here(folder, views, *more)
    assert [tile["input"] for tile in report["tiles"]] == URLS
    assert [tile["output"] for tile in report["tiles"]] == [
        f"memory://out/deep/{name}" for name in NAMES
    ]
    assert [tile["output_bytes"] for tile in report["tiles"]] == [*map(len, found)]


@pytest.mark.usefixtures("memory")
def test_paths_and_urls_go_together(folder, views):
    """One tile of each, written to the disk; the dry run tells the same bytes."""
    tiles = [NAMES[0], URLS[1]]
    told = prune_tiles(tiles, None, **asked(views))
    prune_tiles(tiles, folder / "out", **asked(views))

    found = [(folder / "out" / name).read_bytes() for name in NAMES]
    assert found == here(folder, views)
    assert [tile["output_bytes"] for tile in told["tiles"]] == [*map(len, found)]


def test_of_a_tile_no_more_than_its_rows_are_read(folder, memory, views, monkeypatch):
    """Once to score and once to write, and the header and what is beside the rows, once each.

    Looking at the tile fetches its first bytes besides; here that is all of it, so it is left out.
    """
    taken = []
    read = type(memory).cat_file

    def noting(self, path, *, start, end):  # by name, as storages have others between these
        taken.append(end - start)
        return read(self, path, start, end)

    monkeypatch.setattr(type(memory), "cat_file", noting)
    monkeypatch.setattr(writing, "ROWS", 100)

    prune_tiles(URLS, folder / "out", **asked(views))

    tiles = [source.tile_at(url) for url in URLS]
    rows = sum(tile.splats * tile.dtype.itemsize for tile in tiles)
    once_each = 2 * rows + sum(tile.fixed_bytes + tile.header for tile in tiles)
    assert sum(taken) <= once_each
    assert max(taken) <= 100 * tiles[1].dtype.itemsize


def test_files_there_are_replaced_only_when_told(memory, views):
    """Both or none: the second is there, so the first is not written."""
    memory.pipe_file("/out/b.ply", b"old")

    with pytest.raises(RefineError, match=r"^memory://out/b\.ply: exists already"):
        prune_tiles(URLS, "memory://out", **asked(views))
    assert memory.find("/out") == ["/out/b.ply"]

    prune_tiles(URLS, "memory://out", **asked(views, overwrite=True))
    assert memory.cat_file("/out/b.ply") != b"old"
    assert memory.find("/out") == ["/out/a.ply", "/out/b.ply"]


@pytest.mark.usefixtures("memory")
def test_what_is_read_is_not_replaced(folder, views):
    """However it is called: by the same URL, or as a path here and a URL of a link there."""
    (folder / "link").symlink_to(folder)
    with pytest.raises(RefineError, match=r"memory:///in/a\.ply: is read until all"):
        prune_tiles(URLS, "memory:///in", **asked(views, overwrite=True))
    with pytest.raises(RefineError, match=r"a\.ply: is read until all"):
        prune_tiles(NAMES, f"file://{folder}/link", **asked(views, overwrite=True))


def test_a_tile_behind_a_url_that_changes_meanwhile_stops_all(folder, memory, views):
    """Its bytes and size stay, the time does not; nothing is left here or there."""

    def progress(_fraction, what):
        if what == "scoring":
            memory.pipe_file("/in/b.ply", memory.cat_file("/in/b.ply"))

    with pytest.raises(RefineError, match=r"^memory://in/b\.ply: was changed while it was worked"):
        prune_tiles(URLS, "memory://out", **asked(views), progress=progress)

    assert memory.find("/out") == []
    assert not list(folder.glob(".refine*"))


def test_a_storage_that_fails_leaves_what_is_done(folder, memory, views, monkeypatch):
    """The second upload fails; the same call then reads and writes no tile again."""
    put, sent = type(memory).put_file, []

    def failing(self, source, target, **options):
        sent.append(target)
        if len(sent) == 2:
            raise ConnectionError("the line is dead")
        return put(self, source, target, **options)

    monkeypatch.setattr(type(memory), "put_file", failing)
    with pytest.raises(
        RefineError, match=r"000001: cannot be written \(the line is dead\); the same command goes"
    ):
        prune_tiles(URLS, "memory://out", **asked(views), threads=1)
    assert len(memory.find("/out")) == 1

    with monkeypatch.context() as patched:
        patched.setattr(writing, "rows_of", None)
        prune_tiles(URLS, "memory://out", **asked(views), threads=1)
    assert [Path(path).name[-6:] for path in sent] == ["000000", "000001", "000001"]
    assert memory.find("/out") == ["/out/a.ply", "/out/b.ply"]
    assert [memory.cat_file(f"/out/{name}") for name in NAMES] == here(folder, views)


def test_a_storage_that_cannot_be_written_to_is_known_at_once(memory, views, monkeypatch):
    """Before anything is read or scored."""

    def refused(_self, _path, _value, **_options):
        raise PermissionError("read-only")

    monkeypatch.setattr(type(memory), "pipe_file", refused)
    monkeypatch.setattr(tiles_prune, "copied", None)

    with pytest.raises(RefineError, match=r"^memory://out: cannot be written to \(read-only\)$"):
        prune_tiles(URLS, "memory://out", **asked(views))


ASCII = plain_header(1, splat_names(0), "ascii") + b"0 " * 17 + b"\n"
LISTS = plain_ply(1).replace(
    b"element vertex", b"element face 1\nproperty list uchar int i\nelement vertex"
)


@pytest.mark.parametrize("where", ["memory://in", "."])
@pytest.mark.parametrize(
    ("content", "words"),
    [
        (None, r"cannot be read \((there is no such file|No such file or directory)\)"),
        (b"", "the file is empty"),
        (b"ply\nformat", "header without end"),
        (plain_ply(9)[:-1], r"truncated: .* announces 9 rows of 'vertex'"),
        (b"NGSP1234", "an SPZ file: 'refine convert"),
        (ASCII, "is ascii 1.0, expected a plain binary PLY as a tile"),
        (LISTS, "has (a list|lists).* before the splats, expected"),
    ],
    ids=["missing", "empty", "header", "truncated", "spz", "text", "lists"],
)
def test_what_is_no_tile_is_named_as_it_was_given(folder, memory, views, where, content, words):
    """Of a path and of a URL."""
    for write_to in (lambda data: memory.pipe_file("/in/b.ply", data), Path("b.ply").write_bytes):
        write_to(content or b"")
    if content is None:
        memory.rm_file("/in/b.ply")
        Path("b.ply").unlink()
    path = "memory://in/b.ply" if where != "." else "b.ply"

    with pytest.raises(RefineError, match=rf"^{path}: .*{words}|^{path}: {words}"):
        prune_tiles([NAMES[0], path], folder / "out", **asked(views))


def test_a_storage_that_only_sends_whole_files_is_refused(memory, monkeypatch):
    """As a server without ranges: what it sends can be read, but not from the middle."""

    class Stream(io.BytesIO):
        def seek(self, place, _whence=0):
            if place:
                raise ValueError("no ranges")

    opened = Stream(memory.cat_file("/in/a.ply"))
    monkeypatch.setattr(type(memory), "open", lambda *_given, **_options: opened)

    with pytest.raises(RefineError, match=r"^memory://in/a\.ply: cannot be read \(no ranges\)$"):
        source.tile_at(URLS[0])


def test_a_long_header_is_read_whole(memory):
    """A header of 100 kB, of which the first bytes fetched hold only a part."""
    header = plain_header(1, splat_names(0)).replace(b"element", b"comment " * 12500 + b"\nelement")
    memory.pipe_file("/long.ply", header + b"\0" * 68)

    tile = source.tile_at("memory://long.ply")

    assert (tile.splats, tile.begin, tile.size) == (1, len(header), len(header) + 68)


@pytest.mark.usefixtures("memory")
@pytest.mark.parametrize(
    ("url", "words"),
    [
        ("nowhere://in/a.ply", "Protocol not known: nowhere"),
        ("lacking://in/a.ply", "Install lacking to use it"),
        ("memory://in", "is a folder, expected a PLY file"),
    ],
)
def test_urls_that_cannot_be_opened_are_named(monkeypatch, url, words):
    """A scheme nobody knows, one whose package is not installed, and a folder."""
    needs = {"class": "refine_lacking.System", "err": "Install lacking to use it"}
    known = sys.modules["fsspec.registry"].known_implementations
    monkeypatch.setitem(known, "lacking", needs)

    with pytest.raises(RefineError, match=rf"^{url}: .*{words}"):
        source.tile_at(url)


def test_without_fsspec_the_extra_is_named(folder, views, monkeypatch):
    """Paths need none."""
    monkeypatch.setitem(sys.modules, "fsspec.core", None)

    needed = r": URLs need fsspec: pip install 'refine-addon\[distributed\]'"
    with pytest.raises(RefineError, match=rf"^memory://in/a\.ply{needed}"):
        prune_tiles(URLS, None, **asked(views))
    with pytest.raises(RefineError, match=rf"^memory://out{needed}"):
        prune_tiles(NAMES, "memory://out", **asked(views))
    assert here(folder, views)


@pytest.mark.parametrize(
    ("url", "name", "suffix"),
    [
        ("s3://bucket/deep/a.ply", "a.ply", ".ply"),
        ("https://host/a.ply?key=1/2.x", "a.ply", ".ply"),
        ("https://host/", "", ""),
        ("memory://a?b.ply", "a?b.ply", ".ply"),
    ],
)
def test_a_url_has_a_name(url, name, suffix):
    """What is behind the last slash; a query is part of it only where it is none."""
    assert (Url(url).name, Url(url).suffix) == (name, suffix)


def test_what_is_a_url_and_what_a_path():
    """A drive of Windows has one letter; a slash less makes a path; folders end with a slash."""
    assert isinstance(storage.located("C://a.ply"), Path)
    assert isinstance(storage.located("s3:/a.ply"), Path)
    assert isinstance(storage.located("simplecache::s3://a.ply"), Url)
    assert Url("memory://") / "a" == Url("memory://a")
    assert Url("memory://a") / "b" == Url("memory://a/b")


class Server(BaseHTTPRequestHandler):
    """Serves files of the directory, by ranges unless told otherwise."""

    ranges = True
    sent: list[int]

    def do_HEAD(self):
        """Say how long a file is."""
        self._answer(body=False)

    def do_GET(self):
        """Send a file or a part of it."""
        self._answer(body=True)

    def _answer(self, *, body):
        path = Path(self.path[1:])
        if not path.exists():
            self.send_error(404)
            return
        content, code = path.read_bytes(), 200
        size = len(content)
        found = re.fullmatch(r"bytes=(\d+)-(\d+)", self.headers.get("Range", ""))
        if found and self.ranges:
            start, last = map(int, found.groups())
            content, code = content[start : last + 1], 206
        self.send_response(code)
        if code == 206:
            self.send_header("Content-Range", f"bytes {start}-{last}/{size}")
        self.send_header("Content-Length", str(len(content)))
        self.send_header("ETag", str(path.stat().st_mtime_ns))
        self.end_headers()
        if body:
            self.sent.append(len(content))
            self.wfile.write(content)

    def log_message(self, *_words):
        """Say nothing."""


@pytest.fixture
def server(fsspec):
    """Serve the current directory; give the server, which has its address."""
    pytest.importorskip("aiohttp", reason="fsspec opens http:// by aiohttp")
    handler = type("Handler", (Server,), {"sent": []})
    with ThreadingHTTPServer(("127.0.0.1", 0), handler) as server:
        threading.Thread(target=server.serve_forever, daemon=True).start()
        server.address = f"http://127.0.0.1:{server.server_port}"
        yield server
        server.shutdown()
        fsspec.asyn.reset_lock()


@pytest.mark.slow
@pytest.mark.filterwarnings("default")
def test_a_server_sends_ranges(folder, server, views):
    """The same bytes as from the disk; nobody can write there."""
    urls = [f"{server.address}/{name}" for name in NAMES]

    prune_tiles(urls, folder / "out", **asked(views))

    assert [(folder / "out" / name).read_bytes() for name in NAMES] == here(folder, views)
    with pytest.raises(RefineError, match=r"^http://.*/out: cannot be written to \("):
        prune_tiles(urls, f"{server.address}/out", **asked(views))
    tile = source.tile_at(urls[0])
    (folder / "a.ply").write_bytes(plain_ply(130, seed=2))
    with pytest.raises(RefineError, match=r"^http://.*/a\.ply: was changed"):
        source.rows_of(tile, 0, 1)


@pytest.mark.filterwarnings("default")
def test_a_server_that_only_sends_whole_files_is_refused(folder, server):
    """It is noticed by the last byte: of a large file only the beginning would have been sent."""
    (folder / "large.ply").write_bytes(plain_ply(2000))
    server.RequestHandlerClass.ranges = False

    with pytest.raises(RefineError, match=r"large\.ply: cannot be read \(.*range requests"):
        source.tile_at(f"{server.address}/large.ply")


def call(*words):
    """Run the command with cameras, and return its exit code."""
    return main([*words, "--cameras", str(ROOM / "cameras.json")])


@pytest.mark.parametrize(
    "words",
    [
        ["prune", "s3://in/a.ply", "-o", "out"],
        ["prune", "a.ply", "-o", "s3://out"],
        ["prune", "a.ply", "-o", "s3://out/a.ply"],
        ["clean", "s3://in/a.ply"],
        ["clean", "a.ply", "-o", "s3://out"],
        ["score", "s3://in/a.ply", "-o", "out.ply"],
        ["lod", "a.ply", "-o", "s3://out"],
        ["prune", "a.ply", "--together", "-o", "out", "--report", "s3://out/told.json"],
    ],
    ids=" ".join,
)
def test_elsewhere_a_url_is_wrong_usage(folder, capsys, words):
    """Exit code 2; it is not taken for a path, so no folder of its name is made."""
    assert call(*words) == 2

    assert re.search(r"s3://\S+: is a URL, expected a local path", capsys.readouterr().err)
    assert sorted(path.name for path in folder.iterdir()) == [*NAMES]


@pytest.mark.parametrize("words", [["info", "s3://a.ply"], ["convert", "a.ply", "s3://b.spz"]])
def test_commands_without_cameras_refuse_urls_too(capsys, words):
    """Exit code 2."""
    assert main(words) == 2
    assert "is a URL, expected a local path" in capsys.readouterr().err


def test_only_a_ply_is_made_behind_a_url(folder, memory, capsys):
    """What is there cannot be looked into to see that it holds splats."""
    memory.pipe_file("/in/cameras", (folder / "a.ply").read_bytes())

    words = ["memory://in/cameras", "--together", "-o", "memory://out"]
    assert call("prune", *words) == 2
    assert "memory://out/cameras: expected a name that ends in .ply" in capsys.readouterr().err


def test_functions_for_one_file_refuse_urls():
    """As the command does."""
    with pytest.raises(RefineError, match=r"^s3://in/a\.ply: is a URL, expected a local path"):
        read_splats("s3://in/a.ply")


# On Dask.


def needs_dask(test):
    """Mark a test that starts workers: slow, and Dask's warnings are its own business."""
    return pytest.mark.slow(pytest.mark.filterwarnings("default")(test))


@pytest.fixture(scope="module")
def workers():
    """Start two workers."""
    pytest.importorskip("distributed")
    with cluster.cluster(2) as workers:
        yield workers


def wait_for(workers):
    """Let the workers end what they have begun: each does one thing at a time."""
    client = workers._client
    each = [client.submit(len, "", workers=[name], pure=False) for name in client.nthreads()]
    client.gather(each)


@needs_dask
@pytest.mark.parametrize(
    ("moment", "more"),
    [
        ("scoring", (OCCLUSION,)),
        ("merging", (MERGE,)),
        ("refitting", (Refit(8),)),
        ("writing", (CLOSED,)),
    ],
    ids=["scoring", "merging", "refitting", "writing"],
)
def test_a_killed_worker_changes_no_byte(
    tmp_path, tiles, workers, views, moment, more, monkeypatch
):
    """Whatever it was at, others do it again; the files are those of a run without workers.

    With regions of 1500 splats, which workers merge and refit.
    """
    monkeypatch.setattr(mapped, "REGION", 1500)
    killed = []

    def progress(_fraction, what):
        if what == moment and not killed:
            killed.append(next(iter(workers._client.run(os.getpid).values())))
            os.kill(killed[0], signal.SIGKILL)

    request = asked(views, HALF, *more)
    prune_tiles(tiles, tmp_path / "out", **request, workers=workers, progress=progress)
    prune_tiles(tiles, tmp_path / "here", **request)

    assert killed
    assert bytes_in(tmp_path / "out") == bytes_in(tmp_path / "here")


@needs_dask
def test_what_workers_began_one_process_ends(tmp_path, tiles, views, workers):
    """The folder of the job does not tell who worked on it; behind URLs neither."""
    urls, out = [f"file://{path}" for path in tiles], f"file://{tmp_path}/out"
    with pytest.raises(KeyboardInterrupt), contextlib.chdir(tmp_path):
        prune_tiles(urls, out, **asked(views), workers=workers, progress=stopping("writing"))
    wait_for(workers)

    with contextlib.chdir(tmp_path):
        prune_tiles(urls, out, **asked(views))
    prune_tiles(tiles, tmp_path / "here", **asked(views))

    assert bytes_in(tmp_path / "out") == bytes_in(tmp_path / "here")
    assert not list(tmp_path.glob(".refine*"))


@needs_dask
def test_workers_that_do_not_see_the_files_are_named(tmp_path, tiles, workers, monkeypatch):
    """The folder of the job, a tile, or refine itself is another one there."""
    job = tmp_path / "elsewhere"
    with pytest.raises(RefineError, match=r"worker tcp://.*elsewhere is not there; workers need"):
        workers.check(job, [])
    tile = source.tile_at(tiles[0])
    tiles[0].unlink()
    (job / "tiles").mkdir(parents=True)
    with pytest.raises(RefineError, match=r"worker tcp://.*b\.ply is not there, or another"):
        workers.check(job, [tile])
    monkeypatch.setattr(cluster, "VERSION", "0.0.0")
    with pytest.raises(RefineError, match=r"worker tcp://.*it has refine .*, this is 0\.0\.0"):
        workers.check(job, [])


@needs_dask
def test_a_scheduler_that_is_not_there_is_named(monkeypatch):
    """Nobody listens at port 1."""
    pytest.importorskip("distributed")
    monkeypatch.setattr(cluster, "_CONNECT", 1)
    with (
        pytest.raises(RefineError, match=r"tcp://127\.0\.0\.1:1: no Dask scheduler answers"),
        cluster.cluster("tcp://127.0.0.1:1"),
    ):
        pass


class FakeCluster:
    """Stands for a cluster that takes a moment to start, while Ctrl-C is pressed."""

    made: ClassVar[list[FakeCluster]] = []
    pressed: ClassVar[threading.Event] = threading.Event()

    def __init__(self, **_options):
        self.made.append(self)
        self.started = self.closed = False
        time.sleep(0.1)  # until whoever started this waits
        os.kill(os.getpid(), signal.SIGINT)
        self.pressed.wait(10.0)  # a busy machine takes its time
        time.sleep(0.1)
        self.started = True

    def close(self):
        """Dask asserts that what it closes has started."""
        assert self.started
        self.closed = True


@pytest.mark.slow
def test_ctrl_c_while_workers_start_waits_for_them_and_closes_them(monkeypatch):
    """Dask cannot close workers that are half started: it printed an AssertionError at the end."""
    distributed = pytest.importorskip("distributed")
    monkeypatch.setattr(distributed, "LocalCluster", FakeCluster)

    def press(*_called):
        FakeCluster.pressed.set()
        raise KeyboardInterrupt

    before = signal.signal(signal.SIGINT, press)
    try:
        with pytest.raises(KeyboardInterrupt), cluster.cluster(2):
            pass
    finally:
        signal.signal(signal.SIGINT, before)

    assert [one.closed for one in FakeCluster.made] == [True]


def test_a_worker_that_ends_while_it_starts_is_told_in_a_sentence(monkeypatch):
    """The job has not begun, or goes on where it was: the same command does either."""
    distributed = pytest.importorskip("distributed")

    def failing(**_options):
        raise RuntimeError("Nanny failed to start.")

    monkeypatch.setattr(distributed, "LocalCluster", failing)

    words = r"workers ended while they were started \(Nanny failed to start\.\)"
    with pytest.raises(Interrupted, match=words), cluster.cluster(2):
        pass


@pytest.mark.parametrize(
    ("answers", "raised"),
    [
        ([{"a": OSError("lost"), "b": ""}], None),
        ([{"a": OSError("lost")}, {"c": ""}], None),
        ([{"a": OSError("lost")}] * 3, Interrupted),
        ([{"a": "it is blind", "b": OSError("lost")}], RefineError),
    ],
    ids=["one", "all", "again and again", "another"],
)
def test_workers_lost_while_they_are_asked_do_not_end_a_job(tmp_path, answers, raised):
    """Others answer for them, or those that are started in their place."""
    left = [*answers]
    client = SimpleNamespace(
        run=lambda *_given, **_options: left.pop(0), wait_for_workers=lambda *_given, **_options: 0
    )
    check = cluster.Cluster(client).check

    with contextlib.nullcontext() if raised is None else pytest.raises(raised):
        check(tmp_path, [])

    assert not left


@pytest.mark.parametrize("counts", [[], [{}, {"there": 1}]], ids=["for good", "for a while"])
def test_a_job_whose_workers_are_all_lost_ends(monkeypatch, counts):
    """They may come back, so not at once; a job that has ended goes on where it was."""
    pytest.importorskip("distributed")
    monkeypatch.setattr(cluster, "_ALONE", 0.5)
    left, never = [*counts], SimpleNamespace(add_done_callback=lambda _: None)
    client = SimpleNamespace(
        nthreads=lambda: left.pop(0) if left else {}, submit=lambda *_, **__: never,
        cancel=lambda _: None,
    )  # fmt: skip
    began = time.monotonic()

    with pytest.raises(Interrupted, match="all workers were lost"):
        next(cluster.Cluster(client).run(b"", [0], lambda *_: None, ""))

    assert not left
    assert time.monotonic() - began > 0.5


def test_without_dask_the_extra_is_named(tmp_path, tiles, capsys, monkeypatch):
    """Nothing else needs it, so it is asked for only here; exit code 1."""
    monkeypatch.setitem(sys.modules, "distributed", None)
    options = ["--together", "--method", "closed-form", "--workers", "2"]

    assert call("prune", *map(str, tiles), *options, "-o", str(tmp_path / "out")) == 1
    assert "pip install 'refine-addon[distributed]'" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (["--workers", "2"], "--workers goes with --together"),
        (["--together", "--method", "closed-form", "--workers", "0"], "expected 1 or more"),
    ],
)
def test_workers_that_cannot_be_are_wrong_usage(tiles, capsys, options, words):
    """Exit code 2."""
    assert call("prune", *map(str, tiles), *options, "-o", "out") == 2
    assert words in capsys.readouterr().err
