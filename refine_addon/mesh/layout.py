"""Which attribute of a mesh holds which property of a 3DGS PLY file, and the check of an object.
"Mesh" means a mesh with a vertex for each splat, or a point cloud. Blender 5.3 imports 3DGS files
as point clouds of type ``GAUSSIAN_SPLAT``, with activated values under other names
(docs/conventions.md); they are recognized by their attributes, not by that type, so that output of
geometry nodes and older versions are, too."""

from __future__ import annotations

import json
import re
from collections.abc import Callable, Container, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Any, NamedTuple

import bpy
import numpy as np
from numpy.typing import NDArray

from ..core import RefineError
from ..core.formats.ply import new_header, stated_model, vertex_header, with_count, with_model
from ..core.formats.ply_columns import REQUIRED, REST_COUNTS, THIRD_SCALE
from ..core.splats import MODELS, Model, opacity, scales, single_log_scales, single_logits

BASE, SCALE, ROTATION, HARMONIC = "radiance:base", "scale", "rotation", "radiance:sh_"
NATIVE = "GAUSSIAN_SPLAT"  # Type of point clouds that Blender draws as splats, since 5.3
_NATIVE_NAMES = f"{BASE}, {SCALE}, {ROTATION}"
_FOUR_FLOATS = ("FLOAT4", "FLOAT_COLOR")  # Types of `BASE`: in 5.3, and in older versions
LAYOUT = "refine_layout"  # Custom property of the mesh: layout of its file, JSON
AXES = "refine_spz_axes"  # Custom property of the mesh: `SplatFile.axes` of what was imported
MODEL = "refine_model"  # Custom property of the mesh: one of `splats.MODELS`, set by the user


class Coding(NamedTuple):
    """Conversions between a file's values and those of an attribute, float64."""

    to_file: Callable[[NDArray[Any]], NDArray[Any]]
    to_attribute: Callable[[NDArray[Any]], NDArray[Any]]


_AS_IN_FILE = Coding(np.asarray, np.asarray)
_LOG = Coding(single_log_scales, scales)
_LOGIT = Coding(single_logits, opacity)


class Column(NamedTuple):
    """A PLY property, its type in the file as in ``"<f4"``, and its place: attribute, vector
    component (0 for scalars), allowed attribute types, coding."""

    name: str
    dtype: str
    attribute: str
    component: int
    kinds: tuple[str, ...]
    coding: Coding = _AS_IN_FILE


Place = tuple[Any, ...]  # The last fields of `Column`, from `attribute`
KINDS = {
    "FLOAT": ("value", np.float32, 1),
    "INT": ("value", np.int32, 1),
    "INT8": ("value", np.int8, 1),
    "BOOLEAN": ("value", np.bool_, 1),
    "FLOAT_VECTOR": ("vector", np.float32, 3),
    "FLOAT_COLOR": ("color", np.float32, 4),
    "FLOAT4": ("vector", np.float32, 4),
    "QUATERNION": ("value", np.float32, 4),
}
"""Type of an attribute -> field for `foreach_get`, type and number of the numbers in an element."""

STORAGE = dict.fromkeys(("u1", "i2", "u2", "i4", "u4"), "INT")
STORAGE |= {"i1": "INT8", "f4": "FLOAT", "f8": "FLOAT"}
"""Type of a PLY property -> type of its attribute; u4 is stored by its bits, f8 is rounded."""

PLACES = {name: ("position", axis, ("FLOAT_VECTOR",)) for axis, name in enumerate("xyz")}
"""Properties that are components of Blender's positions."""

NORMAL_PLACES = {f"n{axis}": ("normal", *at[1:]) for axis, at in PLACES.items()}
"""Where Blender's own PLY importer puts a file's normals."""

_LONGEST_NAME = 63  # Bytes of Blender's longest attribute name
_MOST_NAMES = 8  # Attribute names in an error message, at most

_TAKEN = {"position", "normal", "id", "radius", "material_index", "sharp_face", "crease_vert"}
"""Attribute names that mean something to Blender."""

VERTICAL_AXIS = re.compile(r"comment[ \t]+vertical axis:([^\r\n\\]*)(?:\r?\n|(?:\\r)?\\n)", re.I)
"""A comment that names a PLY's vertical axis, in a header or in JSON."""

_TYPES = ("MESH", "POINTCLOUD")
Data = bpy.types.Mesh | bpy.types.PointCloud


