"""What the command says of a result, in words that several subcommands share."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from ..core.report import size_in_words, sizes_in_words

if TYPE_CHECKING:
    from collections.abc import Mapping


def by(views: Mapping[str, int]) -> str:
    """Return how many views decided.

    >>> by({"given": 72, "used": 64})
    'by 64 of 72 views'
    """
    return f"by {views['used']} of {views['given']} views"


def written(splats: Mapping[str, Any]) -> str:
    """Return how many splats a file holds, if its format left some out; else "".

    >>> written({"written": 8, "left_out": 2}), written({"written": 10, "left_out": 0})
    (', 8 written', '')
    """
    return f", {splats['written']:,} written" if splats["left_out"] and splats["written"] else ""


def sizes(before: int, after: int | None) -> str:
    """Return what became of the size of a file; None where only writing tells it.

    >>> sizes(4_940_000, 32_000), sizes(4_940_000, None)
    ('4.9 MB -> 32.0 kB', 'of 4.9 MB')
    """
    if after is None:
        return f"of {size_in_words(before)}"
    return sizes_in_words(before, "->", after)
