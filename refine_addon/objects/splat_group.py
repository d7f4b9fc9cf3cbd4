"""Several splat objects as one scene: scored against one another, and under one budget.

Operators of the panel work on the selection through here. A single object is handed on to
`splat_object`.
"""

from __future__ import annotations

import uuid
from collections.abc import Sequence
from dataclasses import fields, replace
from typing import Any

import bpy
import numpy as np
from numpy.typing import NDArray

from ..core.errors import RefineError
from ..core.merging.merge import Merged
from ..core.methods import Method
from ..core.quality.curve import Quality
from ..core.result import Result
from ..core.scores import Scores
from ..core.selection import Budget, rank
from ..core.splats import Splats, joined
from ..core.views import ViewSet
from ..core.volumes import Forced
from ..mesh import edit as mesh_edit
from ..mesh import layout as mesh_layout
from ..mesh import scores as mesh_scores
from ..mesh.layout import SplatObject
from ..mesh.scores import Provenance
from . import demands, splat_object
from .demands import Demands
from .splat_object import Change, Frame, Outcome

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


def members(layer: bpy.types.ViewLayer, active: SplatObject) -> Members:
    """Return the objects of `chosen`, all of which hold splats.

    Raises
    ------
    RefineError
        See `mesh.layout.check`; also if two of them share their data.
    """
    group = [_checked(obj, active) for obj in chosen(layer, active.obj)]
    owners: dict[bpy.types.Mesh, str] = {}
    for member in group:
        other = owners.setdefault(member.mesh, member.obj.name)
        if other != member.obj.name:
            raise RefineError(
                f"objects '{other}' and '{member.obj.name}' share their data '{member.mesh.name}', "
                "which can hold the scores of one; make it single-user first (Object > Relations), "
                "or select only one"
            )
    return group


def active_first(layer: bpy.types.ViewLayer, active: SplatObject | None) -> Members:
    """Return the objects of `members`, the active one first; none without it."""
    if active is None:
        return []
    return sorted(members(layer, active), key=lambda member: member.obj != active.obj)


def uids_of(group: Members) -> tuple[int, ...]:
    """Return the numbers by which Blender knows the objects in this session; names may change."""
    return tuple(member.obj.session_uid for member in group)


def by_uids(uids: tuple[int, ...], known: SplatObject) -> Members:
    """Return the objects again, in that order; see `mesh.layout.check`. One is known already."""
    objects = {obj.session_uid: obj for obj in bpy.data.objects}
    return [_checked(objects.get(uid), known) for uid in uids]


def _checked(obj: bpy.types.Object | None, known: SplatObject) -> SplatObject:
    return known if obj == known.obj else mesh_layout.check(obj)


def forced_of_each(scene: bpy.types.Scene, group: Members) -> list[Forced]:
    """Return what must stay and what must go of each object, as a scene says it.

    A name protects in the objects that have it.

    Raises
    ------
    RefineError
        See `Demands`; also if no object has a name that protects.
    """
    demanded = Demands.of_scene(scene)
    if len(group) == 1:
        return [demanded.forced(group[0])]
    protecting = [(name, _protecting(group, name)) for name in demanded.names]
    return [
        replace(demanded, names=tuple(n for n, has in protecting if has[index])).forced(member)
        for index, member in enumerate(group)
    ]


def check_forced(scene: bpy.types.Scene, group: Members, before: Sequence[Forced]) -> None:
    """Check that of each object the same must stay and go as before.

    Raises
    ------
    RefineError
        If not; also see `forced_of_each`.
    """
    for member, was, now in zip(group, before, forced_of_each(scene, group), strict=True):
        pairs = ((was.protected, now.protected), (was.removed, now.removed))
        if any(not _same_mask(*pair) for pair in pairs):
            raise RefineError(
                f"object '{member.obj.name}': what must stay or go has changed meanwhile; nothing "
                "was removed: apply again"
            )


def _same_mask(one: NDArray[np.bool_] | None, other: NDArray[np.bool_] | None) -> bool:
    """Tell whether both mark the same; none means that nothing is marked."""
    if one is None or other is None:
        return not any(mask is not None and mask.any() for mask in (one, other))
    return np.array_equal(one, other)


def refresh(scene: bpy.types.Scene, group: Members) -> list[Forced]:
    """Mark what a scene demands of each object, and return it; see `demands.refresh`."""
    if len(group) == 1:
        return [demands.refresh(scene, group[0])]
    each = forced_of_each(scene, group)
    for member, forced_of_member in zip(group, each, strict=True):
        demands.mark(member, forced_of_member)
    return each


