"""Occlusion made cheaper: how much accuracy each way to save time costs."""

from __future__ import annotations

import time
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

from refine_addon.core import pipeline
from refine_addon.core.pipeline import Settings
from refine_addon.core.scoring.occlusion import Occlusion

if TYPE_CHECKING:
    from collections.abc import Sequence

    from .evaluate import Evaluator
    from .methods import Task

BASE = Settings(method="occlusion", views=0)
WAYS: dict[str, dict[str, Any]] = {
    "default, all views": {},
    "32 views": {"views": 32},
    "16 views": {"views": 16},
    "8 views": {"views": 8},
    "3 rounds": {"occlusion": Occlusion(rounds=3)},
    "1 round": {"occlusion": Occlusion(rounds=1)},
    "density 3": {"occlusion": Occlusion(density=3.0)},
    "cells of 6 px": {"occlusion": Occlusion(cell=6.0)},
    "cells of 8 px": {"occlusion": Occlusion(cell=8.0)},
    "cells of 8 px, 3 rounds": {"occlusion": Occlusion(cell=8.0, rounds=3)},
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
    for way, changes in WAYS.items():
        start = time.perf_counter()
        scores = pipeline.score(task.splats, task.views, replace(BASE, **changes))
        seconds = time.perf_counter() - start
        psnr = evaluator.psnr(task.splats, scores, ratios)
        lines.append(Line(way, seconds, psnr))
        print(f"  {way}: {seconds:.2f} s {[round(value, 2) for value in psnr]}", flush=True)
    return lines
