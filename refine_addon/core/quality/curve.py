"""How close the pictures of the views stay to those of the unpruned splats, as a curve.

The measure is PSNR in dB of pictures clipped to 0..1, as a screen shows them: of each view by
itself, at most 100, and of these the mean. `estimate.psnr` estimates it.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import partial
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

Way = Literal["delete", "merge", "refit"]
"""What is done to reach a budget: closed form and occlusion delete."""

WAYS: tuple[Way, ...] = ("delete", "merge", "refit")

PSNR_CAP = 100.0
"""PSNR of equal pictures, dB, and the highest that an estimate may be."""

SHARES = (0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8, 0.9, 0.95)
"""Shares of the splats removed at which the estimate is made; between them it is interpolated."""

MERGED_SHARES = (0.3, 0.5, 0.7, 0.9)
"""Shares removed at which kept splats stand in for removed ones; see `merged_from`."""

GAIN = (3.0, 4.5, 4.5, 4.3), (0.5, 0.55, 0.7, 0.85)
"""What merging gains over deleting at those shares, dB: a constant, and a part of what
standing in gains on rays."""

FULL_GAIN = 40_000
"""Scenes of at least so many splats gain that much."""

FEWER = 0.2, 0.4, 0.8, 1.3
"""By how much less fewer splats gain at those shares, dB for each halving: they have fewer
neighbours of their kind to merge with."""

FEWEST = 20_000
"""Of fewer splats it is not foretold: scenes differ by up to 7 dB."""

PLAIN = 0.1
"""Share removed up to which merging is plain deletion."""

REFIT_GAIN, REFIT_HITS, FEWER_RAYS = (2.9, 3.2, 3.8, 4.7), 78.0, 1.3
"""What refitting gains over merging in the views that decide, dB: at `MERGED_SHARES`, where a
ray hits `REFIT_HITS` splats, and so much less for each doubling of that. Rounds learn from a number
of hits, so that of a scene in which rays hit more they see fewer rays."""

UNSEEN = 60.0
"""PSNR in dB above which pictures are the same to the eye: rounding to 8 bits alone makes 59."""

AS_GOOD = 0.5
"""By so much more, dB, merging has to reach than plain deletion, or deletion is as good: nobody
sees a difference so small, and rows that stay to the bit can be compared with the original's."""

PARTED = 3.0
"""By so much less, dB, views in between are said to lose more than those that decided."""

NOTICED = 50.0
"""What decided counts as no more than that, dB: between views at 70 and at 55 nobody sees more."""

ROUNDS = 2.5
"""Scoring by occlusion takes so many times as long as measuring all splats once."""

TIMED = (0.1, 0.3, 0.5, 0.55, 0.7, 0.9)
"""Shares removed for which the next two hold; between them they are interpolated."""

MERGING = (0.1, 0.5, 0.65, 1.4, 1.8, 2.4)
"""How many times as long as measuring once merging takes after that: more stages, more time.

These and the next are processor times of `room_small`, of one thread."""

REFITTING = (20.0, 17.0, 8.5, 10.5, 7.5, 5.0)
"""The same of refitting."""

_LEAST_SHARE = 1e-6  # the place of "nothing removed" on the curve's axis, where that is infinite


