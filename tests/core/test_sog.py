"""SOG: what is in the archive, and archives that lie."""

import importlib
import json
import zipfile

import numpy as np
import pytest

from refine_addon.core import RefineError, images, read_splats, write_splats
from tests.hostile import refused, with_value
from tests.strategies import plain_ply

pytest.importorskip("PIL", reason="needs Pillow, which a .sog does outside of Blender")


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """Return the files in an archive of 40 splats of degree 1, by their names, and the archive."""
    folder = tmp_path_factory.mktemp("sog")
    (folder / "in.ply").write_bytes(plain_ply(40, 1))
    write_splats(folder / "a.sog", read_splats(folder / "in.ply"))
    with zipfile.ZipFile(folder / "a.sog") as archive:
        files = {name: archive.read(name) for name in archive.namelist()}
    return files, folder / "a.sog"


def pack(path, files, folder="", method=zipfile.ZIP_STORED):
    """Write an archive of files, of which JSON may be parsed."""
    with zipfile.ZipFile(path, "w", method) as archive:
        for name, data in files.items():
            archive.writestr(folder + name, json.dumps(data) if isinstance(data, dict) else data)
    return path


def picture(width, height, value=(0, 0, 0, 255)):
    """Return a WebP image of one colour."""
    return images._Pillow().encode(np.full((height, width, 4), value, np.uint8))


STEP = np.expm1(2 * 32767 / 65535)
BOTH = {  # of one splat
    "l": picture(1, 1, (255, 0, 255, 255)),
    "u": picture(1, 1, (127, 0, 127, 255)),
    "q": picture(1, 1, (128, 128, 128, 253)),
}


def test_values_by_hand(tmp_path):
    """One splat. 16 bits of 255 + 256 * 127 = 32767 of 65535 between 0 and 2, logarithmic.
    exp(.99998) - 1 = 1.71825. Components 0 of a rotation are 127.5, so that 128 is .5 / 127.5 /
    sqrt(2); the alpha 253 leaves out x. Places 2 of tables that count by tenths are .2."""
    tenths = [0.1 * index for index in range(256)]
    meta = {
        "version": 2,
        "count": 1,
        "means": {"mins": [0, 0, 0], "maxs": [2, 2, -2], "files": ["l", "u"]},
        "scales": {"codebook": tenths, "files": ["s"]},
        "quats": {"files": ["q"]},
        "sh0": {"codebook": tenths, "files": ["c"]},
    }
    own = {"s": picture(1, 1, (2, 0, 1, 255)), "c": picture(1, 1, (2, 3, 4, 51))}
    path = pack(tmp_path / "a.sog", {"meta.json": meta, **BOTH, **own, "b.webp": b""}, "folder/")

    splats = read_splats(path).splats()

    np.testing.assert_allclose(splats.means, [[STEP, 0.0, -STEP]], rtol=1e-6)
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

PALETTE = np.full((1, 192, 4), 150, np.uint8)
PALETTE[0, 3:6] = [[255, 150, 0, 255]] * 3
FILES_1 = {
    **BOTH,
    "s": picture(1, 1, (51, 0, 10, 255)),
    "c": picture(1, 1, (2, 10, 0, 51)),
    "p": images._Pillow().encode(PALETTE),
    "n": picture(1, 1, (1, 0, 0, 255)),
}


def unbundled(folder, meta):
    """Write the images of version 1, and a meta.json beside them; return its path."""
    for name, data in FILES_1.items():
        (folder / name).write_bytes(data)
    (folder / "meta.json").write_text(json.dumps(meta))
    return folder / "meta.json"


