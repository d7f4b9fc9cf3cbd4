"""Feed broken files to every reader, for as long as there is time.

    python -m tests.fuzz [--seconds 300] [--seed N]

Good files of every format are broken by chance. Each must end in a `RefineError` that names the
file, or in a result that holds together. Anything else, a warning of NumPy's, much memory and a run
of seconds among it, is a crash: the input is kept and the exit code is 1.
"""

import argparse
import base64
import gzip
import io
import json
import random
import re
import struct
import sys
import tempfile
import time
import traceback
import tracemalloc
import warnings
import zipfile
from collections.abc import Callable
from functools import partial
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np

ROOT = Path(__file__).parents[1]
sys.path.insert(0, str(ROOT))

from refine_addon.command.subcommands import describe
from refine_addon.core import RefineError, read_cameras, read_ply, read_splats, write_splats
from refine_addon.core.execute import within
from refine_addon.core.formats.ply_columns import empty_rows, splats_from_columns
from refine_addon.core.formats.registry import FORMATS, SUFFIXES
from refine_addon.core.methods import ClosedForm
from refine_addon.core.prune import score
from refine_addon.core.scoring import occlusion
from tests.core.test_camera_files import FRAME, INRIA, MATRIX, TRANSFORMS
from tests.core.test_colmap import HALVES, TWO, WRITERS
from tests.strategies import LINE_ENDS, ORDERS, ply_case, splat_names

MEMORY = 40_000_000  # bytes that any small input may cost; NumPy and JSON need some of their own
SECONDS = 5.0  # of the processor; an input that takes longer is a crash too

WORDS = (
    *(b"element vertex 3", b"element face 2", b"property float x", b"property list uchar int i"),
    *(b"property list float double d", b"end_header\n", b"comment \xff", b"obj_info", b"format"),
    *(b"ascii 1.0", b"binary_big_endian 1.0", b"ply\r\n", b"\r", b"\n", b"\0", b" ", b"\t", b"#"),
    *(b"[", b"]", b"{", b"}", b'"', b"\\ud800", b",", b":", b"null", b"NaN", b"-Infinity"),
)
NUMBERS = (
    *("0", "-1", "1", "255", "256", "65536", "2147483648", "4294967295", "9223372036854775808"),
    *("18446744073709551616", "9" * 400, "1e400", "-1e-400", "nan", "inf", "1_0", "0x10", "1.5"),
)
VALUES = (
    *(None, True, False, "", "x" * 500, "\ud800", [], {}, [[]], {"a": 1}, 0, -1, 1, 0.5, 1e-320),
    *(1e18, 1e19, 1e300, float("nan"), float("inf"), -float("inf"), 10**18, 10**400, -(10**30)),
)
"""What a number, a list or a name in a JSON file is replaced with."""

PLY_KINDS = [(f, end.encode(), 3, seed) for f in ORDERS for end in LINE_ENDS for seed in range(2)]
Files = dict[str, bytes]  # a file, or several that belong together, by name


def format_seeds(form: Any) -> list[Files]:
    """Files of a format other than plain PLY, written by ours."""
    seeds = []
    for degree in (0, 1):
        rows, splats = empty_rows(5, degree)
        for values in (splats.means, splats.log_scales, splats.quaternions, splats.sh_dc):
            values[:] = np.random.default_rng(degree).normal(size=values.shape)
        splats.opacity_logits[:], splats.sh_rest[:] = np.linspace(-4.0, 4.0, 5), 0.1
        stream = io.BytesIO()
        form.write(stream, splats_from_columns(rows).up_to_degree(form.degree))
        seeds.append({f"in{form.suffix}": stream.getvalue()})
    if form.name == "SPZ":  # in the open, so that what is broken reaches what is inside
        seeds += [{"in.spz": gzip.decompress(seed["in.spz"])} for seed in seeds]
    return seeds


def transforms_seeds() -> list[Files]:
    """``transforms.json`` of nerfstudio and of instant-ngp, and what lies beside it."""
    studio = {**TRANSFORMS, "camera_model": "OPENCV", "k1": 0.1, "applied_transform": MATRIX[:3]}
    frames = [{**FRAME, "fl_x": 400.0, "w": 320, "h": 200}]
    ngp = {"camera_angle_x": 0.8, "w": 640.0, "h": 480.0, "aabb_scale": 4, "frames": frames}
    seeds = [{"transforms.json": json.dumps(content).encode()} for content in (studio, ngp)]
    beside = json.dumps({"transform": MATRIX[:3], "scale": 0.5}).encode()
    return [*seeds, {**seeds[0], "dataparser_transforms.json": beside}]


