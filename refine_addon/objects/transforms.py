"""Transforms that splats follow as a whole: baked, joined, and put right where others moved them.

Each does all it says, or raises `RefineError` and leaves the scene as it was.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from typing import Any, NamedTuple

import bpy
import numpy as np
from numpy.typing import NDArray

from ..cameras.objects import snapped, world_matrix
from ..core.affine import Move, is_flat
from ..core.errors import RefineError
from ..core.execute import Progress, report
from ..core.formats.ply import REST_COUNTS
from ..core.splats import above_constant, refuse_mixed
from ..mesh import attributes as mesh_attributes
from ..mesh import drift as mesh_drift
from ..mesh import edit as mesh_edit
from ..mesh import floaters as mesh_floaters
from ..mesh import heat_map
from ..mesh import layout as mesh_layout
from ..mesh import scores as mesh_scores
from ..mesh.layout import SplatObject
from . import demands
from .splat_object import moved_columns, read_to_move, uneven_notes

_UNMOVED = {
    "location": (0.0, 0.0, 0.0),
    "rotation_euler": (0.0, 0.0, 0.0),
    "rotation_quaternion": (1.0, 0.0, 0.0, 0.0),
    "rotation_axis_angle": (0.0, 0.0, 1.0, 0.0),
    "scale": (1.0, 1.0, 1.0),
    "delta_location": (0.0, 0.0, 0.0),
    "delta_rotation_euler": (0.0, 0.0, 0.0),
    "delta_rotation_quaternion": (1.0, 0.0, 0.0, 0.0),
    "delta_scale": (1.0, 1.0, 1.0),
}
"""Properties of an object that make its transform, without one."""

_OF_ALL = (
    mesh_scores.SCORE,
    mesh_scores.RANK,
    mesh_scores.SEEN,
    mesh_scores.SCORED,
    heat_map.HEAT,
    mesh_edit.REMOVE,
    mesh_edit.FORCE,
)
"""Attributes that say something of a splat among all others of its scene."""


class Mended(NamedTuple):
    """What an object's splats become: what it takes, and columns, where nothing else changes."""

    mending: mesh_drift.Mending | None
    columns: dict[str, NDArray[Any]]


def read_to_mend(checked: SplatObject) -> Callable[[], Mended]:
    """Read an object; return what finds out how its splats are put right, on any thread.

    Raises
    ------
    RefineError
        See `mesh.edit.check_changeable`; the callable raises it if a map is flat.
    """
    mesh_edit.check_changeable(checked.obj)
    find, move = mesh_drift.mending(checked.mesh), read_to_move(checked)

    def work() -> Mended:
        mending = find()
        whole = mending is not None and mending.moves and not mending.regrouped
        return Mended(mending, move(mending.moves) if mending and whole else {})

    return work


def mend(group: Sequence[SplatObject], found: Sequence[Mended] | None = None) -> int:
    """Have splats follow what others did to their positions: see `mesh.drift`.

    Positions stay. Scales, rotations, harmonics and normals are moved by the maps that the
    positions tell, and properties of joined splats become part of a file.

    Parameters
    ----------
    group : sequence of SplatObject
    found : sequence of Mended, optional
        What the callables of `read_to_mend` have returned; None to do that now.

    Returns
    -------
    int
        How many splats were put right.

    Raises
    ------
    RefineError
        See `mesh.edit.check_changeable`; also if a map is flat.
    """
    for checked in group:
        mesh_edit.check_changeable(checked.obj)
    with ExitStack() as stack:
        for checked in group:
            stack.enter_context(mesh_edit.all_or_nothing(checked.obj))
        each = [None] * len(group) if found is None else found
        return sum(map(_mend, group, each))


def _mend(checked: SplatObject, found: Mended | None = None) -> int:
    """Do what `mend` says to one object, without a net."""
    mesh = checked.mesh
    mending = mesh_drift.mending(mesh)() if found is None else found.mending
    if mending is None:
        return 0
    moves, regrouped = mending
    names = [column.name for column in checked.layout.columns]
    mesh_layout.list_all(mesh)
    checked = mesh_layout.check(checked.obj)
    for degree, rows in regrouped:
        _regroup(checked, degree, rows)
    if moves:
        columns = found.columns if found else {}
        if not columns or names != [column.name for column in checked.layout.columns]:
            columns = moved_columns(checked, moves)
        mesh_attributes.write_columns(
            checked, {name: values for name, values in columns.items() if name not in "xyz"}
        )
    mesh_drift.stamp(mesh)
    mended = [move.rows for move in moves] + [rows for _, rows in regrouped]
    return len(np.unique(np.concatenate(mended))) if mended else 0


