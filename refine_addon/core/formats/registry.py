"""All splat formats: that of an input by its content, that of an output by its suffix."""

from __future__ import annotations

import tempfile
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ..affine import AXES, UNKNOWN_AXES, turned
from ..errors import RefineError
from ..mapped import file_bytes
from ..place import Place, refuse_pointer
from ..splats import Model, Splats, assign, drawable
from ..whole_file import Url, expanded, whole_file
from . import by_name, compressed_ply, glb, sog, spz, streamed_sog
from .format import Format
from .ply import SplatFile, read_plain
from .ply_columns import Changed, Changes, Keep, other_properties, splats_from_columns

# ``.splat`` comes last, since only its name tells it from others.
FORMATS = (compressed_ply.FORMAT, spz.FORMAT, glb.FORMAT, sog.FORMAT, by_name.SPLAT)
"""Formats that are written, but for plain PLY."""

# Streamed SOG comes before SOG: ``lod-meta.json`` ends in ``meta.json``.
READERS = (*FORMATS, by_name.KSPLAT, glb.READER, streamed_sog.READER, sog.META_READER)
"""Formats that are read, but for plain PLY, in the order in which an input is tried."""

SUFFIXES = (".ply", *(form.suffix for form in FORMATS))  # of outputs
READ_SUFFIXES = (".ply", *(form.suffix for form in READERS))  # of inputs
INDEX_NAMES = (streamed_sog.INDEX, sog.META)  # files that stand for their folder
NOT_WRITTEN: tuple[str, ...] = (".lcc", ".gz", ".bz2", ".xz", ".zst", ".zip")
NOT_WRITTEN += tuple(form.suffix for form in READERS if form.write is None)
"""Suffixes of outputs that are refused: a PLY of such a name would mislead."""

_HEAD = 1 << 16  # first bytes, which identify the format; the header of a compressed PLY has fewer


def read_splats(
    path: Path | str, model: Model | None = None, level: int = 0, axes: str | None = None
) -> SplatFile:
    """Open a file of splats of any format, recognised by its content.

    A plain PLY is mapped. Other formats become the plain PLY of the same splats, in memory.

    Parameters
    ----------
    path : path-like, ``~`` is the home folder
    model : {"default", "antialiased", "2dgs"}, optional; overrides what the file states
    level : int, of a streamed SOG, 0 is the finest; other files have only 0
    axes : {"rub", "rdf"}, optional
        Axes of an SPZ that does not name its own, and of those written of this file: y up and z
        back, for which splats are turned, or as they stand.

    Returns
    -------
    SplatFile

    Raises
    ------
    RefineError : if the file is missing, damaged, of no format that is read, or lacks the level
    """
    if axes not in (None, *AXES):
        raise RefineError(f"axes is {axes!r}, expected one of {', '.join(AXES)}")
    path = expanded(path)
    data = file_bytes(path)
    head = data[:_HEAD].tobytes()
    refuse_pointer(path, head)
    form = next((form for form in READERS if form.matches(path, head)), None)
    if level and form is not streamed_sog.READER:
        raise RefineError(f"{path}: has no level {level}: only {streamed_sog.INDEX} has levels")
    if form is None:
        return replace(read_plain(path, data).drawn_as(model), axes=axes or "")
    file = streamed_sog.read(path, data, level) if level else form.read(path, data)
    file = file.drawn_as(model).without_third_scale()
    named = file.axes.strip(UNKNOWN_AXES)
    if named or (file.axes and axes == AXES[0]):
        return turned_from(named or AXES[0], file, "as it says" if named else "as asked")
    return replace(file, axes=axes or file.axes)


def turned_from(axes: str, file: SplatFile, why: str) -> SplatFile:
    """An SPZ whose axes have these letters, turned in place to those of a PLY."""
    assign(file.splats(), turned(file.splats(), axes))  # views of the rows
    remark = f"{file.path.name}: brought from axes {axes.upper()} to those of a PLY, RDF, {why}"
    return replace(file, axes=AXES[0], remarks=(*file.remarks, remark))


def format_named(path: Path | Url) -> Format | None:
    """Format of an output by its name, None for plain PLY; `RefineError` if it is not written."""
    name = path.name.lower()
    form = next((form for form in FORMATS if name.endswith(form.suffix)), None)
    if form is None and name.endswith(NOT_WRITTEN):
        levels = "holds levels, which lod makes;" if name.endswith(streamed_sog.INDEX) else ""
        problem = levels or f"{path.suffix} is not written,"
        raise RefineError(f"{path}: {problem} expected one of {', '.join(SUFFIXES)}")
    return form


def names_file(path: Path | Url) -> bool:
    """Whether an output is named like a file of splats; other names are those of folders."""
    return path.name.lower().endswith((*SUFFIXES, *NOT_WRITTEN))


def without_suffix(name: str) -> str:
    """File name without the suffix of a splat format, if it has one."""
    ends = (end for end in READ_SUFFIXES if name.lower().endswith(end))
    return name[: len(name) - len(max(ends, key=len, default=""))]


