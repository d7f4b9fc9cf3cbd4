"""The scene that looks like a capture, and the table of whole commands."""

from __future__ import annotations

import numpy as np

from benchmarks.speed import capture, whole
from benchmarks.speed.whole import Figure
from refine_addon.core import score
from refine_addon.core.splats import opacity


def test_a_capture_has_many_small_splats_and_few_vast_ones_and_is_always_the_same():
    """One in fifty lies far away; half of the others are smaller than 3 cm on a square of 10 m."""
    splats = capture.make(20_000, degree=1)

    far = np.linalg.norm(splats.means, axis=1) > 2.0 * capture.SIZE
    size = np.exp(splats.log_scales.max(axis=1))
    assert len(splats) == 20_000
    assert np.count_nonzero(far) == 400
    assert np.median(size[far]) > 30.0 * np.median(size[~far])
    assert 0.3 < np.mean(opacity(splats.opacity_logits) < 0.5) < 0.5
    assert splats.sh_rest.shape == (20_000, 3, 3)
    np.testing.assert_array_equal(splats.means, capture.make(20_000, degree=1).means)


def test_cameras_of_a_capture_see_most_of_it_and_hide_some():
    """Most lie in the frame of one of 16 cameras."""
    splats = capture.make(2_000, degree=0)

    scores = score(splats, capture.cameras(16, width=160))

    assert 0.7 < np.mean(scores.seen > 0) <= 1.0


def test_the_table_says_what_is_over_splat_transform_and_what_has_changed():
    """Merging to a tenth: 3 s over 2 s and 200 MB over 100; a tenth more is not marked."""
    figures = {
        "merge 90%": Figure(3.0, 200.0),
        "occlusion": Figure(2.2, 50.0),
        "splat-transform 90%": Figure(2.0, 100.0),
    }
    before = {"merge 90%": (2.0, 195.0), "occlusion": (2.1, 50.0)}

    lines = whole.table(figures, before)

    assert lines[2:] == [
        "| merge 90% | 3.0 s | 200 MB | 1.50 / 2.00 | busy +50% |",
        "| occlusion | 2.2 s | 50 MB |  | as before |",
        "| splat-transform 90% | 2.0 s | 100 MB |  | new |",
    ]