def test_version_1_by_hand(tmp_path):
    """Of -9 to -4, place 51 of 255 is -8; of 0 to 51, places 10 and 2 are 2 and .4.
    Of logits from -5.1 to 5.1, 51 is -3.06. A palette of 192 pixels is one of degree 1; from -1.5
    in steps of .01, 150 is 0 and 255 is 1.05."""
    file = read_splats(unbundled(tmp_path, VERSION_1))
    splats = file.splats()
    assert file.format == "SOG version 1"
    assert file.stored_bytes == sum(path.stat().st_size for path in tmp_path.iterdir())
    np.testing.assert_allclose(splats.means, [[STEP, 0.0, -STEP]], rtol=1e-6)
    np.testing.assert_allclose(splats.log_scales, [[-8.0, 0.0, 2.0]], rtol=1e-6)
    np.testing.assert_allclose(splats.sh_dc, [[0.4, 2.0, 0.0]], rtol=1e-6)
    np.testing.assert_allclose(splats.opacity_logits, [-3.06], rtol=1e-6)
    np.testing.assert_allclose(splats.sh_rest, [[[1.05, 0.0, -1.5]] * 3], atol=1e-6)


def test_images_beside_a_meta_json_are_what_the_archive_holds(made, tmp_path):
    """To the bit; and the same splats make the same archive: no time of day is in it."""
    files, path = made
    for name, data in files.items():
        (tmp_path / name).write_bytes(data)
    assert read_splats(tmp_path / "meta.json").rows.tobytes() == read_splats(path).rows.tobytes()
    write_splats(tmp_path / "b.sog", read_splats(path.with_name("in.ply")))
    assert (tmp_path / "b.sog").read_bytes() == path.read_bytes()


def test_the_palette_tells_clumps_apart(tmp_path):
    """Four clumps of two, 5 apart or more: no group of harmonics spans two of them."""
    random = np.random.default_rng(0)
    (tmp_path / "in.ply").write_bytes(plain_ply(8, 1))
    file = read_splats(tmp_path / "in.ply")
    clumps = np.array([[0, 0, 0], [9, 0, 0], [9, 5, 0], [0, 5, 0]]).repeat(2, axis=0)
    rest = (clumps + random.normal(0.0, 0.1, clumps.shape)).astype(np.float32)
    columns = {f"f_rest_{axis}": rest[:, axis] for axis in range(3)}
    write_splats(tmp_path / "a.sog", file, columns=columns)
    splats = read_splats(tmp_path / "a.sog").splats()
    order = np.argmin(np.linalg.norm(splats.means[:, None] - file.splats().means, axis=2), axis=1)
    assert sorted(order) == list(range(8))
    assert np.abs(splats.sh_rest[:, :, 0] - rest[order]).max() < 0.5


IMAGE = "image 'quats.webp': "
COUNT = "meta.json count: expected a whole number from 1 to "

FAULTS = [
    ("version", 1, "meta.json version: expected 2, got 1"),
    ("version", None, "meta.json version: expected 2, got null"),
    ("count", 10**9, COUNT),
    ("count", 0, COUNT),
    ("count", 100, "image 'means_l.webp': "),
    ("means", [], "meta.json means: expected an object, got a list"),
    ("means", "mins", [0, 0], "meta.json means mins: expected a list of 3 numbers"),
    ("means", "maxs", [10**400] * 3, "meta.json means maxs [0]: expected a finite n"),
    ("sh0", "codebook", [0.0], "meta.json sh0 codebook: expected a list of 256"),
    ("scales", "files", [], "meta.json scales files: expected at least 1"),
    ("scales", "files", ["x"], "'x' in the archive cannot be read ("),
    ("shN", "bands", 4, "meta.json shN bands: expected a whole number from 1 to 3"),
    ("shN", "count", 70_000, "meta.json shN count: expected a whole number from 1 to 65536"),
    ("sh0.webp", b"RIFF", "image 'sh0.webp': cannot be read ("),
    ("sh0.webp", b"\x89PNG\r\n\x1a\n", "image 'sh0.webp': cannot be read"),
    ("quats.webp", picture(4, 4), f"{IMAGE}4 x 4 pixels, expe"),
    ("quats.webp", picture(9000, 900), f"{IMAGE}9000 x 900 pixels, expected 40"),
    ("quats.webp", picture(8, 8, (0, 0, 0, 9)), "rotation of splat 0: alpha 9, expected 252 to"),
    ("shN_centroids.webp", picture(64, 8), "webp': 64 pixels wide, expected 192"),
    ("shN_labels.webp", picture(8, 8, (255, 1, 0, 255)), "splat 0: entry 511 of "),
]


