"""Splats as point attributes of a mesh, with the names and values of the PLY properties.
Scales are logarithms, opacities logits, as Blender's PLY importer and KIRI's 3DGS Render (`vert`
form) store them too. Blender's own splats (5.3) are converted to such columns and back."""

from __future__ import annotations

import zlib
from collections import deque
from collections.abc import Callable, Collection, Mapping, Sequence
from pathlib import Path
from typing import Any

import bpy
import numpy as np
from numpy.typing import NDArray

from ..core.formats.ply import REQUIRED, SplatFile
from ..core.formats.ply_columns import THIRD_SCALE
from ..core.formats.registry import scene_name
from ..core.splats import Splats, single_unit_quaternions, with_model
from .layout import KINDS, Column, Layout, SplatObject, add_attributes, has, rest_count, splat_count

_GROUP = 16  # Columns transposed together: float32 numbers in a cache line of 64 bytes
_ROWS = 4096  # Rows transposed at a time: 256 kB, which fits a cache


def file_size(checked: SplatObject) -> tuple[int, int]:
    """Bytes of one splat in the exported file, and bytes of its header."""
    return checked.layout.row_dtype.itemsize, len(checked.layout.header)


def import_notes(source: SplatFile) -> tuple[str, ...]:
    """Sentences on the parts of a file that a mesh cannot hold."""
    notes = []
    names = source.rows.dtype.names or ()
    doubles = [name for name in names if source.rows.dtype[name].str[1:] == "f8"]
    if doubles:
        notes.append(
            f"{source.path.name}: {', '.join(doubles)} stored as double; "
            "Blender's attributes hold single precision"
        )
    if len(source.before) or len(source.after):
        notes.append(f"{source.path.name}: only the element 'vertex' was imported")
    return (*notes, *source.remarks)


def mesh_from_file(source: SplatFile) -> bpy.types.Mesh:
    """New mesh with a vertex for each splat and an attribute for each property."""
    rows = source.rows
    mesh = bpy.data.meshes.new(scene_name(source.path))
    try:
        mesh.vertices.add(len(rows))
        remove_attribute(mesh, ".select_vert")  # with which Blender selects all
        layout = add_attributes(mesh, rows.dtype, source.header)
        for names in _groups(layout):
            write_columns(mesh, layout, dict(zip(names, _planes(rows, names), strict=True)))
    except BaseException:
        bpy.data.meshes.remove(mesh)
        raise
    return mesh


