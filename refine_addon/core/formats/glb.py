"""glTF (``.glb``, and only read ``.gltf``) with KHR_gaussian_splatting: activated values, or SPZ.

Rotations are x y z w. In glTF y points up, in captures down; half a turn about z, which changes
only signs, maps one to the other. The transforms of nodes are applied.
"""

from __future__ import annotations

import base64
import json
import struct
from collections.abc import Callable
from dataclasses import replace
from typing import Any, NamedTuple
from urllib.parse import unquote

import numpy as np
from numpy.typing import NDArray

from ..affine import transformed
from ..errors import RefineError
from ..place import Place, described, is_whole
from ..splats import assign, opacity, rotation_matrices, scales, single_logits, unit_quaternions
from . import spz
from .format import Format, color_codes, encode_colors, new_file, pieces, refuse_short
from .ply import file_bytes
from .sog import beside, named_json

NAME = "GLB"
EXTENSION = "KHR_gaussian_splatting"
_SPZ = f"{EXTENSION}_compression_spz_2"  # a draft

_HEADER = struct.Struct("<4sII")  # magic, version, bytes of all
_CHUNK = struct.Struct("<I4s")  # bytes, kind
_MAGIC, _VERSION = b"glTF", 2
_JSON, _BINARY = b"JSON", b"BIN\0"
_LONGEST = (1 << 32) - 1
_DEGREE = 3  # highest

_KINDS = {5120: "i1", 5121: "u1", 5122: "<i2", 5123: "<u2", 5126: "<f4"}  # glTF's types -> NumPy's

_SHAPES = {1: "SCALAR", 3: "VEC3", 4: "VEC4"}  # width -> type of accessor

_FLOAT, _BYTE = 5126, 5121
_POINTS, _VERTICES = 0, 34962

_MOVES = ("matrix", "translation", "rotation", "scale")  # keys of a node that move what it holds

_READ = (EXTENSION, _SPZ, "KHR_mesh_quantization")  # extensions that a file may require

_DRAWN = {"colorSpace": "srgb_rec709_display", "projection": "perspective"}
"""How splats are drawn, whatever the extension says."""

_LINEAR = "lin_rec709_display"  # colour space that is converted
_CONVERTED = f'colorSpace "{_LINEAR}", converted to sRGB: harmonics and blends are approximate'

_HALF_TURN = np.diag([-1.0, -1.0, 1.0, 1.0])  # from the frame of captures to glTF's, and back
_SPZ_TURN = np.diag([-1.0, 1.0, -1.0, 1.0])  # from SPZ's (right, up, back) to left, up, front


class _Document(NamedTuple):
    place: Place
    content: dict[str, Any]
    buffers: list[NDArray[np.uint8]]
    size: int  # bytes of the file and of those beside it

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
        if not is_whole(kind) or kind not in _KINDS or shape != _SHAPES[width]:
            got = f"{described(shape)} of {described(kind)}"
            place.fail(f"{got}, expected {_SHAPES[width]} of {', '.join(map(str, _KINDS))}")
        if "sparse" in held or "bufferView" not in held:
            place.fail("sparse or without values, which splats are not read from")
        dtype = np.dtype(_KINDS[kind])
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
    fill: Callable[[Any, slice], None]  # sets splats of its degree to a piece of it
    remarks: tuple[str, ...] = ()  # ends of sentences that begin with "FILE has"
    linear: bool = False  # whether its colours are linear
    model: Any = "default"
    turn: Any = np.eye(4)  # to the frame of its node


def _read(path, data):
    """Read the splats of all nodes of a file's scene, each where the node puts it."""
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
        if "children" in node:
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
    name = NAME if data[: len(_MAGIC)].tobytes() == _MAGIC else READER.name
    origin, degree = (f"{name} with {EXTENSION}", document.size), max(part.degree for part in every)
    model = every[0].model
    if any(part.model != model for part in every):
        document.place.fail(f"some splats are {model}, others not, expected one model")
    file, splats = new_file(path, origin, count, degree, model)
    splats.sh_rest[:] = 0.0
    start = 0
    with np.errstate(all="ignore"):  # files may hold any numbers
        frames = _frames(moves)
        for part, frame, place in shown:
            for piece in pieces(part.splats):
                target = splats.take(slice(start + piece.start, start + piece.stop))
                part.fill(target.up_to_degree(part.degree), piece)
                if part.linear:
                    encode_colors(target)
                try:
                    turn = _HALF_TURN @ frames[frame] @ part.turn
                    unmoved = np.array_equal(turn, _HALF_TURN)
                    moved = _half_turned(target) if unmoved else transformed(target, turn)
                except RefineError as error:
                    place.fail(str(error))
                assign(target, moved)
            start += part.splats
    required = _listed(document.content, "extensionsRequired", document.place)
    unread = [described(name) for name in required if name not in _READ]
    remarks = [f"a required extension that is not read, {name}" for name in unread[:1]]
    remarks += [remark for part in every for remark in part.remarks]
    once = dict.fromkeys(remarks)
    return replace(file, remarks=tuple(f"{path.name} has {remark}" for remark in once))


