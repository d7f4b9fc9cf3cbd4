"""Binary glTF (``.glb``) with KHR_gaussian_splatting: plain accessors, activated values.

A primitive of points has float positions, rotations x y z w, linear scales, opacities of 0..1 and
harmonics as attributes. glTF's y points up where that of captures points down: both are turned half
about z into each other, which changes signs only. What nodes do to a primitive is applied.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from ..affine import transformed
from ..errors import RefineError
from ..place import Place, described
from ..splats import (
    ARRAYS,
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
)
from .ply import Origin, SplatFile

NAME = "GLB"
EXTENSION = "KHR_gaussian_splatting"

_LONGEST = (1 << 32) - 1
_DEGREES = 3

_FLOAT, _BYTE = 5126, 5121
_POINTS, _VERTICES = 0, 34962

_HALF_TURN = np.diag([-1.0, -1.0, 1.0, 1.0])
"""Between the frame of captures and that of glTF, either way."""


_MOVES = frozenset(("matrix", "translation", "rotation", "scale"))
"""Members of a node that move what it shows."""


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
        raise RefineError(
            f"{path}: no splats: no node of its scene shows a primitive with {EXTENSION}"
        )
    count = sum(len(mesh) * len(mesh.nodes) for mesh in meshes)
    degree = max(mesh.degree for mesh in meshes)
    file, splats = new_file(path, Origin(f"{NAME} with {EXTENSION}", len(data)), count, degree)
    for mesh in meshes:
        mesh.fill(splats)
    return file


def _shown(document: Document, most: int) -> list[_Mesh]:
    """Return the meshes with splats that the nodes of a scene show, and by which nodes.

    Raise `RefineError` if they show more splats than `most`: one mesh may be shown by many of them.
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
            document.place.fail(
                f"its nodes show {count} splats or more, expected at most {most}, the bytes of the "
                "file"
            )
    return [mesh for mesh in meshes.values() if mesh.parts]


def _nodes(document: Document) -> Iterator[tuple[int, Place, NDArray[np.float64]]]:
    """Yield the mesh of each node of a scene that has one, the node's place, its matrix (4, 4)."""
    if "scenes" not in document.content:
        return
    scene, place = document.item(
        "scenes", document.content.get("scene", 0), document.place.at("scene")
    )
    left = [(index, place, np.eye(4)) for index in _listed(scene, "nodes", place)[::-1]]
    visited: set[int] = set()
    while left:
        index, above, frame = left.pop()
        node, place = document.item("nodes", index, above)
        if index in visited:
            place.fail("belongs to two nodes, expected a tree")
        visited.add(index)
        matrix = frame
        if not _MOVES.isdisjoint(node):
            with np.errstate(over="ignore", invalid="ignore", under="ignore"):
                matrix = frame @ _matrix(node, place)
        left += [(child, place, matrix) for child in _listed(node, "children", place)[::-1]]
        if "mesh" in node:
            document.item("meshes", node["mesh"], place)
            yield node["mesh"], place, matrix


def _listed(holder: dict[str, Any], key: str, place: Place) -> list[Any]:
    """Return a list, empty if it is not there."""
    return place.at(key).items(holder.get(key, []))


def _matrix(node: dict[str, Any], place: Place) -> NDArray[np.float64]:
    """Return the matrix of a node, (4, 4)."""
    if "matrix" in node:
        columns = place.at("matrix").numbers(node["matrix"], 16)
        return np.array(columns).reshape(4, 4).T

    def numbers(key: str, default: list[float]) -> list[float]:
        return place.at(key).numbers(node.get(key, default), len(default))

    x, y, z, w = numbers("rotation", [0.0, 0.0, 0.0, 1.0])
    matrix = np.eye(4)
    scale = numbers("scale", [1.0, 1.0, 1.0])
    matrix[:3, :3] = rotation_matrices(np.array([w, x, y, z])) * scale
    matrix[:3, 3] = numbers("translation", [0.0, 0.0, 0.0])
    return matrix


def _refuse_unread(extension: Any, place: Place) -> None:
    """Refuse splats of another kernel, and compressed ones."""
    held = extension if isinstance(extension, dict) else {}
    kernel = held.get("kernel", "ellipse")
    if kernel != "ellipse":
        place.fail(f'splats of kernel {described(kernel)}, expected "ellipse"')
    more = held.get("extensions")
    if isinstance(more, dict) and more:
        name = described(next(iter(more)))
        place.fail(f"splats by {name}, expected plain accessors")


@dataclass(frozen=True)
class _Node:
    """A node that shows a mesh."""

    start: int  # row of the file's splats at which those of this node begin
    place: Place
    matrix: NDArray[np.float64]  # (4, 4), from the frame of the mesh to that of the scene


