"""What survivors of a prune may become."""

from __future__ import annotations

from typing import Literal

from .errors import RefineError

SurvivorChoice = Literal["unchanged", "absorb", "refit"]

SURVIVORS: tuple[SurvivorChoice, ...] = ("unchanged", "absorb", "refit")
"""They stay what they are, to the bit; they absorb what goes; they absorb it, and are then refitted
to what the unpruned splats look like. Each takes longer than the one before, and keeps the pictures
closer."""


def refuse_unknown(survivors: str) -> None:
    """Raise `RefineError` if `survivors` is none of `SURVIVORS`."""
    if survivors not in SURVIVORS:
        msg = f"survivors is {survivors!r}, expected one of {', '.join(SURVIVORS)}"
        raise RefineError(msg)
