"""Binary glTF (``.glb``) with KHR_gaussian_splatting: plain accessors, activated values.

A primitive of points has float positions, rotations x y z w, linear scales, opacities of 0..1 and
harmonics as attributes. glTF's y points up where that of captures points down: both are turned half
about z into each other, which changes signs only. What nodes do to a primitive is applied.
"""

from __future__ import annotations

import json
from dataclasses import dataclass, fields
from typing import TYPE_CHECKING, Any

import numpy as np

from ..affine import transformed
from ..errors import RefineError
from ..splats import (
    SINGLE_MARGIN,
    Splats,
    base_color,
    opacity,
    opacity_logits,
    rotation_matrices,
    scales,
    unit_quaternions,
)
from .format import Format, Sizes, codes, new_file, pieces
from .glb_document import (
    BINARY,
    CHUNK,
    HEADER,
    JSON,
    KINDS,
    MAGIC,
    SHAPES,
    VERSION,
    Document,
    opened,
    shown,
)
from .ply import Origin, SplatFile

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator
    from pathlib import Path
    from typing import BinaryIO

    from numpy.typing import NDArray

NAME = "GLB"
EXTENSION = "KHR_gaussian_splatting"

_LONGEST = (1 << 32) - 1
_DEGREES = 3

_FLOAT, _BYTE = 5126, 5121
_POINTS, _VERTICES = 0, 34962

_HALF_TURN = np.diag([-1.0, -1.0, 1.0, 1.0])
"""Between the frame of captures and that of glTF, either way."""

_TRANSLATION, _ROTATION, _SCALE = (0.0, 0.0, 0.0), (0.0, 0.0, 0.0, 1.0), (1.0, 1.0, 1.0)


def matches(_path: Path, head: bytes) -> bool:
    """Return whether a file is one."""
    return head.startswith(MAGIC)


def read(path: Path, data: NDArray[np.uint8]) -> SplatFile:
    """Read the splats of a binary glTF file, those of all nodes of its scene.

    Raises
    ------
    RefineError
        If it is truncated or damaged, or holds no splats, or holds them in a way that is not read;
        with the place in the JSON.
    """
    document = opened(path, data)
    meshes = _shown(document, len(data))
    if not meshes:
        msg = f"{path}: no splats: no node of its scene shows a primitive with {EXTENSION}"
        raise RefineError(msg)
    count = sum(len(mesh) * len(mesh.nodes) for mesh in meshes)
    degree = max(mesh.degree for mesh in meshes)
    file, splats = new_file(path, Origin(f"{NAME} with {EXTENSION}", len(data)), count, degree)
    for mesh in meshes:
        mesh.fill(splats)
    return file


def _shown(document: Document, most: int) -> list[_Mesh]:
    """Return the meshes with splats that the nodes of a scene show, and by which nodes.

    Raises
    ------
    RefineError
        If the nodes show more splats than `most`: one mesh may be shown by many of them.
    """
    meshes: dict[int, _Mesh] = {}
    count = 0
    for index, place, matrix in _nodes(document):
        if index not in meshes:
            meshes[index] = _Mesh(document, index, place)
        mesh = meshes[index]
        if len(mesh):
            mesh.nodes.append(_Node(count, place, matrix))
        count += len(mesh)
        if count > most:
            msg = (
                f"{document.path}: its nodes show {count} splats or more, expected at most {most}, "
                "the bytes of the file"
            )
            raise RefineError(msg)
    return [mesh for mesh in meshes.values() if mesh.parts]


def _nodes(document: Document) -> Iterator[tuple[int, str, NDArray[np.float64]]]:
    """Yield the mesh of each node of a scene that has one, the node's place, its matrix (4, 4)."""
    if "scenes" not in document.content:
        return
    scene = document.item("scenes", document.content.get("scene", 0), "scene")
    left = [(index, np.eye(4)) for index in document.indices(scene, "nodes", "scene")]
    left.reverse()
    visited: set[int] = set()
    while left:
        index, above = left.pop()
        node = document.item("nodes", index, "a node")
        place = f"nodes[{index}]"
        if index in visited:
            raise document.wrong(place, "belongs to two nodes, expected a tree")
        visited.add(index)
        with np.errstate(over="ignore", invalid="ignore", under="ignore"):
            matrix = above @ _matrix(document, node, place)
        left += [(child, matrix) for child in reversed(document.indices(node, "children", place))]
        if "mesh" in node:
            document.item("meshes", node["mesh"], place)
            yield node["mesh"], place, matrix


