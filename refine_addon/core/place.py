"""Checks of values in files, with errors that name the place, and names of other file formats."""

from __future__ import annotations

import json
import stat
import zipfile
import zlib
from collections.abc import Callable, Sequence
from contextlib import suppress
from pathlib import Path, PurePosixPath
from typing import Any, NamedTuple, NoReturn, Self, TypeGuard

from .errors import RefineError
from .whole_file import Url, mode_of

LARGEST_NUMBER = 1e18  # largest number taken, such as a coordinate: its square fits float32
LARGEST_COUNT = 1 << 53  # largest whole number that is taken: floats hold every one up to it
NEGLIGIBLE = 1e-30  # smaller numbers are read as 0, so that products of two do not underflow
_SHOWN = 40  # most characters of a value in a message
GZIP = b"\x1f\x8b"  # the first bytes of a gzip file
SPZ = b"NGSP"  # the first bytes of what an SPZ file holds
_ZIP = b"PK\x03\x04"


class Place(NamedTuple):
    """A file and a place in it, such as "camera 3"; "" for the whole file.

    Each method that checks a JSON value returns it, or raises `RefineError` with the file, the
    place, what was expected and what was got.
    """

    path: Path
    where: str = ""

    def at(self, where: str) -> Self:
        """A place within this one."""
        return type(self)(self.path, f"{self.where} {where}" if self.where else where)

    def fail(self, problem: str) -> NoReturn:
        """Raise `RefineError` with this place."""
        where = f"{self.where}: " if self.where else ""
        raise RefineError(f"{self.path}: {where}{problem}")

    def expected(self, what: str, value: object) -> NoReturn:
        """Raise `RefineError` with this place, what was expected there, and what was got."""
        self.fail(f"expected {what}, got {described(value)}")

    def number(self, value: object) -> float:
        """A number of at most `LARGEST_NUMBER`."""
        if not isinstance(value, (int, float)) or isinstance(value, bool):
            self.expected("a number", value)
        if not abs(value) <= LARGEST_NUMBER:  # also refuses NaN, and integers too large for float
            self.expected("a finite number up to 1e18", value)
        return float(value) if abs(value) >= NEGLIGIBLE else 0.0

    def numbers(self, value: object, count: int) -> list[float]:
        """A list of `count` numbers."""
        if not isinstance(value, list) or len(value) != count:
            self.expected(f"a list of {count} numbers", value)
        return [self.at(f"[{index}]").number(item) for index, item in enumerate(value)]

    def whole(self, value: object, least: int = 0, most: int = LARGEST_COUNT) -> int:
        """A whole number from `least` to `most`."""
        if not is_whole(value) or not least <= value <= most:
            self.expected(f"a whole number from {least} to {most}", value)
        return value

    def text(self, value: object) -> str:
        """A string."""
        if not isinstance(value, str):
            self.expected("a string", value)
        return value

    def items(self, value: object) -> list[Any]:
        """A list."""
        if not isinstance(value, list):
            self.expected("a list", value)
        return value

    def members(self, value: object, required: Sequence[str] = ()) -> dict[str, Any]:
        """A JSON object with these keys."""
        if not isinstance(value, dict):
            self.expected("an object", value)
        missing = [key for key in required if key not in value]
        if missing:
            self.fail(f"missing {missing[0]!r}, expected the keys {', '.join(required)}")
        return value

    def beside(self, name: str) -> Path:
        """Path of a file that this one names; `RefineError` unless in its folder or one below."""
        steps = PurePosixPath(name).parts
        if not steps or name.startswith("/") or ".." in steps or not set("\\:\0").isdisjoint(name):
            self.fail(f"{described(name)}, expected a file in this folder or one below")
        path = self.path.parent.joinpath(*steps)
        with suppress(OSError, ValueError):  # a name too long, a folder that may not be entered
            if stat.S_ISREG(mode_of(path)):
                return path
        self.fail(f"{described(name)} is not there")

    def parsed(self, text: bytes | str) -> Any:
        """Value of a JSON text; `RefineError` with line and column if it is none."""
        try:
            return json.loads(text)
        except json.JSONDecodeError as error:
            self.at(f"line {error.lineno} column {error.colno}").fail(f"invalid JSON: {error.msg}")
        except RecursionError:
            self.fail("invalid JSON: nested too deeply")
        except ValueError as error:  # no UTF-8, or an integer of thousands of digits
            self.fail(f"invalid JSON: {error}")


def is_whole(value: object) -> TypeGuard[int]:
    """Whether a JSON value is a whole number."""
    return isinstance(value, int) and not isinstance(value, bool)


def described(value: object) -> str:
    """Short description of a JSON value, for messages."""
    if isinstance(value, dict):
        return f"an object with {len(value)} keys"
    if isinstance(value, list):
        return f"a list of {len(value)}"
    text = json.dumps(value)
    return text if len(text) <= _SHOWN else f"{text[: _SHOWN - 3]}..."


def refuse_pointer(path: Path | Url, head: bytes) -> None:
    """Raise `RefineError` if a file's first bytes are a Git LFS pointer, left for a large file."""
    if head.startswith(b"version https://git-lfs.github.com/spec/"):
        raise RefineError(
            f"{path}: a Git LFS pointer, not the file itself: 'git lfs pull' fetches that"
        )


def foreign_kind(path: Path | Url, head: bytes) -> str:
    """Name of a known format other than plain PLY, and advice, by name and first bytes; or ""."""
    suffix, read = path.suffix.lower(), "'refine convert IN OUT.ply' makes a plain 3DGS PLY of it"
    if suffix in (".splat", ".ksplat"):  # only the name tells: they have no signature
        return f"a {suffix} file: {read}"
    if suffix == ".gltf" and head.lstrip().startswith(b"{"):
        return f"a glTF file: {read}"
    if is_spz(head):
        return f"an SPZ file: {read}"
    if is_sog(path, head):
        return f"a SOG file: {read}"
    for signature, packed in ((GZIP, "compressed with gzip"), (_ZIP, "a ZIP archive")):
        if head.startswith(signature):
            return f"{packed}: unpack it first"
    if suffix == ".spz" and head and not head.startswith(b"ply"):
        return f"a damaged SPZ file: begins with {head[:4]!r}, expected {SPZ!r} or {GZIP!r}"
    return ""


def named_json(end: str) -> Callable[[Path, bytes], bool]:
    """Whether a file, by path and first bytes, is JSON of a name with this `end`, as a function."""
    return lambda path, head: path.name.lower().endswith(end) and head.lstrip().startswith(b"{")


def is_spz(head: bytes) -> bool:
    """Whether these are the first bytes of an SPZ file, plain or in gzip."""
    with suppress(zlib.error):
        head = zlib.decompressobj(16 + zlib.MAX_WBITS).decompress(head, len(SPZ))
    return head.startswith(SPZ)


def is_sog(path: Path | Url, head: bytes) -> bool:
    """Whether a file is a SOG: a ZIP archive by that name or with meta.json and images."""
    if not head.startswith(_ZIP) or path.suffix.lower() == ".sog":
        return head.startswith(_ZIP)
    try:
        with zipfile.ZipFile(path) as archive:
            names = [PurePosixPath(name) for name in archive.namelist()]
    except (OSError, ValueError, ArithmeticError, NotImplementedError, zipfile.BadZipFile):
        return False
    return any(n.name == "meta.json" for n in names) and any(n.suffix == ".webp" for n in names)
