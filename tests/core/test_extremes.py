"""Whatever the method: scenes at the edge of what there is, with warnings as errors."""

from dataclasses import replace

import numpy as np
import pytest

from refine_addon.core import Budget, Merge, Occlusion, Refit, ViewSet, prune

from .test_cleaning import cameras
from .test_invariance import moved
from .test_levels import colourful
from .test_merging import around, cloud

COUNT = 60


def with_lens(views, **lens):
    return ViewSet(tuple(replace(view, **lens) for view in views))


SMALL = {"fx": 25.0, "fy": 25.0, "cx": 20.0, "cy": 15.0, "width": 40, "height": 30}
PIXEL = {"cx": 0.5, "cy": 0.5, "width": 1, "height": 1}


def with_logits(splats, value):
    """Return splats of which every second has this opacity, as a logit."""
    logits = splats.opacity_logits.copy()
    logits[::2] = value
    return replace(splats, opacity_logits=logits)


SCENES = {
    "one view": lambda splats, views: (splats, views.take([0])),
    "one splat": lambda splats, views: (splats.take(np.arange(1)), views),
    "images of a pixel": lambda splats, views: (splats, with_lens(views, **PIXEL)),
    "in one place": lambda splats, views: (replace(splats, means=np.zeros((COUNT, 3))), views),
    "the same": lambda splats, views: (splats.take(np.zeros(COUNT, np.int64)), views),
    "opacities of 0": lambda splats, views: (with_logits(splats, -np.inf), views),
    "opacities of 1": lambda splats, views: (with_logits(splats, np.inf), views),
    "millionths": lambda splats, views: moved(splats, views, unit=1e-6),
    "millions": lambda splats, views: moved(splats, views, unit=1e6),
    "moved": lambda splats, views: moved(splats, views, step=1e6),
}


@pytest.mark.slow
@pytest.mark.parametrize("method", [Occlusion, Merge, Refit])  # the closed form refuses a pixel
@pytest.mark.parametrize("name", SCENES)
def test_kept_splats_of_a_scene_at_an_edge_are_as_many_as_asked_for_and_numbers(name, method):
    """Half stay; none is NaN that was a number; refitting ends no lower than it began."""
    splats, views = SCENES[name](cloud(COUNT), with_lens(around(3, 6.0), **SMALL))
    result = prune(splats, views, Budget(keep=max(len(splats) // 2, 1)), method())
    left, told = result.splats, result.report
    assert len(left) == max(len(splats) // 2, 1)
    for array in ("means", "log_scales", "quaternions", "sh_dc", "sh_rest"):
        assert np.isfinite(getattr(left, array)).all()
    assert not np.isnan(left.opacity_logits).any()
    refitted = told.get("refitted", {"psnr": 0.0, "psnr_before": 0.0})
    assert refitted["psnr"] >= refitted["psnr_before"]
    reached = told["method"]["psnr"]
    assert all(psnr is None or 0.0 < psnr <= 100.0 for psnr in reached.values())
    if name == "images of a pixel":  # too little is seen for a measurement
        assert reached == {"delete": None, "merge": None, "refit": None}


def test_a_psnr_that_only_all_splats_keep_is_looked_for():
    """12 splats of a wall, each of its own colour: nobody stands in for one that goes."""
    result = prune(colourful().take(slice(1, None, 48)), cameras(2), Budget(psnr=80.0), Refit(2, 1))
    assert result.report["estimated_psnr"] >= 80.0
