"""Operations of panel and command on splat objects: score, apply, export, levels of detail.
Several objects are one scene: scored together, under one budget. `mesh.layout.check` checks each.
A function does all it says, or raises `RefineError` and changes nothing."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import bpy
import numpy as np
from numpy.typing import NDArray

from ..cameras import world_matrix
from ..core import Budget, Level, RefineError, Result, SplatFile, ViewSet, prune
from ..core.affine import is_uniform, transformed
from ..core.execute import silent
from ..core.formats.format import Format
from ..core.formats.ply_columns import values_by_name
from ..core.methods import DEFAULT, Merge, Method
from ..core.operations import Scene, prune_scene, run, score_scene, to_size
from ..core.pictures import PictureFiles
from ..core.spherical_harmonics import recolored
from ..core.splats import Splats, joined
from ..mesh import attributes, drift, edit, layout, scores
from ..mesh.layout import SplatObject, rows_of
from .demands import NONE, Demands, Masks
from .transforms import read_to_move, uneven_notes

LEVEL_STATS = "refine_lod"  # Custom property of a level object: its stats, as in files' reports
LEVEL_OF = "refine_level_of"  # Custom property of a level object: its original
Members = list[SplatObject]  # Objects by name, at least one


class Outcome(NamedTuple):
    """Effect of a budget: splats kept and removed, bytes of the exported files before and after."""

    kept: int
    removed: int
    bytes_before: int
    bytes_after: int

    @classmethod
    def of(cls, count: int, kept: int, row_bytes: int, fixed_bytes: int) -> Outcome:
        """Effect of keeping so many splats of `row_bytes` in a file with `fixed_bytes` besides."""
        # The header says how many splats follow, in as many digits as that takes.
        shorter = len(str(count)) - len(str(kept))
        sizes = (fixed_bytes + row_bytes * count, fixed_bytes - shorter + row_bytes * kept)
        return cls(kept, count - kept, *sizes)


def chosen(active: bpy.types.Object) -> list[bpy.types.Object]:
    """Selected splat objects by name, or the active one if not selected. Quick enough to draw."""
    objects = bpy.context.view_layer.objects
    selected = [obj for obj in objects.selected if layout.looks_like_splats(obj)]
    if active not in selected:
        return [active]
    return sorted(selected, key=lambda obj: obj.name)


def members(active: bpy.types.Object) -> Members:
    """Checked objects of `chosen`; `RefineError` if two share their data."""
    group = [layout.check(obj) for obj in chosen(active)]
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


def check_forced(scene: bpy.types.Scene, group: Members, before: Masks) -> None:
    """Raise `RefineError` if other splats are protected or removed than before."""
    now = Demands.of_scene(scene).masks(group)
    if not all(np.array_equal(before[name], now[name]) for name in now):
        raise RefineError(
            "what must stay or go has changed meanwhile; nothing was removed: apply again"
        )


def gather(group: Sequence[SplatObject], *, whole: bool | None = False) -> Splats:
    """Splats of objects in the world, for scoring; modifiers are ignored, as in exports.
    `whole` reads view-dependent colour, for merging, and needs uniform scales; None reads it where
    scales are uniform, to estimate the pictures' quality. `RefineError` names the object."""
    parts = []
    for checked in group:
        matrix = world_matrix(checked.obj)
        harmonics = is_uniform(matrix) if whole is None else whole
        splats = attributes.splats_from_object(checked, sh_rest=harmonics)
        if not np.array_equal(matrix, np.eye(4)):
            try:
                splats = transformed(splats, matrix, rotate_sh=harmonics)
            except RefineError as error:
                raise RefineError(f"object '{checked.obj.name}': {error}") from None
        parts.append(splats)
    return joined(parts)


def possible(group: Sequence[SplatObject], method: Method) -> Method:
    """The method, or `Occlusion` for merging where an object's scale is uneven."""
    even = all(is_uniform(world_matrix(member.obj)) for member in group)
    return method if even or not isinstance(method, Merge) else method.deleting()


def modifier_notes(obj: bpy.types.Object) -> list[str]:
    """A sentence if modifiers make an object look other than it is scored and exported."""
    drawing = ("REFINE", "KIRI")  # these draw splats and move none
    names = [m.name for m in obj.modifiers if m.show_viewport and not m.name.startswith(drawing)]
    if not names:
        return []
    return [
        f"object '{obj.name}': scored without its modifiers ({', '.join(names)}); apply them "
        "first if they move splats"
    ]


