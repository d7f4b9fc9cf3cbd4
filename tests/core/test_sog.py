"""SOG: what is in the archive, and archives that lie."""

from __future__ import annotations

import importlib
import io
import json
import re
import tracemalloc
import zipfile

import numpy as np
import pytest

from refine_addon.core import RefineError, images, read_splats, write_splats
from refine_addon.core.formats.sog import _grouped
from tests.strategies import plain_ply

pytest.importorskip("PIL", reason="needs Pillow, which a .sog does outside of Blender")


@pytest.fixture
def sog(tmp_path):
    """Return the path of a file of 40 splats of degree 1."""
    (tmp_path / "in.ply").write_bytes(plain_ply(40, 1))
    write_splats(tmp_path / "a.sog", read_splats(tmp_path / "in.ply"))
    return tmp_path / "a.sog"


def content(path):
    """Return the files in an archive by their names; meta.json parsed."""
    with zipfile.ZipFile(path) as archive:
        files = {name: archive.read(name) for name in archive.namelist()}
    return {**files, "meta.json": json.loads(files["meta.json"])}


def pack(path, files, folder=""):
    """Write an archive of files."""
    with zipfile.ZipFile(path, "w") as archive:
        for name, data in files.items():
            archive.writestr(folder + name, json.dumps(data) if name == "meta.json" else data)


def picture(width, height, value=(0, 0, 0, 255)):
    """Return a WebP image of one colour."""
    return images._Pillow().encode(np.full((height, width, 4), value, np.uint8))


def test_values_by_hand(sog):
    """One splat. 16 bits of 255 + 256 * 127 = 32767 of 65535 between 0 and 2, logarithmic.

    exp(.99998) - 1 = 1.71825. Components 0 of a rotation are 127.5, so that 128 is .5 / 127.5 /
    sqrt(2); the alpha 253 leaves out x. Places 2 of tables that count by tenths are .2.
    """
    files = content(sog)
    tenths = [0.1 * index for index in range(256)]
    files["meta.json"] = {
        "version": 2,
        "count": 1,
        "means": {"mins": [0, 0, 0], "maxs": [2, 2, -2], "files": ["l", "u"]},
        "scales": {"codebook": tenths, "files": ["s"]},
        "quats": {"files": ["q"]},
        "sh0": {"codebook": tenths, "files": ["c"]},
    }
    files |= {
        "l": picture(1, 1, (255, 0, 255, 255)),
        "u": picture(1, 1, (127, 0, 127, 255)),
        "s": picture(1, 1, (2, 0, 1, 255)),
        "q": picture(1, 1, (128, 128, 128, 253)),
        "c": picture(1, 1, (2, 3, 4, 51)),
        "b.webp": b"",
    }
    pack(sog, files, "folder/")

    splats = read_splats(sog).splats()

    step = np.expm1(2 * 32767 / 65535)
    np.testing.assert_allclose(splats.means, [[step, 0.0, -step]], rtol=1e-6)
    np.testing.assert_allclose(splats.log_scales, [[0.2, 0.0, 0.1]], rtol=1e-6)
    small = 0.5 / 127.5 / np.sqrt(2.0)
    expected = [[small, np.sqrt(1 - 3 * small**2), small, small]]
    np.testing.assert_allclose(splats.quaternions, expected, rtol=1e-6)
    np.testing.assert_allclose(splats.sh_dc, [[0.2, 0.3, 0.4]], rtol=1e-6)
    np.testing.assert_allclose(splats.opacity_logits, [-np.log(4.0)], rtol=1e-6)


VERSION_1 = {
    "means": {"shape": [1, 3], "mins": [0] * 3, "maxs": [2, 2, -2], "files": ["l", "u"]},
    "scales": {"shape": [1, 3], "mins": [-9, 0, 0], "maxs": [-4, 0, 51], "files": ["s"]},
    "quats": {"shape": [1, 4], "files": ["q"]},
    "sh0": {"mins": [0, 0, 0, -5.1], "maxs": [51, 51, 0, 5.1], "files": ["c"]},
    "shN": {"mins": -1.5, "maxs": 1.05, "files": ["p", "n"]},
}
"""What tools wrote first: no version, ends instead of tables, opacity as a logit."""


