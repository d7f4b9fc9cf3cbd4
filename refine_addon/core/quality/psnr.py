"""The PSNR that views will have, from a sample of their pixels instead of whole pictures.

The rays of a `RaySample` tell the colours of their pixels exactly, with all splats and with some of
them removed. The mean squared difference over these pixels is an unbiased sample of that over the
picture, and nothing is assumed about which splats go together or what lies behind them.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import NDArray

from ..execute import Progress, chunks, part, run_all, silent
from ..splats import Splats
from ..views import View, ViewSet
from ..visibility import projection
from ..visibility.ray_sample import RaySample, cast_colored
from ..visibility.rays import Rays
from .curve import ABSORBED_SHARES, FEWEST, PSNR_CAP, SHARES, Quality, absorbed_from

Compare = Callable[[int, Rays], Sequence[float]]

MIN_RAYS_WITH_HITS = 256
"""So many rays must hit a splat at least, or nothing is estimated."""


def psnr_kept(
    sample: RaySample, keep: NDArray[np.bool_], *, threads: int | None = None
) -> float | None:
    """Return the estimated PSNR with only some splats kept, dB; None if too little is seen.

    Parameters
    ----------
    sample : RaySample
        Of all N splats.
    keep : (N,) bool
    threads : int, optional
    """
    psnr = _mean_after(sample, keep.astype(np.int64), [1], threads)
    return None if psnr is None else float(psnr[0])


def psnr_after(
    sample: RaySample,
    values: NDArray[np.float32],
    shares: Sequence[float] | NDArray[np.float64],
    *,
    protected: NDArray[np.bool_] | None = None,
    threads: int | None = None,
) -> NDArray[np.float64] | None:
    """Return the mean PSNR of all views with some shares removed, (L,), dB; None if little is seen.

    Parameters
    ----------
    sample : RaySample
        Of all N splats.
    values, protected
        See `quality_curve`.
    shares : (L,) float
        Ascending.
    threads : int, optional
    """
    counts = [math.floor(share * len(values)) for share in shares]
    return _mean_after(sample, _places(values, protected), counts, threads)


def quality_curve(
    sample: RaySample,
    values: NDArray[np.float32],
    *,
    protected: NDArray[np.bool_] | None = None,
    settled: int | None = None,
    progress: Progress = silent,
    threads: int | None = None,
) -> Quality | None:
    """Return the estimated PSNR at each of `quality.SHARES`; None if too little is seen.

    Parameters
    ----------
    sample : RaySample
        Of all N splats.
    values : (N,) float32
        The lowest are removed first; of equal ones the first in the file.
    protected : (N,) bool, optional
        Splats that are removed after all others.
    settled : int, optional
        How many splats are in their final order, see `Scores`: the curve ends there, and is None
        if that is before the first of its shares.
    progress : callable, optional
    threads : int, optional

    Raises
    ------
    Cancelled
        If `progress` answers ``False``.
    """
    last = len(values) if settled is None else settled
    if settled is not None and protected is not None:
        last -= int(np.count_nonzero(protected))
    removed, absorbed = (
        [count for share in shares if (count := math.floor(share * len(values))) <= last]
        for shares in (SHARES, ABSORBED_SHARES)
    )
    if not removed:
        return None
    place, views = _places(values, protected)[sample.splat_rows], sample.seeing()
    of_views = _of_each_view(
        sample, _removing(sample, place, removed), views, part(progress, 0.0, 0.5), threads
    )
    if of_views is None:
        return None
    validating = sample.validating()
    gains = _of_each_view(
        sample, _gaining(sample, place, absorbed), validating, part(progress, 0.5, 1.0), threads
    )
    assert gains is not None
    psnr = np.minimum.accumulate(_mean(sample, of_views, views))
    names = [sample.views[number][0].name for number in views]
    return Quality(
        np.array(SHARES[: len(removed)]),
        psnr,
        absorbed_from(psnr, _mean(sample, gains, validating), len(values)),
        len(values) >= FEWEST,
        dict(zip(names, np.minimum.accumulate(of_views, axis=1), strict=True)),
        sample.hits_of_ray(),
    )


def psnr_against(
    sample: RaySample,
    splats: Splats,
    views: ViewSet,
    *,
    progress: Progress = silent,
    threads: int | None = None,
) -> float | None:
    """Return the estimated PSNR with other splats instead, dB; None if too little is seen.

    Parameters
    ----------
    sample : RaySample
        Of the splats that are the truth.
    splats : Splats
        In the frame of the views.
    views : ViewSet
        Those of the sample.
    progress : callable, optional
    threads : int, optional

    Raises
    ------
    Cancelled
        If `progress` answers ``False``.
    """
    gaussians, scene, _ = projection.prepare(
        splats, views, progress=part(progress, 0.0, 0.2), threads=threads
    )

    def cast_again(number: int, rays: Rays) -> tuple[Rays, NDArray[np.float64]]:
        view = sample.views[number][0]
        footprints = projection.project(gaussians, scene, view)
        return cast_colored(splats, gaussians, footprints, view, rays.columns, rays.rows)

    return mean_psnr(sample, cast_again, part(progress, 0.2, 1.0), threads)


def mean_psnr(
    sample: RaySample,
    cast_again: Callable[[int, Rays], tuple[Rays, NDArray[np.float64]]],
    progress: Progress = silent,
    threads: int | None = None,
) -> float | None:
    """Return the mean PSNR, dB, of the pictures that other rays see; None if too little is seen.

    Parameters
    ----------
    sample : RaySample
        Of the splats that are the truth.
    cast_again : callable
        ``cast_again(number, rays)`` returns rays of view `number` through the same pixels, with
        what they hit now, and the colours of that, (3, u).
    progress : callable
    threads : int, optional
    """

    def compare(number: int, rays: Rays) -> list[float]:
        other, colors = cast_again(number, rays)
        truth = rays.colors(sample.colors(number, rays))
        return [psnr_of(other.colors(colors), truth, sample.views[number][0])]

    numbers = sample.validating()
    psnr = _of_each_view(sample, compare, numbers, progress, threads)
    return None if psnr is None else float(_mean(sample, psnr, numbers)[0])


def _mean_after(
    sample: RaySample, places: NDArray[np.int64], counts: Sequence[int], threads: int | None
) -> NDArray[np.float64] | None:
    """Return the mean PSNR of all views after each of L removals, (L,), dB.

    None if too little is seen. `places`, (N,), is that of each splat in the order of removal; see
    `_removing`.
    """
    views = sample.seeing()
    compare = _removing(sample, places[sample.splat_rows], counts)
    psnr = _of_each_view(sample, compare, views, silent, threads)
    return None if psnr is None else np.minimum.accumulate(_mean(sample, psnr, views))


def _removing(sample: RaySample, place: NDArray[np.int64], counts: Sequence[int]) -> Compare:
    """Return a function that gives the PSNR of one view after each of L removals, dB.

    `place`, (M,), is that of each of the Gaussians in the order of removal: those whose place is
    below one of the ascending `counts` are removed.
    """

    def compare(number: int, rays: Rays) -> list[float]:
        view, colors = sample.views[number][0], sample.colors(number, rays)
        truth, psnr = rays.colors(colors), []
        left, place_of_hit = rays, place.take(rays.hit)
        for count in counts:
            # What is removed stays removed: the lists of hits grow shorter.
            left = left.keeping(place_of_hit >= count)
            psnr.append(psnr_of(left.colors(colors), truth, view))
        return psnr

    return compare


def _gaining(sample: RaySample, place: NDArray[np.int64], counts: Sequence[int]) -> Compare:
    """Return a function that gives by how much the PSNR is higher if kept splats stand in.

    See `Rays.colors_by_nearest_kept`; parameters as `_removing`.
    """

    def compare(number: int, rays: Rays) -> list[float]:
        view, colors = sample.views[number][0], sample.colors(number, rays)
        truth, gains, place_of_hit = rays.colors(colors), [], place.take(rays.hit)
        for count in counts:
            keep = place_of_hit >= count  # (u,)
            deleted = rays.keeping(keep).colors(colors)
            stood_in = rays.colors_by_nearest_kept(colors, keep)
            gains.append(psnr_of(stood_in, truth, view) - psnr_of(deleted, truth, view))
        return gains

    return compare


def _of_each_view(
    sample: RaySample,
    compare: Compare,
    numbers: Sequence[int],
    progress: Progress,
    threads: int | None,
) -> NDArray[np.float64] | None:
    """Return what `compare` returns for each of v views, (v, L).

    None if too few rays of all views hit a splat.
    """
    if sample.hitting(range(len(sample.rays))) < MIN_RAYS_WITH_HITS:
        return None

    def compare_one(piece: slice) -> Sequence[float]:
        number = numbers[piece.start]
        rays = sample.rays[number]
        assert rays is not None
        with np.errstate(under="ignore"):
            return compare(number, rays)

    values = run_all(
        compare_one, chunks(len(numbers), 1), progress=progress, what="estimating", threads=threads
    )
    return np.array(values)


def _mean(
    sample: RaySample, values: NDArray[np.float64], numbers: Sequence[int]
) -> NDArray[np.float64]:
    """Return the mean of values of some views, (v, L), weighted as the views are, (L,)."""
    weights = np.array([sample.views[number][1] for number in numbers])
    return np.asarray(weights @ values / weights.sum())


def _places(
    values: NDArray[np.float32], protected: NDArray[np.bool_] | None = None
) -> NDArray[np.int64]:
    """Return the place of each of N splats in the order of removal, (N,); see `quality_curve`."""
    order = np.argsort(values, kind="stable")
    if protected is not None:
        order = order[np.argsort(protected[order], kind="stable")]
    place = np.empty(len(order), np.int64)
    place[order] = np.arange(len(order))
    return place


def psnr_of(colors: NDArray[np.float64], truth: NDArray[np.float64], view: View) -> float:
    """Return the PSNR of a view, dB, given the colours of its rays with other and all splats.

    The logarithm of a mean over few rays is too low on average: by half the square of the mean's
    relative error, to second order. This is corrected. The variance is that between neighbouring
    rays, so that differences between parts of the picture do not count as chance.

    Parameters
    ----------
    colors, truth : (3, P) float64
    view : View
    """
    errors = np.mean((colors - truth) ** 2, axis=0)
    mean, count = float(np.mean(errors)), len(errors)
    if mean <= 10.0 ** (-PSNR_CAP / 10.0):
        return PSNR_CAP
    unsampled = 1.0 - count / (view.width * view.height)  # with all pixels the mean is exact
    variance = float(np.sum(np.diff(errors) ** 2)) / 2.0 / max(count - 1, 1)
    relative = unsampled * variance / count / mean**2
    return min(-10.0 * math.log10(mean) - 5.0 / math.log(10.0) * relative, PSNR_CAP)
