"""PSNR of the views against the unpruned splats, as a curve over the share removed.

In dB of pictures clipped to 0..1: the mean over views of at most 100 each. `psnr` estimates it.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from contextlib import suppress
from functools import partial
from typing import Any, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

Way = Literal["delete", "merge", "refit"]
"""What is done to reach a budget: closed form and occlusion delete."""

WAYS: tuple[Way, ...] = ("delete", "merge", "refit")

PSNR_CAP = 100.0
"""PSNR of equal pictures, dB, and the highest estimate."""

SHARES = (0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8, 0.9, 0.95)
"""Shares removed at which the PSNR is estimated; between them it is interpolated."""

MERGED_SHARES = (0.3, 0.5, 0.7, 0.9)
"""Shares removed at which kept splats stand in for removed ones; see `merged_from`."""

GAIN = (3.0, 4.5, 4.5, 4.3), (0.5, 0.55, 0.7, 0.85)
"""Gain of merging over deletion at these: a constant, dB, and a factor on `merged_from`'s gains."""

FULL_GAIN = 40_000
"""Fewest splats of a scene that gains as much as `GAIN`."""

FEWER = 0.2, 0.4, 0.8, 1.3
"""Loss of this gain for each halving of the splats, dB: fewer have like neighbours to merge."""

FEWEST = 20_000
"""Fewer splats have no prediction: scenes differ by up to 7 dB."""

PLAIN = 0.1
"""Share removed up to which merging is plain deletion."""

REFIT_GAIN, REFIT_HITS, FEWER_RAYS = (2.9, 3.2, 3.8, 4.7), 78.0, 1.3
"""Gain of refitting over merging, dB: at `MERGED_SHARES`, if a ray has `REFIT_HITS` hits, and the
loss for each doubling: rounds use a number of hits, so dense scenes get fewer rays."""

UNSEEN = 60.0
"""PSNR in dB above which estimates are told as equal."""

INVISIBLE = 57.7
"""PSNR of errors of a third of an 8-bit level, ``20 log10(3 255)`` dB; rounding makes 58.9."""

AS_GOOD = 0.5
"""Gain of merging up to which deletion is as good, dB: nobody sees it, and rows keep their bits."""

FARTHER = 1.0
"""Gain of merging over deletion that views beside few cameras do not show, dB: elsewhere in the
rooms of three houses it gained 1.5 to 2.2, beside 0 to 1.2."""

PARTED = 3.0
"""Views in between visibly lose more than deciding views if their PSNR is lower by this, dB."""

NOTICED = 50.0
"""A higher PSNR of deciding views counts as this in `parted`, dB: 70 looks like 55."""

ROUNDS = 2.5
"""Time of scoring by occlusion over that of measuring all splats once."""

TIMED = (0.1, 0.3, 0.5, 0.55, 0.7, 0.9)
"""Shares removed to which `MERGING` and `REFITTING` belong; in between they are interpolated."""

MERGING = (0.1, 0.5, 0.65, 1.4, 1.8, 2.4)
"""Time of merging over that of measuring once: one thread's processor time of `room_small`."""

REFITTING = (20.0, 17.0, 8.5, 10.5, 7.5, 5.0)
"""Time of refitting over that of measuring once."""

_LEAST_SHARE = 1e-6  # stands for 0, whose log-odds are infinite