def test_version_1_by_hand(tmp_path):
    """Of -9 to -4, place 51 of 255 is -8; of 0 to 51, places 10 and 2 are 2 and .4.

    Of logits from -5.1 to 5.1, 51 is -3.06. A palette of 192 pixels is one of degree 1; from -1.5
    in steps of .01, 150 is 0 and 255 is 1.05.
    """
    palette = np.full((1, 192, 4), 150, np.uint8)
    palette[0, 3:6] = [[255, 150, 0, 255]] * 3
    files = {
        "l": picture(1, 1, (255, 0, 255, 255)),
        "u": picture(1, 1, (127, 0, 127, 255)),
        "s": picture(1, 1, (51, 0, 10, 255)),
        "q": picture(1, 1, (128, 128, 128, 253)),
        "c": picture(1, 1, (2, 10, 0, 51)),
        "p": images._Pillow().encode(palette),
        "n": picture(1, 1, (1, 0, 0, 255)),
        "meta.json": json.dumps(VERSION_1).encode(),
    }
    for name, data in files.items():
        (tmp_path / name).write_bytes(data)

    file = read_splats(tmp_path / "meta.json")

    splats = file.splats()
    step = np.expm1(2 * 32767 / 65535)
    assert file.format == "SOG version 1"
    assert file.stored_bytes == sum(map(len, files.values()))
    np.testing.assert_allclose(splats.means, [[step, 0.0, -step]], rtol=1e-6)
    np.testing.assert_allclose(splats.log_scales, [[-8.0, 0.0, 2.0]], rtol=1e-6)
    np.testing.assert_allclose(splats.sh_dc, [[0.4, 2.0, 0.0]], rtol=1e-6)
    np.testing.assert_allclose(splats.opacity_logits, [-3.06], rtol=1e-6)
    np.testing.assert_allclose(splats.sh_rest, [[[1.05, 0.0, -1.5]] * 3], atol=1e-6)


def test_images_beside_a_meta_json_are_what_the_archive_holds(sog):
    """To the bit; the size is that of all files."""
    folder = sog.with_suffix("")
    with zipfile.ZipFile(sog) as archive:
        archive.extractall(folder)

    file = read_splats(folder / "meta.json")

    assert file.rows.tobytes() == read_splats(sog).rows.tobytes()
    assert file.stored_bytes == sum(path.stat().st_size for path in folder.iterdir())


def test_groups_are_halves_of_halves():
    """Four clumps of two: 8 rows become 4 groups at least, and no group spans two clumps."""
    random = np.random.default_rng(0)
    clumps = np.array([[0, 0, 0], [9, 0, 0], [9, 5, 0], [0, 5, 0]]).repeat(2, axis=0)

    labels = _grouped(clumps + random.normal(0.0, 0.1, clumps.shape))

    assert len(set(labels)) == labels.max() + 1 >= 4
    for one in range(8):
        for other in range(8):
            assert labels[one] != labels[other] or one // 2 == other // 2


def _meta(*path_and_value):
    *path, key, value = path_and_value

    def change(files):
        held = files["meta.json"]
        for step in path:
            held = held[step]
        held[key] = value

    return change


def _file(name, data):
    def change(files):
        files[name] = data

    return change


