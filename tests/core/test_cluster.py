"""Tiles pruned by the workers of a Dask cluster, in processes of their own that may be killed."""

from __future__ import annotations

import os
import signal
import sys
from pathlib import Path

import numpy as np
import pytest

from refine_addon.command import main
from refine_addon.core import Budget, RefineError, Settings, prune_tiles, read_cameras, read_ply
from refine_addon.core.formats.ply_header import with_count
from refine_addon.core.tiles import absorbing, cluster, units
from refine_addon.core.tiles.folder import Folder
from refine_addon.core.tiles.steps import Job

ROOM = Path(__file__).parents[2] / "tests/data/room_small"
CLOSED = Settings(method="closed-form", views=8)
BUDGET = Budget(ratio=0.6)


def needs_dask(test):
    """Mark a test that starts workers: slow, and Dask's warnings are its own business."""
    return pytest.mark.slow(pytest.mark.filterwarnings("default")(test))


@pytest.fixture(scope="module")
def workers():
    """Start two workers."""
    pytest.importorskip("distributed")
    with cluster.cluster(2) as workers:
        yield workers


@pytest.fixture
def tiles(tmp_path, monkeypatch):
    """Write 5000 rows of the room as two tiles; a unit has 250, so two go in a group."""
    monkeypatch.setattr(units, "ROWS", 250)
    file = read_ply(ROOM / "point_cloud.ply")
    paths = [tmp_path / "a.ply", tmp_path / "b.ply"]
    for path, rows in zip(paths, np.split(file.rows[:5000], [2300]), strict=True):
        path.write_bytes(with_count(file.header, len(rows)) + rows.tobytes())
    return paths


def prune(tiles, folder, settings=CLOSED, **options):
    """Prune the tiles into a folder, and return the bytes of the files."""
    prune_tiles(tiles, folder, read_cameras(ROOM / "cameras.json"), BUDGET, settings, **options)
    return [(folder / path.name).read_bytes() for path in tiles]


@needs_dask
@pytest.mark.parametrize("moment", [0.05, 0.5, 0.9], ids=["reading", "scoring", "writing"])
def test_a_killed_worker_changes_no_byte(tmp_path, tiles, workers, moment):
    """Whatever it was at, others do it again; the files are those of a run without workers."""
    killed = []

    def progress(fraction, _what):
        if fraction >= moment and not killed:
            killed.append(next(iter(workers._client.run(os.getpid).values())))
            os.kill(killed[0], signal.SIGKILL)

    found = prune(tiles, tmp_path / "out", workers=workers, progress=progress)

    assert killed
    assert found == prune(tiles, tmp_path / "here")
    assert len(list((tmp_path / "out").iterdir())) == len(tiles)


@needs_dask
@pytest.mark.parametrize("moment", [0.2, 0.5, 0.7], ids=["measuring", "absorbing", "again"])
def test_a_worker_killed_while_absorbing_changes_no_byte(
    tmp_path, tiles, workers, monkeypatch, moment
):
    """Blocks of views and regions are done again by others, as runs of rows are."""
    monkeypatch.setattr(absorbing, "REGION", 1500)
    killed = []

    def progress(fraction, _what):
        if fraction >= moment and not killed:
            killed.append(next(iter(workers._client.run(os.getpid).values())))
            os.kill(killed[0], signal.SIGKILL)

    settings = Settings(method="occlusion", views=8)
    found = prune(
        tiles, tmp_path / "out", settings, absorb=True, workers=workers, progress=progress
    )

    assert killed
    assert found == prune(tiles, tmp_path / "here", settings, absorb=True)
    assert len(list((tmp_path / "out").iterdir())) == len(tiles)


@needs_dask
def test_what_workers_began_one_process_ends(tmp_path, tiles, workers):
    """The folder of the job does not tell who worked on it."""

    def interrupt(fraction, _what):
        if fraction > 0.5:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        prune(tiles, tmp_path / "out", workers=workers, progress=interrupt)

    assert prune(tiles, tmp_path / "out") == prune(tiles, tmp_path / "here")


@needs_dask
def test_workers_that_do_not_see_the_files_are_named(tmp_path, tiles, workers, monkeypatch):
    """The folder of the job, a tile, or refine itself is another one there."""
    views = read_cameras(ROOM / "cameras.json")
    job = Job(Folder(tmp_path / "elsewhere"), views, CLOSED.closed_form, views.middle())
    with pytest.raises(RefineError, match=r"worker tcp://.*elsewhere is not there; workers need"):
        workers.check(job, [])
    tile = units.tile_at(tiles[0])
    tiles[0].unlink()
    with job.folder.opened():
        job.folder.note("begun", None)
        with pytest.raises(RefineError, match=r"worker tcp://.*a\.ply is not there, or another"):
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
        cluster.cluster(scheduler="tcp://127.0.0.1:1"),
    ):
        pass


def test_without_dask_the_extra_is_named(tmp_path, tiles, capsys, monkeypatch):
    """Nothing else needs it, so it is asked for only here; exit code 1."""
    monkeypatch.setitem(sys.modules, "distributed", None)
    options = ["--together", "--method", "closed-form", "--workers", "2"]
    options += ["--cameras", str(ROOM / "cameras.json"), "--output-dir", str(tmp_path / "out")]

    assert main(["prune", *map(str, tiles), *options]) == 1
    assert "pip install 'refine-addon[distributed]'" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (["--workers", "2"], "--workers and --scheduler go with --together"),
        (["--together", "--method", "closed-form", "--workers", "0"], "expected 1 or more"),
        (
            ["--together", "--method", "closed-form", "--workers", "1", "--scheduler", "x"],
            "--workers or --scheduler, and not both",
        ),
    ],
)
def test_workers_that_cannot_be_are_wrong_usage(tiles, capsys, options, words):
    """Exit code 2."""
    options += ["--cameras", str(ROOM / "cameras.json"), "--output-dir", "out"]

    assert main(["prune", *map(str, tiles), *options]) == 2
    assert words in capsys.readouterr().err
