"""Long work on a thread: arrays only, Blender's data is not safe to touch from there."""

from __future__ import annotations

import threading
from typing import TYPE_CHECKING, Generic, TypeVar

from ..core.errors import Cancelled

if TYPE_CHECKING:
    from collections.abc import Callable

    from ..core.work import Progress

Result = TypeVar("Result")


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
    """

    def __init__(self, work: Callable[[Progress], Result]) -> None:
        self.fraction = 0.0
        self._cancelled = False
        self._outcome: list[Result] = []  # one, once the work ended well
        self._error: BaseException | None = None
        self._thread = threading.Thread(target=self._run, args=(work,), name="refine", daemon=True)
        self._thread.start()

    def running(self) -> bool:
        """Tell whether it still works."""
        return self._thread.is_alive()

    def cancel(self) -> None:
        """Ask it to stop; `result` raises `Cancelled` then."""
        self._cancelled = True

    def result(self) -> Result:
        """Wait for the result and return it.

        Raises
        ------
        RefineError, Cancelled
            What the work raised.
        """
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
            self._outcome.append(work(self._progress))
        except BaseException as error:  # noqa: BLE001 - handed to the other thread by `result`
            # Whoever cancels asks for no reason, and a traceback would keep what was worked on.
            self._error = Cancelled() if self._cancelled else error

    def _progress(self, fraction: float, _what: str) -> bool:
        self.fraction = fraction
        return not self._cancelled
