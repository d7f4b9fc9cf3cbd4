"""Reading glTF (``.glb``, ``.gltf``) with KHR_gaussian_splatting: activated values, or SPZ.

Rotations are x y z w. In glTF y points up, in captures down; half a turn about z, which changes
only signs, maps one to the other. The transforms of nodes are applied. SPZ within is right, up,
back, and its draft asks for left, up, front, so x and z change sign.
"""

from __future__ import annotations

import base64
import struct
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple
from urllib.parse import unquote

import numpy as np
from numpy.typing import NDArray

from ..affine import transformed
from ..errors import RefineError
from ..mapped import file_bytes
from ..place import Place, described, is_whole
from ..spherical_harmonics import encoded
from ..splats import LOG_ZERO, MODELS, Model, Splats, rotation_matrices, single_logits
from . import spz
from .format import new_file, pieces, refuse_short
from .ply import SplatFile

EXTENSION = "KHR_gaussian_splatting"
_SPZ = f"{EXTENSION}_compression_spz_2"  # a draft
HEADER = struct.Struct("<4sII")  # magic, version, bytes of all
CHUNK = struct.Struct("<I4s")  # bytes, kind
MAGIC, VERSION = b"glTF", 2
JSON, BINARY = b"JSON", b"BIN\0"
DEGREE = 3  # highest
KINDS = {5120: "i1", 5121: "u1", 5122: "<i2", 5123: "<u2", 5126: "<f4"}  # glTF's types -> NumPy's
SHAPES = {1: "SCALAR", 3: "VEC3", 4: "VEC4"}  # width -> type of accessor
POINTS = 0  # mode of a primitive
_MOVES = ("matrix", "translation", "rotation", "scale")  # keys of a node that move what it holds

# Extensions that a file may require: splats have no material.
_READ = (EXTENSION, _SPZ, "KHR_mesh_quantization", "KHR_materials_unlit")

# How splats are drawn, whatever the extension says, and the colour space that is converted.
DRAWN = {"colorSpace": "srgb_rec709_display", "projection": "perspective"}
_LINEAR = "lin_rec709_display"
_CONVERTED = f'colorSpace "{_LINEAR}", converted to sRGB: harmonics and blends are approximate'
HALF_TURN = np.diag([-1.0, -1.0, 1.0, 1.0])  # from the frame of captures to glTF's, and back
_SPZ_TURN = np.diag([-1.0, 1.0, -1.0, 1.0])  # from SPZ's (right, up, back) to left, up, front


class _Document(NamedTuple):
    place: Place
    content: dict[str, Any]
    buffers: list[NDArray[np.uint8]]
    size: int  # bytes of the file and of those beside it
    remarks: list[str]  # ends of sentences that begin with "FILE has"
    packed: dict[int, SplatFile]  # SPZ files within, by view

    def item(self, group: str, index: Any, place: Place) -> tuple[dict[str, Any], Place]:
        """Item of a list such as ``nodes``, and its place; `place` is where the index stands."""
        items = self.content.get(group, [])
        count = len(items) if isinstance(items, list) else 0
        if not is_whole(index) or not 0 <= index < count:
            place.fail(f"{described(index)} is none of {count} {group}")
        where = self.place.at(f"{group}[{index}]")
        return where.members(items[index]), where

    def view(self, index: Any, place: Place) -> tuple[NDArray[np.uint8], int]:
        """Bytes of a view of a buffer, (n,), and its stride, 0 if it has none."""
        held, place = self.item("bufferViews", index, place)
        self.item("buffers", held.get("buffer"), place)
        content = self.buffers[held["buffer"]]
        keys = {"byteOffset": 0, "byteLength": None, "byteStride": 0}
        start, length, stride = (place.at(key).whole(held.get(key, keys[key])) for key in keys)
        if "extensions" in held:
            place.fail("compressed, expected plain bytes")
        if start + length > len(content):
            place.fail(f"{length} bytes from byte {start} of {len(content)} do not fit")
        return content[start : start + length], stride

    def values(self, index: Any, place: Place, width: int) -> tuple[NDArray[Any], float]:
        """Stored values of an accessor, (n, width), and the number that stands for 1."""
        held, place = self.item("accessors", index, place)
        kind, shape = held.get("componentType"), held.get("type")
        if not is_whole(kind) or kind not in KINDS or shape != SHAPES[width]:
            got = f"{described(shape)} of {described(kind)}"
            place.fail(f"{got}, expected {SHAPES[width]} of {', '.join(map(str, KINDS))}")
        if "sparse" in held or "bufferView" not in held:
            place.fail("sparse or without values in a bufferView, which is not read")
        dtype = np.dtype(KINDS[kind])
        count = place.at("count").whole(held.get("count"))
        offset = place.at("byteOffset").whole(held.get("byteOffset", 0))
        content, stride = self.view(held["bufferView"], place)
        size = dtype.itemsize * width
        stride = stride or size
        end = offset + (stride * (count - 1) + size if count else 0)
        if stride < size or end > len(content):
            place.fail(f"{count} values of {size} bytes from {offset} of {len(content)} do not fit")
        layout = content.data, offset, (stride, dtype.itemsize)
        values: NDArray[Any] = np.ndarray((count, width), dtype, *layout)
        shares = dtype.kind != "f" and held.get("normalized", False)
        return values, float(np.iinfo(dtype).max) if shares else 1.0


