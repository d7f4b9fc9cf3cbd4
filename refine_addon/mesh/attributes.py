"""Splats as point attributes of a mesh, with the names and values of the PLY properties.
Scales are logarithms, opacities logits, as Blender's PLY importer and KIRI's 3DGS Render (`vert`
form) store them too. Blender's own splats (5.3) are converted to such columns and back."""

from __future__ import annotations

import zlib
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import bpy
import numpy as np
from numpy.typing import NDArray

from ..core.execute import chunks
from ..core.formats.ply import REQUIRED, SplatFile
from ..core.formats.ply_columns import THIRD_SCALE
from ..core.formats.registry import scene_name
from ..core.splats import Splats, single_unit_quaternions, with_model
from .layout import KINDS, Data, Layout, SplatObject, add_attributes, has, rest_count

Columns = Mapping[str, NDArray[Any]]  # By PLY property, (N,) each
_TOGETHER = 16  # Columns read together: float32 numbers in a cache line of 64 bytes
_ROWS = 4096  # Rows copied at a time: 256 kB of such columns, which fits a cache


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
        layout, names = add_attributes(mesh, rows.dtype, source.header), rows.dtype.names
        for part in chunks(len(names), _TOGETHER):
            columns = {name: np.empty_like(rows[name]) for name in names[part]}
            _copy([(columns[name], rows[name]) for name in columns])
            write_columns(mesh, layout, columns)
    except BaseException:
        bpy.data.meshes.remove(mesh)
        raise
    return mesh