def _matrix(document: Document, node: dict[str, Any], place: str) -> NDArray[np.float64]:
    """Return the matrix of a node, (4, 4)."""
    if "matrix" in node:
        columns = document.numbers(node, "matrix", place, tuple(np.eye(4).ravel().tolist()))
        return columns.reshape(4, 4).T
    x, y, z, w = document.numbers(node, "rotation", place, _ROTATION)
    matrix = np.eye(4)
    scale = document.numbers(node, "scale", place, _SCALE)
    matrix[:3, :3] = rotation_matrices(np.array([w, x, y, z])) * scale
    matrix[:3, 3] = document.numbers(node, "translation", place, _TRANSLATION)
    return matrix


def _check(document: Document, extension: Any, place: str) -> None:  # noqa: ANN401 - from JSON
    """Refuse splats of another kernel, and compressed ones."""
    held = extension if isinstance(extension, dict) else {}
    kernel = held.get("kernel", "ellipse")
    if kernel != "ellipse":
        raise document.wrong(place, f"splats of kernel {shown(kernel)}, expected 'ellipse'")
    more = held.get("extensions")
    if isinstance(more, dict) and more:
        name = shown(next(iter(more)))
        raise document.wrong(place, f"splats by {name}, expected plain accessors")


@dataclass(frozen=True)
class _Node:
    """A node that shows a mesh.

    Attributes
    ----------
    start : int
        Where its splats begin among those of the file.
    place : str
        For messages.
    matrix : (4, 4) float64
        From the frame of the mesh to that of the scene.
    """

    start: int
    place: str
    matrix: NDArray[np.float64]


class _Mesh:
    """The splats of a mesh.

    Parameters
    ----------
    document : Document
    index : int
        Of the mesh.
    place : str
        Of the node that shows it first, for messages.

    Attributes
    ----------
    parts : list of _Part
        Its primitives of splats.
    nodes : list of _Node
        Those that show it, in the order of their splats; none if it has no splats.
    degree : int
        Highest of the harmonics.
    """

    def __init__(self, document: Document, index: int, place: str) -> None:
        self._document = document
        self.parts: list[_Part] = []
        self.nodes: list[_Node] = []
        primitives = document.indices(document.item("meshes", index, place), "primitives", place)
        for number, primitive in enumerate(primitives):
            where = f"meshes[{index}].primitives[{number}]"
            if not isinstance(primitive, dict):
                raise document.wrong(where, f"expected an object, got {shown(primitive)}")
            extensions = primitive.get("extensions")
            if isinstance(extensions, dict) and EXTENSION in extensions:
                _check(document, extensions[EXTENSION], where)
                self.parts.append(_Part(document, primitive, where))
        self.degree = max((part.degree for part in self.parts), default=0)
        self._count = sum(map(len, self.parts))

    def __len__(self) -> int:
        return self._count

    def fill(self, splats: Splats) -> None:
        """Set the values of all splats that its nodes show; `splats` are those of the file."""
        if not self.nodes:
            return
        first, *others = (splats.take(slice(n.start, n.start + len(self))) for n in self.nodes)
        at = 0
        with np.errstate(all="ignore"):  # any number may stand in a file
            for part in self.parts:
                part.fill(first.take(slice(at, at + len(part))))
                at += len(part)
            # The first node's splats last, since the others are made of them as they stand.
            for node, target in reversed([*zip(self.nodes, (first, *others), strict=True)]):
                for piece in pieces(len(self)):
                    shown_there = self._moved(first.take(piece), node)
                    for field in fields(Splats):
                        getattr(target, field.name)[piece] = getattr(shown_there, field.name)

    def _moved(self, splats: Splats, node: _Node) -> Splats:
        """Return splats as a node shows them, in the frame of captures."""
        if np.array_equal(node.matrix, np.eye(4)):
            return _half_turned(splats)
        try:
            return transformed(splats, _HALF_TURN @ node.matrix)
        except RefineError as error:
            raise self._document.wrong(node.place, str(error)) from error


