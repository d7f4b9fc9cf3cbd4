"""Many files pruned as one scene, against one file in memory; on disks, behind URLs, on Dask."""

import contextlib
import functools
import io
import json
import os
import re
import shutil
import signal
import socket
import sys
import threading
import time
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

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
)
from refine_addon.core.formats.ply import with_count
from refine_addon.core.mapped import Interrupted
from refine_addon.core.quality.psnr import psnr_against
from refine_addon.core.refit import round_rays
from refine_addon.core.splats import joined
from refine_addon.core.tiles import cluster, files, storage
from refine_addon.core.visibility import projection
from refine_addon.core.visibility.cast import validation_rays
from refine_addon.core.whole_file import Url
from tests.hostile import files_of_at_most
from tests.places import ROOM
from tests.strategies import plain_header, plain_ply, ply_of, splat_names

from .test_levels import merges  # noqa: F401 - a fixture

fsspec = pytest.importorskip("fsspec")

COUNT = 5000
CUTS = (0, 700, 700, 2600, COUNT)  # a short tile, an empty one, and two that are read in pieces
HALF = Budget(ratio=0.5)
CLOSED, OCCLUSION, MERGE = ClosedForm(8), Occlusion(8), Merge(8)
NAMES = ["a.ply", "b.ply"]

room = functools.cache(lambda: read_ply(ROOM / "point_cloud.ply"))
VIEWS = read_cameras(ROOM / "cameras.json")


@pytest.fixture(autouse=True)
def small(monkeypatch):
    """Make pieces and boxes so small that 5000 splats have several of each."""
    monkeypatch.setattr(files, "ROWS", 1000)
    monkeypatch.setattr(mapped, "_ROWS", 300)
    monkeypatch.setattr(projection, "CHUNK", 700)


def room_rows():
    """`COUNT` rows of the room; some are equal, some cannot be drawn, one is far away."""
    rows = room().rows[::7][:COUNT].copy()
    rows[900:1300] = rows[100]
    rows["x"][[5, 2000]] = np.nan
    rows["x"][7] = 1e30
    rows["opacity"][10:400:7] = -np.inf
    rows["scale_0"][4000] = np.inf
    return rows


def write(path, rows):
    path.write_bytes(with_count(room().header, len(rows)) + rows.tobytes())


def cut(folder, rows, cuts=CUTS):
    """Write rows as files cut at some of them; names have 255 bytes, in another order."""
    paths = [folder / f"{name * 251}.ply" for name in "badc"[: len(cuts) - 1]]
    for path, start, stop in zip(paths, cuts, cuts[1:], strict=False):
        write(path, rows[start:stop])
    return paths


def rows_in(folder, paths):
    return np.concatenate([read_ply(folder / path.name).rows for path in paths])


def names_in(folder):
    return sorted(path.name for path in folder.iterdir())


@pytest.fixture
def tiles(tmp_path):
    """Write rows of the room as four files, and as one."""
    write(tmp_path / "whole.ply", room_rows())
    return cut(tmp_path, room_rows())


def run(tiles, folder, method=CLOSED, budget=HALF, views=VIEWS, **more):
    return prune_tiles(tiles, folder, views, budget, method, **more)


class Store:
    """Two tiles and a folder for outputs; the second has more elements, and 70 kB of header."""

    def __init__(self, root, system):
        self.tiles = [f"{root}/in/{name}" for name in NAMES]
        self.out = f"{root}/out"
        self.system = system
        rows = room().rows[::20][:400]
        self.put(self.tiles[0], with_count(room().header, 230) + rows[:230].tobytes())
        header = with_count(room().header, 170).replace(b"element", b"element a 3\nelement")
        header = header.replace(b"a 3\n", b"a 3\nproperty uchar i\ncomment" + 70_000 * b" " + b"\n")
        header = header.replace(b"end_header", b"element b 2\nproperty short i\nend_header")
        self.put(self.tiles[1], header + b"abc" + rows[230:].tobytes() + b"more")

    def put(self, path, data):
        inner = self.system._strip_protocol(path)
        self.system.makedirs(inner.rpartition("/")[0], exist_ok=True)
        self.system.pipe_file(inner, data)

    def get(self, path):
        return self.system.cat_file(path)

    def made(self):
        """Names and bytes of all outputs, and of whatever else is left there."""
        if not self.system.exists(self.out):
            return {}
        self.system.invalidate_cache()
        paths = self.system.find(self.out)
        return {path.rpartition("/out/")[2]: self.get(path) for path in paths}

    def once(self, *how):
        """The outputs of a run that nothing disturbs, of tiles on the disk."""
        here = Path("undisturbed")
        for path in self.tiles:
            (here / "in").mkdir(parents=True, exist_ok=True)
            (here / "in" / Path(path).name).write_bytes(self.get(path))
        run([here / "in" / name for name in NAMES], here / "out", *how, overwrite=True)
        return {name: (here / "out" / name).read_bytes() for name in NAMES}


