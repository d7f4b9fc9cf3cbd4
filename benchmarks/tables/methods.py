"""Everything that the trade measures, under one name each: from splats and views to fewer splats.

A method either scores, once for all budgets, or reduces to one budget at a time. What the core
offers is asked of its `METHODS`, so that a method that is added there is measured here.
"""

from __future__ import annotations

import tempfile
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from refine_addon import core
from refine_addon.core import METHODS
from refine_addon.core.formats.ply import read_ply
from refine_addon.core.scores import Scores
from refine_addon.core.selection import Budget
from refine_addon.core.splats import ARRAYS, Splats
from refine_addon.core.views import ViewSet

from ..baselines import merging, rap, splat_transform
from ..baselines.refine import refine
from ..baselines.rendered import BASELINES, RENDERED, ROUNDS, removed_in_rounds
from ..renderer.rasterizer import Statistics

OURS, LITERATURE, EXTERNAL = "ours", "literature", "external"


@dataclass(frozen=True, eq=False)
class Task:
    """What every method gets.

    - file: The splats as a file, for other programs.
    """

    splats: Splats
    views: ViewSet
    file: Path


@dataclass(frozen=True, eq=False)
class Method:
    """One way to get rid of splats; exactly one of the three functions is set.

    - score: ``(task, statistics) -> Scores``.
    - reduce: ``(task, keep_count, ratio) -> Splats``.
    - run: ``(task, keep_count) -> (Splats, Run)``: another program, which is timed by itself.
    - rendered: Whether `score` needs the statistics of rendered views, whose time counts as its
      own.
    """

    name: str
    group: str
    about: str
    score: Callable[[Task, Statistics | None], Scores] | None = None
    reduce: Callable[[Task, int, float], Splats] | None = None
    run: Callable[[Task, int], tuple[Splats, splat_transform.Run]] | None = None
    rendered: bool = False


def everything() -> list[Method]:
    """Return all methods that can be measured here, in the order of the tables."""
    return [*_baselines(), *_merging(), *_external(), *_published(), *_core()]


ABOUT = {
    "random": "uniformly at random",
    "opacity": "lowest opacity first",
    "lightgaussian": "sum of opacity T over pixels x (V / V90)^0.1",
    "mesongs": "sum of alpha T over pixels x (V / V90)^0.1",
    "radsplat": "largest alpha T of any pixel",
    "pup-3dgs": "log det of the Fisher matrix of mean and scale, by rendered gradients",
    "removal-error": "squared error of the pictures without this one splat",
}


def _baselines() -> list[Method]:
    """Return the scores of the literature."""
    methods = []
    for name, function in BASELINES.items():

        def score(task: Task, statistics: Statistics | None, function: Any = function) -> Scores:
            return as_scores(function(task.splats, task.views, statistics), len(task.views))

        about = ABOUT.get(name, name)
        methods.append(Method(name, LITERATURE, about, score=score, rendered=name in RENDERED))
        if name == "removal-error":
            about = f"the same in {ROUNDS} rounds, rendered anew before each, as POTR"
            methods.append(
                Method("removal-error-iterated", LITERATURE, about, reduce=_removed_in_rounds)
            )
    return methods


def _removed_in_rounds(task: Task, keep_count: int, ratio: float) -> Splats:
    del ratio
    return task.splats.take(removed_in_rounds(task.splats, task.views, keep_count))


def rap_network(weights: Path) -> Method:
    """Return RAP, whose trained network the project does not have."""

    def score(task: Task, statistics: Statistics | None) -> Scores:
        del statistics
        return as_scores(rap.score(task.splats, weights), len(task.views))

    return Method("rap", LITERATURE, "a trained network, which sees no cameras", score=score)


def _merging() -> list[Method]:
    """Return GHAP's mixture reduction in both dresses."""
    about = {
        "nearest": "GHAP's clusters by blocks; of each the splat nearest its centre stays",
        "moments": "GHAP's clusters by blocks; each becomes one splat by matching moments",
    }
    methods = []
    for dress, text in about.items():

        def reduce(task: Task, keep_count: int, ratio: float, dress: Any = dress) -> Splats:
            del ratio
            return merging.reduce(task.splats, keep_count, dress)

        methods.append(Method(f"ghap-{dress}", LITERATURE, text, reduce=reduce))
    return methods


def _external() -> list[Method]:
    """Return splat-transform's two decimations, where it is installed."""
    if splat_transform.find() is None:
        return []
    methods = []
    for flag in splat_transform.FLAGS:

        def run(
            task: Task, keep_count: int, flag: str = flag
        ) -> tuple[Splats, splat_transform.Run]:
            with tempfile.TemporaryDirectory() as folder:
                target = Path(folder) / "decimated.ply"
                done = splat_transform.decimate(task.file, target, flag, keep_count)
                return in_memory(read_ply(target).splats()), done

        about = f"PlayCanvas splat-transform {splat_transform.version()} {flag}, file to file"
        name = f"splat-transform{flag.removeprefix('--decimate')}"
        methods.append(Method(name, EXTERNAL, about, run=run))
    return methods


def _published() -> list[Method]:
    """Return both published readings of the closed form."""
    readings = {"z": "the paper's formulas", "distance": "its authors' public code"}
    methods = []
    for depth, text in readings.items():

        def score(task: Task, statistics: Statistics | None, depth: str = depth) -> Scores:
            del statistics
            return as_scores(refine(task.splats, task.views, depth), len(task.views))

        about = f"REFINE's closed form, {text} (`baselines/refine.py`)"
        methods.append(Method(f"refine-{depth}", LITERATURE, about, score=score))
    return methods


CORE_ABOUT = {
    "closed-form": "REFINE with frustum test, free of units",
    "occlusion": "transmittance and contrast without rendering, in rounds",
    "merge": "what goes is merged into what stays",
    "refit": "then what stays is fitted, on rays, to the unpruned splats",
}


def _core() -> list[Method]:
    """Return every method of the core."""
    methods = []
    for name, settings in METHODS.items():
        one, about = settings(views=0), CORE_ABOUT.get(name, f"method '{name}'")
        if one.changes:
            methods.append(Method(name, OURS, about, reduce=partial(_pruned, one)))
        else:
            methods.append(Method(name, OURS, about, score=partial(_scored, one)))
    return methods


def _pruned(method: core.Method, task: Task, keep_count: int, ratio: float) -> Splats:
    del ratio
    return core.prune(task.splats, task.views, Budget(keep=keep_count), method).splats


def _scored(method: core.Method, task: Task, statistics: Statistics | None) -> Scores:
    del statistics
    return core.score(task.splats, task.views, method)


def as_scores(values: np.ndarray[Any, np.dtype[np.float64]], views: int) -> Scores:
    """Return plain values as `Scores`, by rank: float32 could not tell all of them apart."""
    places = np.empty(len(values), np.float32)
    places[np.argsort(values, kind="stable")] = np.arange(len(values))
    return Scores(places, np.zeros(len(values), np.int32), views, 0)


def in_memory(splats: Splats) -> Splats:
    """Return a copy that no longer lies in a file."""
    return Splats(
        **{
            name: np.array(getattr(splats, name), order="C").astype(
                getattr(splats, name).dtype.newbyteorder("=")
            )
            for name in ARRAYS
        }
    )
