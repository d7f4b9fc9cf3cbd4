"""The tables of the trade's report that are no part of its main one: one function for each part."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterable, Sequence

from . import finetune, million, refits
from .results import Measured


def table(heads: Sequence[str], rows: Iterable[Sequence[str]]) -> list[str]:
    """Return the lines of a table in Markdown."""
    lines = [f"| {' | '.join(heads)} |", "|---" + "|---:" * (len(heads) - 1) + "|"]
    return lines + [f"| {' | '.join(row)} |" for row in rows]


def sections(scene: Measured, ratios: Sequence[float]) -> list[str]:
    """Return the lines of all parts that were measured of a scene."""
    return [
        *_estimate_table(scene, ratios),
        *_refit_tables(scene, ratios),
        *_finetune_table(scene),
        *_million_table(scene),
        *_ablation_table(scene, ratios),
    ]


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


def _ablation_table(scene: Measured, ratios: Sequence[float]) -> list[str]:
    if not scene.ablation:
        return []
    body = [[line.name, *(f"{value:.1f}" for value in line.psnr)] for line in scene.ablation]
    return ["", f"### {scene.name}: the closed form without its parts", "",
            ("PSNR on held-out views against renders. Visibility is alpha, projection "
            "1 / (d^2 + eta), equal weights lambda = 1/3."), "",
            *table(["closed form", *(f"{ratio:.0%}" for ratio in ratios)], body)]  # fmt: skip
