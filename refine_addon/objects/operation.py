"""What the command does with an object: a source and a sink of `core.operation`."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import bpy

from ..cameras.objects import world_matrix
from ..core.errors import RefineError
from ..core.execute import Progress, silent
from ..core.formats.format import Format
from ..core.operation.files import FileSink
from ..core.operation.loaded import Loaded, RowSizes
from ..core.operation.requests import PruneRequest, ScoreRequest
from ..core.operation.run import Runtime, Written, run
from ..core.task import Result
from ..core.whole_file import expanded
from ..mesh import attributes as mesh_attributes
from ..mesh import edit as mesh_edit
from ..mesh import layout as mesh_layout
from ..mesh.layout import SplatObject, check
from ..mesh.scores import Provenance, store
from .demands import NONE, Demands
from .splat_object import (
    can_become,
    changed,
    drift_notes,
    find,
    frame_of,
    gather,
    modifier_notes,
    reduce_object,
)


def prune_object(
    name: str,
    request: PruneRequest,
    demands: Demands = NONE,
    *,
    output: Path | None = None,
    save: bool = False,
    progress: Progress = silent,
) -> dict[str, Any]:
    """Prune an object of the open scene, export what stays, save the .blend.

    Parameters
    ----------
    name : str
        Of the object.
    request : PruneRequest
        What is asked; its zones count besides those of `demands`.
    demands : Demands
        What must stay and what must go.
    output : Path, optional
        The file to make, in the format that its suffix names.
    save : bool
        Whether to delete the splats from the object and save the .blend.
    progress : callable, optional
        See `refine_addon.core.execute.Progress`.

    Returns
    -------
    dict
        The report, as of `refine_addon.core.prune_file`.

    Raises
    ------
    RefineError
        See `refine_addon.core.operation.run`, `ObjectSource` and `ObjectSink`; also if there is no
        such object. What was exported by then stays; the object is as it was.
    """
    checked = check(find(name))
    save = save and not request.dry_run
    request = replace(request, survivors=can_become([checked], request.survivors))
    # Where the scale is uneven there are no pictures, for which it is not refused.
    harmonics = True if request.absorb else None if request.compares_pictures else False
    demands += Demands(zones=tuple(request.zones))
    source = ObjectSource(checked, demands, harmonics=harmonics, reusable=save)
    target = None if output is None else expanded(output)
    file = FileSink(target, overwrite=request.overwrite, dry_run=request.dry_run)
    return run(source, request, ObjectSink(checked, request, file, save), progress=progress).report


def score_object(
    name: str,
    request: ScoreRequest,
    demands: Demands = NONE,
    *,
    output: Path,
    progress: Progress = silent,
) -> dict[str, Any]:
    """Score an object of the open scene, and write it to a PLY; nothing in the scene changes.

    Parameters
    ----------
    name, demands, progress
        See `prune_object`.
    request : ScoreRequest
        What is asked; its zones count besides those of `demands`.
    output : Path
        The file to make.

    Returns
    -------
    dict
        The report, as of `refine_addon.core.score_file`.

    Raises
    ------
    RefineError
        See `refine_addon.core.operation.run` and `ObjectSource`; also if there is no such object.
    """
    source = ObjectSource(check(find(name)), demands + Demands(zones=tuple(request.zones)))
    sink = FileSink(expanded(output), overwrite=request.overwrite)
    return run(source, request, sink, progress=progress).report


@dataclass(frozen=True, eq=False)
class ObjectSource:
    """Splats of an object of the open scene, as they stand in the world.

    Attributes
    ----------
    checked : SplatObject
    demands : Demands
        What must stay and what must go.
    harmonics : bool or None
        Whether to bring view-dependent colour along; see `gather`.
    reusable : bool
        Whether the scores are kept.
    """

    checked: SplatObject
    demands: Demands
    harmonics: bool | None = False
    reusable: bool = False

    def read(self, form: Format | None) -> Loaded:
        """Read the object; the frame of the views is the world.

        Raises
        ------
        RefineError
            See `gather` and `Demands.forced`.
        """
        checked = self.checked
        row, fixed = mesh_attributes.file_size(checked)
        return Loaded(
            name=f"{bpy.data.filepath}#{checked.obj.name}",
            bytes=row * len(checked) + fixed,
            splats=gather(checked, whole=self.harmonics),
            forced=self.demands.forced(checked),
            sizes=self._sizes(form) if form else RowSizes(row, fixed),
            stored=mesh_attributes.stored_columns(checked),
            file=lambda: mesh_attributes.file_from_object(checked),
            matrix=world_matrix(checked.obj, bpy.context.evaluated_depsgraph_get()),
            notes=(*modifier_notes(checked.obj), *drift_notes(checked)),
            reusable=self.reusable,
        )

    def _sizes(self, form: Format) -> RowSizes:
        """Return the bytes of the splats in another format than plain PLY."""
        degree = mesh_layout.sh_degree(self.checked.mesh)
        count, degree = len(self.checked), min(degree, form.degree)
        return RowSizes(*form.sizes(count, degree)) if form.sizes else RowSizes(0.0, 0)


@dataclass(frozen=True, eq=False)
class ObjectSink:
    """A file to be made of what stays of an object; if it is saved, also the object itself.

    Attributes
    ----------
    checked : SplatObject
    request : PruneRequest
    file : FileSink
    save : bool
        Whether to delete the splats from the object and save the .blend.
    """

    checked: SplatObject
    request: PruneRequest
    file: FileSink
    save: bool
    timing: str = "write_s"

    @property
    def form(self) -> Format | None:
        """The format of the file."""
        return self.file.form

    @contextlib.contextmanager
    def opened(self) -> Iterator[None]:
        """Refuse a file that cannot be written, and an object that cannot be saved.

        Raises
        ------
        RefineError
            See `FileSink.opened` and `mesh.edit.check_deletable`.
        """
        with self.file.opened():
            if self.save:
                mesh_edit.check_deletable(self.checked.obj)
                if not bpy.data.filepath:
                    raise RefineError(
                        "the scene is not saved in a .blend file yet: --save has nowhere to save to"
                    )
            yield

    def write(self, loaded: Loaded, result: Result, runtime: Runtime) -> Written:
        """Write the file; then delete what goes, store the scores, and save.

        Raises
        ------
        RefineError, Cancelled
            See `FileSink.write`; also if the .blend cannot be saved. The file stays then, and the
            object is as it was.
        """
        if self.save and result.stopped is not None:  # nothing is saved over what was not finished
            raise result.stopped
        written = self.file.write(loaded, result, runtime)
        if self.save:
            change = changed(frame_of(self.checked), result.keep, result.absorbed)
            with mesh_edit.all_or_nothing(self.checked.obj):
                store(self.checked, result.scores, Provenance(self.request.settings))
                reduce_object(self.checked, change)
                _save(written.path)
        return written


def _save(exported: Path | None) -> None:
    """Save the .blend."""
    try:
        bpy.ops.wm.save_mainfile()
    except RuntimeError as error:
        msg = f"{bpy.data.filepath}: cannot be saved ({str(error).strip()}); nothing was removed"
        if exported is not None:
            msg += f", {exported} was written"
        raise RefineError(msg) from error
