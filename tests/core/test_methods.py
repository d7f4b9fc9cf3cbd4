"""The dial: what each method makes of the same splats, and when merging deletes."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from refine_addon.command import main
from refine_addon.core import (
    METHODS,
    Budget,
    ClosedForm,
    Merge,
    Occlusion,
    RefineError,
    Refit,
    prune,
    prune_file,
    read_ply,
    score,
)
from refine_addon.core.merging.merge import Merged
from refine_addon.core.quality.curve import AS_GOOD, expected
from refine_addon.core.report import deleted_note
from tests.strategies import ply_of

from .test_prune import file, small, views  # noqa: F401 - fixtures

ROOM = Path(__file__).parents[1] / "data/room_small"
FEW = Merge(12)
HALF = Budget(ratio=0.5)


@pytest.fixture(scope="module")
def splats(small):
    return read_ply(small).splats()


@pytest.mark.slow
def test_merging_merges_where_that_is_better(splats, views):
    """The report says what each method comes to."""
    result = prune(splats, views, HALF, FEW)

    method = result.report["method"]
    assert (method["asked"], method["done"]) == ("merge", "merge")
    assert method["psnr"]["merge"] == result.report["estimated_psnr"]
    assert method["psnr"]["merge"] > method["psnr"]["delete"] + AS_GOOD
    assert method["psnr"]["refit"] is None  # not predicted of so few splats
    assert set(method["seconds"]) == {"delete", "merge", "refit"}


@pytest.mark.slow
def test_where_merging_gains_hardly_anything_rows_stay(splats, views, prune_module, monkeypatch):
    """It was tried, and the report says what it reached; the rows are those of deletion."""
    monkeypatch.setattr(prune_module, "AS_GOOD", 50.0)

    result = prune(splats, views, HALF, FEW)

    wanted = prune(splats, views, HALF, Occlusion(12))
    method = result.report["method"]
    np.testing.assert_array_equal(result.keep, wanted.keep)
    assert (result.merged, method["asked"], method["done"]) == (None, "merge", "occlusion")
    assert method["psnr"]["merge"] > method["psnr"]["delete"]
    assert method["psnr"]["delete"] == wanted.report["estimated_psnr"]
    assert any("hardly more" in note for note in result.report["notes"])


@pytest.mark.parametrize(
    ("reached", "words"), [(54.0, "about 54 dB, no more"), (59.3, "about 59 dB, hardly more")]
)
def test_the_note_does_not_call_less_more(reached, words):
    """Merging can reach less than deletion, in a shot that sees a fifth of the splats."""
    assert deleted_note(59.0, reached).endswith(words)


@pytest.mark.slow
def test_hidden_copies_are_deleted_and_rows_stay(small, views, tmp_path):
    """Of four splats in one place, each all but opaque, three are hidden: .3 of all can go."""
    file = read_ply(small)
    rows = np.concatenate([file.rows] * 4)
    rows["opacity"] = 6.0
    path = tmp_path / "copies.ply"
    columns = {name: rows[name] for name in rows.dtype.names}
    path.write_bytes(ply_of(columns))

    result = prune_file(path, tmp_path / "out.ply", views, Budget(ratio=0.3), FEW)

    method = result.report["method"]
    assert (method["asked"], method["done"]) == ("merge", "occlusion")
    assert result.merged is None
    named = prune(read_ply(path), views, Budget(ratio=0.3), Occlusion(12))
    np.testing.assert_array_equal(result.keep, named.keep)
    kept = read_ply(path).rows[result.keep]
    assert read_ply(tmp_path / "out.ply").rows.tobytes() == kept.tobytes()
    assert any("rows stay as they were" in note for note in result.report["notes"])


@pytest.mark.slow
def test_a_psnr_that_a_tenth_is_enough_for_is_kept_by_deletion(
    splats, views, prune_module, monkeypatch
):
    """Merging deletes the first tenth, too, and is not tried."""
    monkeypatch.delattr(prune_module, "merge_down")

    result = prune(splats, views, Budget(psnr=80.0), FEW)

    assert result.merged is None
    assert result.report["method"]["done"] == "occlusion"


@pytest.mark.slow
@pytest.mark.parametrize("budget", [Budget(threshold=0.5), Budget(min_seen=60.0)])
@pytest.mark.parametrize("method", [ClosedForm(12), Occlusion(12), FEW, Refit(12, 1)])
def test_any_budget_goes_with_any_method(splats, views, method, budget):
    """As many stay as by deleting with the scores that the method looks at."""
    result = prune(splats, views, budget, method)

    deleting = method if not method.changes else Occlusion(12)
    wanted = prune(splats, views, budget, deleting)
    assert np.count_nonzero(result.keep) == np.count_nonzero(wanted.keep)
    assert (result.merged is None) == (
        result.report["method"]["done"] in ("closed-form", "occlusion")
    )


def test_scores_alone_can_only_delete(splats, views):
    """No splats are needed."""
    scores = score(splats, views, ClosedForm())

    result = prune(None, None, HALF, ClosedForm(), scores=scores)

    assert result.merged is None
    assert np.count_nonzero(result.keep) == len(splats) - len(splats) // 2
    with pytest.raises(RefineError, match="need both"):
        prune(None, None, HALF, scores=scores)


@pytest.mark.slow
@pytest.mark.parametrize("name", METHODS)
def test_the_command_has_the_same_words(small, tmp_path, capsys, name):
    """What is done is what was asked for."""
    words = [str(small), "--cameras", str(ROOM / "cameras.json"), "--views", "16"]
    report = tmp_path / "r.json"
    words += ["--method", name, "-o", str(tmp_path / "o.ply"), "--report", str(report)]

    assert main(["prune", *words]) == 0

    (entry,) = json.loads(report.read_text())["results"]
    assert entry["method"]["asked"] == entry["method"]["done"] == name
    assert ("quality: about" in capsys.readouterr().out) is (name != "closed-form")


@pytest.mark.parametrize(
    ("measured", "told"),
    [
        ({"delete": 38.0, "merge": 46.0, "refit": 50.0}, (38.0, 46.0, 50.0)),
        ({"delete": 38.0}, (38.0, None, None)),
        ({"delete": 38.0, "merge": 46.0}, (38.0, 46.0, None)),
        ({}, (None, None, None)),
    ],
)
def test_what_was_measured_is_told_before_what_is_expected(measured, told):
    """Without a curve nothing else is known."""
    assert tuple(expected(None, 0.5, measured).values()) == told


@pytest.mark.parametrize(
    ("reached", "kept", "merges"),
    [(26.6, 20, False), (29.5, 20, True), (30.4, 25, False), (26.6, 35, False)],
)
def test_merging_that_misses_a_psnr_loses_to_deletion(splats, prune_module, reached, kept, merges):
    """For 30 dB deletion leaves 25 splats at 30.1: fewer at 26.6 dB are not what was asked for."""
    keep = np.arange(len(splats)) < 25
    some = splats.take(np.arange(kept))
    merged = Merged(some, keep, np.zeros(kept, np.bool_), 0, 0)
    made = prune_module.Made(merged, "merge", {"merge": reached})
    run = prune_module._Prune(
        splats, None, Budget(psnr=30.0), Merge(), None, None, (0.0, 0), None, False, None, None
    )

    assert run._deletion_is_as_good(keep, 30.1, made) is not merges


def test_tries_for_a_psnr_close_in_on_it_and_prefer_to_keep_it(prune_module):
    """Odds of going 3 and 1 at 28 and 32 dB: 30 dB lies half way in the logarithm, at 3^.5."""
    tried = [prune_module._Try(100, 28.0), prune_module._Try(200, 32.0)]

    share = prune_module._share_between(tried, 30.0, 400)

    assert share == pytest.approx(3.0**0.5 / (1.0 + 3.0**0.5))
    assert prune_module._share_between(tried[:1], 30.0, 400) is None
    assert min(tried, key=lambda one: one.misses(29.5)) is tried[1]
    assert min(tried, key=lambda one: one.misses(28.5)) is tried[0]


def test_refitting_is_predicted_to_gain_less_where_rays_hit_more():
    """At half 3.2 dB by 78 hits a ray, 1.3 less at twice as many; nothing below 0 or above 100."""
    by_hits = [expected(None, 0.5, {"merge": 46.0}, hits)["refit"] for hits in (78.0, 156.0, 1e6)]

    assert by_hits == pytest.approx([49.2, 47.9, 46.0])
    assert expected(None, 0.5, {"merge": 99.0}, 10.0)["refit"] == 100.0


@pytest.mark.parametrize("method", METHODS.values())
def test_a_list_of_views_is_refused_with_what_was_expected(splats, method):
    """For all that a caller can ask for."""
    with pytest.raises(RefineError, match="views is a list, expected a ViewSet"):
        prune(splats, [], HALF, method())
    with pytest.raises(RefineError, match="views is a list, expected a ViewSet"):
        score(splats, [], method())


@pytest.mark.parametrize(
    ("make", "words"),
    [
        (lambda: Occlusion(-1), "views is -1, expected 0"),
        (lambda: Refit(rounds=0), "rounds is 0, expected 1 to 100"),
    ],
)
def test_settings_out_of_range_are_refused(make, words):
    with pytest.raises(RefineError, match=words):
        make()


def test_a_result_is_printed_as_a_line(splats, views):
    result = prune(splats, views, HALF, ClosedForm())

    assert repr(result) == "<Result: 994 of 1,988 splats kept, closed-form>"


@pytest.fixture
def prune_module():
    """The module, which the function of the same name hides in the package."""
    import importlib

    return importlib.import_module("refine_addon.core.prune")
