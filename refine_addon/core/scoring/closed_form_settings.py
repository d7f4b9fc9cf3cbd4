"""Settings of the closed form, and the published constants."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal

import numpy as np

from ..errors import RefineError

ETA_RELATIVE = 0.005
"""Default eta over the squared size of the scene: the paper's .05 at a viewing distance of 3 m."""


@dataclass(frozen=True)
class ClosedForm:
    """Settings of the closed form; the default ranks the same whatever the scene's unit.

    Attributes
    ----------
    depth : {"z", "distance"}
        Depth along the view's axis, or distance to its centre.
    eta : float or None
        Added to the squared depth, squared world units; None takes `ETA_RELATIVE` times the squared
        size of the scene.
    anisotropy_offset : float or None
        Added to the shortest axis in F_gem, world units; None adds nothing, so that F_gem has no
        unit.
    frustum : bool
        Whether only views that a splat lies in, or reaches into, count for it.
    local : bool
        Whether a splat counts relative to those around it.
    visibility, projection, equal_weights : bool
        The paper's ablations: H without alpha, H without 1 / (d^2 + eta), lambda = 1/3 each.
    """

    depth: Literal["z", "distance"] = "z"
    eta: float | None = None
    anisotropy_offset: float | None = None
    frustum: bool = True
    local: bool = True
    visibility: bool = True
    projection: bool = True
    equal_weights: bool = False

    def __post_init__(self) -> None:
        """Check the values."""
        if self.depth not in ("z", "distance"):
            raise RefineError(f"depth is {self.depth!r}, expected 'z' or 'distance'")
        for name in ("eta", "anisotropy_offset"):
            value = getattr(self, name)
            if value is not None and not 0.0 < value < np.inf:
                raise RefineError(f"{name} is {value}, expected a positive number")

    @classmethod
    def published(cls, depth: Literal["z", "distance"], **changes: Any) -> ClosedForm:
        """Return the published constants: the paper's for "z", its authors' code's otherwise."""
        eta, offset = (0.05, 0.05) if depth == "z" else (0.5, 1e-6)
        return cls(depth, eta, offset, frustum=False, local=False, **changes)


DEFAULTS = ClosedForm()
