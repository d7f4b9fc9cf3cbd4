"""What the panel and the command do to an object: score, apply, export.

An operation begins with `mesh.layout.check`, which makes sure that an object holds splats; its
`SplatObject` is what the functions here take. Each either does all it says, or raises `RefineError`
and leaves the scene as it was.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from typing import Any, NamedTuple

import bpy
import numpy as np
from numpy.typing import NDArray

from ..cameras.objects import world_matrix
from ..core.affine import is_uniform, transformed
from ..core.errors import RefineError
from ..core.formats.ply import SplatFile
from ..core.formats.ply_columns import values_by_name
from ..core.merging.merge import Merged
from ..core.methods import Merge, Method, Occlusion
from ..core.result import Result
from ..core.selection import Budget
from ..core.splats import Splats
from ..core.views import ViewSet
from ..core.volumes import Forced
from ..mesh import attributes as mesh_attributes
from ..mesh import drift as mesh_drift
from ..mesh import edit as mesh_edit
from ..mesh import floaters as mesh_floaters
from ..mesh import layout as mesh_layout
from ..mesh.layout import SplatObject
from ..mesh.scores import RECORD, stored_scores
from .transforms import read_to_move, uneven_notes


@dataclass(frozen=True)
class Outcome:
    """What a budget does to an object, or would.

    Attributes
    ----------
    kept, removed : int
        Splats that stay and go.
    bytes_before, bytes_after : int
        Size of the exported file.
    """

    kept: int
    removed: int
    bytes_before: int
    bytes_after: int

    @classmethod
    def of(cls, count: int, kept: int, row_bytes: int, fixed_bytes: int) -> Outcome:
        """Return what keeping so many of `count` splats does to a file.

        Parameters
        ----------
        count, kept : int
        row_bytes, fixed_bytes : int
            What a splat takes in a file of all splats, and all else in it.
        """
        # The header says how many splats follow, in as many digits as that takes.
        shorter = len(str(count)) - len(str(kept))
        sizes = (fixed_bytes + row_bytes * count, fixed_bytes - shorter + row_bytes * kept)
        return cls(kept, count - kept, *sizes)


def gather(checked: SplatObject, *, whole: bool | None = False) -> Splats:
    """Return an object's splats as they stand in the world, for scoring.

    Modifiers are not looked at: what is scored is what is exported.

    Parameters
    ----------
    checked : SplatObject
    whole : bool or None
        Whether to read view-dependent colour, for merging; the object's scale must be uniform
        then. None reads it if the scale is uniform, for an estimate of the pictures' quality.

    Raises
    ------
    RefineError
        If the object's matrix cannot be applied; names the object.
    """
    matrix = world_matrix(checked.obj, bpy.context.evaluated_depsgraph_get())
    whole = is_uniform(matrix) if whole is None else whole
    splats = mesh_attributes.splats_from_object(checked, sh_rest=whole)
    if np.array_equal(matrix, np.eye(4)):
        return splats
    try:
        return transformed(splats, matrix, rotate_sh=whole)
    except RefineError as error:
        raise RefineError(f"object '{checked.obj.name}': {error}") from None


def possible(group: Sequence[SplatObject], method: Method) -> Method:
    """The method for some objects: where the scale of one is uneven, merging only deletes."""
    graph = bpy.context.evaluated_depsgraph_get()
    even = all(is_uniform(world_matrix(member.obj, graph)) for member in group)
    return method if even or not isinstance(method, Merge) else Occlusion(method.views)


def modifier_notes(obj: bpy.types.Object) -> list[str]:
    """Return a sentence if modifiers show the object otherwise than it is scored and exported."""
    drawing = ("REFINE", "KIRI")  # these draw splats and move none
    names = [m.name for m in obj.modifiers if m.show_viewport and not m.name.startswith(drawing)]
    if not names:
        return []
    note = (
        f"object '{obj.name}': scored as without its modifiers ({', '.join(names)}); apply them "
        "first if they move splats"
    )
    return [note]


def drift_notes(checked: SplatObject) -> list[str]:
    """Return what others did to an object's splats, in sentences; see `mesh.drift`."""
    drift = mesh_drift.found(checked.mesh)
    if drift is None:
        return []
    remedy = "; Mend Splats in the panel puts that right" if drift.mendable else ""
    return [f"object '{checked.obj.name}': {told}{remedy}" for told in drift.told]


def stored_arguments(
    checked: SplatObject, budget: Budget, forced: Forced, method: Method, views: ViewSet | None
) -> dict[str, Any]:
    """The arguments of `prune` for Apply, which goes by the scores that the object holds.

    Parameters
    ----------
    checked : SplatObject
    budget : Budget
    forced : Forced
        What must stay and what must go; see `Demands.forced`.
    method : Method
    views : ViewSet or None
        What merging and refitting go by; None where splats are deleted.

    Raises
    ------
    RefineError
        If the object was not scored, or some of it needs scores now that had to go then; also see
        `gather`.
    """
    return {
        "splats": None if views is None else gather(checked, whole=True),
        "views": views,
        "budget": budget,
        "method": method,
        "scores": stored_scores(checked, forced.removed),
        "protected": forced.protected,
        "removed": forced.removed,
        "sizes": mesh_attributes.file_size(checked),
    }


class Frame(NamedTuple):
    """What is to be known of an object to prepare a change of its splats on any thread.

    Attributes
    ----------
    degree : int
        Of its harmonics.
    matrix : (4, 4) float64
        From the world to the object.
    """

    degree: int
    matrix: NDArray[np.float64]


class Change(NamedTuple):
    """What is to become of the splats of an object.

    Attributes
    ----------
    keep : (N,) bool
        Which stay; K of them.
    rows : (M,) int64
        Which of the K change, ascending.
    columns : dict of str to (M,)
        What their properties become, in the object's frame.
    """

    keep: NDArray[np.bool_]
    rows: NDArray[np.int64]
    columns: dict[str, NDArray[Any]]