class _Part:
    """The splats of one primitive.

    Parameters
    ----------
    document : Document
    primitive : dict
    place : str
        For messages.
    """

    def __init__(self, document: Document, primitive: dict[str, Any], place: str) -> None:
        self._document, self._place = document, place
        attributes = primitive.get("attributes")
        if not isinstance(attributes, dict):
            raise document.wrong(place, f"attributes are {shown(attributes)}, expected an object")
        if primitive.get("mode", 4) != _POINTS:
            raise document.wrong(place, f"mode is {shown(primitive.get('mode', 4))}, expected 0")
        self._attributes = attributes
        self.degree = 0
        while self.degree < _DEGREES and _harmonic(self.degree + 1, 0) in attributes:
            self.degree += 1
        self._means = self._values("POSITION", 3)
        self._turns = self._values(f"{EXTENSION}:ROTATION", 4)
        self._scales = self._values(f"{EXTENSION}:SCALE", 3)
        self._opacities = self._values(f"{EXTENSION}:OPACITY", 1)
        self._harmonics = [self._values(name, 3) for name in _harmonics(self.degree)]

    def __len__(self) -> int:
        return len(self._means(slice(None)))

    def _values(self, name: str, width: int) -> Callable[[slice], NDArray[Any]]:
        """Return a function that returns some of the values of an attribute, (n, width)."""
        document, place = self._document, f"{self._place}.attributes"
        if name not in self._attributes:
            raise document.wrong(place, f"no {name}")
        index = self._attributes[name]
        values = document.accessor(index, f"{place}.{name}", width)
        first = values if name == "POSITION" else self._means(slice(None))
        if len(values) != len(first):
            problem = f"{len(values)} values, expected {len(first)} as for POSITION"
            where = f"accessors[{index}]"
            raise document.wrong(where, problem)
        if values.dtype.kind != "f" and document.normalized(index):
            largest = np.iinfo(values.dtype).max
            return lambda piece: np.maximum(values[piece] / largest, -1.0)
        return lambda piece: values[piece]

    def fill(self, splats: Splats) -> None:
        """Set the values of as many splats, in the frame of the file; absent harmonics are 0."""
        for piece in pieces(len(splats)):
            target = splats.take(piece)
            target.means[:] = self._means(piece)
            target.log_scales[:] = np.log(self._scales(piece), dtype=np.float32)
            target.quaternions[:] = self._turns(piece)[:, _WXYZ]
            target.opacity_logits[:] = opacity_logits(self._opacities(piece)[:, 0], SINGLE_MARGIN)
            target.sh_rest[:] = 0.0
            constant, *others = self._harmonics
            target.sh_dc[:] = constant(piece)
            for index, values in enumerate(others):
                target.sh_rest[:, index] = values(piece)


_XYZW, _WXYZ = [1, 2, 3, 0], [3, 0, 1, 2]


def _half_turned(splats: Splats) -> Splats:
    """Return splats turned half about z, to the bit: see `_HALF_TURN`."""
    w, x, y, z = splats.quaternions.T
    # Half a turn multiplies the harmonic of order m by (-1)^m.
    degree = splats.sh_degree
    signs = np.array(
        [(-1.0) ** m for band in range(1, degree + 1) for m in range(-band, band + 1)], np.float32
    )
    return Splats(
        means=splats.means * np.array([-1.0, -1.0, 1.0], np.float32),
        log_scales=splats.log_scales,
        quaternions=np.stack([-z, -y, x, w], axis=1),
        opacity_logits=splats.opacity_logits,
        sh_dc=splats.sh_dc,
        sh_rest=splats.sh_rest * signs[:, None],
    )


def _harmonic(degree: int, order: int) -> str:
    return f"{EXTENSION}:SH_DEGREE_{degree}_COEF_{order}"


def _harmonics(degree: int) -> list[str]:
    """Return the names of all coefficients up to a degree, the constant first."""
    return [_harmonic(band, n) for band in range(degree + 1) for n in range(2 * band + 1)]


@dataclass(frozen=True)
class _Attribute:
    """An attribute as it is written.

    Attributes
    ----------
    name : str
    width, kind : int
        Numbers of one splat, and their component type.
    values : callable
        Returns them, (n, width), of some splats that were turned.
    """

    name: str
    width: int
    kind: int
    values: Callable[[Splats], NDArray[Any]]

    @property
    def row(self) -> int:
        """Bytes of one splat."""
        return self.width * np.dtype(KINDS[self.kind]).itemsize


