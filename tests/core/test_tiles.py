"""Many files pruned as one scene, against one file in memory."""

from __future__ import annotations

import contextlib
import errno
import os
import shutil
import sys
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from refine_addon.core import (
    Box,
    Budget,
    Cleaning,
    PruneRequest,
    RefineError,
    Settings,
    Zone,
    prune_file,
    prune_tiles,
    read_cameras,
    read_ply,
    score,
)
from refine_addon.core.picture_files import PictureFiles
from refine_addon.core.scoring import closed_form
from refine_addon.core.selection import select
from refine_addon.core.splats import ARRAYS
from refine_addon.core.tiles import folder as folder_module
from refine_addon.core.tiles import storage, units, writing
from refine_addon.core.tiles.folder import Folder, Interrupted
from tests.strategies import plain_ply, ply_of
from tests.tiles import COUNT, ROOM, cut, joined, room_rows, told_by_plan, write

CLOSED = Settings(method="closed-form", views=8)


@pytest.fixture(autouse=True)
def by_plan(monkeypatch):
    """Have what is interrupted at a share be the same step, however busy the machine is."""
    told_by_plan(monkeypatch)


@pytest.fixture
def rows(monkeypatch):
    """Give rows of the room; a unit has 1000 of them."""
    monkeypatch.setattr(closed_form, "ROWS", 1000)
    monkeypatch.setattr(units, "ROWS", 1000)
    return room_rows()


@pytest.fixture(scope="module")
def views():
    """Give the room's cameras."""
    return read_cameras(ROOM / "cameras.json")


@pytest.fixture
def tiles(tmp_path, rows):
    """Write the rows as four files, and as one."""
    write(tmp_path / "whole.ply", rows)
    return cut(tmp_path, rows)


BUDGETS = [
    Budget(ratio=0.6),
    Budget(ratio=0.1),  # among the equal ones, which are those from the 253rd to the 653rd
    Budget(ratio=0.0),
    Budget(keep=1),
    Budget(max_mb=0.4),
    Budget(threshold=0.05),
    Budget(min_seen=30),
]


@pytest.mark.parametrize("budget", BUDGETS, ids=str)
def test_of_tiles_the_same_rows_stay_as_of_one_file(tmp_path, tiles, views, budget):
    """Every row to the byte, in the order of the files, whatever decides and wherever it is cut.

    For a size, the four headers take bytes that one does not: here the rows left are compared with
    those of as many in one file.
    """
    report = prune_tiles(tiles, tmp_path / "out", PruneRequest(views, budget, CLOSED))

    if budget.max_mb:
        assert 0 <= 400_000 - report["files"]["output_bytes"] < 2 * 248
        budget = Budget(keep=report["splats"]["kept"])
    whole = prune_file(
        tmp_path / "whole.ply", tmp_path / "pruned.ply", PruneRequest(views, budget, CLOSED)
    )
    assert joined(tmp_path / "out" / path.name for path in tiles) == joined(
        [tmp_path / "pruned.ply"]
    )
    del whole.report["splats"]["unseen_removed"]
    assert report["splats"] == whole.report["splats"]
    assert report["weights"] == whole.report["weights"]
    assert {path.name for path in (tmp_path / "out").iterdir()} == {path.name for path in tiles}


def test_splats_at_the_threshold_stay(tmp_path, tiles, views):
    """401 splats are equal: those below them go, and none of them."""
    splats = read_ply(tmp_path / "whole.ply").splats()
    values = score(splats, views, CLOSED).values
    threshold = float(values[900])

    report = prune_tiles(tiles, None, PruneRequest(views, Budget(threshold=threshold), CLOSED))

    assert np.count_nonzero(values == values[900]) == 401
    assert report["splats"]["removed"] == np.count_nonzero(values < values[900])


