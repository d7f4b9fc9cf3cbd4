"""The one use case, on the committed room."""

from __future__ import annotations

import importlib
import itertools
import json
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from refine_addon.core import (
    Budget,
    Cancelled,
    ClosedForm,
    Merge,
    Occlusion,
    RefineError,
    Scores,
    Splats,
    View,
    ViewSet,
    prune,
    prune_file,
    read_cameras,
    read_ply,
    score,
    select,
)
from refine_addon.core.scoring import closed_form, occlusion
from refine_addon.core.scoring.closed_form import LUMA, lambdas
from refine_addon.core.selection import rank
from refine_addon.core.splats import ARRAYS
from refine_addon.core.visibility import measuring, points, projection, rays
from refine_addon.core.visibility.measuring import Measured
from refine_addon.core.visibility.scene import principal_axes
from tests.strategies import plain_header, ply_of

PRUNE = importlib.import_module("refine_addon.core.prune")

ROOM = Path(__file__).parents[1] / "data/room_small"
PLY = ROOM / "point_cloud.ply"
FAST = ClosedForm()


@pytest.fixture(scope="module")
def file():
    return read_ply(PLY)


@pytest.fixture(scope="module")
def views():
    names = json.loads((ROOM / "split.json").read_text())["train"]
    return read_cameras(ROOM / "cameras.json").select(names)


@pytest.fixture(scope="module")
def front():
    """One camera at the origin, which looks along z."""
    view = View(np.eye(3), np.zeros(3), 100.0, 100.0, 64.0, 64.0, 128, 128)
    return ViewSet((view,))


@pytest.mark.parametrize("ratio", [0.0, 0.1, 0.29, 0.5, 0.9, 0.9999])
def test_a_ratio_removes_exactly_its_floor(file, views, ratio):
    """floor(ratio * 39755), of the decimal as written."""
    expected = {0.0: 0, 0.1: 3975, 0.29: 11528, 0.5: 19877, 0.9: 35779, 0.9999: 39751}[ratio]

    result = prune(file.splats(), views, Budget(ratio=ratio), FAST)

    assert np.count_nonzero(~result.keep) == expected
    assert result.report["splats"]["removed"] == expected


@pytest.mark.slow
def test_what_survives_half_survives_a_third(file, views):
    """Budgets are nested, since all select from one ranking."""
    masks = [
        prune(file.splats(), views, Budget(ratio=r), FAST).keep for r in (0.1, 0.3, 0.5, 0.7, 0.9)
    ]

    for more, less in itertools.pairwise(masks):
        assert not (less & ~more).any()


def test_the_ranking_says_what_a_budget_removes(file, views):
    """The k lowest ranks go: rank is the place in the order of removal."""
    result = prune(file.splats(), views, Budget(keep=1000), FAST)

    order = np.argsort(rank(result.scores.values), kind="stable")

    assert sorted(np.flatnonzero(result.keep)) == sorted(order[-1000:])


def test_protected_splats_stay_and_others_go_in_their_place(file, views):
    """The thousand lowest are protected, so the next thousand go."""
    scores = prune(file.splats(), views, Budget(keep=1), FAST).scores
    lowest = np.argsort(scores.values, kind="stable")
    protected = np.zeros(len(file), np.bool_)
    protected[lowest[:1000]] = True

    budget = Budget(keep=len(file) - 1000)
    keep = prune(file.splats(), views, budget, FAST, protected=protected).keep

    assert sorted(np.flatnonzero(~keep)) == sorted(lowest[1000:2000])


def test_a_size_in_megabytes_is_kept_to_the_row(views, tmp_path):
    """The file fits in 2 MB, and one row of 248 bytes more would not."""
    result = prune_file(PLY, tmp_path / "out.ply", views, Budget(max_mb=2.0), FAST)

    size = (tmp_path / "out.ply").stat().st_size

    assert 2e6 - 248 - 2 < size <= 2e6
    assert result.report["files"]["output_bytes"] == size


def test_the_pruned_file_holds_the_kept_rows_and_the_report_is_json(file, views, tmp_path):
    """Rows bit for bit, in order; every number of the report is finite."""
    result = prune_file(PLY, tmp_path / "out.ply", views, Budget(ratio=0.5), FAST)

    assert read_ply(tmp_path / "out.ply").rows.tobytes() == file.rows[result.keep].tobytes()
    assert json.loads(json.dumps(result.report, allow_nan=False))["splats"]["before"] == 39755


