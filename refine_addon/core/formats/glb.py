"""Writing binary glTF (``.glb``) with KHR_gaussian_splatting, with the conventions of `gltf`."""

from __future__ import annotations

import json

import numpy as np

from ..affine import transformed
from ..errors import RefineError
from ..images import linear_of
from ..place import named_json
from ..splats import opacity, scales, unit_quaternions
from . import gltf
from .format import Format, color_codes, pieces

NAME = "GLB"
_LONGEST = (1 << 32) - 1
_FLOAT, _BYTE = 5126, 5121
_VERTICES = 34962  # target of a view


def _attributes(degree):
    """Name, type, width and function for values, (n, width), of each attribute, in file order."""
    constant, *others = (f"{gltf.EXTENSION}:{name}" for name in gltf.harmonics(degree))
    return [
        ("POSITION", _FLOAT, 3, lambda s: s.means),
        ("COLOR_0", _BYTE, 4, lambda s: color_codes(s, linear_of)),
        (f"{gltf.EXTENSION}:ROTATION", _FLOAT, 4, _rotations),
        (f"{gltf.EXTENSION}:SCALE", _FLOAT, 3, lambda s: scales(s.log_scales)),
        (f"{gltf.EXTENSION}:OPACITY", _FLOAT, 1, lambda s: opacity(s.opacity_logits)[:, None]),
        (constant, _FLOAT, 3, lambda s: s.sh_dc),
        *((name, _FLOAT, 3, lambda s, k=k: s.sh_rest[:, k]) for k, name in enumerate(others)),
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
        total = gltf.HEADER.size + 2 * gltf.CHUNK.size + len(text) + body
        if total > _LONGEST:
            raise RefineError(f"{len(splats)} splats are {total} bytes, a {NAME} holds {_LONGEST}")
        stream.write(gltf.HEADER.pack(gltf.MAGIC, gltf.VERSION, total))
        stream.write(gltf.CHUNK.pack(len(text), gltf.JSON) + text)
        stream.write(gltf.CHUNK.pack(body, gltf.BINARY))
        start = stream.tell()
        for piece in pieces(len(splats)):
            turned, at = transformed(splats.take(piece), gltf.HALF_TURN), start
            for _, kind, width, values in attributes:
                written = np.ascontiguousarray(values(turned), gltf.KINDS[kind])
                row = width * written.itemsize
                stream.seek(at + row * piece.start)
                stream.write(written.data)
                at += row * len(splats)


def _json(attributes, count, low, high):
    """JSON, padded with spaces to a multiple of 4 bytes, and the bytes of the values."""
    views, accessors, at = [], [], 0
    for index, (_, kind, width, _) in enumerate(attributes):
        length = width * np.dtype(gltf.KINDS[kind]).itemsize * count
        views.append({"buffer": 0, "byteOffset": at, "byteLength": length, "target": _VERTICES})
        accessor = {"bufferView": index, "componentType": kind, "count": count}
        accessors.append({**accessor, "type": gltf.SHAPES[width]})
        at += length
    accessors[0].update(min=low, max=high)
    accessors[1]["normalized"] = True
    kernel = {gltf.EXTENSION: {"kernel": "ellipse", "colorSpace": gltf.DRAWN["colorSpace"]}}
    names = {name: index for index, (name, *_) in enumerate(attributes)}
    splats = {"attributes": names, "mode": gltf.POINTS, "extensions": kernel}
    content = {
        "asset": {"version": "2.0", "generator": "REFINE for Blender"},
        "extensionsUsed": [gltf.EXTENSION],
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0}],
        "meshes": [{"primitives": [splats]}],
        "buffers": [{"byteLength": at}],
        "bufferViews": views,
        "accessors": accessors,
    }
    text = json.dumps(content, separators=(",", ":")).encode()
    return text + b" " * (-len(text) % 4), at


_LOSS = "holds activated values in single precision, with y up"
FORMAT = Format(NAME, ".glb", gltf.matches, gltf.read, _write, gltf.DEGREE, _LOSS)
READER = Format("glTF", ".gltf", named_json(".gltf"), gltf.read)
