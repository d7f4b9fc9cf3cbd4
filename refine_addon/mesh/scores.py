"""Scores on a mesh: attributes to look at and select by, and a record of how they came to be."""

from __future__ import annotations

import json
import zlib
from dataclasses import dataclass
from typing import Any, NamedTuple

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
from . import heat_map
from .layout import SplatObject
from .records import parsed

SCORE, RANK, SEEN = "refine_score", "refine_rank", "refine_seen"
"""Point attributes: the score, its place from 0 (goes first) to 1, in how many views it lies."""

SCORED = "refine_scored"
"""Boolean point attribute: which splats have a score. Neither those that had to go have one,
nor those that were joined or added since, for which Blender writes False."""

RECORD = "refine_scores"
"""Custom property of the mesh: how its scores came to be, as JSON."""


class Together(NamedTuple):
    """What an object's scores have in common with those of others that were scored with it.

    Attributes
    ----------
    id : str
        Of the scoring.
    splats : int
        How many all objects have.
    ranks : (N,) float64
        Of this object's splats among all.
    """

    id: str
    splats: int
    ranks: NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Provenance:
    """How scores came to be.

    Attributes
    ----------
    method : Method
        What they were made with.
    origin : dict, optional
        See `staleness.origin`.
    cameras : list of (str, int), optional
        Name of each view given, and how many splats lie in it.
    protected : (N,) bool, optional
        Which splats the curve takes to stay.
    together : Together, optional
        Where other objects were scored with them; the curve is that of all then.
    seconds : float, optional
        How long scoring took.
    """

    method: Method
    origin: dict[str, Any] | None = None
    cameras: list[tuple[str, int]] | None = None
    protected: NDArray[np.bool_] | None = None
    together: Together | None = None
    seconds: float | None = None


def store(checked: SplatObject, scores: Scores, provenance: Provenance) -> None:
    """Write scores to the attributes of an object's mesh, and record how they came to be.

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
    together = provenance.together
    ranks = together.ranks if together else rank(scores.values)
    new_record = json.dumps(
        {
            "splats": len(scores.values),
            "settings": provenance.method.facts(),
            "method": scores.method,
            "views_given": scores.views_given,
            "views_used": scores.views_used,
            "undrawable": scores.undrawable,
            "weights": scores.facts,
            "notes": scores.notes,
            "quality": scores.quality.facts() if scores.quality else None,
            "alignment": scores.alignment.facts() if scores.alignment else None,
            "origin": provenance.origin,
            "cameras": provenance.cameras,
            "protected": digest(provenance.protected),
            "seconds": provenance.seconds,
            "together": together and {"id": together.id, "splats": together.splats},
        }
    )
    # The heat map may fail for want of memory, and comes first: scores and record belong together.
    heat_map.write(mesh, ranks)
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
    for name in (SCORE, RANK, SEEN, SCORED, heat_map.HEAT, mesh_edit.REMOVE):
        if name in mesh.attributes:
            mesh.attributes.remove(mesh.attributes[name])
    if RECORD in mesh:
        del mesh[RECORD]
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


def stored_scores(checked: SplatObject, removed: NDArray[np.bool_] | None = None) -> Scores:
    """Return the scores that an object's mesh holds.

    Parameters
    ----------
    checked : SplatObject
    removed : (N,) bool, optional
        Splats that have to go, and need no score.

    Raises
    ------
    RefineError
        If it was not scored, or has splats that were not.
    """
    mesh, label = checked.mesh, f"object '{checked.obj.name}'"
    recorded = record(mesh)
    if recorded is None or not _has_scores(mesh):
        raise RefineError(f"{label}: has no scores; score it first")
    values = mesh_attributes.read_attribute(mesh, SCORE)
    scored = mesh_attributes.read_attribute(mesh, SCORED)
    removed = np.zeros_like(scored) if removed is None else removed
    unscored = int(np.count_nonzero(~scored & ~removed))
    if len(values) > recorded["splats"] or unscored:
        raise RefineError(
            f"{label}: scored with {recorded['splats']} splats, has {len(values)} now, "
            f"{unscored} of them without a score; score it again"
        )
    # The curve is that of all splats that were scored: of one object, with the same removed.
    whole = len(values) == recorded["splats"] and not recorded.get("together")
    whole = whole and np.array_equal(removed, ~scored)
    return Scores(
        values=values,
        seen=mesh_attributes.read_attribute(mesh, SEEN),
        views_used=recorded["views_used"],
        undrawable=recorded.get("undrawable", 0),
        facts=recorded.get("weights", {}),
        notes=tuple(recorded.get("notes", ())),
        method=recorded.get("method", ""),
        views_given=recorded["views_given"],
        quality=Quality.from_facts(recorded.get("quality")) if whole else None,
        scored=None if scored.all() else scored,
    )


def _has_scores(mesh: bpy.types.Mesh) -> bool:
    """Tell whether a mesh has the attributes that `stored_scores` reads."""
    kinds = {SCORE: "FLOAT", SEEN: "INT", SCORED: "BOOLEAN"}
    attributes = ((mesh.attributes.get(name), kind) for name, kind in kinds.items())
    return all(attribute and attribute.data_type == kind for attribute, kind in attributes)
