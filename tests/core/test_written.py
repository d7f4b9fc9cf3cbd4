"""What a file of a lossy format does to the pictures of the views that pruned."""

from dataclasses import replace

import numpy as np
import pytest

from refine_addon.core import Budget, ClosedForm, Occlusion, operations, prune_file, read_splats
from refine_addon.core.affine import transformed
from refine_addon.core.quality.psnr import psnr_against

from .test_cleaning import cameras
from .test_levels import colourful, file_of


@pytest.fixture(scope="module")
def source(tmp_path_factory):
    """Return a file of 576 splats in as many colours, no two of them equally deep."""
    splats = colourful()
    splats.means[:] += np.random.default_rng(8).normal(0.0, 0.05, (576, 3))
    return file_of(splats, tmp_path_factory.mktemp("scene") / "a.ply")


@pytest.mark.slow
def test_what_the_file_holds_is_compared_with_all_splats(source, tmp_path):
    """As `psnr_against` says of what is read from it again.

    With nothing removed it is what the format costs: of 8-bit colours, off by at most 1/510, 54 dB
    or more. A plain PLY is exact, of a dry run nothing was written, and where nothing was estimated
    (the closed form looks along no lines) it is null.
    """

    def pruned(ratio, name="out.splat", settings=None, **options):
        given = (cameras(), Budget(ratio=ratio), settings or Occlusion())
        return prune_file(source, tmp_path / name, *given, overwrite=True, **options)

    result = pruned(0.1)
    left = read_splats(tmp_path / "out.splat").splats()
    wanted = psnr_against(result.scores.ray_sample, left, cameras())
    assert result.report["written_psnr"] == pytest.approx(wanted, abs=0.006)

    whole = pruned(0.0).report
    assert whole["estimated_psnr"] == 100.0
    assert 54.0 < whole["written_psnr"] < 70.0

    for each in (pruned(0.1, "out.ply"), pruned(0.1, dry_run=True)):
        assert "written_psnr" not in each.report
    assert pruned(0.1, settings=ClosedForm()).report["written_psnr"] is None


@pytest.mark.slow
def test_a_file_in_another_frame_is_moved_to_that_of_the_views(source, tmp_path):
    """Written in a frame 2 to the side, and moved back by the matrix: the same to .02 dB.

    Glb keeps single precision, so it is as good as the estimate for the splats kept.
    """
    out = tmp_path / "out.glb"
    result = prune_file(source, out, cameras(), Budget(ratio=0.3), Occlusion())
    told = result.report["written_psnr"]
    assert told == pytest.approx(result.report["estimated_psnr"], abs=0.02)
    matrix = np.eye(4)
    matrix[0, 3] = 2.0
    moved = transformed(read_splats(out).splats(), np.linalg.inv(matrix))
    aside = file_of(moved, tmp_path / "b.ply")

    def psnr(matrix):
        """Of the other file, as told of the first."""
        scene = operations.read_scene(aside)._replace(matrix=matrix)
        decided = replace(result, keep=np.ones(len(moved), np.bool_), report=dict(result.report))
        how = {"overwrite": True, "views": cameras()}
        done = operations.run(lambda: scene, lambda *_: decided, tmp_path / "b.glb", **how)
        return done.report["written_psnr"]

    assert psnr(matrix) == pytest.approx(told, abs=0.02)
    assert psnr(np.diag([1.0, 2.0, 1.0, 1.0])) is None
