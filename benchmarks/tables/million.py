"""A million splats: seconds and memory of whole commands, file to file, and what is left.

The splats are those of a scene, split until there are `COUNT`: the largest first, each in two along
its longest axis, so that the two together look like the one. Half of them goes. Every command is a
process of its own and is given the file; ours also the cameras that score, with pictures 480 pixels
wide.
"""

from __future__ import annotations

import json
import sys
import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from plyfile import PlyData, PlyElement

from refine_addon.core import METHODS
from refine_addon.core.formats.ply import read_ply
from refine_addon.core.formats.ply_columns import values_by_name
from refine_addon.core.splats import SH_C0, Splats, drawable, joined, opacity, rotation_matrices
from refine_addon.core.views import ViewSet

from ..baselines import splat_transform
from .evaluate import Evaluator

COUNT = 1_000_000
RATIO = 0.5
WIDTH = 480
COMPARED = 4
"""Held-out views that are compared: a million splats take seconds to draw."""
ASIDE = 0.75
"""Where the two of a split splat lie, standard deviations to either side along its longest axis."""
SHADE = 0.02
"""Standard deviation of what one of the two is brighter and the other darker."""


@dataclass(frozen=True)
class Command:
    """One command.

    - seconds, busy: From start to end, and of the processor, all cores together.
    - psnr: Against renders of the million, mean of the views that are compared, dB.
    """

    name: str
    seconds: float
    busy: float
    megabytes: float
    kept: int
    psnr: float


@dataclass(frozen=True)
class Million:
    """What was measured of a million splats.

    - source, splats: How many there were and how many were made of them.
    - likeness: PSNR of the renders of these against renders of those, dB.
    - compared: How many held-out views are compared.
    """

    source: int
    splats: int
    likeness: float
    compared: int
    commands: list[Command]


def split(splats: Splats, count: int) -> Splats:
    """Return `count` splats that look like `splats`, of which there are fewer.

    A splat of variance s^2 along its longest axis becomes two, `ASIDE` s to either side with
    variance ``(1 - ASIDE^2) s^2``: together they have its mean and its covariance. Each gets half
    of its optical thickness times area, ``1 - (1 - opacity)^(1 / (2 sqrt(1 - ASIDE^2)))``.

    - ValueError: if there are more than `count`, or none can be drawn.
    """
    now = splats.take(drawable(splats))
    if not 0 < len(now) <= count:
        raise ValueError(f"cannot make {count} splats of {len(now)} that can be drawn")
    random = np.random.default_rng(0)
    while len(now) < count:
        areas = np.sum(np.sort(now.log_scales, axis=1)[:, 1:], axis=1)
        order = np.argsort(-areas, kind="stable")
        chosen, rest = np.split(order, [min(count - len(now), len(now))])
        one, other = _halves(now.take(chosen), random)
        now = joined([now.take(rest), one, other])
    return now


def _halves(splats: Splats, random: np.random.Generator) -> tuple[Splats, Splats]:
    """Split every splat in two."""
    rows, longest = np.arange(len(splats)), np.argmax(splats.log_scales, axis=1)
    axis = rotation_matrices(splats.quaternions)[rows, :, longest]
    aside = ASIDE * np.exp(splats.log_scales[rows, longest])[:, None] * axis
    shrunk = np.sqrt(1.0 - ASIDE**2)
    scales = np.array(splats.log_scales)
    scales[rows, longest] += np.log(shrunk)
    # Of opacities next to 1 the logarithm needs a bound; 1 - 1e-6 is drawn as .99 anyway.
    thickness = -np.log1p(-np.minimum(opacity(splats.opacity_logits), 1.0 - 1e-6))
    logits = _logit(-np.expm1(-thickness / (2.0 * shrunk)))
    shade = random.normal(scale=SHADE / SH_C0, size=(len(splats), 1)).astype(np.float32)
    pair = [
        replace(
            splats,
            means=(splats.means + sign * aside).astype(np.float32),
            log_scales=scales.astype(np.float32),
            opacity_logits=logits.astype(np.float32),
            sh_dc=splats.sh_dc + sign * shade,
        )
        for sign in (np.float32(1.0), np.float32(-1.0))
    ]
    return pair[0], pair[1]