class Layout(NamedTuple):
    """Columns of a splat mesh in file order, and the file's header."""

    columns: tuple[Column, ...]
    header: bytes

    @property
    def row_dtype(self) -> np.dtype[Any]:
        """Type of a row of the file."""
        return _row(self.columns)

    def file_bytes(self, count: int) -> int:
        """Bytes of a file of so many splats, up to the digits of their number in the header."""
        return len(self.header) + self.row_dtype.itemsize * count

    def by_attribute(self, names: Container[str]) -> dict[str, list[Column]]:
        """The columns of these names, by the attribute that holds them."""
        parts: dict[str, list[Column]] = {}
        for column in self.columns:
            if column.name in names:
                parts.setdefault(column.attribute, []).append(column)
        return parts

    @property
    def model(self) -> Model:
        """How the splats are drawn, one of `splats.MODELS`."""
        return stated_model(self.header, self.row_dtype) or MODELS[0]


@dataclass(frozen=True)
class SplatObject:
    """A splat object that `check` accepted, and its layout.
    Valid until splats or attributes are added or removed."""

    obj: bpy.types.Object
    layout: Layout

    @property
    def mesh(self) -> Data:
        """The object's data."""
        return self.obj.data

    def __len__(self) -> int:
        return splat_count(self.obj.data)


def rows_of(counts: Iterable[int]) -> list[slice]:
    """Slices of each object's splats in the concatenated arrays of several."""
    ends = np.cumsum(list(counts)).tolist()
    return [slice(start, end) for start, end in zip([0, *ends[:-1]], ends, strict=True)]


_parsed = lru_cache(maxsize=16)(json.loads)  # panels read records at each redraw


def recorded(mesh: bpy.types.ID, name: str, read: Callable[[Any], Any]) -> Any:
    """`read` of a JSON record in a custom property; None where that fails, as another program may
    have written there. `read` must not change the record, which is cached."""
    try:
        return read(_parsed(mesh[name]))
    except (AttributeError, KeyError, StopIteration, TypeError, ValueError):
        return None


def has(mesh: bpy.types.ID, name: str, *kinds: str) -> bool:
    """Whether a mesh has a point attribute of one of these types."""
    attribute = mesh.attributes.get(name)
    return bool(attribute and attribute.data_type in kinds and attribute.domain == "POINT")


def splat_count(mesh: Data) -> int:
    """Splats of a mesh or a point cloud."""
    return len(mesh.points if hasattr(mesh, "points") else mesh.vertices)


def looks_like_splats(obj: bpy.types.Object | None) -> bool:
    """Whether an object seems to hold splats; cheap enough for a poll."""
    return obj is not None and obj.type in _TYPES and holds_splats(obj.data)


def holds_splats(data: Data) -> bool:
    """Whether an object's data seems to hold splats."""
    attributes = data.attributes
    return ("opacity" in attributes and "f_dc_0" in attributes) or is_native(data)


def changed_data(depsgraph: bpy.types.Depsgraph | None) -> Iterator[Data]:
    """Meshes and point clouds whose geometry an update of Blender's changed."""
    for update in depsgraph.updates if depsgraph else ():
        data = getattr(update.id.original, "data", update.id.original)
        if update.is_updated_geometry and isinstance(data, Data):
            yield data


def is_native(data: bpy.types.ID) -> bool:
    """Whether an object's data is a point cloud with the attributes of Blender's own splats."""
    attributes = getattr(data, "attributes", ())
    return hasattr(data, "points") and BASE in attributes and SCALE in attributes


def _native_places(data: Data) -> dict[str, Place]:
    """Property -> place in a point cloud of Blender's own splats; empty for other data.
    Each ``radiance:sh_*`` holds RGB of one harmonic; a file has all of red first."""
    if not is_native(data):
        return {}
    count = rest_count(data) // 3
    by_name = {"opacity": (BASE, 3, _FOUR_FLOATS, _LOGIT)}
    for axis in range(3):  # or channel: red, green, blue
        by_name[f"f_dc_{axis}"] = (BASE, axis, _FOUR_FLOATS)
        by_name[f"scale_{axis}"] = (SCALE, axis, ("FLOAT_VECTOR",), _LOG)
        for index in range(count):
            place = f"{HARMONIC}{index}", axis, ("FLOAT_VECTOR",)
            by_name[f"f_rest_{axis * count + index}"] = place
    for index in range(4):
        by_name[f"rot_{index}"] = (ROTATION, index, ("QUATERNION",))
    return by_name


def lost_base(obj: bpy.types.Object) -> bool:
    """Whether an object holds splats of Blender 5.3 whose `BASE` an older version dropped."""
    there = obj.data.attributes if obj.type == "POINTCLOUD" else ()
    return SCALE in there and ROTATION in there and "f_dc_0" not in there and BASE not in there