def test_a_report_says_what_stays_of_each_tile(tmp_path, tiles, views):
    """Counts and bytes add up to those of all, and bytes are those of the files."""
    report = prune_tiles(tiles, tmp_path / "out", PruneRequest(views, Budget(ratio=0.5), CLOSED))

    each = report["tiles"]
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


@pytest.mark.slow
def test_without_a_folder_the_sizes_are_told_and_nothing_is_written(tmp_path, tiles, views):
    """The same sizes as those of a run that writes."""
    before = sorted(tmp_path.rglob("*"))
    told = prune_tiles(tiles, None, PruneRequest(views, Budget(ratio=0.5), CLOSED))

    assert sorted(tmp_path.rglob("*")) == before
    written = prune_tiles(tiles, tmp_path / "out", PruneRequest(views, Budget(ratio=0.5), CLOSED))
    assert [tile["output_bytes"] for tile in told["tiles"]] == [
        tile["output_bytes"] for tile in written["tiles"]
    ]


@pytest.mark.parametrize("megabytes", [0.1, 0.35, 10.0])
def test_tiles_of_other_degrees_go_by_their_bytes(tmp_path, views, rows, megabytes):
    """As in memory, where rows have several lengths: the lowest go until the rest fits.

    The files have degree 3, 1 and 0; scores do not depend on the harmonics above the constant one.
    """
    names = rows.dtype.names
    paths, lengths = [], []
    for index, degree in enumerate((3, 1, 0)):
        file = tmp_path / f"{degree}.ply"
        file.write_bytes(plain_ply(400, degree))
        data = read_ply(file)
        some = data.rows.copy()
        for name in set(names) & set(some.dtype.names) - {"nx", "ny", "nz"}:
            if not name.startswith("f_rest"):
                some[name] = rows[name][index * 400 : index * 400 + 400]
        file.write_bytes(data.header + some.tobytes())
        paths.append(file)
        lengths.append(np.full(400, some.dtype.itemsize))
    write(tmp_path / "whole.ply", rows[:1200])
    scores = score(read_ply(tmp_path / "whole.ply").splats(), views, CLOSED)
    fixed = sum(read_ply(path).fixed_bytes for path in paths)
    keep = select(
        scores, Budget(max_mb=megabytes), row_bytes=np.concatenate(lengths), fixed_bytes=fixed
    )

    report = prune_tiles(
        paths, tmp_path / "out", PruneRequest(views, Budget(max_mb=megabytes), CLOSED)
    )

    for path, part in zip(paths, np.split(keep, 3), strict=True):
        expected = read_ply(path).rows[part]
        assert read_ply(tmp_path / "out" / path.name).rows.tobytes() == expected.tobytes()
    assert report["files"]["output_bytes"] <= megabytes * 1e6


def test_a_size_that_no_splat_fits_in_is_refused(tmp_path, tiles, views):
    """The headers alone are longer than 1 kB."""
    with pytest.raises(RefineError, match="too small for one splat of 248 bytes"):
        prune_tiles(tiles, tmp_path / "out", PruneRequest(views, Budget(max_mb=0.001), CLOSED))


# What is refused.


@pytest.mark.parametrize(
    ("settings", "budget", "words"),
    [
        (CLOSED, Budget(psnr=40.0), "closed-form estimates no PSNR"),
        (CLOSED, Budget(threshold=1e30), "would remove all 5000 splats"),
    ],
)
def test_what_does_not_work_over_tiles_is_refused_and_leaves_nothing(
    tmp_path, tiles, views, settings, budget, words
):
    """Before or after the work, the folder is as empty as it was."""
    with pytest.raises(RefineError, match=words):
        prune_tiles(tiles, tmp_path / "out", PruneRequest(views, budget, settings))

    assert not list((tmp_path / "out").glob("*"))


