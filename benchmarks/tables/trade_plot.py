"""Plots what `trade` measured: quality over time, for each scene."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from .methods import EXTERNAL, LITERATURE, OURS
from .refits import STARTS
from .results import Measured, Row

COLORS = {OURS: "#d1495b", LITERATURE: "#30638e", EXTERNAL: "#6a994e"}
MARKERS = {OURS: "o", LITERATURE: "s", EXTERNAL: "^"}


def draw(file: Path, scene: Measured) -> None:
    """Draw quality over time, one frame for each ratio."""
    import matplotlib as mpl

    mpl.use("Agg")
    from matplotlib import pyplot as plt

    ratios = sorted({row.ratio for row in scene.rows})
    figure, frames = plt.subplots(
        1, len(ratios), figsize=(4.6 * len(ratios), 5.2), squeeze=False, layout="constrained"
    )
    for frame, ratio in zip(frames[0], ratios, strict=True):
        rows = [row for row in scene.rows if row.ratio == ratio]
        for row in rows:
            x, y = max(row.cost.seconds, 1e-3), row.quality["held-out", "renders"]["psnr"]
            group = row.method.group
            frame.scatter(x, y, color=COLORS[group], marker=MARKERS[group], s=28, zorder=3)
        for curve in scene.refits:
            if curve.ratio == ratio and curve.name in STARTS:
                seconds, psnr = zip(*curve.rounds, strict=True)
                times = np.maximum(curve.start + np.array(seconds), 1e-3)
                frame.plot(times, psnr, color=COLORS[OURS], lw=0.8, marker=".", ms=3)
        _labels(frame, rows)
        frame.set(xscale="log", xlabel="seconds", title=f"{ratio:.0%} removed")
        frame.grid(alpha=0.3)
        frame.margins(x=0.25)
    frames[0][0].set_ylabel("PSNR on held-out views, dB")
    figure.suptitle(f"{scene.name}: quality over time (circles: ours, lines: refitting's rounds)")
    # Without the date and version that would change the file at every run.
    figure.savefig(file, dpi=100, metadata={"Software": None})
    plt.close(figure)


def _labels(frame: object, rows: Sequence[Row]) -> None:
    """Name the points; names that would lie on one another move apart vertically."""
    psnr = [row.quality["held-out", "renders"]["psnr"] for row in rows]
    gap = (max(psnr) - min(psnr)) / 40 or 1.0
    last = -np.inf
    for value, row in sorted(zip(psnr, rows, strict=True), key=lambda pair: pair[0]):
        last = max(value, last + gap)
        frame.annotate(  # type: ignore[attr-defined]
            row.method.name, (max(row.cost.seconds, 1e-3), value),
            xytext=(max(row.cost.seconds, 1e-3) * 1.12, last), fontsize=7, va="center",
            color=COLORS[row.method.group],
        )  # fmt: skip