def check(obj: bpy.types.Object) -> SplatObject:
    """The object with the layout of its import, or the standard one.
    `RefineError` in edit mode, with four vertices a splat, or for a missing or wrong attribute."""
    label = f"object '{obj.name}'"
    if obj.type not in _TYPES:
        raise RefineError(
            f"{label}: is of type {obj.type}, expected a mesh or a point cloud that holds splats"
        )
    if obj.mode == "EDIT":
        raise RefineError(f"{label}: is in edit mode; leave edit mode first")
    if obj.get("3DGS_Mesh_Type") == "face":
        raise RefineError(
            f"{label}: KIRI's 'face' form has four vertices a splat, expected one; "
            "use its 'vert' form, or import the PLY file here"
        )
    if not splat_count(obj.data):
        points = "points" if obj.type == "POINTCLOUD" else "vertices"
        raise RefineError(f"{label}: has no {points}, expected one for each splat")
    if lost_base(obj):
        raise RefineError(
            f"{label}: has no attribute {BASE}, which holds colour and opacity: Blender 5.0 and "
            "older drop it when they open a file of 5.3; use 5.2 or later"
        )
    layout = layout_of(obj)
    attributes = obj.data.attributes
    absent = [c.attribute for c in layout.columns if c.attribute not in attributes]
    if absent:
        present = [a.name for a in attributes if a.domain == "POINT" and a.name[0] != "."]
        more = ", ..." if len(present) > _MOST_NAMES else ""
        or_native = f" or Blender's own {_NATIVE_NAMES}" if obj.type == "POINTCLOUD" else ""
        raise RefineError(
            f"{label}: has no attribute {', '.join(dict.fromkeys(absent))}; expected "
            f"the properties of a 3DGS file{or_native} on its points "
            f"(it has {', '.join(present[:_MOST_NAMES])}{more})"
        )
    for column in layout.columns:
        if not has(obj.data, column.attribute, *column.kinds):
            attribute = attributes[column.attribute]
            raise RefineError(
                f"{label}: attribute '{attribute.name}' is {attribute.data_type} on "
                f"{attribute.domain}, expected {' or '.join(column.kinds)} on POINT"
            )
    return SplatObject(obj, layout)


def layout_of(obj: bpy.types.Object) -> Layout:
    """Layout of a splat object, without a check of its attributes."""
    layout = _remembered(obj.data) or _standard(obj)
    model = obj.data.get(MODEL)
    if model in MODELS and THIRD_SCALE in (column.name for column in layout.columns):
        return layout._replace(header=with_model(layout.header, model))
    return layout


def sh_degree(mesh: bpy.types.Mesh) -> int:
    """Spherical-harmonics degree of a splat mesh, 0 to 4."""
    return REST_COUNTS.get(rest_count(mesh), 0)


def layout_if_any(obj: bpy.types.Object | None) -> Layout | None:
    """`layout_of`; None without splats, or where they cannot be exported."""
    try:
        return layout_of(obj) if looks_like_splats(obj) else None
    except RefineError:
        return None