def damaged(path, tiles):
    """Return tiles, one of which is at fault, and what is said of it."""
    kind = path.name
    if kind == "missing":
        return [*tiles, path], "missing: cannot be read"
    if kind == "short.ply":
        path.write_bytes(tiles[0].read_bytes()[:-100])
        return [*tiles, path], "short.ply: truncated"
    if kind == "text.ply":
        header, _, _ = plain_ply(1).partition(b"end_header")
        header = header.replace(b"binary_little_endian", b"ascii") + b"end_header\n"
        path.write_bytes(header + b" ".join([b"0"] * header.count(b"property")) + b"\n")
        return [*tiles, path], "text.ply: is ascii 1.0, expected a plain binary PLY"
    (path.parent / "more").mkdir()
    again = path.parent / "more" / tiles[1].name
    again.write_bytes(tiles[1].read_bytes())
    return [*tiles, again], f"another tile is called {again.name} too"


@pytest.mark.parametrize("folder", ["out", None])
def test_a_tile_that_is_given_twice_is_refused(tmp_path, tiles, views, folder):
    """Also where nothing is written: its splats would count twice."""
    output = None if folder is None else tmp_path / folder
    with pytest.raises(RefineError, match=r"d\.ply: is given twice"):
        prune_tiles([*tiles, tiles[2]], output, PruneRequest(views, Budget(ratio=0.5), CLOSED))


@pytest.mark.parametrize("kind", ["missing", "short.ply", "text.ply", "same"])
def test_one_tile_at_fault_stops_all(tmp_path, tiles, views, kind):
    """It is named, and no tile is written."""
    given, words = damaged(tmp_path / kind, tiles)

    with pytest.raises(RefineError, match=words):
        prune_tiles(given, tmp_path / "out", PruneRequest(views, Budget(ratio=0.5), CLOSED))

    assert not list((tmp_path / "out").glob("*"))


def test_files_that_exist_stay_until_they_may_be_replaced(tmp_path, tiles, views):
    """One of four is there already: none is written; then all of them are."""
    there = tmp_path / "out" / tiles[3].name
    there.parent.mkdir()
    there.write_bytes(b"mine")

    with pytest.raises(RefineError, match="exists already"):
        prune_tiles(tiles, tmp_path / "out", PruneRequest(views, Budget(ratio=0.5), CLOSED))

    assert [*(tmp_path / "out").iterdir()] == [there]
    assert there.read_bytes() == b"mine"
    there.chmod(0o640)
    prune_tiles(
        tiles, tmp_path / "out", PruneRequest(views, Budget(ratio=0.5), CLOSED, overwrite=True)
    )
    assert len(list((tmp_path / "out").iterdir())) == 4
    assert there.stat().st_mode & 0o777 == 0o640


def test_tiles_are_not_replaced_while_they_are_read(tmp_path, tiles, views):
    """A run that goes on after a kill would prune again what was pruned already."""
    with pytest.raises(RefineError, match="is read until all tiles are written"):
        prune_tiles(tiles, tmp_path, PruneRequest(views, Budget(ratio=0.5), CLOSED, overwrite=True))


def test_a_tile_that_changes_meanwhile_stops_all(tmp_path, tiles, views):
    """Written again, of the same length: its rows may no longer be those that were scored."""

    def progress(fraction, _what):
        if fraction > 0.5:
            tiles[2].write_bytes(tiles[2].read_bytes())

    with pytest.raises(RefineError, match="was changed while it was worked on"):
        prune_tiles(
            tiles,
            tmp_path / "out",
            PruneRequest(views, Budget(ratio=0.5), CLOSED),
            progress=progress,
        )

    assert not list((tmp_path / "out").glob("*"))


@pytest.mark.parametrize("count", [0, 3], ids=["none", "three"])
def test_tiles_without_a_splat_are_refused(tmp_path, views, count):
    """There is nothing to rank, whatever the budget."""
    empty = cut(tmp_path, room_rows()[:0], (0,) * (count + 1))

    with pytest.raises(RefineError, match=f"none of {count} tiles has a splat"):
        prune_tiles(empty, tmp_path / "out", PruneRequest(views, Budget(max_mb=1.0), CLOSED))