@pytest.mark.parametrize("form", ["binary_little_endian", "ascii"])
def test_faces_that_count_splats_are_noted_once_splats_go(small, views, tmp_path, form):
    """They are kept byte for byte, and the third corner is then no splat any more."""
    rows = read_ply(small).rows
    faces = b"element face 1\nproperty list uchar int vertex_indices\n"
    header = plain_header(len(rows), list(rows.dtype.names), form)
    texts = b"".join(b" ".join(b"%.9g" % value for value in row.tolist()) + b"\n" for row in rows)
    body, face = (
        (texts, b"3 0 1 1987\n") if form == "ascii" else (rows.tobytes(), b"\x03" + bytes(12))
    )
    path = tmp_path / "in.ply"
    path.write_bytes(header.replace(b"end_header", faces + b"end_header") + body + face)

    fewer, same = (
        prune_file(path, output, views, Budget(ratio=ratio), FAST).report["notes"]
        for output, ratio in ((tmp_path / "out.ply", 0.5), (None, 0.0))
    )

    if form == "ascii":  # written anew
        assert all(
            "without the elements beside its splats (face)" in said[0] for said in (fewer, same)
        )
        return
    expected = (
        "element 'face' beside the splats is kept as it is; its indices may point past the end"
    )
    assert (fewer, same) == ([expected], [])
    assert (tmp_path / "out.ply").read_bytes().endswith(face)


def test_no_output_writes_nothing(views, tmp_path):
    """A dry run decides and reports."""
    result = prune_file(PLY, None, views, Budget(ratio=0.5), FAST)

    assert result.report["files"]["output"] is None
    assert list(tmp_path.iterdir()) == []


def test_fewer_views_are_used_when_asked_for(file, views):
    """Eight of the 63, spread out."""
    report = prune(file.splats(), views, Budget(ratio=0.5), ClosedForm(8)).report

    assert report["views"] == {"given": 63, "used": 8}


@pytest.mark.parametrize("last", range(4))
def test_cancelling_leaves_nothing(views, tmp_path, last):
    """At the first calls and after, no output appears."""
    calls = iter(range(10_000))

    with pytest.raises(Cancelled):
        prune_file(
            PLY,
            tmp_path / "out.ply",
            views,
            Budget(ratio=0.5),
            progress=lambda _fraction, _what: next(calls) < last,
        )

    assert list(tmp_path.iterdir()) == []


TENTHS = [tenth / 10 for tenth in range(1, 10)]


def wide(splats: Splats) -> Splats:
    """Return the same numbers as doubles, in every attribute."""
    return Splats(**{item: getattr(splats, item).astype(np.float64) for item in ARRAYS})


def agreement(one: Scores, other: Scores) -> list[float]:
    """Return the Jaccard index of the kept sets of two scores at each tenth removed."""
    kept = [[select(scores, Budget(ratio=r)) for r in TENTHS] for scores in (one, other)]
    return [np.count_nonzero(a & b) / np.count_nonzero(a | b) for a, b in zip(*kept, strict=True)]


def in_doubles(splats: Splats, views: ViewSet) -> Scores:
    """Evaluate the default closed form plainly: every number a double, all splats at once."""
    middle, spread = views.middle()
    means = splats.means.astype(np.float64)
    squared = np.sum((means - middle) ** 2, axis=1) + spread
    size = np.sqrt(np.median(squared))
    total, seen = np.zeros(len(means)), np.zeros(len(means), np.int32)
    longest = np.exp(splats.log_scales.astype(np.float64).max(axis=1))
    for view, weight in zip(views, views.weights, strict=True):
        x, y, z = view.rotation @ (means - view.center).T
        half_x, half_y = view.width / 2, view.height / 2
        between = (z >= (view.near or 0.01 * size)) & (z <= view.far)
        edge_x = np.abs(view.fx * x + (view.cx - half_x) * z) / half_x
        edge_y = np.abs(view.fy * y + (view.cy - half_y) * z) / half_y
        across = np.maximum(np.maximum(edge_x, edge_y), z)
        steepness = np.sqrt(1 + view.fx * view.fy / (half_x * half_y))
        share = np.clip(1 - (across - z) / (2 * longest * steepness), 0, 1) * between
        total += weight * share / (across**2 + 0.005 * size * size)
        seen += between & (across == z)
    total = np.where(total == 0, 1e-6 / (squared + 0.005 * size * size), total)
    alpha = 1.0 / (1.0 + np.exp(-splats.opacity_logits.astype(np.float64)))
    low, middle_one, high = np.sort(splats.log_scales.astype(np.float64), axis=1).T
    luma = (0.28209479177387814 * splats.sh_dc.astype(np.float64) + 0.5).clip(0, 1) @ LUMA
    factors = lambdas(
        float(np.mean(np.minimum(np.exp(high - low), 1e6))),
        float(np.var(luma)),
        float(np.mean(4 * alpha * (1 - alpha))),
    )
    values = np.zeros(len(means))
    for share, content in zip(factors, (np.exp(middle_one + high), luma**2, alpha**2), strict=True):
        term = alpha * total * content
        values += share * term / term.mean()
    weighted = (means - middle) / squared[:, None]
    axes = principal_axes(np.vstack([weighted.T @ (means - middle), weighted.sum(axis=0)]))
    place = (means - middle) @ axes.T / size
    ball = place / (1 + np.linalg.norm(place, axis=1, keepdims=True))
    _, own = np.unique(np.floor((ball + 1) * 32).astype(int), axis=0, return_inverse=True)
    own = own.ravel()
    around = (np.bincount(own, values) / np.bincount(own))[own]
    values *= (around / values.mean()) ** (-0.5 * values / (values + 0.05 * values.mean()))
    return Scores(values, seen, len(views), 0)