class _Part(NamedTuple):
    splats: int
    degree: int
    model: Model
    turn: NDArray[np.float64]  # to the frame of its node, (4, 4)
    take: Callable[[slice], Splats]
    linear: bool = False  # whether its colours are linear


def matches(_: Path, head: bytes) -> bool:
    """Whether these are the first bytes of a GLB."""
    return head.startswith(MAGIC)


def read(path: Path, data: NDArray[np.uint8]) -> SplatFile:
    """Splats of all nodes of a file's scene, each where the node puts it; see `Format.read`."""
    document = _opened(path, data)
    meshes, shown, every, moves = {}, [], [], []
    left, visited, count, place = [], set(), 0, document.place.at("scene")
    if "scenes" in document.content:
        scene, place = document.item("scenes", document.content.get("scene", 0), place)
        left = [(index, place, 0) for index in _listed(scene, "nodes", place)[::-1]]
    while left:
        index, place, frame = left.pop()
        node, place = document.item("nodes", index, place)
        if index in visited:
            place.fail("belongs to two nodes, expected a tree")
        visited.add(index)
        if not node.keys().isdisjoint(_MOVES):
            moves.append((node, place, frame))  # the frame is that of its parent
            frame = len(moves)
        left += [(child, place, frame) for child in _listed(node, "children", place)[::-1]]
        if "mesh" not in node:
            continue
        mesh, where = document.item("meshes", node["mesh"], place)
        if node["mesh"] not in meshes:
            meshes[node["mesh"]] = _parts(document, mesh, where)
            every += meshes[node["mesh"]]
        parts = [part for part in meshes[node["mesh"]] if part.splats]
        shown += [(part, frame, place) for part in parts]
        count += sum(part.splats for part in parts)
        if count > document.size:  # nodes may share a mesh: few bytes, many splats
            wanted = f"expected at most {document.size}, the bytes of its files"
            document.place.fail(f"its nodes show {count} splats or more, {wanted}")
    if not every:
        document.place.fail(f"no splats: no node of its scene shows a primitive with {EXTENSION}")
    name = "GLB" if matches(path, data[:4].tobytes()) else "glTF"
    origin, degree = (f"{name} with {EXTENSION}", document.size), max(part.degree for part in every)
    model = every[0].model
    if any(part.model != model for part in every):
        document.place.fail(f"some splats are {model}, others not, expected one model")
    remarks = (f"{path.name} has {remark}" for remark in dict.fromkeys(document.remarks))
    file = new_file(path, origin, count, degree, _placed(shown, moves), model)
    return replace(file, remarks=tuple(remarks))


