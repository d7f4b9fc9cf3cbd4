"""``.splat`` files: 32 bytes a splat and nothing else, as antimatter15/splat introduced them.

Mean and linear scale are float32, colour, opacity and rotation 8 bits each. The files have no
signature and are known by their name alone.
"""

from __future__ import annotations

import numpy as np

from ..errors import RefineError
from ..splats import scales, unit_quaternions
from .format import Format, color_codes, named, new_file, pieces, set_colors

NAME = ".splat"

_ROW = np.dtype(
    [("mean", "<f4", 3), ("scale", "<f4", 3), ("color", "u1", 4), ("rotation", "u1", 4)]
)
"""Of one splat: colour is red, green, blue and opacity, rotation is w x y z."""

_NO_TURN = 128.0  # code of 0 in a rotation, and the step from 0 to 1


def _read(path, data):
    size = _ROW.itemsize
    count, beyond = divmod(len(data), size)
    if beyond:
        where = f"splat {count} at byte {count * size}"
        raise RefineError(f"{path}: truncated: {where} has {beyond} bytes, expected {size}")
    stored = data.view(_ROW)
    file, splats = new_file(path, (NAME, len(data)), count, 0)
    # Scales that are 0 or no sizes at all become logarithms that are not finite, as in a PLY.
    with np.errstate(divide="ignore", invalid="ignore"):
        for piece in pieces(count):
            rows, target = stored[piece], splats.take(piece)
            target.means[:] = rows["mean"]
            target.log_scales[:] = np.log(rows["scale"])
            set_colors(target, rows["color"] / 255.0)
            target.quaternions[:] = unit_quaternions(rows["rotation"] / _NO_TURN - 1.0)
    return file


def _write(stream, splats):
    for piece in pieces(len(splats)):
        batch = splats.take(piece)
        rows = np.empty(len(batch), _ROW)
        rows["mean"] = batch.means
        with np.errstate(under="ignore"):
            rows["scale"] = scales(batch.log_scales)
        rows["color"] = color_codes(batch)
        turns = np.rint(unit_quaternions(batch.quaternions) * _NO_TURN + _NO_TURN)
        rows["rotation"] = np.clip(turns, 0.0, 255.0)
        stream.write(rows.data)


_LOSS = "holds colour, opacity and rotation in 8 bits each"
FORMAT = Format(NAME, NAME, named(NAME), _read, _write, 0, _LOSS, lambda *_: (_ROW.itemsize, 0))