def joined_forced(each: Sequence[Forced], group: Members) -> Forced:
    """Return which splats of all objects must stay and must go, without facts."""
    counts = [len(member) for member in group]
    protected, out = (
        None if all(mask is None for mask in masks) else _joined_masks(masks, counts)
        for masks in ([one.protected for one in each], [one.removed for one in each])
    )
    return Forced(protected, out)


def parts_of(mask: NDArray[np.bool_] | None, group: Members) -> list[NDArray[np.bool_]]:
    """Return what a mask of all objects' splats, (N,), says of each object's; None marks none."""
    whole = np.zeros(sum(map(len, group)), np.bool_) if mask is None else mask
    return [whole[rows] for rows in _rows(group)]


def gather(group: Members, *, whole: bool | None = False) -> Splats:
    """Return the splats of all objects as they stand in the world; see `splat_object.gather`."""
    return joined([splat_object.gather(member, whole=whole) for member in group])


def store(
    group: Members, scores: Scores, provenance: Provenance, origins: Sequence[dict[str, Any]]
) -> None:
    """Write scores of all objects' splats to their meshes; see `mesh.scores.store`.

    Parameters
    ----------
    group : list of SplatObject
    scores : Scores
        Of the splats of `gather`.
    provenance : Provenance
        Of them all.
    origins : sequence of dict
        Of each object.
    """
    _check_counts(group, len(scores.values))
    ranks, scoring = rank(scores.values), uuid.uuid4().hex
    protected = parts_of(provenance.protected, group)
    for member, origin, rows, mask in zip(group, origins, _rows(group), protected, strict=True):
        scores_of_member, together = scores, None
        if len(group) > 1:
            scores_of_member = _scores_of_rows(scores, rows)
            together = mesh_scores.Together(scoring, len(scores.values), ranks[rows])
        mesh_scores.store(
            member,
            scores_of_member,
            replace(provenance, origin=origin, protected=mask, together=together),
        )


def _scores_of_rows(scores: Scores, rows: slice) -> Scores:
    """Return the scores of one object of those that were scored together."""
    values = scores.values[rows]
    scored = np.ones(len(values), np.bool_) if scores.scored is None else scores.scored[rows]
    undrawable = int(np.count_nonzero((values == 0.0) & scored))
    return replace(
        scores, values=values, seen=scores.seen[rows], undrawable=undrawable, scored=scored
    )


def stored_arguments(
    group: Members,
    budget: Budget,
    forced: Sequence[Forced],
    method: Method,
    views: ViewSet | None = None,
) -> dict[str, Any]:
    """The arguments of `prune` for Apply to all objects; see `splat_object.stored_arguments`.

    Parameters
    ----------
    group, budget, method, views
        See there.
    forced : sequence of Forced
        What must stay and what must go of each object.

    Raises
    ------
    RefineError
        Also if the objects were not scored together.
    """
    if len(group) > 1:
        _check_scored_together(group)
    parts = [
        splat_object.stored_arguments(member, budget, each, method, views)
        for member, each in zip(group, forced, strict=True)
    ]
    if len(parts) == 1:
        return parts[0]
    counts = [len(member) for member in group]
    masks: dict[str, Any] = {
        name: _joined_masks([part[name] for part in parts], counts)
        for name in ("protected", "removed")
        if any(part[name] is not None for part in parts)
    }
    return {
        **parts[0],
        "splats": None if views is None else joined([part["splats"] for part in parts]),
        "scores": _scores(group, [part["scores"] for part in parts], masks),
        # Of rows of several lengths the longest counts: a size is never exceeded.
        "sizes": (
            max(part["sizes"][0] for part in parts),
            sum(part["sizes"][1] for part in parts),
        ),
        **masks,
    }


def mark_removed(group: Members, keep: NDArray[np.bool_]) -> None:
    """Mark the splats that do not stay, (N,) of all objects."""
    for member, rows in zip(group, _rows(group), strict=True):
        mesh_edit.mark_removed(member.obj, ~keep[rows])


def frames_of(group: Members) -> list[Frame]:
    """Read what `changes` needs of each object; see `splat_object.frame_of`."""
    return [splat_object.frame_of(member) for member in group]