def _placed(shown, moves):
    """Yield the splats of all parts, where their nodes put them."""
    frames = _frames(moves)
    for part, frame, place in shown:
        for piece in pieces(part.splats):
            try:
                splats = transformed(part.take(piece), HALF_TURN @ frames[frame] @ part.turn)
            except RefineError as error:
                place.fail(str(error))
            if part.linear:
                stored = (np.asarray(each, np.float32) for each in (splats.sh_dc, splats.sh_rest))
                dc, rest = encoded(*stored)
                splats = replace(splats, sh_dc=dc, sh_rest=rest)
            yield splats


def _opened(path, data):
    chunks = _chunks(path, data) if matches(path, data[:4].tobytes()) else {JSON: data}
    place, text = Place(path), Place(path, "JSON")
    content = text.members(text.parsed(chunks.get(JSON, data[:0]).tobytes()))
    buffers, files = [], dict[Any, NDArray[np.uint8]]()
    for number, item in enumerate(_listed(content, "buffers", place)):
        where = place.at(f"buffers[{number}]")
        uri = unquote(where.text(where.members(item).get("uri", "")))
        kind, _, coded = uri.partition(",")
        if not uri:
            held = chunks.get(BINARY, data[:0])
        elif kind.startswith("data:") and kind.endswith(";base64"):
            try:
                held = np.frombuffer(base64.b64decode(coded, validate=True), np.uint8)
            except ValueError as error:
                where.fail(f"invalid base64: {error}")
        else:
            file = where.beside(uri).resolve()
            files[file] = held = files[file] if file in files else file_bytes(file)
        buffers.append(held)
    unread = [name for name in _listed(content, "extensionsRequired", place) if name not in _READ]
    remarks = [f"a required extension that is not read, {described(name)}" for name in unread[:1]]
    size = len(data) + sum(map(len, files.values()))
    return _Document(place, content, buffers, size, remarks, {})


def _chunks(path, data):
    """Chunks of a GLB by kind, the first of each."""
    refuse_short(path, HEADER.size + CHUNK.size, len(data), "the first bytes of a GLB file")
    _, version, length = HEADER.unpack_from(data)
    if version != VERSION:
        Place(path).fail(f"glTF version {version}, expected {VERSION}")
    refuse_short(path, length, len(data), "all chunks")
    at, chunks = HEADER.size, dict[bytes, NDArray[np.uint8]]()
    while at + CHUNK.size <= length:
        size, kind = CHUNK.unpack_from(data, at)
        at += CHUNK.size
        refuse_short(path, at + size, length, f"a chunk at byte {at} and what is before it")
        chunks.setdefault(kind, data[at : at + size])
        at += size
    return chunks


def _listed(holder, key, place):
    return place.at(key).items(holder.get(key, []))


def _frames(moves):
    """Frames of the scene and of M nodes, (M + 1, 4, 4), in that of the scene."""

    def numbers(key, *default):
        values = np.tile(default, (len(moves), 1))
        for row, (node, place, _) in zip(values, moves, strict=True):
            if key in node:
                row[:] = place.at(key).numbers(node[key], len(default))
        return values

    turns = np.roll(numbers("rotation", 0.0, 0.0, 0.0, 1.0), 1, axis=1)
    frames = np.tile(np.eye(4), (len(moves) + 1, 1, 1))
    frames[1:, :3, :3] = rotation_matrices(turns) * numbers("scale", 1.0, 1.0, 1.0)[:, None]
    frames[1:, :3, 3] = numbers("translation", 0.0, 0.0, 0.0)
    matrices = numbers("matrix", *np.eye(4).flat).reshape(-1, 4, 4)  # a node with one has no other
    frames[1:] = frames[1:] @ matrices.transpose(0, 2, 1)
    for number, (*_, above) in enumerate(moves, 1):
        frames[number] = frames[above] @ frames[number]
    return frames


