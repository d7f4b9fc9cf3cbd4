"""The command's operations on an object of the open scene."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import bpy

from ..cameras.objects import world_matrix
from ..core.errors import RefineError
from ..core.execute import Progress, silent
from ..core.formats.format import Format
from ..core.formats.registry import refuse_unknown_size
from ..core.methods import DEFAULT, Method
from ..core.operations import Scene, prune_scene, run, score_scene
from ..core.pictures import PictureFiles
from ..core.result import Result
from ..core.selection import Budget
from ..core.views import ViewSet
from ..core.whole_file import expanded
from ..mesh import attributes as mesh_attributes
from ..mesh import edit as mesh_edit
from ..mesh import layout as mesh_layout
from ..mesh.layout import SplatObject, check
from ..mesh.scores import store
from .demands import NONE, Demands
from .splat_group import (
    changes,
    drift_notes,
    find,
    frames_of,
    gather,
    modifier_notes,
    possible,
    reduce_object,
)


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
    overwrite: bool = False,
    dry_run: bool = False,
    progress: Progress = silent,
) -> dict[str, Any]:
    """Prune an object of the open scene, export the result, save the .blend (`save`); the report.
    See `core.operations.prune_file`. On an error an exported file and the object stay."""
    checked = check(find(name))
    save = save and not dry_run
    method = possible([checked], method)
    # Where the scale is uneven there are no pictures, for which it is not refused.
    compares = method.name != "closed-form" or budget.psnr is not None or pictures is not None
    harmonics = True if method.changes else None if compares else False
    target = None if output is None else expanded(output)
    if budget.max_mb is not None:
        refuse_unknown_size(target)
    if save:
        mesh_edit.check_deletable(checked.obj)
        if not bpy.data.filepath:
            raise RefineError(
                "the scene is not saved in a .blend file yet: --save has nowhere to save to"
            )

    def saved(result: Result, exported: Path | None) -> None:
        (change,) = changes(frames_of([checked]), result)
        with mesh_edit.all_or_nothing(checked.obj):
            assert result.scores is not None
            store(checked, result.scores, method)
            reduce_object(checked, change)
            _save(exported)

    return run(
        lambda form: _scene(checked, demands, harmonics, form),
        prune_scene(views, budget, method, reusable=save),
        target,
        overwrite=overwrite, dry_run=dry_run, views=views, pictures=pictures,
        save=saved if save else None, progress=progress,
    ).report  # fmt: skip


def score_object(
    name: str,
    views: ViewSet,
    method: Method,
    demands: Demands = NONE,
    *,
    output: Path,
    overwrite: bool = False,
    progress: Progress = silent,
) -> dict[str, Any]:
    """Score an object of the open scene into a PLY, the scene unchanged; see `prune_object`."""
    checked = check(find(name))
    return run(
        lambda form: _scene(checked, demands, None, form), score_scene(views, method),
        expanded(output), overwrite=overwrite, progress=progress,
    ).report  # fmt: skip


def _scene(
    checked: SplatObject, demands: Demands, harmonics: bool | None, form: Format | None
) -> Scene:
    """The object in the world, which is also the views' frame."""
    row, fixed = mesh_attributes.file_size(checked)
    sizes: tuple[float, int] = (row, fixed)
    if form is not None:
        degree = min(mesh_layout.sh_degree(checked.mesh), form.degree)
        sizes = form.sizes(len(checked), degree) if form.sizes else (0.0, 0)
    return Scene(
        f"{bpy.data.filepath}#{checked.obj.name}",
        row * len(checked) + fixed,
        gather([checked], whole=harmonics),
        demands.forced(checked),
        lambda: mesh_attributes.file_from_object(checked),
        sizes,
        world_matrix(checked.obj, bpy.context.evaluated_depsgraph_get()),
        (*modifier_notes(checked.obj), *drift_notes(checked)),
    )


def _save(exported: Path | None) -> None:
    try:
        bpy.ops.wm.save_mainfile()
    except RuntimeError as error:
        msg = f"{bpy.data.filepath}: cannot be saved ({str(error).strip()}); nothing was removed"
        if exported is not None:
            msg += f", {exported} was written"
        raise RefineError(msg) from error
