"""Long work on a thread: arrays only, Blender's data is not safe to touch from there."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from typing import Generic, TypeVar

from ..core.execute import Cancelled, Progress, checked_by

Result = TypeVar("Result")

PATIENCE = 0.7
"""Seconds that a thread has to end once it was cancelled; then it is left to itself."""


class Worker(Generic[Result]):
    """A call that runs while the window stays alive; it keeps nothing once `result` was asked.

    Parameters
    ----------
    work : callable
        ``work(progress)``; its result, or what it raises, is handed out by `result`.

    Attributes
    ----------
    fraction : float
        How much is done, 0 to 1.
    what : str
        What is being done, in a word or two.
    """

    def __init__(self, work: Callable[[Progress], Result]) -> None:
        self.fraction, self.what = 0.0, ""
        self._cancelled: float | None = None  # when
        self._outcome: list[Result] = []  # one, once the work ended well
        self._error: BaseException | None = None
        self._thread = threading.Thread(target=self._run, args=(work,), name="refine", daemon=True)
        self._thread.start()

    def running(self) -> bool:
        """Tell whether there is still something to wait for.

        Work that has not ended `PATIENCE` after it was cancelled, such as the packing of a file, is
        not: it ends by itself at its next checkpoint, and what comes of it is dropped.
        """
        if self._cancelled is not None and time.monotonic() - self._cancelled > PATIENCE:
            return False
        return self._thread.is_alive()

    @property
    def cancelled(self) -> bool:
        """Whether it was asked to stop."""
        return self._cancelled is not None

    def cancel(self) -> None:
        """Ask it to stop; `result` raises `Cancelled` then, unless the work offers one."""
        if self._cancelled is None:
            self._cancelled = time.monotonic()

    def end(self) -> None:
        """Ask it to stop, and wait until it has or `PATIENCE` is over."""
        self.cancel()
        self._thread.join(PATIENCE)

    def result(self) -> Result:
        """Wait for the result and return it.

        Raises
        ------
        RefineError, Cancelled
            What the work raised.
        """
        if self.cancelled and self._thread.is_alive():
            raise Cancelled
        self._thread.join()
        outcome, self._outcome = self._outcome, []
        error, self._error = self._error, None
        if error is None:
            return outcome[0]
        try:
            raise error
        finally:
            del error  # its traceback holds this frame, which would hold it in turn

    def _run(self, work: Callable[[Progress], Result]) -> None:
        try:
            with checked_by(self._check):
                result = work(self._progress)
            if getattr(result, "stopped", None) is None:  # see `Result.stopped`
                self._check()  # nobody may be left to ask for the result
            self._outcome.append(result)
        except BaseException as error:
            # Whoever cancels asks for no reason, and a traceback would keep what was worked on.
            self._error = Cancelled() if self.cancelled else error

    def _check(self) -> None:
        if self.cancelled:
            raise Cancelled

    def _progress(self, fraction: float, what: str) -> bool:
        self.fraction, self.what = fraction, what
        return not self.cancelled