@pytest.fixture
def memory(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    system = fsspec.filesystem("memory")
    yield Store("memory:/", system)
    system.store.clear()
    system.pseudo_dirs[:] = [""]


@pytest.fixture(params=["disk", "memory"])
def store(request, tmp_path, monkeypatch):
    if request.param == "memory":
        return request.getfixturevalue("memory")
    monkeypatch.chdir(tmp_path)
    return Store(str(tmp_path), fsspec.filesystem("file"))


# The law: tiles give the rows of one file.

WAYS = [
    *((CLOSED, budget, None) for budget in (
        Budget(ratio=0.1),  # among the equal ones, which are those from the 253rd to the 653rd
        Budget(ratio=0.0), Budget(keep=1), Budget(max_mb=0.4), Budget(psnr=36.0),
    )),
    (OCCLUSION, Budget(ratio=0.7), None),
    (OCCLUSION, Budget(psnr=36.0), None),
    (MERGE, Budget(ratio=0.1), None),
    (MERGE, Budget(psnr=36.0), None),
    (MERGE, Budget(ratio=0.8), "antialiased"),
    (Refit(8, 2), Budget(ratio=0.5), "2dgs"),
]  # fmt: skip


@pytest.mark.slow
@pytest.mark.parametrize(("method", "budget", "model"), WAYS, ids=str)
def test_of_tiles_the_same_rows_stay_as_of_one_file(tmp_path, tiles, method, budget, model):
    """To the byte, in the order of the files; reports agree.
    The four headers take bytes that one does not, so of a size as many rows are compared."""
    out, pruned = tmp_path / "out", tmp_path / "pruned.ply"
    told = run(tiles, out, method, budget, model=model)
    if budget.max_mb:
        assert 0 <= 400_000 - told["files"]["output_bytes"] < 2 * 248
        budget = Budget(keep=told["splats"]["kept"])
    whole = prune_file(tmp_path / "whole.ply", pruned, VIEWS, budget, method, model=model).report
    assert rows_in(out, tiles).tobytes() == read_ply(pruned).rows.tobytes()
    assert {read_ply(out / tile.name).model for tile in tiles} == {model or "default"}
    del whole["splats"]["unseen_removed"]
    for key in ("splats", "weights", "views", "estimated_psnr", "quality"):
        assert told[key] == whole[key]
    assert names_in(out) == sorted(tile.name for tile in tiles)
    assert [tile["before"] for tile in told["tiles"]] == [700, 0, 1900, 2400]
    for path, tile in zip(tiles, told["tiles"], strict=True):
        assert (tile["input"], tile["output"]) == (str(path), str(out / path.name))
        assert tile["kept"] == len(read_ply(out / path.name))
        assert tile["output_bytes"] == (out / path.name).stat().st_size


@pytest.mark.slow
@pytest.mark.parametrize(
    ("method", "budget"), [(CLOSED, Budget(max_mb=0.1)), (MERGE, Budget(ratio=0.6))], ids=str
)
def test_tiles_of_several_degrees_and_types_are_one_scene(tmp_path, method, budget):
    """Each keeps its own properties. For a size each splat counts as the longest row."""
    paths = [tmp_path / f"{name}.ply" for name in "abc"]
    parts = np.split(room().rows[:36000:40], 3)
    for path, degree, rows in zip(paths, (3, 1, 0), parts, strict=True):
        kind = "f4" if degree else "f8"
        path.write_bytes(ply_of({name: rows[name].astype(kind) for name in splat_names(degree)}))
    files = [read_ply(path) for path in paths]
    sizes = max(file.row_bytes for file in files), sum(file.fixed_bytes for file in files)
    whole = joined([file.splats() for file in files])
    result = prune(whole, VIEWS, budget, method, sizes=sizes)
    told = run(paths, tmp_path / "out", method, budget)
    made = [read_ply(tmp_path / "out" / path.name).splats() for path in paths]
    assert told["splats"]["kept"] == sum(map(len, made)) == np.count_nonzero(result.keep) > 300
    assert [splats.sh_rest.shape[1] for splats in made] == [15, 3, 0]
    assert made[2].means.dtype == np.float64
    ends = np.cumsum([len(splats) for splats in made])[:-1]
    for name in ("means", "sh_rest"):
        for splats, part in zip(made, np.split(getattr(result.splats, name), ends), strict=True):
            found = getattr(splats, name)
            np.testing.assert_array_equal(found, part[:, : found.shape[1]].astype(found.dtype))
    assert method is MERGE or told["files"]["output_bytes"] <= 0.1 * 1e6


@pytest.mark.slow
@pytest.mark.parametrize(
    ("ratio", "used", "step"),
    [(0.05, VIEWS, 4), (0.8, VIEWS, 4), (0.5, VIEWS.take(range(3)), 2)],
    ids=["deleted", "merged", "three views"],
)
def test_merging_by_regions_is_as_good_as_merging_one_file(
    tmp_path, merges, monkeypatch, ratio, used, step
):
    """Within .3 dB; of 5 %, which are deleted alone, the same rows stay.
    No splat is merged twice or lost, though the stages divide along other planes."""
    monkeypatch.setattr(mapped, "REGION", 10_000 // step)
    out, method, judging = tmp_path / "out", Merge(16), VIEWS.spread(16)
    rows, splats = room().rows[::step], room().splats().take(slice(None, None, step))
    tiles = cut(tmp_path, rows, (0, 3000, len(rows)))
    one = prune(splats, used, Budget(ratio=ratio), method)
    told = run(tiles, out, method, Budget(ratio=ratio), used)
    rays, found = validation_rays(splats, judging), rows_in(out, tiles)
    made = joined([read_ply(out / path.name).splats() for path in tiles])
    assert psnr_against(rays, made, judging) > psnr_against(rays, one.splats, judging) - 0.3
    assert len(made) == told["splats"]["kept"] == one.report["splats"]["kept"]
    counts, same = told["merged"], np.isin(found.view("V248"), rows.view("V248"))
    assert counts["merged"] + counts["deleted"] == len(rows) - len(found)
    assert counts["merged"] >= counts["changed"] == np.count_nonzero(~same)
    assert (counts["changed"] > 100) is (ratio > 0.1)
    assert ratio > 0.1 or found.tobytes() == rows[one.keep].tobytes()
    assert np.isfinite([found[name] for name in found.dtype.names]).all()


@pytest.mark.slow
def test_refitting_by_regions_is_as_good_as_refitting_one_file(tmp_path, tiles, monkeypatch):
    """Within 1.3 dB: regions of 600 splats are border for the most part (docs/scale.md)."""
    monkeypatch.setattr(round_rays, "MIN_RAYS", 1 << 14)
    monkeypatch.setattr(mapped, "REGION", 1500)
    told = run(tiles, tmp_path / "out", Refit(8))
    one = prune_file(tmp_path / "whole.ply", None, VIEWS, HALF, Refit(8))
    used = VIEWS.spread(8)
    rays = validation_rays(read_ply(tmp_path / "whole.ply").splats(), used)
    made = joined([read_ply(tmp_path / "out" / path.name).splats() for path in tiles])
    psnr = psnr_against(rays, made, used)
    assert psnr > psnr_against(rays, one.splats, used) - 1.3
    assert told["estimated_psnr"] == pytest.approx(psnr, abs=0.1)
    same = np.isin(rows_in(tmp_path / "out", tiles).view("V248"), room_rows().view("V248"))
    assert told["refitted"]["changed"] <= np.count_nonzero(~same) <= len(made) == COUNT // 2


def when(step, act):
    """A progress callback that acts each time it is told of a step."""
    return lambda _fraction, what: act() if what == step else None


# What is refused.


def test_one_tile_or_budget_at_fault_stops_all(tmp_path, tiles):
    """It is named, and no tile is written, nor is a folder left; without outputs, too."""
    more, link, mip = (tmp_path / name for name in ("more", "link", "mip.ply"))
    more.mkdir()
    link.symlink_to(tiles[0])
    header, rows = tiles[0].read_bytes().split(b"element", 1)
    mip.write_bytes(header + b"comment SplatRenderMode: mip\nelement" + rows)
    shutil.copy(tiles[0], more)
    for paths, budget, words in [
        (tiles, Budget(max_mb=0.001), "too small for one splat of 248 bytes"),
        ([*tiles, more], HALF, "more: is a folder, expected a PLY file"),
        ([*tiles, tiles[2]], HALF, r"d\.ply: is given twice$"),
        ([*tiles, link], HALF, r"link: is given twice, also as .*b\.ply"),
        ([*tiles, mip], HALF, r"mip\.ply: its splats are antialiased, those of .*b\.ply default"),
        ([], HALF, "none of 0 tiles has a splat"),
        (tiles[1:2], HALF, "none of 1 tiles has a splat"),
        ([*tiles, more / tiles[0].name], HALF, r"another tile is called b*\.ply too"),
    ]:
        for folder in (tmp_path / "new/deep", *([] if "called" in words else [None])):
            with pytest.raises(RefineError, match=words):
                run(paths, folder, CLOSED, budget)
        assert not (tmp_path / "new").exists()


ASCII = plain_header(1, splat_names(0), "ascii") + b"0 " * 17 + b"\n"
LISTS = plain_ply(1).replace(
    b"element vertex", b"element face 1\nproperty list uchar int i\nelement vertex"
)


@pytest.mark.parametrize(
    ("content", "words"),
    [
        (None, r"cannot be read \((there is no such file|No such file or directory)\)"),
        (plain_ply(9)[:-1], r"truncated: .* announces 9 rows of 'vertex'"),
        (b"NGSP1234", "an SPZ file: 'refine convert"),
        (ASCII, "is ascii 1.0, expected a plain binary PLY as a tile"),
        (LISTS, "has (a list|lists).* before the splats, expected"),
    ],
    ids=["missing", "truncated", "spz", "text", "lists"],
)
def test_what_is_no_tile_is_named_as_it_was_given(store, content, words):
    store.put(store.tiles[1], content or b"")
    if content is None:
        store.system.rm_file(store.tiles[1])
    path = re.escape(store.tiles[1])
    with pytest.raises(RefineError, match=rf"^{path}: .*{words}"):
        run(store.tiles, store.out)
    assert not store.made()


def test_files_that_exist_stay_until_they_may_be_replaced(store):
    """Without a folder the same sizes are told. A path goes together with a URL."""
    store.put(f"{store.out}/b.ply", b"mine")
    with pytest.raises(RefineError, match=rf"^{store.out}/b\.ply: exists already"):
        run(store.tiles, store.out)
    assert store.made() == {"b.ply": b"mine"}
    report = run(store.tiles, store.out, overwrite=True)
    assert store.made() == store.once()
    dry = run(["undisturbed/in/a.ply", store.tiles[1]], None)
    sizes = [*map(len, store.made().values())]
    for told in (report, dry):
        assert [tile["output_bytes"] for tile in told["tiles"]] == sizes


def test_tiles_are_not_replaced_while_they_are_read(tmp_path, tiles):
    """A job that goes on would prune again what was pruned: by a URL of a link, too."""
    (tmp_path / "link").symlink_to(tmp_path)
    for folder in (tmp_path, f"file://{tmp_path}/link"):
        with pytest.raises(RefineError, match=r"b\.ply: is read until all tiles are written"):
            run(tiles, folder, overwrite=True)


def test_a_tile_that_changes_meanwhile_stops_all(store):
    """Written again, the same bytes: they may no longer be those that were scored."""
    again = when("scoring", lambda: store.put(store.tiles[1], store.get(store.tiles[1])))
    with pytest.raises(RefineError, match=r"in/b\.ply: was changed while it was worked on"):
        run(store.tiles, store.out, progress=again)
    assert not store.made()
    assert not list(Path().glob(".refine*"))


def test_outputs_that_are_links_are_refused_where_tiles_would_be_lost(tmp_path, tiles):
    """Two to one file, also where it is not there yet; one to another disk: no renaming there."""
    out, memory = tmp_path / "out", Path("/dev/shm")
    out.mkdir()
    for tile in tiles[:2]:
        (out / tile.name).symlink_to("real.ply")
    with pytest.raises(RefineError, match=r"is the same file as .*, by a link"):
        run(tiles, out)
    for tile in tiles[:2]:
        (out / tile.name).unlink()
    if not memory.is_dir() or memory.stat().st_dev == out.stat().st_dev:
        pytest.skip("there is no second disk")
    (out / tiles[1].name).symlink_to(memory / "far.ply")
    with pytest.raises(RefineError, match="is a link to another disk, /dev/shm; remove the link"):
        run(tiles, out)


# What is done after an interruption.


def stopping(at):
    """A progress callback that stops when it is told of a step for the second time."""
    told = []

    def progress(_fraction, what):
        told.append(what)
        if told.count(at) > 1:
            raise KeyboardInterrupt

    return progress


@pytest.mark.slow
@pytest.mark.parametrize(
    ("method", "stop", "done", "damaged"),
    [
        (CLOSED, "reading", set(), None),
        (CLOSED, "scoring", {"copying"}, None),
        (OCCLUSION, "estimating", {"copying", "scoring"}, None),
        (MERGE, "merging", {"scoring"}, None),
        (MERGE, "writing", {"copying", "scoring", "selecting", "merging", "reading"}, None),
        (CLOSED, "scoring", set(), "splats/log_scales"),
        (CLOSED, "scoring", set(), "splats.done"),
        (CLOSED, "writing", {"copying"}, "kept.done"),
    ],
    ids=["reading", "scoring", "occlusion", "merging", "writing", "array", "splats", "kept"],
)
def test_a_job_that_was_interrupted_goes_on_behind_the_last_stage(
    store, method, stop, done, damaged
):
    """The bytes are the same; what a power cut truncated is made again."""
    told = []
    with pytest.raises(KeyboardInterrupt):
        run(store.tiles, store.out, method, progress=stopping(stop), threads=1)
    assert not store.made().keys() & set(NAMES)
    if damaged:
        (path,) = Path().rglob(damaged)
        os.truncate(path, path.stat().st_size // 2)
    run(store.tiles, store.out, method, progress=lambda _fraction, what: told.append(what))
    if told.count("reading") > 1:  # once at the beginning of scoring
        told.append("copying")
    assert not done & set(told)
    assert store.made() == store.once(method)


def test_a_job_that_was_stopped_while_it_renamed_goes_on(store, monkeypatch):
    """One of two files is in its place already. What replaced it meanwhile stays, unless told."""
    first, publish = f"{store.out}/{NAMES[0]}", storage.publish

    def stop(made, path, **options):
        if path.name == NAMES[1]:
            raise KeyboardInterrupt
        publish(made, path, **options)

    for taken in (False, True):
        with monkeypatch.context() as patched:
            patched.setattr(storage, "publish", stop)
            with pytest.raises(KeyboardInterrupt):
                run(store.tiles, store.out)
        assert set(NAMES) & store.made().keys() == {NAMES[0]}
        if taken:
            store.put(first, b"mine")
            with pytest.raises(RefineError, match="exists already"):
                run(store.tiles, store.out)
            assert store.get(first) == b"mine"
        run(store.tiles, store.out, overwrite=taken)
        assert store.made() == store.once()
        store.system.rm(store.out, recursive=True)


@pytest.mark.parametrize(
    ("overwrite", "words"), [(False, "exists already"), (True, "is a folder, expected a file")]
)
def test_what_appears_in_the_place_of_a_tile_meanwhile_stops_before_the_first(
    store, overwrite, words
):
    """A file, or a folder that nothing can replace."""
    there = f"{store.out}/{NAMES[1]}{'/in' if overwrite else ''}"
    put = when("writing", lambda: store.put(there, b"mine"))
    with pytest.raises(Interrupted, match=f"{words}.*; the same command goes on"):
        run(store.tiles, store.out, overwrite=overwrite, progress=put)
    assert NAMES[0] not in store.made()
    assert store.get(there) == b"mine"
    store.system.rm(f"{store.out}/{NAMES[1]}", recursive=True)
    run(store.tiles, store.out, overwrite=overwrite)
    assert sorted(store.made()) == NAMES


@pytest.mark.parametrize(
    ("step", "size"),
    [("reading", 1_000), ("reading", 60_000), ("selecting", 100), ("writing", 60_000)],
)
def test_on_a_full_disk_what_is_done_stays(tmp_path, tiles, step, size):
    """No file may grow beyond a size, which is the system's own error; there is room later."""
    words = r"cannot be written \(File too large\); the same command goes on where this one was$"
    with contextlib.ExitStack() as held:
        fill = when(step, lambda: held.enter_context(files_of_at_most(size)))
        with pytest.raises(Interrupted, match=rf"^{tmp_path}/out/.*: {words}"):
            run(tiles, tmp_path / "out", threads=1, progress=fill)
    run(tiles, tmp_path / "out")
    one = prune_file(tmp_path / "whole.ply", None, VIEWS, HALF, CLOSED)
    assert rows_in(tmp_path / "out", tiles).tobytes() == room_rows()[one.keep].tobytes()


def test_another_job_does_not_take_over_what_is_left(store):
    with pytest.raises(KeyboardInterrupt):
        run(store.tiles, store.out, progress=stopping("writing"))
    assert run(store.tiles, store.out, CLOSED, Budget(ratio=0.25))["splats"]["removed"] == 100


def test_two_runs_do_not_work_in_one_folder(store):
    def second():
        with pytest.raises(RefineError, match="another run is at work on the same job"):
            run(store.tiles, store.out)

    run(store.tiles, store.out, progress=when("scoring", second))
    assert store.made() == store.once()


# Behind URLs.


def test_of_a_tile_no_more_than_its_rows_are_read(memory, monkeypatch):
    """Once to score and once to write, and the header and what is beside the rows, once each."""
    taken, read = [], type(memory.system).cat_file

    def noting(self, path, *, start, end):  # by name, as storages have others between these
        taken.append(end - start)
        return read(self, path, start, end)

    monkeypatch.setattr(type(memory.system), "cat_file", noting)
    monkeypatch.setattr(files, "ROWS", 100)

    run(memory.tiles, "out")

    tiles = [files.tile_at(url) for url in memory.tiles]
    rows = sum(tile.splats * tile.dtype.itemsize for tile in tiles)
    assert sum(taken) <= 2 * rows + sum(t.size - t.end + t.begin + t.header for t in tiles)
    assert max(taken) <= max(100 * tiles[0].dtype.itemsize, tiles[1].header)


def test_a_storage_that_fails_leaves_what_is_done(memory, monkeypatch):
    """The second upload fails; the same call then sends no tile again."""
    put, sent = type(memory.system).put_file, []

    def failing(self, source, target, **options):
        sent.append(target)
        if len(sent) == 2:
            raise ConnectionError("the line is dead")
        return put(self, source, target, **options)

    monkeypatch.setattr(type(memory.system), "put_file", failing)
    words = r"000001: cannot be written \(the line is dead\); the same command goes"
    with pytest.raises(RefineError, match=words):
        run(memory.tiles, memory.out, threads=1)

    run(memory.tiles, memory.out, threads=1)
    assert [path[-6:] for path in sent] == ["000000", "000001", "000001"]
    assert memory.made() == memory.once()


def test_a_job_behind_a_link_is_refused(tmp_path, tiles):
    """It would write files in a folder elsewhere, and could not remove them at the end."""
    with pytest.raises(KeyboardInterrupt):
        run(tiles, tmp_path / "out", progress=stopping("writing"))
    (job,) = (tmp_path / "out").glob(".refine-*")
    job.rename(tmp_path / "far")
    job.symlink_to(tmp_path / "far")
    with pytest.raises(RefineError, match="is a link, expected a folder of an earlier run"):
        run(tiles, tmp_path / "out")


def test_another_url_is_another_job(memory):
    """One that was interrupted goes on where it was, whatever is written elsewhere meanwhile."""
    told = []
    with pytest.raises(KeyboardInterrupt):
        run(memory.tiles, memory.out, progress=stopping("writing"))

    run(memory.tiles, f"{memory.out}/elsewhere")
    run(memory.tiles, memory.out, progress=lambda _fraction, what: told.append(what))

    assert set(told) == {"writing"}


def test_without_fsspec_the_extra_is_named(memory, monkeypatch):
    """Paths need none."""
    paths = [f"undisturbed/in/{name}" for name in NAMES]
    memory.once()
    monkeypatch.setitem(sys.modules, "fsspec.core", None)
    run(paths, None)
    for tiles, out, named in ((memory.tiles, None, "in/a.ply"), (paths, memory.out, "out")):
        words = f"memory://{named}: URLs need fsspec: pip install 'refine-addon[distributed]'"
        with pytest.raises(RefineError, match=f"^{re.escape(words)}"):
            run(tiles, out)


@pytest.mark.usefixtures("memory")
def test_a_url_is_no_path_and_has_a_name():
    """A drive of Windows has one letter; folders end with a slash."""
    for url, name in [
        ("https://host/a.ply?key=1/2.x", "a.ply"),
        ("memory://a?b.ply", "a?b.ply"),
        ("simplecache::s3://a.ply", "a.ply"),
    ]:
        assert (type(storage.located(url)), storage.located(url).name) == (Url, name)
    assert {type(storage.located(path)) for path in ("C://a.ply", "s3:/a.ply")} == {type(Path())}
    assert Url("memory://a") / "b" == Url("memory://a/b")
    for url, words in [
        ("nowhere://in/a.ply", "Protocol not known: nowhere"),
        ("memory://in", "is a folder, expected a PLY file"),
    ]:
        with pytest.raises(RefineError, match=rf"^{url}: .*{words}"):
            files.tile_at(url)


class Server(SimpleHTTPRequestHandler):
    ranges = True

    def send_head(self):
        found = re.fullmatch(r"bytes=(\d+)-(\d+)", self.headers.get("Range", ""))
        if not found or not self.ranges:
            return super().send_head()
        content = Path(self.path[1:]).read_bytes()
        part = content[int(found[1]) : int(found[2]) + 1]
        self.send_response(206)
        self.send_header("Content-Range", f"bytes {found[1]}-{found[2]}/{len(content)}")
        self.send_header("Content-Length", str(len(part)))
        self.end_headers()
        return io.BytesIO(part)

    def log_message(self, *_words):
        """Say nothing."""


@pytest.mark.slow
@pytest.mark.filterwarnings("default")
def test_a_server_sends_ranges(tmp_path, monkeypatch):
    """The same bytes as from the disk; nobody can write there, and a change is noticed.
    Of a large file, one that only sends whole files would have sent only the beginning: refused."""
    pytest.importorskip("aiohttp", reason="fsspec opens http:// by aiohttp")
    monkeypatch.chdir(tmp_path)
    store = Store(str(tmp_path), fsspec.filesystem("file"))
    with ThreadingHTTPServer(("127.0.0.1", 0), Server) as server:
        threading.Thread(target=server.serve_forever, daemon=True).start()
        address = f"http://127.0.0.1:{server.server_port}"
        urls = [f"{address}/in/{name}" for name in NAMES]
        run(urls, "out")
        assert store.made() == store.once()
        with pytest.raises(RefineError, match=r"^http://.*/out: cannot be written to \("):
            run(urls, f"{address}/out")
        tile = files.tile_at(urls[0])
        store.put(store.tiles[0], plain_ply(130, seed=2))
        with pytest.raises(RefineError, match=r"^http://.*/a\.ply: was changed"):
            files.rows_of(tile, 0, 1)
        Path("large.ply").write_bytes(plain_ply(2000))
        monkeypatch.setattr(Server, "ranges", False)
        with pytest.raises(RefineError, match=r"large\.ply: cannot be read \(.*range requests"):
            files.tile_at(f"{address}/large.ply")
        server.shutdown()
    fsspec.asyn.reset_lock()


# The command.

CAMERAS = f"--cameras {ROOM / 'cameras.json'}"
FAST = f"--together --method closed-form --views 8 {CAMERAS}"
NO_URL = r"s3://\S+: is a URL, expected a local path"


def test_the_command_prunes_as_python_does(store, capsys, monkeypatch):
    """A dry run says the same, and writes nothing. After Ctrl-C the same command goes on."""
    words = ["prune", *store.tiles, "-o", store.out, *FAST.split()]
    assert main([*words, "--dry-run"]) == 0
    assert "2 tiles: would keep 200 of 400 splats" in capsys.readouterr().out
    assert not store.made()

    def stop(*_paths, **_options):
        monkeypatch.setattr(storage, "publish", publish)
        raise KeyboardInterrupt

    publish = storage.publish
    monkeypatch.setattr(storage, "publish", stop)
    assert main(words) == 130
    assert "the same command goes on where this one was" in capsys.readouterr().err

    assert main([*words, "--report", "told.json"]) == 0
    assert store.made() == store.once()
    assert "2 tiles: kept 200 of 400 splats (50.0% removed)" in capsys.readouterr().out
    (told,) = json.loads(Path("told.json").read_text())["results"]
    assert sum(tile["kept"] for tile in told["tiles"]) == 200


@pytest.mark.parametrize(
    ("words", "told"),
    [
        (f"prune s3://in/a.ply -o out {CAMERAS}", NO_URL),
        (f"prune a.ply -o s3://out {CAMERAS}", NO_URL),
        (f"prune a.ply -o out --report s3://out/told.json {FAST}", NO_URL),
        ("info s3://a.ply", NO_URL),
        (f"prune s3://in/a -o s3://out {FAST}", "a: expected a name that ends in .ply"),
        (f"prune a.ply -o out.ply {FAST}", "-o out.ply is one file, expected a folder"),
        (f"prune a.ply -o out {FAST} --clean", "--clean does not go with --together"),
        (f"prune a.ply -o o {FAST} --spz-axes rub", "--spz-axes does not go with"),
        (f"prune a.ply -o o {FAST} --protect sphere:0,0,0,1", "--protect does not go with"),
        (f"prune a.ply {FAST}", "expected -o OUT "),
        (f"prune a.ply -o out {FAST} --workers 0", "expected 1 or more"),
        (f"prune a.ply -o out {CAMERAS} --workers 2", "--workers goes with --together"),
        (f"prune more/../a.ply a.ply -o out {FAST}", "would both be out/a.ply: rename one"),
    ],
)
def test_wrong_usage_is_known_at_once(tmp_path, monkeypatch, capsys, words, told):
    """Exit code 2; no folder of a URL's name is made."""
    monkeypatch.chdir(tmp_path)
    Path("a.ply").write_bytes(plain_ply())
    assert main(words.split()) == 2
    assert re.search(told, capsys.readouterr().err)
    assert names_in(tmp_path) == ["a.ply"]


# On Dask.


needs_dask = pytest.mark.filterwarnings("default")  # Dask's warnings are its own business


@pytest.fixture(scope="module")
def workers():
    pytest.importorskip("distributed")
    with cluster.cluster(2) as workers:
        yield workers


@pytest.mark.slow
@needs_dask
@pytest.mark.parametrize(
    ("moment", "method"),
    [("scoring", OCCLUSION), ("merging", MERGE), ("refitting", Refit(8, 1)), ("writing", CLOSED)],
    ids=["scoring", "merging", "refitting", "writing"],
)
def test_a_killed_worker_changes_no_byte(tmp_path, workers, moment, method, monkeypatch):
    """The files are those of a run without workers, which merge and refit regions of 400 splats."""
    monkeypatch.setattr(mapped, "REGION", 400)
    tiles, killed = cut(tmp_path, room_rows()[::4], (0, 600, 1250)), []

    def progress(_fraction, what):
        if what == moment and not killed:
            killed.append(next(iter(workers.client.run(os.getpid).values())))
            os.kill(killed[0], signal.SIGKILL)

    run(tiles, tmp_path / "out", method, workers=workers, progress=progress)
    run(tiles, tmp_path / "here", method)

    assert killed
    assert rows_in(tmp_path / "out", tiles).tobytes() == rows_in(tmp_path / "here", tiles).tobytes()


@pytest.mark.slow
@needs_dask
def test_what_workers_began_one_process_ends(tmp_path, monkeypatch, workers):
    """The folder of the job does not tell who worked on it; behind URLs neither."""
    monkeypatch.chdir(tmp_path)
    store = Store(f"{tmp_path}", fsspec.filesystem("file"))
    urls, out = [f"file://{path}" for path in store.tiles], f"file://{store.out}"
    with pytest.raises(KeyboardInterrupt):
        run(urls, out, workers=workers, progress=stopping("writing"))
    client = workers.client  # each worker does one thing at a time: wait until it has ended that
    client.gather([client.submit(len, "", workers=[name]) for name in client.nthreads()])
    run(urls, out)
    assert store.made() == store.once()
    assert not list(Path().glob(".refine*"))


@pytest.mark.slow
@needs_dask
def test_workers_that_do_not_see_the_files_are_named(tmp_path, tiles, workers, monkeypatch):
    """The folder of the job, a tile, or refine itself is another one there."""
    job = tmp_path / "elsewhere"
    with pytest.raises(RefineError, match=r"worker tcp://.*elsewhere is not there; workers need"):
        workers.check(job, [])
    tile = files.tile_at(tiles[0])
    tiles[0].unlink()
    (job / "tiles").mkdir(parents=True)
    with pytest.raises(RefineError, match=r"worker tcp://.*b\.ply is not there, or another"):
        workers.check(job, [tile])
    monkeypatch.setattr(cluster, "VERSION", "0.0.0")
    with pytest.raises(RefineError, match=r"worker tcp://.*it has refine .*, this is 0\.0\.0"):
        workers.check(job, [])


@pytest.mark.slow
@needs_dask
def test_an_address_where_no_scheduler_answers_is_told_in_a_sentence(monkeypatch):
    """A web server (Dask took "HTTP/1.1" for a length and could not allocate 3.07 EiB); nobody."""

    def answer():
        with server.accept()[0] as connection:
            connection.recv(1)
            connection.sendall(b"HTTP/1.1 400 Bad Request\r\n\r\n")
            connection.recv(1 << 16)

    with socket.create_server(("127.0.0.1", 0)) as server:
        thread = threading.Thread(target=answer)
        thread.start()
        address = f"tcp://127.0.0.1:{server.getsockname()[1]}"
        words = f"{address}: no Dask scheduler answers there"
        with pytest.raises(RefineError, match=words), cluster.cluster(address):
            pass
        thread.join()
    monkeypatch.setattr(cluster, "_CONNECT", 1)
    with pytest.raises(RefineError, match=words), cluster.cluster(address):
        pass


@pytest.mark.slow
def test_ctrl_c_while_workers_start_waits_for_them_and_closes_them(monkeypatch):
    """Dask cannot close workers that are half started: it printed an AssertionError at the end."""
    distributed, told = pytest.importorskip("distributed"), []

    def starting(**_options):
        time.sleep(0.2)  # until whoever started this waits
        os.kill(os.getpid(), signal.SIGINT)
        time.sleep(0.2)
        told.append("started")
        return SimpleNamespace(close=lambda: told.append("closed"))

    monkeypatch.setattr(distributed, "LocalCluster", starting)
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    try:
        with pytest.raises(KeyboardInterrupt), cluster.cluster(2):
            pass
    finally:
        signal.signal(signal.SIGINT, before)
    assert told == ["started", "closed"]


@pytest.mark.slow
def test_a_job_whose_workers_are_all_lost_ends(monkeypatch):
    """They may come back, so not at once; a job that has ended goes on where it was."""
    pytest.importorskip("distributed")
    monkeypatch.setattr(cluster, "_ALONE", 0.5)
    future = SimpleNamespace(add_done_callback=lambda _: None)
    client = SimpleNamespace(nthreads=dict, submit=lambda *_, **__: future, cancel=lambda _: None)
    began = time.monotonic()
    with pytest.raises(Interrupted, match="all workers were lost"):
        next(cluster.Cluster(client).run(b"", [0], lambda _: None))
    assert time.monotonic() - began > 0.5


def test_without_dask_the_extra_is_named(store, capsys, monkeypatch):
    monkeypatch.setitem(sys.modules, "distributed", None)
    assert main(["prune", *store.tiles, "-o", store.out, *FAST.split(), "--workers", "2"]) == 1
    assert "pip install 'refine-addon[distributed]'" in capsys.readouterr().err
    assert not store.made()
