"""Refitting: kept splats learn the colours that the unpruned splats have on rays.

Deleting and merging leave kept splats with the numbers that they had, or that one merge at a time
gave them. On rays it is known what the unpruned splats look like, and how the colours change with
every parameter of the kept splats (`linear`). So in rounds, each on rays through other pixels, the
squared difference of colours is made small by damped least squares (Levenberg, Marquardt)::

    minimise over x   |J x - r|^2  +  sum over parameters p of  (k (D_p + m_p) + K_p) x_p^2

r is the difference on all rays, in which large ones count less (`linear.HUBER`), D the diagonal of
J'J, m_p the median of D over all splats that are hit, for each kind of parameter, and K the sum of
D over the rounds before. So what few rays tell of a splat moves it little, and rounds together
learn from the rays of all of them, not from the last alone: each has a share in what a parameter
becomes. The sum is made small by a few steps of conjugate gradients, preconditioned by the
diagonal. What these and the damping leave of J'r, half of it is added to that of the next round.

k is `DAMPING` over how many rays there are for each kept splat: the more rays, the less damping.

Validation rays, which nothing is learned from, compare kept splats before and after a round. One
that loses is undone, and the next is damped more. Rounds end where little is gained, or after many
rays.

Splats in files, too many for memory, are divided into boxes of about equally many. Each box is
refitted by itself; splats of other regions are drawn as they are, in front and behind, and do not
change.
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
from ..execute import Progress, part, run_all, seconds, silent, stages
from ..mapped import divided, folder_of, in_one, in_regions, look, new_folder, note, noted, on_disk
from ..splats import Splats, rotation_matrices, unit_quaternions
from ..views import View, ViewSet
from ..visibility import projection
from ..visibility.projection import Footprints, Gaussians
from .linear import COLOR, COUNT, DEGREE_1, MEAN, OPACITY, SCALE, TURN, Singles
from .round_rays import LARGEST, RoundRays, Target, Window, limits, steps_of

STEPS = 8
"""Steps of conjugate gradients in a round."""

DAMPING, LEAST_DAMPING = 4.0, 0.1
"""Damping counts as so many rays for each kept splat: k is this over how many there are, but at
least so much, as colours change with parameters in straight lines near by alone."""

CARRIED = 0.5
"""How much of what a round leaves of J'r counts in the next one."""

MORE_DAMPING = 8.0
"""Factor of k after a round that lost; see the top of this file."""

MAX_ROUNDS, ENOUGH_RAYS = 4, (5, 400_000)
"""By default there are so many rounds, and fewer where these have had so many rays for each
kept splat and so many in all: of large scenes each round takes as long as merging."""

MOST_ROUNDS = 100
"""No more may be asked for: after some ten none gains."""

LEAST_GAIN = 0.05
"""Rounds end where the PSNR of the validation rays rises by less, dB."""

ONE_PLACE = "nothing was refitted: what fits views in one place looks worse from others"
"""What is said where no view can move (`round_rays.steps_of`). Validation rays begin where those of
the rounds do, and cannot tell: one view gains 9 dB by them, and in others -0.6 to 0.5 dB."""

MAX_STEP = {"color": 0.5, "opacity": 1.0, "mean": 0.5, "scale": 0.3, "turn": 0.3}
"""How far a parameter moves in a round: as `linear` has them, means by the longest scale."""

LEAST_MOVE = 0.02
"""A mean that would move by less in a round stays, in longest scales; see `_worthwhile`."""

SHARE = 0.5
"""Kept splats of a region, in `mapped.REGION`: one takes twice the memory of one that merges."""

_FIRST = 0.1  # share of progress until the first round
_CASTING, _SOLVED = 0.35, 0.9  # of that of a round
_SAMPLE = 1 << 12  # splats of a region that tell where it is in each view
_EDGE = 0.005  # share of them that may lie outside on each side
_NOTHING = 1e-30  # rays that tell less of a parameter tell nothing; 1 over it is a float32


