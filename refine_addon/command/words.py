"""What the command says of a result, in words that several subcommands share."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from ..core.pace import in_time
from ..core.quality.curve import in_words
from ..core.report import size_in_words, sizes_in_words


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


def by_survivors(told: Mapping[str, Any], without: str = "") -> str:
    """Return which quality and time what survivors may become is expected to come to.

    Parameters
    ----------
    told : mapping
        ``psnr`` and ``seconds`` of a report's ``survivors`` or ``prices``.
    without : str
        What of them is left out.

    Examples
    --------
    >>> psnr = {"unchanged": 38.0, "absorb": 46.0, "refit": None}
    >>> by_survivors({"psnr": psnr, "seconds": {"unchanged": 1.2, "absorb": 2.1, "refit": 8.0}})
    'unchanged about 38 dB in 2 s, absorb about 46 dB in 3 s'
    >>> by_survivors({"psnr": psnr}, "absorb")  # one round of scoring tells less than all
    'unchanged about 38 dB or more'
    """
    seconds = told.get("seconds") or {}
    return ", ".join(
        f"{way} {in_words(psnr)}"
        + (" or more" if way == "unchanged" and without else "")
        + (f" in {in_time(seconds[way])}" if seconds else "")
        for way, psnr in told["psnr"].items()
        if psnr is not None and way != without
    )
