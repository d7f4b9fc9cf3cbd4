"""Kept splats among stored columns: what changed is put in, all else stays to the bit."""

import io

import numpy as np
import pytest

from refine_addon.core import Result, Splats, read_ply
from refine_addon.core.affine import transformed
from refine_addon.core.formats import ply
from refine_addon.core.formats.ply_columns import values_by_name
from refine_addon.core.merging.merge import Merged
from refine_addon.core.splats import ARRAYS
from tests.strategies import plain_ply

KEEP = np.array([True, True, False, True, True])
CHANGED = np.array([False, False, True, True])


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
    for name in ARRAYS:
        getattr(kept, name)[changed] *= factor
    return Merged(kept, keep, changed, 0, len(keep) - int(keep.sum()))


def written(rows, columns):
    """Return rows as they are written with new columns."""
    ply.write_rows(stream := io.BytesIO(), rows, None, columns)
    return np.frombuffer(stream.getvalue(), rows.dtype)


def test_rows_are_written_as_their_columns_say(tmp_path, monkeypatch):
    """In chunks of 7 rows, some of which none changed; a result writes the same."""
    generator = np.random.default_rng(0)
    (tmp_path / "in.ply").write_bytes(plain_ply(100, 1))
    file = read_ply(tmp_path / "in.ply")
    keep = generator.random(100) < 0.7
    changed = (generator.random(keep.sum()) < 0.4) & (np.flatnonzero(keep) > 30)
    merged = merged_of(file.splats(), keep, changed, 1 / 3)
    columns = Result(keep, {}, merged=merged).changed()
    Result(keep, {}, merged=merged, source=file).write(tmp_path / "whole.ply")
    monkeypatch.setattr(ply, "_CHANGED_ROWS", 7)

    for threads in (1, 3):
        file.write(tmp_path / "out.ply", keep, columns=columns, threads=threads, overwrite=True)
        assert (tmp_path / "out.ply").read_bytes() == (tmp_path / "whole.ply").read_bytes()


@pytest.mark.parametrize("kind", ["<f4", ">f4", "<f8", ">f8"])
def test_what_changed_is_put_in_rounded_once_and_all_else_stays_to_the_bit(file, kind):
    """A third of what doubles hold is the nearest number that a property of this type can be.

    Rows 3 and 4 change, in all 23 properties; the stored rows are not touched.
    """
    with np.errstate(invalid="ignore"):  # of the signalling NaN, which turns quiet
        rows = file.rows.astype([(name, kind) for name in file.rows.dtype.names])
        splats, before = file.splats(), rows.tobytes()
        wide = Splats(**{name: getattr(splats, name).astype(np.float64) for name in ARRAYS})
    merged = merged_of(wide, KEEP, CHANGED, factor=1 / 3)

    columns = Result(KEEP, {}, merged=merged).changed()
    after = written(rows, columns)

    assert set(columns.columns) == set(rows.dtype.names)
    assert after[:3].tobytes() == rows[:3].tobytes()
    for name, values in values_by_name(merged.splats).items():
        np.testing.assert_array_equal(after[name][3:], values[2:].astype(kind))
    assert before == rows.tobytes()


def test_a_matrix_leads_the_changed_ones_to_the_frame_of_the_columns(file):
    """Turned by 90 degrees about z and moved along x; the unchanged ones are not taken along."""
    matrix = np.array([[0.0, -1, 0, 7], [1, 0, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]])
    merged = merged_of(file.splats(), KEEP, CHANGED)

    result = Result(KEEP, {}, merged=merged, matrix=np.linalg.inv(matrix))
    after = written(file.rows, result.changed())

    wanted = values_by_name(transformed(merged.splats.take(CHANGED), matrix))
    np.testing.assert_allclose(after["x"][3:], 7 - 2 * file.rows["y"][3:], rtol=1e-6)
    for name, values in wanted.items():
        np.testing.assert_array_equal(after[name][3:], values.astype(np.float32))
        assert after[name][:3].tobytes() == file.rows[name][:3].tobytes()
