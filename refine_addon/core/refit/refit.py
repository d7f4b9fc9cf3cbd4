"""Refitting: kept splats learn the colours that the unpruned splats have on rays.

Rounds, each on other rays, minimize ``|G x - d|^2 + sum_p (k (D_p + m_p) + K_p) x_p^2`` (Levenberg,
Marquardt; docs/method.md, section 12): x changes of parameters, G derivatives of colours, d
differences of colours, D the diagonal of G'G, m its medians, K the sum of D over earlier rounds. A
round that loses on validation rays, which nothing is learned from, is undone, and the last. Splats
in files are refitted box by box, amid the others, which do not change.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..errors import RefineError
from ..execute import Progress, chunks, in_file, part, run_all, seconds, silent, stages
from ..mapped import divided, folder_of, in_one, in_regions, new_folder, note, noted, on_disk
from ..spherical_harmonics import LARGEST
from ..splats import Splats, rotation_matrices, unit_quaternions
from ..views import View, ViewSet
from ..visibility import projection
from ..visibility.projection import Footprints, Gaussians
from .linear import COLOR, COUNT, DEGREE_1, MEAN, OPACITY, SCALE, TURN, Singles
from .round_rays import RoundRays, Target, Window, limits, steps_of

STEPS = 8  # of conjugate gradients in a round

DAMPING, LEAST_DAMPING = 4.0, 0.1
"""k is `DAMPING` over the rays for each kept splat, but at least the other: colours are linear in
the parameters only near by."""

CARRIED = 0.5  # part of the gradient G'd left by a round that counts in the next

MAX_ROUNDS, ENOUGH_RAYS = 4, (5, 400_000, 1_500_000)
"""Default rounds, fewer after so many rays for each kept splat, but at least and at most the others
in all: of millions of splats a round takes as long as merging."""

MOST_ROUNDS = 100  # limit of the option; after some ten none gains
LEAST_GAIN = 0.05  # dB on validation rays; rounds end below

ONE_PLACE = "nothing was refitted: what fits views in one place looks worse from others"
"""If no view can move (`round_rays.steps_of`), validation rays start where those of the rounds do:
by them one view gains 9 dB, where others gain -0.6 to 0.5 dB."""

MAX_STEP = {"color": 0.5, "opacity": 1.0, "mean": 0.5, "scale": 0.3, "turn": 0.3}
"""Largest change of a parameter in a round, in units as in `linear`; of means in longest scales."""

LEAST_MOVE = 0.02  # longest scales; shorter moves of means are left out, see `_worthwhile`

SHARE = 0.5
"""Kept splats of a region over `mapped.REGION`: each takes twice the memory of one that merges."""

_FIRST = 0.1  # share of progress until the first round
_CASTING, _SOLVED = 0.35, 0.9  # share of a round's progress when its rays are cast, and solved
_SAMPLE = 1 << 12  # splats of a region that tell where it is in each view
_EDGE = 0.005  # share of them that may lie outside on each side
_CHUNK = 1 << 14  # splats changed at a time
_NOTHING = 1e-30  # least of D from which a parameter changes; 1 over it is a float32


@dataclass(frozen=True, eq=False)
class Refitted:
    """N kept splats after some rounds."""

    splats: Splats  # as they are now
    changed: NDArray[np.bool_]  # (N,); all others keep their bits
    rounds: int
    psnr_before: float  # dB on validation rays, of the splats as given
    psnr: float  # now
    why_not: str = "refitting gains nothing on rays that nothing was fitted to"

    def facts(self, seconds: float) -> dict[str, float]:
        """The numbers for a report."""
        return {
            "rounds": self.rounds,
            "changed": int(np.count_nonzero(self.changed)),
            "psnr_before": round(self.psnr_before, 2),
            "psnr": round(self.psnr, 2),
            "seconds": round(seconds, 2),
        }

    def note(self, seconds: float) -> str:
        """The numbers as a sentence, for the user."""
        sentence = (
            "{changed:,} kept splats were refitted in {rounds} rounds: {psnr_before:.1f} -> "
            "{psnr:.1f} dB on rays that nothing was fitted to, {seconds:.1f} s"
        )
        return sentence.format(**self.facts(seconds)) if self.rounds else self.why_not


def check_rounds(rounds: int | None) -> None:
    """Raise `RefineError` if `rounds` is neither None nor 1 to `MOST_ROUNDS`."""
    if rounds is not None and not 1 <= rounds <= MOST_ROUNDS:
        raise RefineError(f"rounds is {rounds}, expected 1 to {MOST_ROUNDS}")


def expected_rounds(count: int, rounds: int | None = None) -> int:
    """Rounds that refitting `count` splats takes if all of them gain."""
    return rounds or min(math.ceil(_enough(count) / limits(count)[0]), MAX_ROUNDS)


def _enough(count):
    return float(np.clip(ENOUGH_RAYS[0] * count, *ENOUGH_RAYS[1:]))


def refit_rounds(
    splats: Splats,
    original: Splats,
    views: ViewSet,
    rounds: int | None = None,
    *,
    protected: NDArray[np.bool_] | None = None,
    progress: Progress = silent,
) -> Iterator[Refitted]:
    """Yield kept splats as they are, and after each round that gains on validation rays.

    `rounds` are the most (RefineError if out of range); by default they also end after
    `ENOUGH_RAYS`. `protected` splats do not change. Memory: 1,300 to 1,800 bytes a kept splat, of
    all processes, at millions; a temporary file takes 14 bytes a hit (`round_rays.limits`).
    """
    check_rounds(rounds)
    if in_regions(original, len(original)) and in_regions(original, 2 * len(splats)):
        yield from _by_regions(splats, original, views, rounds, protected, progress)
        return
    rays = RoundRays.of(original, views, len(splats), part(progress, 0.0, 0.03))
    later = part(progress, 0.03, 1.0)
    yield from refit_on(rays, splats, rounds, protected=protected, progress=later)


def refit_on(
    rays: RoundRays,
    splats: Splats,
    rounds: int | None = None,
    *,
    protected: NDArray[np.bool_] | None = None,
    progress: Progress = silent,
) -> Iterator[Refitted]:
    """Refit as `refit_rounds` does, on given rays."""
    count = len(splats)
    moving = np.ones(COUNT, np.bool_)
    moving[DEGREE_1] = splats.sh_rest.shape[1] > 0
    moving[SCALE.stop - 1] &= splats.model != "2dgs"  # discs have no third scale
    fixed = np.zeros(count, np.bool_) if protected is None else protected
    movable = moving[:, None] & ~fixed
    ahead, cast, done = expected_rounds(count, rounds), 0, _FIRST
    enough = np.inf if rounds else _enough(count)
    psnr = rays.psnr(splats, part(progress, 0.0, done))
    best = Refitted(splats, np.zeros(count, np.bool_), 0, psnr, psnr)
    if not any(window.step for window in rays.windows):
        yield replace(best, why_not=ONE_PLACE)
        return
    yield best
    before = np.zeros((2, COUNT, count), np.float32)
    for number in range(1, (rounds or MAX_ROUNDS) + 1):
        start, done = done, done + (1.0 - done) / max(ahead - number + 1, 1)
        share = part(progress, start, done)
        linear = rays.linear(best.splats, number, part(share, 0.0, _CASTING))
        cast += linear.count
        if not rounds:
            ahead = max(min(math.ceil(enough * number / cast), MAX_ROUNDS), number)
        damping = max(DAMPING * count / linear.count, LEAST_DAMPING)
        solving = part(share, _CASTING, _SOLVED)
        change = _solve(linear, movable, damping, before, solving)
        index, learned = linear.shapes.gaussians.index, (linear.diagonal, linear.residual)
        del linear  # the hits, before those of the next round
        if not change.any():
            return
        _worthwhile(change)
        trial = in_file(_moved(best.splats, change))
        psnr = rays.psnr(trial, part(share, _SOLVED, 1.0))
        gain = psnr - best.psnr
        if gain <= 0.0:
            return
        changed = best.changed | change.any(axis=0)
        best = Refitted(trial, changed, best.rounds + 1, best.psnr_before, psnr)
        yield best
        if gain < LEAST_GAIN or cast >= enough:
            return
        before = before * np.array([[[1.0]], [[CARRIED]]], np.float32)
        for k in np.flatnonzero(moving):
            for total, of_round in zip(before, learned, strict=True):
                total[k, index] += of_round[k]
        before = in_file(before)
        del learned, change


def _solve(linear, movable, damping, before, progress):
    """Change of the parameters, (22, N), by a few steps of conjugate gradients from 0.

    `linear.residual` becomes the gradient that is left, less the damping by K. Rows are changed one
    by one: all at a time take 88 bytes a splat.
    """
    index, diagonal, residual = linear.shapes.gaussians.index, linear.diagonal, linear.residual
    rows, moving = np.flatnonzero(movable.any(axis=1)), movable[:, index]
    medians = np.ones(COUNT, np.float32)
    change, direction = np.zeros((2, *diagonal.shape), np.float32)
    size = 0.0

    def curvature(k):
        damped = diagonal[k] + np.float32(damping) * (diagonal[k] + medians[k])
        return damped + before[0][k, index]

    for k in rows:
        moving[k] &= diagonal[k] > _NOTHING
        residual[k] += np.float32(CARRIED) * before[1][k, index]
        residual[k] *= moving[k]
        if moving[k].any():  # splats that rays hit
            medians[k] = np.median(diagonal[k, moving[k]])
        direction[k] = residual[k] / curvature(k)
        size += _dot(residual[k], direction[k])
    for step in range(STEPS):
        if size <= 0.0:
            break
        image = linear.normal(direction, part(progress, step / STEPS, (step + 1) / STEPS))
        along, later = 0.0, 0.0
        for k in rows:
            image[k] *= moving[k]
            image[k] += (curvature(k) - diagonal[k]) * direction[k]
            along += _dot(direction[k], image[k])
        for k in rows:
            change[k] += np.float32(size / along) * direction[k]
            residual[k] -= np.float32(size / along) * image[k]
            later += _dot(residual[k], residual[k] / curvature(k))
        for k in rows:
            direction[k] *= np.float32(later / size)
            direction[k] += residual[k] / curvature(k)
        size = later
        del image
    del direction
    result = np.zeros(movable.shape, np.float32)
    for k in rows:
        result[k, index] = change[k]
        residual[k] += np.float32(damping) * (diagonal[k] + medians[k]) * change[k]
    return result


def _dot(one: Singles, other: Singles) -> float:
    return float(np.sum(one * other, dtype=np.float64))


def _worthwhile(change: Singles) -> None:
    """Shorten the moves of means in a change, (22, N) (Breiman's garrote).

    A move can swap splats in depth, which no derivative shows: the squared error grows with the
    move, the gain with its square.
    """
    means = change[MEAN]
    squared = np.maximum(np.square(means).sum(axis=0), np.float32(_NOTHING))
    means *= np.maximum(np.float32(1.0) - np.float32(LEAST_MOVE**2) / squared, np.float32(0.0))


def _moved(splats: Splats, change: NDArray[np.floating[Any]]) -> Splats:
    """Splats with changed parameters; those that do not change keep their bits."""
    result = splats.take(np.arange(len(splats)))
    for piece in chunks(len(splats), _CHUNK):
        _move(result.take(piece), change[:, piece])
    return result


def _move(splats, change):
    """Change parameters in place."""
    rows = np.flatnonzero(change.any(axis=0))
    some, change = splats.take(rows), change[:, rows].astype(np.float64)
    quaternions = unit_quaternions(some.quaternions)
    logs = some.log_scales.astype(np.float64)
    longest = np.exp(logs.max(axis=1))
    along = _limited(change[MEAN], MAX_STEP["mean"]).T  # the axes of the splats
    step = np.einsum("nij,nj->ni", rotation_matrices(quaternions), along) * longest[:, None]
    limit = MAX_STEP["color"]
    values = {
        "means": some.means + step,
        "log_scales": logs + change[SCALE].T.clip(-MAX_STEP["scale"], MAX_STEP["scale"]),
        "quaternions": _product(quaternions, _limited(change[TURN], MAX_STEP["turn"])),
        "opacity_logits": some.opacity_logits
        + change[OPACITY][0].clip(-MAX_STEP["opacity"], MAX_STEP["opacity"]),
        "sh_dc": some.sh_dc + change[COLOR].T.clip(-limit, limit),
    }
    if splats.sh_rest.shape[1]:
        by_channel = change[DEGREE_1].reshape(3, 3, -1).swapaxes(0, 1)
        steps = [_limited(each, limit).T for each in by_channel]  # (n, 3) each
        values["sh_rest"] = some.sh_rest.copy()
        # In float32, since that is what blended harmonics are in memory, but not in tiles.
        learned = some.sh_rest[:, :3].clip(-LARGEST, LARGEST).astype(np.float32)
        values["sh_rest"][:, :3] = (learned + np.stack(steps, axis=2)).astype(np.float32)
    for name, new in values.items():
        getattr(splats, name)[rows] = new


def _limited(vectors: NDArray[np.float64], longest: float) -> NDArray[np.float64]:
    lengths = np.linalg.norm(vectors, axis=0)
    return np.asarray(vectors * np.minimum(1.0, longest / np.maximum(lengths, longest)))


def _product(quaternions: NDArray[np.float64], turns: NDArray[np.float64]) -> NDArray[np.float64]:
    """Unit quaternions, (n, 4), of splats that are turned about their own axes first."""
    angle = np.linalg.norm(turns, axis=0)
    sine = 0.5 * np.sinc(angle / (2.0 * np.pi))  # sin(angle / 2) / angle
    w, x, y, z = quaternions.T
    a, (b, c, d) = np.cos(angle / 2.0), sine * turns
    return np.stack(
        [
            w * a - x * b - y * c - z * d,
            w * b + x * a + y * d - z * c,
            w * c - x * d + y * a + z * b,
            w * d + x * c - y * b + z * a,
        ],
        axis=1,
    )


def _by_regions(kept, original, views, rounds, protected, progress):
    """Yield kept splats before and, if that is better, after all regions are refitted."""
    count, folder = len(kept), new_folder(original)
    cost = seconds("refit", count, len(views))
    preparing, before, refitting, after = stages(progress, 0.1 * cost, 0.1 * cost, cost, 0.1 * cost)
    if folder_of(kept) is None:
        kept = on_disk(new_folder(original), [kept])
    rays = RoundRays.of(original, views, count, preparing)
    psnr = rays.psnr(kept, before)
    yield Refitted(kept, np.zeros(count, np.bool_), 0, psnr, psnr)
    fixed = np.zeros(count, np.bool_) if protected is None else protected
    boxes = divided(kept.means[...], SHARE)
    for number, rows in enumerate(boxes):
        note(folder, f"rows-{number}", (rows, fixed[rows]))
    every = rays.target(kept, silent)
    work = partial(_refit_region, folder, views, rounds, rays.original, every)
    refitted = run_all(work, range(len(boxes)), progress=refitting, what="refitting", threads=1,
                       cost=cost)  # fmt: skip
    changed, numbers, regions = zip(*refitted, strict=True)
    splats, order = in_one(folder, regions, boxes)
    better = rays.psnr(splats, after)
    if better > psnr:
        yield Refitted(splats, np.concatenate(changed)[order], max(numbers), psnr, better)


def _refit_region(folder, views, rounds, original, kept, number):
    """Refit the splats of a region amid all others: changed, rounds, splats."""
    rows, protected = noted(folder, f"rows-{number}")[1]
    others = np.ones(len(kept.splats), np.bool_)
    others[rows] = False
    splats = kept.splats.take(rows)
    done = Refitted(splats, np.zeros(len(rows), np.bool_), 0, 0.0, 0.0)
    windows = _windows(splats, len(others), original.scene, views.by_distance())
    if windows:
        amid = partial(_Amid.of, every=kept, others=others[kept.gaussians.index[...]])
        rays = RoundRays(windows, original, amid)
        *_, done = refit_on(rays, splats, rounds, protected=protected)
    return done.changed, done.rounds, on_disk(folder / f"region-{number}", [done.splats])


@dataclass(frozen=True, eq=False)
class _Amid(Target):
    """What rays hit: the splats of a region, which change, amid all others."""

    every: Target  # of all regions
    others: NDArray[np.bool_]  # (M,), which of the Gaussians of all are not of the region

    def footprints(self, window: Window) -> Footprints:
        """Footprints in a window; those of the region have the first numbers."""
        both = _Both(**vars(self.gaussians), every=self.every.gaussians, others=self.others)
        return projection.project(both, self.scene, window.view, window.part)

    def colors(self, hit: NDArray[np.int64], view: View) -> Singles:
        count = len(self.gaussians)
        mine = int(np.searchsorted(hit, count))
        parts = [super().colors(hit[:mine], view), self.every.colors(hit[mine:] - count, view)]
        return np.concatenate(parts, axis=1)


@dataclass(frozen=True, eq=False, kw_only=True)
class _Both(Gaussians):
    """The Gaussians of a region, then all others, as `project` reads them."""

    every: Gaussians
    others: NDArray[np.bool_]

    def most(self, *seen: Any) -> int:
        return len(self) + self.every.most(*seen)

    def parts(self, *seen: Any) -> Iterator[tuple[int, Gaussians]]:
        yield 0, self
        for first, chunk in self.every.parts(*seen):
            there = self.others[first : first + len(chunk)]
            hidden = np.where(there, chunk.largest, np.float32(np.nan))  # which reaches nowhere
            yield first + len(self), replace(chunk, largest=hidden)


def _windows(splats, total, scene, views):
    """Windows of the views that show a region, weighted by how much of it they show."""
    sample = splats.take(slice(None, None, max(len(splats) // _SAMPLE, 1)))
    only = [view for view, _ in views]
    gaussians, _, _ = projection.prepare(sample, ViewSet(tuple(only)), scene)
    boxes = {}
    for number, view in enumerate(only):
        footprints = projection.project(gaussians, scene, view)
        centers = footprints.centers[:, footprints.inside]
        if centers.shape[1]:
            boxes[number] = centers.shape[1], _box(centers, view)
    shown = sum(count for count, _ in boxes.values())
    rays, hits = limits(total)[0] / len(views), limits(len(splats))[1]
    steps, windows = steps_of(only, scene), []
    for number, (count, box) in boxes.items():
        (view, weight), share = views[number], count / shown
        rays_here = rays * (box[2] * box[3] / (view.width * view.height))
        counts = weight * share, rays_here, hits * share
        windows.append(Window(view, number, *counts, box, steps[number]))
    return windows


def _box(centers, view):
    """Left, top, width and height, at least 1 px, of where most points, (2, n), lie."""
    low, high = np.quantile(centers, (_EDGE, 1.0 - _EDGE), axis=1)
    size = np.array([view.width, view.height])
    first = np.floor(low).astype(np.int64).clip(0, size - 1)
    end = np.ceil(high).astype(np.int64).clip(first + 1, size)
    return (*first.tolist(), *(end - first).tolist())
