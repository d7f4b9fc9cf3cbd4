"""What survivors of a prune may become."""

from __future__ import annotations

from typing import Literal

from .errors import RefineError

Became = Literal["unchanged", "absorb", "refit"]

SurvivorChoice = Literal["auto", "unchanged", "absorb", "refit"]

SURVIVORS: tuple[Became, ...] = ("unchanged", "absorb", "refit")
"""What survivors become: they stay what they are, to the bit; they absorb what goes; they absorb
it, and are then refitted to what the unpruned splats look like. Each takes longer than the one
before, and keeps the pictures closer."""

CHOICES: tuple[SurvivorChoice, ...] = ("auto", *SURVIVORS)
"""What may be asked. The first is the default: survivors absorb what goes, but stay unchanged where
that is as good, and where the method or the budget says how to delete; see `Task.absorb`."""


def refuse_unknown(survivors: str, choices: tuple[str, ...] = CHOICES) -> None:
    """Raise `RefineError` if `survivors` is none of the choices."""
    if survivors not in choices:
        raise RefineError(f"survivors is {survivors!r}, expected one of {', '.join(choices)}")