def _regroup(checked: SplatObject, degree: int, rows: NDArray[np.int64]) -> None:
    """Put harmonics of a lower degree under the names that they have in that of the object."""
    own, all_of = above_constant(degree), mesh_layout.rest_count(checked.mesh) // 3
    stored = mesh_attributes.stored_columns(checked)
    values = np.stack([stored[f"f_rest_{index}"][rows] for index in range(3 * own)])
    columns = {}
    for index in range(3 * all_of):
        channel, harmonic = divmod(index, all_of)
        columns[f"f_rest_{index}"] = column = stored[f"f_rest_{index}"].copy()
        column[rows] = values[channel * own + harmonic] if harmonic < own else 0.0
    mesh_attributes.write_columns(checked, columns)


def bake(group: Sequence[SplatObject], *, location: bool = True) -> list[str]:
    """Move splats as their objects are moved, and take the objects' transforms away.

    What they look like, and where they are in the world, stays; so do children, and scores hold.
    Parents still move the objects. What others did before is mended first.

    Parameters
    ----------
    group : sequence of SplatObject
    location : bool
        Whether the objects' origins go to that of the world, or of their parents.

    Returns
    -------
    list of str
        Notes.

    Raises
    ------
    RefineError
        See `mesh.edit.check_deletable`, `mend` and `splat_object.moved_columns`; also if an object
        is animated or constrained.
    """
    notes = []
    for checked in group:
        mesh_edit.check_deletable(checked.obj)
        _check_still(checked.obj)
        notes += uneven_notes(checked, _own_matrix(checked.obj, location=location))
    with ExitStack() as stack:
        for checked in group:
            stack.enter_context(mesh_edit.all_or_nothing(checked.obj))
        for checked in group:
            matrix = _own_matrix(checked.obj, location=location)
            _move_all(checked, matrix)
    for checked in group:  # nothing fails from here on
        _take_away(checked.obj, location=location)
    return notes


def _check_still(obj: bpy.types.Object) -> None:
    """Refuse an object that something else will put where it was."""
    animated = obj.animation_data and (obj.animation_data.action or obj.animation_data.drivers)
    if animated or obj.constraints:
        what = "animated" if animated else "constrained"
        raise RefineError(
            f"object '{obj.name}': is {what}, which goes on to move it; remove that first, or "
            "export with Apply Transform"
        )


def _own_matrix(obj: bpy.types.Object, *, location: bool) -> NDArray[np.float64]:
    """Return the transform that an object has beside those of its parents, (4, 4)."""
    matrix = snapped(np.array(obj.matrix_basis, np.float64))
    if not location:
        matrix[:3, 3] = 0.0
    if is_flat(matrix):
        raise RefineError(
            f"object '{obj.name}': is scaled to nothing along an axis, which nothing undoes"
        )
    return matrix


def _move_all(
    checked: SplatObject,
    matrix: NDArray[np.float64],
    columns: dict[str, NDArray[Any]] | None = None,
) -> None:
    """Move all splats of an object's data, after what others did to them was mended.

    What they become may be known: then there is nothing to mend.
    """
    if columns is None:
        if _mend(checked):
            checked = mesh_layout.check(checked.obj)
        stays = np.array_equal(matrix, np.eye(4))
        everything = Move(np.arange(len(checked)), matrix)
        columns = {} if stays else moved_columns(checked, [everything])
    mesh_attributes.write_columns(checked, columns)
    mesh_drift.stamp(checked.mesh)


def _take_away(obj: bpy.types.Object, *, location: bool) -> None:
    """Take away an object's own transform; children stay where they are, and scores hold."""
    bpy.context.view_layer.update()
    before = obj.matrix_world.copy()
    place = obj.matrix_basis.translation.copy()
    for name, value in _UNMOVED.items():
        setattr(obj, name, value)
    if not location:
        obj.location = place
    bpy.context.view_layer.update()
    for child in obj.children:
        back = obj.matrix_world.inverted() @ before
        child.matrix_parent_inverse = back @ child.matrix_parent_inverse
    mesh_scores.move_origin(obj.data, np.array(before), np.array(obj.matrix_world))
    bpy.context.view_layer.update()