@pytest.mark.parametrize("link", [Path.symlink_to, Path.hardlink_to], ids=["symbolic", "hard"])
def test_a_link_to_a_tile_is_that_tile_again(tmp_path, tiles, views, link):
    """Both names are told: the splats would count twice."""
    again = tmp_path / "again.ply"
    link(again, tiles[0])

    with pytest.raises(RefineError, match=r"again\.ply: is given twice, also as .*b\.ply"):
        prune_tiles(
            [*tiles, again], tmp_path / "out", PruneRequest(views, Budget(ratio=0.5), CLOSED)
        )


def test_a_failed_job_leaves_no_folder_that_it_made(tmp_path, tiles, views):
    """Neither the outputs' nor the one above it; one that was there stays."""
    (tmp_path / "there").mkdir()
    for folder in ("there", "new/deep"):
        with pytest.raises(RefineError, match="would remove all"):
            prune_tiles(
                tiles, tmp_path / folder, PruneRequest(views, Budget(threshold=1e30), CLOSED)
            )

    assert not list((tmp_path / "there").iterdir())
    assert not (tmp_path / "new").exists()


@pytest.mark.slow
@pytest.mark.usefixtures("rows")
def test_the_work_for_a_tile_does_not_grow_with_their_number(tmp_path, views):
    """With n, 2 n and 3 n tiles there are a + b n calls, which has no second difference.

    Calls are counted, of Python's functions and of others, while n = 30 tiles of two splats each
    are pruned. One call for each pair of tiles would make it 2 n^2 = 1800.
    """
    calls = [counted_calls(tmp_path, views, count) for count in (3, 30, 60, 90)]

    assert abs(calls[3] - 2 * calls[2] + calls[1]) < 900


def counted_calls(folder, views, count):
    """Return how many calls it takes to prune so many tiles."""
    rows, calls = room_rows(), [0]
    paths = [folder / f"{count}-{number}.ply" for number in range(count)]
    for number, path in enumerate(paths):
        write(path, rows[1400 + 2 * number : 1402 + 2 * number])
    settings = Settings(method="closed-form", views=1)

    def count_call(_frame, event, _argument):
        calls[0] += event in ("call", "c_call")

    sys.setprofile(count_call)
    try:
        request = PruneRequest(views, Budget(ratio=0.5), settings)
        prune_tiles(paths, folder / str(count), request, threads=1)
    finally:
        sys.setprofile(None)
    return calls[0]


def test_tiles_of_different_models_are_refused(tiles):
    """The message names both files and what each holds."""
    tagged = tiles[1]
    rest = tagged.read_bytes().removeprefix(b"ply\n")
    tagged.write_bytes(b"ply\ncomment SplatRenderMode: mip\n" + rest)

    with pytest.raises(RefineError) as caught:
        units.tiles_at(tiles)

    first = f"{tagged}: its splats are antialiased, those of {tiles[0]} default"
    assert str(caught.value) == f"{first}; expected one model in all tiles"
    assert {tile.model for tile in units.tiles_at(tiles[:1], "2dgs")} == {"2dgs"}


def test_a_slice_of_a_unit_is_that_of_its_tiles(tmp_path):
    """Any slice of a unit, across its parts, in the types and the degree of all of them.

    Three tiles of 5, 4 and 6 splats, of degrees 0, 1 and 0, the last of doubles.
    """
    for name, count, degree in (("a", 5, 0), ("b", 4, 1), ("c", 6, 0)):
        (tmp_path / f"{name}.ply").write_bytes(plain_ply(count, degree, seed=count))
    doubles = {name: (1 / 3 + column).astype(float) for name, column in columns(tmp_path / "c.ply")}
    (tmp_path / "c.ply").write_bytes(ply_of(doubles))
    a, b, c = (units.tile_at(tmp_path / f"{name}.ply") for name in "abc")
    unit = units.Unit(0, (units.Part(a, 1, 5), units.Part(b, 0, 4), units.Part(c, 0, 4)))
    whole = unit.splats()

    assert len(unit) == len(whole) == 12
    assert whole.means.dtype == np.float64
    assert whole.sh_rest.shape == (12, 3, 3)
    np.testing.assert_array_equal(whole.means[:4], read_ply(tmp_path / "a.ply").splats().means[1:])
    np.testing.assert_array_equal(whole.means[8:, 0], doubles["x"][:4])
    for start in range(13):
        for stop in range(start, 13):
            some = unit.take(slice(start, stop))
            for field in ARRAYS:
                expected = getattr(whole, field)[start:stop]
                found = getattr(some, field)
                assert found.dtype == expected.dtype
                np.testing.assert_array_equal(found, expected)