@dataclass(frozen=True, eq=False)
class Refitted:
    """What some rounds have made of N kept splats.

    Attributes
    ----------
    splats : Splats
        As they are now.
    changed : (N,) bool
        Which of them may not be what they were; all others are equal to the bit.
    rounds : int
        How many rounds made them so.
    psnr_before, psnr : float
        Of the splats as given, and as they are now, dB, on rays that nothing was learned from.
    why_not : str
        Why there was no round that made them better, for the user.
    """

    splats: Splats
    changed: NDArray[np.bool_]
    rounds: int
    psnr_before: float
    psnr: float
    why_not: str = "refitting gains nothing on rays that nothing was fitted to"

    def facts(self, seconds: float) -> dict[str, float]:
        """The same for a report, with how long it took."""
        return {
            "rounds": self.rounds,
            "changed": int(np.count_nonzero(self.changed)),
            "psnr_before": round(self.psnr_before, 2),
            "psnr": round(self.psnr, 2),
            "seconds": round(seconds, 2),
        }

    def note(self, seconds: float) -> str:
        """The same as a sentence, for the user."""
        told = (
            "{changed:,} kept splats were refitted in {rounds} rounds: {psnr_before:.1f} -> "
            "{psnr:.1f} dB on rays that nothing was fitted to, {seconds:.1f} s"
        )
        return told.format(**self.facts(seconds)) if self.rounds else self.why_not


def check_rounds(rounds: int | None) -> None:
    """Raise `RefineError` if so many rounds cannot be asked for; None leaves it open."""
    if rounds is not None and not 1 <= rounds <= MOST_ROUNDS:
        raise RefineError(f"rounds is {rounds}, expected 1 to {MOST_ROUNDS}")


def expected_rounds(count: int, rounds: int | None = None) -> int:
    """How many rounds it takes to refit so many splats if all of them gain.

    Parameters
    ----------
    count : int
    rounds : int, optional
        So many, if given.
    """
    enough = max(ENOUGH_RAYS[0] * count, ENOUGH_RAYS[1])
    return rounds or min(math.ceil(enough / limits(count)[0]), MAX_ROUNDS)


def refit(*arguments: Any, **options: Any) -> Refitted:
    """What `refit_rounds` yields last."""
    *_, last = refit_rounds(*arguments, **options)
    return last


def refit_rounds(
    splats: Splats,
    original: Splats,
    views: ViewSet,
    rounds: int | None = None,
    *,
    protected: NDArray[np.bool_] | None = None,
    progress: Progress = silent,
    threads: int | None = None,
) -> Iterator[Refitted]:
    """Yield kept splats as they are, and after each round that gains.

    Parameters
    ----------
    splats : Splats
        N kept splats, in the frame and unit of the views.
    original : Splats
        The unpruned splats, in the same frame.
    views : ViewSet
        All of them are used.
    rounds : int, optional
        At most so many, up to `MOST_ROUNDS`; by default see `MAX_ROUNDS`. They end before where
        little is gained.
    protected : (N,) bool, optional
        Kept splats that do not change.
    progress : callable, optional
        See `refine_addon.core.execute.Progress`.
    threads : int, optional

    Yields
    ------
    Refitted
        Never below what it began with, on rays that nothing was learned from.

    Raises
    ------
    RefineError
        If `rounds` is out of range.
    Cancelled
        If `progress` answers ``False``.

    Notes
    -----
    Memory: about 900 bytes a kept splat. 14 bytes for each hit of a round, see `round_rays.limits`,
    lie in a temporary file.
    """
    check_rounds(rounds)
    if in_regions(original, len(original)) and in_regions(original, 2 * len(splats)):
        yield from _by_regions(splats, original, views, rounds, progress, threads)
        return
    rays = RoundRays.of(original, views, len(splats), part(progress, 0.0, 0.03), threads)
    later = part(progress, 0.03, 1.0)
    yield from refit_on(rays, splats, rounds, protected=protected, progress=later, threads=threads)


