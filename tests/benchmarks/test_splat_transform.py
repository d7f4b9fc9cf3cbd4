"""The external decimation: how it is called, and what is said where it is missing."""

from __future__ import annotations

import sys
from pathlib import Path

import pytest

from benchmarks.baselines import splat_transform
from refine_addon.core.errors import RefineError
from refine_addon.core.formats.ply import read_ply

ROOM = Path(__file__).parents[1] / "data/room_small/point_cloud.ply"

SAY = "import sys, time; open({!r}, 'w').write(' '.join(sys.argv[1:])); time.sleep(0.2)"


def pretend(monkeypatch: pytest.MonkeyPatch, script: str) -> None:
    """Put a Python script in the place of the program."""
    monkeypatch.setattr(splat_transform, "find", lambda: [sys.executable, "-c", script])


def test_its_absence_is_said(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """The message tells how to install it."""
    monkeypatch.setattr(splat_transform, "find", lambda: None)

    assert splat_transform.version() == ""
    with pytest.raises(RefineError, match=r"python -m benchmarks\.baselines\.splat_transform"):
        splat_transform.decimate(ROOM, tmp_path / "a.ply", "--decimate", 10)


def test_it_is_called_with_the_number_that_stays(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    """On the CPU, quietly, the flag and the count last; time and memory come back."""
    target = tmp_path / "a.ply"
    pretend(monkeypatch, SAY.format(str(target)))

    run = splat_transform.decimate(ROOM, target, "--decimate-adaptive", 123)

    assert target.read_text() == f"-g cpu -q -w {ROOM} {target} --decimate-adaptive 123"
    assert run.seconds > 0.0
    assert run.peak_bytes is None or run.peak_bytes > 1e6


def test_what_it_says_when_it_fails_is_passed_on(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    """Exit code and message."""
    pretend(monkeypatch, "import sys; sys.exit('no adapter')")

    with pytest.raises(RefineError, match="ended with 1: no adapter"):
        splat_transform.decimate(ROOM, tmp_path / "a.ply", "--decimate", 10)


@pytest.mark.skipif(splat_transform.find() is None, reason=splat_transform.MISSING)
def test_the_real_one_leaves_as_many_as_asked_for(tmp_path: Path) -> None:
    """Half of the committed room, in the layout that we read."""
    target = tmp_path / "a.ply"

    splat_transform.decimate(ROOM, target, "--decimate", 20000)

    assert len(read_ply(target).splats()) == 20000