def frame_of(checked: SplatObject) -> Frame:
    """Read what `changed` needs of an object."""
    matrix = world_matrix(checked.obj, bpy.context.evaluated_depsgraph_get())
    return Frame(mesh_layout.sh_degree(checked.mesh), np.linalg.inv(matrix))


def changed(frame: Frame, keep: NDArray[np.bool_], merged: Merged | None) -> Change:
    """Return what is to become of an object's splats; touches nothing of Blender's.

    Parameters
    ----------
    frame : Frame
    keep : (N,) bool
    merged : Merged or None
        What the kept splats became, in the world.
    """
    if merged is None:
        return Change(keep, np.empty(0, np.int64), {})
    rows = np.flatnonzero(merged.changed)
    splats = merged.splats.take(rows).up_to_degree(frame.degree)
    if not np.array_equal(frame.matrix, np.eye(4)):
        splats = transformed(splats, frame.matrix)
    columns = {name: np.ascontiguousarray(v) for name, v in values_by_name(splats).items()}
    return Change(keep, rows, columns)


def apply_object(checked: SplatObject, result: Result) -> Outcome:
    """Do what `apply` does, with what was decided of an object's splats."""
    change = changed(frame_of(checked), result.keep, result.merged)
    (outcome,) = apply([(checked, change)])
    return outcome


def apply(parts: Sequence[tuple[SplatObject, Change]]) -> list[Outcome]:
    """Delete the splats that do not stay, and store what the others became: all of it or nothing.

    Everything else of the objects and their meshes stays: attributes, vertex groups, custom
    properties, materials, modifiers. The scores stay to be looked at, but the next apply asks for
    new ones.

    Parameters
    ----------
    parts : sequence of (SplatObject, Change)

    Raises
    ------
    RefineError
        See `mesh_edit.check_deletable`; also if there are no longer as many splats.
    """
    outcomes = []
    for checked, change in parts:
        mesh_edit.check_deletable(checked.obj)
        if len(change.keep) != len(checked):
            raise RefineError(
                f"object '{checked.obj.name}': has {len(checked)} splats and had "
                f"{len(change.keep)} when it was decided which stay; apply again"
            )
        outcomes.append(_outcome(checked, change.keep))
    with ExitStack() as stack:
        for checked, _ in parts:
            stack.enter_context(mesh_edit.all_or_nothing(checked.obj))
        for checked, change in parts:
            reduce_object(checked, change)
    return outcomes


def delete_splats(checked: SplatObject, keep: NDArray[np.bool_]) -> Outcome:
    """Delete the splats that do not stay, all of them or none; nothing else changes.

    Scores hold for all splats together, so they are to be computed again.

    Parameters
    ----------
    checked : SplatObject
    keep : (N,) bool

    Raises
    ------
    RefineError
        See `mesh_edit.check_deletable`; also if nothing would be left.
    """
    mesh_edit.check_deletable(checked.obj)
    if not keep.any():
        raise RefineError(
            f"object '{checked.obj.name}': no splat would be left; nothing was deleted"
        )
    outcome = _outcome(checked, keep)
    with mesh_edit.all_or_nothing(checked.obj):
        reduce_object(checked, changed(frame_of(checked), keep, None))
    return outcome


def reduce_object(checked: SplatObject, change: Change) -> None:
    """Delete what does not stay, store what the others became, and drop the scores' record."""
    mesh_edit.delete_vertices(checked.obj, ~change.keep)
    mesh_attributes.write_rows(checked, change.rows, change.columns)
    if change.columns:
        mesh_drift.renew(checked.mesh)
    mesh_floaters.forget(checked.mesh)
    if RECORD in checked.mesh:
        del checked.mesh[RECORD]


def read_for_export(
    checked: SplatObject, *, apply_transform: bool = False
) -> Callable[[], SplatFile]:
    """Read an object; return what makes its PLY file of that, in memory, on any thread.

    The file is in the layout that the object was imported with.

    Parameters
    ----------
    checked : SplatObject
    apply_transform : bool
        Whether the splats are to be as they stand in the world, harmonics turned with them.

    Raises
    ------
    RefineError
        If the transform is to be applied and cannot be, being flat.
    """
    if apply_transform:
        matrix = world_matrix(checked.obj, bpy.context.evaluated_depsgraph_get())
        names, move = read_to_move(checked, matrix)
        return mesh_attributes.read_for_file(checked, names, lambda: move()[0])
    return mesh_attributes.read_for_file(checked)


def export_notes(checked: SplatObject, *, apply_transform: bool = False) -> list[str]:
    """Return what is to be said of an exported object; see `drift_notes`, `uneven_notes`."""
    notes = drift_notes(checked)
    if apply_transform:
        matrix = world_matrix(checked.obj, bpy.context.evaluated_depsgraph_get())
        notes += uneven_notes(checked, matrix)
    return notes


def _outcome(checked: SplatObject, keep: NDArray[np.bool_]) -> Outcome:
    kept = int(np.count_nonzero(keep))
    return Outcome.of(len(keep), kept, *mesh_attributes.file_size(checked))


def find(name: str) -> bpy.types.Object:
    """Return the object of that name, or raise `RefineError` with those that hold splats."""
    obj = bpy.context.scene.objects.get(name)
    if obj is None:
        names = [o.name for o in bpy.context.scene.objects if mesh_layout.looks_like_splats(o)]
        listed = ", ".join(names[:8]) or "none"
        raise RefineError(
            f"no object '{name}' in scene '{bpy.context.scene.name}' (splat objects: {listed})"
        )
    return obj