def colmap_seeds(suffix: str) -> list[Files]:
    """A model of two cameras and two images."""
    parts = zip(HALVES, TWO, WRITERS[suffix], strict=True)
    return [{f"{stem}{suffix}": write(things) for stem, things, write in parts}]


def sog_seeds() -> list[Files]:
    """What is in SOG files, so that what is broken is not the archive alone."""
    seeds = []
    for seed in format_seeds(FORMATS[SUFFIXES.index(".sog") - 1]):
        with zipfile.ZipFile(io.BytesIO(seed["in.sog"])) as archive:
            seeds.append({name: archive.read(name) for name in archive.namelist()})
    return seeds


def gltf_seeds() -> list[Files]:
    """GLB files as JSON, so that values are broken; their bytes are in base64."""
    seeds = []
    for data in (seed["in.glb"] for seed in format_seeds(FORMATS[SUFFIXES.index(".glb") - 1])):
        end = 20 + int.from_bytes(data[12:16], "little")
        content = json.loads(data[20:end])
        content["buffers"][0]["uri"] = f"data:;base64,{base64.b64encode(data[end + 8 :]).decode()}"
        seeds.append({"in.gltf": json.dumps(content).encode()})
    return seeds


def version_1_of(files: Files) -> Files:
    """The files of a SOG with what version 1 says in place of version 2."""
    held = json.loads(files["meta.json"])
    meta = {name: {"files": held[name]["files"]} for name in ("means", "scales", "quats", "sh0")}
    meta["means"] |= {"shape": [held["count"], 3], "mins": [-1, -1, -1], "maxs": [1, 1, 1]}
    meta["scales"] |= {"mins": [-9, -9, -9], "maxs": [-1, -1, -1]}
    meta["sh0"] |= {"mins": [-2, -2, -2, -5], "maxs": [2, 2, 2, 5]}
    if "shN" in held:
        meta["shN"] = {"files": held["shN"]["files"], "mins": -1, "maxs": 1}
    return {**files, "meta.json": json.dumps(meta).encode()}


def ksplat_seeds() -> list[Files]:
    """What files of the reference converter hold, without the zeros between."""
    seeds = []
    for name in ("level_0", "level_1", "level_2", "degree_1"):
        data = (ROOT / f"tests/data/other_tools/{name}.ksplat").read_bytes()
        starts = [4096 + 1024 * number for number in range(data[4])]
        sections = {f"{1 + n}": data[at : at + 42] for n, at in enumerate(starts)}
        seeds.append({"0": data[:44], **sections, "9": data[4096 + 1024 * data[4] :]})
    return seeds


def broken(files: Files, others: list[Files], chance: random.Random) -> Files:
    """The files with one of them broken in one to five ways."""
    name = chance.choice(sorted(files))
    data = files[name]
    for _ in range(chance.choice((1, 1, 1, 2, 3, 5))):
        if name.endswith((".json", ".gltf")) and chance.random() < 0.6:
            data = _other_value(data, chance)
        else:
            other = chance.choice(others).get(name, data)
            data = chance.choice((_flip, _put, _put, _number, _splice))(data, other, chance)
    return {**files, name: data[:200_000]}


def _flip(data: bytes, _: bytes, chance: random.Random) -> bytes:
    changed = bytearray(data)
    for _ in range(chance.choice((1, 1, 4, 30)) if data else 0):
        value = chance.choice((0, 255, 10, 13, 32, chance.randrange(256)))
        changed[chance.randrange(len(changed))] = value
    return bytes(changed)


def _put(data: bytes, other: bytes, chance: random.Random) -> bytes:
    """Put a word, a number, a line or a piece of a file among others or over them."""
    value = chance.choice((0, 1, 255, 2**31, 2**32 - 1, 2**63, 2**64 - 1, 0x7FF4000000000001))
    kind = chance.choice(["<Q", ">Q", "<I", "<B"])
    start, length = chance.randint(0, len(data)), chance.choice((1, 4, 8, 60, 200))
    piece = chance.choice(
        (
            *(b"", chance.choice(WORDS), b"\n" + chance.choice(other.split(b"\n")) + b"\n"),
            *(data[start : start + length] * chance.choice((2, 3, 100)), chance.choice(WORDS)),
            struct.pack(kind, value & (1 << 8 * struct.calcsize(kind)) - 1),
        )
    )
    return data[:start] + piece + data[start + chance.choice((0, len(piece), length)) :]


