"""Broken files of every format end in an error that names them, or in a result."""

import random
import re

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from refine_addon.core import (
    Budget,
    ClosedForm,
    Levels,
    RefineError,
    Refit,
    convert_files,
    lod_file,
    prune,
    prune_file,
    read_cameras,
)
from refine_addon.core.formats.ply_columns import splats_from_columns
from tests.fuzz import TARGETS, Crash, attempt, fuzz
from tests.hostile import refused
from tests.strategies import plain_ply, splat_names

from .test_formats import cameras  # noqa: F401 - a fixture


@pytest.mark.slow
@pytest.mark.parametrize("name", TARGETS)
def test_files_broken_by_chance_end_in_an_error_or_a_result(name):
    """The same on every run, some of each kind of end, or it tests little; or `make fuzz`."""
    tried, taken = fuzz(name, random.Random(0), lambda count: count < 80)
    assert tried == 80
    assert 1 < taken < 60


def test_the_fuzzer_notices_what_is_wrong(tmp_path):
    """A traceback, an error without the file's name, a warning of NumPy's."""

    def unnamed(_):
        raise RefineError("something is wrong")

    for use in (lambda _: int("x"), unnamed, lambda _: np.float32(1e30) * np.float32(1e30)):
        with pytest.raises(Crash):
            attempt({"in.ply": b""}, use, tmp_path)


@pytest.mark.parametrize("bits", [0x7FA00000, 0x7F800000], ids=["signalling NaN", "infinity"])
def test_splats_of_no_number_are_moved_kept_and_in_levels(cameras, tmp_path, bits):
    """Twelve of 20, so that some of the ten that are kept are among them."""
    source, names = tmp_path / "in.ply", splat_names(1)
    data = np.frombuffer(plain_ply(20, 1), np.uint8).copy()
    data[-20 * 4 * len(names) :].view("<u4")[: 12 * len(names)] = bits
    source.write_bytes(data)
    convert_files([source], tmp_path / "turned.ply", matrices=[np.eye(4)[[0, 2, 1, 3]]])
    result = prune_file(source, tmp_path / "out.ply", cameras, Budget(keep=10), Refit(rounds=1))
    assert np.count_nonzero(result.keep) == 10
    pytest.importorskip("PIL", reason="needs Pillow, which SOG does outside of Blender")
    lod_file(source, tmp_path / "lod-meta.json", cameras, Levels((0.7,)), ClosedForm())


ANY_BITS = st.tuples(st.sampled_from(splat_names(1)), st.integers(0, 19), st.integers(0, 2**32 - 1))


@pytest.mark.slow
@settings(max_examples=15)
@given(cells=st.lists(ANY_BITS, max_size=40), wide=st.booleans())
def test_splats_of_any_bits_are_pruned_without_a_warning(cameras, cells, wide):
    """Signalling NaN, denormals and infinities in any property, in floats and in doubles."""
    names = splat_names(1)
    data = plain_ply(20, 1)[-20 * 4 * len(names) :]
    columns = dict(zip(names, np.frombuffer(data, "<f4").reshape(20, -1).T.copy(), strict=True))
    for name, row, bits in cells:
        columns[name].view(np.uint32)[row] = bits
    for name in names[1::2] if wide else ():  # as bits again: widening would quiet a NaN
        high = columns[name].view(np.uint32).astype(np.uint64) << np.uint64(32)
        columns[name] = high.view("<f8")
    with np.errstate(all="raise"):
        try:
            result = prune(splats_from_columns(columns), cameras, Budget(keep=10))
        except RefineError as error:
            assert re.match(r"none of the 20 splats can be drawn|no camera sees", str(error))
        else:
            assert np.count_nonzero(result.keep) == 10
            assert np.isfinite(result.scores.values).all()


@pytest.mark.parametrize(
    ("name", "data"),
    [
        ("cameras.json", b"[" * 100_000),
        ("transforms.json", b'{"frames": ' + b"[" * 50_000 + b"]" * 50_000 + b"}"),
        ("cameras.json", b"[" + b"9" * 100_000 + b"]"),
        ("cameras.json", b"[" + b"0," * 20_000 + b"0]"),
        ("cameras.json", b'["' + b"\\ud800" * 100_000 + b'"]'),
        ("transforms.json", b"{" + b'"frames": [], ' * 10_000 + b'"w": 1}'),
    ],
    ids=range(6),
)
def test_json_that_is_deep_or_huge_is_refused(tmp_path, name, data):
    memory = 40 * len(data) + 1_000_000
    assert len(refused(tmp_path / name, "", data, read=read_cameras, memory=memory)) < 500
