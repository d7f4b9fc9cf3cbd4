"""Kept splats among stored columns: what changed is put in, all else stays to the bit."""

from __future__ import annotations

import ast
from pathlib import Path

import numpy as np
import pytest

from refine_addon.core import Result, Splats, read_ply
from refine_addon.core.affine import transformed
from refine_addon.core.formats import ply
from refine_addon.core.formats.ply_columns import values_by_name
from refine_addon.core.merging.merge import Merged
from refine_addon.core.splats import ARRAYS
from tests.strategies import plain_ply

CORE = Path(__file__).parents[2] / "refine_addon/core"


@pytest.fixture
def file(tmp_path):
    """Open a file of 5 splats, one of whose numbers is a signalling NaN and one a -0."""
    data = bytearray(plain_ply(5, 1))
    (tmp_path / "in.ply").write_bytes(data)
    rows = read_ply(tmp_path / "in.ply").rows.copy()
    rows["x"].view(np.uint32)[0] = 0x7F800001
    rows["f_rest_3"][1] = -0.0
    (tmp_path / "in.ply").write_bytes(data[: -rows.nbytes] + rows.tobytes())
    return read_ply(tmp_path / "in.ply")


def merged_of(splats, keep, changed, factor=2.0):
    """Return kept splats of which some have become `factor` times what they were."""
    kept = splats.take(keep)
    for name in ("means", "log_scales", "quaternions", "opacity_logits", "sh_dc", "sh_rest"):
        getattr(kept, name)[changed] *= factor
    gone = len(keep) - int(keep.sum())
    return Merged(kept, keep, changed, 0, gone)


def changed_columns(rows, merged):
    """Columns of a result of these kept splats."""
    return Result(merged.keep, {}, merged=merged).changed(rows)


KEEP = np.array([True, True, False, True, True])
CHANGED = np.array([False, False, True, True])


def test_what_changed_is_put_in_and_all_else_stays_to_the_bit(file):
    """Rows 3 and 4 are doubled, in all 23 properties; the file's own rows are not touched."""
    before = file.rows.tobytes()

    columns = changed_columns(file.rows, merged_of(file.splats(), KEEP, CHANGED))

    assert set(columns) == set(file.rows.dtype.names)
    for name, values in columns.items():
        np.testing.assert_array_equal(values[3:], 2 * file.rows[name][3:])
        assert values[:3].tobytes() == file.rows[name][:3].tobytes()
        assert values.dtype == file.rows.dtype[name]
    assert before == file.rows.tobytes()


def test_a_file_is_written_with_its_kept_splats_in_one_call(file, tmp_path):
    """As the README says: rows 0 and 1 byte for byte, and then the changed ones."""
    merged = merged_of(file.splats(), KEEP, CHANGED)
    Result(KEEP, {}, merged=merged, source=file).write(tmp_path / "out.ply")

    written = read_ply(tmp_path / "out.ply")

    assert written.rows[:2].tobytes() == file.rows[:2].tobytes()
    np.testing.assert_array_equal(written.splats().sh_rest, merged.splats.sh_rest)
    np.testing.assert_array_equal(written.splats().means[2:], merged.splats.means[2:])


@pytest.mark.parametrize("threads", [1, 3])
@pytest.mark.parametrize("wide", [False, True])
def test_rows_are_written_as_their_columns_say(tmp_path, monkeypatch, wide, threads):
    """In chunks of 7 rows, some of which none changed, also as doubles of big endian."""
    generator, data = np.random.default_rng(0), plain_ply(100, 1)
    if wide:
        header, rows = data[: data.index(b"end_header\n") + 11], data[-100 * 23 * 4 :]
        header = header.replace(b"little", b"big").replace(b"float", b"double")
        data = header + np.frombuffer(rows, "<f4").astype(">f8").tobytes()
    (tmp_path / "in.ply").write_bytes(data)
    file = read_ply(tmp_path / "in.ply")
    keep = generator.random(100) < 0.7
    changed = (generator.random(keep.sum()) < 0.4) & (np.flatnonzero(keep) > 30)
    columns = changed_columns(file.rows, merged_of(file.splats(), keep, changed, 1 / 3))
    file.write(tmp_path / "whole.ply", keep, columns=dict(columns))

    monkeypatch.setattr(ply, "_CHANGED_ROWS", 7)
    file.write(tmp_path / "out.ply", keep, columns=columns, threads=threads)

    assert (tmp_path / "out.ply").read_bytes() == (tmp_path / "whole.ply").read_bytes()


@pytest.mark.parametrize("kind", ["<f4", ">f4", "<f8", ">f8"])
def test_every_property_keeps_its_type_and_is_rounded_to_it_once(file, kind):
    """A third of what doubles hold is the nearest number that the property can be."""
    with np.errstate(invalid="ignore"):  # of the signalling NaN, which turns quiet
        rows = file.rows.astype([(name, kind) for name in file.rows.dtype.names])
        splats = file.splats()
        wide = Splats(**{name: getattr(splats, name).astype(np.float64) for name in ARRAYS})
    merged = merged_of(wide, KEEP, CHANGED, factor=1 / 3)

    columns = changed_columns(rows, merged)

    for name, values in values_by_name(merged.splats).items():
        np.testing.assert_array_equal(columns[name][3:], values[2:].astype(kind))
        assert columns[name].dtype == np.dtype(kind)


def test_a_matrix_leads_the_changed_ones_to_the_frame_of_the_columns(file):
    """Turned by 90 degrees about z and moved along x; the unchanged ones are not taken along."""
    matrix = np.array([[0.0, -1, 0, 7], [1, 0, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]])
    merged = merged_of(file.splats(), KEEP, CHANGED)

    result = Result(KEEP, {}, merged=merged, matrix=np.linalg.inv(matrix))
    columns = result.changed({n: file.rows[n] for n in file.rows.dtype.names})

    wanted = values_by_name(transformed(merged.splats.take(CHANGED), matrix))
    np.testing.assert_allclose(columns["x"][3:], 7 - 2 * file.rows["y"][3:], rtol=1e-6)
    for name, values in wanted.items():
        np.testing.assert_array_equal(columns[name][3:], values.astype(np.float32))
        assert columns[name][:3].tobytes() == file.rows[name][:3].tobytes()


def test_a_format_knows_nothing_of_what_is_done_with_splats():
    """The wall: files are read and written whatever scores, selects and merges."""
    above = {
        "merging", "scoring", "prune", "selection", "result", "scores", "operations",

    }  # fmt: skip
    for room in ("formats", "cameras"):
        files = sorted((CORE / room).glob("*.py"))
        assert files
        for path in files:
            nodes = ast.walk(ast.parse(path.read_text()))
            found = [n.module or "" for n in nodes if isinstance(n, ast.ImportFrom)]
            assert not [name for name in found if above & {*name.split(".")}], path.name
