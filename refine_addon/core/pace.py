"""How long the rest of a run takes."""

from __future__ import annotations

import math
import time
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

_MINUTE = 60

_EARLY = 2.0  # seconds before which a pace says little


class Pace:
    """Files of a run, one after the other, and the time that the others will take.

    Parameters
    ----------
    sizes : sequence of int
        Bytes of each; a file is taken to need time in proportion.
    clock : callable, optional
        Returns seconds.
    """

    def __init__(
        self, sizes: Sequence[int], clock: Callable[[], float] = time.perf_counter
    ) -> None:
        self._sizes = [max(size, 1) for size in sizes]
        self._begun = 0
        self._clock = clock
        self._start = clock()

    def next(self) -> None:
        """Go on to the next file."""
        self._begun += 1

    def named(self, name: str) -> str:
        """Return the name of the file under way, with its place among several."""
        count = len(self._sizes)
        return name if count == 1 else f"file {self._begun} of {count}, {name}"

    def left(self, fraction: float) -> str:
        """Return how long all that is left takes, in words; "" where it is too early to tell.

        Parameters
        ----------
        fraction : float
            How much of the file under way is done, 0 to 1.
        """
        before, current = sum(self._sizes[: self._begun - 1]), self._sizes[self._begun - 1]
        done, total = before + fraction * current, sum(self._sizes)
        passed = self._clock() - self._start
        if passed < _EARLY or not 0.0 < done < total:
            return ""
        rest = in_time(passed * (total - done) / done)
        return f"about {rest} left{' in all' if len(self._sizes) > 1 else ''}"


def in_time(seconds: float) -> str:
    """Return a time in the unit that suits it, rounded up.

    >>> in_time(2.1), in_time(61.0)
    ('3 s', '2 min')
    """
    if seconds <= _MINUTE:
        return f"{math.ceil(seconds)} s"
    hours, minutes = divmod(math.ceil(seconds / _MINUTE), 60)
    return f"{hours} h {minutes} min" if hours else f"{minutes} min"
