"""Files that are no 3DGS PLY, but something that people have: named, with what to do."""

import gzip
import io
import struct
import zipfile

import pytest

from refine_addon.core import read_cameras, read_ply
from tests.hostile import refused
from tests.strategies import plain_ply

POINTER = (
    b"version https://git-lfs.github.com/spec/v1\n"
    b"oid sha256:4d7a214614ab2935c943f9e0ff69d22eadbb8f32b1258daaa5e2ca24d17e2393\nsize 12345\n"
)
SPZ = struct.pack("<4sIIBBBB", b"NGSP", 3, 1, 0, 12, 0, 0) + bytes(20)
READ = "'refine convert IN OUT.ply' makes a plain 3DGS PLY of it"


def zipped(*names: str) -> bytes:
    """Return an archive of empty files."""
    made = io.BytesIO()
    with zipfile.ZipFile(made, "w") as archive:
        for name in names:
            archive.writestr(name, b"")
    return made.getvalue()


SOG = f"a SOG file: {READ}"
LONG = zipped("a.txt", *(f"{'x' * 200}{i}.webp" for i in range(500)), "meta.json")

FOREIGN = [
    ("in.splat", bytes(64), f"a .splat file: {READ}"),
    ("in.splat", b"\x1f\x8b" + bytes(62), "a .splat file"),  # as gzip begins
    ("in.ksplat", bytes(4096), f"a .ksplat file: {READ}"),
    ("in.ply", gzip.compress(SPZ), f"an SPZ file: {READ}"),
    ("in.spz", SPZ, f"an SPZ file: {READ}"),
    ("in.sog", zipped("means_l.webp", "meta.json"), SOG),
    ("in.ply", LONG, SOG),  # more than is looked into
    ("in.ply", zipped("a/meta.json", "a/b.webp"), SOG),
    ("in.zip", zipped("meta.json", "in.ply"), "a ZIP archive: unpack"),
    ("in.zip", zipped("my-meta.json.webp"), "a ZIP archive: unpack"),
    ("in.zip", zipped("meta.json", "a.webp")[:60], "a ZIP archive: unpack it first"),
    ("in.ply.gz", gzip.compress(plain_ply()), "compressed with gzip: unpack it first"),
    ("in.ply", b"\x1f\x8b\xff" + bytes(9), "compressed with gzip: unpack it first"),
]


@pytest.mark.parametrize(("file", "data", "expected"), FOREIGN, ids=range(len(FOREIGN)))
def test_a_known_format_is_named_and_so_is_what_to_do(tmp_path, file, data, expected):
    """By what the file holds; by its name only where nothing in it tells. As cameras, too."""
    refused(tmp_path / file, f": {expected}", data, read=read_ply)
    refused(tmp_path / file, f": not a camera file: {expected.split(':')[0]}", read=read_cameras)


def test_a_gltf_is_named(tmp_path):
    words = ": a glTF file: 'refine convert IN OUT.ply' makes a plain 3DGS PLY of it"
    refused(tmp_path / "in.gltf", words, b' {"asset": {}}', read=read_ply)


@pytest.mark.parametrize(
    "name", ["in.ply", "in.splat", "cameras.json", "cameras.bin", "images.txt"]
)
def test_a_pointer_to_a_large_file_is_named(tmp_path, name):
    """A repository cloned without its large files holds these in their place."""
    path = tmp_path / name
    for beside in ("cameras", "images"):
        (tmp_path / beside).with_suffix(path.suffix).write_bytes(POINTER)
    path.write_bytes(POINTER)
    read = read_ply if name.startswith("in.") else read_cameras
    file = path if path.suffix != ".txt" else tmp_path / "cameras.txt"
    refused(path, ": a Git LFS pointer, not the file itself: 'git lfs pull'", read=read, file=file)
