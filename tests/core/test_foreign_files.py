"""Files that are no 3DGS PLY, but something that people have: named, with what to do."""

from __future__ import annotations

import gzip
import io
import struct
import zipfile

import pytest

from refine_addon.core import RefineError, read_cameras, read_ply
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


FOREIGN = {
    "a pointer": ("in.ply", POINTER, "a Git LFS pointer, not the file itself: 'git lfs pull'"),
    "a pointer to splats": ("in.splat", POINTER, "a Git LFS pointer, not the file itself"),
    "splat": ("in.splat", bytes(64), f"a .splat file: {READ}"),
    "splat in capitals": ("IN.SPLAT", bytes(64), f"a .splat file: {READ}"),
    "splat that starts like gzip": ("in.splat", b"\x1f\x8b" + bytes(62), "a .splat file"),
    "ksplat": ("in.ksplat", bytes(4096), f"a .ksplat file: {READ}"),
    "spz": ("in.spz", gzip.compress(SPZ), f"an SPZ file: {READ}"),
    "spz, whatever its name": ("in.ply", gzip.compress(SPZ), f"an SPZ file: {READ}"),
    "spz without compression around it": ("in.spz", SPZ, f"an SPZ file: {READ}"),
    "sog": ("in.sog", zipped("means_l.webp", "meta.json"), f"a SOG file: {READ}"),
    "sog by its content": ("in.ply", zipped("meta.json", "sh0.webp"), f"a SOG file: {READ}"),
    "sog, longer than what is looked into": (
        "in.ply",
        zipped("a.txt", *(f"{'x' * 200}{i}.webp" for i in range(10_000)), "meta.json"),
        f"a SOG file: {READ}",
    ),
    "sog in a folder": ("in.ply", zipped("a/meta.json", "a/b.webp"), f"a SOG file: {READ}"),
    "zip with some meta.json": ("in.zip", zipped("meta.json", "in.ply"), "a ZIP archive: unpack"),
    "zip that says meta.json": ("in.zip", zipped("my-meta.json.webp"), "a ZIP archive: unpack"),
    "zip, cut": ("in.zip", zipped("meta.json", "a.webp")[:60], "a ZIP archive: unpack it first"),
    "zip": ("in.zip", zipped("in.ply"), "a ZIP archive: unpack it first"),
    "gzip": ("in.ply.gz", gzip.compress(plain_ply()), "compressed with gzip: unpack it first"),
    "gzip, broken": ("in.ply", b"\x1f\x8b\xff" + bytes(9), "compressed with gzip: unpack it first"),
}


@pytest.mark.parametrize("name", FOREIGN)
def test_a_known_format_is_named_and_so_is_what_to_do(tmp_path, name):
    """By what the file holds; by its name only where nothing in it tells."""
    file, data, expected = FOREIGN[name]
    (tmp_path / file).write_bytes(data)

    with pytest.raises(RefineError) as caught:
        read_ply(tmp_path / file)

    assert str(caught.value).startswith(f"{tmp_path / file}: {expected}")


@pytest.mark.parametrize("name", [name for name in FOREIGN if "pointer" not in name])
def test_splats_given_as_cameras_are_named_too(tmp_path, name):
    """Whoever mixes up the two reads the same: what it is, and what to do."""
    file, data, expected = FOREIGN[name]
    (tmp_path / file).write_bytes(data)

    with pytest.raises(RefineError) as caught:
        read_cameras(tmp_path / file)

    said = str(caught.value)
    assert said.startswith(f"{tmp_path / file}: not a camera file: {expected.split(':')[0]}")


def test_a_ply_is_one_whatever_it_is_called(tmp_path):
    """The name of another format is no reason to refuse it."""
    (tmp_path / "in.splat").write_bytes(plain_ply(3))

    assert len(read_ply(tmp_path / "in.splat")) == 3


@pytest.mark.parametrize(
    "name", ["cameras.json", "transforms.json", "cameras.bin", "images.txt", "cameras.txt"]
)
def test_cameras_that_are_a_pointer_are_named_too(tmp_path, name):
    """A repository cloned without its large files holds these in their place."""
    for beside in ("cameras", "images"):
        (tmp_path / beside).with_suffix((tmp_path / name).suffix).write_bytes(POINTER)
    (tmp_path / name).write_bytes(POINTER)

    with pytest.raises(RefineError, match=r": a Git LFS pointer, not the file itself: 'git lfs pu"):
        read_cameras(tmp_path / name)
