"""Scores by other settings: what each part of a method is worth, and what it costs."""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from refine_addon.core import Settings, score
from refine_addon.core.scoring.closed_form_settings import ClosedForm
from refine_addon.core.scoring.occlusion import Occlusion

from .evaluate import Evaluator
from .methods import Task


def _occlusion(views: int = 0, **changes: float) -> Settings:
    return Settings("occlusion", views=views, occlusion=Occlusion(**changes))


CHEAPER = {
    "default, all views": _occlusion(),
    "32 views": _occlusion(32),
    "16 views": _occlusion(16),
    "8 views": _occlusion(8),
    "3 rounds": _occlusion(rounds=3),
    "1 round": _occlusion(rounds=1),
    "density 3": _occlusion(density=3.0),
    "cells of 6 px": _occlusion(cell=6.0),
    "cells of 8 px": _occlusion(cell=8.0),
    "cells of 8 px, 3 rounds": _occlusion(cell=8.0, rounds=3),
}
"""Occlusion made cheaper: how much accuracy each way to save time costs."""

_READINGS = {
    "published, z": lambda **parts: ClosedForm.published("z", **parts),
    "published, distance": lambda **parts: ClosedForm.published("distance", **parts),
    "default": ClosedForm,
}
_PARTS = {
    "whole": {},
    "without visibility": {"visibility": False},
    "without projection": {"projection": False},
    "equal weights": {"equal_weights": True},
}
ABLATION = {
    f"{reading}: {part}": Settings("closed-form", views=0, closed_form=make(**changes))
    for reading, make in _READINGS.items()
    for part, changes in _PARTS.items()
}
"""The closed form without its parts, as the paper takes it apart, in each of its readings."""


@dataclass(frozen=True)
class Line:
    """Seconds and PSNR by one of the settings.

    Attributes
    ----------
    name : str
    seconds : float
        For the scores, from which any number of splats can be removed.
    psnr : tuple of float
        For each ratio, dB, on held-out views against renders of the unpruned splats.
    """

    name: str
    seconds: float
    psnr: tuple[float, ...]


def measure(
    variants: Mapping[str, Settings], task: Task, evaluator: Evaluator, ratios: Sequence[float]
) -> list[Line]:
    """Score by each of the settings and compare what stays."""
    lines = []
    for name, settings in variants.items():
        start = time.perf_counter()
        scores = score(task.splats, task.views, settings)
        seconds = time.perf_counter() - start
        psnr = evaluator.psnr(task.splats, scores, ratios)
        lines.append(Line(name, seconds, psnr))
        print(f"  {name}: {seconds:.2f} s {[round(value, 2) for value in psnr]}", flush=True)
    return lines