def drift_notes(checked: SplatObject) -> list[str]:
    """Sentences on drift; see `mesh.drift`."""
    found = drift.found(checked.mesh)
    if found is None:
        return []
    remedy = "; Mend Splats in the panel puts that right" if found.mendable else ""
    return [f"object '{checked.obj.name}': {sentence}{remedy}" for sentence in found.sentences]


def stored_arguments(
    group: Members, budget: Budget, masks: Masks, method: Method, views: ViewSet | None = None
) -> dict[str, Any]:
    """Arguments of `prune` from stored scores; `views` for merging and refitting, None to delete.
    `RefineError` if splats have no scores, or objects were not scored together."""
    sizes = [attributes.file_size(member) for member in group]
    return {
        "splats": None if views is None else gather(group, whole=True),
        "views": views,
        "budget": budget,
        "method": method,
        "scores": scores.stored_scores(group, masks["removed"]),
        **masks,
        # The longest row counts, so that the file is never larger than the budget.
        "sizes": (max(row for row, _ in sizes), sum(fixed for _, fixed in sizes)),
    }


def sized(
    arguments: dict[str, Any], form: Format, reads: Sequence[Callable[[], SplatFile]]
) -> dict[str, Any]:
    """Arguments of `prune` with the size of a splat in a format, of those that deletion keeps."""
    files = [read() for read in reads]
    starts = np.cumsum([len(file) for file in files])[:-1]

    def pruned(sizes: tuple[float, int], **_: Any) -> Result:
        return prune(**arguments | {"method": arguments["method"].deleting(), "sizes": sizes})

    kept = to_size(
        arguments["budget"], form, files,
        lambda result: [(keep, None) for keep in np.split(result.keep, starts)], [(pruned, silent)],
    ).keep  # fmt: skip
    limit = 1e6 * arguments["budget"].max_mb
    return arguments | {"sizes": (limit / np.count_nonzero(kept), 0)}


def mark_removed(group: Members, keep: NDArray[np.bool_]) -> None:
    """Mark splats outside `keep`, (N,) of all objects."""
    for member, rows in zip(group, rows_of(map(len, group)), strict=True):
        edit.mark(member.obj, edit.REMOVE, ~keep[rows])


Frame = tuple[int, int, NDArray[np.float64]]
"""An object's splats, their degree of harmonics, and the (4, 4) matrix to the world."""


class Change(NamedTuple):
    """Change of an object's N splats: `keep`, (N,), K of them; `rows`, (M,) of the K, ascending;
    `columns`, new values of these M by property, in the object's frame."""

    keep: NDArray[np.bool_]
    rows: NDArray[np.int64] = np.empty(0, np.int64)
    columns: dict[str, NDArray[Any]] = {}


def frames_of(group: Sequence[SplatObject]) -> list[Frame]:
    """Read what `changes` needs of each object."""
    return [(len(one), layout.sh_degree(one.mesh), world_matrix(one.obj)) for one in group]


def changes(frames: Sequence[Frame], result: Result) -> list[Change]:
    """Change of each object's splats, from the result for all; arrays only."""
    parts, first, merged = [], 0, result.merged
    keeps = [result.keep[rows] for rows in rows_of(count for count, *_ in frames)]
    if merged is None:
        return list(map(Change, keeps))
    for (_, degree, matrix), keep in zip(frames, keeps, strict=True):
        start, first = first, first + int(np.count_nonzero(keep))
        changing = np.flatnonzero(merged.changed[start:first])
        splats = merged.splats.take(start + changing).up_to_degree(degree)
        if not np.array_equal(matrix, np.eye(4)):
            splats = transformed(splats, np.linalg.inv(matrix))
        columns = {name: np.ascontiguousarray(v) for name, v in values_by_name(splats).items()}
        parts.append(Change(keep, changing, columns))
    return parts


