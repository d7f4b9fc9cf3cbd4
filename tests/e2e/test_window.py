"""The panel in a real window, used with mouse and keyboard."""

from __future__ import annotations

import math
import shutil
from fractions import Fraction
from typing import TYPE_CHECKING

from blenders import PROJECT

if TYPE_CHECKING:
    from pathlib import Path

    from blenders import Binary

PICTURES = PROJECT / "build" / "e2e"


def test_score_apply_undo_and_preview_by_hand(binary: Binary, blend: Path):
    """39,755 splats; *Apply* leaves 19,878 of them, Ctrl+Z and *Heat Map* all.

    While the slider is dragged the sentence follows at once, the marks when it rests. The chart is
    no image of the file.

    Pictures of the stages stay in build/e2e, for a person to look at.
    """
    try:
        found = binary.window_step("window", blend, name="Splats", pictures=binary.work)
    finally:
        PICTURES.mkdir(parents=True, exist_ok=True)
        for picture in binary.work.glob("*.png"):
            shutil.copy(picture, PICTURES / f"{binary.name}-{picture.name}")

    assert found["opened"] == {"vertices": 39_755, "scored": False}
    assert found["scored"] == {"vertices": 39_755, "scored": True}
    priced, sliding, slid = (found[stage] for stage in ("priced", "sliding", "slid"))
    assert priced["sentence"].startswith("Keeps 19,878 of 39,755, 4.9 of 9.9 MB, about ")
    assert priced["percent"] == 50.0
    assert priced["chart"]
    assert priced["images"] == 0
    assert sliding["percent"] == slid["percent"] > 55.0
    assert priced["marked"] == 19_877
    assert slid["marked"] == math.floor(Fraction(str(slid["ratio"])) * 39_755)
    assert sliding["sentence"] == slid["sentence"] != priced["sentence"]
    assert f"Keeps {39_755 - slid['marked']:,} of" in slid["sentence"]
    assert found["applied"] == {"vertices": 19_878, "scored": True}
    assert found["undone"] == found["scored"]
    assert found["previewed"] == found["scored"]
