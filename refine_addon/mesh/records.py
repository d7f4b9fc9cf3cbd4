"""Records of how data came to be: custom properties that hold JSON."""

from __future__ import annotations

import json
from functools import lru_cache
from typing import Any


@lru_cache(maxsize=16)
def parsed(text: str) -> Any:
    """A JSON record, read-only, cached for panels; TypeError or ValueError if it is none."""
    return json.loads(text)