def columns(path):
    """Return the names and columns of a file."""
    rows = read_ply(path).rows
    return [(name, rows[name]) for name in rows.dtype.names]


# What is done after an interruption.


@pytest.mark.slow
@pytest.mark.parametrize("stop", [0.1, 0.5, 0.735, 0.755, 0.8, 0.9])
def test_a_job_that_was_interrupted_goes_on_where_it_was(tmp_path, tiles, views, monkeypatch, stop):
    """Units that were read are not read again, tiles that were written not written again.

    Stopped in the middle of every step, the second run ends with the same bytes as a run at once.
    """
    budget = Budget(ratio=0.5)
    prune_tiles(tiles, tmp_path / "once", PruneRequest(views, budget, CLOSED))
    done = []
    take, write_rows = units.Unit.take, writing.write_rows

    def taken(unit, piece):
        if not piece.stop:  # whoever reads a unit looks at its types first
            done.append(unit.index)
        return take(unit, piece)

    monkeypatch.setattr(units.Unit, "take", taken)
    monkeypatch.setattr(
        writing, "write_rows", lambda *rows: done.append(len(rows[1])) or write_rows(*rows)
    )

    def interrupt(fraction, _what):
        if fraction > stop:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        prune_tiles(
            tiles, tmp_path / "out", PruneRequest(views, budget, CLOSED), progress=interrupt
        )
    assert not list((tmp_path / "out").glob("*.ply"))
    prune_tiles(tiles, tmp_path / "out", PruneRequest(views, budget, CLOSED))

    for path in tiles:
        once, again = ((tmp_path / folder / path.name).read_bytes() for folder in ("once", "out"))
        assert once == again
    assert len(list((tmp_path / "out").iterdir())) == 4
    assert sorted(index for index in done if index < 5) == [0, 1, 2, 3, 4]
    # Rows that are copied: of each tile once, or once more of the tile under way.
    assert sum(index for index in done if index >= 5) <= COUNT + (1900 if stop > 0.79 else 0)


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
    budget, out = Budget(ratio=0.5), tmp_path / "out"
    with monkeypatch.context() as patched:
        renaming_stops(patched, tiles[1].name, error)
        with pytest.raises(raised):
            prune_tiles(tiles, out, PruneRequest(views, budget, CLOSED))
    assert [path.name for path in out.glob("*.ply")] == [tiles[0].name]

    monkeypatch.setattr(writing, "rows_of", None)  # nothing is written again
    report = prune_tiles(tiles, out, PruneRequest(views, budget, CLOSED))

    assert {path.name for path in out.iterdir()} == {path.name for path in tiles}
    assert sum(len(read_ply(out / path.name)) for path in tiles) == COUNT // 2
    for tile in report["tiles"]:
        assert tile["output_bytes"] == Path(tile["output"]).stat().st_size


def test_ctrl_c_after_the_last_tile_was_renamed_comes_too_late(tmp_path, tiles, views, monkeypatch):
    """The folder of the job goes all the same: nothing is left that would go on."""
    rmtree, calls = shutil.rmtree, []

    def stop_at_first(path, **options):
        calls.append(path)
        if len(calls) == 1:
            rmtree(path / "done", **options)
            raise KeyboardInterrupt
        rmtree(path, **options)

    monkeypatch.setattr(shutil, "rmtree", stop_at_first)

    report = prune_tiles(tiles, tmp_path / "out", PruneRequest(views, Budget(ratio=0.5), CLOSED))

    assert report["splats"]["written"] == COUNT // 2
    assert {path.name for path in (tmp_path / "out").iterdir()} == {path.name for path in tiles}


