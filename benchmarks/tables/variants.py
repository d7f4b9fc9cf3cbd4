"""Scores by other settings: what each part of the closed form is worth."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

from refine_addon import core
from refine_addon.core import ClosedForm, Scores

from ..baselines.refine import refine
from .evaluate import Evaluator
from .methods import Task, as_scores

Score = Callable[[Task], Scores]


def _published(depth: str, **changes: bool) -> Score:
    return lambda task: as_scores(
        refine(task.splats, task.views, depth, **changes), len(task.views)
    )


_PARTS = {
    "whole": {},
    "without visibility": {"visibility": False},
    "without projection": {"projection": False},
    "equal weights": {"equal_weights": True},
}
ABLATION = {
    f"published, {depth}: {part}": _published(depth, **changes)
    for depth in ("z", "distance")
    for part, changes in _PARTS.items()
} | {"default: whole": lambda task: core.score(task.splats, task.views, ClosedForm(views=0))}
"""The closed form as published, and without its parts as the paper takes it apart; and ours."""


@dataclass(frozen=True)
class Line:
    """Seconds and PSNR by one of the settings.

    - seconds: For the scores, from which any number of splats can be removed.
    - psnr: For each ratio, dB, on held-out views against renders of the unpruned splats.
    """

    name: str
    seconds: float
    psnr: tuple[float, ...]


def measure(
    variants: Mapping[str, Score], task: Task, evaluator: Evaluator, ratios: Sequence[float]
) -> list[Line]:
    """Score in each way and compare what stays."""
    lines = []
    for name, score in variants.items():
        start = time.perf_counter()
        scores = score(task)
        seconds = time.perf_counter() - start
        psnr = evaluator.psnr(task.splats, scores, ratios)
        lines.append(Line(name, seconds, psnr))
        print(f"  {name}: {seconds:.2f} s {[round(value, 2) for value in psnr]}", flush=True)
    return lines
