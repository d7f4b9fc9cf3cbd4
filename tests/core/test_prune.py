"""The one use case, on the committed room; the dial, and when merging deletes."""

import json
from types import SimpleNamespace

import numpy as np
import pytest

from refine_addon.core import (
    METHODS,
    Budget,
    ClosedForm,
    Merge,
    Occlusion,
    RefineError,
    Refit,
    Scores,
    Splats,
    execute,
    prune,
    prune_file,
    read_cameras,
    read_ply,
    score,
    select,
)
from refine_addon.core.scoring import closed_form, occlusion
from refine_addon.core.splats import ARRAYS
from refine_addon.core.visibility import measuring, points, projection, rays
from tests.core.test_levels import PRUNE
from tests.places import ROOM
from tests.strategies import ply_of

FEW, DELETING = Merge(12), Occlusion(12)
HALF = Budget(ratio=0.5)
TENTHS = [tenth / 10 for tenth in range(1, 10)]


@pytest.fixture(scope="module")
def file():
    return read_ply(ROOM / "point_cloud.ply")


@pytest.fixture(scope="module")
def views():
    names = json.loads((ROOM / "split.json").read_text())["train"]
    return read_cameras(ROOM / "cameras.json").select(names)


@pytest.fixture(scope="module")
def small(file, tmp_path_factory):
    path = tmp_path_factory.mktemp("small") / "small.ply"
    file.write(path, np.arange(len(file)) % 20 == 0)
    return path


@pytest.fixture(scope="module")
def splats(small):
    return read_ply(small).splats()


def test_faces_that_count_splats_are_noted_once_splats_go(small, views, tmp_path):
    """They are kept byte for byte, and the third corner is then no splat any more."""
    header, rows = small.read_bytes().split(b"end_header\n", 1)
    faces = b"element face 1\nproperty list uchar int vertex_indices\nend_header\n"
    path, face = tmp_path / "in.ply", b"\x03" + bytes(12)
    path.write_bytes(header + faces + rows + face)
    fewer, same = (
        prune_file(path, output, views, Budget(ratio=ratio), ClosedForm()).report["notes"]
        for output, ratio in ((tmp_path / "out.ply", 0.5), (None, 0.0))
    )
    kept = "element 'face' beside the splats is kept as it is; its indices may point past the end"
    assert (fewer, same) == ([kept], [])
    assert (tmp_path / "out.ply").read_bytes().endswith(face)


def wide(splats: Splats) -> Splats:
    """The same numbers as doubles, in every attribute."""
    return Splats(**{item: getattr(splats, item).astype(np.float64) for item in ARRAYS})


def agreement(one: Scores, other: Scores) -> list[float]:
    """Jaccard index of the kept sets of two scores at each tenth removed."""
    kept = [[select(scores, Budget(ratio=r)) for r in TENTHS] for scores in (one, other)]
    return [np.count_nonzero(a & b) / np.count_nonzero(a | b) for a, b in zip(*kept, strict=True)]


@pytest.mark.slow
def test_closed_form_of_floats_keeps_the_splats_that_doubles_keep(file, views):
    splats = file.splats()
    for prior in (False, True):
        scores = closed_form.score(splats, views, prior=prior)
        assert agreement(scores, closed_form.score(wide(splats), views, prior=prior)) == [1.0] * 9


@pytest.mark.slow
@pytest.mark.parametrize(("rounds", "every"), [(1, 4), (3, 8)])
def test_occlusion_in_floats_keeps_the_splats_that_doubles_keep(
    file, views, monkeypatch, rounds, every
):
    """Against the same code with every float32 a double: two for two others at 90 %."""
    some = views.take(range(0, len(views), every))
    scores = occlusion.score(file.splats(), some, rounds=rounds)[0]
    doubles = SimpleNamespace(**{**vars(np), "float32": np.float64})
    for module in (projection, points, measuring, rays):
        monkeypatch.setattr(module, "np", doubles)
    monkeypatch.setattr(projection, "_by_depth", lambda depth: np.argsort(depth, kind="stable"))
    gaussians, frame, _ = projection.prepare(wide(file.splats()), some)
    assert projection.project(gaussians, frame, some[0]).centers.dtype == np.float64
    # Other processes have floats.
    expected = execute.within(cores=1)(occlusion.score)(wide(file.splats()), some, rounds=rounds)[0]
    assert min(agreement(scores, expected)) >= 0.999


