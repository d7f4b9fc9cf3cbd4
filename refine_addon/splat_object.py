"""What the panel and the command do to an object: score, store, plan, apply, export.

Every function either does all it says or raises `RefineError` and leaves the scene as it was.
"""

from __future__ import annotations

import time
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import bpy
import numpy as np

from .cameras.objects import world_matrix
from .core import pipeline
from .core.affine import transformed
from .core.errors import RefineError
from .core.formats.ply import columns_from_splats
from .core.selection import select
from .core.whole_file import refuse_existing
from .core.work import Progress, part, silent
from .mesh import attributes as mesh_attributes
from .mesh import edit as mesh_edit
from .mesh import layout as mesh_layout
from .mesh.layout import check
from .mesh.scores import RECORD, store, stored_scores

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from .core.absorbing.absorb import Absorbed
    from .core.formats.ply import SplatFile
    from .core.pipeline import Settings
    from .core.selection import Budget
    from .core.splats import Splats
    from .core.views import ViewSet


@dataclass(frozen=True)
class Plan:
    """What a budget would do to an object.

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


def gather(obj: bpy.types.Object, *, whole: bool = False) -> Splats:
    """Return an object's splats as they stand in the world, for scoring.

    Modifiers are not looked at: what is scored is what is exported.

    Parameters
    ----------
    obj : bpy.types.Object
    whole : bool
        Whether to bring view-dependent colour along, for absorbing; the scale must be uniform then.

    Raises
    ------
    RefineError
        If the object holds no splats, or its matrix cannot be applied.
    """
    check(obj)
    matrix = world_matrix(obj, bpy.context.evaluated_depsgraph_get())
    splats = mesh_attributes.splats_from_object(obj, sh_rest=whole)
    if np.array_equal(matrix, np.eye(4)):
        return splats
    return transformed(splats, matrix, rotate_sh=whole)


def modifier_notes(obj: bpy.types.Object) -> list[str]:
    """Return a sentence if modifiers show the object otherwise than it is scored and exported."""
    ours = ("REFINE", "KIRI")  # they draw splats, and move none
    names = [m.name for m in obj.modifiers if m.show_viewport and not m.name.startswith(ours)]
    if not names:
        return []
    note = (
        f"object '{obj.name}': scored as without its modifiers ({', '.join(names)}); apply them "
        "first if they move splats"
    )
    return [note]


def check_scorable(obj: bpy.types.Object) -> None:
    """Raise `RefineError` if scores could not be stored on an object, before they are computed."""
    check(obj)
    mesh_edit.check_writable(obj)


def keep_mask(obj: bpy.types.Object, budget: Budget, protect: str = "") -> NDArray[np.bool_]:
    """Return which splats of a scored object stay.

    Parameters
    ----------
    obj : bpy.types.Object
    budget : Budget
    protect : str
        Name of a boolean point attribute or a vertex group: what is in it stays.

    Raises
    ------
    RefineError
        If the object was not scored, has nothing named `protect`, or nothing would stay.
    """
    row_bytes, fixed_bytes = mesh_attributes.file_size(obj)
    return select(
        stored_scores(obj),
        budget,
        protected=protected(obj, protect),
        row_bytes=row_bytes,
        fixed_bytes=fixed_bytes,
    )


def protected(obj: bpy.types.Object, name: str) -> NDArray[np.bool_] | None:
    """Return what the named attribute or vertex group protects; None for no name."""
    return mesh_edit.protected_mask(obj, name) if name else None


def plan(obj: bpy.types.Object, budget: Budget, protect: str = "") -> Plan:
    """Return what `apply_object` would do, and mark the splats that would go."""
    keep = keep_mask(obj, budget, protect)
    mesh_edit.check_writable(obj)
    mesh_attributes.write_attribute(obj.data, mesh_edit.REMOVE, "BOOLEAN", ~keep)
    obj.data.update()
    return _plan(obj, keep)


def apply_object(
    obj: bpy.types.Object, budget: Budget, protect: str = "", absorbed: Absorbed | None = None
) -> Plan:
    """Delete the splats that a budget does not keep, by the scores that the object holds.

    Everything else of the object and its mesh stays: attributes, vertex groups, custom properties,
    materials, modifiers. The scores stay to be looked at, but the next apply asks for new ones.

    Parameters
    ----------
    obj : bpy.types.Object
    budget : Budget
    protect : str
        See `keep_mask`.
    absorbed : Absorbed, optional
        What became of the object's splats, in the world: decides in place of budget and scores.

    Returns
    -------
    Plan
        What was done.

    Raises
    ------
    RefineError
        See `keep_mask` and `mesh_edit.check_deletable`.
    """
    mesh_edit.check_deletable(obj)
    keep = absorbed.keep if absorbed else keep_mask(obj, budget, protect)
    if len(keep) != len(obj.data.vertices):
        msg = (
            f"object '{obj.name}': has {len(obj.data.vertices)} splats and had {len(keep)} when "
            "absorbing began; apply again"
        )
        raise RefineError(msg)
    done = _plan(obj, keep)
    _reduce(obj, keep, absorbed_columns(obj, absorbed) if absorbed else {})
    return done


def _reduce(
    obj: bpy.types.Object, keep: NDArray[np.bool_], columns: dict[str, NDArray[Any]]
) -> None:
    """Set what the survivors became, delete the others, and ask for new scores from here on."""
    mesh_attributes.write_columns(obj, columns)
    mesh_edit.delete_vertices(obj, ~keep)
    del obj.data[RECORD]


def absorbed_columns(obj: bpy.types.Object, absorbed: Absorbed) -> dict[str, NDArray[Any]]:
    """Return an object's columns with the survivors as they became, in the object's frame."""
    matrix = world_matrix(obj, bpy.context.evaluated_depsgraph_get())
    changed = np.flatnonzero(absorbed.changed)
    survivors = absorbed.splats.take(changed)
    if not np.array_equal(matrix, np.eye(4)):
        survivors = transformed(survivors, np.linalg.inv(matrix))
    index = np.flatnonzero(absorbed.keep)[changed]
    columns = mesh_attributes.stored_columns(obj, columns_from_splats(survivors))
    for name, values in columns_from_splats(survivors).items():
        columns[name][index] = values
    return columns


def export_object(
    obj: bpy.types.Object,
    path: Path | str,
    *,
    keep: NDArray[np.bool_] | None = None,
    columns: dict[str, NDArray[Any]] | None = None,
    apply_transform: bool = False,
    overwrite: bool = False,
) -> SplatFile:
    """Write an object as a 3DGS PLY, in the layout of the file it was imported from.

    Parameters
    ----------
    obj : bpy.types.Object
    path : path-like
    keep : (N,) bool, optional
        Which splats to write; all by default.
    columns : mapping of str to (N,), optional
        Properties to write with these values, in the object's frame, in place of the object's.
    apply_transform : bool
        Whether to write the splats as they stand in the world, harmonics turned with them.
    overwrite : bool
        Whether `path` may be replaced.

    Returns
    -------
    SplatFile
        What was written, all rows.

    Raises
    ------
    RefineError
        If the object holds no splats, its scale is uneven and is to be applied, or the file cannot
        be written; nothing is written then.
    """
    target = Path(path).expanduser()
    check(obj)
    refuse_existing(target, overwrite=overwrite)
    file = mesh_attributes.file_from_object(
        obj, _world_columns(obj) if apply_transform else columns
    )
    file.write(target, keep, overwrite=overwrite)
    return file


def prune_object(  # noqa: PLR0913 - the command's options
    name: str,
    views: ViewSet,
    budget: Budget,
    settings: Settings,
    *,
    absorb: bool = False,
    output: Path | None = None,
    save: bool = False,
    dry_run: bool = False,
    overwrite: bool = False,
    progress: Progress = silent,
) -> dict[str, Any]:
    """Prune an object of the open scene, export what stays, save the .blend.

    Parameters
    ----------
    name : str
        Of the object.
    views, budget, settings, absorb, progress
        See `refine_addon.core.pipeline.prune`.
    output : Path, optional
        The PLY file to make.
    save : bool
        Whether to delete the splats from the object and save the .blend.
    dry_run : bool
        Whether to decide only.
    overwrite : bool
        Whether `output` may be replaced.

    Returns
    -------
    dict
        The report, as of `refine_addon.core.pipeline.prune_file`.

    Raises
    ------
    RefineError
        See `gather`, `apply_object`, `export_object` and `refine_addon.core.pipeline.prune`; also
        if there is no such object, or the .blend cannot be saved.
    """
    start = time.perf_counter()
    obj = find(name)
    check(obj)
    target = None if output is None or dry_run else Path(output).expanduser()
    if target is not None:
        refuse_existing(target, overwrite=overwrite)
    if save and not dry_run:
        _check_savable(obj)
    row_bytes, fixed_bytes = mesh_attributes.file_size(obj)
    splats = gather(obj, whole=absorb)
    read = time.perf_counter()
    result = pipeline.prune(
        splats,
        views,
        budget,
        settings,
        absorb=absorb,
        row_bytes=row_bytes,
        fixed_bytes=fixed_bytes,
        progress=part(progress, 0.0, 0.8),
    )
    decided = time.perf_counter()
    sizes = _plan(obj, result.keep)
    columns = absorbed_columns(obj, result.absorbed) if result.absorbed and not dry_run else {}
    if target is not None:
        export_object(obj, target, keep=result.keep, columns=columns, overwrite=overwrite)
    if save and not dry_run:
        store(obj, result.scores, settings)
        _reduce(obj, result.keep, columns)
        _save()
    timings = result.report["timings"]
    timings["read_s"] = read - start
    timings["write_s"] = time.perf_counter() - decided
    timings["total_s"] = time.perf_counter() - start
    result.report["notes"] += modifier_notes(obj)
    result.report["files"] = {
        "input": f"{bpy.data.filepath}#{name}",
        "output": None if target is None else str(target),
        "input_bytes": sizes.bytes_before,
        "output_bytes": sizes.bytes_after,
    }
    return result.report


def _plan(obj: bpy.types.Object, keep: NDArray[np.bool_]) -> Plan:
    row_bytes, fixed_bytes = mesh_attributes.file_size(obj)
    kept = int(np.count_nonzero(keep))
    # The header says how many splats follow, in as many digits as that takes.
    shorter = len(str(len(keep))) - len(str(kept))
    sizes = (fixed_bytes + row_bytes * len(keep), fixed_bytes - shorter + row_bytes * kept)
    return Plan(kept, len(keep) - kept, *sizes)


def _world_columns(obj: bpy.types.Object) -> dict[str, NDArray[Any]]:
    """Return the columns that the object's matrix changes, as they are in the world."""
    matrix = world_matrix(obj, bpy.context.evaluated_depsgraph_get())
    if np.array_equal(matrix, np.eye(4)):
        return {}
    moved = transformed(mesh_attributes.splats_from_object(obj), matrix)
    columns: dict[str, NDArray[Any]] = dict(columns_from_splats(moved))
    layout = check(obj)
    if {"nx", "ny", "nz"} <= {column.name for column in layout.columns}:
        normals = mesh_attributes.normals(obj, layout) @ np.linalg.inv(matrix[:3, :3])
        lengths = np.linalg.norm(normals, axis=1, keepdims=True)
        normals = normals / np.where(lengths > 0.0, lengths, 1.0)  # most files store zeros
        columns.update(zip(("nx", "ny", "nz"), normals.T, strict=True))
    return columns


def find(name: str) -> bpy.types.Object:
    """Return the object of that name, or raise `RefineError` with those that hold splats."""
    obj = bpy.context.scene.objects.get(name)
    if obj is None:
        names = [o.name for o in bpy.context.scene.objects if mesh_layout.looks_like_splats(o)]
        there = ", ".join(names[:8]) or "none"
        msg = f"no object '{name}' in scene '{bpy.context.scene.name}' (splat objects: {there})"
        raise RefineError(msg)
    return obj


def _check_savable(obj: bpy.types.Object) -> None:
    mesh_edit.check_deletable(obj)
    if not bpy.data.filepath:
        msg = "the scene is not saved in a .blend file yet: --save has nowhere to save to"
        raise RefineError(msg)


def _save() -> None:
    try:
        bpy.ops.wm.save_mainfile()
    except RuntimeError as error:
        msg = f"{bpy.data.filepath}: cannot be saved ({str(error).strip()})"
        raise RefineError(msg) from error