def refit_on(
    rays: RoundRays,
    splats: Splats,
    rounds: int | None = None,
    *,
    protected: NDArray[np.bool_] | None = None,
    progress: Progress = silent,
    threads: int | None = None,
) -> Iterator[Refitted]:
    """Yield what `refit_rounds` does, of some rays."""
    count = len(splats)
    moving = np.ones(COUNT, np.bool_)
    moving[DEGREE_1] = splats.sh_rest.shape[1] > 0
    moving[SCALE.stop - 1] &= splats.model != "2dgs"  # discs have no third scale
    fixed = np.zeros(count, np.bool_) if protected is None else protected
    movable = moving[:, None] & ~fixed
    ahead, cast, done = expected_rounds(count, rounds), 0, _FIRST
    enough = np.inf if rounds else max(ENOUGH_RAYS[0] * count, ENOUGH_RAYS[1])
    psnr = rays.psnr(splats, part(progress, 0.0, done))
    best = Refitted(splats, np.zeros(count, np.bool_), 0, psnr, psnr)
    if not any(window.step for window in rays.windows):
        yield replace(best, why_not=ONE_PLACE)
        return
    yield best
    before = np.zeros((2, COUNT, count), np.float32)
    more, undone = 1.0, False
    for number in range(1, (rounds or MAX_ROUNDS) + 1):
        start, done = done, done + (1.0 - done) / max(ahead - number + 1, 1)
        of_round = part(progress, start, done)
        linear = rays.linear(best.splats, number, part(of_round, 0.0, _CASTING))
        cast += linear.count
        if not rounds:
            ahead = max(min(math.ceil(enough * number / cast), MAX_ROUNDS), number)
        damping = more * max(DAMPING * count / linear.count, LEAST_DAMPING)
        solving = part(of_round, _CASTING, _SOLVED)
        change, told = _solve(linear, movable, damping, before, progress=solving, threads=threads)
        del linear  # the hits, before those of the next round
        if not change.any():
            return
        change = _worthwhile(change)
        trial = _moved(best.splats, change)
        psnr = rays.psnr(trial, part(of_round, _SOLVED, 1.0))
        gain = psnr - best.psnr
        if gain > 0.0:
            before, changed = told, best.changed | change.any(axis=0)
            best = Refitted(trial, changed, best.rounds + 1, best.psnr_before, psnr)
            yield best
            if gain < LEAST_GAIN or cast >= enough:
                return
        elif undone:
            return
        else:
            more, undone = more * MORE_DAMPING, True


def _solve(linear, movable, damping, before, *, progress, threads):
    """By how much to change the parameters of N splats, (22, N), and what rays told.

    Like what they told `before` that is K, (22, N), and what is left of J'r, (22, N).
    """
    index = linear.shapes.gaussians.index
    moving = movable[:, index]
    steps = [part(progress, k / STEPS, (k + 1) / STEPS) for k in range(STEPS)]
    residual = linear.residual + np.float32(CARRIED) * before[1][:, index]
    residual *= moving
    diagonal = linear.diagonal * moving
    # The median over splats of what rays tell, 1 where they tell nothing.
    medians = [np.median(row[row > 0.0]) if row.any() else 1.0 for row in diagonal]
    prior = np.float32(damping) * (diagonal + np.array(medians, np.float32)[:, None])
    damped = prior + before[0][:, index]
    inverse = np.divide(
        1.0, diagonal + damped, out=np.zeros_like(damped), where=diagonal > _NOTHING
    )

    def product(direction, step):
        result = linear.normal(direction, step, threads)
        result *= moving
        result += damped * direction
        return result

    change, residual = _conjugate_gradients(product, residual, inverse, steps)
    prior *= change
    residual += prior
    result = np.zeros(movable.shape, np.float32)
    told = before[0].copy(), np.float32(CARRIED) * before[1]
    for row, values in enumerate(zip(change, diagonal, residual, strict=True)):
        result[row, index] = values[0]
        told[0][row, index] += values[1]
        told[1][row, index] = values[2]
    return result, told


