"""splat-transform reads what we write, and we read what it writes, splat by splat."""

from __future__ import annotations

import subprocess
from typing import TYPE_CHECKING

import numpy as np
import pytest
from scipy.spatial import cKDTree

from benchmarks.baselines import splat_transform
from refine_addon.core import Splats, as_written, read_splats
from refine_addon.core.splats import base_color, opacity, rotation_matrices
from tests.strategies import ply_of, splat_names

if TYPE_CHECKING:
    from pathlib import Path

pytestmark = [
    pytest.mark.skipif(splat_transform.find() is None, reason=splat_transform.MISSING),
    pytest.mark.slow,
]

COUNT = 700

BOUNDS = {
    # suffix: (mean, log scale, opacity, colour, entry of the rotation matrix, harmonics)
    ".splat": (0.0, 1e-5, 0.004, 0.004, 0.1, np.inf),
    ".spz": (0.0005, 0.032, 0.002, 0.004, 0.006, 0.071),
    ".compressed.ply": (0.006, 0.006, 0.002, 0.004, 0.006, 0.04),
}
"""Suffix -> largest differences of activated values: what docs/conventions.md says of each format;
of .splat twice that, since splat-transform cuts codes off where we round, and takes those of
rotations for shares of 127.5 where we take 128.
"""


def transformed(source: Path, target: Path, *options: str) -> None:
    """Have splat-transform write `source` as `target`."""
    order = [*splat_transform.find(), "-g", "cpu", "-q", "-w", str(source), *options, str(target)]
    subprocess.run(order, check=True, timeout=300, capture_output=True)


def room(folder: Path, degree: int) -> Path:
    """Write random splats, apart from each other, as a plain PLY."""
    random = np.random.default_rng(degree)
    columns = {
        name: random.normal(0.0, 0.3, COUNT).astype(np.float32) for name in splat_names(degree)
    }
    grid = np.stack(np.meshgrid(*[np.arange(9)] * 3), axis=-1).reshape(-1, 3)[:COUNT] - 4.0
    for axis, name in enumerate("xyz"):
        columns[name] = (grid[:, axis] * 0.5 + columns[name] * 0.1).astype(np.float32)
        columns[f"scale_{axis}"] -= 4.0
    columns["opacity"] *= 8.0
    # It does not normalise rotations for a .splat; SPZ holds harmonics between -1 and 1.
    length = np.sqrt(sum(columns[f"rot_{index}"] ** 2 for index in range(4)))
    for name, values in columns.items():
        if name.startswith("rot_"):
            columns[name] = values / length
        elif name.startswith("f_rest_"):
            columns[name] = (values * 0.5).clip(-0.9, 0.9)
    (folder / "in.ply").write_bytes(ply_of(columns))
    return folder / "in.ply"


def compare(one: Splats, other: Splats, bounds: tuple[float, ...]) -> None:
    """Compare splats, each with the nearest."""
    apart, nearest = cKDTree(other.means).query(one.means)
    other = other.take(nearest)
    differences = (
        apart,
        one.log_scales - other.log_scales,
        opacity(one.opacity_logits) - opacity(other.opacity_logits),
        base_color(one.sh_dc) - base_color(other.sh_dc),
        rotation_matrices(one.quaternions) - rotation_matrices(other.quaternions),
        one.sh_rest - other.sh_rest,
    )

    assert len(np.unique(nearest)) == len(one) == COUNT
    for difference, bound in zip(differences, bounds, strict=True):
        assert np.abs(difference).max(initial=0.0) <= bound


@pytest.mark.parametrize("degree", [0, 3])
@pytest.mark.parametrize("suffix", BOUNDS)
def test_it_reads_what_we_write(tmp_path, suffix, degree):
    """Ours, read by it and written as a PLY, is the source within the bounds, and what we read."""
    source, made, back = room(tmp_path, degree), tmp_path / f"a{suffix}", tmp_path / "back.ply"
    file = read_splats(source)
    as_written(file, made).write(made)

    transformed(made, back)

    degree = read_splats(made).splats().sh_degree
    theirs = read_splats(back).splats()
    assert theirs.sh_degree == degree
    compare(theirs, file.splats().up_to_degree(degree), BOUNDS[suffix])
    exact = (1e-5, 1e-5, 1e-5, 1e-5, 0.05 if suffix == ".splat" else 1e-5, 1e-5)
    compare(theirs, read_splats(made).splats(), exact)


@pytest.mark.parametrize("degree", [0, 3])
@pytest.mark.parametrize("suffix", BOUNDS)
def test_we_read_what_it_writes(tmp_path, suffix, degree):
    """Its file, read by us, is the source within the bounds."""
    source, made = room(tmp_path, degree), tmp_path / f"a{suffix}"
    transformed(source, made)

    ours = read_splats(made).splats()

    compare(ours, read_splats(source).splats().up_to_degree(ours.sh_degree), BOUNDS[suffix])


@pytest.mark.parametrize("version", ["3", "4"])
def test_we_read_both_versions_of_spz_that_it_writes(tmp_path, version):
    """By gzip and by zstd: the same splats."""
    source, made = room(tmp_path, 2), tmp_path / "a.spz"
    if version == "4":
        pytest.importorskip("zstandard")
    transformed(source, made, "--spz-version", version)

    file = read_splats(made)

    assert file.format == f"SPZ version {version}"
    compare(file.splats(), read_splats(source).splats(), BOUNDS[".spz"])
