"""Pruning many files as one scene, by one ranking and one budget over all of them."""

from __future__ import annotations

import contextlib
import hashlib
import shutil
import tempfile
from collections.abc import Iterator, Sequence
from dataclasses import fields
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from ...version import VERSION
from ..errors import RefineError
from ..execute import Cancelled, Progress, seconds, silent, stages, within
from ..mapped import Interrupted, note, noted, on_disk, once, pieces, write
from ..methods import DEFAULT, Method
from ..prune import prune
from ..report import Clock
from ..scoring.occlusion import expected_views
from ..selection import Budget
from ..splats import Model
from ..views import ViewSet
from ..whole_file import Url, explained
from .cluster import Cluster
from .files import Kept, Outputs, copied, header_of, tiles_at, waiting_in
from .storage import identity, located, new_folder


def prune_tiles(
    sources: Sequence[Path | str],
    folder: Path | str | None,
    views: ViewSet,
    budget: Budget,
    method: Method = DEFAULT,
    *,
    model: Model | None = None,
    overwrite: bool = False,
    dry_run: bool = False,
    progress: Progress = silent,
    threads: int | None = None,
    workers: Cluster | None = None,
) -> dict[str, Any]:
    """Prune files of splats as one scene, by one budget over all of them; none is held in memory.

    The same splats are kept as of one file with all rows in the given order. Either all files are
    written or none. Until the end the folder of the job lies beside the outputs, and after an
    interruption the same call goes on where it was.

    Parameters
    ----------
    sources : sequence of path-like, plain binary PLY files in one frame, or URLs that fsspec opens
    folder : path-like, a URL, or None, which writes nothing
        For the outputs, each under its own name. For a URL, the job's folder is in the current
        directory.
    views, budget, method, model, overwrite, dry_run, progress, threads : see `prune_file`
    workers : Cluster, optional, runs the large steps; by default this machine

    Returns
    -------
    dict : the report, see docs/report.md, with ``tiles``: name, counts and bytes of each

    Raises
    ------
    RefineError, Cancelled : see `prune`; also if two files have one name; the job's folder goes
    Interrupted : if a disk, a storage or all workers fail, or a file takes an output's place

    Notes
    -----
    Memory: about 150 bytes a splat, and the hits of scoring rays; in a worker 160 for each splat
    that a view shows. Disk: the tiles, and 60 bytes a splat.
    """
    clock, tiles = Clock(), tiles_at(sources, model)
    output = None if folder is None or dry_run else located(folder)
    with contextlib.ExitStack() as held:
        outputs = None
        if output is None:
            job = Path(held.enter_context(tempfile.TemporaryDirectory(prefix="refine-"))) / "job"
        else:
            near = Path.cwd() if isinstance(output, Url) else output.absolute()
            job = near / f".refine-{_digest(output, tiles, views, budget, method)}"
            held.enter_context(new_folder(output))
            outputs = Outputs(job, tiles, output, overwrite)
        held.enter_context(_opened(job, outputs))
        held.enter_context(within(cluster=workers, cores=threads))
        if workers is not None:
            goes_on, _ = noted(job, "begun")
            note(job, "begun", None)
            workers.check(job, tiles, Interrupted if goes_on else RefineError)
        count, size = sum(tile.splats for tile in tiles), sum(tile.size for tile in tiles)
        used = method.used(views)
        scoring = seconds("measure", count, expected_views(len(used), method.between(used)))
        reading, deciding, writing = stages(
            progress, seconds("read", count), scoring, seconds("write", count)
        )
        decided = partial(_decided, job, tiles, views, budget, method, clock, reading, deciding)
        kept, counts, report = once(job, "kept", decided)
        if outputs is None:
            sizes = [
                tile.size - tile.header + len(header_of(tile, count))
                - (tile.splats - count) * tile.dtype.itemsize
                for tile, (count, _) in zip(tiles, counts, strict=True)
            ]  # fmt: skip
        else:
            sizes = outputs.write(kept, writing)
        clock.lap("write_s")
    report["files"] = {
        "input": f"{len(tiles)} tiles", "output": None if outputs is None else str(output),
        "input_bytes": size, "output_bytes": sum(sizes),
    }  # fmt: skip
    report["splats"] |= {"written": report["splats"]["kept"] if outputs else None, "left_out": 0}
    names = ("input", "output", "before", "kept", "unseen", "input_bytes", "output_bytes")
    targets = [str(each) for each in outputs.targets] if outputs else [None] * len(tiles)
    report["tiles"] = [
        dict(zip(names, (str(t.path), to, t.splats, kept, unseen, t.size, after), strict=True))
        for t, to, (kept, unseen), after in zip(tiles, targets, counts, sizes, strict=True)
    ]
    report["timings"] = clock.stop()
    return report


