"""Hypothesis strategies, all in this file: PLY files put together by hand, scores, budgets, masks.

Nothing here uses the code under test; a file is a concatenation of bytes whose parts are kept.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from hypothesis import strategies as st

_SPELLED = {
    "i1": "char int8", "u1": "uchar uint8", "i2": "short int16", "u2": "ushort uint16",
    "i4": "int int32", "u4": "uint uint32", "f4": "float float32", "f8": "double float64",
}  # fmt: skip
TYPES = {name: kind for kind, names in _SPELLED.items() for name in names.split()}
"""Every name that a PLY gives a type -> NumPy's."""

ORDERS = {"binary_little_endian": "<", "binary_big_endian": ">", "ascii": "="}

LINE_ENDS = ("\n", "\r\n", "\r")

ODD_FLOATS = (0.0, -0.0, 1.0, -1.5, 1e-40, 3e38, np.inf, -np.inf, np.nan)


def splat_names(degree: int, *, normals: bool = False) -> list[str]:
    """Return the properties of a splat in the order of the reference implementation."""
    names = ["x", "y", "z", *(["nx", "ny", "nz"] if normals else [])]
    names += [f"f_dc_{index}" for index in range(3)]
    names += [f"f_rest_{index}" for index in range(3 * ((degree + 1) ** 2 - 1))]
    names += ["opacity", "scale_0", "scale_1", "scale_2"]
    return [*names, *(f"rot_{index}" for index in range(4))]


@dataclass(frozen=True, eq=False)
class PlyCase:
    """A PLY file in its parts."""

    form: str  # ascii, binary_little_endian or binary_big_endian
    line_end: bytes  # of the header
    head: tuple[bytes, bytes, bytes]  # ahead of the number of vertices, that, and behind it
    before: bytes  # the body ahead of the vertex rows
    after: bytes  # and behind them
    rows: np.ndarray  # (N,) structured: what the vertex rows hold
    parts: tuple[bytes, ...]  # each row as it stands in the file

    @property
    def data(self) -> bytes:
        """The file."""
        return b"".join([*self.head, self.before, *self.parts, self.after])

    def pruned(self, keep: np.ndarray, parts: Sequence[bytes] | None = None) -> bytes:
        """Return the file that holds the kept rows alone, or others in their place."""
        number = self.head[1] if keep.all() else str(int(keep.sum())).encode()
        parts = self.parts if parts is None else parts
        kept = [part for part, stays in zip(parts, keep, strict=True) if stays]
        return b"".join([self.head[0], number, self.head[2], self.before, *kept, self.after])


@st.composite
def ply_files(draw: st.DrawFn, *, least: int = 0, forms: tuple[str, ...] = tuple(ORDERS)):
    """Draw 3DGS PLY files in every shape that the format allows."""
    form = draw(st.sampled_from(forms))
    line_end = draw(st.sampled_from(LINE_ENDS))
    random = np.random.default_rng(draw(st.integers(0, 2**32)))
    kinds = _splat_kinds(draw, random)
    count = draw(st.integers(least, 5))
    dtype = np.dtype([(name, ORDERS[form] + TYPES[kind]) for name, kind in kinds])
    rows = np.frombuffer(random.bytes(count * dtype.itemsize), dtype).copy()
    for name in dtype.names if count else ():
        if dtype[name].kind == "f" and random.random() < 0.2:
            rows[name][random.integers(count)] = random.choice(np.array(ODD_FLOATS, dtype[name]))
    parts = _texts(random, rows) if form == "ascii" else [row.tobytes() for row in rows]
    before, after = (_elements(draw, random, form, prefix) for prefix in ("lead", "tail"))
    tail = b"".join(body for _, body in after)
    if form == "ascii" and not tail and parts and draw(st.booleans()):
        parts[-1] = parts[-1].rstrip(b"\r\n")  # an editor's last line may lack its end
    else:
        trailing = (b"", b"one more line\n") if form == "ascii" else (b"", b"\x00\n\xffmore")
        tail += draw(st.sampled_from(trailing))
    spelled = draw(st.sampled_from([str(count), f"00{count}"]))
    lead, rest = _header_lines(draw, form, (before, kinds, after))
    end = line_end.encode()
    head = (
        end.join([*lead, b"element vertex "]),
        spelled.encode(),
        end + end.join([*rest, b"end_header", b""]),
    )
    body = b"".join(body for _, body in before)
    return PlyCase(form, end, head, body, tail, rows, tuple(parts))


def _splat_kinds(draw: st.DrawFn, random: np.random.Generator) -> list[tuple[str, str]]:
    """Draw the names and types of the vertex properties, in file order."""
    names = splat_names(draw(st.integers(0, 4)), normals=draw(st.booleans()))
    real = draw(st.sampled_from(["float", "float32", "double", "float64"]))
    kinds = [(name, real) for name in names]
    if draw(st.booleans()):  # some properties in another precision than the rest
        other = {"float": "double", "float32": "float64"}.get(real, "float")
        kinds = [(name, other if random.random() < 0.3 else kind) for name, kind in kinds]
    extra = draw(st.lists(st.sampled_from(sorted(TYPES)), max_size=4))
    for index, kind in enumerate(extra):
        kinds.insert(random.integers(len(kinds) + 1), (f"extra_{index}", kind))
    if draw(st.booleans()):
        random.shuffle(kinds)
        kinds = [(str(name), str(kind)) for name, kind in kinds]
    return kinds


