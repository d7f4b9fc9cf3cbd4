"""The PSNR that views will have, from thousands of lines of sight instead of whole pictures.

Scoring projects every splat into every view. Of a few hundred pixels of each view, spread evenly,
it is noted which splats their lines of sight meet, front to back, and with which alpha. The colour
of these pixels follows from that, with all splats or with some of them removed::

    C = sum over splats kept of  T_i alpha_i c_i,    T_i = product over those in front of 1 - alpha

The mean squared difference over the pixels is an unbiased sample of that over the picture, and
nothing is assumed about which splats go together or what lies behind them. Colours are those of the
direction from which a view sees the splat: by the constant of the harmonics alone, as the rest of
scoring takes them, the estimate was 1.2 dB too high on an outdoor scene.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import TYPE_CHECKING

import numpy as np

from .. import spherical_harmonics
from ..estimate.quality import FEWEST, PSNR_CAP, SHARES, TAKEN_OVER, Quality, absorbed_from
from ..rendering import ALPHA_CUT, ALPHA_MAX
from ..work import Progress, checkpoint, for_chunks, part, silent
from . import projection
from .froxels import behind, paired

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Sequence
    from typing import Any

    from numpy.typing import NDArray

    from ..scene import Scene
    from ..splats import Splats
    from ..views import View, ViewSet
    from .projection import Footprints, Gaussians

LINES = 1 << 14
"""How many lines of sight all views together have."""

MOST_MET = 1 << 24
"""About how many splats all lines together may meet; there are fewer lines in dense scenes."""

RANKED = 1 << 16
"""How many other lines of sight all views together have that order splats, see `thinning`: what is
ordered by some lines, others have to judge."""

MOST_RANKED = 3 << 24
"""About how many splats all of those may meet. Each takes 16 bytes."""

FEW = 8
"""Fewer views have no more of what may be met than if they were so many."""

MOST_LINES = 60_000
"""A view has at most so many lines: NumPy sorts numbers of 16 bits by radix, in linear time."""

LEAST_LINES = 16
"""A view has at least this many lines, if it has as many pixels."""

ENOUGH = 256
"""So many lines must meet a splat at least, or nothing is estimated."""

JUDGES = 24
"""At most about so many views judge what takes more time than splats that are deleted."""

DARK = -9.3
"""Logarithm of the transmittance below which nothing is seen, 1e-4."""

_BLOCK = 1 << 17  # pairs of footprint and pixel at a time, which limits temporary memory
_PIECE = 1 << 15  # of what lines meet, at a time: what stays in the second-level cache
_LARGE = 1 << 14  # pixels; for images no larger, a table says how many lines lie before each


def sights(
    splats: Splats, views: ViewSet, *, progress: Progress = silent, threads: int | None = None
) -> SightLines:
    """Return what the lines of sight of all views meet, for scores that did not project splats.

    Parameters
    ----------
    splats : Splats
        In the frame and unit of the views.
    views : ViewSet
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
    found = SightLines(views.by_distance(), gaussians, splats)
    ahead = part(progress, 0.2, 1.0)
    found.look_from(range(len(found.views)), gaussians, scene, ahead, threads)
    return found


