"""Transforms of whole splat objects: bake, mend.
Each does all it says, or raises `RefineError` and changes nothing."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from typing import Any

import bpy
import numpy as np
from numpy.typing import NDArray

from ..cameras import snapped
from ..core import RefineError
from ..core.affine import Move, baked, check_affine, is_flat, is_uniform, moved
from ..core.execute import chunks, run_all
from ..core.formats.ply_columns import values_by_name
from ..core.splats import Splats, above_constant
from ..mesh import attributes, drift, edit, scores
from ..mesh.layout import SplatObject, forget_axis, sh_degree

_NORMALS = ("nx", "ny", "nz")
_ROWS = 1 << 14  # Splats moved at a time on one thread

_TRANSFORM = (
    *("location", "rotation_euler", "rotation_quaternion", "rotation_axis_angle", "scale"),
    *("delta_location", "delta_rotation_euler", "delta_rotation_quaternion", "delta_scale"),
)
"""Transform properties of an object."""


def read_to_move(
    checked: SplatObject, matrix: NDArray[np.float64], *, mend: bool = False
) -> tuple[set[str], Callable[[], tuple[dict[str, NDArray[Any]], int]]]:
    """Read an object to move its splats by `matrix`, (4, 4) in its frame, first repaired if `mend`.
    Gives the properties that change (maybe none, or normals that it lacks), and a thread-safe
    callable for their values, (N,), and the number mended."""
    check_affine(matrix)
    notes = drift.disturbed(checked.mesh) if mend else None
    if notes is None and np.array_equal(matrix, np.eye(4)):
        return set(), lambda: ({}, 0)
    splats = attributes.splats_from_object(checked)
    names = {*values_by_name(splats), *_NORMALS} - {"opacity"}
    normals = attributes.read_planes(checked, _NORMALS).T
    return names, partial(_moved, splats, normals, matrix, notes)


def _moved(splats, normals, matrix, notes):
    """Columns of splats and normals, repaired by notes and moved by a matrix; number repaired."""
    moves = notes.moves()[0] if notes else []
    regrouped = notes.regrouped() if notes else np.zeros(len(splats), np.int64)
    if regrouped.any():
        splats = replace(splats, sh_rest=_regrouped(splats.sh_rest, regrouped))
    mended = regrouped > 0
    still = np.ones(len(splats), np.bool_)
    for move in moves:
        mended[move.rows], still[move.rows] = True, False
    stays = np.array_equal(matrix, np.eye(4))
    all_moves = [Move(move.rows, matrix @ move.matrix) for move in moves]
    all_moves += [] if stays else [Move(np.flatnonzero(still), matrix)]
    values = values_by_name(splats)
    columns = {name: np.array(values[name]) for name in values if name != "opacity"}
    for move in all_moves:
        _move_rows(splats, columns, move)
        normals[move.rows] = _turned_normals(normals[move.rows], move.matrix)
    with np.errstate(over="ignore", under="ignore", invalid="ignore"):  # rounding of float64
        means = splats.means if stays else np.float32(moved(splats.means, matrix))
    columns |= dict(zip("xyz", means.T, strict=True))
    columns |= dict(zip(_NORMALS, normals.T, strict=True))
    return columns, int(np.count_nonzero(mended))


def _move_rows(splats: Splats, columns: dict[str, NDArray[Any]], move: Move) -> None:
    def move_some(part: slice) -> None:
        rows = move.rows[part]
        values = values_by_name(baked(splats.take(rows), move.matrix))
        with np.errstate(over="ignore", under="ignore", invalid="ignore"):  # rounding of float64
            for name, column in columns.items():
                column[rows] = values[name]

    run_all(move_some, chunks(len(move.rows), _ROWS))


def _regrouped(rest: NDArray[Any], degrees: NDArray[np.int64]) -> NDArray[Any]:
    """Harmonics, (N, K, 3), put right; `degrees`: as in `mesh.drift.Notes.regrouped`."""
    rest = np.array(rest)
    for degree in np.unique(degrees[degrees > 0]).tolist():
        rows, own = degrees == degree, above_constant(degree)
        in_file = rest[rows].transpose(0, 2, 1).reshape(-1, 3 * rest.shape[1])
        rest[rows] = 0.0
        rest[rows, :own] = in_file[:, : 3 * own].reshape(-1, 3, own).transpose(0, 2, 1)
    return rest


def _turned_normals(normals: NDArray[np.float32], matrix: NDArray[np.float64]) -> NDArray[Any]:
    """Normals, (M, 3), of surfaces moved by a matrix; zeros, as most files have, stay."""
    turned = normals @ np.linalg.inv(matrix[:3, :3]) + 0.0  # no -0
    lengths = np.linalg.norm(turned, axis=1, keepdims=True)
    return np.asarray(turned / np.where(lengths > 0.0, lengths, 1.0))


def uneven_notes(checked: SplatObject, matrix: NDArray[np.float64]) -> list[str]:
    """A sentence if colours cannot follow a (4, 4) matrix exactly."""
    if is_uniform(matrix) or not sh_degree(checked.mesh):
        return []
    return [
        f"object '{checked.obj.name}': the scale is uneven, which harmonics cannot follow exactly: "
        "colours that change with the direction became the nearest"
    ]


def write_moved(parts: Sequence[tuple[SplatObject, dict[str, NDArray[Any]]]]) -> None:
    """Store results of `read_to_move`: in all objects or none."""
    group = [checked for checked, _ in parts]
    for checked in group:
        edit.check_changeable(checked.obj)
    with edit.all_or_nothing(group):
        for checked, columns in parts:
            attributes.write_columns(checked.mesh, checked.layout, columns)
            drift.stamp(checked.mesh)
            if columns:
                forget_axis(checked.mesh)


def bake(group: Sequence[SplatObject], *, location: bool = True) -> list[str]:
    """Move splats by their object's transform and reset it (`location`: its origin too); notes.
    Look, world positions, children and scores stay; parents still move it. Drift is mended first.
    `RefineError` also if an object is animated or constrained."""
    notes, parts = [], []
    for checked in group:
        obj, label = checked.obj, f"object '{checked.obj.name}'"
        edit.check_deletable(obj)
        animated = obj.animation_data and (obj.animation_data.action or obj.animation_data.drivers)
        if animated or obj.constraints:
            what = "animated" if animated else "constrained"
            raise RefineError(
                f"{label}: is {what}, which goes on to move it; remove that first, or export with "
                "Apply Transform"
            )
        matrix = snapped(np.array(obj.matrix_basis, np.float64))
        if not location:
            matrix[:3, 3] = 0.0
        if is_flat(matrix):
            raise RefineError(f"{label}: is scaled to nothing along an axis, which nothing undoes")
        notes += uneven_notes(checked, matrix)
        parts.append((checked, read_to_move(checked, matrix, mend=True)[1]()[0]))
    write_moved(parts)
    for checked in group:  # nothing fails from here on
        _reset(checked.obj, location=location)
    return notes


def _reset(obj: bpy.types.Object, *, location: bool) -> None:
    """Reset an object's own transform; children stay in place, and scores hold."""
    bpy.context.view_layer.update()
    before = obj.matrix_world.copy()
    place = obj.matrix_basis.translation.copy()
    for name in _TRANSFORM:
        setattr(obj, name, obj.bl_rna.properties[name].default_array)
    if not location:
        obj.location = place
    bpy.context.view_layer.update()
    for child in obj.children:
        back = obj.matrix_world.inverted() @ before
        child.matrix_parent_inverse = back @ child.matrix_parent_inverse
    scores.move_origin(obj.data, np.array(before), np.array(obj.matrix_world))
    bpy.context.view_layer.update()