@dataclass(frozen=True, eq=False)
class Quality:
    """A curve from the share of the splats that is removed to the estimated PSNR.

    Attributes
    ----------
    shares : (L,) float64
        Ascending, between 0 and 1.
    psnr : (L,) float64
        With these shares deleted, lowest scores first; dB, never rising.
    merged : (L,) float64
        About what merging reaches with as many kept splats; dB, never rising.
    foretold : bool
        Whether `merged` is accurate enough to be shown.
    views : dict of str to (L,) float64
        As `psnr`, of single views by their names; those that no ray tells of are missing.
    hits : float
        How many splats a ray hits on average.
    between : (L,) float64 or None
        As `psnr`, in views between these; None where nothing tells it.

    Examples
    --------
    >>> curve = Quality(np.array([0.2, 0.5, 0.8]), np.array([50.0, 40.0, 30.0]), np.zeros(3))
    >>> curve.at(0.5), curve.share(40.0)
    (40.0, 0.5)
    """

    shares: NDArray[np.float64]
    psnr: NDArray[np.float64]
    merged: NDArray[np.float64]
    foretold: bool = True
    views: dict[str, NDArray[np.float64]] = field(default_factory=dict)
    hits: float = REFIT_HITS
    between: NDArray[np.float64] | None = None

    def at(self, share: float, way: Way = "delete") -> float:
        """PSNR with a share of the splats removed, dB; if kept splats may change, about.

        Between the shares of the curve the PSNR is taken as linear in the logarithm of the odds
        ``share / (1 - share)``, which it nearly is; beyond the last it stays.
        """
        return self._at(self._curve(way), share)

    def of_views(self, share: float, way: Way = "delete") -> dict[str, float]:
        """PSNR of single views with a share of the splats removed, dB.

        Merging and refitting are taken to gain as much in each view as in all together.

        Examples
        --------
        >>> curve = Quality(np.array([0.2, 0.5]), *np.array([[50.0, 40.0], [53.0, 46.0]]))
        >>> curve.views["a"] = np.array([48.0, 36.0])
        >>> curve.of_views(0.5), curve.of_views(0.5, "merge")
        ({'a': 36.0}, {'a': 42.0})
        """
        gain = self.at(share, way) - self.at(share)
        return {
            name: min(self._at(psnr, share) + gain, PSNR_CAP) for name, psnr in self.views.items()
        }

    def at_between(self, share: float, way: Way = "delete") -> float | None:
        """PSNR in views between these with a share of the splats removed, dB.

        Merging and refitting are taken to gain as much there. None where nothing tells it.

        Examples
        --------
        >>> between = np.array([48.0, 36.0])
        >>> curve = Quality(np.array([0.2, 0.5]), between + 2.0, between + 9.0, between=between)
        >>> curve.at_between(0.5), curve.at_between(0.5, "merge")
        (36.0, 43.0)
        """
        if self.between is None:
            return None
        deleted = self._at(self.between, share)
        return min(deleted + self.at(share, way) - self.at(share), PSNR_CAP)

    def share(self, psnr: float, way: Way = "delete") -> float:
        """Largest share that can go while the PSNR is at least `psnr`, dB; or 0.

        It is at most the last share of the curve.
        """
        odds, values = self._odds(), [PSNR_CAP, *self._curve(way)]
        if psnr > PSNR_CAP:
            return 0.0
        if psnr <= values[-1]:
            return float(self.shares[-1])
        right = sum(value >= psnr for value in values) - 1  # the last point that is good enough
        step = (values[right] - psnr) / (values[right] - values[right + 1])
        place = odds[right] + step * (odds[right + 1] - odds[right])
        return float(1.0 / (1.0 + np.exp(-place)))

    def _curve(self, way):
        """PSNR at the shares, dB, never rising."""
        if way == "delete":
            return self.psnr
        gain = refit_gain(self.shares, self.hits) if way == "refit" else 0.0
        return np.minimum.accumulate(np.minimum(self.merged + gain, PSNR_CAP))

    def _odds(self):
        return [_log_odds(share) for share in (0.0, *self.shares.tolist())]

    def _at(self, psnr, share):
        """PSNR of a curve at a share; at its beginning nothing is removed."""
        return float(np.interp(_log_odds(share), self._odds(), [PSNR_CAP, *psnr]))

    def as_good(self, share: float) -> bool:
        """Whether plain deletion of a share is about as good as merging, as foretold."""
        plain = self.at(share)
        return deletion_will_do(plain) or plain > self.at(share, "merge") - AS_GOOD

    def facts(self) -> dict[str, Any]:
        """Plain JSON values; those of single views to hundredths of a dB."""
        curves = {name: getattr(self, name).tolist() for name in ("shares", "psnr", "merged")}
        views = {name: psnr.round(2).tolist() for name, psnr in self.views.items()}
        between = None if self.between is None else self.between.round(2).tolist()
        told = {"foretold": self.foretold, "hits": round(self.hits, 2)}
        return {**curves, **told, "views": views, "between": between}

    @classmethod
    def from_facts(cls, facts: Mapping[str, Any] | None) -> Quality | None:
        """The curve that `facts` describe; None if they are malformed."""
        try:
            held, array = dict(facts or {}), partial(np.array, dtype=np.float64)
            shares, psnr, merged = map(array, (held["shares"], held["psnr"], held["merged"]))
            views = {str(name): array(each) for name, each in (held.get("views") or {}).items()}
            between = None if held.get("between") is None else array(held["between"])
            told = [] if between is None else [between]
            every = np.stack([shares, psnr, merged, *views.values(), *told])  # of one length
            if every.ndim != 2 or not every.size:
                return None
            hits, foretold = float(held.get("hits", REFIT_HITS)), bool(held.get("foretold", True))
        except (AttributeError, KeyError, TypeError, ValueError):
            return None
        return cls(shares, psnr, merged, foretold, views, hits, between)


