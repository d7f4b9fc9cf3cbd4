"""PSNR of views, estimated from a sample of their pixels: `RaySample` has these for any choice of
splats.

The mean squared difference over these pixels is unbiased for that over the picture.
"""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..execute import Progress, part, run_all, silent
from ..splats import Splats
from ..views import View, ViewSet
from ..visibility import projection
from ..visibility.cast import RaySample, cast, colors_from
from .curve import FEWEST, MERGED_SHARES, PSNR_CAP, SHARES, Quality, merged_from

MIN_RAYS_WITH_HITS = 256
"""Fewer rays that hit a splat give no estimate."""

DOUBT = 0.75
"""Standard errors of the mean over views in between by which less is told, as that is a promise:
without them it was up to 1.6 dB too high."""


def psnr_of(colors: NDArray[Any], truth: NDArray[Any], view: View) -> float:
    """PSNR of a view, dB, at most `PSNR_CAP`, by (3, ...) colours (docs/method.md, section 5).

    The logarithm of a mean is too low by half its squared relative error, which is corrected; the
    variance is that between neighbouring rays, so that parts of the picture may differ.
    """
    errors = np.mean((colors - truth) ** 2, axis=0, dtype=np.float64).ravel()
    mean, count = float(np.mean(errors)), len(errors)
    if mean <= 10.0 ** (-PSNR_CAP / 10.0):
        return PSNR_CAP
    unsampled = 1.0 - count / (view.width * view.height)  # with all pixels the mean is exact
    variance = float(np.sum(np.diff(errors) ** 2)) / 2.0 / max(count - 1, 1)
    relative = unsampled * variance / count / mean**2
    return min(-10.0 * math.log10(mean) - 5.0 / math.log(10.0) * relative, PSNR_CAP)


def psnr_kept(sample: RaySample, keep: NDArray[np.bool_]) -> float | None:
    """Mean PSNR of all views, dB, if only splats `keep`, (N,), stay; None if too little is seen."""
    if not _enough(sample):
        return None
    return float(_removing(sample, keep, [1])[1][0])


def with_quality(
    scores: Any, protected: NDArray[np.bool_] | None = None, progress: Progress = silent
) -> Any:
    """`Scores` with the estimated PSNR at each of `curve.SHARES`, if they have validation rays.

    It is None if too little is seen. The lowest scores are removed first, of equal ones the first
    in the file, `protected` splats last. The curve ends after the scores that are settled.
    """
    sample, values, settled = scores.ray_sample, scores.values, scores.settled
    if sample is None:
        return scores
    last = len(values) if settled is None else settled
    if settled is not None and protected is not None:
        last -= int(np.count_nonzero(protected))
    removed, merged = (
        [count for share in shares if (count := math.floor(share * len(values))) <= last]
        for shares in (SHARES, MERGED_SHARES)
    )
    if not removed or not _enough(sample):
        return replace(scores, quality=None)
    order = np.argsort(values, kind="stable")
    if protected is not None:
        order = order[np.argsort(protected[order], kind="stable")]
    place = np.empty(len(order), np.int64)  # of each splat in the order of removal
    place[order] = np.arange(len(order))

    def gaining(number, rays):
        view, colors = sample.views[number][0], sample.colors(number, rays)
        truth, gains, place_of_hit = sample.truths[number], [], place[sample.splat_rows[rays.hit]]
        for count in merged:
            keep = place_of_hit >= count  # (u,)
            deleted = rays.keeping(keep).colors(colors)
            stood_in = rays.colors_by_nearest_kept(colors, keep)
            gains.append(psnr_of(stood_in, truth, view) - psnr_of(deleted, truth, view))
        return gains

    of_views, mean = _removing(sample, place, removed, part(progress, 0.0, 0.5))
    _, gains = _of_views(sample, gaining, sample.validating(), part(progress, 0.5, 1.0))
    psnr = np.minimum.accumulate(mean)
    names = [sample.views[number][0].name for number in sample.seeing()]
    curve = Quality(
        np.array(SHARES[: len(removed)]),
        psnr,
        merged_from(psnr, gains, len(values)),
        len(values) >= FEWEST,
        dict(zip(names, np.minimum.accumulate(of_views, axis=1), strict=True)),
        sample.hits_of_ray(),
    )
    between = scores.between if scores.tells else None
    if between is not None and _enough(between):
        _, mean = _removing(between, place, removed)
        curve = curve._replace(between=np.minimum.accumulate(mean))
    return replace(scores, quality=curve)


def psnr_against(
    sample: RaySample, splats: Splats, views: ViewSet, *, progress: Progress = silent
) -> float | None:
    """Estimated PSNR of other splats against those of a sample, dB; None if too little is seen."""
    gaussians, scene, _ = projection.prepare(splats, views, progress=part(progress, 0.0, 0.2))

    def compare(number, rays):
        view = sample.views[number][0]
        footprints = projection.project(gaussians, scene, view)
        other = cast(footprints, rays.columns, rays.rows)
        colors = colors_from(splats, gaussians.index[other.hit], view.center)
        if (truth := sample.truths.get(number)) is None:
            truth = sample.truths[number] = rays.colors(sample.colors(number, rays))
        return [psnr_of(other.colors(colors), truth, view)]

    if not _enough(sample):
        return None
    _, mean = _of_views(sample, compare, sample.validating(), part(progress, 0.2, 1.0))
    return float(mean[0])


def _enough(sample):
    """Whether enough rays of all views hit a splat."""
    return sum(len(rays.counts()) for rays in sample.rays if rays) >= MIN_RAYS_WITH_HITS


def _removing(sample, place, counts, progress=silent):
    """`_of_views`, dB, without splats whose place, (N,), is below each of L ascending counts."""
    places = place[sample.splat_rows]

    def compare(number, rays):
        view, colors = sample.views[number][0], sample.colors(number, rays)
        truth = sample.truths[number] = rays.colors(colors)
        psnr, place_of_hit = [], places.take(rays.hit)
        for count in counts:
            # What is removed stays removed: the lists of hits grow shorter.
            rays = rays.keeping(place_of_hit >= count)
            psnr.append(psnr_of(rays.colors(colors), truth, view))
        return psnr

    return _of_views(sample, compare, sample.seeing(), progress)


def _of_views(sample, compare, numbers, progress):
    """Results of ``compare(number, rays)`` for v views, (v, L), and their weighted mean, (L,).

    The mean of views in between is less by `DOUBT` standard errors.
    """

    def compare_one(number):
        return compare(number, sample.rays[number])

    values = np.array(run_all(compare_one, numbers, progress=progress, what="estimating"))
    weights = np.array([sample.views[number][1] for number in numbers])
    weights /= weights.sum()
    mean = weights @ values
    if sample.kind == "between":
        spread = np.square(weights) @ np.square(values - mean)
        mean -= DOUBT * np.sqrt(spread * len(weights) / max(len(weights) - 1, 1))
    return values, mean
