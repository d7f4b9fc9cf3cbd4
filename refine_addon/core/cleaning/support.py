"""How much of the light on rays stops near a splat, and how much goes on to what lies behind.

    support = light that stops near the place / light that stops there or behind

A surface stops nearly all, a floater little. A hit lies where the splat's density peaks on the ray,
so an oblique wall is a surface. Two hits are near each other if their nearness (1 / depth, in scene
sizes) differs by less than `WINDOW` of it, or by less than `PARALLAX`.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..visibility.rays import in_front

WINDOW = 0.1
"""Hits on a ray are near each other if their nearness differs by less than this share of it."""

PARALLAX = 0.05
"""Or by less than this, 1 / scene size; cameras a scene size apart see more as a shift."""

REACHED = 1e-3
"""Share of the light that must reach a hit, or it is no evidence."""

NOTHING = 0.02
"""Share of the light that must stop behind a place, or nothing is behind it."""

SEEN = 0.1
"""A view sees what is at and behind a splat if this share of the light stops there."""

PAST = 0.15
"""A view sees past a splat if a lower share of the light stops near it."""

FRACTION = 0.999  # places on ray k have keys from k to k + this
_TINY = 1e-30  # replaces 0 as a divisor


class Light(NamedTuple):
    """The light on the rays of one view, at the h hits that it reaches, near to far on each ray."""

    hit: NDArray[np.int64]  # (u,), Gaussians hit
    owner: NDArray[np.int32]  # (h,), place in `hit`
    alpha: NDArray[np.float64]  # (h,)
    transmittance: NDArray[np.float64]  # (h,), in front
    weight: NDArray[np.float64]  # (h,), light that stops there: their product, 0 for absent ones
    key: NDArray[np.float64]  # (h,), see `Hits`
    window: NDArray[np.float64]  # (h,), difference of keys up to which hits are near

    def around(self, rows: NDArray[np.int64]) -> tuple[NDArray[np.int64], ...]:
        """First, last and end of the hits, (r,) each: near ones up to last, then those behind."""
        key, window, ray = self.key[rows], self.window[rows], np.floor(self.key[rows])
        end = ray + (1.0 + FRACTION) / 2.0
        first = np.searchsorted(self.key, np.maximum(key - window, ray))
        last = np.searchsorted(self.key, np.minimum(key + window, end), side="right")
        return first, last, np.searchsorted(self.key, end)

    def sums(self, rows: NDArray[np.int64], *values: NDArray[np.float64]) -> NDArray[np.float64]:
        """Sums over the hits `rows` of k values, (r,) each, for each of `hit`, (k, u)."""
        return np.stack([np.bincount(self.owner[rows], each, len(self.hit)) for each in values])


class Hits(NamedTuple):
    """The h hits of one view that may show once suspects are absent, near to far on each ray."""

    hit: NDArray[np.int64]  # (u,), Gaussians hit
    width: NDArray[np.float32]  # (u,), longer sigma over the image's longer side
    owner: NDArray[np.int32]  # (h,), place in `hit`
    alpha: NDArray[np.float32]  # (h,)
    key: NDArray[np.float64]  # (h,), ascending: ray number plus place on it, 0 to 1
    scale: float  # keys per unit of nearness, 1 / scene size

    def without(self, absent: NDArray[np.bool_]) -> Light:
        """The light on the rays if absent Gaussians, (M,), stop none."""
        ray = np.floor(self.key)
        present = (~absent[self.hit]).take(self.owner).astype(np.float64)
        alpha = self.alpha.astype(np.float64)
        log_front = in_front(np.log1p(-alpha) * present, np.unique(ray, return_counts=True)[1])
        reached = np.flatnonzero(log_front > math.log(REACHED))  # (h,)
        key, alpha, transmittance = self.key[reached], alpha[reached], np.exp(log_front[reached])
        nearness = (ray[reached] + FRACTION - key) / self.scale
        window = self.scale * np.maximum(WINDOW * nearness, PARALLAX)
        weight = transmittance * alpha * present[reached]
        return Light(self.hit, self.owner[reached], alpha, transmittance, weight, key, window)


class Evidence(NamedTuple):
    """Light on rays at the places of suspects, with all of them absent, (M,) each, else 0."""

    near: NDArray[np.float64]  # light that stops near, times the suspect's alpha
    behind: NDArray[np.float64]  # light that stops behind, times alpha
    contrast: NDArray[np.float64]  # `behind` times the difference of colour to what is there
    views: NDArray[np.float64]  # number of views that see what is at and behind the place
    past: NDArray[np.float64]  # number of these that see past it


def own_support(light: Light, wanted: NDArray[np.bool_]) -> NDArray[np.float64]:
    """Light that stops at each of `Light.hit`, and this light times support by others, (2, u).

    Support is as if the splat were gone: what lies behind gets ``1 / (1 - alpha)`` times the light.
    """
    rows = np.flatnonzero(wanted[light.hit].take(light.owner) & (light.weight > 0.0))
    before = _running(light.weight)
    first, last, end = light.around(rows)
    more = 1.0 / (1.0 - light.alpha[rows])
    near = before[rows] - before[first]
    near += (before[last] - before[rows + 1]) * more
    behind = (before[end] - before[last]) * more
    support = near / np.maximum(near + behind, _TINY)
    support = np.where(behind > NOTHING * light.transmittance[rows], support, 1.0)
    weight = light.weight[rows]
    return light.sums(rows, weight, weight * support)


def evidence_of(
    light: Light, suspects: NDArray[np.bool_], colors: NDArray[np.float32]
) -> NDArray[np.float64]:
    """`Evidence` of one view on each of `Light.hit`, (5, u), by light with all suspects absent."""
    rows = np.flatnonzero(suspects[light.hit].take(light.owner))
    before = _running(light.weight)
    first, last, end = light.around(rows)
    near, behind = before[last] - before[first], before[end] - before[last]
    squared = np.zeros(len(rows))
    for channel in colors[light.hit].T.astype(np.float64):
        own = channel.take(light.owner)
        before = _running(light.weight * own)
        squared += (own[rows] - (before[end] - before[last]) / np.maximum(behind, _TINY)) ** 2
    contrast = np.where(behind > NOTHING, np.sqrt(squared / 3.0), 0.0)  # root mean square
    alpha = light.alpha[rows]
    mass, stops, passes, differs = light.sums(
        rows, alpha, alpha * near, alpha * behind, alpha * behind * contrast
    )
    sees = (stops + passes > SEEN * mass) & (mass > 0.0)
    past = sees & (stops < PAST * (stops + passes))
    return np.stack([stops, passes, differs, sees, past])


def share(part: NDArray[np.float64], whole: NDArray[np.float64]) -> NDArray[np.float64]:
    """Part over whole, (M,) each; 1 where the whole is 0."""
    return np.divide(part, whole, out=np.ones_like(whole), where=whole > 0.0)


def _running(values: NDArray[np.float64]) -> NDArray[np.float64]:
    """Sum of the values before each place, and of all, (h + 1,)."""
    return np.append(0.0, np.cumsum(values))
