"""Several splat objects as one scene: scored against one another, and under one budget.

What panel operators do to the selection goes through here. A single object is handed on to
`splat_object` as it is.
"""

from __future__ import annotations

import uuid
from dataclasses import fields, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from . import splat_object
from .core.errors import RefineError
from .core.quality import Quality
from .core.selection import rank
from .core.splats import Splats, above_constant
from .core.task import DEFAULTS, Task
from .mesh import edit as mesh_edit
from .mesh import layout as mesh_layout
from .mesh import scores as mesh_scores

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence

    import bpy
    from numpy.typing import NDArray

    from .core.absorbing.absorb import Absorbed
    from .core.scores import Scores
    from .core.selection import Budget
    from .core.task import Result, Settings
    from .core.views import ViewSet
    from .mesh.layout import SplatObject
    from .splat_object import Plan

Members = list["SplatObject"]
"""The objects, by name; one at least."""


def chosen(layer: bpy.types.ViewLayer, active: bpy.types.Object) -> list[bpy.types.Object]:
    """Return the splat objects that are worked on, by name: the selected ones.

    Only the active one where it is alone, or not selected itself; quick enough for drawing.
    """
    selected = [obj for obj in layer.objects.selected if mesh_layout.looks_like_splats(obj)]
    if active not in selected:
        return [active]
    return sorted(selected, key=lambda obj: obj.name)


def members(layer: bpy.types.ViewLayer, active: bpy.types.Object) -> Members:
    """Return the objects of `chosen`, found to hold splats.

    Raises
    ------
    RefineError
        See `mesh.layout.check`; also if two of them share their data.
    """
    found = [mesh_layout.check(obj) for obj in chosen(layer, active)]
    owners: dict[bpy.types.Mesh, str] = {}
    for member in found:
        other = owners.setdefault(member.mesh, member.obj.name)
        if other != member.obj.name:
            msg = (
                f"objects '{other}' and '{member.obj.name}' share their data '{member.mesh.name}', "
                "which can hold the scores of one; make it single-user first (Object > Relations), "
                "or select only one"
            )
            raise RefineError(msg)
    return found


def by_names(names: Iterable[str]) -> Members:
    """Return the objects of these names; see `splat_object.find` and `mesh.layout.check`."""
    return [mesh_layout.check(splat_object.find(name)) for name in names]


def names_of(group: Members) -> tuple[str, ...]:
    """Return the names of the objects."""
    return tuple(member.obj.name for member in group)


def gather(group: Members, *, whole: bool | None = False) -> Splats:
    """Return the splats of all objects as they stand in the world; see `splat_object.gather`."""
    return _joined([splat_object.gather(member, whole=whole) for member in group])


def store(
    group: Members,
    scores: Scores,
    settings: Settings,
    origins: Sequence[dict[str, Any]],
    cameras: list[tuple[str, int]],
) -> None:
    """Write scores of all objects' splats to their meshes; see `mesh.scores.store`.

    Parameters
    ----------
    group : list of SplatObject
    scores : Scores
        Of the splats of `gather`.
    settings, cameras
        See `mesh.scores.store`.
    origins : sequence of dict
        Of each object.
    """
    if len(group) == 1:
        mesh_scores.store(group[0], scores, settings, origins[0], cameras)
        return
    _check_counts(group, len(scores.values))
    ranks = rank(scores.values)
    scoring = uuid.uuid4().hex
    for member, rows, origin in zip(group, _rows(group), origins, strict=True):
        values = scores.values[rows]
        own = replace(
            scores,
            values=values,
            seen=scores.seen[rows],
            undrawable=int(np.count_nonzero(values == 0.0)),
        )
        together = mesh_scores.Together(scoring, len(scores.values), ranks[rows])
        mesh_scores.store(member, own, settings, origin, cameras, together)


def stored_task(
    group: Members,
    budget: Budget,
    protect: str = "",
    *,
    settings: Settings = DEFAULTS,
    views: ViewSet | None = None,
) -> Task:
    """Return what Apply has to decide of all objects; see `splat_object.stored_task`.

    Raises
    ------
    RefineError
        Also if the objects were not scored together; and if what is protected is named by none.
    """
    if len(group) == 1:
        (member,) = group
        return splat_object.stored_task(member, budget, protect, settings=settings, views=views)
    _check_scored_together(group)
    names = _protecting(group, protect)
    tasks = [
        splat_object.stored_task(member, budget, name, settings=settings, views=views)
        for member, name in zip(group, names, strict=True)
    ]
    counts = [len(member) for member in group]
    masks: dict[str, Any] = {
        field.name: _joined_masks([getattr(task, field.name) for task in tasks], counts)
        for field in fields(Task)
        if any(isinstance(getattr(task, field.name), np.ndarray) for task in tasks)
    }
    return replace(
        tasks[0],
        splats=None if views is None else _joined([task.splats for task in tasks if task.splats]),
        scores=_scores(group, [task.scores for task in tasks if task.scores]),
        # Of rows of several lengths the longest counts: a size is never exceeded.
        row_bytes=max(float(task.row_bytes) for task in tasks),
        fixed_bytes=sum(task.fixed_bytes for task in tasks),
        **masks,
    )