@pytest.mark.slow
@pytest.mark.parametrize("budget", [Budget(ratio=0.04), Budget(ratio=0.7), Budget(psnr=80.0)])
def test_known_scores_do_not_decide_where_merging_deletes(file, budget, monkeypatch):
    """Apply in the panel, which has scores, keeps what the command keeps.
    At 70 % alone merging is tried; if it is no better, all rounds of scoring decide.
    """
    tried = budget.ratio == 0.7
    monkeypatch.setattr(PRUNE._Prune, "_deletion_is_as_good", lambda *_: tried)
    splats, views = file.splats(), read_cameras(ROOM / "cameras.json")
    scene = splats.take(np.arange(0, len(file), 4)), views, budget
    scores = score(*scene[:2], Occlusion(3))
    at_once, later = (prune(*scene, Merge(4), scores=each) for each in (None, scores))
    method = later.report["method"]
    assert (method["asked"], method["done"], later.merged) == ("merge", "occlusion", None)
    np.testing.assert_array_equal(later.keep, at_once.keep)
    assert method["seconds"] is not None
    if budget.ratio == 0.04:  # nobody sees what refitting would gain
        refitted = prune(*scene, Refit(4))
        np.testing.assert_array_equal(refitted.keep, later.keep)
        assert refitted.merged is None
    if tried:
        np.testing.assert_array_equal(later.keep, prune(*scene, Occlusion(4)).keep)
        assert "merging reaches about 27 dB" in " ".join(later.report["notes"])


@pytest.mark.slow
@pytest.mark.parametrize("demanding", [False, True])
def test_scoring_for_one_budget_decides_what_scores_for_all_would(splats, views, demanding):
    """Scoring ends with the round that removes the last of its splats; the report is the same."""
    every = np.arange(len(splats))
    demands = {"protected": every % 2 == 0, "removed": every % 11 == 0} if demanding else {}

    def decide(ratio, **changes):
        return prune(splats, views, Budget(ratio=ratio), Occlusion(12), **demands, **changes)

    scores = decide(0.5, reusable=True).scores
    for ratio in (0.05, 0.93):
        some, whole = decide(ratio), decide(ratio, scores=scores)

        assert whole.scores.settled is None
        np.testing.assert_array_equal(some.keep, whole.keep)
        for name in ("estimated_psnr", "splats", "notes"):
            assert some.report[name] == whole.report[name]
        assert some.report["method"]["psnr"] == whole.report["method"]["psnr"]
        one, other = some.report["quality"], whole.report["quality"]
        for name in ("shares", "psnr", "merged"):
            # Means over the views are products of matrices: the last digit depends on their shape.
            assert one[name] == pytest.approx(other[name][: len(one["shares"])], rel=1e-12)
        assert one["shares"][-1] >= ratio


@pytest.mark.slow
def test_scores_of_one_budget_are_refused_for_a_larger_one(splats, views):
    """What they say of the splats that stayed is not final."""
    protected = np.arange(len(splats)) % 5 == 0
    scores = prune(splats, views, Budget(ratio=0.2), Occlusion(8), protected=protected).scores
    settled = int(0.3 * len(splats)) + np.count_nonzero(protected)
    assert scores.settled == settled
    assert select(scores, Budget(keep=len(splats) - settled)).sum() == len(splats) - settled
    assert select(scores, Budget(ratio=0.35), protected=protected).sum() > 0
    assert select(scores, Budget(ratio=0.0), protected=~protected).all()
    assert not select(scores, Budget(psnr=scores.quality.psnr[-1] + 0.1)).all()
    for budget, shield, words in (
        (Budget(keep=len(splats) - settled - 1), None, rf"up to {settled} of {len(splats)}"),
        (Budget(ratio=0.45), protected, "score again, for all budgets"),
        (Budget(psnr=scores.quality.psnr[-1] - 0.1), None, "score again"),
    ):
        with pytest.raises(RefineError, match=words):
            select(scores, budget, protected=shield)


@pytest.mark.slow
def test_hidden_copies_are_deleted_and_rows_stay(small, views, tmp_path):
    """Of four splats in one place, each all but opaque, three are hidden: .3 of all can go."""
    rows = np.concatenate([read_ply(small).rows[::4]] * 4)
    rows["opacity"] = 6.0
    path, out = tmp_path / "copies.ply", tmp_path / "out.ply"
    path.write_bytes(ply_of({name: rows[name] for name in rows.dtype.names}))
    result = prune_file(path, out, views, Budget(ratio=0.3), FEW)
    method = result.report["method"]
    assert (method["asked"], method["done"], result.merged) == ("merge", "occlusion", None)
    named = prune(read_ply(path), views, Budget(ratio=0.3), DELETING)
    np.testing.assert_array_equal(result.keep, named.keep)
    assert read_ply(out).rows.tobytes() == read_ply(path).rows[result.keep].tobytes()
    assert any("rows stay as they were" in note for note in result.report["notes"])


@pytest.mark.parametrize("method", METHODS.values())
def test_a_list_of_views_is_refused_with_what_was_expected(splats, method):
    for use in (lambda: prune(splats, [], HALF, method()), lambda: score(splats, [], method())):
        with pytest.raises(RefineError, match="views is a list, expected a ViewSet"):
            use()


def test_merging_needs_splats_and_views(splats, views):
    scores = score(splats, views, ClosedForm())
    for given in ({"splats": None, "scores": scores}, {"splats": splats}):
        with pytest.raises(RefineError, match="need both"):
            prune(views=None, budget=HALF, **given)
