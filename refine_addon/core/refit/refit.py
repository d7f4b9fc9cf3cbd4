"""Refitting: survivors learn the colours that the unpruned splats have on rays.

Deleting and absorbing leave survivors with the numbers that they had, or that one merge at a time
gave them. On rays it is known what the unpruned splats look like, and how the colours change with
every parameter of the survivors (`linear`). So in rounds, each on rays through other pixels, the
squared difference of colours is made small by damped least squares (Levenberg, Marquardt)::

    minimise over x   |J x - r|^2  +  sum over parameters p of  (k (D_p + m_p) + K_p) x_p^2

r is the difference on all rays, in which large ones count less (`linear.HUBER`), D the diagonal of
J'J, m_p the median of D over all splats that are hit, for each kind of parameter, and K the sum of
D over the rounds before. So what few rays tell of a splat moves it little, and rounds together
learn from the rays of all of them, not from the last alone: each has a share in what a parameter
becomes. The sum is made small by a few steps of conjugate gradients, preconditioned by the
diagonal. What these and the damping leave of J'r, half of it is added to that of the next round.

k is `DAMPING` over how many rays there are for each survivor: the more rays, the less damping.

Validation rays, which nothing is learned from, compare survivors before and after a round. One that
loses is undone, and the next is damped more. Rounds end where little is gained, or after many rays.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from .. import costs
from ..errors import RefineError
from ..execute import Progress, part, silent
from ..pace import phases
from ..splats import Splats, rotation_matrices, unit_quaternions
from ..views import ViewSet
from .linear import COLOR, COUNT, DEGREE_1, MEAN, OPACITY, SCALE, TURN, LinearRays
from .round_rays import LARGEST, RoundRays, limits

STEPS = 8
"""Steps of conjugate gradients in a round."""

DAMPING, LEAST_DAMPING = 4.0, 0.1
"""Damping counts as so many rays for each survivor: k is this over how many there are, but at least
so much, as colours change with parameters in straight lines near by alone."""

CARRIED = 0.5
"""How much of what a round leaves of J'r counts in the next one."""

MORE_DAMPING = 8.0
"""Factor of k after a round that lost; see the top of this file."""

MAX_ROUNDS, ENOUGH_RAYS = 4, (5, 400_000)
"""By default there are so many rounds, and fewer where these have had so many rays for each
survivor and so many in all: of large scenes each round takes as long as absorbing."""

SIMPLER, ENOUGH_SIMPLER = 0.4, 0.25
"""How many times as many rays a round has, and are enough, for colours and opacities alone: 13 of
22 parameters, and colours change with most of these in straight lines."""

LEAST_GAIN = 0.05
"""Rounds end where the PSNR of the validation rays rises by less, dB."""

MAX_STEP = {"color": 0.5, "opacity": 1.0, "mean": 0.5, "scale": 0.3, "turn": 0.3}
"""How far a parameter moves in a round: as `linear` has them, means by the longest scale."""

LEAST_MOVE = 0.02
"""A mean that would move by less in a round stays, in longest scales; see `_worthwhile`."""


_NOTHING = 1e-30  # rays that tell less of a parameter tell nothing; 1 over it is a float32


@dataclass(frozen=True)
class Refit:
    """Settings of refitting.

    Attributes
    ----------
    rounds : int, optional
        At most so many; by default see `MAX_ROUNDS`. They end before where little is gained.
    geometry : bool
        Whether means, scales and rotations are refitted too, or colours and opacities alone.
    """

    rounds: int | None = None
    geometry: bool = True

    def __post_init__(self) -> None:
        """Check the values."""
        if self.rounds is not None and self.rounds < 1:
            raise RefineError(f"rounds is {self.rounds}, expected 1 or more")

    def expected_rounds(self, count: int) -> int:
        """Return how many rounds it takes to refit so many survivors, if all of them gain."""
        enough = max(ENOUGH_RAYS[0] * count, ENOUGH_RAYS[1])
        return self.rounds or min(math.ceil(enough / limits(count)[0]), MAX_ROUNDS)


class Gains:
    """What refitting changed and gained; see `Refitted`."""

    changed: NDArray[np.bool_]
    rounds: int
    psnr_before: float
    psnr: float

    def facts(self, seconds: float) -> dict[str, float]:
        """Return it for a report, with how long it took."""
        return {
            "rounds": self.rounds,
            "changed": int(np.count_nonzero(self.changed)),
            "psnr_before": round(self.psnr_before, 2),
            "psnr": round(self.psnr, 2),
            "seconds": round(seconds, 2),
        }

    def note(self, seconds: float) -> str:
        """Return it as a sentence, for the user."""
        return (
            "{changed:,} survivors were refitted in {rounds} rounds: {psnr_before:.1f} -> "
            "{psnr:.1f} dB on rays that nothing was fitted to, {seconds:.1f} s"
        ).format(**self.facts(seconds))


