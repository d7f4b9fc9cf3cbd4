"""What every scoring method returns."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray


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
    """

    values: NDArray[np.float32]
    seen: NDArray[np.int32]
    views_used: int
    undrawable: int
    weights: dict[str, Any] = field(default_factory=dict)
    notes: tuple[str, ...] = ()