def apply(group: Sequence[SplatObject], parts: Sequence[Change]) -> Outcome:
    """Delete the splats that are not kept and store changed values: in all objects or none.
    All else stays; the scores' record goes, as scores hold for all splats together. `RefineError`
    if an object would end up empty."""
    outcomes = []
    for checked, part in zip(group, parts, strict=True):
        edit.check_deletable(checked.obj)
        if not part.keep.any():
            raise RefineError(
                f"no splat of object '{checked.obj.name}' would be left; nothing was removed: "
                "delete the object, or let more stay"
            )
        kept = int(np.count_nonzero(part.keep))
        outcomes.append(Outcome.of(len(part.keep), kept, *attributes.file_size(checked)))
    with edit.all_or_nothing(group):
        for checked, part in zip(group, parts, strict=True):
            reduce_object(checked, part)
    return Outcome(*map(sum, zip(*outcomes, strict=True)))


def delete_splats(checked: SplatObject, keep: NDArray[np.bool_]) -> Outcome:
    """Delete an object's splats outside `keep`, (N,); see `apply`."""
    return apply([checked], [Change(keep)])


def reduce_object(checked: SplatObject, change: Change) -> None:
    """Delete removed splats, store changed ones, drop floaters and the scores' record."""
    mesh = checked.mesh
    edit.delete_vertices(checked.obj, ~change.keep)
    attributes.write_columns(mesh, checked.layout, change.columns, change.rows)
    if change.columns and drift.is_stamped(mesh) and drift.found(mesh) is None:
        drift.stamp(mesh)  # not where others drifted before
    attributes.remove_attribute(mesh, scores.REASON)
    for record in (scores.FLOATERS, scores.RECORD):
        mesh.pop(record, None)


def grade(checked: SplatObject, rows: NDArray[np.int64], matrix: NDArray[np.float64]) -> None:
    """Multiply the colours of an object's splats `rows`, (M,), by a (3, 3) matrix; all else stays,
    to the bit."""
    edit.check_changeable(checked.obj)
    splats = attributes.splats_from_object(checked).take(rows)
    sh_dc, sh_rest = recolored(splats.sh_dc, splats.sh_rest, matrix)
    values = values_by_name(replace(splats, sh_dc=sh_dc, sh_rest=sh_rest))
    columns = {name: values[name] for name in values if name.startswith("f_")}
    with edit.all_or_nothing([checked]):
        attributes.write_columns(checked.mesh, checked.layout, columns, rows)


def read_for_export(
    checked: SplatObject, *, apply_transform: bool = False
) -> Callable[[], SplatFile]:
    """Read an object; a thread-safe callable builds its PLY in memory, in the imported layout.
    `apply_transform` puts splats into the world, harmonics turned; not if the matrix is flat."""
    if not apply_transform:
        return attributes.read_for_file(checked)
    names, move = read_to_move(checked, world_matrix(checked.obj))
    if names:
        header = layout.VERTICAL_AXIS.sub("", checked.layout.header.decode("latin-1"))
        checked = replace(checked, layout=checked.layout._replace(header=header.encode("latin-1")))
    return attributes.read_for_file(checked, names, lambda: move()[0])


def export_notes(checked: SplatObject, *, apply_transform: bool = False) -> list[str]:
    """Notes on an exported object; see `drift_notes`, `uneven_notes`."""
    uneven = uneven_notes(checked, world_matrix(checked.obj)) if apply_transform else []
    return [*drift_notes(checked), *uneven]


def find(name: str) -> bpy.types.Object:
    """The object of that name; else `RefineError` lists those with splats."""
    obj = bpy.context.scene.objects.get(name)
    if obj is None:
        names = [o.name for o in bpy.context.scene.objects if layout.looks_like_splats(o)]
        listed = ", ".join(names[:8]) or "none"
        raise RefineError(
            f"no object '{name}' in scene '{bpy.context.scene.name}' (splat objects: {listed})"
        )
    return obj


def add_levels(
    checked: SplatObject, levels: Sequence[Level], distance: float
) -> bpy.types.Collection:
    """Copy the original as an object for each level, ``_lod1`` and so on, in a new collection.
    Hidden, as all stand in one place; nothing is left on an error. `distance`: views to scene."""
    name = checked.obj.name
    collection = bpy.data.collections.new(f"{name} levels")
    try:
        bpy.context.scene.collection.children.link(collection)
        for level in levels:
            copy = checked.obj.copy()
            collection.objects.link(copy)
            copy.data = checked.obj.data.copy()
            copy.name = copy.data.name = f"{name}_lod{level.number}"
            bpy.context.view_layer.update()  # its place in the world
            group = [layout.check(copy)]
            apply(group, changes(frames_of(group), level.result))
            stats = {**level.facts(), "distance": distance}
            copy[LEVEL_STATS] = {key: value for key, value in stats.items() if value is not None}
            copy.select_set(False)
        for obj in bpy.data.objects:
            if obj.get(LEVEL_OF) == checked.obj:  # the new levels replace those made before
                del obj[LEVEL_OF]
        for obj in collection.objects:  # all stand in one place
            obj[LEVEL_OF] = checked.obj
            obj.hide_set(True)
            obj.hide_render = True
    except BaseException:
        made = list(collection.objects)
        bpy.data.batch_remove([*made, *(obj.data for obj in made), collection])
        raise
    return collection