def splats_from_object(checked: SplatObject, *, sh_rest: bool = True) -> Splats:
    """Splats of an object, in its own frame. Without `sh_rest` one coefficient replaces all above
    the constant: NaN if any is not finite, else 0. Scoring needs no more (saves 0.5 GB at 3 M)."""
    rest = [f"f_rest_{index}" for index in range(rest_count(checked.mesh))]
    count = len(checked)
    if sh_rest:
        planes = read_planes(checked, rest).reshape(3, len(rest) // 3, count)
        coefficients = planes.transpose(2, 1, 0)
    else:
        finite = np.ones(count, np.bool_)
        for _, values in read_columns(checked, rest):
            finite &= np.isfinite(values)
        coefficients = np.where(finite, 0.0, np.nan).astype(np.float32)[:, None, None]
        coefficients = np.broadcast_to(coefficients, (count, 1, 3))
    splats = Splats(
        means=read_attribute(checked.mesh, "position"),
        log_scales=read_planes(checked, ["scale_0", "scale_1", THIRD_SCALE]).T,
        quaternions=read_planes(checked, ["rot_0", "rot_1", "rot_2", "rot_3"]).T,
        opacity_logits=read_planes(checked, ["opacity"])[0],
        sh_dc=read_planes(checked, ["f_dc_0", "f_dc_1", "f_dc_2"]).T,
        sh_rest=coefficients,
    )
    return with_model(splats, checked.layout.model)


def read_for_file(
    checked: SplatObject, replaced: Collection[str] = (), columns: Callable[[], Columns] = dict
) -> Callable[[], SplatFile]:
    """Read the object now; the thread-safe callable builds its PLY file, once.
    Properties in `replaced` take the values that `columns` gives then, (N,) each."""
    name, layout, count = checked.obj.name, checked.layout, len(checked)
    kept = {column.name for column in layout.columns} - set(replaced)
    stored = dict(read_columns(checked, kept))

    def file() -> SplatFile:
        rows, names = np.empty(count, layout.row_dtype), layout.row_dtype.names
        stored.update(columns())
        for part in chunks(len(names), _TOGETHER):
            _copy([(rows[name], stored.pop(name)) for name in names[part]])  # freed once written
        no_elements = np.empty(0, np.uint8)
        return SplatFile(Path(name), rows, layout.header, no_elements, no_elements)

    return file


def write_columns(
    mesh: Data, layout: Layout, columns: Columns, rows: slice | NDArray[np.int64] = slice(None)
) -> None:
    """Store columns by PLY property, (M,) each, in M rows, by default all; others keep every bit.
    One attribute at a time, as allocating memory takes longest."""
    for attribute, own in layout.by_attribute(columns).items():
        kind, values = mesh.attributes[attribute].data_type, read_attribute(mesh, attribute)
        components = values.reshape(len(values), -1)
        with np.errstate(over="ignore", under="ignore", invalid="ignore"):  # float64 to float32
            for column in own:
                coded = column.coding.to_attribute(columns[column.name])
                components[rows, column.component] = coded
        if kind == "QUATERNION":
            values[rows] = single_unit_quaternions(values[rows])
        write_attribute(mesh, attribute, kind, values)
    if columns:
        updated(mesh)


def updated(mesh: Data) -> None:
    """Tell Blender that attributes changed."""
    if isinstance(mesh, bpy.types.PointCloud):
        mesh.update_tag()
    else:
        mesh.update()


def read_field(items: Any, field: str, dtype: type, width: int = 1) -> NDArray[Any]:
    """A field of all items of a Blender collection, (N,), or (N, width) for vectors and colours."""
    values: NDArray[Any] = np.empty(len(items) * width, dtype)
    items.foreach_get(field, values)
    return values if width == 1 else values.reshape(-1, width)


def read_triangles(mesh: bpy.types.Mesh) -> tuple[NDArray[np.float32], NDArray[np.int32]]:
    """Vertices, (V, 3), and triangles, (T, 3), of a mesh."""
    mesh.calc_loop_triangles()
    places = read_field(mesh.vertices, "co", np.float32, 3)
    return places, read_field(mesh.loop_triangles, "vertices", np.int32, 3)


def read_attribute(mesh: bpy.types.Mesh, name: str) -> NDArray[Any]:
    """A point attribute, as `read_field` gives it."""
    attribute = mesh.attributes[name]
    return read_field(attribute.data, *KINDS[attribute.data_type])


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
    field, dtype, _ = KINDS[data_type]
    attribute.data.foreach_set(field, np.ascontiguousarray(values, dtype).ravel())


def digest(checked: SplatObject) -> int:
    """Checksum of an object's splats and model; harmonics above the constant do not count."""
    checksum = 0
    for name in checked.layout.by_attribute(REQUIRED):
        checksum = zlib.crc32(read_attribute(checked.mesh, name).data, checksum)
    return zlib.crc32(checked.layout.model.encode(), checksum)


def remove_attribute(mesh: bpy.types.Mesh, name: str) -> None:
    """Remove an attribute if it exists."""
    attribute = mesh.attributes.get(name)
    if attribute:
        mesh.attributes.remove(attribute)


def read_columns(
    checked: SplatObject, names: Collection[str]
) -> Iterator[tuple[str, NDArray[Any]]]:
    """Columns of these names with the file's values, (N,) each, unsigned integers by their bits.
    Values of Blender's own splats come in float64, so that writing them back changes none."""
    for attribute, columns in checked.layout.by_attribute(names).items():
        values = read_attribute(checked.mesh, attribute)
        for column in columns:
            alone = values[:, column.component].copy() if values.ndim > 1 else values  # in memory
            own = column.coding.to_file(alone)
            yield column.name, own.view(np.uint32) if column.dtype[1:] == "u4" else own


def read_planes(checked: SplatObject, names: Sequence[str]) -> NDArray[np.float32]:
    """Columns as float32, (len(names), N); 0 where the object has none."""
    planes = np.zeros((len(names), len(checked)), np.float32)
    for name, values in read_columns(checked, names):
        planes[names.index(name)] = values
    return planes


def _copy(pairs: Sequence[tuple[NDArray[Any], NDArray[Any]]]) -> None:
    """Copy columns, (N,) each, of which some lie in the rows of a file: ``(target, source)``.
    Piece by piece, as one by one they would each pass through the whole file."""
    for piece in chunks(len(pairs[0][0]), _ROWS):
        for target, source in pairs:
            target[piece] = source[piece]
