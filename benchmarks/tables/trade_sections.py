"""The tables of the trade's report that are no part of its main one: one function for each part."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterable, Sequence

from . import finetune, flops, million, refits
from .cost import Cost
from .results import Measured


def table(heads: Sequence[str], rows: Iterable[Sequence[str]]) -> list[str]:
    """Return the lines of a table in Markdown."""
    lines = [f"| {' | '.join(heads)} |", "|---" + "|---:" * (len(heads) - 1) + "|"]
    return lines + [f"| {' | '.join(row)} |" for row in rows]


def sections(scene: Measured, ratios: Sequence[float]) -> list[str]:
    """Return the lines of all parts that were measured of a scene."""
    return [
        *_sizes_table(scene),
        *_estimate_table(scene, ratios),
        *_refit_tables(scene, ratios),
        *_finetune_table(scene),
        *_million_table(scene),
        *_cheaper_table(scene, ratios),
        *_ablation_table(scene, ratios),
        *_flops_table(scene),
        *_hessian_table(scene),
    ]


def _seconds(cost: Cost) -> str:
    return f"{cost.seconds:.2f} ({cost.busy:.2f})"


def _sizes_table(scene: Measured) -> list[str]:
    if not scene.sizes:
        return []
    sizes = list(scene.sizes[0].costs)
    body = []
    for line in scene.sizes:
        costs = [line.costs[size] for size in sizes]
        growth = costs[-1].busy / max(costs[-2].busy, 1e-9) if len(costs) > 1 else 1.0
        body.append([line.name, *map(_seconds, costs), f"{growth:.2f}"])
    heads = ["seconds (of the processor)", *sizes, "last over the one before it"]
    return ["", f"### {scene.name}: seconds by the size of the pictures", "",
            ("Half removed. The first size is that of the files; the last column compares "
            "processor time."), "",
            *table(heads, body)]  # fmt: skip


def _estimate_table(scene: Measured, ratios: Sequence[float]) -> list[str]:
    if not scene.estimate:
        return []
    by_way = defaultdict(list)
    for row in scene.estimate:
        by_way[row.way].append(row)
    body = [
        [way, *(f"{row.estimate:.1f}/{row.truth:.1f} ({_signed(row.off)})" for row in rows)]
        for way, rows in by_way.items()
    ]
    errors = [abs(row.off) for row in scene.estimate]
    return ["", f"### {scene.name}: the estimated quality beside the truth", "",
            ("`estimated_psnr` of the report/mean PSNR of renders of all scoring views "
            "(difference), dB; ranked by occlusion."), "",
            *table(["estimate/truth", *(f"{ratio:.0%}" for ratio in ratios)], body), "",
            (f"Mean error {sum(errors) / len(errors):.2f} dB, largest {max(errors):.2f} dB.")
            ]  # fmt: skip


def _signed(value: float) -> str:
    return f"{round(value, 1) + 0.0:+.1f}"  # no minus before a zero


def _refit_tables(scene: Measured, ratios: Sequence[float]) -> list[str]:
    if not scene.refits:
        return []
    heads, rounds, ways = [f"{ratio:.0%}" for ratio in ratios], [], []
    for name in dict.fromkeys(curve.name for curve in scene.refits):
        curves = [curve for curve in scene.refits if curve.name == name]
        if name in refits.STARTS:
            rounds.append([name, *(" ".join(f"{psnr:.1f}" for _, psnr in curve.rounds)
                                   for curve in curves)])  # fmt: skip
            rounds.append(["seconds", *(" ".join(f"{curve.start + seconds:.1f}"
                                                 for seconds, _ in curve.rounds)
                                        for curve in curves)])  # fmt: skip
        if name == "merged" or name not in refits.STARTS:
            label = "as it is" if name == "merged" else name
            ways.append([label, *(f"{curve.rounds[-1][1]:.1f} ({curve.rounds[-1][0]:.1f})"
                                  for curve in curves)])  # fmt: skip
    how = ("PSNR on held-out views against renders, dB. Seconds are the processor's with one "
           "thread, without comparing,")  # fmt: skip
    return ["", f"### {scene.name}: refitting, round after round", "",
            f"{how} and count from the scores. The first number is before any round.", "",
            *table(["refitted", *heads], rounds), "",
            f"### {scene.name}: refitting made cheaper", "",
            f"After merging. {how} of refitting alone.", "",
            *table(["refitting", *heads], ways)]  # fmt: skip


def _finetune_table(scene: Measured) -> list[str]:
    if not scene.finetune:
        return []
    by_name = defaultdict(list)
    for row in scene.finetune:
        by_name[row.name].append(row)
    body = [
        [name, *(f"{row.before:.2f} -> {row.after:.2f}" for row in rows),
         f"{rows[-1].seconds:.0f}"]
        for name, rows in by_name.items()
    ]  # fmt: skip
    unpruned = scene.unpruned.get(("held-out", "pictures"), {}).get("psnr")
    known = "" if unpruned is None else f" Unpruned: {unpruned:.2f} dB."
    return ["", f"### {scene.name}: after training on the photos", "",
            ("PSNR on held-out views against their photos, dB, before and after "
            f"{scene.iterations} iterations on the photos of the scoring views.{known} All "
            "parameters are trained by Adam at the reference implementation's learning rates (of "
            "means: its last) and loss (0.8 L1, 0.2 SSIM); splats are neither added nor removed "
            "(`benchmarks/tables/finetune.py`)."), "",
            *table(["removed", *(f"{ratio:.0%}" for ratio in finetune.RATIOS), "seconds"], body)
            ]  # fmt: skip


def _million_table(scene: Measured) -> list[str]:
    found = scene.million
    if found is None:
        return []
    body = [
        [one.name, f"{one.psnr:.1f}", f"{one.seconds:.1f}", f"{one.busy:.1f}",
         f"{one.megabytes:,.0f}"]
        for one in found.commands
    ]  # fmt: skip
    return ["", f"### {scene.name}: {found.splats:,} splats", "",
            (f"Made of the {found.source:,} by splitting the largest in two along their longest "
            f"axis ({million.ASIDE:g} standard deviations to either side, one a little brighter); "
            f"renders before and after agree to {found.likeness:.1f} dB. Whole processes, file to "
            f"file, all scoring views, pictures {million.WIDTH} px wide; PSNR on {found.compared} "
            f"held-out views against renders of the {found.splats:,}. Halves of one splat are "
            "alike, which flatters everything that merges."), "",
            *table(["half removed", "PSNR", "seconds", "of the processor", "MB"], body)
            ]  # fmt: skip


def _cheaper_table(scene: Measured, ratios: Sequence[float]) -> list[str]:
    if not scene.cheaper:
        return []
    body = [
        [line.name, *(f"{value:.1f}" for value in line.psnr), f"{line.seconds:.2f}"]
        for line in scene.cheaper
    ]
    return ["", f"### {scene.name}: speed for accuracy within occlusion", "",
            ("PSNR on held-out views against renders. Views are `--views`; cells, density and "
            "rounds are arguments of `core/scoring/occlusion.py`."), "",
            *table(["occlusion", *(f"{r:.0%}" for r in ratios), "seconds"], body)]  # fmt: skip


def _ablation_table(scene: Measured, ratios: Sequence[float]) -> list[str]:
    if not scene.ablation:
        return []
    body = [[line.name, *(f"{value:.1f}" for value in line.psnr)] for line in scene.ablation]
    return ["", f"### {scene.name}: the closed form without its parts", "",
            ("PSNR on held-out views against renders. Visibility is alpha, projection "
            "1 / (d^2 + eta), equal weights lambda = 1/3."), "",
            *table(["closed form", *(f"{ratio:.0%}" for ratio in ratios)], body)]  # fmt: skip


def _flops_table(scene: Measured) -> list[str]:
    counts = scene.flops
    if counts is None:
        return []
    everything = counts.splats * counts.views / 1e9
    body = [
        [one.method, f"{one.per_splat:.0f}", f"{one.per_splat_view:.1f}",
         f"{one.per_splat_view * everything + one.per_splat * counts.splats / 1e9:.2f}"]
        for one in counts.methods
    ]  # fmt: skip
    rendered = flops.PER_HIT * counts.hits_per_splat_view
    body.append(["rendered statistics, at least", "", f"{rendered:.0f}",
                 f"{rendered * everything:.2f}"])  # fmt: skip
    failed = [f"- {name} could not be counted: {why}" for name, why in counts.failed.items()]
    return ["", f"### {scene.name}: floating-point operations", "",
            ("Counted by running the code with arrays that count (`tables/flops.py`, where "
            "`ANALYTIC` is the closed form's count by hand, which a test compares); the last "
            f"column is for all {counts.splats:,} splats and {counts.views} views. Rendering "
            f"draws a splat in {counts.hits_per_splat_view:.1f} pixels of a view on average, "
            f"{flops.PER_HIT} operations each."),
            "", *table(["method", "a splat", "a splat and view", "all, 1e9"], body),
            *(["", *failed] if failed else [])]  # fmt: skip


def _hessian_table(scene: Measured) -> list[str]:
    found = scene.hessian
    if found is None:
        return []
    body = [
        ["splats (14 parameters each)", found.primitives, found.primitives_unitless],
        ["attributes of a splat (geometry, opacity, colour)", found.attributes,
         found.attributes_unitless],
        ["removals of single splats", found.removals, found.removals],
    ]  # fmt: skip
    rows = [[str(name), f"{raw:.3f}", f"{free:.3f}"] for name, raw, free in body]
    rows[-1][-1] = ""
    return ["", f"### {scene.name}: how independent splats and attributes are", "",
            ("Diagonal energy ratio of the Gauss-Newton Hessian of the pictures, 1 is independent; "
            f"mean over {found.groups} random splats with {found.neighbours} nearest neighbours, "
            f"{found.views} views (`tables/hessian.py`). Unitless: every parameter's own diagonal "
            "entry is 1."), "",
            *table(["diagonal blocks", "as it is", "unitless"], rows)]  # fmt: skip
