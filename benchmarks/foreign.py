"""Files that others wrote: whether each is read, and as its neighbours say.

Every file of splats or cameras below a folder has a line: what it holds, or the sentence that
refuses it. Files of one folder whose names differ only by format, version or encoding hold the same
splats: their values, and numbers that makers' tests state, are compared up to what the formats
round. An SPZ that names no axes may fit after half a turn about x, which is told.

::

    python -m benchmarks.foreign FOLDER
"""

from __future__ import annotations

import argparse
import re
import traceback
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from refine_addon.core import RefineError, Splats, read_cameras, read_splats
from refine_addon.core.affine import AXES, UNKNOWN_AXES, turned
from refine_addon.core.formats.registry import INDEX_NAMES, READ_SUFFIXES
from refine_addon.core.splats import base_color, opacity, rotation_matrices, scales

BOUNDS = {
    ".splat": (0.0, 0.0, 1 / 255, 1 / 255, 0.06, 0.0),
    ".ksplat": (0.0, 0.0, 1 / 255, 1 / 255, 0.002, 0.01),
    ".spz": (1 / 4096, 1 / 32, 1 / 510, 0.0037, 0.14, 0.071),
    ".sog": (0.004, 0.06, 1 / 255, 0.02, 0.25, 0.7),
    ".compressed.ply": (0.006, 0.006, 1 / 510, 1 / 255, 0.02, 0.04),
}
"""Suffix -> largest error by `NAMES`, where a value is cut off or rounded; other formats have
`EXACT`."""

EXACT = (1e-5,) * 6
NAMES = ("position", "log scale", "opacity", "colour", "shape", "harmonics")
"""Values that are compared; shape is the covariance over its largest entry."""

_VARIANT = re.compile(
    r"[-_.](v\d+|raw|ascii|binary|text|(sh|degree|level)[-_]?\d|compressed|be|le)(?=[-_.]|$)",
    re.IGNORECASE,
)

_SCALE = np.tile([0.0, 0.5, -0.5], (15, 1))
_SCALE[3:8] = [[0.2, -0.1, 0.7], [1, -2, 3], [1, 0, -1], [2, -3, 4], [1, 0, -1]]
_OPACITY = np.full(15, 0.25)
_OPACITY[8:11] = 0.75, 64 / 255, 16384 / 65535
STATED = {"khr_conformance_matrix": (np.tile([-1.0, -2.0, 3.0], (15, 1)), _SCALE, _OPACITY)}
"""Stem -> positions, log scales, opacities by the tests of their makers, in our axes."""

PLAIN_COLORS = "its script stored plain colours, which are not SPZ's"
WRONG = {"minimal-raw.spz": PLAIN_COLORS, "minimal-v2.spz": PLAIN_COLORS}
"""Files that do not hold what their makers meant, and why: told, and no failure."""


def values(splats: Splats) -> list[NDArray[np.float64]]:
    """Values by `NAMES`, (N, ...) each, colours within 0..1, log scales at least SPZ's -10."""
    axes = rotation_matrices(splats.quaternions) * scales(splats.log_scales)[:, None, :]
    shape = axes @ axes.swapaxes(1, 2)
    shape = shape / np.abs(shape).max(axis=(1, 2), keepdims=True)
    colors = np.clip(base_color(splats.sh_dc), 0.0, 1.0)
    logs = np.maximum(splats.log_scales, -10.0)
    each = splats.means, logs, opacity(splats.opacity_logits), colors, shape
    return [np.asarray(one, np.float64) for one in (*each, splats.sh_rest)]


def bounds(path: Path) -> tuple[float, ...]:
    """Largest errors of values read from a file."""
    return next((b for end, b in BOUNDS.items() if path.name.lower().endswith(end)), EXACT)


