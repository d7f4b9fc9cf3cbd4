"""From a task to a result: scoring by any method, absorbing to a budget, deciding."""

from .absorb_splats import absorb_removed
from .decide_task import decide, planned, prune
from .score_splats import score, scoring_plans

__all__ = ["absorb_removed", "decide", "planned", "prune", "score", "scoring_plans"]