def _decided(job, tiles, views, budget, method, clock, reading, deciding):
    """Kept splats, numbers of kept and unseen splats of each tile, and the report."""
    splats = once(job, "splats", lambda: copied(tiles, job / "splats", reading))
    clock.lap("read_s")
    row_bytes = max(tile.dtype.itemsize for tile in tiles)
    result = prune(
        splats, views, budget, method,
        sizes=(row_bytes, sum(tile.size - tile.end + tile.begin for tile in tiles)),
        clock=clock, progress=deciding,
    )  # fmt: skip
    assert result.scores is not None
    begins = np.cumsum([tile.splats for tile in tiles])[:-1]
    masks = result.keep, result.scores.seen == 0
    counts = [[int(part.sum()) for part in np.split(mask, begins)] for mask in masks]
    result.report["splats"].pop("unseen_removed", None)
    rows, became = np.empty(0, np.int64), None
    if result.merged is not None:
        changed = np.flatnonzero(result.merged.changed)
        rows, merged = np.flatnonzero(result.keep)[changed], result.merged.splats
        became = on_disk(job / "became", pieces(merged, changed)) if len(changed) else None
    kept = Kept(**write(job / "keep", [{"keep": result.keep, "changed": rows}]), became=became)
    return kept, [*zip(*counts, strict=True)], result.report


@contextlib.contextmanager
def _opened(job: Path, outputs: Outputs | None) -> Iterator[None]:
    """Make and lock the folder of a job within the block; it stays if the job can go on."""
    if job.is_symlink():
        raise RefineError(f"{job}: is a link, expected a folder of an earlier run; remove the link")
    with explained(job, "cannot be made"):
        waiting_in(job).mkdir(parents=True, exist_ok=True)
        lock = (job / "lock").open("wb")
    stays = True
    try:
        with lock:
            _lock(job, lock)
            for left in (*job.glob("gaussians-*"), *job.glob("*.tmp")):
                shutil.rmtree(left, ignore_errors=True)  # of a run that was killed
            try:
                yield
                stays = False
            except Interrupted as error:
                if outputs is None:
                    raise
                advice = "the same command goes on where this one was"
                raise Interrupted(f"{error}; {advice}") from error
            except (RefineError, Cancelled):
                stays = False
                if outputs:
                    outputs.discard()
                raise
    finally:
        if not stays:  # after the lock is closed: Windows removes no open file
            for _ in range(2):  # Ctrl-C may come meanwhile
                with contextlib.suppress(KeyboardInterrupt):
                    shutil.rmtree(job, ignore_errors=True)


def _lock(job: Path, lock: Any) -> None:
    try:
        import fcntl

        fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError as error:
        raise RefineError(f"{job}: another run is at work on the same job") from error
    except (ImportError, OSError):
        pass  # Windows and some file systems have no such locks


def _digest(output, tiles, views, budget, method):
    """Name of a job: equal for the same job, and for no other."""
    digest = hashlib.blake2b(digest_size=8)
    for argument in (VERSION, identity(output), [*tiles], budget, method):
        digest.update(repr(argument).encode("utf-8", "surrogateescape"))
    for view in views.spread(method.views):
        values = [np.asarray(getattr(view, field.name)).tolist() for field in fields(view)]
        digest.update(repr(values).encode())
    return digest.hexdigest()