def _logit(values: NDArray[np.float64]) -> NDArray[np.float64]:
    inside = np.maximum(values, 1e-30)
    return np.asarray(np.log(inside) - np.log1p(-inside))


def write_ply(path: Path, splats: Splats) -> None:
    """Write splats as a 3DGS PLY of float32."""
    columns = {name: values.astype(np.float32) for name, values in values_by_name(splats).items()}
    rows = np.empty(len(splats), [(name, "<f4") for name in columns])
    for name, values in columns.items():
        rows[name] = values
    PlyData([PlyElement.describe(rows, "vertex")], byte_order="<").write(path)


def write_cameras(path: Path, views: ViewSet) -> None:
    """Write cameras as the reference implementation does; principal points are the middles."""
    cameras = [
        {
            "id": number,
            "img_name": view.name,
            "width": view.width,
            "height": view.height,
            "position": view.center.tolist(),
            "rotation": view.rotation.T.tolist(),
            "fx": view.fx,
            "fy": view.fy,
        }
        for number, view in enumerate(views)
    ]
    path.write_text(json.dumps(cameras), encoding="utf-8")


def scaled(views: ViewSet, width: int) -> ViewSet:
    """Return the same cameras with pictures of another width, pixels; heights in proportion."""
    made = []
    for view in views:
        height = max(round(view.height * width / view.width), 1)
        across, down = width / view.width, height / view.height
        size = {"width": width, "fx": view.fx * across, "cx": view.cx * across}
        size |= {"height": height, "fy": view.fy * down, "cy": view.cy * down}
        made.append(replace(view, **size))
    return replace(views, views=tuple(made))


def commands(folder: Path, left: int) -> Mapping[str, Sequence[str | Path]]:
    """Return all commands by name, from ``in.ply`` in a folder to ``out.ply`` there."""
    source, output = folder / "in.ply", folder / "out.ply"
    ours: list[str | Path] = [sys.executable, "-m", "refine_addon", "prune", source, "-o", output]
    ours += ["--keep", str(left), "--cameras", folder / "cameras.json", "--views", "0"]
    found: dict[str, Any] = {name: [*ours, "--method", name] for name in METHODS}
    if splat_transform.find() is not None:
        for flag in splat_transform.FLAGS:
            name = f"splat-transform{flag.removeprefix('--decimate')}"
            found[name] = splat_transform.command(source, output, flag, left)
    return found


def measure(splats: Splats, views: ViewSet, test: ViewSet, count: int = COUNT) -> Million:
    """Split the splats of a scene and run every command on them.

    - test: Those that are compared, `COMPARED` of them.
    """
    many = split(splats, count)
    held_out = scaled(test.spread(COMPARED), WIDTH)
    likeness = Evaluator(splats, held_out, metrics=("psnr",)).evaluate(many).renders.mean["psnr"]
    evaluator = Evaluator(many, held_out, metrics=("psnr",))
    rows = []
    with tempfile.TemporaryDirectory() as made:
        folder = Path(made)
        write_ply(folder / "in.ply", many)
        write_cameras(folder / "cameras.json", scaled(views, WIDTH))
        for name, command in commands(folder, len(many) - int(RATIO * len(many))).items():
            seconds, busy, peak = splat_transform.measured(command)
            left = read_ply(folder / "out.ply").splats()
            psnr = evaluator.evaluate(left).renders.mean["psnr"]
            rows.append(Command(name, seconds, busy, peak, len(left), psnr))
            (folder / "out.ply").unlink()
            print(f"  {rows[-1]}", flush=True)
    return Million(len(splats), len(many), likeness, len(held_out), rows)