def _opened(path, data):
    chunks = _chunks(path, data) if data[: len(_MAGIC)].tobytes() == _MAGIC else {_JSON: data}
    place, text = Place(path), Place(path, "JSON")
    content = text.members(text.parsed(chunks.get(_JSON, data[:0]).tobytes()))
    buffers, files = [], dict[Any, NDArray[np.uint8]]()
    for number, item in enumerate(_listed(content, "buffers", place)):
        where = place.at(f"buffers[{number}]")
        uri = unquote(where.text(where.members(item).get("uri", "")))
        kind, _, coded = uri.partition(",")
        if not uri:
            held = chunks.get(_BINARY, data[:0])[: None if number == 0 else 0]
        elif kind.startswith("data:") and kind.endswith(";base64"):
            try:
                held = np.frombuffer(base64.b64decode(coded, validate=True), np.uint8)
            except ValueError as error:
                where.fail(f"invalid base64: {error}")
        else:
            file = beside(where, uri).resolve()
            files[file] = held = files[file] if file in files else file_bytes(file)
        buffers.append(held)
    return _Document(place, content, buffers, len(data) + sum(map(len, files.values())))


def _chunks(path, data):
    """Chunks of a GLB by kind, the first of each."""
    refuse_short(path, _HEADER.size + _CHUNK.size, len(data), "the first bytes of a GLB file")
    _, version, length = _HEADER.unpack(data[: _HEADER.size].tobytes())
    if version != _VERSION:
        Place(path).fail(f"glTF version {version}, expected {_VERSION}")
    refuse_short(path, length, len(data), "all chunks")
    at, chunks = _HEADER.size, dict[bytes, NDArray[np.uint8]]()
    while at + _CHUNK.size <= length:
        size, kind = _CHUNK.unpack(data[at : at + _CHUNK.size].tobytes())
        at += _CHUNK.size
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
        if primitive.get("mode", 4) != _POINTS:
            where.at("mode").expected(str(_POINTS), primitive.get("mode", 4))
        linear = extension.get("colorSpace") == _LINEAR
        remarks = tuple(
            f"{key} {described(extension[key])}, read as {described(drawn)}"
            for key, drawn in _DRAWN.items()
            if extension.get(key, drawn) not in (drawn, _LINEAR)
        )
        remarks += (_CONVERTED,) * linear
        if more:
            part = _packed_part(document, more[_SPZ], where.at(_SPZ))
        else:
            part = _part(document, primitive.get("attributes"), where.at("attributes"))
        parts.append(part._replace(remarks=remarks + part.remarks, linear=linear))
    return parts


def _packed_part(document, held, place):
    """Part of the splats in an SPZ file within."""
    content, _ = document.view(place.members(held).get("bufferView"), place)
    file = spz.FORMAT.read(place.path, content)
    stored = file.splats()

    def fill(target, piece):
        assign(target, stored.take(piece))

    return _Part(len(stored), stored.sh_degree, fill, model=file.model, turn=_SPZ_TURN)


def _part(document, attributes, place):
    attributes = place.members(attributes)
    degree, count, held = 0, 0, {}
    while degree < _DEGREE and f"{EXTENSION}:SH_DEGREE_{degree + 1}_COEF_0" in attributes:
        degree += 1
    wanted = {"POSITION": 3, "ROTATION": 4, "SCALE": 3, "OPACITY": 1}
    for name, width in (wanted | dict.fromkeys(_harmonics(degree), 3)).items():
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
    remarks = ("negative scales: its scales are read as logarithms",) if log else ()

    def fill(target, piece):
        target.means[:] = values("POSITION", piece)
        sizes = values("SCALE", piece)
        # The logarithm of 0 is -104, as of Blender's splats.
        target.log_scales[:] = np.maximum(sizes if log else np.log(sizes, dtype=np.float32), -104.0)
        target.quaternions[:] = np.roll(values("ROTATION", piece), 1, axis=1)
        target.opacity_logits[:] = single_logits(values("OPACITY", piece)[:, 0])
        constant, *others = _harmonics(degree)
        target.sh_dc[:] = values(constant, piece)
        for index, name in enumerate(others):
            target.sh_rest[:, index] = values(name, piece)

    return _Part(count, degree, fill, remarks)


