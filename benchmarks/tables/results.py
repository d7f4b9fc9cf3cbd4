"""What `trade` measures and `trade_report` writes down."""

from __future__ import annotations

from dataclasses import dataclass, field

from .cost import Cost
from .estimate import Estimated
from .finetune import Tuned
from .methods import Method
from .million import Million
from .refits import Curve
from .variants import Line


@dataclass(frozen=True, eq=False)
class Row:
    """One method at one ratio.

    - kept, asked: How many splats are left, and how many should be.
    - quality, dict of (views, reference) to dict of str to float: Views "held-out" or "scoring",
      reference "renders" or "pictures" -> metric -> mean.
    """

    method: Method
    ratio: float
    kept: int
    asked: int
    cost: Cost
    quality: dict[tuple[str, str], dict[str, float]]


@dataclass(eq=False)
class Measured:
    """All that was measured of one scene; from `estimate` on, each part under its own name."""

    name: str
    facts: dict[str, str]
    rows: list[Row] = field(default_factory=list)
    unpruned: dict[tuple[str, str], dict[str, float]] = field(default_factory=dict)
    estimate: list[Estimated] = field(default_factory=list)
    iterations: int = 0
    finetune: list[Tuned] = field(default_factory=list)
    refits: list[Curve] = field(default_factory=list)
    million: Million | None = None
    ablation: list[Line] = field(default_factory=list)
    failed: list[str] = field(default_factory=list)