def _number(data: bytes, _: bytes, chance: random.Random) -> bytes:
    found = [match.span() for match in re.finditer(rb"-?[0-9.]+", data[:5000])] or [(0, 0)]
    start, end = chance.choice(found)
    return data[:start] + chance.choice(NUMBERS).encode() + data[end:]


def _splice(data: bytes, other: bytes, chance: random.Random) -> bytes:
    rest = other[chance.randint(0, len(other)) :]
    return data[: chance.randint(0, len(data))] + chance.choice((b"", rest))


def _places(node: Any) -> list[tuple[Any, Any]]:
    """Every value within, as what holds it and its key or index."""
    keys = {list: lambda: range(len(node)), dict: lambda: list(node)}.get(type(node), tuple)()
    return [(node, k) for k in keys] + [place for k in keys for place in _places(node[k])]


def _other_value(data: bytes, chance: random.Random) -> bytes:
    try:
        content = json.loads(data)
        node, key = chance.choice(_places(content))
    except (ValueError, RecursionError, IndexError):
        return data
    other, many = chance.choice(VALUES), [node[key]] * chance.choice((1, 2, 1000))
    node[key] = chance.choice((*[other] * 7, many, many))
    if chance.random() < 0.1:
        del node[key]
    return json.dumps(content).encode()


def use_ply(folder: Path) -> None:
    path, again = folder / "in.ply", folder / "out.ply"
    file = read_ply(path)
    file.splats()
    describe(file)
    file.write(again, overwrite=True)
    same = path.read_bytes() == again.read_bytes()
    assert same or not file.format.startswith("binary"), "with nothing pruned it differs"
    keep = np.arange(len(file)) % 2 == 0
    file.write(again, keep, columns={"mine": np.ones(len(file), np.float32)}, overwrite=True)
    assert len(read_ply(again)) == int(keep.sum()), "pruned it holds another number of splats"


def use_splats(folder: Path, name: str = "in.*", suffix: str | None = None) -> None:
    """Convert a file of another format, and write it in that format again, or in another."""
    (path,) = folder.glob(name)
    file = read_splats(path)
    describe(file)
    file.write(folder / "out.ply")
    try:
        write_splats(path.with_suffix(suffix or path.suffix), file, overwrite=True)
    except RefineError as error:
        if not re.search("can be drawn: nothing|coordinates up to", str(error)):
            raise


def use_ksplat(folder: Path) -> None:
    header, *sections, rest = (path.read_bytes() for path in sorted(folder.iterdir()))
    padded = b"".join(data[:1024].ljust(1024, b"\0") for data in sections)
    (folder / "in.ksplat").write_bytes(header[:4096].ljust(4096, b"\0") + padded + rest)
    use_splats(folder, "in.ksplat", ".splat")


def use_cameras(folder: Path) -> None:
    """Read cameras, and score a few splats by them, by either method."""
    files = sorted(path for path in folder.iterdir() if path.name != "dataparser_transforms.json")
    views = read_cameras(files[0])
    values = np.random.default_rng(0).normal(size=(20, 14)).astype(np.float32)
    values[:, :3] += (-3.0, 2.0, 3.0)  # what the good cameras look at
    splats = splats_from_columns(dict(zip(splat_names(0), values.T, strict=True)))
    try:  # in this thread: NumPy's flags are raised in it alone
        first = score(splats, views, ClosedForm(), threads=1).values
        second = within(cores=1)(occlusion.score)(splats, views, rounds=1)[0].values
    except RefineError as error:
        if "no camera sees the splats" not in str(error):
            raise
    else:
        assert np.isfinite([first, second]).all(), "scores are not finite"


