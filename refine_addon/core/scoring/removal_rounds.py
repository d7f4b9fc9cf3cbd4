"""What each splat is worth while others go, by lines of sight.

Splats hide each other, so what one is worth rises as those around it go. Lines of sight that were
noted once (`sight_lines`) tell it at any time, without measuring the views again: what a line meets
is known, front to back, and so is what it would show without any one of them. Few lines meet a
small splat, so what they tell is weighed against what the views measured of all splats
(`measuring`)::

    error_i = (n_i  error of the lines now  +  KNOWN  error measured, grown) / (n_i + KNOWN)

n_i is how many lines met the splat while all were there. A measured sum grows as the lines tell,
see `_grown`.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from ..seeing.measuring import Measured
from ..work import Progress, for_chunks, part

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from ..seeing.sight_lines import Lines, SightLines

    Sums = tuple[NDArray[np.float64], NDArray[np.float64]]

KNOWN = 10.0
"""What was measured counts as much as so many lines."""

_LOADING = 0.3
"""Share of the time that colours take, for the display of progress."""


@dataclass(frozen=True, eq=False)
class _Look:
    """What one view tells.

    Attributes
    ----------
    lines : Lines
    colors : (3, u) float32
        Of what they meet.
    area : float
        Of the image for each line, px^2, times the view's weight.
    """

    lines: Lines
    colors: NDArray[np.float32]
    area: float

    def keeping(self, keep: NDArray[np.bool_]) -> _Look:
        """Return it with only some of all M Gaussians."""
        return replace(self, lines=self.lines.keeping(keep.take(self.lines.met)))

    def losses(self) -> Sums:
        """Return error and contribution of what the lines meet, (u,) each; see `measuring`."""
        error, contribution = self.lines.losses(self.colors)
        return np.asarray(self.area * error), np.asarray(self.area * contribution)


class Thinning:
    """M Gaussians, of which ever more go.

    Parameters
    ----------
    sights : SightLines
        Lines that were noted while all were there.
    measured : Measured
        What the views saw of them then.
    progress : callable
    threads : int, optional

    Raises
    ------
    Cancelled
        If `progress` answers ``False``.

    Notes
    -----
    Memory: 16 bytes for everything that a line meets, of which there are at most about
    `sight_lines.MOST_RANKED`; while a view notes it, 100 bytes for each of its own.
    """

    def __init__(
        self, sights: SightLines, measured: Measured, progress: Progress, threads: int | None
    ) -> None:
        self._measured, self._threads = measured, threads
        sights.load()
        numbers = [k for k, lines in enumerate(sights.lines) if lines is not None]

        def look(piece: slice) -> _Look:
            number: int = numbers[piece.start]
            lines, (view, weight) = sights.lines[number], sights.views[number]
            assert lines is not None  # noqa: S101 - as `numbers` says
            with np.errstate(under="ignore"):
                colors = sights.colors(lines, view).astype(np.float32)
            return _Look(lines, colors, weight * view.width * view.height / lines.count)

        ahead = part(progress, 0.0, _LOADING)
        self._looks: list[_Look] = for_chunks(
            look, len(numbers), 1, progress=ahead, what="scoring", threads=threads
        )
        self._met = np.zeros(len(measured.seen), np.int64)
        for one in self._looks:
            met = one.lines.met
            self._met[met] += np.bincount(one.lines.owner, minlength=len(met))
        self._first = self._sums(np.arange(len(self._met)), part(progress, _LOADING, 1.0))

    def measured(self, left: NDArray[np.int64], progress: Progress) -> Measured:
        """Remove Gaussians for good; return what those that are left are worth now, (n,) each.

        Parameters
        ----------
        left : (n,) int64
            Rows, ascending.
        progress : callable

        Raises
        ------
        Cancelled
            If `progress` answers ``False``.
        """
        before = len(left) == len(self._met)  # nothing has gone
        now = self._first if before else self._sums(left, progress)
        own = self._measured.error[left], self._measured.contribution[left]
        met = self._met[left]  # (n,)
        error, contribution = (
            _grown(mine, first[left], after, KNOWN / np.maximum(met, 1))
            for mine, first, after in zip(own, self._first, now, strict=True)
        )
        error = (met * now[0] + KNOWN * error) / (met + KNOWN)
        return Measured(contribution, error, self._measured.seen[left])

    def _sums(self, left: NDArray[np.int64], progress: Progress) -> Sums:
        """Return error and contribution of Gaussians that are left, (n,) each, as lines tell."""
        keep = np.zeros(len(self._met), np.bool_)
        keep[left] = True
        every = len(left) == len(keep)

        def losses(piece: slice) -> Sums:
            one: _Look = self._looks[piece.start]
            if not every:
                one = self._looks[piece.start] = one.keeping(keep)
            with np.errstate(under="ignore"):
                return one.losses()

        found = for_chunks(
            losses, len(self._looks), 1, progress=progress, what="scoring", threads=self._threads
        )
        error, contribution = np.zeros(len(keep)), np.zeros(len(keep))
        for look, (lost, made_up) in zip(self._looks, found, strict=True):
            error[look.lines.met] += lost
            contribution[look.lines.met] += made_up
        return error[left], contribution[left]


def _grown(
    own: NDArray[np.float64],
    before: NDArray[np.float64],
    now: NDArray[np.float64],
    known: NDArray[np.float64],
) -> NDArray[np.float64]:
    """Return measured sums with what they have grown by since, (n,).

    A splat that lines meet often has grown as they tell, one that they hardly meet as all splats.

    Parameters
    ----------
    own : (n,) float64
        As measured, before any splat had gone.
    before, now : (n,) float64
        What the lines told then, and what they tell now.
    known : (n,) float64
        How many times what was measured the growth of all splats counts.
    """
    total = float(before.sum())
    common = float(now.sum()) / total if total > 0.0 else 1.0
    prior = known * own
    both = before + prior
    grown = np.divide(now + common * prior, both, out=np.ones_like(own), where=both > 0.0)
    return np.asarray(own * grown)