@dataclass(frozen=True, eq=False)
class Lines:
    """The lines of sight of one view, and what they meet.

    Attributes
    ----------
    columns, rows : (C,), (R,) int64
        The P lines go through the pixels where these columns and rows cross, row by row.
    line : (h,) int32
        Which line meets something, ascending; the others are front to back for each line.
    owner : (h,) int32
        Which of `met` it meets.
    alpha, dark : (h,) float32
        Alpha of the splat there, and the logarithm of 1 - alpha.
    met : (u,) int64
        The Gaussians that any line meets.
    """

    columns: NDArray[np.int64]
    rows: NDArray[np.int64]
    line: NDArray[np.int32]
    owner: NDArray[np.int32]
    alpha: NDArray[np.float32]
    dark: NDArray[np.float32]
    met: NDArray[np.int64]

    def keeping(self, keep: NDArray[np.bool_]) -> Lines:
        """Return the lines with only some of what they meet.

        Parameters
        ----------
        keep : (u,) bool
            Which of `met` are there.
        """
        there = np.flatnonzero(keep.take(self.owner))
        return replace(
            self,
            line=self.line.take(there),
            owner=self.owner.take(there),
            alpha=self.alpha.take(there),
            dark=self.dark.take(there),
        )

    def colors(self, colors: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the colour that each line sees, (3, P), 0..1.

        Parameters
        ----------
        colors : (3, u) float64
            Of the splats that are met.
        """
        line, owner, weight = self.contributions()
        channels = [
            np.bincount(line, weight * channel.take(owner), self.count) for channel in colors
        ]
        return np.stack(channels).clip(0.0, 1.0)

    @property
    def count(self) -> int:
        """How many lines there are."""
        return len(self.columns) * len(self.rows)

    def losses(
        self, colors: NDArray[np.float32]
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return what all lines together would lose with each splat that they meet, (u,) each.

        Parameters
        ----------
        colors : (3, u) float32
            Of the splats that are met.

        Returns
        -------
        error : (u,) float64
            The squared change of the colours of the lines without this one, all channels:
            ``(T alpha)^2 |c - B|^2``, with T what is left of the light in front of the splat, and B
            the colour behind it.
        contribution : (u,) float64
            What part of the colours it makes up: ``T alpha``.
        """
        first = self._first()
        ends = np.append(first, len(self.line))
        cuts = np.unique(np.searchsorted(ends, [*range(0, len(self.line), _PIECE), len(self.line)]))
        error, weight = np.empty((2, len(self.line)), np.float32)
        owner = self.owner.astype(np.intp)
        for begin, end in pairwise(cuts.tolist()):
            checkpoint()
            piece = slice(int(ends[begin]), int(ends[end]))
            error[piece], weight[piece] = _losses(
                self.alpha[piece], self.dark[piece], colors.take(owner[piece], axis=1),
                np.diff(ends[begin : end + 1]),
            )  # fmt: skip
        sums = (np.bincount(owner, each, len(self.met)) for each in (error, weight))
        errors, parts = (np.asarray(each, np.float64) for each in sums)
        return errors, parts

    def contributions(self) -> tuple[NDArray[np.int32], NDArray[np.int32], NDArray[np.float32]]:
        """Return what the lines see: r of the things that they meet.

        Returns
        -------
        line, owner : (r,) int32
            As the attributes.
        weight : (r,) float32
            Transmittance times alpha: what part of the pixel it makes up.
        """
        through = np.cumsum(self.dark, dtype=np.float64)
        last = np.flatnonzero(self.line[1:] != self.line[:-1])  # of each line but the last
        before = np.zeros(self.count)  # the sum over all lines before each
        before[self.line[last + 1]] = through[last]
        front = through - self.dark  # logarithm of the transmittance in front
        front -= before.take(self.line)
        seen = np.flatnonzero(front > DARK)
        line, owner = self.line.take(seen), self.owner.take(seen)
        return line, owner, self.alpha.take(seen) * np.exp(front.take(seen).astype(np.float32))

    def taken_over(
        self, colors: NDArray[np.float64], keep: NDArray[np.bool_]
    ) -> NDArray[np.float64]:
        """Return the colour that each line sees if survivors take over what goes, (3, P), 0..1.

        What goes is as opaque as it was, in the colour of the nearest splat on the line that stays.

        Parameters
        ----------
        colors : (3, u) float64
            Of the splats that are met.
        keep : (u,) bool
            Which of them stay.
        """
        heirs = self._heirs(keep, nobody=colors.shape[1])
        black = np.zeros((3, 1))  # of nobody
        return replace(self, owner=heirs).colors(np.append(colors, black, axis=1))

    def _heirs(self, keep: NDArray[np.bool_], nobody: int) -> NDArray[np.int32]:
        """Return which of `met` takes over each thing that is met, (h,): the nearest that stays.

        Parameters
        ----------
        keep : (u,) bool
            Which of `met` stay.
        nobody : int
            Stands where nothing on the line stays.
        """
        stays, here = keep.take(self.owner), np.arange(len(self.owner))
        first = self._first()
        counts = np.diff(np.append(first, len(here)))
        low = np.repeat(first, counts)  # (h,), the first on the same line
        high = low + np.repeat(counts, counts)  # and the one behind the last
        before = np.maximum.accumulate(np.where(stays, here, -1))
        after = np.minimum.accumulate(np.where(stays, here, len(here))[::-1])[::-1]
        back = np.where(before >= low, here - before, len(here))  # steps to the nearest in front
        on = np.where(after < high, after - here, len(here))
        near = np.where(back < on, before, after)
        none = np.minimum(back, on) == len(here)  # nothing on this line stays
        heirs = self.owner.take(np.where(none, here, near))
        heirs[none] = nobody
        return heirs

    @property
    def meeting(self) -> int:
        """How many of the lines meet a splat."""
        return len(self._first())

    def _first(self) -> NDArray[np.int64]:
        """Return where each line that meets something begins."""
        new = np.ones(len(self.line), np.bool_)
        np.not_equal(self.line[1:], self.line[:-1], out=new[1:])
        return np.flatnonzero(new)


class SightLines:
    """The lines of sight of all views into one scene.

    Parameters
    ----------
    views : sequence of (View, float)
        Views and their weights, in an order given by the scene.
    gaussians : Gaussians
        What the lines may meet.
    splats : Splats
        What the Gaussians were made of, for their colours.
    judges : bool
        Whether only about `JUDGES` of the views are looked from: enough for `against`, not for
        `curve`.
    ranking : bool
        Whether the lines are those that order splats; see `RANKED`.

    Attributes
    ----------
    index : (M,) int64
        Rows of the splats that the Gaussians are, among all.
    rows : (M,) int64
        The same among `splats`, which need only hold those that are met.
    lines : list of Lines or None
        Of each view; None where they are not known.
    """

    def __init__(
        self,
        views: Sequence[tuple[View, float]],
        gaussians: Gaussians,
        splats: Splats,
        *,
        judges: bool = False,
        ranking: bool = False,
    ) -> None:
        self.views, self.splats, self.ranking = views, splats, ranking
        self.every = max(math.ceil(len(views) / JUDGES), 1) if judges else 1
        self.index = self.rows = gaussians.index
        self.lines: list[Lines | None] = [None] * len(views)

    def colors(self, lines: Lines, view: View) -> NDArray[np.float64]:
        """Return the colours in which a view sees what its lines meet, (3, u)."""
        return colors_from(self.splats, self.rows[lines.met], view)

    def load(self) -> None:
        """Make ready what the lines meet, where that does not lie in memory."""

    def lacks(self, number: int) -> bool:
        """Return whether what the lines of a view meet is wanted, and not yet known."""
        return self.lines[number] is None and number % self.every == 0

    def look_from(
        self,
        numbers: Sequence[int],
        gaussians: Gaussians,
        scene: Scene,
        progress: Progress,
        threads: int | None,
    ) -> None:
        """Project all Gaussians into some views, and note what their lines meet."""

        def work(piece: slice) -> None:
            number = numbers[piece.start]
            if self.lacks(number):
                with np.errstate(under="ignore"):
                    footprints = projection.project(gaussians, scene, self.views[number][0])
                    self.lines[number] = met(self.views, number, footprints, ranking=self.ranking)

        for_chunks(work, len(numbers), 1, progress=progress, what="looking", threads=threads)

    def psnr(self, keep: NDArray[np.bool_], *, threads: int | None = None) -> float | None:
        """Return the estimated PSNR with some splats removed, dB; None if too little is seen.

        Parameters
        ----------
        keep : (N,) bool
        threads : int, optional
        """
        place, seen = keep[self.index].astype(np.int64), self._seen()
        found = self._removing(place, [1], seen, silent, threads)
        return None if found is None else float(self._mean(found, seen)[0])

    def curve(
        self,
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
        values : (N,) float32
            The lowest are removed first; of equal ones the first in the file.
        protected : (N,) bool, optional
            Splats that are removed after all others.
        settled : int, optional
            How many splats are in their final order, see `Scores`: the curve ends there, and is
            None if that is before the first of its shares.
        progress : callable, optional
        threads : int, optional

        Raises
        ------
        Cancelled
            If `progress` answers ``False``.
        """
        place = _places(values, protected)[self.index]
        last = len(values) if settled is None else settled
        if settled is not None and protected is not None:
            last -= int(np.count_nonzero(protected))
        places = [[math.floor(share * len(values)) for share in of] for of in (SHARES, TAKEN_OVER)]
        counts, taken = ([count for count in some if count <= last] for some in places)
        if not counts:
            return None
        seen = self._seen()
        single = self._removing(place, counts, seen, part(progress, 0.0, 0.5), threads)
        if single is None:
            return None
        gains = self._taking_over(place, taken, part(progress, 0.5, 1.0), threads)
        assert gains is not None  # noqa: S101 - the same lines tell it
        found = np.minimum.accumulate(self._mean(single, seen))
        names = [self.views[number][0].name for number in seen]
        views = dict(zip(names, np.minimum.accumulate(single, axis=1), strict=True))
        absorbed = absorbed_from(found, gains, len(values))
        foretold = len(values) >= FEWEST
        return Quality(np.array(SHARES[: len(counts)]), found, absorbed, foretold, views)

    def judged(
        self,
        values: NDArray[np.float32],
        shares: Sequence[float],
        views: Sequence[int],
        *,
        threads: int | None = None,
    ) -> NDArray[np.float64] | None:
        """Return the PSNR that some views tell, (L,), dB; None if their lines see too little.

        Parameters
        ----------
        values : (N,) float32
            The lowest are removed first.
        shares : sequence of float
            L shares of the splats that are removed, ascending.
        views : sequence of int
            The numbers of the views.
        threads : int, optional
        """
        if self._meeting(views) < ENOUGH:
            return None
        seen = sorted(set(views) & set(self._seen()))
        counts = [math.floor(share * len(values)) for share in shares]
        found = self._removing(_places(values)[self.index], counts, seen, silent, threads)
        return None if found is None else self._mean(found, seen)

    def against(
        self,
        splats: Splats,
        views: ViewSet,
        *,
        progress: Progress = silent,
        threads: int | None = None,
    ) -> float | None:
        """Return the estimated PSNR with other splats instead, dB; None if too little is seen.

        Parameters
        ----------
        splats : Splats
            In the frame of the views.
        views : ViewSet
            Those that the lines belong to.
        progress : callable, optional
        threads : int, optional

        Raises
        ------
        Cancelled
            If `progress` answers ``False``.
        """
        ahead = part(progress, 0.0, 0.2)
        gaussians, scene, _ = projection.prepare(splats, views, progress=ahead, threads=threads)

        def compare(number: int, lines: Lines) -> NDArray[np.float64]:
            view = self.views[number][0]
            with np.errstate(under="ignore"):
                footprints = projection.project(gaussians, scene, view)
                other = meet(footprints, lines.columns, lines.rows)
                seen = other.colors(colors_from(splats, gaussians.index[other.met], view))
                whole = lines.colors(self.colors(lines, view))
            return np.array([psnr_of(seen, whole, view)])

        return self._mean_of(compare, part(progress, 0.2, 1.0), threads)

    def _mean_of(
        self,
        compare: Callable[[int, Lines], NDArray[np.float64]],
        progress: Progress = silent,
        threads: int | None = None,
    ) -> float | None:
        """Return the mean of what `compare` returns, (1,), for each of the judges."""
        judges = self._judges()
        found = self._of_each(compare, judges, progress, threads)
        return None if found is None else float(self._mean(found, judges)[0])

    def _removing(
        self,
        place: NDArray[np.int64],
        counts: Sequence[int],
        views: Sequence[int],
        progress: Progress,
        threads: int | None,
    ) -> NDArray[np.float64] | None:
        """Return the PSNR of each of v views, (v, L), with each of L numbers of splats removed.

        Parameters
        ----------
        place : (M,) int64
            Of each of the Gaussians in the order of removal.
        counts : sequence of int
            Ascending: Gaussians whose place is lower are removed.
        views : sequence of int
            The numbers of the views that tell it.
        progress : callable
        threads : int, optional
        """

        def compare(number: int, lines: Lines) -> NDArray[np.float64]:
            view = self.views[number][0]
            with np.errstate(under="ignore"):
                colors = self.colors(lines, view)
            whole, values = lines.colors(colors), []
            own = place.take(lines.met)  # (u,)
            for count in counts:
                # What is removed stays removed: the lists grow shorter.
                lines = lines.keeping(own >= count)
                values.append(psnr_of(lines.colors(colors), whole, view))
            return np.array(values)

        return self._of_each(compare, views, progress, threads)

    def _taking_over(
        self,
        place: NDArray[np.int64],
        counts: Sequence[int],
        progress: Progress,
        threads: int | None,
    ) -> NDArray[np.float64] | None:
        """Return by how much the PSNR is higher, (L,), if survivors take over what goes.

        At most about `JUDGES` views tell it; parameters as `_removing`.
        """

        def compare(number: int, lines: Lines) -> NDArray[np.float64]:
            view = self.views[number][0]
            with np.errstate(under="ignore"):
                colors = self.colors(lines, view)
            whole, own, gains = lines.colors(colors), place.take(lines.met), []
            for count in counts:
                keep = own >= count  # (u,)
                left = lines.keeping(keep).colors(colors)
                taken = lines.taken_over(colors, keep)
                gains.append(psnr_of(taken, whole, view) - psnr_of(left, whole, view))
            return np.array(gains)

        judges = self._judges()
        found = self._of_each(compare, judges, progress, threads)
        return None if found is None else self._mean(found, judges)

    def _judges(self) -> list[int]:
        """Return the numbers of the views that judge where not all can."""
        seen = self._seen()
        return seen[:: max(math.ceil(len(seen) / JUDGES), 1)]

    def _seen(self) -> list[int]:
        """Return the numbers of the views whose lines meet a splat."""
        return [k for k, lines in enumerate(self.lines) if lines is not None and len(lines.line)]

    def _meeting(self, views: Iterable[int]) -> int:
        """Return how many lines of some views meet a splat."""
        return sum(lines.meeting for lines in map(self.lines.__getitem__, views) if lines)

    def _of_each(
        self,
        compare: Callable[[int, Lines], NDArray[np.float64]],
        views: Sequence[int],
        progress: Progress,
        threads: int | None,
    ) -> NDArray[np.float64] | None:
        """Return what `compare` returns for each of v views, (v, L).

        None if too few lines of all views meet a splat.
        """
        if self._meeting(range(len(self.lines))) < ENOUGH:
            return None

        def work(piece: slice) -> NDArray[np.float64]:
            number = views[piece.start]
            lines = self.lines[number]
            assert lines is not None  # noqa: S101 - `views` are of `_seen`
            return compare(number, lines)

        values = for_chunks(
            work, len(views), 1, progress=progress, what="estimating", threads=threads
        )
        return np.array(values)

    def _mean(self, values: NDArray[np.float64], views: Sequence[int]) -> NDArray[np.float64]:
        """Return the mean of values of some views, (v, L), weighted as the views are, (L,)."""
        weights = np.array([self.views[number][1] for number in views])
        return np.asarray(weights @ values / weights.sum())


def _places(
    values: NDArray[np.float32], protected: NDArray[np.bool_] | None = None
) -> NDArray[np.int64]:
    """Return the place of each of N splats in the order of removal, (N,); see `curve`."""
    order = np.argsort(values, kind="stable")
    if protected is not None:
        order = order[np.argsort(protected[order], kind="stable")]
    place = np.empty(len(order), np.int64)
    place[order] = np.arange(len(order))
    return place


def met(
    views: Sequence[tuple[View, float]],
    number: int,
    footprints: Footprints,
    *,
    ranking: bool = False,
) -> Lines:
    """Return what the lines of sight of one of some views meet; see `SightLines`."""
    view = views[number][0]
    crowd = max(crowding(footprints, view), 1.0)
    if not ranking:
        return meet(footprints, *pixels(view, number, min(LINES, MOST_MET / crowd) / len(views)))
    # What a view notes at a time takes six times the memory of what is noted.
    count = min(RANKED / len(views), MOST_RANKED / max(len(views), FEW) / crowd, MOST_LINES)
    # Other pixels than those of the lines that judge.
    return meet(footprints, *pixels(view, number + len(views), count))


def pixels(view: View, number: int, count: float) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Return the columns and rows of a view in which about `count` lines lie, spread evenly.

    Those of each `number` are others: multiples of the plastic number's powers are spread evenly.
    """
    count = max(count, LEAST_LINES)
    columns = max(round(math.sqrt(count * view.width / view.height)), 1)
    columns = min(columns, view.width, max(int(count), 1))
    rows = min(max(round(count / columns), 1), view.height)
    return (
        spread(view.width, columns, (number * 0.7548776662466927) % 1.0),
        spread(view.height, rows, (number * 0.5698402909980532) % 1.0),
    )


def colors_from(splats: Splats, rows: NDArray[np.int64], view: View) -> NDArray[np.float64]:
    """Return the colours in which a view sees some splats, (3, n), at least 0.

    Parameters
    ----------
    splats : Splats
        In the frame of the view.
    rows : (n,) int64
        Which of them.
    view : View
    """
    away = splats.means[rows].astype(np.float64) - view.center
    away /= np.maximum(np.linalg.norm(away, axis=1), np.finfo(np.float64).tiny)[:, None]
    found = spherical_harmonics.colors(away, splats.sh_dc[rows], splats.sh_rest[rows])
    return np.ascontiguousarray(found.T.clip(0.0, projection.BRIGHTEST))


def _losses(
    alpha: NDArray[np.float32],
    dark: NDArray[np.float32],
    colors: NDArray[np.float32],
    counts: NDArray[np.int64],
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Return for all that some lines meet what they would lose without it; see `Lines.losses`.

    Parameters
    ----------
    alpha, dark : (h,) float32
        See `Lines`.
    colors : (3, h) float32
    counts : (n,) int64
        How much each line meets, at least one.

    Returns
    -------
    error, contribution : (h,) float32
        0 where nothing is seen.
    """
    before = dark.astype(np.float64)
    front = np.cumsum(before)
    front -= before
    front -= np.repeat(front.take(np.cumsum(counts) - counts), counts)
    through = np.exp(front.astype(np.float32))
    through[front < DARK] = 0.0
    weight = through * alpha
    after = np.maximum(through - weight, np.float32(1e-8))
    pair = behind(paired(weight * colors[0], weight * colors[1]), counts)
    third = behind((weight * colors[2]).astype(np.float64), counts)
    error = np.zeros(len(alpha), np.float32)
    for own, light in zip(colors, (pair.real, pair.imag, third), strict=True):
        lost = light.astype(np.float32)
        lost /= after
        lost -= own
        lost *= weight
        lost *= lost
        error += lost
    return error, weight


def psnr_of(seen: NDArray[np.float64], whole: NDArray[np.float64], view: View) -> float:
    """Return the PSNR of a view, dB, given the colours of its lines with some and all splats.

    The logarithm of a mean over few lines is too low on average: by half the square of the mean's
    relative error, to second order, which is put right. How much the lines differ by chance, and
    not from one part of the picture to the other, is told by neighbours.
    """
    errors = np.mean((seen - whole) ** 2, axis=0)
    mean, count = float(np.mean(errors)), len(errors)
    if mean <= 10.0 ** (-PSNR_CAP / 10.0):
        return PSNR_CAP
    rest = 1.0 - count / (view.width * view.height)  # with all pixels the mean is exact
    variance = float(np.sum(np.diff(errors) ** 2)) / 2.0 / max(count - 1, 1)
    relative = rest * variance / count / mean**2
    return min(-10.0 * math.log10(mean) - 5.0 / math.log(10.0) * relative, PSNR_CAP)


def spread(size: int, count: int, start: float) -> NDArray[np.int64]:
    """Return `count` of `size` pixels, evenly spread and ascending; `start` shifts them, 0 to 1."""
    places = (np.arange(count) + start) * (size / count)
    return np.asarray(np.floor(places), np.int64)


def crowding(footprints: Footprints, view: View) -> float:
    """Return about how many footprints a line of sight of a view meets, at most all of them."""
    size = float(view.width * view.height)
    area = reaches(footprints.alphas)  # (n,), px^2
    area *= np.float32(math.pi) * footprints.sigmas[0] * footprints.sigmas[1]
    return float(np.minimum(area, np.float32(size)).sum(dtype=np.float64)) / size


def meet(
    footprints: Footprints,
    columns: NDArray[np.int64],
    rows: NDArray[np.int64],
) -> Lines:
    """Return which footprints the lines through some pixels meet.

    Parameters
    ----------
    footprints : Footprints
        In the view of the pixels.
    columns, rows : (C,), (R,) int64
        See `Lines`; ascending.
    """
    reach = reaches(footprints.alphas)  # (n,), squared Mahalanobis distance
    # Of each footprint: the first column and row that its box holds, and how many it holds.
    (left, wide), (top, tall) = (
        boxes(footprints, reach, axis, places) for axis, places in enumerate((columns, rows))
    )
    pairs = wide * tall  # (n,)
    some = np.flatnonzero(pairs > 0)
    pairs, wide = pairs[some], wide[some]  # (r,)
    ends = np.cumsum(pairs, dtype=np.int64)
    cuts = np.searchsorted(ends, np.arange(0, ends[-1] if len(ends) else 0, _BLOCK)).tolist()
    found: list[tuple[NDArray[Any], ...]] = []
    for start, end in pairwise([*cuts, len(some)] if cuts else []):
        checkpoint()
        count = pairs[start:end]
        own = np.repeat(some[start:end], count)  # (p,), row of the footprint, as all that follows
        number = np.arange(len(own)) - np.repeat(np.cumsum(count) - count, count)
        down, across = np.divmod(number, np.repeat(wide[start:end], count))
        across += left.take(own)
        down += top.take(own)
        squared = mahalanobis(footprints, own, columns.take(across), rows.take(down))
        met = np.flatnonzero(squared < reach.take(own))
        own = own[met]
        alpha = footprints.alphas.take(own) * np.exp(squared[met] / -2.0)
        found.append((own, down[met] * len(columns) + across[met], alpha))
    found.append((np.empty(0, np.int64), np.empty(0, np.int64), np.empty(0, np.float32)))
    own, line, alpha = (np.concatenate(arrays) for arrays in zip(*found, strict=True))
    order = np.argsort(line.astype(np.uint16), kind="stable")  # footprints are front to back
    met, own = np.unique(footprints.index[own[order]], return_inverse=True)
    alpha = np.minimum(alpha[order], np.float32(ALPHA_MAX))
    return Lines(
        columns,
        rows,
        line[order].astype(np.int32),
        own.astype(np.int32),
        alpha,
        np.log1p(-alpha),
        met,
    )


def boxes(
    footprints: Footprints, reach: NDArray[np.float32], axis: int, places: NDArray[np.int64]
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Return the first of some columns or rows that lies in each footprint's box, and how many do.

    Parameters
    ----------
    footprints : Footprints
    reach : (n,) float32
        Squared Mahalanobis distance to which a footprint is followed.
    axis : int
        0 for columns, 1 for rows.
    places : (C,) int64
        Numbers of the columns or rows, ascending; their centres are half a pixel on.
    """
    center = footprints.centers[axis] - np.float32(0.5)
    half = np.sqrt(reach * (footprints.major[axis] ** 2 + footprints.minor[axis] ** 2))
    first, end = (_before(places, np.ceil(edge)) for edge in (center - half, center + half))
    return first, end - first


def _before(places: NDArray[np.int64], edges: NDArray[np.float32]) -> NDArray[np.int64]:
    """Return how many of some ascending pixels lie before each edge, (n,)."""
    size = int(places[-1]) + 1
    if size > _LARGE:
        return np.asarray(np.searchsorted(places.astype(np.float64), edges.astype(np.float64)))
    table = np.searchsorted(places, np.arange(size + 1))  # four times as fast as searching each
    return np.asarray(table.take(edges.clip(0.0, size).astype(np.int64)))


def mahalanobis(
    footprints: Footprints,
    own: NDArray[np.int64],
    column: NDArray[np.int64],
    row: NDArray[np.int64],
) -> NDArray[np.float32]:
    """Return the squared Mahalanobis distance of pixels to footprints, (p,) each.

    Parameters
    ----------
    footprints : Footprints
    own : (p,) int64
        Row of the footprint.
    column, row : (p,) int64
        Of the pixel.
    """
    across = column.astype(np.float32) + np.float32(0.5) - footprints.centers[0].take(own)
    down = row.astype(np.float32) + np.float32(0.5) - footprints.centers[1].take(own)
    squared = np.zeros(len(own), np.float32)
    for axes, sigma in zip((footprints.major, footprints.minor), footprints.sigmas, strict=True):
        along = across * axes[0].take(own) + down * axes[1].take(own)
        along /= np.square(sigma.take(own))
        squared += along * along
    return squared


def reaches(alphas: NDArray[np.float32]) -> NDArray[np.float32]:
    """Return the squared Mahalanobis distance at which alpha falls to `ALPHA_CUT`, (n,)."""
    ratio = alphas * np.float32(1.0 / ALPHA_CUT)
    return np.asarray(np.float32(2.0) * np.log(np.maximum(ratio, np.float32(1.0))))