def test_a_file_in_the_place_of_a_renamed_tile_is_not_replaced(tmp_path, tiles, views, monkeypatch):
    """Between two runs another program wrote it: it is refused, and with `overwrite` replaced."""
    budget, out = Budget(ratio=0.5), tmp_path / "out"
    with monkeypatch.context() as patched:
        renaming_stops(patched, tiles[1].name, KeyboardInterrupt())
        with pytest.raises(KeyboardInterrupt):
            prune_tiles(tiles, out, PruneRequest(views, budget, CLOSED))
    (out / tiles[0].name).write_bytes(b"mine")

    with pytest.raises(RefineError, match="exists already"):
        prune_tiles(tiles, out, PruneRequest(views, budget, CLOSED))
    assert (out / tiles[0].name).read_bytes() == b"mine"
    prune_tiles(tiles, out, PruneRequest(views, budget, CLOSED, overwrite=True))

    assert sum(len(read_ply(out / path.name)) for path in tiles) == COUNT // 2


@pytest.mark.parametrize(
    ("overwrite", "words"), [(False, "exists already"), (True, "is a folder, expected a file")]
)
def test_what_appears_in_the_place_of_a_tile_meanwhile_stops_before_the_first(
    tmp_path, tiles, views, monkeypatch, overwrite, words
):
    """A file, or a folder that nothing can replace: no tile is renamed, and none is lost."""
    budget, out = Budget(ratio=0.5), tmp_path / "out"
    there = out / tiles[3].name

    def progress(fraction, _what):
        if fraction > 0.9 and not there.exists():
            (Path.mkdir if overwrite else Path.touch)(there)

    options = {"overwrite": overwrite}
    with pytest.raises(Interrupted, match=f"{words}.*; the same command goes on"):
        prune_tiles(tiles, out, PruneRequest(views, budget, CLOSED, **options), progress=progress)
    assert [*out.glob("*.ply")] == [there]
    (Path.rmdir if overwrite else Path.unlink)(there)
    monkeypatch.setattr(writing, "rows_of", None)  # nothing is written again
    prune_tiles(tiles, out, PruneRequest(views, budget, CLOSED, **options))

    assert {path.name for path in out.iterdir()} == {path.name for path in tiles}


@pytest.mark.slow
@pytest.mark.parametrize("calls", [1, 30, 60, 77], ids=["begin", "scores", "selected", "tiles"])
def test_on_a_full_disk_what_is_done_stays(tmp_path, tiles, views, monkeypatch, calls):
    """Wherever it fills up, the file is named, and the same call goes on once there is room."""
    budget, done = Budget(ratio=0.5), []
    prune_tiles(tiles, tmp_path / "once", PruneRequest(views, budget, CLOSED))
    open_file = Folder.writing

    @contextlib.contextmanager
    def filling(folder, path):
        done.append(path)
        with open_file(folder, path) as stream:
            yield stream
            if len(done) >= calls:
                raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    with monkeypatch.context() as patched:
        patched.setattr(Folder, "writing", filling)
        with pytest.raises(Interrupted) as stopped:
            prune_tiles(tiles, tmp_path / "out", PruneRequest(views, budget, CLOSED))
    words = f"{done[-1]}: no space left on the disk; the same command goes on where this one was"
    assert str(stopped.value) == words
    assert len(done) == calls
    assert not done[-1].exists()

    prune_tiles(tiles, tmp_path / "out", PruneRequest(views, budget, CLOSED))
    assert joined(tmp_path / "out" / path.name for path in tiles) == joined(
        tmp_path / "once" / path.name for path in tiles
    )


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="only Linux has a disk that is full")
def test_an_array_on_a_full_disk_says_so():
    """NumPy would say how many of its numbers were written, not why, and name no file."""
    with (
        Path("/dev/full").open("wb", buffering=0) as full,
        pytest.raises(OSError, match=os.strerror(errno.ENOSPC)),
    ):
        folder_module._write(full, np.zeros(100_000))