FAULTS = {
    "version 1": (_meta("version", 1), "meta.json version: expected 2, got 1"),
    "no version": (_meta("version", None), "meta.json version: expected 2, got null"),
    "many": (_meta("count", 10**9), "meta.json count: expected a whole number from 1 to "),
    "none": (_meta("count", 0), "meta.json count: expected a whole number from 1 to "),
    "half": (_meta("count", 1.5), "meta.json count: expected a whole number from 1 to "),
    "a few too many": (_meta("count", 100), "image 'means_l.webp': "),
    "no means": (_meta("means", []), "meta.json means: expected an object, got a list"),
    "two limits": (
        _meta("means", "mins", [0, 0]),
        "meta.json means mins: expected a list of 3 numbers",
    ),
    "a huge limit": (
        _meta("means", "maxs", [10**400] * 3),
        "meta.json means maxs [0]: expected a finite n",
    ),
    "a short table": (
        _meta("sh0", "codebook", [0.0]),
        "meta.json sh0 codebook: expected a list of 256",
    ),
    "no file": (_meta("scales", "files", []), "meta.json scales files: expected at least 1"),
    "another file": (_meta("scales", "files", ["x"]), "'x' in the archive cannot be read ("),
    "no image": (_file("sh0.webp", b"RIFF"), "image 'sh0.webp': cannot be read ("),
    "another image": (_file("sh0.webp", b"\x89PNG\r\n\x1a\n"), "image 'sh0.webp': cannot be read"),
    "a small image": (_file("quats.webp", picture(4, 4)), "image 'quats.webp': 4 x 4 pixels, expe"),
    "a huge image": (
        _file("quats.webp", picture(9000, 900)),
        "image 'quats.webp': 9000 x 900 pixels, expected 40",
    ),
    "an image of another size": (_file("quats.webp", picture(8, 8)), None),
    "an unknown rotation": (
        _file("quats.webp", picture(8, 8, (0, 0, 0, 9))),
        "rotation of splat 0: alpha 9, expected 252 to 255",
    ),
    "bands": (_meta("shN", "bands", 4), "meta.json shN bands: expected a whole number from 1 to 3"),
    "entries": (
        _meta("shN", "count", 70_000),
        "meta.json shN count: expected a whole number from 1 to 65536",
    ),
    "a narrow palette": (
        _file("shN_centroids.webp", picture(64, 8)),
        "image 'shN_centroids.webp': 64 pixels wide, expected 192",
    ),
    "labels": (
        _file("shN_labels.webp", picture(8, 8, (255, 1, 0, 255))),
        "splat 0: entry 511 of ",
    ),
}


@pytest.mark.parametrize("name", FAULTS)
def test_what_is_wrong_is_named_with_its_place(sog, name):
    """With memory that the file accounts for: a WebP of one colour may be as large as it likes."""
    change, expected = FAULTS[name]
    files = content(sog)
    change(files)
    pack(sog, files)
    if expected is None:  # no fault: 64 pixels hold 40 splats
        assert len(read_splats(sog)) == 40
        return
    tracemalloc.start()

    with pytest.raises(RefineError, match=re.escape(f"{sog}: {expected}")):
        read_splats(sog)

    assert tracemalloc.get_traced_memory()[1] < 5_000_000
    tracemalloc.stop()


def test_an_archive_without_meta_json_is_refused(sog):
    """By its name it is a SOG file."""
    files = content(sog)
    del files["meta.json"]
    pack(sog, files)

    with pytest.raises(RefineError, match=re.escape(f"{sog}: no meta.json in the archive")):
        read_splats(sog)


@pytest.mark.parametrize("method", [zipfile.ZIP_BZIP2, zipfile.ZIP_LZMA])
@pytest.mark.parametrize("damaged", [False, True])
def test_a_member_that_is_packed_as_no_sog_is_refused(sog, method, damaged):
    """Ways to compress that take any memory; a damaged one of LZMA was a traceback."""
    with zipfile.ZipFile(sog) as archive:
        files = {name: archive.read(name) for name in archive.namelist()}
    with zipfile.ZipFile(sog, "w", method) as archive:
        for name, data in files.items():
            archive.writestr(name, data)
    if damaged:
        data = bytearray(sog.read_bytes())
        data[60:80] = bytes(20)
        sog.write_bytes(data)

    expected = f"{sog}: 'meta.json' in the archive cannot be read (compressed by method {method})"
    with pytest.raises(RefineError, match=re.escape(expected)):
        read_splats(sog)