@pytest.mark.slow
def test_closed_form_of_floats_keeps_the_splats_that_doubles_keep(file, views):
    """At every tenth: against the same numbers as doubles, and against the formula in doubles."""
    splats = file.splats()
    for form in ({}, {"depth": "distance"}, {"depth": "distance", "frustum": False}):
        scores = closed_form.score(splats, views, **form)

        assert agreement(scores, closed_form.score(wide(splats), views, **form)) == [1.0] * 9

    assert agreement(score(splats, views, FAST), in_doubles(splats, views)) == [1.0] * 9


class Doubles:
    """NumPy, but for what float32 is."""

    float32 = np.float64

    def __getattr__(self, name: str) -> object:
        """Return what NumPy has."""
        return getattr(np, name)


@pytest.mark.slow
@pytest.mark.parametrize(("rounds", "every"), [(1, 4), (3, 8)])
def test_occlusion_in_floats_keeps_the_splats_that_doubles_keep(
    file, views, monkeypatch, rounds, every
):
    """The method computes in float32; against the same code with every float32 a double.

    A point on the edge of a cell falls on either side: two splats for two others at 90 %.
    """
    some = views.take(range(0, len(views), every))
    scores = occlusion.score(file.splats(), some, rounds=rounds)
    for module in (projection, points, measuring, rays):
        monkeypatch.setattr(module, "np", Doubles())
    monkeypatch.setattr(projection, "_by_depth", lambda depth: np.argsort(depth, kind="stable"))
    gaussians, frame, _ = projection.prepare(wide(file.splats()), some)
    assert projection.project(gaussians, frame, some[0]).centers.dtype == np.float64

    # Other processes have floats.
    expected = occlusion.score(wide(file.splats()), some, rounds=rounds, threads=1)

    assert min(agreement(scores, expected)) >= 0.999


@pytest.mark.slow
def test_core_imports_where_there_is_no_blender():
    """`sys.modules["bpy"] = None` makes any import of it fail."""
    code = (
        "import sys\n"
        "for name in ('bpy', 'bmesh', 'mathutils', 'gpu'): sys.modules[name] = None\n"
        "import refine_addon.core, refine_addon.command.subcommands\n"
    )

    subprocess.run([sys.executable, "-c", code], check=True)


@pytest.fixture(scope="module")
def small(file, tmp_path_factory):
    """Every twentieth splat of the room, as a file."""
    path = tmp_path_factory.mktemp("small") / "small.ply"
    keep = np.zeros(len(file), np.bool_)
    keep[::20] = True
    file.write(path, keep)
    return path


@pytest.mark.slow
def test_merging_file_to_file_writes_the_changed_splats_and_the_rest_bit_for_bit(
    small, views, tmp_path
):
    """The budget says how many survive; the report and a note say how many of them changed."""
    before = read_ply(small)
    result = prune_file(small, tmp_path / "out.ply", views, Budget(ratio=0.6), Merge())

    after = read_ply(tmp_path / "out.ply")

    changed, kept = result.merged.changed, before.rows[result.keep]
    assert len(after) == len(before) - len(before) * 6 // 10
    assert after.rows[~changed].tobytes() == kept[~changed].tobytes()
    np.testing.assert_array_equal(
        after.splats().means, result.merged.splats.means.astype(np.float32)
    )
    facts = result.report["merged"]
    assert facts["changed"] == np.count_nonzero(changed) > 0
    assert facts["merged"] + facts["deleted"] == result.report["splats"]["removed"]
    assert any("merged into" in note for note in result.report["notes"])


