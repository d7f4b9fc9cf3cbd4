"""Broken files of every format end in an error that names them, or in a result."""

from __future__ import annotations

import json
import random
import re
import struct
import tracemalloc

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from refine_addon.core import Budget, RefineError, prune, read_cameras
from refine_addon.core.formats.ply_columns import splats_from_columns
from tests.fuzz import TARGETS, Crash, attempt, fuzz, main
from tests.strategies import plain_ply, splat_names


@pytest.fixture
def traced():
    """Measure memory, in bytes, of what a test asks for."""
    tracemalloc.start()
    yield lambda: tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()


@pytest.mark.slow
@pytest.mark.parametrize("name", TARGETS)
def test_files_broken_by_chance_end_in_an_error_or_a_result(name):
    """120 of each format, the same on every run; some of each kind of end, or it tests little.

    `make fuzz` goes on from here.
    """
    tried, taken = fuzz(name, random.Random(0), lambda count: count < 120)

    assert tried == 120
    assert 3 < taken < 90


def test_the_fuzzer_notices_what_is_wrong(tmp_path):
    """A traceback, an error without the file's name, a warning of NumPy's, hunger for memory."""

    def unnamed(_):
        raise RefineError("something is wrong")

    for use in (lambda _: int("x"), unnamed, lambda _: np.float32(1e30) * np.float32(1e30)):
        with pytest.raises(Crash):
            attempt({"in.ply": b""}, use, tmp_path)


@pytest.mark.slow
def test_the_longer_run_prints_how_many_inputs_it_tried(capsys, tmp_path):
    """And ends in time, with code 0."""
    assert main(["--seconds", "0.5", "--seed", "1", "--keep", str(tmp_path / "kept")]) == 0

    lines = capsys.readouterr().out.splitlines()
    assert len(lines) == len(TARGETS) + 2
    assert re.fullmatch(r"\d+ inputs tried, 0 crashes", lines[-1])
    assert not (tmp_path / "kept").exists()


ANY_BITS = st.tuples(st.sampled_from(splat_names(1)), st.integers(0, 19), st.integers(0, 2**32 - 1))


@pytest.mark.slow
@given(cells=st.lists(ANY_BITS, max_size=40), wide=st.booleans())
def test_splats_of_any_bits_are_pruned_without_a_warning(views, cells, wide):
    """Signalling NaN, denormals and infinities in any property, in floats and in doubles."""
    names = splat_names(1)
    rows = np.frombuffer(
        plain_ply(20, 1)[-20 * 4 * len(names) :], np.dtype([(n, "<f4") for n in names])
    )
    rows = rows.copy()
    for name, row, bits in cells:
        rows[name].view(np.uint32)[row] = bits
    if wide:  # half of the properties are doubles, as bits again: widening would quiet a NaN
        kinds = [(name, ("<f8" if index % 2 else "<f4")) for index, name in enumerate(names)]
        mixed = np.empty(20, kinds)
        for name, kind in kinds:
            if kind == "<f4":
                mixed[name] = rows[name]
            else:
                high = rows[name].view(np.uint32).astype(np.uint64) << np.uint64(32)
                mixed[name] = high.view("<f8")
        rows = mixed

    with np.errstate(all="raise"):
        try:
            result = prune(splats_from_columns(rows), views, Budget(keep=10))
        except RefineError as error:
            assert re.match(r"none of the 20 splats can be drawn|no camera sees", str(error))
        else:
            assert np.count_nonzero(result.keep) == 10
            assert np.isfinite(result.scores.values).all()


@pytest.fixture(scope="module")
def views(tmp_path_factory):
    """Return two views of the splats of `plain_ply`."""
    path = tmp_path_factory.mktemp("views") / "cameras.json"
    camera = {
        "rotation": [[1, 0, 0], [0, 1, 0], [0, 0, 1]],
        "fx": 500,
        "fy": 500,
        "width": 640,
        "height": 480,
    }
    path.write_text(json.dumps([{**camera, "position": [x, 0, 0]} for x in (0, 1)]))
    return read_cameras(path)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "data"),
    [
        ("cameras.json", b"[" * 100_000),
        ("cameras.json", b'{"a":' * 100_000),
        ("transforms.json", b'{"frames": ' + b"[" * 50_000 + b"]" * 50_000 + b"}"),
        ("cameras.json", b"[" + b"9" * 100_000 + b"]"),
        ("cameras.json", b"[" + b"0," * 1_000_000 + b"0]"),
        ("cameras.json", b'["' + b"\\ud800" * 100_000 + b'"]'),
        ("cameras.json", b"\0" * 1_000_000),
        ("cameras.json", b"\xef\xbb\xbf" * 1000),
        ("transforms.json", b"{" + b'"frames": [], ' * 10_000 + b'"w": 1}'),
    ],
)
def test_json_that_is_deep_or_huge_is_refused(tmp_path, traced, name, data):
    """With a sentence, and with memory that the file accounts for."""
    path = tmp_path / name
    path.write_bytes(data)
    before = traced()

    with pytest.raises(RefineError, match=re.escape(str(path))) as caught:
        read_cameras(path)

    assert len(str(caught.value)) < 500
    assert traced() - before < 40 * len(data) + 1_000_000


@pytest.mark.parametrize("count", [2, 1000, 2**31, 2**40, 2**63, 2**64 - 1])
@pytest.mark.parametrize("where", ["cameras", "images", "points"])
def test_a_colmap_model_that_lies_about_a_count_is_refused(tmp_path, traced, where, count):
    """One of each is there; memory does not follow the number."""
    counts = {"cameras": 1, "images": 1, "points": 1, where: count}
    camera = struct.pack("<IiQQ4d", 1, 1, 640, 480, 500.0, 500.0, 320.0, 240.0)
    image = struct.pack("<I7dI", 1, 1.0, 0.0, 0.0, 0.0, 0.0, 0.0, 4.0, 1) + b"a.png\0"
    image += struct.pack("<Q", counts["points"]) + bytes(24)
    (tmp_path / "cameras.bin").write_bytes(struct.pack("<Q", counts["cameras"]) + camera)
    (tmp_path / "images.bin").write_bytes(struct.pack("<Q", counts["images"]) + image)
    broken = "cameras.bin" if where == "cameras" else "images.bin"

    with pytest.raises(RefineError, match=re.escape(f"{tmp_path / broken}: ")):
        read_cameras(tmp_path)

    assert traced() < 2_000_000


@pytest.mark.slow
def test_a_colmap_model_cut_at_every_byte_is_refused(tmp_path):
    """Binary and text alike never end in anything but a sentence; text may lack its last points."""
    for name in ("colmap binary", "colmap text"):
        (files,) = TARGETS[name][0]()
        for cut_name, data in files.items():
            for cut in range(len(data)):
                attempt({**files, cut_name: data[:cut]}, TARGETS[name][1], tmp_path)