use_sog = partial(use_splats, name="meta.json", suffix=".sog")
TARGETS: dict[str, tuple[Callable[[], list[Files]], Callable[[Path], Any]]] = {
    "ply": (lambda: [{"in.ply": ply_case(*kind).data} for kind in PLY_KINDS], use_ply),
    **{f.name: (partial(format_seeds, f), use_splats) for f in FORMATS if f.name != "SOG"},
    "glTF": (gltf_seeds, partial(use_splats, suffix=".glb")),
    "SOG": (sog_seeds, use_sog),
    "SOG 1": (lambda: [version_1_of(seed) for seed in sog_seeds()], use_sog),
    ".ksplat": (ksplat_seeds, use_ksplat),
    "cameras.json": (lambda: [{"cameras.json": json.dumps([INRIA] * 2).encode()}], use_cameras),
    "transforms.json": (transforms_seeds, use_cameras),
    "colmap text": (partial(colmap_seeds, ".txt"), use_cameras),
    "colmap binary": (partial(colmap_seeds, ".bin"), use_cameras),
}
if not find_spec("PIL"):
    TARGETS = {name: target for name, target in TARGETS.items() if "SOG" not in name}


class Crash(Exception):
    """Files, and why they led to something other than a result or an error for the user."""


def attempt(files: Files, use: Callable[[Path], Any], folder: Path) -> bool:
    """Use files that may be broken; return whether they were taken, or raise `Crash`."""
    for old in folder.iterdir():
        old.unlink()
    for name, data in files.items():
        (folder / name).write_bytes(data)
    start, message, why = time.process_time(), "", ""
    tracemalloc.reset_peak()
    try:
        with np.errstate(all="raise"):
            use(folder)
    except RefineError as error:
        message = str(error)
        if not message.startswith(str(folder)):
            why = f"the error names no file: {message}"
        elif len(message) > 2000 or not message.isprintable():
            why = f"the error is no sentence: {message[:300]!r}"
    except Exception:
        why = traceback.format_exc()
    took = time.process_time() - start
    if took > SECONDS:
        why = why or f"took {took:.1f} s"
    if tracemalloc.is_tracing() and tracemalloc.get_traced_memory()[1] > MEMORY:
        why = why or f"took {tracemalloc.get_traced_memory()[1]} bytes of memory"
    if why:
        raise Crash(files, why)
    return not message


def fuzz(name: str, chance: random.Random, going: Callable[[int], bool]) -> tuple[int, int]:
    """Try broken files as long as `going` says so; return how many, and how many were taken."""
    make, use = TARGETS[name]
    seeds = make()
    tried = taken = 0
    with tempfile.TemporaryDirectory() as made, warnings.catch_warnings():
        warnings.simplefilter("error")
        for seed in seeds:
            if not attempt(seed, use, Path(made)):
                raise Crash(seed, "a good file is refused")
        while going(tried):
            tried += 1
            taken += attempt(broken(chance.choice(seeds), seeds, chance), use, Path(made))
    return tried, taken


def main(arguments: list[str] | None = None) -> int:
    """Fuzz every reader in turn; return the exit code."""
    parser = argparse.ArgumentParser(description="Feed broken files to every reader.")
    parser.add_argument("--seconds", type=float, default=300.0, help="for all formats together")
    parser.add_argument("--seed", type=int, default=None, help="the same inputs again")
    parser.add_argument("--keep", type=Path, default=ROOT / "build/fuzz", help="for what crashes")
    options = parser.parse_args(arguments)
    seed = random.SystemRandom().randrange(2**32) if options.seed is None else options.seed
    print(f"seed {seed}, {options.seconds:g} s")
    total = crashes = 0
    tracemalloc.start()
    for name in TARGETS:
        end = time.monotonic() + options.seconds / len(TARGETS)
        try:
            chance = random.Random(f"{seed} {name}")
            tried, taken = fuzz(name, chance, lambda _, end=end: time.monotonic() < end)
        except Crash as crash:
            crashes += 1
            files, why = crash.args
            where = options.keep / name.replace(" ", "_")
            where.mkdir(parents=True, exist_ok=True)
            for file, data in files.items():
                (where / file).write_bytes(data)
            print(f"{name}: CRASH, input kept in {where}\n{why}")
        else:
            total += tried
            print(f"{name}: {tried} inputs tried, {taken} taken, {tried - taken} refused")
    tracemalloc.stop()
    print(f"{total} inputs tried, {crashes} crashes")
    return int(crashes > 0)


if __name__ == "__main__":
    sys.exit(main())