class Joined(NamedTuple):
    """What the splats of several objects become in the frame of the first.

    Attributes
    ----------
    matrices : list of (4, 4) float64
        From the frames of the objects to that of the first.
    columns : list of dict of str to (N,) float32
        What changes of each object; None where something is to be mended before.
    """

    matrices: list[NDArray[np.float64]]
    columns: list[dict[str, NDArray[Any]] | None]


def read_to_join(
    active: SplatObject, others: Sequence[SplatObject]
) -> Callable[[Progress], Joined]:
    """Read objects; return what moves their splats into the frame of the first, on any thread.

    Raises
    ------
    RefineError
        See `join`.
    """
    group = [active, *others]
    matrices = _to_first(group)
    parts = [_read_to_move_all(*pair) for pair in zip(group, matrices, strict=True)]

    def work(progress: Progress) -> Joined:
        columns = []
        for number, part in enumerate(parts):
            report(progress, number / len(parts), "")
            columns.append(part())
        return Joined(matrices, columns)

    return work


def _read_to_move_all(
    member: SplatObject, matrix: NDArray[np.float64]
) -> Callable[[], dict[str, NDArray[Any]] | None]:
    """Read an object; return what moves all of its splats, None if they are to be mended first."""
    find, stays = mesh_drift.mending(member.mesh), np.array_equal(matrix, np.eye(4))
    everything = [] if stays else [Move(np.arange(len(member)), matrix)]
    move = None if stays else read_to_move(member)
    return lambda: None if find() else move(everything) if move else {}


def join(
    active: SplatObject, others: Sequence[SplatObject], found: Joined | None = None
) -> list[str]:
    """Put the splats of several objects into one, which keep what they look like and all they have.

    The others go; their children are parented to the one. Marks, vertex groups and properties come
    along; where one has no such property, it is 0 for its splats. Harmonics of a lower degree are
    filled up with zeros, which they mean. Scores do not come along.

    Parameters
    ----------
    active : SplatObject
        Which has the splats afterwards; it keeps its place, name and type.
    others : sequence of SplatObject
        One at least.
    found : Joined, optional
        What the callable of `read_to_join` has returned; None to do that now. It does not count if
        an object was moved since.

    Returns
    -------
    list of str
        What was filled in, and what else does not stay to the digit, in sentences.

    Raises
    ------
    RefineError
        See `mesh.edit.check_changeable` and `splat_object.moved_columns`; also if Blender fails.
    """
    group = [active, *others]
    matrices = _to_first(group)
    pairs = zip(group, matrices, strict=True)
    notes = [note for member, matrix in pairs for note in uneven_notes(member, matrix)]
    with _workbench() as bench:
        parts = [_copied(member, bench) for member in group]
        holds = found is not None and np.array_equal(found.matrices, matrices)
        columns = found.columns if found and holds else [None] * len(parts)
        for part, matrix, moved in zip(parts, matrices, columns, strict=True):
            _move_all(mesh_layout.check(part), matrix, moved)
        notes += _made_alike([mesh_layout.check(part) for part in parts], group)
        whole = _as_one(parts)
        mesh_drift.stamp(whole.data)
        _give(active.obj, whole)
    for other in others:
        _replace(other.obj, active.obj)
    return notes


def _to_first(group: Sequence[SplatObject]) -> list[NDArray[np.float64]]:
    """The matrices from the frames of objects that can be joined to that of the first."""
    for member in group:
        mesh_edit.check_changeable(member.obj)
        if member.obj.type != "MESH":
            raise RefineError(
                f"object '{member.obj.name}': is a point cloud, which Blender cannot join; export "
                "it, and import the file as a mesh"
            )
    graph = bpy.context.evaluated_depsgraph_get()
    worlds = [world_matrix(member.obj, graph) for member in group]
    for member, world in zip(group, worlds, strict=True):
        if is_flat(world):
            raise RefineError(f"object '{member.obj.name}': is scaled to nothing along an axis")
    return [np.eye(4), *(np.linalg.inv(worlds[0]) @ world for world in worlds[1:])]