def differences(first: Splats, second: Splats, allowed: Sequence[float]) -> list[float]:
    """Largest differences by `NAMES`, each splat beside the most similar if the order differs."""
    degree = min(first.sh_degree, second.sh_degree)
    a, b = (values(one.up_to_degree(degree)) for one in (first, second))
    order = np.arange(len(first))
    if np.median(np.abs(a[0] - b[0])) > allowed[0]:
        points, known = (
            np.column_stack([value / most for value, most in zip(each[:4], allowed, strict=False)])
            for each in (a, b)
        )
        order = cKDTree(known).query(points, p=np.inf)[1]
    pairs = zip(a, b, strict=True)
    return [float(np.abs(one - other[order]).max(initial=0.0)) for one, other in pairs]


def verdict(path: Path, measured: Sequence[float], allowed: Sequence[float], how: str) -> bool:
    """Print a comparison; whether it failed.

    >>> verdict(Path("a.spz"), [0.5, 0.01], [0.1, 0.02], "a.spz beside a.ply")
      a.spz beside a.ply: position 0.5, log scale 0.01: FAIL (position)
    True
    """
    named = list(zip(NAMES, measured, strict=False))
    over = [n for (n, value), most in zip(named, allowed, strict=False) if not value <= most]
    known = WRONG.get(path.name, "")
    result = "PASS" if not over else f"KNOWN ({known})" if known else f"FAIL ({', '.join(over)})"
    print(f"  {how}: {', '.join(f'{name} {value:.2g}' for name, value in named)}: {result}")
    return bool(over) and not known


def content(path: Path) -> str:
    """What names of files with the same splats have in common.

    >>> [content(Path(name)) for name in ("a-v2.spz", "a.raw.spz", "a_degree0.ply", "a_b.ply")]
    ['a', 'a', 'a', 'a_b']
    """
    return _VARIANT.sub("", path.stem)


def compare(path: Path, splats: Splats, axes: str, other: Path, reference: Splats) -> bool:
    """Print how splats differ from those of another file; whether more than formats round."""
    how = f"{path.name} beside {other.name}"
    if len(splats) != len(reference):
        same = path.stem == other.stem
        print(f"  {how}: {len(splats)} and {len(reference)} splats: {'FAIL' if same else 'others'}")
        return same
    allowed = [1e-6 + a + b for a, b in zip(bounds(path), bounds(other), strict=True)]
    measured = differences(splats, reference, allowed)
    if axes == UNKNOWN_AXES and measured[0] > allowed[0]:
        half = differences(turned(splats, AXES[0]), reference, allowed)
        if half[0] < measured[0]:
            measured, how = half, f"{how}, y up"
    return verdict(path, measured, allowed, how)


def main(arguments: Sequence[str] | None = None) -> int:
    """Print the lines; 1 if a comparison failed or a reader did."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("folder", type=Path)
    failed, groups = 0, {}
    for path in sorted(parser.parse_args(arguments).folder.rglob("*")):
        name = path.name.lower()
        of_splats = name.endswith((*READ_SUFFIXES, ".json")) and (
            not name.endswith(".json") or name.endswith(INDEX_NAMES)
        )
        if not of_splats and not name.endswith((".json", "images.bin", "images.txt")):
            continue
        try:
            if not of_splats:
                views = read_cameras(path if name.endswith(".json") else path.parent)
                print(f"{path}: {len(views)} views of {views[0].width} x {views[0].height}")
                continue
            file = read_splats(path)
            splats = file.splats()
        except RefineError as error:
            print(f"{error} (refused)" if str(path) in str(error) else f"{path}: {error} (refused)")
            continue
        except Exception:
            traceback.print_exc()
            failed += 1
            continue
        print(f"{path}: {len(file)} splats, degree {splats.sh_degree}, {file.format}, {file.model}")
        if path.stem in STATED:
            measured = [
                float(np.abs(value - stated).max())
                for value, stated in zip(values(splats), STATED[path.stem], strict=False)
            ]
            failed += verdict(path, measured, EXACT, "beside its maker's test")
        group = groups.setdefault((path.parent, content(path)), [])
        group.append((path, splats, file.axes))
    for group in groups.values():
        group.sort(key=lambda one: sum(bounds(one[0])))
        (first, reference, _), *others = group
        for path, splats, axes in others:
            failed += compare(path, splats, axes, first, reference)
    print(f"{failed} failed")
    return int(failed > 0)


if __name__ == "__main__":
    raise SystemExit(main())
