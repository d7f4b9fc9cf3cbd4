"""Tiles pruned by the workers of a Dask cluster, in processes of their own that may be killed."""

from __future__ import annotations

import contextlib
import os
import signal
import sys
import threading
import time
from pathlib import Path
from types import SimpleNamespace
from typing import ClassVar

import numpy as np
import pytest

from refine_addon.command import main
from refine_addon.core import (
    Budget,
    PruneRequest,
    RefineError,
    Settings,
    prune_tiles,
    read_cameras,
    read_ply,
)
from refine_addon.core.execute import silent
from refine_addon.core.formats.ply_header import with_count
from refine_addon.core.tiles import absorbing, cluster, units
from refine_addon.core.tiles.folder import Folder, Interrupted
from refine_addon.core.tiles.workers import Batch
from tests.tiles import told_by_plan

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
    told_by_plan(monkeypatch)
    file = read_ply(ROOM / "point_cloud.ply")
    paths = [tmp_path / "a.ply", tmp_path / "b.ply"]
    for path, rows in zip(paths, np.split(file.rows[:5000], [2300]), strict=True):
        path.write_bytes(with_count(file.header, len(rows)) + rows.tobytes())
    return paths


def prune(tiles, folder, settings=CLOSED, *, survivors="unchanged", **options):
    """Prune the tiles into a folder, and return the bytes of the files."""
    views = read_cameras(ROOM / "cameras.json")
    prune_tiles(
        tiles, folder, PruneRequest(views, BUDGET, settings, survivors=survivors), **options
    )
    return [(folder / path.name).read_bytes() for path in tiles]


@needs_dask
@pytest.mark.parametrize("moment", [0.05, 0.5, 0.85], ids=["reading", "scoring", "writing"])
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
@pytest.mark.parametrize(
    ("survivors", "moment"),
    [("absorb", 0.1), ("absorb", 0.5), ("absorb", 0.66), ("refit", 0.6)],
    ids=["measuring", "absorbing", "again", "refitting"],
)
def test_a_worker_killed_while_survivors_change_changes_no_byte(
    tmp_path, tiles, workers, monkeypatch, survivors, moment
):
    """Blocks of views and regions are done again by others, as runs of rows are."""
    monkeypatch.setattr(absorbing, "REGION", 1500)
    killed = []

    def progress(fraction, _what):
        if fraction >= moment and not killed:
            killed.append(next(iter(workers._client.run(os.getpid).values())))
            os.kill(killed[0], signal.SIGKILL)

    settings = Settings(method="occlusion", views=4 if survivors == "refit" else 8)
    found = prune(
        tiles, tmp_path / "out", settings, survivors=survivors, workers=workers, progress=progress
    )

    assert killed
    assert found == prune(tiles, tmp_path / "here", settings, survivors=survivors)
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
@pytest.mark.parametrize("moment", [0.5, 0.85], ids=["scoring", "writing"])
def test_workers_read_and_write_behind_urls(tmp_path, tiles, workers, monkeypatch, moment):
    """A killed worker changes no byte of them, and leaves nothing there or here."""
    monkeypatch.chdir(tmp_path)
    killed = []

    def progress(fraction, _what):
        if fraction >= moment and not killed:
            killed.append(next(iter(workers._client.run(os.getpid).values())))
            os.kill(killed[0], signal.SIGKILL)

    urls = [f"file://{path}" for path in tiles]
    views = read_cameras(ROOM / "cameras.json")
    prune_tiles(
        urls,
        f"file://{tmp_path}/out",
        PruneRequest(views, BUDGET, CLOSED),
        workers=workers,
        progress=progress,
    )

    assert killed
    found = {path.name: path.read_bytes() for path in (tmp_path / "out").iterdir()}
    names = [path.name for path in tiles]
    assert found == dict(zip(names, prune(tiles, tmp_path / "here"), strict=True))
    assert not list(tmp_path.glob(".refine*"))


@needs_dask
def test_workers_that_do_not_see_the_files_are_named(tmp_path, tiles, workers, monkeypatch):
    """The folder of the job, a tile, or refine itself is another one there."""
    folder = Folder(tmp_path / "elsewhere")
    with pytest.raises(RefineError, match=r"worker tcp://.*elsewhere is not there; workers need"):
        workers.check(folder, [])
    tile = units.tile_at(tiles[0])
    tiles[0].unlink()
    with folder.opened():
        folder.note("begun", None)
        with pytest.raises(RefineError, match=r"worker tcp://.*a\.ply is not there, or another"):
            workers.check(folder, [tile])
    monkeypatch.setattr(cluster, "VERSION", "0.0.0")
    with pytest.raises(RefineError, match=r"worker tcp://.*it has refine .*, this is 0\.0\.0"):
        workers.check(folder, [])


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
        check(Folder(tmp_path), [])

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
        next(cluster.Cluster(client).run(Batch(None, [0], silent, "")))

    assert not left
    assert time.monotonic() - began > 0.5


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
