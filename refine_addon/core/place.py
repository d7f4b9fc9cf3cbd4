"""A place in a file, and checks of the JSON values that stand there.

A `Place` is a position in a file, such as "cameras.json: camera 3". Each check is one method of it,
and each error names the file, the place, what was got and what was expected.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, NoReturn, Self, TypeGuard

from .errors import RefineError

LARGEST_NUMBER = 1e18
"""Largest number that is taken, such as a coordinate: its square still fits float32."""

LARGEST_COUNT = 1 << 53
"""Largest whole number that is taken: up to it, floating-point numbers hold every one."""

NEGLIGIBLE = 1e-30
"""Smaller numbers are read as 0, so that products of two numbers do not underflow."""

_SHOWN = 40  # most characters of a value in a message


@dataclass(frozen=True)
class Place:
    """A file and a place in it.

    Every check returns the value that it is given, or raises `RefineError` with the place.

    Attributes
    ----------
    path : Path
        The file.
    where : str
        The place, "" for the whole file.
    """

    path: Path
    where: str = ""

    def at(self, where: str) -> Self:
        """A place within this one."""
        return replace(self, where=f"{self.where} {where}" if self.where else where)

    def fail(self, problem: str) -> NoReturn:
        """Raise the error of this place."""
        where = f"{self.where}: " if self.where else ""
        raise RefineError(f"{self.path}: {where}{problem}")

    def expected(self, what: str, value: object) -> NoReturn:
        """Raise the error of this place: what was expected there, and what was got."""
        self.fail(f"expected {what}, got {described(value)}")

    def number(self, value: object) -> float:
        """Return `value` if it is a number of at most `LARGEST_NUMBER`."""
        if not isinstance(value, (int, float)) or isinstance(value, bool):
            self.expected("a number", value)
        if not abs(value) <= LARGEST_NUMBER:  # also refuses NaN, and integers too large for float
            self.expected("a finite number up to 1e18", value)
        return float(value) if abs(value) >= NEGLIGIBLE else 0.0

    def numbers(self, value: object, count: int) -> list[float]:
        """Return `value` if it is a list of `count` numbers."""
        if not isinstance(value, list) or len(value) != count:
            self.expected(f"a list of {count} numbers", value)
        try:
            return [self.number(item) for item in value]
        except RefineError:
            # A place for each number would take longer than the checks of all.
            return [self.at(f"[{index}]").number(item) for index, item in enumerate(value)]

    def whole(self, value: object, least: int = 0, most: int = LARGEST_COUNT) -> int:
        """Return `value` if it is a whole number of `least` to `most`."""
        if not is_whole(value) or not least <= value <= most:
            self.expected(f"a whole number from {least} to {most}", value)
        return value

    def text(self, value: object) -> str:
        """Return `value` if it is a string."""
        if not isinstance(value, str):
            self.expected("a string", value)
        return value

    def items(self, value: object) -> list[Any]:
        """Return `value` if it is a list."""
        if not isinstance(value, list):
            self.expected("a list", value)
        return value

    def members(self, value: object, required: Sequence[str] = ()) -> dict[str, Any]:
        """Return `value` if it is a JSON object with these keys."""
        if not isinstance(value, dict):
            self.expected("an object", value)
        missing = [key for key in required if key not in value]
        if missing:
            self.fail(f"missing {missing[0]!r}, expected the keys {', '.join(required)}")
        return value

    def parsed(self, text: bytes | str) -> Any:
        """Value of a text in JSON; errors name line and column."""
        try:
            return json.loads(text)
        except json.JSONDecodeError as error:
            self.at(f"line {error.lineno} column {error.colno}").fail(f"invalid JSON: {error.msg}")
        except RecursionError:
            self.fail("invalid JSON: nested too deeply")
        except ValueError as error:  # no UTF-8, or an integer of thousands of digits
            self.fail(f"invalid JSON: {error}")


def is_whole(value: object) -> TypeGuard[int]:
    """Whether a JSON value is a whole number."""
    return isinstance(value, int) and not isinstance(value, bool)


def described(value: object) -> str:
    """Short description of a JSON value, for messages."""
    if isinstance(value, dict):
        return f"an object with {len(value)} keys"
    if isinstance(value, list):
        return f"a list of {len(value)}"
    text = json.dumps(value)
    return text if len(text) <= _SHOWN else f"{text[: _SHOWN - 3]}..."