class Quality(NamedTuple):
    """Estimated PSNR, dB, never rising, at L shares of the splats removed.

    >>> curve = Quality(np.array([0.2, 0.5, 0.8]), np.array([50.0, 40.0, 30.0]), np.zeros(3))
    >>> curve.at(0.5), curve.share(40.0)
    (40.0, 0.5)
    """

    shares: NDArray[np.float64]  # (L,), ascending
    psnr: NDArray[np.float64]  # (L,), with the lowest scores deleted
    merged: NDArray[np.float64]  # (L,), predicted for merging
    foretold: bool = True  # whether `merged` is accurate enough to be shown
    views: dict[str, NDArray[np.float64]] = {}  # by name, if rays hit
    hits: float = REFIT_HITS  # mean number of splats that a ray hits
    between: NDArray[np.float64] | None = None  # (L,), `psnr` of views in between

    def at(self, share: float, way: Way = "delete") -> float:
        """PSNR with a share removed, dB, interpolated linearly in the log-odds of the share."""
        return self._at(self._curve(way), share)

    def of_views(self, share: float, way: Way = "delete") -> dict[str, float]:
        """PSNR of single views, dB, taken to gain as much by a method as all views together."""
        return dict(zip(self.views, self._gained([*self.views.values()], share, way), strict=True))

    def at_between(self, share: float, way: Way = "delete") -> float | None:
        """PSNR of views in between, dB, taken to gain as much by a method; None if unknown."""
        return None if self.between is None else self._gained([self.between], share, way)[0]

    def _gained(self, curves, share, way):
        """PSNR of views by these, (L,) each, dB: what deletion has, and what all views gain."""
        gain = self.at(share, way) - self.at(share)
        return [min(self._at(psnr, share) + gain, PSNR_CAP) for psnr in curves]

    def share(self, psnr: float, way: Way = "delete") -> float:
        """Largest share that leaves at least `psnr` dB, at most the last of the curve; or 0."""
        odds, values = self._odds(), [PSNR_CAP, *self._curve(way)]
        if psnr > PSNR_CAP:
            return 0.0
        if psnr <= values[-1]:
            return float(self.shares[-1])
        place = np.interp(-psnr, np.negative(values), odds)  # of equal values behind the last
        return float(1.0 / (1.0 + np.exp(-place)))

    def _curve(self, way):
        if way == "delete":
            return self.psnr
        gain = refit_gain(self.shares, self.hits) if way == "refit" else 0.0
        return np.minimum.accumulate(np.minimum(self.merged + gain, PSNR_CAP))

    def _odds(self):
        return [_log_odds(share) for share in (0.0, *self.shares.tolist())]

    def _at(self, psnr, share):
        return float(np.interp(_log_odds(share), self._odds(), [PSNR_CAP, *psnr]))

    def as_good(self, share: float, way: Way) -> bool:
        """Whether deleting a share is predicted to be about as good as merging or refitting."""
        plain = self.at(share)
        return deletion_will_do(plain) or plain > self.at(share, way) - AS_GOOD

    def facts(self) -> dict[str, Any]:
        """Plain JSON values; those of single views to hundredths of a dB."""
        curves = {name: getattr(self, name).tolist() for name in ("shares", "psnr", "merged")}
        views = {name: psnr.round(2).tolist() for name, psnr in self.views.items()}
        between = None if self.between is None else self.between.round(2).tolist()
        more = {"foretold": self.foretold, "hits": round(self.hits, 2)}
        return {**curves, **more, "views": views, "between": between}

    @classmethod
    def from_facts(cls, facts: Mapping[str, Any] | None) -> Quality | None:
        """Inverse of `facts`; None if they are malformed."""
        with suppress(AttributeError, KeyError, TypeError, ValueError):
            held, array = dict(facts or {}), partial(np.array, dtype=np.float64)
            shares, psnr, merged = map(array, (held["shares"], held["psnr"], held["merged"]))
            views = {str(name): array(each) for name, each in (held.get("views") or {}).items()}
            between = None if held.get("between") is None else array(held["between"])
            last = [] if between is None else [between]
            every = np.stack([shares, psnr, merged, *views.values(), *last])  # of one length
            hits, foretold = float(held.get("hits", REFIT_HITS)), bool(held.get("foretold", True))
            if every.ndim == 2 and every.size:
                return cls(shares, psnr, merged, foretold, views, hits, between)
        return None


def refit_gain(share: NDArray[np.float64] | float, hits: float) -> NDArray[np.float64]:
    """Predicted gain of refitting over merging, dB >= 0, by shares removed and mean hits of a ray.

    >>> [round(float(refit_gain(0.5, hits)), 2) for hits in (39.0, 78.0, 156.0)]
    [4.5, 3.2, 1.9]
    """
    fewer = FEWER_RAYS * math.log2(max(hits, 1.0) / REFIT_HITS)
    gain = np.interp(share, MERGED_SHARES, REFIT_GAIN) - fewer
    return np.asarray(gain.clip(0.0), np.float64)