def scene_name(path: Path) -> str:
    """Name of the scene in a file: that of the file, or for an index that of its folder.

    >>> from pathlib import Path
    >>> [scene_name(Path(name)) for name in ("a/b.compressed.ply", "a/b", "a/lod-meta.json")]
    ['b', 'b', 'a']
    """
    name = without_suffix(path.name)
    return name or path.absolute().parent.name or path.name


def write_splats(
    path: Path | str,
    file: SplatFile,
    keep: Keep = None,
    *,
    columns: Changes = None,
    overwrite: bool = False,
    threads: int | None = 1,
) -> None:
    """Write the kept splats of a file in the format that the suffix of `path` names.

    A plain PLY keeps all properties. Other formats leave out splats that cannot be drawn.

    Parameters
    ----------
    path, keep, columns, overwrite : see `SplatFile.write`
    file : SplatFile
    threads : int, optional

    Raises
    ------
    RefineError
        See `SplatFile.write`; also if a format is not written, lacks a property of `columns`, or no
        kept splat can be drawn.

    Examples
    --------
    To make an SPZ file of every other splat::

        file = read_splats("in.ply")
        write_splats("out.spz", file, np.arange(len(file)) % 2 == 0)
    """
    path = expanded(path)
    form = format_named(path)
    if form is None or form.write is None:
        file.write(path, keep, columns=columns, overwrite=overwrite, threads=threads)
        return
    splats = held_splats(path, form, file, keep, columns)
    with whole_file(path, overwrite=overwrite) as stream:
        form.write(stream, splats)


def held_splats(path: Path, form: Format, file: SplatFile, keep: Keep, columns: Changes) -> Splats:
    """Splats that an output in a format gets, see `write_splats`; errors name `path`."""
    rows = file.rows if keep is None else file.rows[keep]
    if columns:
        kept = np.arange(len(file)) if keep is None else np.flatnonzero(keep)
        if not isinstance(columns, Changed):
            columns = Changed(kept, {name: values[kept] for name, values in columns.items()})
        rows, some = rows.copy(), np.searchsorted(kept, columns.rows)
        for name, values in columns.columns.items():
            if name not in (rows.dtype.names or ()):
                Place(path).fail(f"{form.suffix} holds no property '{name}'; write to a .ply")
            with np.errstate(over="ignore", under="ignore"):  # doubles beyond float32
                rows[name][some] = values
    splats = splats_from_columns(rows, file.model)
    good = drawable(splats)
    if not good.any():
        Place(path).fail(f"none of the {len(splats)} splats can be drawn: nothing to write")
    splats = (splats if good.all() else splats.take(good)).up_to_degree(form.degree)
    return turned(splats, AXES[0]) if form is spz.FORMAT and file.axes == AXES[0] else splats


def written_size(file: SplatFile, form: Format | None, keep: Keep, columns: Changes = None) -> int:
    """Bytes that `write_splats` would write; but for a plain PLY they are written and dropped."""
    if form is None or form.write is None:
        return file.size(keep, columns)
    with tempfile.TemporaryFile() as stream:
        form.write(stream, held_splats(file.path, form, file, keep, columns))
        return stream.seek(0, 2)  # to its end


def losses(file: SplatFile, form: Format | None, keep: NDArray[np.bool_]) -> tuple[int, list[str]]:
    """Number of kept splats that a format leaves out, and sentences for the user about writing.

    Only plain PLY holds splats that cannot be drawn.
    """
    if form is None:
        kept = "beside the splats is kept as it is; its indices may point past the end"
        indexing = () if keep.all() else file.indexing
        return 0, [*file.remarks, *(f"element '{name}' {kept}" for name in indexing)]
    splats, suffix, model = file.splats(), form.suffix, file.model
    good, degree = keep & drawable(splats), splats.sh_degree
    lost = int(np.count_nonzero(keep & ~good))
    extra = other_properties(file.rows.dtype.names or ())
    moved = form.moves(splats.means[good]) if form.moves and good.any() else 0.0
    held = f"{suffix} holds harmonics of degree {form.degree}, the file has degree {degree}"
    stated = f"{suffix} does not say that splats are {model}: say so when it is read (model)"
    up, is_spz = file.axes == AXES[0], form is spz.FORMAT
    said = {
        f"{suffix} {form.loss} (docs/conventions.md, Formats)": True,
        f"{suffix} moves splats by up to {moved:.3g}, those beside an outlier farthest": moved,
        f"{held}: the others are left out": degree > form.degree,
        stated: model not in form.models,
        f"{suffix} does not hold {', '.join(extra)}: left out": extra,
        f"{lost} of the kept splats cannot be drawn and {suffix} cannot hold them: left out": lost,
        f"coordinates go to {suffix} turned to y up and z back": is_spz and up,
        f"coordinates go to {suffix} as they stand, y up is documented": is_spz and not up,
    }
    return lost, [*file.remarks, *(sentence for sentence, applies in said.items() if applies)]