def refit_gain(share: NDArray[np.float64] | float, hits: float) -> NDArray[np.float64]:
    """About what refitting gains over merging, dB, at least 0.

    Parameters
    ----------
    share : (L,) float64 or float
        Of the splats that goes.
    hits : float
        How many splats a ray hits on average.

    Examples
    --------
    >>> [round(float(refit_gain(0.5, hits)), 2) for hits in (39.0, 78.0, 156.0)]
    [4.5, 3.2, 1.9]
    """
    fewer = FEWER_RAYS * math.log2(max(hits, 1.0) / REFIT_HITS)
    gain = np.interp(share, MERGED_SHARES, REFIT_GAIN) - fewer
    return np.asarray(gain.clip(0.0), np.float64)


def expected(
    curve: Quality | None,
    share: float,
    measured: Mapping[Way, float | None],
    hits: float | None = None,
) -> dict[Way, float | None]:
    """About which PSNR is reached by what kept splats become, dB; None where nothing tells it.

    Parameters
    ----------
    curve : Quality or None
    share : float
        Of the splats that goes.
    measured : mapping of str to (float or None)
        The estimates that were measured, dB: these are returned.
    hits : float or None
        How many splats a ray hits on average, to foretell what refitting gains over merging that
        was measured; None where that is not foretold.

    Examples
    --------
    >>> expected(None, 0.5, {"merge": 46.0}, 78.0)
    {'delete': None, 'merge': 46.0, 'refit': 49.2}
    """
    told: dict[Way, float | None] = {}
    for way in WAYS:
        told[way] = measured.get(way)
        if told[way] is None and curve is not None and (curve.foretold or way == "delete"):
            told[way] = curve.at(share, way)
    merged = measured.get("merge")
    if measured.get("refit") is None and merged is not None:
        told["refit"] = None
        if hits is not None:
            told["refit"] = min(merged + float(refit_gain(share, hits)), PSNR_CAP)
    return told


def deletion_will_do(psnr: float | None) -> bool:
    """Whether nobody would see what merging gains over plain deletion.

    Parameters
    ----------
    psnr : float or None
        The estimate with splats deleted, dB; None where the views see too little, so that nothing
        tells of a gain.
    """
    return psnr is None or psnr > UNSEEN


def needed(gone: int | None, count: int) -> int | None:
    """How many of `count` splats the curve must be known for where `gone` are removed.

    That is up to the next of `MERGED_SHARES`, so that what it says up to there is what the whole
    curve says. None if the whole is needed.

    Parameters
    ----------
    gone : int or None
        None where that is not known before.
    count : int

    Examples
    --------
    >>> needed(40, 100), needed(50, 100), needed(95, 100)
    (50, 50, None)
    """
    places = (math.floor(share * count) for share in MERGED_SHARES)
    return None if gone is None else next((place for place in places if place >= gone), None)


def merged_from(
    psnr: NDArray[np.float64], gains: NDArray[np.float64], count: int
) -> NDArray[np.float64]:
    """About what merging reaches at the first L of `SHARES`, without merging; dB.

    Rays tell what the pictures would be if removed splats stayed as opaque as they are, in the
    colour of the nearest kept hit (`Rays.colors_by_nearest_kept`). That is neither an upper nor a
    lower bound of what merging reaches, but goes up and down with it from scene to scene.

    Parameters
    ----------
    psnr : (L,) float64
        With the splats deleted, at those shares.
    gains : (G,) float64
        By how much it is higher with kept splats standing in, at the first G of `MERGED_SHARES`,
        which go as far.
    count : int
        How many splats there are.
    """
    constant, part, fewer = np.array([*GAIN, FEWER])[:, : len(gains)]
    halvings = max(math.log2(FULL_GAIN / max(count, 1)), 0.0)
    foretold = (constant + part * gains - halvings * fewer).clip(0.0)
    known = (PLAIN, *MERGED_SHARES[: len(gains)])
    gain = np.interp(SHARES[: len(psnr)], known, np.concatenate([[0.0], foretold]))
    return np.minimum.accumulate(np.minimum(psnr + gain, PSNR_CAP))


