"""Volumes that say which splats must stay and which must go, by where their centres lie."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import reduce
from operator import or_
from typing import Any, Literal, Protocol

import numpy as np
from numpy.typing import NDArray

from .affine import is_flat, moved, scales_of
from .errors import RefineError

Role = Literal["protect", "remove", "keep"]


class Volume(Protocol):
    """A part of space."""

    def inside(self, points: NDArray[Any]) -> NDArray[np.bool_]:
        """Points, (N, 3) floating, that lie inside, (N,) bool; none that is not finite."""
        ...


@dataclass(frozen=True)
class Box:
    """A box along the axes. It holds its lower faces and not its upper ones, so boxes side by side
    share no point.

    Attributes
    ----------
    low, high : tuple of 3 float
        Two corners; infinite where it has no end.

    Examples
    --------
    >>> Box((0, 0, 0), (1, 1, np.inf)).inside(np.array([[0.5, 0, 9], [0.5, 1, 9]])).tolist()
    [True, False]
    """

    low: tuple[float, float, float]
    high: tuple[float, float, float]

    def __post_init__(self) -> None:
        """Check the corners."""
        for axis, low, high in zip("xyz", self.low, self.high, strict=True):
            if not low < high:
                raise RefineError(
                    f"box goes from {low:g} to {high:g} in {axis}, expected a larger number last"
                )

    def inside(self, points: NDArray[Any]) -> NDArray[np.bool_]:
        """Points, (N, 3), that lie inside, (N,) bool."""
        between = ((points >= self.low) & (points < self.high)).all(axis=1)
        return np.asarray(between & np.isfinite(points).all(axis=1))


@dataclass(frozen=True)
class Sphere:
    """A sphere with its surface.

    Attributes
    ----------
    center : tuple of 3 float
    radius : float
    """

    center: tuple[float, float, float]
    radius: float

    def __post_init__(self) -> None:
        """Check the numbers."""
        if not np.isfinite([*self.center, self.radius]).all():
            raise RefineError(
                f"sphere at {self.center} has radius {self.radius}, expected finite numbers"
            )
        if self.radius <= 0.0:
            raise RefineError(f"sphere has radius {self.radius:g}, expected more than 0")

    def inside(self, points: NDArray[Any]) -> NDArray[np.bool_]:
        """Points, (N, 3), that lie inside, (N,) bool."""
        with np.errstate(over="ignore", under="ignore", invalid="ignore"):
            away: NDArray[np.float64] = points - np.asarray(self.center, np.float64)
            squared = np.square(np.float64(self.radius))
            return np.asarray(np.einsum("ij,ij->i", away, away) <= squared)


@dataclass(frozen=True, eq=False)
class MovedVolume:
    """A volume that a matrix has moved.

    Attributes
    ----------
    volume : Volume
    matrix : (4, 4) float64
        From its frame to that of the points.
    """

    volume: Volume
    matrix: NDArray[np.float64]

    def __post_init__(self) -> None:
        """Check the matrix."""
        if is_flat(self.matrix):
            scales = scales_of(self.matrix).round(9).tolist()
            raise RefineError(f"is flat (scales {scales}), expected a volume")

    def inside(self, points: NDArray[Any]) -> NDArray[np.bool_]:
        """Points, (N, 3), that lie inside, (N,) bool."""
        return self.volume.inside(moved(points, np.linalg.inv(self.matrix)))


def parse(text: str) -> Volume | None:
    """The volume that a text gives in numbers, None where it is a name.

    Raises
    ------
    RefineError
        If the numbers are no volume.

    Examples
    --------
    >>> parse("sphere:0,0,1.5,2")
    Sphere(center=(0.0, 0.0, 1.5), radius=2.0)
    >>> parse("box:0,0,0,1,1,inf").high
    (1.0, 1.0, inf)
    """
    kind, colon, rest = text.partition(":")
    if not colon or kind not in _FORMS:
        return None
    try:
        numbers: Any = tuple(map(float, rest.split(",")))
    except ValueError:
        numbers = ()
    if len(numbers) != len(_FORMS[kind].split(",")):
        raise RefineError(f"expected {kind}:{_FORMS[kind]} in numbers, got '{text}'")
    try:
        return Box(numbers[:3], numbers[3:]) if kind == "box" else Sphere(numbers[:3], numbers[3])
    except RefineError as error:
        raise RefineError(f"'{text}': {error}") from error


_FORMS = {"box": "x0,y0,z0,x1,y1,z1", "sphere": "x,y,z,radius"}


@dataclass(frozen=True, eq=False)
class Zone:
    """A volume with what becomes of the splats in it.

    Attributes
    ----------
    role : {"protect", "remove", "keep"}
        They stay; they go; or all others go, those in no volume of this kind.
    name : str
        Of the volume, for messages and the report.
    volume : Volume
        In the frame of the views.
    idle : bool
        Whether it may hold no splat, as a volume may from which they were removed.
    """

    role: Role
    name: str
    volume: Volume
    idle: bool = False


@dataclass(frozen=True, eq=False)
class Forced:
    """What volumes decide of N splats.

    Attributes
    ----------
    protected : (N,) bool or None
        Those that stay as they are, for this or another reason.
    removed : (N,) bool or None
        Those that go whatever they are worth; none that is protected.
    facts : list of dict
        For the report: ``role``, ``name`` and number of ``splats`` of each volume.
    """

    protected: NDArray[np.bool_] | None = None
    removed: NDArray[np.bool_] | None = None
    facts: tuple[dict[str, Any], ...] = ()

    def counts(self) -> dict[str, int]:
        """How many splats are ``protected`` and how many were ``removed_by_user``."""
        masks = {"protected": self.protected, "removed_by_user": self.removed}
        return {n: 0 if m is None else int(np.count_nonzero(m)) for n, m in masks.items()}

    def of(self, rows: NDArray[np.bool_]) -> Forced:
        """The same for the splats in `rows`, (N,) bool, alone."""
        masks = (self.protected, self.removed)
        protected, removed = (None if mask is None else mask[rows] for mask in masks)
        return Forced(protected, removed, self.facts)


def forced(
    zones: Sequence[Zone],
    means: NDArray[Any],
    protected: NDArray[np.bool_] | None = None,
    removed: NDArray[np.bool_] | None = None,
) -> Forced:
    """What must stay and what must go by volumes.

    Parameters
    ----------
    zones : sequence of Zone
    means : (N, 3) floating
        Centres of the splats, in the frame of the volumes.
    protected, removed : (N,) bool, optional
        Splats that stay, and that go, for another reason.

    Returns
    -------
    Forced

    Raises
    ------
    RefineError
        If a volume holds no splat and is not `Zone.idle`, or all splats would go.
    """
    inside = [(zone, zone.volume.inside(means)) for zone in zones]
    for zone, mask in inside:
        if not zone.idle and not mask.any():
            raise RefineError(f"{zone.name} holds the centre of no splat ({_extent(means)})")
    facts = tuple(
        {"role": zone.role, "name": zone.name, "splats": int(np.count_nonzero(mask))}
        for zone, mask in inside
    )
    protect, remove, keep = (
        _any(*(mask for zone, mask in inside if zone.role == role))
        for role in ("protect", "remove", "keep")
    )
    protected = _any(protected, protect)
    removed = _any(removed, remove, None if keep is None else ~keep)
    if removed is not None:
        gone = must_go(removed, protected)
        removed = np.zeros_like(removed) if gone is None else gone
    return Forced(protected, removed, facts)


def _any(*masks: NDArray[np.bool_] | None) -> NDArray[np.bool_] | None:
    given = [mask for mask in masks if mask is not None]
    return reduce(or_, given) if given else None


def must_go(
    removed: NDArray[np.bool_] | None, protected: NDArray[np.bool_] | None = None
) -> NDArray[np.bool_] | None:
    """Which splats are removed and not protected, (N,) bool; None if none are.

    Raises
    ------
    RefineError
        If all are.
    """
    gone = removed if protected is None or removed is None else removed & ~protected
    if gone is None or not gone.any():
        return None
    if gone.all():
        raise RefineError(f"all {len(gone)} splats lie where they must go; nothing was removed")
    return gone


def _extent(means: NDArray[Any]) -> str:
    """In words, from where to where splats lie."""
    finite = means[np.isfinite(means).all(axis=1)]
    if not len(finite):
        return "there is none with a finite centre"
    low, high = (",".join(f"{x:g}" for x in ends(finite, axis=0)) for ends in (np.min, np.max))
    return f"they lie from {low} to {high}"
