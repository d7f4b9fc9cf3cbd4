"""What a measurement takes: seconds and memory."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Cost:
    """What something took.

    - seconds, busy: Medians of the runs: by the clock, and of the processor, all cores together.
    - peak_bytes: Beyond what was held before; of a program of its own, all it had. None: not to be
      had here.
    """

    seconds: float
    busy: float
    runs: int
    peak_bytes: int | None

    def plus(self, other: Cost) -> Cost:
        """Return the cost of doing both, one after the other."""
        peaks = [peak for peak in (self.peak_bytes, other.peak_bytes) if peak is not None]
        runs = min(self.runs, other.runs)
        seconds, busy = self.seconds + other.seconds, self.busy + other.busy
        return Cost(seconds, busy, runs, max(peaks, default=None))
