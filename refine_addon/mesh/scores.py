"""Scores and floaters on a mesh: point attributes, and records of how they were computed."""

from __future__ import annotations

import json
import uuid
import zlib
from collections.abc import Collection, Sequence
from typing import Any

import bpy
import numpy as np
from numpy.typing import NDArray

from ..core import Method, RefineError, Scores, rank
from ..core.cleaning.clean import REASONS, Cleaned, in_words
from ..core.quality.curve import Quality
from . import attributes, edit
from .layout import Data, SplatObject, has, recorded, rows_of, splat_count

SCORE, RANK, SEEN = "refine_score", "refine_rank", "refine_seen"
"""Point attributes: score, rank from 0 (removed first) to 1, number of views with the splat."""

SCORED = "refine_scored"
"""Boolean point attribute: whether the splat has a score. False if it was removed by the user, or
added later, as false is Blender's default."""

_TOLD = ("method", "views_given", "views_used", "views_between")  # Fields of `Scores` in a record
RECORD = "refine_scores"  # Custom property of the mesh: record of its scoring, JSON
REASON = "refine_floats"  # Integer point attribute: 0, or 1 + the index of a reason in `REASONS`
FLOATERS = "refine_floaters"  # Custom property of the mesh: floaters by reason, and how sure, JSON


def store(
    group: Sequence[SplatObject],
    scores: Scores,
    method: Method,
    *,
    origins: Sequence[dict[str, Any] | None] = (None,),
    protected: NDArray[np.bool_] | None = None,
    **facts: Any,
) -> None:
    """Write scores of all splats of some objects, scored together, and a record to each mesh.
    `origins`: of each object, see `plans.origin`. `protected`: (N,) bool of all, as the quality
    curve has it. `facts`: what panels tell besides: `cameras`, name and number of splats of each
    view, and `seconds` of scoring."""
    for checked in group:
        edit.check_writable(checked.obj)
    total, ranks = len(scores.values), rank(scores.values)
    scored = np.ones(total, np.bool_) if scores.scored is None else scores.scored
    of_all = {
        "settings": method.facts(),
        **{name: getattr(scores, name) for name in _TOLD},
        "weights": scores.facts,
        "notes": scores.notes,
        "quality": scores.quality.facts() if scores.quality else None,
        "alignment": scores.alignment.facts() if scores.alignment else None,
        **facts,
        "together": {"id": uuid.uuid4().hex, "splats": total} if len(group) > 1 else None,
    }
    for checked, origin, rows in zip(group, origins, rows_of(map(len, group)), strict=True):
        mesh = checked.mesh
        attributes.write_attribute(mesh, SCORE, "FLOAT", scores.values[rows])
        attributes.write_attribute(mesh, RANK, "FLOAT", ranks[rows])
        attributes.write_attribute(mesh, SEEN, "INT", scores.seen[rows])
        attributes.write_attribute(mesh, SCORED, "BOOLEAN", scored[rows])
        stay = digest(None if protected is None else protected[rows])
        own = {"splats": len(checked), "origin": origin, "protected": stay}
        mesh[RECORD] = json.dumps(of_all | own)
        attributes.updated(mesh)


def forget(checked: SplatObject) -> None:
    """Remove a writable object's scores, their record, and the preview of what goes."""
    mesh = checked.mesh
    for name in (SCORE, RANK, SEEN, SCORED, edit.REMOVE):
        attributes.remove_attribute(mesh, name)
    mesh.pop(RECORD, None)
    attributes.updated(mesh)


def digest(mask: NDArray[np.bool_] | None) -> list[int]:
    """Number of splats in a mask, (N,) bool, and the mask's checksum; [0, 0] if empty."""
    if mask is None or not mask.any():
        return [0, 0]
    return [int(np.count_nonzero(mask)), zlib.crc32(np.packbits(mask).tobytes())]


def record(mesh: bpy.types.Mesh) -> dict[str, Any] | None:
    """Record of a mesh's scoring; None without one, or if it is damaged."""
    needed = {"splats", "settings", "views_given", "views_used"}
    return recorded(mesh, RECORD, lambda content: content if content.keys() >= needed else None)


def move_origin(mesh: Data, before: NDArray[np.float64], after: NDArray[np.float64]) -> None:
    """Keep scores valid for an object whose (4, 4) matrix changed while its splats stayed in place
    in the world."""
    scoring = record(mesh) or {}
    origin = scoring.get("origin")
    if origin and np.allclose(origin.get("matrix", np.nan), before, rtol=0.0, atol=1e-6):
        origin = {**origin, "matrix": np.asarray(after).tolist()}
        mesh[RECORD] = json.dumps({**scoring, "origin": origin})


