"""What every scoring method returns."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:
    from numpy.typing import NDArray

_DISTINCT = 1 << 24
"""Up to so many equal steps from 0 to 1 are distinct as float32."""


@dataclass(frozen=True, eq=False)
class Scores:
    """How much the views would miss each of N splats.

    Attributes
    ----------
    values : (N,) float32
        Finite, >= 0; 0 only for splats that no renderer can draw. Each method has its own scale.
    seen : (N,) int32
        In how many of the views used the splat's centre lies.
    views_used : int
        How many views decided.
    undrawable : int
        How many splats no renderer can draw.
    weights : dict of str to float
        The method's weights, for the report.
    notes : tuple of str
        What the user should know about how the scores came to be.
    method : str
        Name of the method asked for, as in `Settings.method`; "" where it is not known.
    frustum : bool
        Whether `seen` counts only the views in whose image the centre lies; without, all views see
        all splats.
    views_given : int
        How many views there were to choose those used from.
    """

    values: NDArray[np.float32]
    seen: NDArray[np.int32]
    views_used: int
    undrawable: int
    weights: dict[str, Any] = field(default_factory=dict)
    notes: tuple[str, ...] = ()
    method: str = ""
    frustum: bool = True
    views_given: int = 0


def shares_gone(places: NDArray[np.int64], count: int) -> NDArray[np.float32]:
    """Return the share of `count` splats that have gone once the splat at each place goes.

    Above 2^24 splats float32 has fewer numbers near 1 than there are places. A share that would
    then equal the next is lowered to the nearest number below it, so that the order stays whole;
    the highest shares are too low there, the lowest exact.

    Parameters
    ----------
    places : (N,) int64
        From 1, which goes first, to `count`, which goes last.
    count : int

    Returns
    -------
    (N,) float32
        In (0, 1]; larger for a later place.

    Examples
    --------
    >>> shares_gone(np.array([1, 2, 4]), 4).tolist()
    [0.25, 0.5, 1.0]
    """
    shares = (places / count).astype(np.float32)
    if count <= _DISTINCT:
        return shares
    # The bits of positive floats, read as integers, are in the same order without a gap.
    highest = np.float32(1.0).view(np.int32) - (count - places)
    return np.minimum(shares.view(np.int32), highest).astype(np.int32).view(np.float32)
