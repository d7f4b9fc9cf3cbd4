"""The closed form without its parts, as the paper takes it apart, in each of its readings."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

from refine_addon.core.scoring import closed_form
from refine_addon.core.scoring.closed_form import ClosedForm

if TYPE_CHECKING:
    from collections.abc import Sequence

    from .evaluate import Evaluator
    from .methods import Task

READINGS = {
    "published, z": ClosedForm.published("z"),
    "published, distance": ClosedForm.published("distance"),
    "default": ClosedForm(),
}
CHANGES = {
    "whole": {},
    "without visibility": {"visibility": False},
    "without projection": {"projection": False},
    "equal weights": {"equal_weights": True},
}


@dataclass(frozen=True)
class Line:
    """PSNR of one reading without one part.

    Attributes
    ----------
    reading, change : str
    psnr : tuple of float
        For each ratio, dB, on held-out views against renders of the unpruned splats.
    """

    reading: str
    change: str
    psnr: tuple[float, ...]


def measure(task: Task, evaluator: Evaluator, ratios: Sequence[float]) -> list[Line]:
    """Measure all readings without each part."""
    lines = []
    for reading, settings in READINGS.items():
        for change, values in CHANGES.items():
            scores = closed_form.score(task.splats, task.views, replace(settings, **values))
            psnr = evaluator.psnr(task.splats, scores, ratios)
            lines.append(Line(reading, change, psnr))
            print(f"  {reading}, {change}: {[round(value, 2) for value in psnr]}", flush=True)
    return lines
