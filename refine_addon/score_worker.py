"""Scoring on a thread: arrays only, Blender's data is not safe to touch from there."""

from __future__ import annotations

import threading
from typing import TYPE_CHECKING

from .core import pipeline

if TYPE_CHECKING:
    from .core.pipeline import Settings
    from .core.scores import Scores
    from .core.splats import Splats
    from .core.views import ViewSet


class ScoreWorker:
    """A call of `pipeline.score` that runs while the window stays alive.

    Attributes
    ----------
    fraction : float
        How much is done, 0 to 1.
    """

    def __init__(self, splats: Splats, views: ViewSet, settings: Settings) -> None:
        self.fraction = 0.0
        self._cancelled = False
        self._scores: Scores | None = None
        self._error: BaseException | None = None
        self._thread = threading.Thread(
            target=self._run, args=(splats, views, settings), name="refine-score", daemon=True
        )
        self._thread.start()

    def running(self) -> bool:
        """Tell whether it still works."""
        return self._thread.is_alive()

    def cancel(self) -> None:
        """Ask it to stop; `result` raises `Cancelled` then."""
        self._cancelled = True

    def result(self) -> Scores:
        """Wait for the scores and return them.

        Raises
        ------
        RefineError, Cancelled
            What the scoring raised.
        """
        self._thread.join()
        if self._error is not None:
            raise self._error
        return self._scores

    def _run(self, splats: Splats, views: ViewSet, settings: Settings) -> None:
        try:
            self._scores = pipeline.score(splats, views, settings, progress=self._progress)
        except BaseException as error:  # noqa: BLE001 - handed to the other thread by `result`
            self._error = error

    def _progress(self, fraction: float, _what: str) -> bool:
        self.fraction = fraction
        return not self._cancelled
