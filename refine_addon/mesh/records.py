"""Records of how data came to be: custom properties that hold JSON."""

from __future__ import annotations

import json
from functools import lru_cache
from typing import Any


@lru_cache(maxsize=16)
def parsed(text: str) -> Any:
    """Return a record as values, which nobody may change: panels ask whenever they are drawn.

    Raises
    ------
    TypeError, ValueError
        If it is no text, or no JSON.
    """
    return json.loads(text)