@dataclass(frozen=True, eq=False)
class Refitted(Gains):
    """What some rounds have made of survivors.

    Attributes
    ----------
    splats : Splats
        As they are now.
    changed : (N,) bool
        Which of them are not what they were.
    rounds : int
        How many rounds made them so.
    psnr_before, psnr : float
        Of the survivors as given, and as they are now, dB, on rays that nothing was learned from.
    """

    splats: Splats
    changed: NDArray[np.bool_]
    rounds: int
    psnr_before: float
    psnr: float


def refit(
    survivors: Splats,
    original: Splats,
    views: ViewSet,
    settings: Refit = Refit(),
    *,
    protected: NDArray[np.bool_] | None = None,
    progress: Progress = silent,
    threads: int | None = None,
) -> Refitted:
    """Refit survivors to what the views see of the unpruned splats.

    Parameters
    ----------
    survivors : Splats
        N splats, in the frame and unit of the views.
    original : Splats
        The unpruned splats, in the same frame.
    views : ViewSet
        All of them are used.
    settings : Refit
    protected : (N,) bool, optional
        Survivors that do not change.
    progress : callable, optional
        See `refine_addon.core.execute.Progress`.
    threads : int, optional

    Returns
    -------
    Refitted
        Never below what it began with, on rays that nothing was learned from.

    Raises
    ------
    Cancelled
        If `progress` answers ``False``; `refit_rounds` gives what was reached by then.

    Notes
    -----
    Memory: about 900 bytes a survivor. 14 bytes for each hit of a round, see `round_rays.limits`,
    lie in a temporary file.
    """
    *_, last = refit_rounds(
        survivors, original, views, settings,
        protected=protected, progress=progress, threads=threads,
    )  # fmt: skip
    return last


def refit_rounds(
    survivors: Splats,
    original: Splats,
    views: ViewSet,
    settings: Refit = Refit(),
    *,
    protected: NDArray[np.bool_] | None = None,
    progress: Progress = silent,
    threads: int | None = None,
) -> Iterator[Refitted]:
    """Yield what survivors are before the first round, and after each that gains.

    Parameters and errors are those of `refit`.
    """
    share = 1.0 if settings.geometry else SIMPLER
    count = round(share * len(survivors))
    rounds = settings.expected_rounds(len(survivors))
    most = limits(count)[0]
    preparing, *plans = costs.refitting(len(original), len(survivors), len(views), most, rounds)
    prepared, refitting = phases(progress, preparing, costs.joined(plans), threads=threads)
    rays = RoundRays.of(original, views, count, prepared, threads)
    yield from refit_on(
        rays, survivors, settings,
        protected=protected, progress=refitting, threads=threads,
    )  # fmt: skip


def refit_on(
    rays: RoundRays,
    survivors: Splats,
    settings: Refit,
    *,
    protected: NDArray[np.bool_] | None = None,
    progress: Progress = silent,
    threads: int | None = None,
) -> Iterator[Refitted]:
    """Yield what `refit_rounds` does, of some rays."""
    moving, geometry = np.zeros(COUNT, np.bool_), settings.geometry
    moving[: COUNT if geometry else MEAN.start] = True
    moving[DEGREE_1] = survivors.sh_rest.shape[1] > 0
    moving[SCALE.stop - 1] &= survivors.model != "2dgs"  # discs have no third scale
    movable = moving[:, None] & ~(
        np.zeros(len(survivors), np.bool_) if protected is None else protected
    )
    rounds, cast = settings.rounds or MAX_ROUNDS, 0
    ahead = settings.expected_rounds(len(survivors))
    checked, one_round = rays.costs(len(survivors))
    validating, later = phases(progress, checked, ahead * costs.joined(one_round))
    psnr = rays.psnr(survivors, validating)
    best = Refitted(survivors, np.zeros(len(survivors), np.bool_), 0, psnr, psnr)
    yield best
    enough = np.inf if settings.rounds else max(ENOUGH_RAYS[0] * len(survivors), ENOUGH_RAYS[1])
    enough *= 1.0 if geometry else ENOUGH_SIMPLER
    before = _Told(*np.zeros((2, COUNT, len(survivors)), np.float32))
    more = 1.0 if geometry else SIMPLER
    undone = False
    for number in range(1, rounds + 1):
        casting, solving, checking, later = phases(
            later, *one_round, (ahead - number) * costs.joined(one_round)
        )
        linear = rays.linear(
            best.splats, number,
            geometry=geometry, progress=casting,
        )  # fmt: skip
        cast += linear.count
        if not settings.rounds:
            ahead = max(min(math.ceil(enough * number / cast), rounds), number)
            (later,) = phases(later, (ahead - number) * costs.joined(one_round))
        damping = more * max(DAMPING * len(survivors) / linear.count, LEAST_DAMPING)
        change, told = _solve(linear, movable, damping, before, progress=solving, threads=threads)
        del linear  # the hits, before those of the next round
        if not change.any():
            return
        trial = _moved(best.splats, _worthwhile(change))
        psnr = rays.psnr(trial, checking)
        gain = psnr - best.psnr
        if gain > 0.0:
            before = told
            changed = ~_same(survivors, trial)
            best = Refitted(trial, changed, best.rounds + 1, best.psnr_before, psnr)
            yield best
            if gain < LEAST_GAIN or cast >= enough:
                return
        elif undone:
            return
        else:
            more, undone = more * MORE_DAMPING, True