def interrupted_at(fraction):
    """Return a progress callback that stops there."""

    def progress(done, _what):
        if done > fraction:
            raise KeyboardInterrupt

    return progress


@pytest.mark.slow
@pytest.mark.parametrize("name", ["means.npy", "plain.npy", "values.npy"])
def test_an_array_that_a_power_cut_truncated_is_made_again(tmp_path, tiles, views, name):
    """It is named, what was not damaged stays, and the next run ends with the same bytes."""
    budget, out = Budget(ratio=0.5), tmp_path / "out"
    prune_tiles(tiles, tmp_path / "once", PruneRequest(views, budget, CLOSED))
    stop = {"means.npy": 0.4, "plain.npy": 0.74, "values.npy": 0.79}[name]
    with pytest.raises(KeyboardInterrupt):
        prune_tiles(tiles, out, PruneRequest(views, budget, CLOSED), progress=interrupted_at(stop))
    damaged = next(path for path in sorted(out.rglob(name)) if path.stat().st_size > 300)
    os.truncate(damaged, 300)

    with pytest.raises(Interrupted, match=f"{name}: is damaged; the same command goes on"):
        prune_tiles(tiles, out, PruneRequest(views, budget, CLOSED))
    prune_tiles(tiles, out, PruneRequest(views, budget, CLOSED))

    assert joined(out / path.name for path in tiles) == joined(
        tmp_path / "once" / path.name for path in tiles
    )


def test_a_disk_that_cannot_be_read_is_an_interruption(tmp_path):
    """A file of the job is a folder here, which is as good as a bad sector: it is named."""
    folder = Folder(tmp_path).inner("job")
    (folder.path / "arrays/000001/means.npy").mkdir(parents=True)

    with pytest.raises(Interrupted, match=r"means\.npy: cannot be read \("):
        folder.load(1, ["means"])


def test_a_note_that_a_power_cut_truncated_counts_as_none(tmp_path):
    """Of one array or of several, whatever is left of it; what was whole is read as before."""
    folder = Folder(tmp_path / "job")
    with folder.opened():
        for name, result in (("one", np.arange(3)), ("two", (np.eye(2), 0.1)), ("none", None)):
            folder.note(name, result)
            path = next((folder.path / "done").glob(f"{name}*"))
            whole = path.read_bytes()
            for size in (0, 100, len(whole) - 1):
                path.write_bytes(whole[:size])
                assert folder.noted(name) == (False, None)


@pytest.mark.parametrize(
    "asked",
    [
        {"zones": (Zone("remove", "a box", Box((0.0, 0.0, 0.0), (1.0, 1.0, 1.0))),)},
        {"cleaning": Cleaning()},
        {"pictures": PictureFiles(Path("shown"), "a")},
    ],
    ids=["volumes", "cleaning", "pictures"],
)
def test_what_needs_all_splats_in_memory_is_refused(tmp_path, tiles, views, asked):
    """Before anything is read or made; it would be left out in silence otherwise."""
    with pytest.raises(RefineError, match="need all splats in memory"):
        prune_tiles(tiles, tmp_path / "out", PruneRequest(views, Budget(ratio=0.5), **asked))

    assert not (tmp_path / "out").exists()


def test_a_tile_with_the_longest_name_is_pruned(tmp_path, tiles, views):
    """255 bytes: what is noted of a tile does not have its name."""
    long = tmp_path / f"{'x' * 251}.ply"
    tiles[0].rename(long)

    prune_tiles(
        [long, *tiles[1:]], tmp_path / "out", PruneRequest(views, Budget(ratio=0.5), CLOSED)
    )

    assert (tmp_path / "out" / long.name).exists()


