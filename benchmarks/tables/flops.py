"""Floating-point operations of scoring, for a splat and a view: by the formulas, and counted.

`ANALYTIC` is the count by hand of what the closed form's code does. `count` runs the code itself
with arrays that count: every element that an arithmetic function makes is one operation, of
whatever kind (a root or an exponential counts as one, as does a comparison of two floats); a sum of
n is n - 1; a matrix product as many as its sums and products. Copies, selections, sorting, integers
and booleans count nothing. What the core computes once for a splat and what it computes for each
view are told apart by counting with 16 views and with 32.
"""

from __future__ import annotations

import sys
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np

from refine_addon.core.scoring import closed_form, occlusion
from refine_addon.core.splats import ARRAYS, Splats
from refine_addon.core.views import ViewSet

from ..baselines.refine import refine
from ..renderer import rasterizer

READINGS = ("z", "distance", "default")
ANALYTIC = {
    "z: a row of four products and three sums; published, three differences more": (8, 0, 7),
    "x', y': two more rows": (0, 0, 14),
    "abs(x'), abs(y'), their maximum less z, a comparison: the frustum": (0, 0, 5),
    "two comparisons, two products: what is inside, and what reaches inside": (0, 0, 4),
    "d^2: z z, or three differences and products, two sums": (1, 8, 1),
    "+ eta, the division, weight and sum; published, weight / (d^2 + eta)": (3, 3, 4),
}
"""Term -> operations of a splat and a view, for both published readings and ours, in a view
that sees a part of the splats around it; the few that reach into it from outside are left out."""

PER_HIT = 34
"""Operations of the reference renderer for a splat in a pixel, least: 16 for alpha (offset 4, form
7, exponential and its factor, opacity, clamp, cut), 2 for T, 11 for colour, 5 for statistics."""

MOST_SPLATS = 50_000
"""How many splats are counted at most, at random: counting is slow, and the counts are averages."""

NOT_COUNTED = frozenset(
    {"logical_and", "logical_or", "logical_not", "isfinite", "isnan", "copyto", "signbit"}
)


class Counting(np.ndarray):
    """An array whose arithmetic is counted, in `total`."""

    total: ClassVar[int] = 0

    def __array_ufunc__(
        self,
        ufunc: np.ufunc,
        method: str,
        *inputs: Any,
        out: Any = None,
        **options: Any,
    ) -> Any:
        plain = [_plain(value) for value in inputs]
        if out is not None:
            options["out"] = tuple(_plain(value) for value in out)
        if "where" in options:
            options["where"] = _plain(options["where"])
        result = getattr(ufunc, method)(*plain, **options)
        if ufunc.__name__ not in NOT_COUNTED and any(map(_floating, [*plain, result])):
            Counting.total += _operations(ufunc, method, plain, result)
        return _counting(result) if out is None else out[0] if len(out) == 1 else out

    def __array_function__(self, function: Any, types: Any, args: Any, kwargs: Any) -> Any:
        del types
        if function is np.einsum:
            operands = [_plain(value) for value in args[1:]]
            result = np.einsum(args[0], *operands, **kwargs)
            sizes = {}
            for letters, operand in zip(args[0].split("->")[0].split(","), operands, strict=True):
                sizes.update(zip(letters, operand.shape, strict=True))
            Counting.total += len(operands) * int(np.prod(list(sizes.values()))) - np.size(result)
            return _counting(result)
        if function in (np.bincount, np.cumsum, np.interp):
            Counting.total += np.size(args[0])
        plain = [_plain(value) for value in args]
        if function in (np.bincount, np.cumsum, np.interp):
            return _counting(function(*plain, **{k: _plain(v) for k, v in kwargs.items()}))
        return super().__array_function__(function, (Counting,), args, kwargs)

    def cumsum(self, *args: Any, **kwargs: Any) -> Any:
        """Count what the C code of `ndarray` would do unseen."""
        return np.cumsum(self, *args, **kwargs)


@dataclass(frozen=True)
class Count:
    """Operations of one method: for each splat once, and for each splat and view."""

    method: str
    per_splat: float
    per_splat_view: float


