"""Long work on a thread: arrays only, Blender's data is not safe to touch from there."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from concurrent.futures import Future
from typing import Any

from ..core.execute import Cancelled, Progress, checked_by

PATIENCE = 0.7  # Seconds that a cancelled thread has to end before it is left alone


class Worker:
    """``work(progress)`` on a thread; `fraction` done, 0 to 1, of `what`, a word or two."""

    def __init__(self, work: Callable[[Progress], Any]) -> None:
        self.fraction, self.what = 0.0, ""
        self._cancelled: float | None = None  # when
        self._outcome: Future[Any] = Future()
        self._thread = threading.Thread(target=self._run, args=(work,), name="refine", daemon=True)
        self._thread.start()

    def running(self) -> bool:
        """Whether there is still something to wait for: not `PATIENCE` after cancelling.
        Such work, like packing a file, ends at its next checkpoint, and its result is dropped."""
        late = self.cancelled and time.monotonic() - self._cancelled > PATIENCE
        return not late and self._thread.is_alive()

    @property
    def cancelled(self) -> bool:
        """Whether it was asked to stop."""
        return self._cancelled is not None

    def cancel(self) -> None:
        """Ask it to stop; `result` raises `Cancelled` then, unless the work offers one."""
        if not self.cancelled:
            self._cancelled = time.monotonic()

    def end(self) -> None:
        """Ask it to stop, and wait until it has or `PATIENCE` is over."""
        self.cancel()
        self._thread.join(PATIENCE)

    def result(self) -> Any:
        """The work's result or error; keeps neither."""
        if self.cancelled and self._thread.is_alive():
            raise Cancelled
        self._thread.join()
        outcome, self._outcome = self._outcome, Future()
        return outcome.result()

    def _run(self, work: Callable[[Progress], Any]) -> None:
        try:
            with checked_by(self._check):
                result = work(self._progress)
            if getattr(result, "stopped", None) is None:  # see `Result.stopped`
                self._check()  # nobody may be left to ask for the result
            self._outcome.set_result(result)
        except BaseException as error:
            # Whoever cancels asks for no reason, and a traceback would keep what was worked on.
            self._outcome.set_exception(Cancelled() if self.cancelled else error)

    def _check(self) -> None:
        if self.cancelled:
            raise Cancelled

    def _progress(self, fraction: float, what: str) -> bool:
        self.fraction, self.what = fraction, what
        return not self.cancelled
