"""What a file of a lossy format does to the pictures of the views that pruned."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest

from refine_addon.command import main
from refine_addon.core import (
    Budget,
    ClosedForm,
    Occlusion,
    operations,
    prune_file,
    read_splats,
)
from refine_addon.core.affine import transformed
from refine_addon.core.quality.psnr import psnr_against

from .test_cleaning import cameras, wall
from .test_command_clean import files  # noqa: F401 - a fixture
from .test_levels import file_of

OCCLUSION = Occlusion()


@pytest.fixture
def source(tmp_path):
    """Return a file of 576 splats in as many colours."""
    random = np.random.default_rng(8)
    colors = random.uniform(-1.0, 1.0, (576, 3)).astype(np.float32)
    means = wall().means + random.normal(0.0, 0.05, (576, 3)).astype(np.float32)  # no equal depths
    splats = replace(wall(), sh_dc=colors, means=means)
    return file_of(splats, tmp_path / "a.ply")


@pytest.mark.slow
def test_what_the_file_holds_is_compared_with_all_splats(source, tmp_path):
    """As `psnr_against` says of what is read from it again."""
    out = tmp_path / "out.splat"

    result = prune_file(source, out, cameras(), Budget(ratio=0.1), OCCLUSION)

    wanted = psnr_against(result.scores.ray_sample, read_splats(out).splats(), cameras())
    assert result.report["written_psnr"] == pytest.approx(wanted, abs=0.006)


@pytest.mark.slow
def test_a_format_that_rounds_little_costs_next_to_nothing(source, tmp_path):
    """Glb keeps single precision: as good as the estimate for the splats kept, to .01 dB."""
    result = prune_file(source, tmp_path / "out.glb", cameras(), Budget(ratio=0.3), OCCLUSION)

    report = result.report
    assert report["written_psnr"] == pytest.approx(report["estimated_psnr"], abs=0.02)


@pytest.mark.slow
def test_with_nothing_removed_it_is_what_the_format_costs(source, tmp_path):
    """All pictures are the same, 100 dB; of 8-bit colours, off by at most 1/510, 54 dB or more."""
    result = prune_file(source, tmp_path / "out.splat", cameras(), Budget(ratio=0.0), OCCLUSION)

    assert result.report["estimated_psnr"] == 100.0
    assert 54.0 < result.report["written_psnr"] < 70.0


@pytest.mark.slow
def test_a_plain_ply_and_a_dry_run_cost_nothing(source, tmp_path):
    """A plain PLY is exact; of a dry run nothing was written."""
    for name, dry in (("out.ply", False), ("out.splat", True)):
        result = prune_file(
            source,
            tmp_path / name,
            cameras(),
            Budget(ratio=0.1),
            OCCLUSION,
            dry_run=dry,
        )
        assert "written_psnr" not in result.report


def test_where_nothing_was_estimated_it_is_null(source, tmp_path):
    """The closed form looks along no lines unless a PSNR is the budget."""
    settings = ClosedForm()

    result = prune_file(source, tmp_path / "out.splat", cameras(), Budget(ratio=0.1), settings)

    assert result.report["written_psnr"] is None


@pytest.mark.slow
def test_a_file_in_another_frame_is_moved_to_that_of_the_views(source, tmp_path):
    """Written in a frame 2 to the side, and moved back by the matrix: the same to .02 dB."""
    out = tmp_path / "out.glb"
    result = prune_file(source, out, cameras(), Budget(ratio=0.3), OCCLUSION)
    matrix = np.eye(4)
    matrix[0, 3] = 2.0
    aside = file_of(
        transformed(read_splats(out).splats(), np.linalg.inv(matrix)), tmp_path / "b.ply"
    )
    moved = prune_file(aside, tmp_path / "b.glb", cameras(), Budget(ratio=0.0), OCCLUSION)
    assert moved.report["splats"]["removed"] == 0

    def psnr(matrix):
        """Of the other file, as told of the first."""
        scene = replace(operations.read_scene(aside), matrix=matrix)
        kept = np.ones(len(scene.splats), np.bool_)
        decided = replace(result, keep=kept, report=dict(result.report))
        written = operations.run(
            lambda form: scene, lambda *_: decided, tmp_path / "b.glb",
            overwrite=True, views=cameras(),
        )  # fmt: skip
        return written.report["written_psnr"]

    told = result.report["written_psnr"]
    assert psnr(matrix) == pytest.approx(told, abs=0.02)
    assert psnr(np.diag([1.0, 2.0, 1.0, 1.0])) is None


@pytest.mark.slow
def test_the_command_says_it(files, capsys):
    """On the line of the quality, and in the report."""
    told = files / "report.json"
    code = main([
        "prune", str(files / "scene.ply"), "--cameras", str(files), "--ratio", ".1",
        "--method", "occlusion", "-o", str(files / "out.splat"), "--report", str(told),
    ])  # fmt: skip

    assert code == 0
    assert "dB as written" in capsys.readouterr().out
    assert json.loads(told.read_text())["results"][0]["written_psnr"] > 0.0
