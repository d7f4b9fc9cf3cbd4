"""Scores on a mesh: attributes to look at and select by, and a note of how they came to be."""

from __future__ import annotations

import json
import zlib
from dataclasses import asdict
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from ..core.errors import RefineError
from ..core.estimate.quality import Quality
from ..core.scores import Scores
from ..core.selection import rank
from . import attributes as mesh_attributes
from . import edit as mesh_edit
from . import heat_map
from .notes import parsed

if TYPE_CHECKING:
    import bpy
    from numpy.typing import NDArray

    from ..core.task import Settings
    from .layout import SplatObject

SCORE, RANK, SEEN = "refine_score", "refine_rank", "refine_seen"
"""Point attributes: the score, its place from 0 (goes first) to 1, in how many views it lies."""

SCORED = "refine_scored"
"""Boolean point attribute: which splats have a score; not those that were forced out, and not those
that were joined or added since, for which Blender writes False."""

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


def store(  # noqa: PLR0913 - all that a note holds
    checked: SplatObject,
    scores: Scores,
    settings: Settings,
    origin: dict[str, Any] | None = None,
    cameras: list[tuple[str, int]] | None = None,
    *,
    protected: NDArray[np.bool_] | None = None,
    asked: Settings | None = None,
    together: Together | None = None,
) -> None:
    """Write scores to the attributes of an object's mesh, and note how they came to be.

    Parameters
    ----------
    checked : SplatObject
    scores, settings
        What `core.score` gave, and was given.
    origin : dict, optional
        See `staleness.origin`.
    cameras : list of (str, int), optional
        Name of each view given, and how many splats lie in it.
    protected : (N,) bool, optional
        Which splats the curve takes to stay.
    asked : Settings, optional
        What the scores are to be refined by, if that is still to come.
    together : Together, optional
        Where other objects were scored with them; the curve of `scores` is that of all then.

    Raises
    ------
    RefineError
        If the object cannot be written to, or no longer has as many splats.
    """
    mesh_edit.check_writable(checked.obj)
    mesh = checked.mesh
    if len(checked) != len(scores.values):
        msg = (
            f"object '{checked.obj.name}': has {len(checked)} splats, was scored with "
            f"{len(scores.values)}; score it again"
        )
        raise RefineError(msg)
    ranks = together.ranks if together else rank(scores.values)
    note = json.dumps(
        {
            "splats": len(scores.values),
            "settings": asdict(settings),
            "method": scores.method,
            "frustum": scores.frustum,
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
            "asked": asdict(asked) if asked else None,
            "together": together and {"id": together.id, "splats": together.splats},
        }
    )
    # What can fail comes first: scores and note are to belong together.
    heat_map.write(mesh, ranks)
    mesh_attributes.write_attribute(mesh, SCORE, "FLOAT", scores.values)
    mesh_attributes.write_attribute(mesh, RANK, "FLOAT", ranks)
    mesh_attributes.write_attribute(mesh, SEEN, "INT", scores.seen)
    scored = np.ones(len(checked), np.bool_) if scores.scored is None else scores.scored
    mesh_attributes.write_attribute(mesh, SCORED, "BOOLEAN", scored)
    mesh[RECORD] = note
    mesh_attributes.updated(mesh)


def digest(mask: NDArray[np.bool_] | None) -> list[int]:
    """Return how many splats a mask, (N,) bool, marks, and a checksum of which; [0, 0] if none."""
    if mask is None or not mask.any():
        return [0, 0]
    return [int(np.count_nonzero(mask)), zlib.crc32(np.packbits(mask).tobytes())]


def record(mesh: bpy.types.Mesh) -> dict[str, Any] | None:
    """Return how a mesh was scored, None if it was not."""
    try:
        noted: dict[str, Any] = parsed(mesh[RECORD])
        complete = noted.keys() >= {"splats", "settings", "views_given", "views_used"}
    except (KeyError, TypeError, ValueError, AttributeError):
        return None
    return noted if complete else None


def unrefined(record: dict[str, Any]) -> bool:
    """Tell whether the scores of a note are a sketch of those that were asked for."""
    return bool(record.get("asked"))


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
    noted = record(mesh)
    kinds = {SCORE: "FLOAT", SEEN: "INT", SCORED: "BOOLEAN"}
    for name, kind in kinds.items():
        attribute = mesh.attributes.get(name)
        if noted is None or not attribute or attribute.data_type != kind:
            msg = f"{label}: has no scores; score it first"
            raise RefineError(msg)
    values = mesh_attributes.read_attribute(mesh, SCORE)
    scored = mesh_attributes.read_attribute(mesh, SCORED)
    unscored = ~scored if removed is None else ~scored & ~removed
    if len(values) > noted["splats"] or unscored.any():
        msg = (
            f"{label}: scored with {noted['splats']} splats, has {len(values)} now, "
            f"{np.count_nonzero(unscored)} of them without a score; score it again"
        )
        raise RefineError(msg)
    # The curve is that of all splats that were scored: of one object, with the same forced out.
    forced_out = np.zeros_like(scored) if removed is None else removed
    whole = len(values) == noted["splats"] and not noted.get("together")
    whole = whole and np.array_equal(forced_out, ~scored)
    return Scores(
        values=values,
        seen=mesh_attributes.read_attribute(mesh, SEEN),
        views_used=noted["views_used"],
        undrawable=noted.get("undrawable", 0),
        facts=noted.get("weights", {}),
        notes=tuple(noted.get("notes", ())),
        method=noted.get("method", ""),
        frustum=noted.get("frustum", True),
        views_given=noted["views_given"],
        quality=Quality.from_facts(noted.get("quality")) if whole else None,
        scored=None if scored.all() else scored,
    )
