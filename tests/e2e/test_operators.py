"""The panel's operators of the installed zip, one after the other, in every Blender."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from splat_rows import rows, rows_in

if TYPE_CHECKING:
    from pathlib import Path

    from blenders import Blender


def test_import_score_apply_export(blender: Blender, cloud: Path, cameras: Path, pruned: Path):
    """39,755 - floor(39,755 / 2) = 19,878 rows of the file stay, bit for bit and in their order.

    They are those that the command keeps, but for ties: Blender's cameras are float32.
    """
    output = blender.work / "pruned.ply"

    found = blender.step("prune", cloud=cloud, cameras=cameras, output=output)

    assert found == {"imported": 39_755, "cameras": 72, "scored": True, "kept": 19_878}
    before, after = rows(cloud), rows(output)
    assert after.dtype == before.dtype
    assert after.tobytes() == before[rows_in(after, before)].tobytes()
    assert np.count_nonzero(rows_in(after, rows(pruned))) >= 0.999 * len(after)
