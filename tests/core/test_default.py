"""By default survivors absorb what goes, and stay unchanged where that is as good."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from refine_addon.command import main
from refine_addon.core import (
    CHOICES,
    Budget,
    PruneRequest,
    RefineError,
    Settings,
    prune,
    prune_file,
    read_cameras,
    read_ply,
    score,
)
from refine_addon.core.merging.merge import Merged
from refine_addon.core.pipeline import absorb_splats, decide, decide_task
from refine_addon.core.pipeline.refit_splats import Made, unchanged_note
from refine_addon.core.quality.curve import AS_GOOD, expected
from refine_addon.core.splats import ARRAYS
from refine_addon.core.task import Task
from tests.strategies import ply_of

ROOM = Path(__file__).parents[1] / "data/room_small"
FEW = Settings(views=12)
HALF = Budget(ratio=0.5)


@pytest.fixture(scope="module")
def views():
    names = json.loads((ROOM / "split.json").read_text())["train"]
    return read_cameras(ROOM / "cameras.json").select(names)


@pytest.fixture(scope="module")
def small(tmp_path_factory):
    """Every twentieth splat of the room, as a file."""
    file, path = read_ply(ROOM / "point_cloud.ply"), tmp_path_factory.mktemp("small") / "in.ply"
    keep = np.zeros(len(file), np.bool_)
    keep[::20] = True
    file.write(path, keep)
    return path


@pytest.fixture(scope="module")
def splats(small):
    return read_ply(small).splats()


@pytest.mark.slow
def test_it_absorbs_where_that_is_better(splats, views):
    """To the bit as where absorbing is asked for; the report says what each comes to."""
    wanted = prune(splats, views, HALF, FEW, survivors="absorb")

    result = prune(splats, views, HALF, FEW)

    told = result.report["survivors"]
    np.testing.assert_array_equal(result.keep, wanted.keep)
    for item in ARRAYS:
        found = getattr(result.absorbed.splats, item)
        np.testing.assert_array_equal(found, getattr(wanted.absorbed.splats, item))
    assert (told["asked"], told["became"]) == ("auto", "absorb")
    assert told["psnr"]["absorb"] == result.report["estimated_psnr"]
    assert told["psnr"]["absorb"] > told["psnr"]["unchanged"] + AS_GOOD
    assert told["psnr"]["refit"] is None  # not foretold of so few splats
    assert set(told["seconds"]) == {"unchanged", "absorb", "refit"}


@pytest.mark.slow
def test_where_absorbing_gains_hardly_anything_rows_stay(splats, views, monkeypatch):
    """It was tried, and the report says what it reached; the rows are those of deletion."""
    monkeypatch.setattr(decide_task, "AS_GOOD", 50.0)

    result = prune(splats, views, HALF, FEW)

    wanted = prune(splats, views, HALF, FEW, survivors="unchanged")
    told = result.report["survivors"]
    np.testing.assert_array_equal(result.keep, wanted.keep)
    assert (result.absorbed, told["became"]) == (None, "unchanged")
    assert told["psnr"]["absorb"] > told["psnr"]["unchanged"]
    assert told["psnr"]["unchanged"] == wanted.report["estimated_psnr"]
    assert any("hardly more" in note for note in result.report["notes"])


@pytest.mark.parametrize(
    ("reached", "words"), [(54.0, "about 54 dB, no more"), (59.3, "about 59 dB, hardly more")]
)
def test_the_note_does_not_call_less_more(splats, reached, words):
    """Absorbing can reach less than deletion, in a shot that sees a fifth of the splats."""
    every = np.ones(len(splats), np.bool_)
    tried = Made(Merged(splats, every, every, 0, 0), reached)

    assert unchanged_note(59.0, tried).endswith(words)


@pytest.mark.slow
def test_hidden_copies_are_deleted_and_rows_stay(small, views, tmp_path):
    """Of four splats in one place, each all but opaque, three are hidden: .3 of all can go."""
    file = read_ply(small)
    rows = np.concatenate([file.rows] * 4)
    rows["opacity"] = 6.0
    path = tmp_path / "copies.ply"
    columns = {name: rows[name] for name in rows.dtype.names}
    path.write_bytes(ply_of(columns))

    result = prune_file(path, tmp_path / "out.ply", PruneRequest(views, Budget(ratio=0.3), FEW))

    told = result.report["survivors"]
    assert (told["asked"], told["became"]) == ("auto", "unchanged")
    assert result.absorbed is None
    named = prune(read_ply(path).splats(), views, Budget(ratio=0.3), FEW, survivors="unchanged")
    np.testing.assert_array_equal(result.keep, named.keep)
    kept = read_ply(path).rows[result.keep]
    assert read_ply(tmp_path / "out.ply").rows.tobytes() == kept.tobytes()
    assert any("survivors stay unchanged" in note for note in result.report["notes"])


@pytest.mark.slow
def test_a_psnr_that_a_tenth_is_enough_for_is_kept_by_deletion(splats, views, monkeypatch):
    """Absorbing deletes the first tenth, too, and is not tried."""
    monkeypatch.delattr(decide_task, "absorb_task")

    told = prune(splats, views, Budget(psnr=80.0), FEW)

    assert told.absorbed is None
    assert told.report["survivors"]["became"] == "unchanged"


@pytest.mark.parametrize(
    ("settings", "budget"),
    [
        (Settings("closed-form"), HALF),
        (Settings("closed-form"), Budget(threshold=0.5)),
        (Settings(views=12), Budget(min_seen=60.0)),
    ],
)
def test_who_says_how_to_delete_gets_rows(splats, views, settings, budget):
    """The closed form, and a budget of scores or views."""
    result = prune(splats, views, budget, settings)

    assert result.absorbed is None
    assert result.report["survivors"]["became"] == "unchanged"
    assert not any("survivors" in note for note in result.report["notes"])


def test_scores_alone_can_only_delete(splats, views):
    """A task of stored scores has no splats that could absorb."""
    scores = score(splats, views, Settings("closed-form"))

    result = decide(Task(HALF, scores=scores))

    assert result.absorbed is None
    assert np.count_nonzero(result.keep) == len(splats) - len(splats) // 2


@pytest.mark.slow
@pytest.mark.parametrize(
    ("options", "became"),
    [
        ([], "absorb"),
        (["--method", "occlusion"], "unchanged"),
        (["--method", "occlusion", "--survivors", "refit"], "refit"),
        (["--survivors", "auto", "--method", "occlusion"], "absorb"),
        (["--absorb"], "absorb"),
    ],
)
def test_the_command_deletes_where_a_method_is_named(small, tmp_path, capsys, options, became):
    """Whoever names one says how to delete, unless survivors are named too."""
    words = [str(small), "--cameras", str(ROOM / "cameras.json"), "--views", "16", *options]
    report = tmp_path / "r.json"

    assert main(["prune", *words, "-o", str(tmp_path / "o.ply"), "--report", str(report)]) == 0

    (entry,) = json.loads(report.read_text())["results"]
    assert entry["survivors"]["became"] == became
    assert "quality: about" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("measured", "told"),
    [
        ({"unchanged": 38.0, "absorb": 46.0, "refit": 50.0}, (38.0, 46.0, 50.0)),
        ({"unchanged": 38.0}, (38.0, None, None)),
        ({"unchanged": 38.0, "absorb": 46.0}, (38.0, 46.0, None)),
        ({}, (None, None, None)),
    ],
)
def test_what_was_measured_is_told_before_what_is_expected(measured, told):
    """Without a curve nothing else is known."""
    assert tuple(expected(None, 0.5, measured).values()) == told


@pytest.mark.parametrize(
    ("reached", "kept", "absorbs"),
    [(26.6, 20, False), (29.5, 20, True), (30.4, 25, False), (26.6, 35, False)],
)
def test_absorbing_that_misses_a_psnr_loses_to_deletion(splats, reached, kept, absorbs):
    """For 30 dB deletion leaves 25 splats at 30.1: fewer at 26.6 dB are not what was asked for."""
    keep = np.arange(len(splats)) < 25
    some = splats.take(np.arange(kept))
    made = Made(Merged(some, keep, np.zeros(kept, np.bool_), 0, 0), reached)

    as_good = decide_task._as_good(Task(Budget(psnr=30.0)), keep, 30.1, made)

    assert as_good is not absorbs


def test_tries_for_a_psnr_close_in_on_it_and_prefer_to_keep_it():
    """Odds of going 3 and 1 at 28 and 32 dB: 30 dB lies half way in the logarithm, at 3^.5."""
    tried = [absorb_splats._Try(100, 28.0), absorb_splats._Try(200, 32.0)]

    share = absorb_splats._between(tried, 30.0, 400)

    assert share == pytest.approx(3.0**0.5 / (1.0 + 3.0**0.5))
    assert absorb_splats._between(tried[:1], 30.0, 400) is None
    assert min(tried, key=lambda one: one.misses(29.5)) is tried[1]
    assert min(tried, key=lambda one: one.misses(28.5)) is tried[0]


def test_refitting_is_foretold_to_gain_less_where_rays_hit_more():
    """At half 3.2 dB by 78 hits a ray, 1.3 less at twice as many; nothing below 0 or above 100."""
    by_hits = [expected(None, 0.5, {"absorb": 46.0}, hits)["refit"] for hits in (78.0, 156.0, 1e6)]

    assert by_hits == pytest.approx([49.2, 47.9, 46.0])
    assert expected(None, 0.5, {"absorb": 99.0}, 10.0)["refit"] == 100.0


@pytest.mark.parametrize("survivors", CHOICES)
def test_a_list_of_views_is_refused_with_what_was_expected(splats, survivors):
    """For all that a caller can ask for."""
    with pytest.raises(RefineError, match="views is a list, expected a ViewSet"):
        prune(splats, [], HALF, survivors=survivors)
    with pytest.raises(RefineError, match="views is a list, expected a ViewSet"):
        score(splats, [])


def test_a_result_is_printed_as_a_line(splats, views):
    result = prune(splats, views, HALF, Settings("closed-form"))

    assert repr(result) == "<Result: 994 of 1,988 splats kept, unchanged>"