def rest_count(mesh: bpy.types.Mesh) -> int:
    """Number of ``f_rest_*`` properties that a mesh has attributes for."""
    name, width = _harmonics(mesh)
    return width * sum(f"{name}{i}" in mesh.attributes for i in range(max(REST_COUNTS) // width))


def _harmonics(mesh: bpy.types.Mesh) -> tuple[str, int]:
    """How names of attributes with harmonics begin, and properties in each."""
    return (HARMONIC, 3) if is_native(mesh) else ("f_rest_", 1)


def _remembered(mesh: bpy.types.Mesh) -> Layout | None:
    """Layout that the import stored, None without one or if it is damaged."""
    places = _native_places(mesh)

    def read(record: Any) -> Layout | None:
        columns = tuple(
            Column(name, dtype, *(places.get(name) or _plain(dtype, attribute, component)))
            for name, dtype, attribute, component in record["columns"]
        )
        # Splats may have been deleted, and Join may have added harmonics of a higher degree.
        count, names = splat_count(mesh), [column.name for column in columns]
        layout = Layout(columns, with_count(record["header"].encode("latin-1"), count))
        rest = [n for i in range(rest_count(mesh)) if (n := f"f_rest_{i}") not in names]
        if rest:
            layout = _with_harmonics(layout, count, _floats(rest, places))
        complete = set(REQUIRED) <= {*(layout.row_dtype.names or ()), THIRD_SCALE}
        return layout if complete else None

    return recorded(mesh, LAYOUT, read)


def _with_harmonics(layout: Layout, count: int, rest: Sequence[Column]) -> Layout:
    """A layout with the columns `rest` after its other colours."""
    colors = [c.name.startswith(("f_dc_", "f_rest_")) for c in layout.columns]
    end = len(colors) - colors[::-1].index(True)
    columns = [*layout.columns[:end], *rest, *layout.columns[end:]]
    # All little-endian, as a header has one byte order.
    plain = tuple(column._replace(dtype=column.dtype.replace(">", "<")) for column in columns)
    header = new_header(_row(plain), count)
    comments = re.findall(rb"^(?:comment|obj_info)\b[^\r\n]*", layout.header, re.MULTILINE)
    first = header.index(b"element")
    header = header[:first] + b"".join(line + b"\n" for line in comments) + header[first:]
    return Layout(plain, header)


def _floats(names: Sequence[str], places: Mapping[str, Place]) -> list[Column]:
    return [Column(name, "<f4", *(places.get(name) or _plain("<f4", name))) for name in names]


def _plain(dtype: str, attribute: str, component: int = 0) -> Place:
    kind = "FLOAT_VECTOR" if attribute in ("position", "normal") else STORAGE[dtype[1:]]
    return attribute, component, (kind,)


def _standard(obj: bpy.types.Object) -> Layout:
    """The reference implementation's layout for the object's attributes."""
    attributes = obj.data.attributes
    rest = [f"f_rest_{index}" for index in range(rest_count(obj.data))]
    if len(rest) not in REST_COUNTS:
        name, width = _harmonics(obj.data)
        *counts, most = (each // width for each in REST_COUNTS)
        raise RefineError(
            f"object '{obj.name}': has {len(rest) // width} attributes {name}*, expected "
            f"{', '.join(map(str, counts))} or {most} of them (degree 0 to 4)"
        )
    folded = "nx" not in attributes and has(obj.data, "normal", "FLOAT_VECTOR")
    places = PLACES | _native_places(obj.data) | (NORMAL_PLACES if folded else {})
    normals = NORMAL_PLACES if folded or "nx" in attributes else ()
    names = [*PLACES, *normals, *REQUIRED[3:6], *rest, *REQUIRED[6:]]
    if THIRD_SCALE not in attributes and THIRD_SCALE not in places and "scale_1" in attributes:
        names.remove(THIRD_SCALE)
    columns = _floats(names, places)
    columns += _further_columns(obj.data, {*names, *(c.attribute for c in columns)})
    return Layout(tuple(columns), new_header(_row(columns), splat_count(obj.data)))


def _further_columns(mesh: bpy.types.Mesh, taken: set[str]) -> list[Column]:
    """Columns of other scalar point attributes, but for those of `taken` and of this add-on."""
    dtypes = {"FLOAT": "<f4", "INT": "<i4", "INT8": "<i1"}
    return [
        Column(attribute.name, dtype, *_plain(dtype, attribute.name))
        for attribute in mesh.attributes
        if (dtype := dtypes.get(attribute.data_type))
        and attribute.domain == "POINT"
        and attribute.name not in taken
        and re.fullmatch(r"(?!refine_|KIRI|\.)[!-~]+", attribute.name)
    ]


def add_attributes(mesh: bpy.types.Mesh, rows: np.dtype[Any], header: bytes) -> Layout:
    """Add an attribute for each property of a file, and store the layout; the layout."""
    columns = []
    for name in rows.names or ():
        kind, place = rows[name].str, PLACES.get(name)
        if place is None:
            plain = name not in _TAKEN and not name.startswith((".", "refine_"))
            plain = plain and len(name.encode()) <= _LONGEST_NAME
            other = f"ply_{name}".encode()[:_LONGEST_NAME].decode(errors="ignore")
            attribute = mesh.attributes.new(name if plain else other, STORAGE[kind[1:]], "POINT")
            attribute = attribute or mesh.attributes.new(other, STORAGE[kind[1:]], "POINT")
            place = _plain(kind, attribute.name)
        columns.append(Column(name, kind, *place))
    record = [[c.name, c.dtype, c.attribute, c.component] for c in columns]
    text = vertex_header(header).decode("latin-1")
    mesh[LAYOUT] = json.dumps({"header": text, "columns": record})
    return Layout(tuple(columns), header)


def forget_axis(mesh: bpy.types.ID) -> None:
    """Drop the vertical axis that the file named: the splats were moved."""
    if isinstance(text := mesh.get(LAYOUT), str):
        mesh[LAYOUT] = VERTICAL_AXIS.sub("", text)


def _row(columns: Sequence[Column]) -> np.dtype[Any]:
    return np.dtype([(column.name, column.dtype) for column in columns])