def _texts(random: np.random.Generator, rows: np.ndarray) -> list[bytes]:
    """Write rows as text, each number so that it reads back as itself."""
    end, space = random.choice(["\n", "\r\n"]), random.choice([" ", "  ", "\t"])
    around, lines = ["", " "], []
    for row in rows:
        words = space.join(str(row[name]) for name in rows.dtype.names)
        lines.append(f"{random.choice(around)}{words}{random.choice(around)}{end}".encode())
    return lines


def _elements(
    draw: st.DrawFn, random: np.random.Generator, form: str, prefix: str
) -> list[tuple[list[bytes], bytes]]:
    """Draw other elements, as their header lines and their body; lists only behind the splats."""
    length = st.sampled_from(["", *(["uchar", "uint8", "int", "ushort"] * (prefix == "tail"))])
    column = st.tuples(length, st.sampled_from(sorted(TYPES)))
    elements = []
    for number in range(draw(st.integers(0, 2))):
        count, columns = draw(st.integers(0, 3)), draw(st.lists(column, min_size=1, max_size=3))
        lines = [f"element {prefix}{number} {count}"]
        for index, (length_kind, kind) in enumerate(columns):
            listed = f"list {length_kind} " if length_kind else ""
            lines.append(f"property {listed}{kind} {prefix}_{index}")
        body = b"".join(_element_row(random, form, columns) for _ in range(count))
        elements.append(([line.encode() for line in lines], body))
    return elements


def _element_row(random: np.random.Generator, form: str, columns: list[tuple[str, str]]) -> bytes:
    order, parts, words = ORDERS[form], [], []
    for length, kind in columns:
        size = int(random.integers(4)) if length else 1
        values = random.integers(0, 100, size).astype(order + TYPES[kind])
        if length:
            parts.append(np.array(size, order + TYPES[length]).tobytes())
            words.append(str(size))
        parts.append(values.tobytes())
        words += map(str, values)
    return (" ".join(words) + "\n").encode() if form == "ascii" else b"".join(parts)


REMARKS = (
    *("comment element vertex 7", "comment", "comment end_header", "obj_info num_cols 3", ""),
    "comment gemacht für Zoë 🎈",
)


def _header_lines(draw: st.DrawFn, form: str, elements: tuple) -> tuple[list[bytes], list[bytes]]:
    """Return the header's lines ahead of the vertex element and behind it, comments among them."""
    before, kinds, after = elements
    remark = st.sampled_from([[], *([text.encode()] for text in REMARKS)])
    lead = [b"ply", *draw(remark), b"format %s 1.0" % form.encode(), *draw(remark)]
    lead += [line for lines, _ in before for line in lines]
    rest = draw(remark) + [f"property {kind} {name}".encode() for name, kind in kinds]
    rest += draw(remark) + [line for lines, _ in after for line in lines] + draw(remark)
    indent = draw(st.sampled_from([b"", b" "]))
    return lead, [indent + line if line.startswith(b"prop") else line for line in rest]


def scores(least: int = 1, most: int = 40):
    """Draw float32 scores, finite and not negative, many of them equal."""
    value = st.one_of(st.sampled_from([0.0, 1.0, 1e-38, 3e38]), st.floats(0.0, 100.0, width=32))
    return st.lists(value, min_size=least, max_size=most).map(lambda v: np.array(v, np.float32))


def masks(count: int):
    """Draw a bool for each of `count` splats."""
    return st.lists(st.booleans(), min_size=count, max_size=count).map(
        lambda values: np.array(values, np.bool_)
    )


def plain_ply(count: int = 3, degree: int = 0, *, seed: int = 0) -> bytes:
    """Return a binary little-endian 3DGS PLY of tame random splats around (0, 0, 4)."""
    names = splat_names(degree)
    values = np.random.default_rng(seed).normal(0.0, 0.3, (count, len(names))).astype("<f4")
    values[:, 2] += 4.0
    values[:, [names.index(f"scale_{axis}") for axis in range(3)]] -= 3.0
    return plain_header(count, names) + values.tobytes()


def ply_of(columns: dict[str, np.ndarray], comments: Sequence[str] = ()) -> bytes:
    """Return a binary little-endian PLY with a property a column, in their order and types."""
    names = {value: name for name, value in TYPES.items() if not name[-1].isdigit()}
    rows = np.empty(len(columns["x"]), [(n, v.dtype.newbyteorder("<")) for n, v in columns.items()])
    for name, values in columns.items():
        rows[name] = values
    lines = ["ply", "format binary_little_endian 1.0", *(f"comment {text}" for text in comments)]
    lines.append(f"element vertex {len(rows)}")
    lines += [f"property {names[v.dtype.str[1:]]} {name}" for name, v in columns.items()]
    return "\n".join([*lines, "end_header", ""]).encode() + rows.tobytes()


def plain_header(count: object, names: list[str], form: str = "binary_little_endian") -> bytes:
    """Return the header of a PLY whose vertices have float properties of these names."""
    lines = ["ply", f"format {form} 1.0", f"element vertex {count}"]
    lines += [f"property float {name}" for name in names]
    return "\n".join([*lines, "end_header", ""]).encode()