def test_where_an_open_file_cannot_be_removed_the_folder_goes_all_the_same(tmp_path, monkeypatch):
    """As on Windows: the lock is closed before the folder goes."""
    rmtree, opened = shutil.rmtree, []
    open_file = Path.open

    def noting(path, *mode, **options):
        stream = open_file(path, *mode, **options)
        opened.append(stream)
        return stream

    def remove(path, **options):
        if all(stream.closed for stream in opened):
            rmtree(path, **options)
        else:
            for inner in ("done", "arrays", "tiles"):
                rmtree(path / inner)

    monkeypatch.setattr(Path, "open", noting)
    monkeypatch.setattr(shutil, "rmtree", remove)
    folder = Folder(tmp_path / "job")
    with folder.opened():
        folder.remove()

    assert not folder.path.exists()


@pytest.mark.slow
def test_another_job_does_not_take_over_what_is_left(tmp_path, tiles, views):
    """Of another budget, the folder has another name."""

    def interrupt(fraction, _what):
        if fraction > 0.9:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        prune_tiles(
            tiles,
            tmp_path / "out",
            PruneRequest(views, Budget(ratio=0.5), CLOSED),
            progress=interrupt,
        )
    report = prune_tiles(tiles, tmp_path / "out", PruneRequest(views, Budget(ratio=0.25), CLOSED))

    assert report["splats"]["removed"] == COUNT // 4


def test_two_runs_do_not_work_in_one_folder(tmp_path):
    """The second is told so."""
    folder = Folder(tmp_path / "job")
    with folder.opened(), pytest.raises(RefineError, match="another run"), folder.opened():
        pass


def test_what_is_noted_is_read_back(tmp_path):
    """Nothing, one array, several; what was not noted is told from nothing."""
    folder = Folder(tmp_path / "job")
    with folder.opened():
        folder.note("none", None)
        folder.note("one", np.arange(3))
        folder.note("two", (np.eye(2), 0.1))

    assert folder.noted("none") == (True, None)
    assert folder.noted("one")[1].tolist() == [0, 1, 2]
    assert [each.tolist() for each in folder.noted("two")[1]] == [[[1, 0], [0, 1]], 0.1]
    assert folder.noted("three") == (False, None)


def test_tiles_that_would_be_one_file_by_links_are_refused(tmp_path, tiles, views):
    """One of them would be lost: also where the file is not there yet."""
    out = tmp_path / "out"
    out.mkdir()
    for tile in tiles[:2]:
        (out / tile.name).symlink_to("real.ply")

    with pytest.raises(RefineError, match=r"is the same file as .*, by a link"):
        prune_tiles(tiles, out, PruneRequest(views, Budget(ratio=0.5), CLOSED))
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
        prune_tiles(tiles, out, PruneRequest(views, Budget(ratio=0.5), CLOSED))


@pytest.mark.slow
def test_over_tiles_survivors_stay_unchanged_by_default_and_a_note_says_so(tiles, views):
    """As by name, where a file would absorb; where it would not, nobody is told."""
    settings = Settings(views=4)
    default, named = (
        prune_tiles(tiles, None, PruneRequest(views, Budget(ratio=0.5), settings, survivors=way))
        for way in ("auto", "unchanged")
    )
    scored = prune_tiles(tiles, None, PruneRequest(views, Budget(ratio=0.5), CLOSED))

    words = "survivors stay unchanged: over tiles"
    assert [note for note in default["notes"] if note not in named["notes"]] == [
        note for note in default["notes"] if words in note
    ]
    assert any(words in note for note in default["notes"])
    assert default["survivors"]["asked"] == scored["survivors"]["asked"] == "auto"
    assert default["survivors"]["psnr"] == named["survivors"]["psnr"]
    assert not any(words in note for note in scored["notes"])