@pytest.mark.parametrize("case", range(len(FAULTS)))
def test_what_is_wrong_is_named_with_its_place(made, tmp_path, case):
    """With memory that the file accounts for: a WebP of one colour may be as large as it likes."""
    files, (*where, value, expected) = made[0], FAULTS[case]
    meta = json.loads(files["meta.json"])
    changed = {where[0]: value}
    if not isinstance(value, bytes):
        changed = {"meta.json": with_value(meta, *where, value)}
    refused(pack(tmp_path / "a.sog", {**files, **changed}), expected)


@pytest.mark.slow
def test_an_archive_that_is_packed_as_no_sog_is_refused(made, tmp_path):
    """Ways to compress that take any memory; a damaged one of LZMA was a traceback.
    100 MB of zeros in 100 KB, as an image. No fault: 64 pixels hold 40 splats."""
    files, path = dict(made[0]), tmp_path / "a.sog"
    assert len(read_splats(pack(path, {**files, "quats.webp": picture(8, 8)}))) == 40
    for method in (zipfile.ZIP_BZIP2, zipfile.ZIP_LZMA):
        pack(path, files, method=method)
        expected = f"'meta.json' in the archive cannot be read (compressed by method {method})"
        refused(path, expected)
        data = bytearray(path.read_bytes())
        data[60:80] = bytes(20)
        refused(path, expected, data)
    bomb = {**files, "sh0.webp": bytes(100_000_000)}
    pack(path, bomb, method=zipfile.ZIP_DEFLATED)
    refused(path, "'sh0.webp' in the archive has more than ")
    del files["meta.json"]
    refused(pack(path, files), "no meta.json in the archive")


OUTSIDE = ["../a", "/etc/passwd", "//etc/passwd", "///etc/passwd", "//a/b", "a/../../b", "C:a"]
OUTSIDE += ["a\\b", "a\0b", "", ".."]
SHAPE = "means shape [0]: expected a whole number from 1 to "

FAULTS_1 = [
    ("means", "shape", [], SHAPE),
    ("means", "shape", [10**9], SHAPE),
    ("sh0", "mins", [0, 0, 0], "sh0 mins: expected a list of 4 numbers"),
    ("shN", "mins", [0], "shN mins: expected a number, got a list of 1"),
    ("shN", "files", ["l", "n"], "shN: a palette 1 pixels wide, expected 192, 512, 960"),
    ("quats", "files", [[]], "quats files [0]: expected a string, got a list of 0"),
    ("quats", "files", ["no"], '"no" is not there'),
    ("quats", "files", ["folder"], '"folder" is not there'),
    # Up, from the root, on a drive or a share: no file there is so much as looked for.
    *(("scales", "files", [name], "expected a file in this folder or one") for name in OUTSIDE),
]


@pytest.mark.parametrize("case", range(len(FAULTS_1)))
def test_what_is_wrong_with_images_beside_a_meta_json_is_named(tmp_path, case):
    *change, expected = FAULTS_1[case]
    (tmp_path / "folder").mkdir()
    refused(unbundled(tmp_path, with_value(VERSION_1, *change)), expected)


def test_what_is_missing_is_said(made, monkeypatch):
    """Without Pillow, neither read nor written."""
    _, path = made

    def missing(name):
        raise ImportError(name)

    monkeypatch.setattr(importlib, "import_module", missing)
    source = read_splats(path.with_name("in.ply"))
    refused(path, "WebP images need a library: run this in Blen")
    with pytest.raises(RefineError, match="WebP images need a library: run this in Blender, or 'p"):
        write_splats(path.with_name("b.sog"), source)
    assert not path.with_name("b.sog").exists()