def has_levels(obj: bpy.types.Object) -> bool:
    """Whether an object is a level, or has some."""
    return LEVEL_OF in obj or any(each.get(LEVEL_OF) == obj for each in bpy.data.objects)


def levels_of(obj: bpy.types.Object) -> list[bpy.types.Object]:
    """An object and its levels, finest first, from any of them; `RefineError` without levels."""
    original = obj.get(LEVEL_OF) or obj
    objects = [each for each in bpy.data.objects if each.get(LEVEL_OF) == original]
    # A copy of a level is none; its name sorts behind that of the level.
    levels = {each[LEVEL_STATS]["level"]: each for each in reversed(objects)}
    if not levels:
        raise RefineError(f"object '{obj.name}': has no levels; make them first")
    return [original, *(levels[number] for number in sorted(levels))]


def prune_object(
    name: str,
    views: ViewSet,
    budget: Budget,
    method: Method = DEFAULT,
    *,
    demands: Demands = NONE,
    output: Path | None = None,
    save: bool = False,
    pictures: PictureFiles | None = None,
    dry_run: bool = False,
    **how: Any,
) -> dict[str, Any]:
    """Prune an object of the open scene, export the result, save the .blend (`save`); the report.
    See `core.operations.prune_file`; `how`: `overwrite`, `progress`. On an error the object is
    unchanged; a file that was exported before it stays."""
    checked = layout.check(find(name))
    save = save and not dry_run
    method = possible([checked], method)
    # None: an uneven scale is not refused, since only the pictures would need harmonics.
    compares = method.name != "closed-form" or budget.psnr is not None or pictures is not None
    harmonics = True if method.changes else None if compares else False
    if save:
        edit.check_deletable(checked.obj)
        if not bpy.data.filepath:
            raise RefineError(
                "the scene is not saved in a .blend file yet: --save has nowhere to save to"
            )

    def saved(result: Result, exported: Path | None) -> None:
        (change,) = changes(frames_of([checked]), result)
        with edit.all_or_nothing([checked]):
            scores.store([checked], result.scores, method)
            reduce_object(checked, change)
            try:
                bpy.ops.wm.save_mainfile()
            except RuntimeError as error:
                why = f"{bpy.data.filepath}: cannot be saved ({str(error).strip()})"
                also = "" if exported is None else f", {exported} was written"
                raise RefineError(f"{why}; nothing was removed{also}") from error

    return run(
        lambda: _scene(checked, demands, harmonics),
        prune_scene(views, budget, method, reusable=save),
        output,
        dry_run=dry_run, views=views, pictures=pictures, save=saved if save else None, **how,
    ).report  # fmt: skip


def score_object(
    name: str, views: ViewSet, method: Method, demands: Demands = NONE, **how: Any
) -> dict[str, Any]:
    """Score an object of the open scene into a PLY, the scene unchanged; see `prune_object`.
    `how`: `output`, `overwrite`, `progress`."""
    checked = layout.check(find(name))
    return run(lambda: _scene(checked, demands, None), score_scene(views, method), **how).report


def _scene(checked: SplatObject, demands: Demands, harmonics: bool | None) -> Scene:
    """The object in the world, which is also the views' frame."""
    axes = checked.mesh.get(layout.AXES, "")
    return Scene(
        f"{bpy.data.filepath}#{checked.obj.name}",
        checked.layout.file_bytes(len(checked)),
        gather([checked], whole=harmonics),
        demands.of_each([checked])[0],
        lambda: replace(attributes.read_for_file(checked)(), axes=axes),
        attributes.file_size(checked),
        world_matrix(checked.obj),
        (*modifier_notes(checked.obj), *drift_notes(checked)),
    )