def splats_from_object(checked: SplatObject, *, sh_rest: bool = True) -> Splats:
    """Splats of an object, in its own frame. Without `sh_rest` one coefficient replaces all above
    the constant: NaN if any is not finite, else 0. Scoring needs no more (saves 0.5 GB at 3 M)."""
    read = StoredColumns(checked)
    rest = [f"f_rest_{index}" for index in range(rest_count(checked.mesh))]
    count = len(checked)
    if sh_rest:
        planes = read.planes(rest).reshape(3, len(rest) // 3, count)
        coefficients = planes.transpose(2, 1, 0)
    else:
        finite = np.ones(count, np.bool_)
        for attribute in dict.fromkeys(read.columns[name].place.attribute for name in rest):
            values = np.isfinite(read_attribute(checked.mesh, attribute))
            finite &= values if values.ndim == 1 else values.all(axis=1)
        coefficients = np.where(finite, 0.0, np.nan).astype(np.float32)[:, None, None]
        coefficients = np.broadcast_to(coefficients, (count, 1, 3))
    flat = THIRD_SCALE not in read.columns
    scales = read.planes(["scale_0", "scale_1", "scale_1" if flat else THIRD_SCALE])
    splats = Splats(
        means=read_attribute(checked.mesh, "position"),
        log_scales=scales.T,
        quaternions=read.planes(["rot_0", "rot_1", "rot_2", "rot_3"]).T,
        opacity_logits=read.planes(["opacity"])[0],
        sh_dc=read.planes(["f_dc_0", "f_dc_1", "f_dc_2"]).T,
        sh_rest=coefficients,
    )
    return with_model(splats, checked.layout.model)


def read_for_file(
    checked: SplatObject,
    replaced: Collection[str] = (),
    columns: Callable[[], Mapping[str, NDArray[Any]]] = dict,
) -> Callable[[], SplatFile]:
    """Read the object now; the thread-safe callable builds its PLY file, once.
    Properties in `replaced` take the values that `columns` gives then, (N,) each."""
    name, layout, count = checked.obj.name, checked.layout, len(checked)
    read, groups = StoredColumns(checked), _groups(layout)
    stored = deque([None if n in replaced else read[n] for n in names] for names in groups)

    def file() -> SplatFile:
        rows, values = np.empty(count, layout.row_dtype), columns()
        for names in groups:
            pairs = zip(names, stored.popleft(), strict=True)  # freed once written
            _interleave(rows, names, [values.get(name, plane) for name, plane in pairs])
        no_elements = np.empty(0, np.uint8)
        return SplatFile(Path(name), rows, layout.header, no_elements, no_elements)

    return file


def write_columns(
    mesh: bpy.types.Mesh | bpy.types.PointCloud,
    layout: Layout,
    columns: Mapping[str, NDArray[Any]],
    rows: slice | NDArray[np.int64] = slice(None),
) -> None:
    """Store columns by PLY property, (M,) each, in M rows, by default all; others keep every bit.
    One attribute at a time, as allocating memory takes longest."""
    parts: dict[str, list[Column]] = {}
    for column in layout.columns:
        if column.name in columns:
            parts.setdefault(column.place.attribute, []).append(column)
    for attribute, own in parts.items():
        kind, values = mesh.attributes[attribute].data_type, read_attribute(mesh, attribute)
        components = values.reshape(len(values), -1)
        with np.errstate(over="ignore", under="ignore", invalid="ignore"):  # float64 to float32
            for column in own:
                new, coding = columns[column.name], column.place.coding
                new = coding.to_attribute(new) if coding else new
                components[rows, column.place.component] = new
        if kind == "QUATERNION":
            values[rows] = single_unit_quaternions(values[rows])
        write_attribute(mesh, attribute, kind, values)
    if columns:
        updated(mesh)


def updated(mesh: bpy.types.Mesh | bpy.types.PointCloud) -> None:
    """Tell Blender that attributes changed."""
    if isinstance(mesh, bpy.types.PointCloud):
        mesh.update_tag()
    else:
        mesh.update()


def read_attribute(mesh: bpy.types.Mesh, name: str) -> NDArray[Any]:
    """A point attribute, (N,), or (N, width) for vectors and colours."""
    attribute = mesh.attributes[name]
    kind = KINDS[attribute.data_type]
    values: NDArray[Any] = np.empty(len(attribute.data) * kind.width, kind.dtype)
    attribute.data.foreach_get(kind.field, values)
    return values if kind.width == 1 else values.reshape(-1, kind.width)


def attribute_if_any(mesh: bpy.types.Mesh, name: str, *kinds: str) -> NDArray[Any] | None:
    """A point attribute of one of these types, as `read_attribute` gives it; None without one."""
    return read_attribute(mesh, name) if has(mesh, name, *kinds) else None


def write_attribute(mesh: bpy.types.Mesh, name: str, data_type: str, values: NDArray[Any]) -> None:
    """Store a point attribute, unsigned integers by their bits, replacing one of another type or
    domain."""
    attribute = mesh.attributes.get(name)
    if not has(mesh, name, data_type):
        remove_attribute(mesh, name)
        attribute = mesh.attributes.new(name, data_type, "POINT")
    kind = KINDS[data_type]
    attribute.data.foreach_set(kind.field, np.ascontiguousarray(values, kind.dtype).ravel())


def digest(checked: SplatObject) -> int:
    """Checksum of an object's splats and model; harmonics above the constant do not count."""
    columns = (column for column in checked.layout.columns if column.name in REQUIRED)
    checksum = 0
    for name in dict.fromkeys(column.place.attribute for column in columns):
        checksum = zlib.crc32(read_attribute(checked.mesh, name).data, checksum)
    return zlib.crc32(checked.layout.model.encode(), checksum)


def remove_attribute(mesh: bpy.types.Mesh, name: str) -> None:
    """Remove an attribute if it exists."""
    attribute = mesh.attributes.get(name)
    if attribute:
        mesh.attributes.remove(attribute)


class StoredColumns:
    """Columns of a mesh by name, read on demand; caches the last vector attribute."""

    def __init__(self, checked: SplatObject) -> None:
        self.mesh = checked.mesh
        self.columns = {column.name: column for column in checked.layout.columns}
        self.vectors: dict[str, NDArray[np.float32]] = {}

    def __getitem__(self, name: str) -> NDArray[Any]:
        """A column with the file's values, (N,); unsigned integers by their bits.
        Values of Blender's own splats come in float64, so that writing them back changes none."""
        column = self.columns[name]
        place = column.place
        values = self.vectors.get(place.attribute)
        if values is None:
            values = read_attribute(self.mesh, place.attribute)
        if values.ndim > 1:
            self.vectors = {place.attribute: values}
            values = values[:, place.component].copy()  # alone in memory, without the others
        if place.coding:
            return place.coding.to_file(values)
        return values.view(np.uint32) if column.dtype[1:] == "u4" else values

    def planes(self, names: Sequence[str]) -> NDArray[np.float32]:
        """Columns as float32, (len(names), N)."""
        values = np.empty((len(names), splat_count(self.mesh)), np.float32)
        pairs = zip(values, names, strict=True)
        # Sorted by attribute, so that each vector attribute is read once.
        for row, name in sorted(pairs, key=lambda pair: self.columns[pair[1]].place.attribute):
            attribute = self.mesh.attributes[self.columns[name].place.attribute]
            if KINDS[attribute.data_type].width == 1:
                attribute.data.foreach_get("value", row)
            else:
                row[:] = self[name]
        return values


def _groups(layout: Layout) -> list[list[str]]:
    """Names of adjacent columns of one type, at most `_GROUP`, to be transposed together.
    One by one, each would read the whole file: a row fills several cache lines."""
    groups: list[list[str]] = []
    dtype = ""
    for column in layout.columns:
        if column.dtype != dtype or len(groups[-1]) == _GROUP:
            groups.append([])
        groups[-1].append(column.name)
        dtype = column.dtype
    return groups


def _block(rows: NDArray[Any], names: Sequence[str]) -> NDArray[Any]:
    """View of adjacent columns of one type, (N, len(names))."""
    first = rows[names[0]]
    shape, strides = (len(rows), len(names)), (rows.strides[0], first.itemsize)
    return np.lib.stride_tricks.as_strided(first, shape, strides, writeable=first.flags.writeable)


def _planes(rows: NDArray[Any], names: Sequence[str]) -> NDArray[Any]:
    """Adjacent columns, (len(names), N), in native byte order."""
    block = _block(rows, names)
    planes = np.empty(block.shape[::-1], block.dtype.newbyteorder("="))
    for start in range(0, len(rows), _ROWS):
        planes[:, start : start + _ROWS] = block[start : start + _ROWS].T
    return planes


def _interleave(rows: NDArray[Any], names: Sequence[str], planes: Sequence[NDArray[Any]]) -> None:
    """Write columns into rows; inverse of `_planes`."""
    block = _block(rows, names)
    for start in range(0, len(rows), _ROWS):
        for index, plane in enumerate(planes):
            block[start : start + _ROWS, index] = plane[start : start + _ROWS]
