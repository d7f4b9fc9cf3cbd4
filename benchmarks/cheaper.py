"""Occlusion made cheaper: how much accuracy each way to save time costs."""

from __future__ import annotations

import time
from dataclasses import dataclass
from typing import TYPE_CHECKING

from refine_addon.core import pipeline
from refine_addon.core.occlusion import Occlusion
from refine_addon.core.pipeline import Settings

if TYPE_CHECKING:
    from collections.abc import Sequence

    from .evaluate import Evaluator
    from .methods import Task

WAYS = {
    "default, all views": Settings(views=0, method="occlusion"),
    "32 views": Settings(views=32, method="occlusion"),
    "16 views": Settings(views=16, method="occlusion"),
    "8 views": Settings(views=8, method="occlusion"),
    "3 rounds": Settings(views=0, method="occlusion", occlusion=Occlusion(rounds=3)),
    "1 round": Settings(views=0, method="occlusion", occlusion=Occlusion(rounds=1)),
    "density 3": Settings(views=0, method="occlusion", occlusion=Occlusion(density=3.0)),
    "cells of 6 px": Settings(views=0, method="occlusion", occlusion=Occlusion(cell=6.0)),
    "cells of 8 px": Settings(views=0, method="occlusion", occlusion=Occlusion(cell=8.0)),
    "cells of 8 px, 3 rounds": Settings(
        views=0, method="occlusion", occlusion=Occlusion(cell=8.0, rounds=3)
    ),
}


@dataclass(frozen=True)
class Line:
    """Seconds and PSNR of one way.

    Attributes
    ----------
    way : str
    seconds : float
        For the scores, from which any number of splats can be removed.
    psnr : tuple of float
        For each ratio, dB, on held-out views against renders of the unpruned splats.
    """

    way: str
    seconds: float
    psnr: tuple[float, ...]


def measure(task: Task, evaluator: Evaluator, ratios: Sequence[float]) -> list[Line]:
    """Measure all ways."""
    lines = []
    for way, settings in WAYS.items():
        start = time.perf_counter()
        scores = pipeline.score(task.splats, task.views, settings)
        seconds = time.perf_counter() - start
        psnr = evaluator.psnr(task.splats, scores, ratios)
        lines.append(Line(way, seconds, psnr))
        print(f"  {way}: {seconds:.2f} s {[round(value, 2) for value in psnr]}", flush=True)
    return lines
