"""Hypothesis strategies, all in this file: PLY files put together by hand, scores, budgets, masks.

Nothing here uses the code under test; a file is a concatenation of bytes whose parts are kept.
"""

import json
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
    form, end = draw(st.sampled_from(forms)), draw(st.sampled_from(LINE_ENDS)).encode()
    return ply_case(form, end, draw(st.integers(least, 5)), draw(st.integers(0, 2**32)))


def ply_case(form: str, end: bytes, count: int, seed: int) -> PlyCase:
    """Return a PLY file of so many splats; all but format and line end comes about by chance."""
    random = np.random.default_rng(seed)
    kinds, text = _splat_kinds(random), form == "ascii"
    dtype = np.dtype([(name, ORDERS[form] + TYPES[kind]) for name, kind in kinds])
    rows = np.frombuffer(random.bytes(count * dtype.itemsize), dtype).copy()
    for name in dtype.names if count else ():
        if dtype[name].kind == "f" and random.random() < 0.2:
            rows[name][random.integers(count)] = random.choice(np.array(ODD_FLOATS, dtype[name]))
    parts = _texts(random, rows) if text else [row.tobytes() for row in rows]
    lead, before = _elements(random, form, "lead")
    tail, after = _elements(random, form, "tail")
    if text and not after and parts and random.random() < 0.5:
        parts[-1] = parts[-1].rstrip(b"\r\n")  # an editor's last line may lack its end
    elif random.random() < 0.5:
        after += b"one more line\n" if text else b"\x00\n\xffmore"
    indent, remark = random.choice(["", " "]), lambda: REMARKS[random.integers(len(REMARKS))]
    own = [f"{indent}property {kind} {name}" for name, kind in kinds]
    first = ["ply", *remark(), f"format {form} 1.0", *remark(), *lead, "element vertex "]
    rest = ["", *remark(), *own, *remark(), *tail, *remark(), "end_header", ""]
    number = f"{random.choice(['', '00'])}{count}"
    head = (end.join(map(str.encode, first)), number.encode(), end.join(map(str.encode, rest)))
    return PlyCase(form, end, head, before, after, rows, tuple(parts))


REMARKS = (
    *([], [], ["comment element vertex 7"], ["comment"], ["comment end_header"], [""]),
    *(["obj_info num_cols 3"], ["comment gemacht für Zoë 🎈"]),
)


def _splat_kinds(random: np.random.Generator) -> list[tuple[str, str]]:
    """Return the names and types of the vertex properties, in file order."""
    names = splat_names(random.integers(5), normals=random.random() < 0.5)
    reals = [["float", "double"], ["float32", "float64"], ["double", "float"]][random.integers(3)]
    mixed = random.choice([0.0, 0.3])  # of properties in another precision than the rest
    kinds = [(name, reals[int(random.random() < mixed)]) for name in names]
    for index in range(random.integers(5)):
        extra = f"extra_{index}", sorted(TYPES)[random.integers(len(TYPES))]
        kinds.insert(random.integers(len(kinds) + 1), extra)
    return [kinds[index] for index in random.permutation(len(kinds))] if mixed else kinds


def _texts(random: np.random.Generator, rows: np.ndarray) -> list[bytes]:
    """Write rows as text, each number so that it reads back as itself."""
    end, space = random.choice(["\n", "\r\n"]), random.choice([" ", "  ", "\t"])
    around, lines = ["", " "], []
    for row in rows:
        words = space.join(str(row[name]) for name in rows.dtype.names)
        lines.append(f"{random.choice(around)}{words}{random.choice(around)}{end}".encode())
    return lines


def _elements(random: np.random.Generator, form: str, prefix: str) -> tuple[list[str], bytes]:
    """Return header lines and body of other elements; lists stand only behind the splats."""
    lengths = ["", *(["uchar", "uint8", "int", "ushort"] * (prefix == "tail"))]
    lines, body = [], b""
    for number in range(random.integers(3)):
        count, kinds = random.integers(4), random.choice(sorted(TYPES), 1 + random.integers(3))
        columns = [(str(random.choice(lengths)), str(kind)) for kind in kinds]
        lines.append(f"element {prefix}{number} {count}")
        for index, (length, kind) in enumerate(columns):
            listed = f"list {length} " if length else ""
            lines.append(f"property {listed}{kind} {prefix}_{index}")
        for _ in range(count):
            row: list[tuple[str, np.ndarray]] = []
            for length, kind in columns:
                values = random.integers(0, 100, random.integers(4) if length else 1)
                row += [(length, np.array([len(values)]))] if length else []
                row.append((kind, values))
            if form == "ascii":
                body += " ".join(str(value) for _, some in row for value in some).encode() + b"\n"
            else:
                body += b"".join(some.astype(ORDERS[form] + TYPES[k]).tobytes() for k, some in row)
    return lines, body


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


def cameras_json(places: dict[str, list[float]], focal: float, width: int, height: int) -> str:
    """Return Inria's cameras.json of cameras by name that look along z, y down."""
    lens = {"fx": focal, "fy": focal, "width": width, "height": height}
    pose = {"rotation": np.eye(3).tolist()} | lens
    return json.dumps([{"img_name": n, "position": p, **pose} for n, p in places.items()])


def plain_header(count: object, names: list[str], form: str = "binary_little_endian") -> bytes:
    """Return the header of a PLY whose vertices have float properties of these names."""
    lines = ["ply", f"format {form} 1.0", f"element vertex {count}"]
    lines += [f"property float {name}" for name in names]
    return "\n".join([*lines, "end_header", ""]).encode()
