"""The table of levels of detail: its ways give as many splats as asked for."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from benchmarks.baselines import splat_transform
from benchmarks.tables import lod as table
from benchmarks.tables.evaluate import Scene, read_scene

ROOM = Path(__file__).parents[1] / "data/room_small"


@pytest.fixture
def few() -> Scene:
    """Return a twentieth of the committed room, and six of its views."""
    scene = read_scene(ROOM)
    splats = scene.splats.take(np.arange(len(scene.splats)) % 20 == 0)
    train = scene.train.take(range(0, len(scene.train), 11))
    return Scene(splats, train, scene.test, {})


@pytest.mark.slow
@pytest.mark.parametrize("way", [table.from_one_another, table.in_one_go, table.deleted])
def test_our_ways_make_the_levels_asked_for(few: Scene, way) -> None:
    """Of 1988 splats: 994, 497, 239 (238.56) and 120 (119.28), rounded up."""
    assert [len(splats) for splats, _ in way(few)] == [994, 497, 239, 120]


def test_each_level_is_decimated_to_the_same_number(monkeypatch: pytest.MonkeyPatch) -> None:
    """splat-transform is asked for what ours keep, of the original each time."""
    asked = []

    def decimate(source: Path, target: Path, flag: str, keep_count: int) -> splat_transform.Run:
        asked.append((source.name, flag, keep_count))
        target.write_bytes(source.read_bytes())
        return splat_transform.Run(1.0, 2.0, None)

    monkeypatch.setattr(splat_transform, "decimate", decimate)
    source = ROOM / "point_cloud.ply"

    notes = [note for _, note in table.decimated(source, "--decimate", 1988)]

    assert asked == [(source.name, "--decimate", count) for count in (994, 497, 239, 120)]
    assert notes == [" (2 s)"] * 4