OUTSIDE = [
    "../a",
    "/etc/passwd",
    "//etc/passwd",
    "///etc/passwd",
    "//a/b",
    "a/../../b",
    "C:a",
    "a\\b",
    "a\0b",
    "",
    "..",
]


@pytest.mark.parametrize("name", OUTSIDE)
def test_a_name_that_leads_elsewhere_is_refused(tmp_path, name):
    """Up, from the root, on a drive or a share: no file there is so much as looked for."""
    meta = {**VERSION_1, "scales": {**VERSION_1["scales"], "files": [name]}}
    (tmp_path / "meta.json").write_text(json.dumps(meta))
    for known in ("l", "u", "q", "c", "p", "n"):
        (tmp_path / known).write_bytes(picture(1, 1))

    with pytest.raises(RefineError, match="expected a file in this folder or one below"):
        read_splats(tmp_path / "meta.json")


@pytest.mark.parametrize(
    ("change", "expected"),
    [
        (("means", "shape", []), "means shape [0]: expected a whole number from 1 to "),
        (("means", "shape", [10**9]), "means shape [0]: expected a whole number from 1 to "),
        (("sh0", "mins", [0, 0, 0]), "sh0 mins: expected a list of 4 numbers"),
        (("shN", "mins", [0]), "shN mins: expected a number, got a list of 1"),
        (("shN", "files", ["l", "n"]), "shN: a palette 1 pixels wide, expected 192, 512, 960"),
        (("quats", "files", [[]]), "quats files [0]: expected a string, got a list of 0"),
        (("quats", "files", ["no"]), '"no" is not there'),
        (("quats", "files", ["folder"]), '"folder" is not there'),
    ],
    ids=range(8),
)
def test_what_is_wrong_with_images_beside_a_meta_json_is_named(tmp_path, change, expected):
    """With the file and the place."""
    meta = json.loads(json.dumps(VERSION_1))
    meta[change[0]][change[1]] = change[2]
    (tmp_path / "folder").mkdir()
    (tmp_path / "meta.json").write_text(json.dumps(meta))
    for name in ("l", "u", "s", "q", "c", "n"):
        (tmp_path / name).write_bytes(picture(1, 1, (0, 0, 0, 253)))
    (tmp_path / "p").write_bytes(picture(192, 1))

    with pytest.raises(RefineError, match=re.escape(f"{tmp_path / 'meta.json'}: {expected}")):
        read_splats(tmp_path / "meta.json")


@pytest.mark.slow
def test_a_bomb_in_the_archive_is_refused(sog):
    """100 MB of zeros in 100 KB, as an image."""
    files = content(sog)
    with zipfile.ZipFile(sog, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, data in files.items():
            data = json.dumps(data) if name == "meta.json" else data
            archive.writestr(name, bytes(100_000_000) if name == "sh0.webp" else data)

    with pytest.raises(RefineError, match=r"'sh0.webp' in the archive has more than \d{6} bytes"):
        read_splats(sog)


def test_what_is_missing_is_said(sog, monkeypatch):
    """Without Pillow, neither read nor written."""

    def missing(name):
        raise ImportError(name)

    monkeypatch.setattr(importlib, "import_module", missing)
    source = read_splats(sog.with_name("in.ply"))

    with pytest.raises(RefineError, match=r"a\.sog: WebP images need a library: run this in Blen"):
        read_splats(sog)
    with pytest.raises(RefineError, match="WebP images need a library: run this in Blender, or 'p"):
        write_splats(sog.with_name("b.sog"), source)
    assert not sog.with_name("b.sog").exists()


def test_the_same_splats_make_the_same_file(sog):
    """No time of day is in it."""
    source = read_splats(sog.with_name("in.ply"))
    write_splats(sog.with_name("b.sog"), source)

    assert sog.read_bytes() == sog.with_name("b.sog").read_bytes()
    assert io.BytesIO(sog.read_bytes()).read(4) == b"PK\x03\x04"