def _conjugate_gradients(product, residual, inverse, steps):
    """About the solution x of ``product(x) = residual``, by a few steps from 0.

    And what it leaves of the residual.
    """
    solution = np.zeros_like(residual)
    direction = inverse * residual
    before = _dot(residual, direction)
    for step in steps:
        if before <= 0.0:
            break
        image = product(direction, step)
        length = np.float32(before / _dot(direction, image))
        solution += length * direction
        image *= length
        residual = np.subtract(residual, image, out=image)
        preconditioned = inverse * residual
        after = _dot(residual, preconditioned)
        direction *= np.float32(after / before)
        direction += preconditioned
        before = after
    return solution, residual


def _dot(one: Singles, other: Singles) -> float:
    """The inner product of two arrays, (22, N), summed in float64."""
    return float(sum(np.sum(a * b, dtype=np.float64) for a, b in zip(one, other, strict=True)))


def _worthwhile(change: Singles) -> Singles:
    """A change in which means move only where that is worth it, (22, N).

    Splats are drawn in the order of their means, and each move puts some behind others that were
    behind them, which no derivative tells of. The squared error that costs grows in proportion to
    the move, what a move gains with its square. So those shorter than `LEAST_MOVE` are left out,
    and others are shortened by less the longer they are (Breiman's garrote)::

        m <- m max(1 - (LEAST_MOVE / |m|)^2, 0)
    """
    means = change[MEAN]
    squared = np.maximum(np.square(means).sum(axis=0), np.float32(_NOTHING))
    kept = np.maximum(np.float32(1.0) - np.float32(LEAST_MOVE**2) / squared, np.float32(0.0))
    result = change.copy()
    result[MEAN] = means * kept
    return result


def _moved(splats: Splats, change: NDArray[np.floating[Any]]) -> Splats:
    """Splats with changed parameters; those that do not change keep their bits."""
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
    arrays = {}
    for name, new in values.items():
        arrays[name] = getattr(splats, name).copy()
        arrays[name][rows] = new
    return replace(splats, **arrays)


def _limited(vectors: NDArray[np.float64], longest: float) -> NDArray[np.float64]:
    """Vectors, (3, n), no longer than a length."""
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


def _by_regions(kept, original, views, rounds, progress, threads):
    """Yield kept splats before and, if that is better, after all regions are refitted."""
    count, folder = len(kept), new_folder(original)
    cost = seconds("refit", count, len(views))
    preparing, before, refitting, after = stages(progress, 0.1 * cost, 0.1 * cost, cost, 0.1 * cost)
    if folder_of(kept) is None:
        kept = on_disk(new_folder(original), [kept])
    rays = RoundRays.of(original, views, count, preparing, threads)
    psnr = rays.psnr(kept, before)
    yield Refitted(kept, np.zeros(count, np.bool_), 0, psnr, psnr)
    boxes = divided(kept.means[...], SHARE)
    for number, rows in enumerate(boxes):
        note(folder, f"rows-{number}", rows)
    work = partial(
        _refit_region, folder, views, rounds, rays.original, rays.target(kept, silent), threads
    )
    made = run_all(work, range(len(boxes)), progress=refitting, what="refitting", threads=1,
                   cost=cost)  # fmt: skip
    changed, numbers, regions = zip(*made, strict=True)
    splats, order = in_one(folder, regions, boxes)
    better = rays.psnr(splats, after)
    if better > psnr:
        yield Refitted(splats, np.concatenate(changed)[order], max(numbers), psnr, better)