def changes(frames: Sequence[Frame], counts: Sequence[int], result: Result) -> list[Change]:
    """Return what is to become of each object's splats; touches nothing of Blender's.

    Parameters
    ----------
    frames : sequence of Frame
        Of each object.
    counts : sequence of int
        How many splats each has.
    result : Result
        What was decided of all of them.
    """
    if len(frames) == 1:
        return [splat_object.changed(frames[0], result.keep, result.merged)]
    return [
        splat_object.changed(frame, result.keep[rows], result.merged and _part(result.merged, rows))
        for frame, rows in zip(frames, _runs(counts), strict=True)
    ]


def apply(group: Members, parts: Sequence[Change]) -> Outcome:
    """Delete the splats that do not stay, and store what the others became: in all objects or none.

    Parameters
    ----------
    group : list of SplatObject
    parts : sequence of Change
        See `changes`.

    Raises
    ------
    RefineError
        See `splat_object.apply`; also if an object would be left without splats.
    """
    if len(group) > 1:
        _check_counts(group, sum(len(part.keep) for part in parts))
    for member, part in zip(group, parts, strict=True):
        if len(group) > 1 and not part.keep.any():
            raise RefineError(
                f"no splat of object '{member.obj.name}' would be left; nothing was removed: "
                "delete the object, or let more stay"
            )
    outcomes = splat_object.apply(list(zip(group, parts, strict=True)))
    totals = {
        field.name: sum(getattr(outcome, field.name) for outcome in outcomes)
        for field in fields(Outcome)
    }
    return Outcome(**totals)


def _rows(group: Members) -> list[slice]:
    """Return which of all splats are those of each object."""
    return _runs([len(member) for member in group])


def _runs(counts: Sequence[int]) -> list[slice]:
    """Return which of all splats are those of each object, of which each has so many."""
    ends = np.cumsum(counts).tolist()
    return [slice(start, end) for start, end in zip([0, *ends[:-1]], ends, strict=True)]


def _check_counts(group: Members, count: int) -> None:
    total = sum(len(member) for member in group)
    if total != count:
        names = ", ".join(repr(member.obj.name) for member in group)
        raise RefineError(
            f"objects {names}: have {total} splats together and had {count} when the work began; "
            "do it again"
        )


def _check_scored_together(group: Members) -> None:
    """Refuse objects of several scorings: scores compare only within one."""
    ids = {
        ((mesh_scores.record(member.mesh) or {}).get("together") or {}).get("id")
        for member in group
    }
    if len(ids) > 1 or None in ids:
        raise RefineError(
            f"the {len(group)} selected objects were not scored together: score them as they are "
            "selected, or select only one"
        )


def _scores(group: Members, parts: list[Scores], masks: dict[str, Any]) -> Scores:
    """Return the scores of all objects as one; their curve, if all that were scored are there."""
    record, removed = mesh_scores.record(group[0].mesh) or {}, masks.get("removed")
    values = np.concatenate([part.values for part in parts])
    scored = ~_joined_masks(
        [None if part.scored is None else ~part.scored for part in parts],
        [len(part.values) for part in parts],
    )
    removed = np.zeros_like(scored) if removed is None else removed
    whole = record["together"]["splats"] == len(values) and np.array_equal(removed, ~scored)
    return replace(
        parts[0],
        values=values,
        seen=np.concatenate([part.seen for part in parts]),
        undrawable=sum(part.undrawable for part in parts),
        quality=Quality.from_facts(record.get("quality")) if whole else None,
        scored=scored,
    )


def _protecting(group: Members, name: str) -> list[bool]:
    """Return which objects have a vertex group or an attribute of that name that protects.

    Raise `RefineError` if none has.
    """
    protecting, errors = [], []
    for member in group:
        try:
            mesh_edit.protected_mask(member.obj, name)
            protecting.append(True)
        except RefineError as error:
            protecting.append(False)
            errors.append(error)
    if not any(protecting):
        raise errors[0]
    return protecting


def _joined_masks(parts: list[Any], counts: list[int]) -> NDArray[np.bool_]:
    """Return masks of several objects as one; none means that nothing is marked."""
    return np.concatenate([
        np.zeros(count, np.bool_) if part is None else part
        for part, count in zip(parts, counts, strict=True)
    ])  # fmt: skip


def _part(merged: Merged, rows: slice) -> Merged:
    """The kept splats of one object."""
    first = int(np.count_nonzero(merged.keep[: rows.start]))
    keep = merged.keep[rows]
    kept = slice(first, first + int(np.count_nonzero(keep)))
    splats = merged.splats.take(kept)
    return replace(merged, keep=keep, splats=splats, changed=merged.changed[kept])