@dataclass(frozen=True)
class Counts:
    """The table.

    Attributes
    ----------
    methods : list of Count
    failed : dict of str to str
        Method -> why it could not be counted.
    splats, views : int
    hits_per_splat_view : float
        Pixels in which a splat is drawn, over splats and views: what rendering pays for.
    """

    methods: list[Count]
    failed: dict[str, str]
    splats: int
    views: int
    hits_per_splat_view: float


def measure(splats: Splats, views: ViewSet) -> Counts:
    """Count every way to score, and the hits of rendering."""
    names = ["refine-z", "refine-distance", "closed-form", "occlusion"]
    if len(splats) > MOST_SPLATS:
        drawn = np.random.default_rng(0).choice(len(splats), MOST_SPLATS, replace=False)
        sample = splats.take(np.sort(drawn))
    else:
        sample = splats
    few, many = (views.take(np.arange(n) % len(views)) for n in (16, 32))
    found, failed = [], {}
    for name in names:
        try:
            less, more = (count(sample, v, name) / len(sample) for v in (few, many))
        except (TypeError, ValueError, AttributeError, IndexError) as error:
            failed[name] = f"{type(error).__name__}: {error}"
            continue
        per_view = (more - less) / 16
        found.append(Count(name, less - 16 * per_view, per_view))
        print(f"  {name}: {per_view:.1f} operations a splat and view", flush=True)
    statistics = rasterizer.accumulate_statistics(splats, few)
    hits = float(np.sum(statistics.hits)) / len(splats) / len(few)
    return Counts(found, failed, len(splats), len(views), hits)


def count(splats: Splats, views: ViewSet, method: str) -> int:
    """Return how many operations a method takes, without what is said of the views besides."""
    arrays = {name: np.asarray(getattr(splats, name)).view(Counting) for name in ARRAYS}
    with _counted():
        Counting.total = 0
        with np.errstate(under="ignore"):
            if method == "occlusion":
                occlusion.score(Splats(**arrays), views, threads=1)
            elif method == "closed-form":
                closed_form.score(Splats(**arrays), views, threads=1)
            else:
                refine(Splats(**arrays), views, method.removeprefix("refine-"))
        return Counting.total


@contextmanager
def _counted() -> Iterator[None]:
    """Let every module of the core make arrays that count."""
    modules = [
        module
        for name, module in sys.modules.items()
        if name.startswith("refine_addon.core") and getattr(module, "np", None) is np
    ]
    counting = _CountingNumPy()
    for module in modules:
        module.np = counting  # type: ignore[attr-defined]
    try:
        yield
    finally:
        for module in modules:
            module.np = np  # type: ignore[attr-defined]


class _CountingNumPy:
    """NumPy, but the arrays it makes count."""

    MAKERS: ClassVar[frozenset[str]] = frozenset(
        {"ones", "zeros", "empty", "full", "array", "asarray", "ascontiguousarray", "arange",
         "linspace", "stack", "concatenate", "hstack", "column_stack"}
    )  # fmt: skip

    def __getattr__(self, name: str) -> Any:
        value = getattr(np, name)
        if name not in self.MAKERS:
            return value
        return lambda *args, **kwargs: _counting(value(*args, **kwargs))


def _plain(value: Any) -> Any:
    return value.view(np.ndarray) if isinstance(value, Counting) else value


def _counting(value: Any) -> Any:
    if isinstance(value, tuple):
        return tuple(map(_counting, value))
    return value.view(Counting) if isinstance(value, np.ndarray) else value


def _floating(value: Any) -> bool:
    return np.issubdtype(getattr(value, "dtype", type(value)), np.inexact)


def _operations(ufunc: np.ufunc, method: str, inputs: list[Any], result: Any) -> int:
    """Return how many operations one call is."""
    if isinstance(result, tuple):
        result = result[0]
    if ufunc is np.matmul:
        return (2 * inputs[0].shape[-1] - 1) * int(np.size(result))
    if method == "reduce":
        return int(np.size(inputs[0])) - int(np.size(result))
    if method == "at":
        return int(np.size(inputs[1]))
    return int(np.size(result if result is not None else inputs[0]))