def _half_turned(splats):
    """Splats turned by `_HALF_TURN`, without rounding."""
    w, x, y, z = splats.quaternions.T
    # Half a turn multiplies the harmonic of order m by (-1)^m.
    bands = range(1, splats.sh_degree + 1)
    signs = np.array([(-1.0) ** m for n in bands for m in range(-n, n + 1)], np.float32)
    means = splats.means * np.array([-1.0, -1.0, 1.0], np.float32)
    turns = np.stack([-z, -y, x, w], axis=1)
    return replace(splats, means=means, quaternions=turns, sh_rest=splats.sh_rest * signs[:, None])


def _harmonics(degree):
    """Names of all coefficients up to a degree, the constant first."""
    bands = range(degree + 1)
    return [f"SH_DEGREE_{band}_COEF_{n}" for band in bands for n in range(2 * band + 1)]


def _attributes(degree):
    """Name, type, width and function for values, (n, width), of each attribute, in file order."""
    constant, *others = (f"{EXTENSION}:{name}" for name in _harmonics(degree))
    harmonics = [lambda splats, k=k: splats.sh_rest[:, k] for k in range(len(others))]
    return [
        ("POSITION", _FLOAT, 3, lambda splats: splats.means),
        ("COLOR_0", _BYTE, 4, color_codes),
        (f"{EXTENSION}:ROTATION", _FLOAT, 4, _rotations),
        (f"{EXTENSION}:SCALE", _FLOAT, 3, lambda splats: scales(splats.log_scales)),
        (f"{EXTENSION}:OPACITY", _FLOAT, 1, lambda splats: opacity(splats.opacity_logits)[:, None]),
        (constant, _FLOAT, 3, lambda splats: splats.sh_dc),
        *((name, _FLOAT, 3, harmonic) for name, harmonic in zip(others, harmonics, strict=True)),
    ]


def _rotations(splats):
    return np.roll(unit_quaternions(splats.quaternions), -1, axis=1)  # x y z w


def _write(stream, splats):
    """Write splats as a file with one node; `RefineError` above 4 GiB, the format's limit."""
    attributes = _attributes(splats.sh_degree)
    with np.errstate(under="ignore", over="ignore"):  # doubles beyond float32
        means = np.asarray(splats.means, np.float32) * np.array([-1.0, -1.0, 1.0], np.float32)
        ends = [(end.astype(np.float64) + 0.0).tolist() for end in (means.min(0), means.max(0))]
        text, body = _json(attributes, len(splats), *ends)
        total = _HEADER.size + 2 * _CHUNK.size + len(text) + body
        if total > _LONGEST:
            what = f"{len(splats)} splats are {total} bytes as {NAME}"
            raise RefineError(f"{what}, which holds {_LONGEST}")
        stream.write(_HEADER.pack(_MAGIC, _VERSION, total) + _CHUNK.pack(len(text), _JSON) + text)
        stream.write(_CHUNK.pack(body, _BINARY))
        for _, kind, _, values in attributes:
            for piece in pieces(len(splats)):
                written = values(_half_turned(splats.take(piece)))
                stream.write(np.ascontiguousarray(written, _KINDS[kind]).data)


def _json(attributes, count, low, high):
    """JSON, padded with spaces to a multiple of 4 bytes, and the bytes of the values."""
    views, accessors, at = [], [], 0
    for index, (_, kind, width, _) in enumerate(attributes):
        length = width * np.dtype(_KINDS[kind]).itemsize * count
        views.append({"buffer": 0, "byteOffset": at, "byteLength": length, "target": _VERTICES})
        accessor = {"bufferView": index, "componentType": kind, "count": count}
        accessors.append({**accessor, "type": _SHAPES[width]})
        at += length
    accessors[0].update(min=low, max=high)
    accessors[1]["normalized"] = True
    kernel = {EXTENSION: {"kernel": "ellipse", "colorSpace": _DRAWN["colorSpace"]}}
    names = {name: index for index, (name, *_) in enumerate(attributes)}
    content = {
        "asset": {"version": "2.0", "generator": "REFINE for Blender"},
        "extensionsUsed": [EXTENSION],
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0}],
        "meshes": [{"primitives": [{"attributes": names, "mode": _POINTS, "extensions": kernel}]}],
        "buffers": [{"byteLength": at}],
        "bufferViews": views,
        "accessors": accessors,
    }
    text = json.dumps(content, separators=(",", ":")).encode()
    return text + b" " * (-len(text) % 4), at


def _sizes(count, degree):
    longest = [-1.1754943508222875e-38] * 3
    text, _ = _json(_attributes(degree), count, longest, longest)
    _, row = _json(_attributes(degree), 1, longest, longest)
    return row, _HEADER.size + 2 * _CHUNK.size + len(text)


_LOSS = "holds activated values in single precision, with y up"
FORMAT = Format(
    NAME, ".glb", lambda _, head: head.startswith(_MAGIC), _read, _write, _DEGREE, _LOSS, _sizes
)
READER = Format("glTF", ".gltf", named_json(".gltf"), _read)