@pytest.mark.slow
def test_kept_splats_of_doubles_are_doubles(small, views, tmp_path):
    """At an offset of 1e6, float32 knows steps of .0625: each kept splat has a place of its own.

    Every number written is the one that merging came to, to the last of its 53 bits.
    """
    rows = read_ply(small).rows
    columns = {name: rows[name].astype("f8") for name in rows.dtype.names}
    columns["x"] += 1e6
    (tmp_path / "in.ply").write_bytes(ply_of(columns))
    moved = ViewSet(
        tuple(replace(view, center=view.center + np.array([1e6, 0, 0])) for view in views)
    )

    result = prune_file(
        tmp_path / "in.ply",
        tmp_path / "out.ply",
        moved,
        Budget(ratio=0.6),
        Merge(),
    )

    written, changed = read_ply(tmp_path / "out.ply").splats(), result.merged.changed
    assert len(np.unique(written.means[changed, 0])) == np.count_nonzero(changed) > 100
    for item in ARRAYS:
        wanted = getattr(result.merged.splats, item)
        np.testing.assert_array_equal(getattr(written, item), wanted)
        assert wanted.dtype == np.float64


@pytest.mark.slow
def test_a_budget_that_only_scores_can_tell_says_how_many_kept_splats_merge(small, views):
    """The threshold is the median score: half survive, by whatever costs least."""
    splats = read_ply(small).splats()
    median = float(np.median(score(splats, views).values))

    result = prune(splats, views, Budget(threshold=median))

    assert np.count_nonzero(result.keep) == pytest.approx(len(splats) / 2, abs=1)


@pytest.mark.slow
@pytest.mark.parametrize("method", [FAST, Occlusion(), Merge()])
def test_scores_that_are_there_already_decide_as_new_ones_would(small, views, method):
    """The panel scores once and applies later: the same splats, and the same report of them."""
    splats, budget = read_ply(small).splats(), Budget(threshold=0.5)
    at_once = prune(splats, views, budget, method)
    scores = score(splats, views, method)
    scene = (splats, views) if method.changes else (None, None)

    later = prune(*scene, budget, method, scores=scores)

    np.testing.assert_array_equal(at_once.keep, later.keep)
    for report in (at_once.report, later.report):
        del report["timings"], report["method"]["seconds"]
    assert at_once.report == later.report


@pytest.mark.parametrize("budget", [Budget(ratio=0.04), Budget(psnr=80.0)])
def test_known_scores_decide_where_merging_deletes(small, views, budget, monkeypatch):
    """Apply keeps what the panel marked by these scores, and does not score again."""
    splats = read_ply(small).splats()
    scores = score(splats, views, Occlusion(3))
    marked = prune(None, None, budget, Occlusion(12), scores=scores)
    fresh = prune(splats, views, budget, Occlusion(12))
    monkeypatch.delattr(PRUNE.occlusion, "score")

    result = prune(splats, views, budget, Merge(12), scores=scores)

    assert result.merged is None
    assert result.report["method"]["asked"] == "merge"
    assert result.report["method"]["done"] == "occlusion"
    np.testing.assert_array_equal(result.keep, marked.keep)
    assert (result.keep != fresh.keep).any()


def test_splats_without_scores_need_views_to_decide(small):
    """And merging needs both."""
    with pytest.raises(RefineError, match="need both"):
        prune(read_ply(small), None, Budget(ratio=0.5))


@pytest.mark.slow
def test_protected_splats_stay_as_they_are_while_others_merge(small, views):
    """Every third is protected, and six of ten go."""
    splats = read_ply(small).splats()
    protected = np.arange(len(splats)) % 3 == 0

    result = prune(splats, views, Budget(ratio=0.6), protected=protected, method=Merge())

    assert result.keep[protected].all()
    assert np.count_nonzero(result.keep) == len(splats) - len(splats) * 6 // 10
    assert not result.merged.changed[protected[result.keep]].any()


@pytest.mark.slow
def test_nothing_to_remove_leaves_merging_nothing_to_do(small, views):
    """All stay, none changes."""
    result = prune(read_ply(small).splats(), views, Budget(ratio=0.0), Merge())

    assert result.keep.all()
    assert result.merged is None


