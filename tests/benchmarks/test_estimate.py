"""The table of estimates: the views between, beside held-out views."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("numba")

from benchmarks.tables import estimate

ROOM = Path(__file__).parents[1] / "data" / "room_small"


@pytest.mark.slow
def test_of_few_views_the_estimate_between_comes_with_a_warning(capsys):
    """Of 8 views of the committed room; the difference is that of the two columns before it."""
    arguments = [str(ROOM), "--between", "--only", "delete", "--ratios", ".9", "--views", "8"]

    code = estimate.main(arguments)

    row = capsys.readouterr().out.splitlines()[1]
    _, _, _, between, held, _, off, *_ = row.split()
    assert code == 0
    assert row.endswith("warned")
    assert float(between) - float(held) == pytest.approx(float(off), abs=0.011)


def test_the_error_of_a_mean_is_that_of_its_views():
    """Of 40, 42 and 44 dB the deviation is 2, over the root of 3 views: 1.15."""
    row = estimate.Between("delete", 0.5, 43.0, np.array([40.0, 42.0, 44.0]), warned=False)

    assert row.line("room").split()[3:] == ["43.00", "42.00", "1.15", "+1.00", "42.00"]
