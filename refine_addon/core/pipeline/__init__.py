"""From a task to a result: scoring by any method, absorbing to a budget, deciding."""

from .absorb_splats import absorb_removed
from .decide_task import decide, prune
from .score_splats import score

__all__ = ["absorb_removed", "decide", "prune", "score"]