class _Told(NamedTuple):
    """What rounds have told of the parameters of N survivors, and the next one goes on from."""

    diagonal: NDArray[np.float32]
    left: NDArray[np.float32]


def _solve(
    linear: LinearRays,
    movable: NDArray[np.bool_],
    damping: float,
    before: _Told,
    *,
    progress: Progress,
    threads: int | None,
) -> tuple[NDArray[np.float32], _Told]:
    """Return by how much to change the parameters of N survivors, (22, N), and what rays told."""
    index = linear.shapes.gaussians.index
    moving = movable[:, index]
    steps = [part(progress, k / STEPS, (k + 1) / STEPS) for k in range(STEPS)]
    residual = linear.residual + np.float32(CARRIED) * before.left[:, index]
    residual *= moving
    diagonal = linear.diagonal * moving
    prior = np.float32(damping) * (diagonal + _medians(diagonal)[:, None])
    damped = prior + before.diagonal[:, index]
    inverse = np.divide(
        1.0, diagonal + damped, out=np.zeros_like(damped), where=diagonal > _NOTHING
    )

    def product(direction: NDArray[np.float32], step: Progress) -> NDArray[np.float32]:
        result = linear.normal(direction, step, threads)
        result *= moving
        result += damped * direction
        return result

    change, residual = _conjugate_gradients(product, residual, inverse, steps)
    prior *= change
    residual += prior
    result = np.zeros(movable.shape, np.float32)
    told = _Told(before.diagonal.copy(), np.float32(CARRIED) * before.left)
    for row, values in enumerate(zip(change, diagonal, residual, strict=True)):
        result[row, index] = values[0]
        told.diagonal[row, index] += values[1]
        told.left[row, index] = values[2]
    return result, told


def _medians(diagonal: NDArray[np.float32]) -> NDArray[np.float32]:
    """Return the median over splats of what rays tell, 1 where they tell nothing, (22,)."""
    medians = [np.median(row[row > 0.0]) if row.any() else 1.0 for row in diagonal]
    return np.array(medians, np.float32)


def _conjugate_gradients(
    product: Callable[[NDArray[np.float32], Progress], NDArray[np.float32]],
    residual: NDArray[np.float32],
    inverse: NDArray[np.float32],
    steps: list[Progress],
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Return about the solution x of ``product(x) = residual``, by a few steps from 0.

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


def _dot(one: NDArray[np.float32], other: NDArray[np.float32]) -> float:
    """Return the inner product of two arrays, (22, N), summed in float64."""
    return float(sum(np.sum(a * b, dtype=np.float64) for a, b in zip(one, other, strict=True)))


def _worthwhile(change: NDArray[np.float32]) -> NDArray[np.float32]:
    """Return a change in which means move only where that is worth it, (22, N).

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
    """Return splats with changed parameters; those that do not change keep their bits."""
    rows = np.flatnonzero(change.any(axis=0))
    some, change = splats.take(rows), change[:, rows].astype(np.float64)
    quaternions = unit_quaternions(some.quaternions)
    logs = some.log_scales.astype(np.float64)
    longest = np.exp(logs.max(axis=1))
    step = _turned(quaternions, _limited(change[MEAN], MAX_STEP["mean"]).T) * longest[:, None]
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
    """Return vectors, (3, n), no longer than a length."""
    lengths = np.linalg.norm(vectors, axis=0)
    return np.asarray(vectors * np.minimum(1.0, longest / np.maximum(lengths, longest)))


def _turned(quaternions: NDArray[np.float64], vectors: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return vectors along the axes of splats, (n, 3), in the world."""
    return np.asarray(np.einsum("nij,nj->ni", rotation_matrices(quaternions), vectors))


def _product(quaternions: NDArray[np.float64], turns: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return unit quaternions, (n, 4), of splats that are turned about their own axes first."""
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


def _same(one: Splats, other: Splats) -> NDArray[np.bool_]:
    """Return which rows of two arrays of splats are equal, (N,)."""
    same = one.opacity_logits == other.opacity_logits
    for name in ("means", "log_scales", "quaternions", "sh_dc"):
        same &= (getattr(one, name) == getattr(other, name)).all(axis=1)
    return np.asarray(same & (one.sh_rest[:, :3] == other.sh_rest[:, :3]).all(axis=(1, 2)))
