"""What the command says of a result, in words that several subcommands share."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from ..core.execute import in_time
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


def by_method(predicted: Mapping[str, Any], without: str = "") -> str:
    """Which quality and time the methods are expected to come to.

    Parameters
    ----------
    predicted : mapping
        ``psnr`` and ``seconds`` of a report's ``method`` or ``prices``.
    without : str
        The method that is left out.

    Examples
    --------
    >>> psnr = {"delete": 38.0, "merge": 46.0, "refit": None}
    >>> by_method({"psnr": psnr, "seconds": {"delete": 1.2, "merge": 2.1, "refit": 8.0}})
    'occlusion about 38 dB in 2 s, merge about 46 dB in 3 s'
    >>> by_method({"psnr": psnr}, "merge")  # one round of scoring tells less than all
    'occlusion about 38 dB or more'
    """
    seconds = predicted.get("seconds") or {}
    return ", ".join(
        f"{name} {in_words(psnr)}"
        + (" or more" if way == "delete" and without else "")
        + (f" in {in_time(seconds[way])}" if seconds else "")
        for way, psnr in predicted["psnr"].items()
        if psnr is not None
        and without != (name := "occlusion" if way == "delete" else way)
        and not (way == "delete" and without == "closed-form")
    )