@contextmanager
def _workbench() -> Iterator[bpy.types.Collection]:
    """Give a collection of the scene; all that is in it goes afterwards."""
    bench = bpy.data.collections.new("REFINE join")
    bpy.context.scene.collection.children.link(bench)
    try:
        yield bench
    finally:
        for obj in list(bench.objects):
            _remove(obj)
        bpy.data.collections.remove(bench)


def _remove(obj: bpy.types.Object) -> None:
    """Remove an object, and its data if nothing else uses it."""
    data = obj.data
    bpy.data.objects.remove(obj)
    if not data.users:
        bpy.data.batch_remove([data])


def _copied(member: SplatObject, bench: bpy.types.Collection) -> bpy.types.Object:
    """Return a mesh object with a copy of an object's splats, without transform and scores."""
    obj = bpy.data.objects.new("REFINE join", member.mesh.copy())
    bench.objects.link(obj)
    for name in _OF_ALL:
        mesh_attributes.remove_attribute(obj.data, name)
    mesh_floaters.forget(obj.data)
    for record in (mesh_scores.RECORD, demands.FACTS):
        if record in obj.data:
            del obj.data[record]
    bpy.context.view_layer.update()
    return obj


def _made_alike(parts: Sequence[SplatObject], group: Sequence[SplatObject]) -> list[str]:
    """Have objects hold the same columns in the same attributes; tell what some lack, in notes."""
    notes = []
    most = max(mesh_layout.rest_count(part.mesh) for part in parts)
    refuse_mixed([member.layout.model for member in group])
    layout = mesh_layout.merged([part.layout for part in parts])
    for part, member in zip(parts, group, strict=True):
        own = {column.name: column for column in part.layout.columns}
        missing = [c.name for c in layout.columns if c.name not in own]
        if missing := [name for name in missing if not name.startswith("f_rest_")]:
            notes.append(
                f"object '{member.obj.name}': has no {', '.join(missing)}, which became 0 for its "
                f"{len(member):,} splats"
            )
        _raise_degree(part, most)
        mesh_attributes.move_columns(part, layout)
    mesh_layout.note(parts[0].mesh, layout)
    return notes


def _raise_degree(checked: SplatObject, count: int) -> None:
    """Add harmonics that are 0 until there are as many of all channels."""
    mesh, own = checked.mesh, mesh_layout.rest_count(checked.mesh)
    for index in range(own, count):
        mesh.attributes.new(f"f_rest_{index}", "FLOAT", "POINT")
    if 0 < own < count:
        everything = np.arange(len(checked))
        _regroup(mesh_layout.check(checked.obj), REST_COUNTS[own], everything)


def _as_one(parts: Sequence[bpy.types.Object]) -> bpy.types.Object:
    """Return the first of several mesh objects, in which all vertices are by then."""
    bpy.context.view_layer.update()
    first, count = parts[0], sum(len(part.data.vertices) for part in parts)
    others = [part.data for part in parts[1:]]
    chosen = {"active_object": first, "object": first, "selected_editable_objects": parts}
    try:
        with bpy.context.temp_override(**chosen):
            bpy.ops.object.join()
    except RuntimeError as error:
        raise RefineError(f"Blender could not join the splats ({str(error).strip()})") from error
    bpy.data.batch_remove(others)
    if len(first.data.vertices) != count:
        raise RefineError(
            f"{len(first.data.vertices)} splats were joined, expected {count}; report this"
        )
    return first


def _give(obj: bpy.types.Object, source: bpy.types.Object) -> None:
    """Give an object the data of another in place of its own."""
    old = obj.data
    name = old.name
    obj.data = source.data
    if not old.users:
        bpy.data.batch_remove([old])
        obj.data.name = name


def _replace(obj: bpy.types.Object, parent: bpy.types.Object) -> None:
    """Remove an object; another becomes the parent of its children, which stay where they are."""
    back = parent.matrix_world.inverted() @ obj.matrix_world
    for child in list(obj.children):
        inverse = back @ child.matrix_parent_inverse
        child.parent = parent
        child.matrix_parent_inverse = inverse
    _remove(obj)