def _attributes(degree: int) -> list[_Attribute]:
    """Return what is written, in the order of the binary chunk."""

    def opaque(splats: Splats) -> NDArray[Any]:
        return opacity(splats.opacity_logits)[:, None]

    def color(splats: Splats) -> NDArray[Any]:
        return codes(np.hstack([base_color(splats.sh_dc), opaque(splats)]))

    def scale(splats: Splats) -> NDArray[Any]:
        return scales(splats.log_scales)

    def turn(splats: Splats) -> NDArray[Any]:
        return unit_quaternions(splats.quaternions)[:, _XYZW]

    def harmonic(index: int) -> Callable[[Splats], NDArray[Any]]:
        return lambda splats: splats.sh_rest[:, index]

    constant, *others = _harmonics(degree)
    return [
        _Attribute("POSITION", 3, _FLOAT, lambda splats: splats.means),
        _Attribute("COLOR_0", 4, _BYTE, color),
        _Attribute(f"{EXTENSION}:ROTATION", 4, _FLOAT, turn),
        _Attribute(f"{EXTENSION}:SCALE", 3, _FLOAT, scale),
        _Attribute(f"{EXTENSION}:OPACITY", 1, _FLOAT, opaque),
        _Attribute(constant, 3, _FLOAT, lambda splats: splats.sh_dc),
        *(_Attribute(name, 3, _FLOAT, harmonic(index)) for index, name in enumerate(others)),
    ]


def write(stream: BinaryIO, splats: Splats) -> None:
    """Write splats as a binary glTF file with one node.

    Raises
    ------
    RefineError
        If the file would be longer than 4 GiB, which its format cannot say.
    """
    attributes = _attributes(splats.sh_degree)
    with np.errstate(under="ignore", over="ignore"):  # doubles that are no floats
        means = np.asarray(splats.means, np.float32)
        low, high = means.min(axis=0), means.max(axis=0)
        # Half a turn about z: x and y change sign.
        low, high = (
            np.array([-high[0], -high[1], low[2]], np.float64),
            np.array([-low[0], -low[1], high[2]], np.float64),
        )
        text = _json(attributes, len(splats), (low + 0.0).tolist(), (high + 0.0).tolist())
        body = len(splats) * sum(attribute.row for attribute in attributes)
        total = HEADER.size + 2 * CHUNK.size + len(text) + body
        if total > _LONGEST:
            msg = f"{len(splats)} splats are {total} bytes as {NAME}, which holds {_LONGEST}"
            raise RefineError(msg)
        stream.write(HEADER.pack(MAGIC, VERSION, total) + CHUNK.pack(len(text), JSON) + text)
        stream.write(CHUNK.pack(body, BINARY))
        for attribute in attributes:
            for piece in pieces(len(splats)):
                values = attribute.values(_half_turned(splats.take(piece)))
                stream.write(np.ascontiguousarray(values, KINDS[attribute.kind]).data)


def _json(attributes: list[_Attribute], count: int, low: list[float], high: list[float]) -> bytes:
    """Return the JSON of a file, as many spaces behind it as its length in fours needs."""
    views: list[dict[str, Any]] = []
    accessors: list[dict[str, Any]] = []
    at = 0
    for index, attribute in enumerate(attributes):
        length = attribute.row * count
        views.append({"buffer": 0, "byteOffset": at, "byteLength": length, "target": _VERTICES})
        accessors.append(
            {
                "bufferView": index,
                "componentType": attribute.kind,
                "count": count,
                "type": SHAPES[attribute.width],
            }
        )
        at += length
    accessors[0].update(min=low, max=high)
    accessors[1]["normalized"] = True
    primitive = {
        "attributes": {attribute.name: index for index, attribute in enumerate(attributes)},
        "mode": _POINTS,
        "extensions": {EXTENSION: {"kernel": "ellipse", "colorSpace": "srgb_rec709_display"}},
    }
    content = {
        "asset": {"version": "2.0", "generator": "REFINE for Blender"},
        "extensionsUsed": [EXTENSION],
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0}],
        "meshes": [{"primitives": [primitive]}],
        "buffers": [{"byteLength": at}],
        "bufferViews": views,
        "accessors": accessors,
    }
    text = json.dumps(content, separators=(",", ":")).encode()
    return text + b" " * (-len(text) % 4)


def sizes(count: int, degree: int) -> Sizes:
    """Return how large a file is, at most: its JSON has numbers of unknown length."""
    attributes = _attributes(degree)
    longest = [-1.1754943508222875e-38] * 3
    text = _json(attributes, count, longest, longest)
    fixed = HEADER.size + 2 * CHUNK.size + len(text)
    return Sizes(sum(attribute.row for attribute in attributes), fixed)


FORMAT = Format(
    name=NAME,
    suffix=".glb",
    degree=_DEGREES,
    loss="holds activated values in single precision, with y up",
    matches=matches,
    read=read,
    write=write,
    sizes=sizes,
)