def left_to_lose(goal: float, psnr: float | None) -> float:
    """PSNR that a second change may have by itself so that both together reach `goal`, dB.

    The squared errors of changes that have nothing to do with each other add up.

    Parameters
    ----------
    goal : float
    psnr : float or None
        Of the first change; None if there was none.

    Examples
    --------
    >>> round(left_to_lose(40.0, 43.0103), 2), left_to_lose(40.0, 39.0)
    (43.01, inf)
    """
    if psnr is None:
        return goal
    left = 10.0 ** (-goal / 10.0) - 10.0 ** (-psnr / 10.0)
    return -10.0 * math.log10(left) if left > 0.0 else math.inf


def out_of_reach(goal: float, gone: int, count: int, psnr: float | None) -> str:
    """Sentence where a PSNR as budget cannot be had, or "".

    Parameters
    ----------
    goal : float
        The PSNR, dB.
    gone, count : int
        How many splats go, of how many.
    psnr : float or None
        The estimate with these removed, dB.

    Examples
    --------
    >>> out_of_reach(99.0, 0, 100, 100.0)
    'by the estimate nothing can go at 99 dB'
    >>> out_of_reach(10.0, 95, 100, 16.2)
    'the estimate ends at 95% removed, about 16 dB: for 10 dB no more goes'
    """
    if not gone:
        return f"by the estimate nothing can go at {goal:g} dB"
    if psnr is None or psnr <= goal or gone < math.floor(SHARES[-1] * count):
        return ""
    end = f"the estimate ends at {SHARES[-1]:.0%} removed, {in_words(psnr)}"
    return f"{end}: for {goal:g} dB no more goes"


def in_words(psnr: float) -> str:
    """An estimate as a user needs it.

    >>> in_words(38.4), in_words(72.0)
    ('about 38 dB', 'more than 60 dB')
    """
    return f"more than {UNSEEN:.0f} dB" if psnr > UNSEEN else f"about {psnr:.0f} dB"


def parted(psnr: float | None, between: float | None) -> bool:
    """Whether views in between lose more than those that decided, so that it can be seen.

    >>> parted(50.0, 36.0), parted(50.0, 48.0), parted(80.0, 48.0), parted(50.0, None)
    (True, False, False, False)
    """
    return psnr is not None and between is not None and min(psnr, NOTICED) - between > PARTED


def in_views(psnr: float, between: float | None) -> str:
    """An estimate in the views that decided and in those between them, as a user needs it.

    >>> in_views(50.2, 36.1), in_views(50.2, None)
    ('about 50 dB in these views, about 36 between them', 'about 50 dB in these views')
    >>> in_views(72.0, 70.0)
    'more than 60 dB in these views and between them'
    """
    here = f"{in_words(psnr)} in these views"
    if between is None:
        return here
    if in_words(psnr) == in_words(between):
        return f"{here} and between them"
    return f"{here}, {in_words(between).removesuffix(' dB')} between them"


def expected_seconds(scored: float, share: float, *, once: bool) -> dict[Way, float]:
    """About how long pruning takes, by what is done, seconds; without files.

    Parameters
    ----------
    scored : float
        How long scoring took, seconds.
    share : float
        Of the splats that goes.
    once : bool
        Whether all splats were measured once; else they were scored in rounds.

    Examples
    --------
    >>> expected_seconds(1.0, 0.5, once=True)
    {'delete': 2.5, 'merge': 1.65, 'refit': 10.15}
    """
    measured = scored if once else scored / ROUNDS
    merging, refitting = (
        measured * float(np.interp(share, TIMED, times)) for times in (MERGING, REFITTING)
    )
    merged = measured + merging
    return {"delete": ROUNDS * measured, "merge": merged, "refit": merged + refitting}


def _log_odds(share):
    share = min(max(share, _LEAST_SHARE), 1.0 - _LEAST_SHARE)
    return float(np.log(share / (1.0 - share)))