def _parts(document, mesh, place):
    parts = []
    for number, item in enumerate(_listed(mesh, "primitives", place)):
        where = place.at(f"primitives[{number}]")
        primitive = where.members(item)
        extensions = primitive.get("extensions")
        if not isinstance(extensions, dict) or EXTENSION not in extensions:
            continue
        extension = extensions[EXTENSION] if isinstance(extensions[EXTENSION], dict) else {}
        kernel, more = extension.get("kernel", "ellipse"), extension.get("extensions") or {}
        if kernel != "ellipse":
            where.fail(f'splats of kernel {described(kernel)}, expected "ellipse"')
        unread = [name for name in where.members(more) if name != _SPZ]
        if unread:
            where.fail(f"splats by {described(unread[0])}, expected plain accessors or {_SPZ}")
        if primitive.get("mode", 4) != POINTS:
            where.at("mode").expected(str(POINTS), primitive.get("mode", 4))
        linear = extension.get("colorSpace") == _LINEAR
        document.remarks.extend(
            f"{key} {described(extension[key])}, read as {described(drawn)}"
            for key, drawn in DRAWN.items()
            if extension.get(key, drawn) not in (drawn, _LINEAR)
        )
        document.remarks.extend([_CONVERTED] * linear)
        if more:
            part = _packed_part(document, more[_SPZ], where.at(_SPZ))
        else:
            part = _part(document, primitive.get("attributes"), where.at("attributes"))
        parts.append(part._replace(linear=linear))
    return parts


def _packed_part(document, held, place):
    """Part of the splats in an SPZ file within; `RefineError` if many views share its bytes."""
    index = place.members(held).get("bufferView")
    content, _ = document.view(index, place)
    if index not in document.packed:
        size = len(content) + sum(file.stored_bytes for file in document.packed.values())
        if size > document.size:
            place.fail(f"{size} bytes of SPZ so far, expected at most {document.size}")
        document.packed[index] = spz.FORMAT.read(place.path, content)
    splats = document.packed[index].splats()
    return _Part(len(splats), splats.sh_degree, splats.model, _SPZ_TURN, splats.take)


def _part(document, attributes, place):
    attributes = place.members(attributes)
    degree, count, held = 0, 0, {}
    while degree < DEGREE and f"{EXTENSION}:SH_DEGREE_{degree + 1}_COEF_0" in attributes:
        degree += 1
    wanted = {"POSITION": 3, "ROTATION": 4, "SCALE": 3, "OPACITY": 1}
    for name, width in (wanted | dict.fromkeys(harmonics(degree), 3)).items():
        key = name if name == "POSITION" else f"{EXTENSION}:{name}"
        if key not in attributes:
            place.fail(f"no {key}")
        held[name] = document.values(attributes[key], place.at(key), width)
        count, got = len(held["POSITION"][0]), len(held[name][0])
        if got != count:
            place.at(key).fail(f"{got} values, expected {count} as for POSITION")

    def values(name, piece):
        stored, unit = held[name]
        return stored[piece] if unit == 1.0 else np.maximum(stored[piece] / unit, -1.0)

    log = any((values("SCALE", piece) < 0.0).any() for piece in pieces(count))
    if log:
        document.remarks.append("negative scales: its scales are read as logarithms")

    def take(piece):
        sizes, turns = values("SCALE", piece), np.roll(values("ROTATION", piece), 1, axis=1)
        logs = sizes if log else np.maximum(np.log(sizes, dtype=np.float32), LOG_ZERO)
        logits = single_logits(values("OPACITY", piece)[:, 0])
        every = np.stack([values(name, piece) for name in harmonics(degree)], axis=1)
        return Splats(values("POSITION", piece), logs, turns, logits, every[:, 0], every[:, 1:])

    return _Part(count, degree, MODELS[0], np.eye(4), take)


def harmonics(degree: int) -> list[str]:
    """Names of all coefficients up to a degree, the constant first."""
    return [f"SH_DEGREE_{band}_COEF_{n}" for band in range(degree + 1) for n in range(2 * band + 1)]