def mark_removed(group: Members, keep: NDArray[np.bool_]) -> None:
    """Mark the splats that do not stay, (N,) of all objects."""
    for member, rows in zip(group, _rows(group), strict=True):
        mesh_edit.mark_removed(member.obj, ~keep[rows])


def apply(group: Members, result: Result) -> Plan:
    """Delete the splats that do not stay, and set what the others became: of all objects or none.

    Raises
    ------
    RefineError
        See `splat_object.apply_object`; also if an object would be left without splats.
    """
    if len(group) == 1:
        return splat_object.apply_object(group[0], result)
    _check_counts(group, len(result.keep))
    parts = list(zip(group, _split(group, result), strict=True))
    for member, own in parts:
        if not own.keep.any():
            msg = (
                f"no splat of object '{member.obj.name}' would be left; nothing was removed: "
                "delete the object, or let more stay"
            )
            raise RefineError(msg)
    plans = splat_object.apply_objects(parts)
    totals = {
        field.name: sum(getattr(plan, field.name) for plan in plans)
        for field in fields(splat_object.Plan)
    }
    return splat_object.Plan(**totals)


def _rows(group: Members) -> list[slice]:
    """Return which of all splats are those of each object."""
    ends = np.cumsum([len(member) for member in group]).tolist()
    return [slice(start, end) for start, end in zip([0, *ends[:-1]], ends, strict=True)]


def _check_counts(group: Members, count: int) -> None:
    found = sum(len(member) for member in group)
    if found != count:
        msg = (
            f"objects {', '.join(names_of(group))}: have {found} splats together and had {count} "
            "when the work began; do it again"
        )
        raise RefineError(msg)


def _check_scored_together(group: Members) -> None:
    """Refuse objects of several scorings: their scores mean something else each."""
    marks = {
        ((mesh_scores.record(member.mesh) or {}).get("together") or {}).get("id")
        for member in group
    }
    if len(marks) > 1 or None in marks:
        msg = (
            f"the {len(group)} selected objects were not scored together: score them as they are "
            "selected, or select only one"
        )
        raise RefineError(msg)


def _scores(group: Members, parts: list[Scores]) -> Scores:
    """Return the scores of all objects as one; their curve, if all that were scored are there."""
    noted = mesh_scores.record(group[0].mesh) or {}
    whole = noted["together"]["splats"] == sum(len(part.values) for part in parts)
    return replace(
        parts[0],
        values=np.concatenate([part.values for part in parts]),
        seen=np.concatenate([part.seen for part in parts]),
        undrawable=sum(part.undrawable for part in parts),
        quality=Quality.from_facts(noted.get("quality")) if whole else None,
    )


def _protecting(group: Members, protect: str) -> list[str]:
    """Return what protects in each object: the name, or nothing where it has none of that name.

    Raises
    ------
    RefineError
        If none has one.
    """
    names, errors = [], []
    for member in group:
        try:
            mesh_edit.protected_mask(member.obj, protect)
            names.append(protect)
        except RefineError as error:
            names.append("")
            errors.append(error)
    if len(errors) == len(group):
        raise errors[0]
    return names


def _joined_masks(parts: list[Any], counts: list[int]) -> NDArray[np.bool_]:
    """Return masks of several objects as one; none means that nothing is marked."""
    return np.concatenate([
        np.zeros(count, np.bool_) if part is None else part
        for part, count in zip(parts, counts, strict=True)
    ])  # fmt: skip


def _joined(parts: list[Splats]) -> Splats:
    """Return the splats of several objects as one; harmonics that one lacks are 0."""
    if len(parts) == 1:
        return parts[0]
    most = max(part.sh_rest.shape[1] for part in parts)
    padded = [
        np.pad(part.sh_rest, ((0, 0), (0, most - part.sh_rest.shape[1]), (0, 0))) for part in parts
    ]
    joined = {
        field.name: np.concatenate([getattr(part, field.name) for part in parts])
        for field in fields(Splats)
        if field.name != "sh_rest"
    }
    return Splats(**joined, sh_rest=np.concatenate(padded))


def _split(group: Members, result: Result) -> list[Result]:
    """Return what was decided of each object."""
    parts = []
    for member, rows in zip(group, _rows(group), strict=True):
        own = None
        if result.absorbed is not None:
            own = _part(result.absorbed, rows, mesh_layout.sh_degree(member.mesh))
        parts.append(replace(result, keep=result.keep[rows], absorbed=own))
    return parts


def _part(absorbed: Absorbed, rows: slice, degree: int) -> Absorbed:
    """Return the survivors of one object, with as many harmonics as it has."""
    first = int(np.count_nonzero(absorbed.keep[: rows.start]))
    keep = absorbed.keep[rows]
    here = slice(first, first + int(np.count_nonzero(keep)))
    splats = absorbed.splats.take(here)
    splats = replace(splats, sh_rest=splats.sh_rest[:, : above_constant(degree)])
    return replace(absorbed, keep=keep, splats=splats, changed=absorbed.changed[here])
