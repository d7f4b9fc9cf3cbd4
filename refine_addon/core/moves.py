"""Which affine maps took points from where they were to where they are."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from .affine import moved
from .execute import chunks

LEAST = 6
"""Points that a map is found of at least: any four have one in common."""

_MOST = 32
"""Maps that are looked for."""

_NOISE = 4e-6
"""Rounding of float32, relative to the terms that make a coordinate: 32 times its precision."""

_FLAT = 1e-5
"""Thickness over extent of points that count as lying in a plane."""

_SAMPLE, _FITTED = 2048, 16384
"""Points by which candidates are compared, and to which a map is fitted at last; evenly spread."""

_ROWS = 1 << 14
"""Points that are mapped at a time."""

_TRIES, _DRAWN = 240, 4
"""Candidates for each map, and points that each is fitted to: the fewest that determine one."""

_BLOCKS = (1.0, 0.1, 0.01)
"""Shares of the points, in a row, from which a candidate draws: what was joined or copied lies
together, what was selected by hand does not."""


class Move(NamedTuple):
    """Points that one affine map moved.

    Attributes
    ----------
    rows : (M,) int64
    matrix : (4, 4) float64
        From where they were. Its linear part is exactly the identity where they were not moved, or
        moved alike.
    """

    rows: NDArray[np.int64]
    matrix: NDArray[np.float64]


def affine_moves(before: NDArray[Any], after: NDArray[Any]) -> list[Move]:
    """Maps that explain how points moved, those that did not move first.

    A map is fitted to all points, and where it does not fit, to a few that are drawn at random, of
    which the map is taken that most points agree with (RANSAC, Fischler and Bolles 1981); then the
    rest is looked at. The draws are the same at each call.

    Parameters
    ----------
    before, after : (N, 3) floating
        Rounded to float32 once or a few times.

    Returns
    -------
    list of Move
        Each point is in one of them at most: none explains those that were moved one by one, and
        those that are not finite.
    """
    before, after = np.asarray(before, np.float64), np.asarray(after, np.float64)
    finite = np.isfinite(before).all(axis=1) & np.isfinite(after).all(axis=1)
    same = finite & (before == after).all(axis=1)
    moves = [Move(np.flatnonzero(same), np.eye(4))] if same.any() else []
    left = np.flatnonzero(finite & ~same)
    random = np.random.default_rng(0)
    while len(left) >= LEAST and len(moves) <= _MOST:
        some = slice(None) if len(left) == len(before) else left
        matrix, fits = _best(before[some], after[some], random)
        if matrix is None:
            break
        moves.append(Move(left[fits], matrix))
        left = left[~fits]
    return moves


def _best(before, after, random):
    """Map that most points agree with, (4, 4), None where hardly any, and which do."""
    whole = _refined(before, after, np.arange(len(before)))
    if whole is not None and (fits := _fits(whole, before, after)).all():
        return whole, fits
    some = _spread(np.arange(len(before)), _SAMPLE)
    best, most = None, LEAST - 1
    for number in range(_TRIES):
        share = int(len(before) * _BLOCKS[number % len(_BLOCKS)])
        size = max(min(len(before), 2 * _DRAWN), share)
        start = random.integers(0, len(before) - size + 1)
        drawn = start + random.choice(size, min(size, _DRAWN), replace=False)
        matrix = _fitted(before[drawn], after[drawn])
        if matrix is None:
            continue
        # Few points tell a map less exactly than all that agree with it.
        agree = _fits(matrix, before[some], after[some], slack=100.0)
        if np.count_nonzero(agree) >= LEAST:
            better = _fitted(before[some][agree], after[some][agree])
            matrix = matrix if better is None else better
        agreeing = int(np.count_nonzero(_fits(matrix, before[some], after[some])))
        if agreeing > most:
            best, most = matrix, agreeing
        if most > len(some) // 2:
            break
    if best is not None:
        best = _refined(before, after, np.flatnonzero(_fits(best, before, after)))
    if best is None:
        return None, np.zeros(len(before), np.bool_)
    return best, _fits(best, before, after)


def _spread(rows, most):
    """At most so many of some rows, evenly spread."""
    return rows[np.unique(np.linspace(0, len(rows) - 1, most).astype(np.int64))]


def _refined(before, after, agree):
    """Map of points that agree, (4, 4); a translation where that explains them."""
    if len(agree) < LEAST:
        return None
    rows = _spread(agree, _FITTED)
    before, after = before[rows], after[rows]
    shift = np.eye(4)
    shift[:3, 3] = (after - before).mean(axis=0)
    if _fits(shift, before, after).all():
        return shift
    return _fitted(before, after)


def _fits(matrix, before, after, *, slack=1.0):
    """Which points a map takes to where they are but for rounding, (N,)."""
    fits = np.empty(len(before), np.bool_)
    turn, shift = np.abs(matrix[:3, :3]).T, np.abs(matrix[:3, 3])
    for part in chunks(len(before), _ROWS):  # whose arrays stay in the caches
        start, end = before[part], after[part]
        allowed = slack * _NOISE * (np.abs(start) @ turn + shift + np.abs(end)).max(axis=1)
        fits[part] = np.abs(moved(start, matrix) - end).max(axis=1) <= allowed
    return fits


def _fitted(before, after):
    """Affine map of least squares between points, (4, 4).

    Points in a plane say nothing of the direction across it. It is mapped across the plane that
    they lie in now, by the mean scale within it, and not mirrored. None for points on a line.
    """
    # Relative to their size: far points are rounded more coarsely.
    extents = np.abs(before).max(axis=1) + np.abs(after).max(axis=1)
    weights = 1.0 / (extents + (np.median(extents) or 1.0))
    middle, target = (np.average(points, axis=0, weights=weights) for points in (before, after))
    source = (before - middle) * weights[:, None]
    left, spread, axes = np.linalg.svd(source, full_matrices=False)
    if len(spread) < 3 or not spread[1] > _FLAT * spread[0]:
        return None
    flat = not spread[2] > _FLAT * spread[0]
    inverse = np.array([1.0 / spread[0], 1.0 / spread[1], 0.0 if flat else 1.0 / spread[2]])
    images = (inverse[:, None] * left.T) @ ((after - target) * weights[:, None])  # (3 axes, 3)
    if flat:
        images[2] = np.cross(images[0], images[1]) * np.linalg.det(axes)
        length = np.linalg.norm(images[2])
        images[2] /= np.sqrt(length) or 1.0
    matrix = np.eye(4)
    matrix[:3, :3] = (axes.T @ images).T
    matrix[:3, 3] = target - matrix[:3, :3] @ middle
    return matrix