def _refit_region(folder, views, rounds, original, kept, threads, number):
    """Refit the splats of a region amid all others: which changed, in how many rounds, and they."""
    rows = noted(folder, f"rows-{number}")[1]
    others = np.ones(len(kept.splats), np.bool_)
    others[rows] = False
    splats = kept.splats.take(rows)
    done = Refitted(splats, np.zeros(len(rows), np.bool_), 0, 0.0, 0.0)
    windows = _windows(splats, len(others), original.scene, views.by_distance())
    if windows:
        amid = partial(_Amid, every=kept, others=others[kept.gaussians.index[...]])
        rays = RoundRays(windows, original, threads, amid)
        *_, done = refit_on(rays, splats, rounds, progress=look, threads=threads)
    return done.changed, done.rounds, on_disk(folder / f"region-{number}", [done.splats])


@dataclass(frozen=True, eq=False)
class _Amid(Target):
    """The splats of a region amid all others, for rays to hit."""

    every: Target  # of all regions
    others: NDArray[np.bool_]  # (M,), which of the Gaussians of all are not of the region

    def __getstate__(self) -> dict[str, Any]:
        return {**super().__getstate__(), "every": self.every, "others": self.others}

    def footprints(self, window: Window) -> Footprints:
        """Footprints in a window; those of the region have the first numbers."""
        both = _Both(**vars(self.gaussians), every=self.every.gaussians, others=self.others)
        return projection.project(both, self.scene, window.view, window.part)

    def colors(self, hit: NDArray[np.int64], view: View) -> Singles:
        """Colours in which a view sees some of the Gaussians, ascending, (3, u)."""
        count = len(self.gaussians)
        mine = int(np.searchsorted(hit, count))
        parts = [super().colors(hit[:mine], view), self.every.colors(hit[mine:] - count, view)]
        return np.concatenate(parts, axis=1)


@dataclass(frozen=True, eq=False, kw_only=True)
class _Both(Gaussians):
    """The Gaussians of a region and, behind them, all but these, as far as `project` asks."""

    every: Gaussians
    others: NDArray[np.bool_]

    def parts(self, *seen: Any) -> Iterator[tuple[int, Gaussians]]:
        """See `Gaussians.parts`."""
        yield 0, self
        for first, chunk in self.every.parts(*seen):
            there = self.others[first : first + len(chunk)]
            hidden = np.where(there, chunk.largest, np.float32(np.nan))  # which reaches nowhere
            yield first + len(self), replace(chunk, largest=hidden)


def _windows(splats, total, scene, views):
    """Windows of the views, with their weights, that show a region.

    Rays are as dense in them as if all of the `total` kept splats were refitted together. A view
    counts by how much of the region it shows.
    """
    sample = splats.take(slice(None, None, max(len(splats) // _SAMPLE, 1)))
    only = [view for view, _ in views]
    gaussians, _, _ = projection.prepare(sample, ViewSet(tuple(only)), scene, threads=1)
    boxes = {}
    for number, view in enumerate(only):
        with np.errstate(under="ignore"):
            footprints = projection.project(gaussians, scene, view)
        centers = footprints.centers[:, footprints.inside]
        if centers.shape[1]:
            boxes[number] = centers.shape[1], _box(centers, view)
    shown = sum(count for count, _ in boxes.values())
    rays, hits = limits(total)[0] / len(views), limits(len(splats))[1]
    steps, windows = steps_of(only, scene), []
    for number, (count, (left, top, width, height)) in boxes.items():
        (view, weight), share = views[number], count / shown
        rays_here = rays * (width * height / (view.width * view.height))
        counts = weight * share, rays_here, hits * share
        windows.append(Window(view, number, *counts, left, top, width, height, steps[number]))
    return windows


def _box(centers, view):
    """Left, top, width and height, at least 1 px, of where most points, (2, n), lie."""
    low, high = np.quantile(centers, (_EDGE, 1.0 - _EDGE), axis=1)
    size = np.array([view.width, view.height])
    first = np.floor(low).astype(np.int64).clip(0, size - 1)
    end = np.ceil(high).astype(np.int64).clip(first + 1, size)
    return (*first.tolist(), *(end - first).tolist())