_KINDS = {SCORE: "FLOAT", SEEN: "INT", SCORED: "BOOLEAN"}


def stored_scores(group: Sequence[SplatObject], removed: NDArray[np.bool_] | None = None) -> Scores:
    """Scores of several objects, concatenated; splats in `removed`, (N,) bool of all, need none.
    `RefineError` if others have none, or if the objects were not scored together."""
    records, columns = [], []
    removed = np.zeros(sum(map(len, group)), np.bool_) if removed is None else removed
    for checked, rows in zip(group, rows_of(map(len, group)), strict=True):
        scoring, label = record(checked.mesh), f"object '{checked.obj.name}'"
        if scoring is None or not all(has(checked.mesh, *each) for each in _KINDS.items()):
            raise RefineError(f"{label}: has no scores; score it first")
        own = [attributes.read_attribute(checked.mesh, name) for name in _KINDS]
        count = len(checked)
        unscored = int(np.count_nonzero(~own[2] & ~removed[rows]))
        if count > scoring["splats"] or unscored:
            raise RefineError(
                f"{label}: scored with {scoring['splats']} splats, has {count} now, "
                f"{unscored} of them without a score; score it again"
            )
        records.append(scoring)
        columns.append(own)
    values, seen, scored = (np.concatenate(parts) for parts in zip(*columns, strict=True))
    together = [each.get("together") or {} for each in records]
    if len(group) > 1 and len({each.get("id") or index for index, each in enumerate(together)}) > 1:
        raise RefineError(
            f"the {len(group)} selected objects were not scored together: score them as they are "
            "selected, or select only one"
        )
    # The quality curve holds only for all scored splats, with the same ones removed.
    first = records[0]
    total = together[0].get("splats", first["splats"])
    whole = len(values) == total and np.array_equal(removed, ~scored)
    return Scores(
        values=values,
        seen=seen,
        undrawable=int(np.count_nonzero((values == 0.0) & scored)),
        facts=first.get("weights", {}),
        notes=tuple(first.get("notes", ())),
        quality=Quality.from_facts(first.get("quality")) if whole else None,
        scored=None if scored.all() else scored,
        **{name: first[name] for name in _TOLD if name in first},
    )


def store_floaters(checked: SplatObject, cleaned: Cleaned) -> None:
    """Write floaters and their record to a writable object's mesh."""
    reasons = np.zeros(len(cleaned.keep), np.int32)
    for number, name in enumerate(REASONS, start=1):
        reasons[cleaned.by_reason[name]] = number
    attributes.write_attribute(checked.mesh, REASON, "INT", reasons)
    counts = {name: int(np.count_nonzero(mask)) for name, mask in cleaned.by_reason.items()}
    content = {"splats": len(reasons), "counts": counts, "sure": cleaned.surety()}
    checked.mesh[FLOATERS] = json.dumps(content)
    attributes.updated(checked.mesh)


def floaters(mesh: Data) -> dict[str, tuple[int, float]] | None:
    """Floaters for each reason, and the share of further views that see past them, 0 if unknown.
    None without a search since splats were deleted."""

    def read(content: Any) -> dict[str, tuple[int, float]] | None:
        if content["splats"] != splat_count(mesh) or REASON not in mesh.attributes:
            return None
        counts, sure = content["counts"], content["sure"]
        return {name: (int(counts[name]), float(sure[name] or 0.0)) for name in REASONS}

    return recorded(mesh, FLOATERS, read)


def floaters_in_words(mesh: bpy.types.ID | None, reasons: Collection[str]) -> str:
    """Floaters for these reasons, and how surely they float; "" where `floaters` is None."""
    found = floaters(mesh) if mesh else None
    if found is None:
        return ""
    going = {name: found[name] for name in reasons}
    total = sum(count for count, _ in going.values())
    return f"{total:,} of {splat_count(mesh):,} float: {in_words(going)}"


def floater_mask(checked: SplatObject, reasons: Collection[str]) -> NDArray[np.bool_]:
    """Floaters of these reasons, (N,) bool; `RefineError` where `floaters` is None."""
    if floaters(checked.mesh) is None:
        raise RefineError(f"object '{checked.obj.name}': find floaters first: Clean")
    numbers = [number for number, name in enumerate(REASONS, start=1) if name in reasons]
    return np.isin(attributes.read_attribute(checked.mesh, REASON), numbers)
