"""The price of a budget as a picture: quality over what is removed, and what kind of splats go.

Arrays only: `price` shows them in the panel. Positions are pixels from the upper left.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..core.quality.curve import UNSEEN, WAYS, Quality, Way
from . import pixel_font

Color = tuple[float, float, float]
Box = tuple[float, float, float, float]  # left, top, right, bottom

SIZE = 212
"""Pixels of an edge at scale 1, where a pixel of a letter is one of the screen."""

BINS = 40
"""Bars of a histogram at most."""

_LEFT, _RIGHT, _TOP = 20, 202, 14  # of both plots, and of the upper one; pixels at scale 1
_MIDDLE, _LOWER, _BOTTOM = 116, 144, 198  # where the upper ends, the lower one begins and ends
_STEP = 10  # dB between two lines


@dataclass(frozen=True)
class Look:
    """How a picture fits the screen.

    Attributes
    ----------
    size : int
        Pixels of an edge.
    ink : tuple of float
        Colour of text and axes, sRGB in 0..1; light text stands on a dark ground.
    """

    size: int
    ink: Color

    @property
    def dark(self) -> bool:
        """Whether it stands on a dark ground."""
        return sum(self.ink) > 1.5

    @property
    def colors(self) -> dict[str, Color]:
        """Colours that the colour-blind tell apart too, by what they stand for, sRGB in 0..1."""
        if self.dark:
            blue, orange, green, red, grey = 0x56B4E9, 0xE69F00, 0x2FBF8F, 0xE8603C, 0x8C8C8C
        else:
            blue, orange, green, red, grey = 0x005A9C, 0xA85400, 0x00704F, 0xB5300F, 0x6A6A6A
        named = {"delete": blue, "merge": orange, "refit": green, "goes": red, "stays": grey}
        named |= {"in range": blue, "others": grey}
        return {name: _rgb(value) for name, value in named.items()}


@dataclass(frozen=True, eq=False)
class Histogram:
    """How many splats there are of each kind.

    Attributes
    ----------
    bins : (N,) uint8
        The bar that each splat belongs to.
    total : (B,) int64
        How many splats each bar has.
    ticks : tuple of (float, str)
        Places along the axis, 0 to 1, and what stands there.
    name : str
        What the splats are sorted by.
    parts : (str, str)
        What the two parts of each bar are, by their names in `Look.colors`: the lower one first.
    """

    bins: NDArray[np.uint8]
    total: NDArray[np.int64]
    ticks: tuple[tuple[float, str], ...]
    name: str
    parts: tuple[str, str] = ("goes", "stays")

    def going(self, keep: NDArray[np.bool_]) -> NDArray[np.int64]:
        """Return how many splats of each bar do not stay, (B,), for `keep`, (N,)."""
        return np.bincount(self.bins[~keep], minlength=len(self.total))


@dataclass(frozen=True)
class Place:
    """Where a budget lies.

    Attributes
    ----------
    share : float
        Of the splats that go, 0 to 1.
    way : {"delete", "merge", "refit"}
        What is done.
    """

    share: float
    way: Way = "delete"


def by_score(values: NDArray[np.float32]) -> Histogram:
    """Return how many splats score how much, (N,), by the logarithm of the score.

    The few that score least of all share the first bar with those that score 0.
    """
    positive = values[values > 0.0]
    if not len(positive):
        positive = np.ones(1, np.float32)
    low, high = np.log10(np.quantile(positive, [0.01, 1.0]))
    low, high = np.floor(low), np.ceil(high) + (np.floor(low) == np.ceil(high))
    with np.errstate(divide="ignore"):
        place = (np.log10(values) - low) / (high - low)
    bins = (place * BINS).clip(0, BINS - 1).astype(np.uint8)
    every = max(int(high - low) // 4, 1)
    powers = range(int(low), int(high) + 1, every)
    ticks = tuple((float((power - low) / (high - low)), f"1e{power}") for power in powers)
    return Histogram(bins, np.bincount(bins, minlength=BINS), ticks, "score")


def by_views(seen: NDArray[np.int32], views: int) -> Histogram:
    """Return how many splats lie in how many of the views, (N,); in none: the first bar."""
    count = min(max(views, 1), BINS - 1)
    # Bar 0 is for no view alone; the others share 1 .. views evenly.
    bins = np.ceil(seen * (count / max(views, 1))).clip(0, count).astype(np.uint8)
    ticks = ((0.0, "0"), (0.25, "25"), (0.5, "50 % of views"), (0.75, "75"), (1.0, "100"))
    return Histogram(bins, np.bincount(bins, minlength=count + 1), ticks, "views")


def _ways(quality: Quality) -> tuple[Way, ...]:
    """Of what kept splats may become curves are drawn."""
    return WAYS if quality.foretold else WAYS[:1]


class Chart:
    """The picture for one scoring; what does not change with the budget is drawn once.

    Parameters
    ----------
    look : Look
    quality : Quality or None
        The curve; without it there is only the histogram.
    histogram : Histogram
    """

    def __init__(self, look: Look, quality: Quality | None, histogram: Histogram) -> None:
        self.look, self.quality, self.histogram = look, quality, histogram
        self._scale = look.size / SIZE
        self._still = _Canvas(look.size)
        self._upper = _LOWER if quality is not None else _TOP  # where the histogram begins
        if quality is not None:
            least = min(float(quality.psnr[-1]), UNSEEN - 2 * _STEP)
            self._low = max(np.floor(least / _STEP) * _STEP, 0.0)
            self._draw_curves(quality)
        self._draw_axis(histogram.ticks, _BOTTOM)
        self._legend(histogram.parts, self._upper - 13, f"splats by {histogram.name}")
        self._barred = self._still
        self._bytes = self._still.bytes()

    def picture(
        self, place: Place | None, going: NDArray[np.int64] | None = None
    ) -> NDArray[np.uint8]:
        """Return the picture, (size, size, 4) uint8, lowest row first: RGB times alpha, and alpha.

        Parameters
        ----------
        place : Place or None
            Where the budget lies.
        going : (B,) int64, optional
            How many splats of each bar of the histogram go; by default as many as last time.
        """
        if going is not None:
            self._barred = self._still.part(slice(None))
            self._draw_bars(self._barred, going)
            self._bytes = self._barred.bytes()
        picture = self._bytes.copy()
        if place is not None and self.quality is not None:
            x = self.at(place.share, 0.0)[0]
            left = int(x - 8.0 * self._scale)
            columns = slice(left, left + int(16.0 * self._scale))
            strip = self._barred.part(columns)
            self._draw_place(strip, x - left, self.quality, place)
            picture[:, columns] = strip.bytes()
        return picture[::-1]

    def at(self, share: float, psnr: float) -> tuple[float, float]:
        """Return where a share removed and a PSNR lie in the upper plot, pixels from upper left."""
        height = (min(psnr, UNSEEN) - self._low) / (UNSEEN - self._low)
        x = _LEFT + share * (_RIGHT - _LEFT)
        return x * self._scale, (_MIDDLE - height * (_MIDDLE - _TOP)) * self._scale

    def _draw_curves(self, quality: Quality) -> None:
        canvas, colors = self._still, self.look.colors
        for psnr in np.arange(self._low, UNSEEN + 1.0, _STEP):
            y = self.at(0.0, psnr)[1]
            self._rule(canvas, _LEFT, y / self._scale, _RIGHT, 0.15)
            self._text(f"{psnr:.0f}", _LEFT - 4, y / self._scale - 4, align=1.0)
        ticks = ((0.0, "0"), (0.25, "25"), (0.5, "50 % removed"), (0.75, "75"), (1.0, "100"))
        self._draw_axis(ticks, _MIDDLE)
        columns = np.arange(round(self.at(0.0, 0.0)[0]), self.look.size)
        shares = (columns + 0.5 - self.at(0.0, 0.0)[0]) / (self.at(1.0, 0.0)[0] - columns[0])
        columns, shares = (
            columns[shares <= quality.shares[-1]],
            shares[shares <= quality.shares[-1]],
        )
        for name in reversed(_ways(quality)):
            heights = [self.at(share, quality.at(share, name))[1] for share in shares]
            canvas.curve(columns, np.array(heights), 2.0 * self._scale, colors[name])
        self._legend(_ways(quality), 0, "dB")

    def _draw_axis(self, ticks: Iterable[tuple[float, str]], y: float) -> None:
        self._rule(self._still, _LEFT, y, _RIGHT, 0.5)
        for place, text in ticks:
            x = _LEFT + place * (_RIGHT - _LEFT)
            self._box(self._still, (x - 0.5, y, x + 0.5, y + 3), self.look.ink, 0.5)
            # The last one ends where the picture does.
            width = pixel_font.drawn(text).shape[1]
            self._text(text, min(x + width / 2, SIZE), y + 5, align=1.0)

    def _legend(self, names: Iterable[str], y: float, title: str) -> None:
        self._text(title, 2, y)
        x = float(SIZE)
        for name in reversed(tuple(names)):
            color = self.look.colors[name]
            x -= pixel_font.drawn(name).shape[1]
            self._text(name, x, y)
            x -= 9
            self._box(self._still, (x, y + 1, x + 6, y + 7), color, 1.0)
            x -= 8

    def _draw_bars(self, canvas: _Canvas, going: NDArray[np.int64]) -> None:
        total = self.histogram.total
        height = (_BOTTOM - self._upper) * self._scale / max(int(total.max()), 1)
        left, right = _LEFT * self._scale, _RIGHT * self._scale
        columns = np.arange(int(np.ceil(left)), int(right))
        place = (columns + 0.5 - left) * len(total) / (right - left)
        gap = 1.0 - (place % 1.0) > self._scale * len(total) / (right - left)  # 1 pixel
        columns, bars = columns[gap], place.astype(np.int64)[gap]
        bottom = _BOTTOM * self._scale
        # A bar of a few splats among many is one pixel high, not nothing.
        tops = bottom - np.where(total > 0, np.maximum(total * height, self._scale), 0.0)
        split = bottom - np.where(going > 0, np.maximum(going * height, self._scale), 0.0)
        colors = self.look.colors
        canvas.columns(columns, tops[bars], split[bars], colors[self.histogram.parts[1]])
        canvas.columns(
            columns, split[bars], np.full(len(bars), bottom), colors[self.histogram.parts[0]]
        )

    def _draw_place(self, strip: _Canvas, x: float, quality: Quality, place: Place) -> None:
        half, (top, bottom) = 0.5 * self._scale, (_TOP * self._scale, _MIDDLE * self._scale)
        strip.box((x - half, top, x + half, bottom), self.look.ink, 0.8)
        for name in _ways(quality):
            y = self.at(place.share, quality.at(place.share, name))[1]
            chosen = name == place.way
            if chosen:
                strip.dot(x, y, 5.5 * self._scale, self.look.ink)
            strip.dot(x, y, (4.0 if chosen else 3.0) * self._scale, self.look.colors[name])

    def _rule(self, canvas: _Canvas, left: float, y: float, right: float, alpha: float) -> None:
        self._box(canvas, (left, y - 0.5, right, y + 0.5), self.look.ink, alpha)

    def _box(self, canvas: _Canvas, box: Box, color: Color, alpha: float) -> None:
        left, top, right, bottom = (edge * self._scale for edge in box)
        canvas.box((left, top, right, bottom), color, alpha)

    def _text(self, text: str, x: float, y: float, align: float = 0.0) -> None:
        """Write a line whose upper left corner is at (x, y), or its right one with `align` 1."""
        mask = pixel_font.drawn(text)
        zoom = max(round(self._scale), 1)
        mask = mask.repeat(zoom, axis=0).repeat(zoom, axis=1)
        left = round(x * self._scale - align * mask.shape[1])
        self._still.mask(mask, left, round(y * self._scale), self.look.ink)


class _Canvas:
    """An image that is painted on; its colours are multiplied by alpha, as Blender draws icons."""

    def __init__(self, size: int) -> None:
        self.pixels = np.zeros((size, size, 4), np.float32)

    def part(self, columns: slice) -> _Canvas:
        """Return a copy of some columns."""
        canvas = _Canvas(0)
        canvas.pixels = self.pixels[:, columns].copy()
        return canvas

    def bytes(self) -> NDArray[np.uint8]:
        """Return the image, (H, W, 4)."""
        return (self.pixels * 255.0 + 0.5).astype(np.uint8)

    def _paint(self, rows: slice, columns: slice, alpha: NDArray[np.float32], color: Color) -> None:
        """Lay a colour over a part of the image, as opaque as `alpha`, (R, C), says."""
        part = self.pixels[rows, columns]
        alpha = alpha[..., None]
        part *= 1.0 - alpha
        part += alpha * np.array([*color, 1.0], np.float32)

    def box(self, box: Box, color: Color, alpha: float) -> None:
        """Fill a rectangle; its edges go to the nearest pixels, and it is one wide at least."""
        left, top, right, bottom = map(round, box)
        rows = slice(max(top, 0), max(bottom, top + 1))
        columns = slice(max(left, 0), max(right, left + 1))
        shape = self.pixels[rows, columns].shape[:2]
        self._paint(rows, columns, np.full(shape, alpha, np.float32), color)

    def mask(self, mask: NDArray[np.bool_], left: int, top: int, color: Color) -> None:
        """Fill where `mask`, (H, W), is set, as far as it lies in the image."""
        left, top = max(left, 0), max(top, 0)
        rows, columns = slice(top, top + mask.shape[0]), slice(left, left + mask.shape[1])
        height, width = self.pixels[rows, columns].shape[:2]
        self._paint(rows, columns, mask[:height, :width].astype(np.float32), color)

    def columns(
        self,
        columns: NDArray[np.int64],
        tops: NDArray[np.float64],
        bottoms: NDArray[np.float64],
        color: Color,
    ) -> None:
        """Fill each of some columns, (C,), between two heights, (C,)."""
        if not len(columns):
            return
        rows = slice(max(int(tops.min()), 0), int(bottoms.max()) + 1)
        span = slice(int(columns[0]), int(columns[-1]) + 1)
        y = np.arange(rows.start, rows.stop)[:, None] + 0.5
        alpha = np.zeros((rows.stop - rows.start, span.stop - span.start), np.float32)
        alpha[:, columns - columns[0]] = (y > tops) & (y < bottoms)
        self._paint(rows, span, alpha, color)

    def curve(
        self, columns: NDArray[np.int64], heights: NDArray[np.float64], width: float, color: Color
    ) -> None:
        """Draw a curve through heights, (C,), in neighbouring columns, (C,), without jags."""
        if not len(columns):
            return
        y = np.arange(len(self.pixels))[:, None] + 0.5
        slope = np.gradient(heights) if len(heights) > 1 else np.zeros(1)
        distance = np.abs(y - heights) / np.sqrt(1.0 + slope**2)
        alpha = (0.5 * width + 0.5 - distance).clip(0.0, 1.0).astype(np.float32)
        self._paint(slice(None), slice(int(columns[0]), int(columns[-1]) + 1), alpha, color)

    def dot(self, x: float, y: float, radius: float, color: Color) -> None:
        """Draw a filled circle without jags."""
        rows = slice(max(int(y - radius) - 1, 0), int(y + radius) + 2)
        columns = slice(max(int(x - radius) - 1, 0), int(x + radius) + 2)
        height, width = self.pixels[rows, columns].shape[:2]
        down = rows.start + np.arange(height)[:, None] + 0.5 - y
        across = columns.start + np.arange(width) + 0.5 - x
        alpha = (radius + 0.5 - np.hypot(down, across)).clip(0.0, 1.0).astype(np.float32)
        self._paint(rows, columns, alpha, color)


def _rgb(value: int) -> Color:
    return ((value >> 16) / 255, (value >> 8 & 255) / 255, (value & 255) / 255)