class _Mesh:
    """The splats of a mesh; `place` is that of the node that shows it first."""

    def __init__(self, document: Document, index: int, place: Place) -> None:
        self.parts: list[_Part] = []  # its primitives of splats
        # The nodes that show it, in the order of their splats; empty if it has no splats.
        self.nodes: list[_Node] = []
        mesh, place = document.item("meshes", index, place)
        for number, item in enumerate(_listed(mesh, "primitives", place)):
            where = place.at(f"primitives[{number}]")
            primitive = where.members(item)
            extensions = primitive.get("extensions")
            if isinstance(extensions, dict) and EXTENSION in extensions:
                _refuse_unread(extensions[EXTENSION], where)
                self.parts.append(_Part(document, primitive, where))
        self.degree = max((part.degree for part in self.parts), default=0)
        self._count = sum(map(len, self.parts))

    def __len__(self) -> int:
        return self._count

    def fill(self, splats: Splats) -> None:
        """Set the values of all splats that its nodes show, among all `splats` of the file."""
        if not self.nodes:
            return
        first, *others = (splats.take(slice(n.start, n.start + len(self))) for n in self.nodes)
        at = 0
        with np.errstate(all="ignore"):  # any number may stand in a file
            for part in self.parts:
                part.fill(first.take(slice(at, at + len(part))))
                at += len(part)
            # The first node last: the splats of the others are computed from its untouched ones.
            for node, target in reversed([*zip(self.nodes, (first, *others), strict=True)]):
                for piece in pieces(len(self)):
                    shown_there = self._moved(first.take(piece), node)
                    for name in ARRAYS:
                        getattr(target, name)[piece] = getattr(shown_there, name)

    def _moved(self, splats: Splats, node: _Node) -> Splats:
        """Return splats as a node shows them, in the frame of captures."""
        if np.array_equal(node.matrix, np.eye(4)):
            return _half_turned(splats)
        try:
            return transformed(splats, _HALF_TURN @ node.matrix)
        except RefineError as error:
            node.place.fail(str(error))


class _Part:
    """The splats of one primitive."""

    def __init__(self, document: Document, primitive: dict[str, Any], place: Place) -> None:
        self._document, self._place = document, place.at("attributes")
        self._attributes = attributes = self._place.members(primitive.get("attributes"))
        mode = primitive.get("mode", 4)
        if mode != _POINTS:
            place.at("mode").fail(f"expected {_POINTS}, got {described(mode)}")
        self.degree = 0
        while self.degree < _DEGREES and _harmonic(self.degree + 1, 0) in attributes:
            self.degree += 1
        self._means = self._values("POSITION", 3)
        self._turns = self._values(f"{EXTENSION}:ROTATION", 4)
        self._scales = self._values(f"{EXTENSION}:SCALE", 3)
        self._opacities = self._values(f"{EXTENSION}:OPACITY", 1)
        self._harmonics = [self._values(name, 3) for name in _harmonics(self.degree)]

    def __len__(self) -> int:
        return self._count

    def _values(self, name: str, width: int) -> Callable[[slice], NDArray[Any]]:
        """Return a function that returns a slice of the values of an attribute, (n, width)."""
        if name not in self._attributes:
            self._place.fail(f"no {name}")
        index, place = self._attributes[name], self._place.at(name)
        values = self._document.accessor(index, place, width)
        if name == "POSITION":
            self._count = len(values)
        if len(values) != self._count:
            place.fail(f"{len(values)} values, expected {self._count} as for POSITION")
        if values.dtype.kind != "f" and self._document.normalized(index):
            largest = np.iinfo(values.dtype).max
            return lambda piece: np.maximum(values[piece] / largest, -1.0)
        return lambda piece: values[piece]

    def fill(self, splats: Splats) -> None:
        """Set the values of `splats`, one for each of these; harmonics that are absent are 0."""
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
    """An attribute as it is written."""

    name: str
    width: int  # numbers of one splat
    kind: int  # their component type
    values: Callable[[Splats], NDArray[Any]]  # (n, width), for splats in the frame of glTF

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
            raise RefineError(
                f"{len(splats)} splats are {total} bytes as {NAME}, which holds {_LONGEST}"
            )
        stream.write(HEADER.pack(MAGIC, VERSION, total) + CHUNK.pack(len(text), JSON) + text)
        stream.write(CHUNK.pack(body, BINARY))
        for attribute in attributes:
            for piece in pieces(len(splats)):
                values = attribute.values(_half_turned(splats.take(piece)))
                stream.write(np.ascontiguousarray(values, KINDS[attribute.kind]).data)


def _json(attributes: list[_Attribute], count: int, low: list[float], high: list[float]) -> bytes:
    """Return the JSON of a file, padded with spaces to a multiple of 4 bytes."""
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
