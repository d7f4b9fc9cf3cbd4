"""Scores on a mesh: attributes to look at and select by, and a record of how they came to be."""

from __future__ import annotations

import json
import zlib
from collections.abc import Sequence
from typing import Any

import bpy
import numpy as np
from numpy.typing import NDArray

from ..core.errors import RefineError
from ..core.methods import Method
from ..core.quality.curve import Quality
from ..core.scores import Scores
from ..core.selection import rank
from . import attributes as mesh_attributes
from . import edit as mesh_edit
from .layout import SplatObject
from .records import parsed

SCORE, RANK, SEEN = "refine_score", "refine_rank", "refine_seen"
"""Point attributes: the score, its place from 0 (goes first) to 1, in how many views it lies."""

SCORED = "refine_scored"
"""Boolean point attribute: which splats have a score. Neither those that had to go have one,
nor those that were joined or added since, for which Blender writes False."""

RECORD = "refine_scores"
"""Custom property of the mesh: how its scores came to be, as JSON."""


def store(
    checked: SplatObject,
    scores: Scores,
    method: Method,
    *,
    origin: dict[str, Any] | None = None,
    cameras: list[tuple[str, int]] | None = None,
    protected: NDArray[np.bool_] | None = None,
    together: tuple[str, int, NDArray[np.float64]] | None = None,
    seconds: float | None = None,
) -> None:
    """Write scores to the attributes of an object's mesh, and record how they came to be.

    Parameters
    ----------
    checked : SplatObject
    scores : Scores
    method : Method
        What they were made with.
    origin : dict, optional
        See `staleness.origin`.
    cameras : list of (str, int), optional
        Name of each view given, and how many splats lie in it.
    protected : (N,) bool, optional
        Which splats the curve takes to stay.
    together : (str, int, (N,) float64), optional
        Where other objects were scored with it: a name for the scoring, how many splats all have,
        and ranks of this object's among all; the curve is that of all then.
    seconds : float, optional
        How long scoring took.

    Raises
    ------
    RefineError
        If the object cannot be written to, or no longer has as many splats.
    """
    mesh_edit.check_writable(checked.obj)
    mesh = checked.mesh
    if len(checked) != len(scores.values):
        raise RefineError(
            f"object '{checked.obj.name}': has {len(checked)} splats, was scored with "
            f"{len(scores.values)}; score it again"
        )
    ranks = together[2] if together else rank(scores.values)
    new_record = json.dumps(
        {
            "splats": len(scores.values),
            "settings": method.facts(),
            "method": scores.method,
            "views_given": scores.views_given,
            "views_used": scores.views_used,
            "undrawable": scores.undrawable,
            "weights": scores.facts,
            "notes": scores.notes,
            "quality": scores.quality.facts() if scores.quality else None,
            "alignment": scores.alignment.facts() if scores.alignment else None,
            "origin": origin,
            "cameras": cameras,
            "protected": digest(protected),
            "seconds": seconds,
            "together": together and {"id": together[0], "splats": together[1]},
        }
    )
    mesh_attributes.write_attribute(mesh, SCORE, "FLOAT", scores.values)
    mesh_attributes.write_attribute(mesh, RANK, "FLOAT", ranks)
    mesh_attributes.write_attribute(mesh, SEEN, "INT", scores.seen)
    scored = np.ones(len(checked), np.bool_) if scores.scored is None else scores.scored
    mesh_attributes.write_attribute(mesh, SCORED, "BOOLEAN", scored)
    mesh[RECORD] = new_record
    mesh_attributes.updated(mesh)


def forget(checked: SplatObject) -> None:
    """Remove the scores of an object, with all that shows them and goes by them.

    Raises
    ------
    RefineError
        If the object cannot be written to.
    """
    mesh_edit.check_writable(checked.obj)
    mesh = checked.mesh
    for name in (SCORE, RANK, SEEN, SCORED, mesh_edit.REMOVE):
        mesh_attributes.remove_attribute(mesh, name)
    mesh.pop(RECORD, None)
    mesh_attributes.updated(mesh)


