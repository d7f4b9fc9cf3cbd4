"""What the budget of the panel would do, worked out when something changes, not when drawn."""

from __future__ import annotations

import json
from typing import TYPE_CHECKING, Any

from .. import splat_object
from ..core.errors import RefineError
from ..mesh import layout as mesh_layout
from ..mesh import scores as mesh_scores

if TYPE_CHECKING:
    import bpy

PLAN = "refine_plan"
"""Custom property of the mesh: the last plan, or why there is none, as JSON."""


def key(settings: Any) -> str:  # noqa: ANN401 - RefineSettings, which imports this module
    """Return what a plan depends on, to tell whether a stored one still holds."""
    return f"{settings.budget} {getattr(settings, settings.budget)!r} {settings.protect!r}"


def refresh(context: bpy.types.Context) -> None:
    """Work out the plan for the active object if it has scores, and store it on its mesh."""
    obj = getattr(context, "object", None)  # not in every editor
    if not mesh_layout.looks_like_splats(obj) or mesh_scores.record(obj.data) is None:
        return
    if obj.mode == "EDIT" or obj.data.library or obj.library:
        return
    settings = context.scene.refine
    noted: dict[str, Any] = {"key": key(settings), "splats": mesh_layout.splat_count(obj.data)}
    try:
        checked = mesh_layout.check(obj)
        plan = splat_object.plan(checked, settings.to_budget(), settings.protect)
        noted.update(vars(plan))
    except RefineError as error:
        noted["error"] = str(error)
    obj.data[PLAN] = json.dumps(noted)


def stored(obj: bpy.types.Object, settings: Any) -> dict[str, Any] | None:  # noqa: ANN401
    """Return the stored plan if it is that of the current budget and mesh, else None."""
    try:
        noted = json.loads(obj.data[PLAN])
        count = mesh_layout.splat_count(obj.data)
        holds = noted["key"] == key(settings) and noted["splats"] == count
    except (KeyError, TypeError, ValueError):
        return None
    return noted if holds else None


def forget(mesh: bpy.types.Mesh) -> None:
    """Remove the stored plan."""
    if PLAN in mesh:
        del mesh[PLAN]
