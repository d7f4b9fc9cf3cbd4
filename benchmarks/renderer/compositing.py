"""Pixels out of footprints, tile by tile, and what each splat does to them.

The rules are those of `rasterizer`.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numba
import numpy as np
from numpy.typing import NDArray

from .footprints import (
    ALPHA_CUT,
    COLUMNS,
    DETERMINANT,
    LIMIT,
    OPACITY,
    RED,
    A,
    B,
    C,
    Footprints,
    U,
    V,
    disc_distance,
)

TILE = 16
"""Side of a tile, pixels."""
ALPHA_MAX = 0.99
TRANSMITTANCE_STOP = 1e-4

# Columns of what is summed for every splat.
WEIGHT, WEIGHT_MAX, OPACITY_SUM, HITS, REMOVAL, SUMS = 0, 1, 2, 3, 4, 5


class Bins(NamedTuple):
    """Which footprints every tile meets: ``entries[starts[t]:starts[t + 1]]``, front to back."""

    starts: NDArray[np.int64]
    entries: NDArray[np.int32]


class Target(NamedTuple):
    """Where the tiles draw.

    - background, (3,) float64
    - image, (H, W, 3) float64
    - sums, (entries of the bins, 5) float64: What each splat does in each tile; empty where nobody
      asks.
    """

    background: NDArray[np.float64]
    image: NDArray[np.float64]
    sums: NDArray[np.float64]


@numba.njit(cache=True)
def bins_of(boxes: NDArray[np.int32], width: int, height: int) -> Bins:
    """Distribute the footprints over the tiles; each tile keeps their order, so none is sorted."""
    across = (width + TILE - 1) // TILE
    down = (height + TILE - 1) // TILE
    starts = np.zeros(across * down + 1, np.int64)
    for k in range(len(boxes)):
        for row in range(boxes[k, 2] // TILE, boxes[k, 3] // TILE + 1):
            for column in range(boxes[k, 0] // TILE, boxes[k, 1] // TILE + 1):
                starts[row * across + column + 1] += 1
    starts = np.cumsum(starts)
    entries = np.empty(starts[-1], np.int32)
    fill = starts[:-1].copy()
    for k in range(len(boxes)):
        for row in range(boxes[k, 2] // TILE, boxes[k, 3] // TILE + 1):
            for column in range(boxes[k, 0] // TILE, boxes[k, 1] // TILE + 1):
                tile = row * across + column
                entries[fill[tile]] = k
                fill[tile] += 1
    return Bins(starts, entries)


@numba.njit(cache=True, parallel=True)
def draw_tiles(
    order: NDArray[np.int64], bins: Bins, footprints: Footprints, target: Target
) -> None:
    """Draw every tile, the threads taking equal runs of `order`."""
    for k in numba.prange(len(order)):
        _draw_tile(order[k], bins, footprints, target)


@numba.njit(cache=True)
def _draw_tile(tile: int, bins: Bins, footprints: Footprints, target: Target) -> None:
    """Collect the hits of a tile, then compose each pixel from its own list of them."""
    background, image = target.background, target.image
    height, width = image.shape[:2]
    across = (width + TILE - 1) // TILE
    left, top = tile % across * TILE, tile // across * TILE
    mine = slice(bins.starts[tile], bins.starts[tile + 1])
    entries, sums = bins.entries[mine], target.sums[mine]
    # Removing a splat divides what is behind it by 1 - alpha >= 0.01, so splats that come after
    # the end of the pixel can appear: their hits are needed too. 0.99 is a margin for rounding.
    stop = TRANSMITTANCE_STOP * (0.99 * (1.0 - ALPHA_MAX) if len(sums) else 1.0)
    size = min(TILE, width - left), min(TILE, height - top)
    starts, owners, alphas = tile_hits(entries, footprints, (left, top), size, stop)
    longest = np.max(np.diff(starts))
    through, colors = np.empty(longest + 1), np.empty((longest + 1, 3))
    for pixel in range(size[0] * size[1]):
        hits = slice(starts[pixel], starts[pixel + 1])
        shown = entries[owners[hits]]
        end = compose(shown, alphas[hits], footprints.table, through, colors)
        row = image[top + pixel // size[0], left + pixel % size[0]]
        for channel in range(3):
            row[channel] = colors[end, channel] + background[channel] * through[end]
        if len(sums):
            blended = through, colors, background
            opacities = footprints.table[shown, OPACITY]
            _count_hits((owners[hits], alphas[hits], opacities), end, through, sums)
            removal_errors(owners[hits], alphas[hits], end, blended, sums)


@numba.njit(cache=True)
def tile_hits(
    entries: NDArray[np.int32],
    footprints: Footprints,
    corner: tuple[int, int],
    size: tuple[int, int],
    stop: float,
) -> tuple[NDArray[np.int64], NDArray[np.int32], NDArray[np.float64]]:
    """Find which splats cover which pixels of a tile, until a pixel's transmittance is < `stop`.

    - returned starts, (pixels + 1,) int64: Hits of pixel p (row by row in the tile) are
      ``starts[p]:starts[p + 1]``, front to back; the last of them may be the one that took the
      transmittance below `stop`.
    - returned owners, (hits,) int32: Which of `entries` it is.
    - returned alphas, (hits,) float64
    """
    pixels = size[0] * size[1]
    through = np.ones(pixels)
    starts = np.zeros(pixels + 1, np.int64)
    count, alive = 0, pixels
    places, owners, alphas = np.empty(2048, np.int32), np.empty(2048, np.int32), np.empty(2048)
    for k in range(len(entries)):
        if alive == 0:
            break
        if count + pixels > len(owners):
            places, owners = _doubled(places), _doubled(owners)
            alphas = _doubled(alphas)
        before = count
        count = _splat_hits(
            footprints.table[entries[k]],
            footprints.boxes[entries[k]],
            (corner, size),
            (through, stop),
            (places, alphas, count),
        )
        for hit in range(before, count):
            owners[hit] = k
            starts[places[hit] + 1] += 1
            through[places[hit]] *= 1.0 - alphas[hit]
            if through[places[hit]] < stop:
                alive -= 1
    # A counting sort by pixel; it keeps the order of equal ones, front to back.
    starts = np.cumsum(starts)
    fill = starts[:-1].copy()
    sorted_owners, sorted_alphas = np.empty(count, np.int32), np.empty(count)
    for hit in range(count):
        place = fill[places[hit]]
        sorted_owners[place], sorted_alphas[place] = owners[hit], alphas[hit]
        fill[places[hit]] += 1
    return starts, sorted_owners, sorted_alphas


@numba.njit(cache=True)
def _doubled(values: NDArray[Any]) -> NDArray[Any]:
    """Return a copy with room for twice as many."""
    larger = np.empty(2 * len(values), values.dtype)
    larger[: len(values)] = values
    return larger


@numba.njit(cache=True)
def _splat_hits(
    row: NDArray[np.float64],
    box: NDArray[np.int32],
    region: tuple[tuple[int, int], tuple[int, int]],
    progress: tuple[NDArray[np.float64], float],
    hits: tuple[NDArray[np.int32], NDArray[np.float64], int],
) -> int:
    """Append one splat's unfinished pixels and alphas to `hits`; return how many there are then.

    On a row of pixels at height d from the centre, ``a e^2 + 2 b e d + c d^2 <= limit`` holds for
    e within ``sqrt(a limit - d^2 / det) / a`` of ``-b d / a``, because ``a c - b^2 = 1 / det``.
    """
    if len(row) > COLUMNS:
        return _disc_hits(row, box, region, progress, hits)
    (left, top), (width, height) = region
    through, stop = progress
    places, alphas, count = hits
    first_column, last_column = max(box[0] - left, 0), min(box[1] - left, width - 1)
    for j in range(max(box[2] - top, 0), min(box[3] - top, height - 1) + 1):
        dy = top + j + 0.5 - row[V]
        square = row[A] * row[LIMIT] - dy * dy / row[DETERMINANT]
        if square < 0.0:
            continue
        reach = math.sqrt(square) / row[A] + 1e-6
        middle = row[U] - row[B] / row[A] * dy - 0.5 - left
        begin = max(first_column, math.ceil(max(middle - reach, -1.0)))
        end = min(last_column, math.floor(min(middle + reach, 1.0 * TILE)))
        for i in range(begin, end + 1):
            place = j * width + i
            if through[place] < stop:
                continue
            dx = left + i + 0.5 - row[U]
            square = row[A] * dx * dx + 2.0 * row[B] * dx * dy + row[C] * dy * dy
            alpha = min(ALPHA_MAX, row[OPACITY] * math.exp(-0.5 * square))
            if alpha >= ALPHA_CUT:
                places[count], alphas[count] = place, alpha
                count += 1
    return count


@numba.njit(cache=True)
def _disc_hits(
    row: NDArray[np.float64],
    box: NDArray[np.int32],
    region: tuple[tuple[int, int], tuple[int, int]],
    progress: tuple[NDArray[np.float64], float],
    hits: tuple[NDArray[np.int32], NDArray[np.float64], int],
) -> int:
    """Do the same for a disc: every pixel of its box is asked."""
    (left, top), (width, height) = region
    through, stop = progress
    places, alphas, count = hits
    for j in range(max(box[2] - top, 0), min(box[3] - top, height - 1) + 1):
        for i in range(max(box[0] - left, 0), min(box[1] - left, width - 1) + 1):
            place = j * width + i
            if through[place] < stop:
                continue
            square = disc_distance(row, left + i + 0.5, top + j + 0.5)
            alpha = min(ALPHA_MAX, row[OPACITY] * math.exp(-0.5 * square))
            if alpha >= ALPHA_CUT:
                places[count], alphas[count] = place, alpha
                count += 1
    return count


@numba.njit(cache=True)
def compose(
    shown: NDArray[np.int32],
    alphas: NDArray[np.float64],
    table: NDArray[np.float64],
    through: NDArray[np.float64],
    colors: NDArray[np.float64],
) -> int:
    """Blend one pixel's hits front to back, on past its end.

    Fills ``through[k]`` and ``colors[k]``, transmittance and colour in front of hit k, up to and
    including ``k = len(shown)``, and returns how many hits are drawn.
    """
    through[0], colors[0] = 1.0, 0.0
    end = len(shown)
    for k in range(len(shown)):
        through[k + 1] = through[k] * (1.0 - alphas[k])
        if through[k + 1] < TRANSMITTANCE_STOP and end == len(shown):
            end = k
        for channel in range(3):
            value = table[shown[k], RED + channel]
            colors[k + 1, channel] = colors[k, channel] + alphas[k] * through[k] * value
    return end


@numba.njit(cache=True)
def _count_hits(
    hits: tuple[NDArray[np.int32], NDArray[np.float64], NDArray[np.float64]],
    end: int,
    through: NDArray[np.float64],
    sums: NDArray[np.float64],
) -> None:
    """Add the `end` drawn hits of a pixel (owners, alphas, opacities) to all sums but removal."""
    owners, alphas, opacities = hits
    for k in range(end):
        row = sums[owners[k]]
        row[WEIGHT] += alphas[k] * through[k]
        row[WEIGHT_MAX] = max(row[WEIGHT_MAX], alphas[k] * through[k])
        row[OPACITY_SUM] += opacities[k] * through[k]
        row[HITS] += 1.0


@numba.njit(cache=True)
def removal_errors(
    owners: NDArray[np.int32],
    alphas: NDArray[np.float64],
    end: int,
    blended: tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]],
    sums: NDArray[np.float64],
) -> None:
    """Add to each splat the squared change of this pixel if that splat alone were removed.

    Write T_k for the transmittance and C_k for the colour in front of hit k, so that
    ``C_{k+1} = C_k + a_k T_k c_k``, ``T_{k+1} = (1 - a_k) T_k``, and let hits 0 .. n - 1 be drawn
    (n is the first with T_{n+1} < 1e-4, or their number). The pixel is ``P = C_n + T_n G``, G the
    background. Without hit i, everything in front of it stays, and every transmittance behind it
    grows by 1 / (1 - a_i)::

        P' = C_i + (C_m - C_{i+1}) / (1 - a_i) + T_m / (1 - a_i) G

    where m >= n is the first hit behind i with T_{m+1} / (1 - a_i) < 1e-4: the pixel now ends
    later. If the end did not move (m = n), with B = ((C_n - C_{i+1}) + T_n G) / T_{i+1} the colour
    seen behind i, ``P' - P = a_i T_i (B - c_i)``: its weight times its contrast to what it hides.
    Hit n, which ended the pixel without being drawn, changes it too: hits behind it are drawn
    once it is gone. Hits after n change nothing.

    P' is compared with P directly, so no term is left out; what remains is rounding, about 1e-14
    of the colours per pixel (before squaring), and the decision m where a transmittance
    meets the stop to the last bit.

    - owners, (hits,) int32: Row of `sums` for each hit of the pixel.
    - alphas, (hits,) float64: The hits go on past `end` until T < 1e-6, so that m is always among
      them.
    - end: n.
    - blended: T, (hits + 1,); C, (hits + 1, 3); background (3,).
    - sums, (entries, 5) float64: Column `REMOVAL` is added to.
    """
    through, colors, background = blended
    for i in range(min(end + 1, len(owners))):
        rest = 1.0 - alphas[i]
        last = max(end, i + 1)
        while last < len(owners) and through[last + 1] >= TRANSMITTANCE_STOP * rest:
            last += 1
        for channel in range(3):
            with_it = colors[end, channel] + through[end] * background[channel]
            behind = colors[last, channel] - colors[i + 1, channel]
            behind += through[last] * background[channel]
            change = colors[i, channel] + behind / rest - with_it
            sums[owners[i], REMOVAL] += change * change


@numba.njit(cache=True)
def merge(
    entries: NDArray[np.int32],
    index: NDArray[np.int64],
    entry_sums: NDArray[np.float64],
    sums: NDArray[np.float64],
) -> None:
    """Add up the tiles' sums for every splat, tile by tile, so that threads do not matter."""
    for k in range(len(entries)):
        splat = index[entries[k]]
        largest = max(sums[splat, WEIGHT_MAX], entry_sums[k, WEIGHT_MAX])
        for column in range(SUMS):
            sums[splat, column] += entry_sums[k, column]
        sums[splat, WEIGHT_MAX] = largest


@numba.njit(cache=True)
def add_up(
    entries: NDArray[np.int32], found: NDArray[np.float64], sums: NDArray[np.float64]
) -> None:
    """Add the rows that the tiles `found`, to those of the footprints, in order; as `merge`."""
    for k in range(len(entries)):
        sums[entries[k]] += found[k]