@pytest.mark.slow
def test_later_stages_measure_half_of_the_views_and_take_over_the_rest(small, views, monkeypatch):
    """What was expected counts by the share of the views that were not measured.

    In place of the second measuring 1 for every splat, from a quarter of the views: 1 + .75 times
    what was expected. All views are measured once, before.
    """
    asked, seen = [], []

    def quarter(splats, _views, turn, parts, **_):
        asked.append((turn, parts))
        ones = np.ones(len(splats))
        return Measured(ones, 2.0 * ones, np.zeros(len(splats), np.int32)), 0.25

    def listening(splats, used, sums, measure, count, original=PRUNE.merge, **changes):
        def tell(now, expected, progress):
            sums = measure(now, expected, progress)
            seen.append((sums, expected))
            return sums

        return original(splats, used, sums, tell, count, **changes)

    monkeypatch.setattr(occlusion, "measure_part", quarter)
    monkeypatch.setattr(PRUNE, "merge", listening)
    prune(read_ply(small).splats(), views, Budget(ratio=0.7), Merge())

    assert asked == [(turn, 2) for turn in range(len(asked))]
    assert len(seen) == len(asked) > 0
    for sums, expected in seen:
        np.testing.assert_allclose(sums[0], 1.0 + 0.75 * expected[0])
        np.testing.assert_allclose(sums[1], 2.0 + 0.75 * expected[1])


@pytest.fixture(
    scope="module",
    params=["", "a seventh stays", "half stays"],
)
def scored_for_all(request, small, views):
    """Return a task without scores, one with the scores for every budget, and what has to stay."""
    zoned = request.param
    splats = read_ply(small).splats()
    every = np.arange(len(splats))
    held = every % 2 == 0 if zoned.startswith("half") else every % 7 == 0
    demands = {"protected": held, "removed": every % 11 == 0} if zoned else {}

    def decide(ratio, **changes):
        return prune(splats, views, Budget(ratio=ratio), Occlusion(12), **demands, **changes)

    return decide, decide(0.5, reusable=True).scores, zoned


@pytest.mark.slow
@pytest.mark.parametrize("ratio", [0.05, 0.55, 0.93])
def test_scoring_for_one_budget_decides_what_scores_for_all_would(scored_for_all, ratio):
    """Scoring ends with the round that removes the last of its splats: the same report, too."""
    decide, scores, zoned = scored_for_all
    some = decide(ratio)

    whole = decide(ratio, scores=scores)

    assert whole.scores.settled is None
    np.testing.assert_array_equal(some.keep, whole.keep)
    for name in ("estimated_psnr", "splats", "notes"):
        assert some.report[name] == whole.report[name]
    assert some.report["method"]["psnr"] == whole.report["method"]["psnr"]
    known = len(some.report["quality"]["shares"])
    for name in ("shares", "psnr", "merged"):
        # Means over the views are products of matrices, whose last digit depends on their shape.
        expected = whole.report["quality"][name][:known]
        assert some.report["quality"][name] == pytest.approx(expected, rel=1e-12)
    assert some.report["quality"]["shares"][-1] >= ratio
    if not zoned.startswith("half"):
        assert (known == 10) == (ratio > 0.9)


@pytest.mark.slow
def test_scores_of_one_budget_are_refused_for_a_larger_one(small, views):
    """What they say of the splats that stayed is not final; views seen are."""
    splats = read_ply(small).splats()
    protected = np.arange(len(splats)) % 5 == 0
    scores = prune(splats, views, Budget(ratio=0.2), Occlusion(8), protected=protected).scores
    settled = int(0.3 * len(splats)) + np.count_nonzero(protected)

    assert scores.settled == settled
    assert select(scores, Budget(keep=len(splats) - settled)).sum() == len(splats) - settled
    assert select(scores, Budget(min_seen=50)).any()
    assert select(scores, Budget(ratio=0.35), protected=protected).sum() > 0
    assert select(scores, Budget(ratio=0.0), protected=~protected).all()
    with pytest.raises(RefineError, match=rf"removes up to {settled} of {len(splats)}"):
        select(scores, Budget(keep=len(splats) - settled - 1))
    with pytest.raises(RefineError, match="score again, for all budgets"):
        select(scores, Budget(ratio=0.45), protected=protected)
    with pytest.raises(RefineError, match="score again"):
        select(scores, Budget(psnr=scores.quality.psnr[-1] - 0.1))
    assert not select(scores, Budget(psnr=scores.quality.psnr[-1] + 0.1)).all()
    with pytest.raises(RefineError, match="score again"):
        select(scores, Budget(threshold=0.9))
