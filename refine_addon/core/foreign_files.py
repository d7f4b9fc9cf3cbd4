"""Files of known kinds where another kind is expected: they are refused with advice what to do."""

from __future__ import annotations

import zipfile
import zlib
from pathlib import Path, PurePosixPath

from .errors import RefineError
from .whole_file import Url

_POINTER = b"version https://git-lfs.github.com/spec/"
GZIP = b"\x1f\x8b"
"""The first bytes of a gzip file."""

SPZ = b"NGSP"
"""The first bytes of what an SPZ file holds."""

_ZIP = b"PK\x03\x04"
_READ = "'refine convert IN OUT.ply' makes a plain 3DGS PLY of it"

_UNSIGNED = (".splat", ".ksplat")
"""Formats that only the file's name tells, since the files have no signature."""


def refuse_pointer(path: Path | Url, head: bytes) -> None:
    """Refuse a Git LFS pointer, which Git leaves in place of a large file.

    Parameters
    ----------
    path : Path or Url
        For the message.
    head : bytes
        The first bytes of the file.

    Raises
    ------
    RefineError
        If it is one; with advice.
    """
    if head.startswith(_POINTER):
        raise RefineError(
            f"{path}: a Git LFS pointer, not the file itself: 'git lfs pull' fetches that"
        )


def refuse_foreign_splats(path: Path | Url, head: bytes) -> None:
    """Refuse splats in another format than PLY, and archives, by the name of their format.

    Parameters
    ----------
    path, head
        See `refuse_pointer`; a few hundred bytes.

    Raises
    ------
    RefineError
        If it is one of them; with advice.
    """
    refuse_pointer(path, head)
    if problem := foreign_kind(path, head):
        raise RefineError(f"{path}: {problem}")


def foreign_kind(path: Path | Url, head: bytes) -> str:
    """What a file in another format is and what to do with it; "" if it is not known.

    Parameters
    ----------
    path, head
        See `refuse_foreign_splats`.
    """
    suffix = path.suffix.lower()
    if suffix in _UNSIGNED:
        return f"a {suffix} file: {_READ}"
    if is_spz(head):
        return f"an SPZ file: {_READ}"
    if is_sog(path, head):
        return f"a SOG file: {_READ}"
    for signature, packed in ((GZIP, "compressed with gzip"), (_ZIP, "a ZIP archive")):
        if head.startswith(signature):
            return f"{packed}: unpack it first"
    if suffix == ".spz" and head and not head.startswith(b"ply"):
        return f"a damaged SPZ file: begins with {head[:4]!r}, expected {SPZ!r} or {GZIP!r}"
    return ""


def is_spz(head: bytes) -> bool:
    """Whether a file with these first bytes is an SPZ file, as it is or within gzip."""
    if head.startswith(SPZ):
        return True
    try:
        beginning = zlib.decompressobj(16 + zlib.MAX_WBITS).decompress(head, len(SPZ))
    except zlib.error:
        return False
    return beginning.startswith(SPZ)


def is_sog(path: Path | Url, head: bytes) -> bool:
    """Whether a file is a SOG file: a ZIP archive by that name or with meta.json and images."""
    if not head.startswith(_ZIP) or path.suffix.lower() == ".sog":
        return head.startswith(_ZIP)
    try:
        with zipfile.ZipFile(path) as archive:
            names = [PurePosixPath(name) for name in archive.namelist()]
    except (OSError, ValueError, ArithmeticError, NotImplementedError, zipfile.BadZipFile):
        return False
    return any(n.name == "meta.json" for n in names) and any(n.suffix == ".webp" for n in names)