def expected(scores: Any, share: float, measured: Mapping[Way, float | None]) -> dict[Way, Any]:
    """PSNR of each way to remove a share, dB: as measured, else predicted, also from merging's."""
    psnr, curve, rays = dict[Way, Any](), scores.quality, scores.ray_sample
    for way in WAYS:
        psnr[way] = measured.get(way)
        if psnr[way] is None and curve is not None and (curve.foretold or way == "delete"):
            psnr[way] = curve.at(share, way)
    merged = measured.get("merge")
    if measured.get("refit") is None and merged is not None:
        psnr["refit"] = None
        if rays is not None and len(scores.values) >= FEWEST:
            psnr["refit"] = min(merged + float(refit_gain(share, rays.hits_of_ray())), PSNR_CAP)
    return psnr


def deletion_will_do(psnr: float | None) -> bool:
    """Whether nobody sees what deletion at `psnr` dB loses; also if views see too little (None)."""
    return psnr is None or psnr > INVISIBLE


def needed(gone: int | None, count: int) -> int | None:
    """How many of `count` splats need their final order if `gone` are removed; None if all.

    Up to the next of `MERGED_SHARES`, so that the curve up to there equals the whole curve.
    """
    places = (math.floor(share * count) for share in MERGED_SHARES)
    return None if gone is None else next((place for place in places if place >= gone), None)


def merged_from(
    psnr: NDArray[np.float64], gains: NDArray[np.float64], count: int
) -> NDArray[np.float64]:
    """Predicted PSNR of merging at the first L of `SHARES`, (L,) dB (docs/method.md, section 5).

    `psnr`, (L,), is that by deletion. `gains`, dB at the first of `MERGED_SHARES`, are of rays
    where nearest kept hits stand in: no bound, but they vary between scenes as merging's do.
    """
    constant, factor, fewer = np.array([*GAIN, FEWER])[:, : len(gains)]
    halvings = max(math.log2(FULL_GAIN / max(count, 1)), 0.0)
    merging = (constant + factor * gains - halvings * fewer).clip(0.0)
    shares = (PLAIN, *MERGED_SHARES[: len(gains)])
    gain = np.interp(SHARES[: len(psnr)], shares, np.concatenate([[0.0], merging]))
    return np.minimum.accumulate(np.minimum(psnr + gain, PSNR_CAP))


def left_to_lose(goal: float, psnr: float | None) -> float:
    """PSNR that a second change must keep so that both reach `goal`, dB: squared errors add up.

    >>> round(left_to_lose(40.0, 43.0103), 2), left_to_lose(40.0, 39.0)
    (43.01, inf)
    """
    if psnr is None:
        return goal
    left = 10.0 ** (-goal / 10.0) - 10.0 ** (-psnr / 10.0)
    return -10.0 * math.log10(left) if left > 0.0 else math.inf


def out_of_reach(goal: float, gone: int, count: int, psnr: float | None) -> str:
    """Sentence on why a budget of `goal` dB removed just `gone` of `count` splats, or "".

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
    """An estimate as a user needs it, "about 38 dB" or "more than 60 dB"."""
    return f"more than {UNSEEN:.0f} dB" if psnr > UNSEEN else f"about {psnr:.0f} dB"


def parted(psnr: float | None, between: float | None) -> bool:
    """Whether views in between visibly lose more than those that decided, see `PARTED`."""
    return psnr is not None and between is not None and min(psnr, NOTICED) - between > PARTED


def in_views(psnr: float, between: float | None) -> str:
    """An estimate for the views that decided and for those in between, in words.

    >>> in_views(50.2, 36.1), in_views(50.2, None)
    ('about 50 dB in these views, about 36 between them', 'about 50 dB in these views')
    """
    here = f"{in_words(psnr)} in these views"
    if between is None:
        return here
    if in_words(psnr) == in_words(between):
        return f"{here} and between them"
    return f"{here}, {in_words(between).removesuffix(' dB')} between them"


def expected_seconds(scored: float, share: float, *, once: bool) -> dict[Way, float]:
    """Predicted seconds of each method after `scored` seconds of scoring, `once` or in rounds.

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