def digest(mask: NDArray[np.bool_] | None) -> list[int]:
    """Return how many splats a mask, (N,) bool, marks, and a checksum of which; [0, 0] if none."""
    if mask is None or not mask.any():
        return [0, 0]
    return [int(np.count_nonzero(mask)), zlib.crc32(np.packbits(mask).tobytes())]


def record(mesh: bpy.types.Mesh) -> dict[str, Any] | None:
    """Return how a mesh was scored, None if it was not."""
    try:
        recorded: dict[str, Any] = parsed(mesh[RECORD])
        complete = recorded.keys() >= {"splats", "settings", "views_given", "views_used"}
    except (KeyError, TypeError, ValueError, AttributeError):
        return None
    return recorded if complete else None


def move_origin(
    mesh: bpy.types.Mesh, before: NDArray[np.float64], after: NDArray[np.float64]
) -> None:
    """Have scores hold for an object whose matrix, (4, 4), changed while its splats stayed."""
    recorded = record(mesh) or {}
    origin = recorded.get("origin")
    if origin and np.allclose(origin.get("matrix", np.nan), before, rtol=0.0, atol=1e-6):
        origin = {**origin, "matrix": np.asarray(after).tolist()}
        mesh[RECORD] = json.dumps({**recorded, "origin": origin})


def stored_scores(group: Sequence[SplatObject], removed: NDArray[np.bool_] | None = None) -> Scores:
    """The scores that the meshes of objects hold, as of one.

    Parameters
    ----------
    group : sequence of SplatObject
    removed : (N,) bool, optional
        Splats of all that have to go, and need no score.

    Raises
    ------
    RefineError
        If one was not scored, or has splats that were not; or not all were scored together.
    """
    records, columns, start = [], [], 0
    removed = np.zeros(sum(map(len, group)), np.bool_) if removed is None else removed
    for checked in group:
        recorded, label = record(checked.mesh), f"object '{checked.obj.name}'"
        if recorded is None or not _has_scores(checked.mesh):
            raise RefineError(f"{label}: has no scores; score it first")
        own = [mesh_attributes.read_attribute(checked.mesh, n) for n in (SCORE, SEEN, SCORED)]
        count = len(own[0])
        unscored = int(np.count_nonzero(~own[2] & ~removed[start : start + count]))
        if count > recorded["splats"] or unscored:
            raise RefineError(
                f"{label}: scored with {recorded['splats']} splats, has {count} now, "
                f"{unscored} of them without a score; score it again"
            )
        records.append(recorded)
        columns.append(own)
        start += count
    values, seen, scored = (np.concatenate(parts) for parts in zip(*columns, strict=True))
    together = [each.get("together") or {} for each in records]
    if len(group) > 1 and len({each.get("id") or index for index, each in enumerate(together)}) > 1:
        raise RefineError(
            f"the {len(group)} selected objects were not scored together: score them as they are "
            "selected, or select only one"
        )
    # The curve is that of all splats that were scored, with the same removed.
    first = records[0]
    total = together[0].get("splats", first["splats"])
    whole = len(values) == total and np.array_equal(removed, ~scored)
    return Scores(
        values=values,
        seen=seen,
        views_used=first["views_used"],
        undrawable=sum(each.get("undrawable", 0) for each in records),
        facts=first.get("weights", {}),
        notes=tuple(first.get("notes", ())),
        method=first.get("method", ""),
        views_given=first["views_given"],
        quality=Quality.from_facts(first.get("quality")) if whole else None,
        scored=None if scored.all() else scored,
    )


def _has_scores(mesh: bpy.types.Mesh) -> bool:
    """Tell whether a mesh has the attributes that `stored_scores` reads."""
    kinds = {SCORE: "FLOAT", SEEN: "INT", SCORED: "BOOLEAN"}
    attributes = ((mesh.attributes.get(name), kind) for name, kind in kinds.items())
    return all(attribute and attribute.data_type == kind for attribute, kind in attributes)
