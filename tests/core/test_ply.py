"""3DGS PLY files: what is read, what is written, and what is refused in which words."""

import os
import re
import tracemalloc

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from refine_addon.core import RefineError, read_ply
from refine_addon.core.formats import registry
from refine_addon.core.formats.ply_columns import splats_from_columns, values_by_name
from refine_addon.core.splats import ARRAYS
from tests.hostile import refused
from tests.strategies import TYPES, masks, plain_header, plain_ply, ply_files, ply_of, splat_names

BINARY = ("binary_little_endian", "binary_big_endian")
NAMES = splat_names(0)


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return tmp_path_factory.mktemp("ply")


def opened(folder, data):
    path = folder / "in.ply"
    path.unlink(missing_ok=True)  # never cut short what an earlier example may still map
    path.write_bytes(data)
    with np.errstate(all="raise"):
        return read_ply(path)


def rewritten(folder, file, *given, **named):
    """What `file` writes, which it knew the length of."""
    with np.errstate(all="raise"):
        file.write(folder / "out.ply", *given, **named, overwrite=True)
    written = (folder / "out.ply").read_bytes()
    assert len(written) == file.size(*given, **named)
    return written


@given(case=ply_files())
def test_every_number_is_read_as_it_stands(folder, case):
    """NaN payloads included; coefficient k of channel c is f_rest_(c K + k)."""
    file = opened(folder, case.data)
    splats, rows = file.splats(), file.rows
    assert case.rows.dtype == rows.dtype
    for name in rows.dtype.names:
        np.testing.assert_array_equal(case.rows[name], rows[name])
    assert case.form == "ascii" or case.rows.tobytes() == rows.tobytes()
    basis = sum(name.startswith("f_rest_") for name in rows.dtype.names) // 3
    assert splats.sh_rest.shape == (len(rows), basis, 3)
    for axis, name in enumerate("xyz"):
        np.testing.assert_array_equal(rows[name], splats.means[:, axis])
        np.testing.assert_array_equal(rows[f"scale_{axis}"], splats.log_scales[:, axis])
        np.testing.assert_array_equal(rows[f"f_dc_{axis}"], splats.sh_dc[:, axis])
        for k in range(basis):
            expected = rows[f"f_rest_{axis * basis + k}"]
            np.testing.assert_array_equal(expected, splats.sh_rest[:, k, axis])
    for index in range(4):
        np.testing.assert_array_equal(rows[f"rot_{index}"], splats.quaternions[:, index])
    np.testing.assert_array_equal(rows["opacity"], splats.opacity_logits)
    again = splats_from_columns(values_by_name(splats))
    for name in ARRAYS:
        np.testing.assert_array_equal(getattr(splats, name), getattr(again, name))


def test_a_prune_holds_a_few_megabytes_of_a_file(tmp_path):
    """80,000 splats of degree 3 are 19 MB; opening and writing half of them takes under 10 MB."""
    (tmp_path / "in.ply").write_bytes(plain_ply(80_000, 3))
    keep = np.arange(80_000) % 2 == 0
    tracemalloc.start()
    file = read_ply(tmp_path / "in.ply")
    file.splats()
    file.write(tmp_path / "out.ply", keep, columns={"refine_score": np.zeros(80_000, np.float32)})
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 10e6


@given(case=ply_files(forms=BINARY), data=st.data(), kind=st.sampled_from(["f4", "f8", "u1", "i2"]))
def test_a_pruned_file_is_the_kept_rows_and_another_count(folder, case, data, kind):
    """All else stays to the byte: byte order, comments, the count's spelling, what trails.
    Opacity becomes 1/3 in its own type; a new property is the last of each row."""
    keep = data.draw(masks(len(case.rows)))
    file = opened(folder, case.data)
    assert case.data == rewritten(folder, file)
    assert case.pruned(keep) == rewritten(folder, file, keep)
    fitting = file.fixed_bytes + file.row_bytes * int(keep.sum())
    assert len(case.pruned(keep)) <= fitting or case.head[1].startswith(b"0")
    rows, values = case.rows.copy(), (np.arange(len(keep)) * 1.5 + 0.25).astype(kind)
    rows["opacity"] = 1 / 3
    cells = values.astype(values.dtype.newbyteorder(rows.dtype["x"].byteorder))
    parts = [row.tobytes() + cell.tobytes() for row, cell in zip(rows, cells[:, None], strict=True)]
    columns = {"opacity": np.full(len(keep), 1 / 3), "refine_score": values}
    written = rewritten(folder, file, keep, columns=columns)
    declared = next(name for name, value in TYPES.items() if value == kind)
    line = b"property %s refine_score" % declared.encode() + case.line_end
    assert written.replace(line, b"", 1) == case.pruned(keep, parts)
    assert written.count(case.line_end + line) == 1
    again = read_ply(folder / "out.ply")
    assert again.rows.dtype.names[-1] == "refine_score"
    np.testing.assert_array_equal(values[keep], again.rows["refine_score"])


@given(case=ply_files(forms=("ascii",)), data=st.data())
def test_text_is_written_as_the_binary_file_of_its_splats(folder, case, data):
    """With its comments and its count's spelling; elements beside the splats are named."""
    keep = data.draw(masks(len(case.rows)))
    file = opened(folder, case.data)
    written = rewritten(folder, file, keep)
    again = read_ply(folder / "out.ply")
    assert case.rows.dtype == again.rows.dtype
    for name in case.rows.dtype.names:
        np.testing.assert_array_equal(case.rows[name][keep], again.rows[name])
    assert len(written) == len(again.header) + again.rows.nbytes
    beside = [line for part in case.head[::2] for line in part.split(case.line_end)]
    kept = [line for line in beside if line.startswith((b"comment", b"obj_info"))]
    assert kept == [line for line in again.header.split(case.line_end) if line in kept]
    assert (file.format, again.format) == ("ascii 1.0", "binary_little_endian 1.0")
    _, (note,) = registry.losses(file, None, keep)
    assert note.startswith("in.ply is text; a PLY that is written of it is binary")
    for line in beside:
        words = line.split()
        if words[:1] == [b"element"] and words[1:] and words[-1] not in (b"0", b"vertex"):
            assert words[1].decode() in note


def test_odd_headers_are_read_and_kept(tmp_path):
    """NumPy hands out no buffer of rows with a colon in a name.
    Lines end as the first does; 0x0a may be the first byte of x then."""
    tag = np.arange(3, dtype=np.float32)
    file = opened(tmp_path, ply_of(dict.fromkeys([*NAMES, "t:ag"], tag), ["made here"]))
    assert b"\ncomment made here\n" in rewritten(tmp_path, file, columns={"more": 2 * tag})
    again = read_ply(tmp_path / "out.ply").rows
    assert (again["t:ag"].tolist(), again["more"].tolist()) == ([0, 1, 2], [0, 2, 4])
    header, row = plain_header(1, NAMES).replace(b"\n", b"\r"), b"\n" + bytes(range(1, 56))
    assert row == opened(tmp_path, header + row).rows.tobytes()
    odd = b"  element \t vertex   0002  "
    header, rows = plain_header(2, NAMES).replace(b"element vertex 2", odd), bytes(range(112))
    written = rewritten(tmp_path, opened(tmp_path, header + rows), np.array([False, True]))
    assert header.replace(b"0002", b"1") + rows[56:] == written


UNFIT = [
    ({"keep": np.ones(2, bool)}, "keep is bool (2,), expected one bool for each of 3 splats"),
    ({"keep": np.ones(3)}, "keep is float64 (3,), expected one bool"),
    ({"columns": {"s": np.zeros(2)}}, "column 's' has shape (2,), expected (3,)"),
    ({"columns": {"s": np.zeros(3, "i8")}}, "column 's' of type int64 cannot be a property"),
    ({"columns": {"my s": np.zeros(3)}}, "column 'my s' of type float64 cannot be a property"),
    ({"columns": {"tag": np.zeros(3)}}, "'tag' is there already, of type uint8; expected one"),
]


def test_what_does_not_fit_the_rows_is_refused_before_anything_is_written(tmp_path):
    header = plain_header(3, [*NAMES, "tag"]).replace(b"float tag", b"uchar tag")
    file = opened(tmp_path, header + bytes(3 * 57))
    for arguments, expected in UNFIT:
        with pytest.raises(RefineError, match=re.escape(expected)):
            file.write(tmp_path / "out.ply", **arguments)
    assert [tmp_path / "in.ply"] == list(tmp_path.iterdir())


PLAIN = plain_ply()


def declared(old: bytes, new: bytes) -> bytes:
    """A good file with a change to its header."""
    assert old in PLAIN
    return PLAIN.replace(old, new, 1)


def ahead(element: bytes) -> bytes:
    return declared(VERTEX, element + VERTEX)


def more(declaration: bytes) -> bytes:
    return declared(b"end_header", declaration + b"\nend_header")


def counted(count: object) -> bytes:
    return declared(VERTEX, b"element vertex %s\n" % str(count).encode())


VERTEX = b"element vertex 3\n"
GAP = [f"f_rest_{index}" for index in range(1, 10)]
LIST = b"element face 2\nproperty list %s int corners\n"
POSITIONS = b"element vertex 1\nproperty float x\nproperty float y\nproperty float z\n"
CLOUD = b"ply\nformat ascii 1.0\n" + POSITIONS + b"end_header\n0 0 0\n"
FACES = b"element face 0\nproperty list uchar int vertex_indices\nend_header"
MESH = CLOUD.replace(b"end_header", FACES)
PACKED = CLOUD.replace(b"vertex 1\n", b"vertex 1\nproperty uint packed_position\n")
PACKED = PACKED.replace(b"property float z\n", b"property uint packed_rotation\n")
LONG = b"n" * 5000
ROWS = "expected a number of rows, got"

TEXT_HEADER = plain_header(2, [*NAMES, "tag"], "ascii").replace(b"float tag", b"uchar tag")
TEXT_ROW = b"0 0 0 0 0 0 0 0 0 0 1 0 0 0 7\n"
LONG_ROW = TEXT_ROW.replace(b"\n", b" " * 40 + b"\n")

REFUSED = [
    (b"", "the file is empty, expected a PLY"),
    (b"\xef\xbb\xbf" + PLAIN, "not a PLY: it starts with b'\\xef\\xbb\\xbfply"),
    (declared(b"ply\n", b"ply\r\n"), f"no 'end_header' line in the first {len(PLAIN) + 1} bytes"),
    (declared(b"little_endian 1", b"middle 1"), "line 2: don't understand format"),
    (more(b"end_header now"), "unexpected data after 'end_header'"),
    (declared(b"float y", b"float\x1cy"), r"line 5: expected ASCII text, got b'property float\x1c"),
    (declared(b"float y", b"float x"), "line 5: 'x' is declared twice, expected once"),
    (MESH, "a mesh, not splats: vertex lacks f_dc_0"),
    (declared(VERTEX, b"element point 3\n"), "expected an element 'vertex', got point"),
    (PACKED, "a compressed splat PLY: 'refine convert IN OUT.ply' makes a plain one of it"),
    (declared(b"property float rot_3\n", b""), "incomplete splats: vertex lacks rot_3 (it has x"),
    (more(b"property float f_rest_0"), "found 1 f_rest properties, expected f_rest_0 onward, 0,"),
    (plain_header(0, [*NAMES, *GAP]), "found 9 f_rest properties, expected f_rest_0 onward"),
    (more(b"property list uchar int links"), "property 'links' is a list, expected one number a"),
    (declared(b"float y", b"int y"), "'y' is of type i4, expected float or double"),
    (counted("9" * 5000), f"header line 3: {ROWS} '999"),
    (counted(2**63), "9223372036854775808 rows of 'vertex', at least 516508834063867445248 bytes"),
    (more(b"element f %d\nproperty list uchar int a" % 2**63), "9223372036854775808 rows of 'f'"),
    (more(b"element a 1\nproperty double a"), "1 rows of 'a', at least 176 bytes so far, but on"),
    (ahead(LIST % b"uchar"), "'face' has a list and stands before the splats, expected it behind"),
    # Two rows are announced and one is there, long enough to be two by its bytes.
    (TEXT_HEADER + LONG_ROW, "truncated: the file ends in row 1 of 2 of 'vertex'"),
    # Names that do not end do not flood the message: forty characters of each are shown.
    (declared(b"float rot_3", b"float " + LONG), ""),
    (declared(b"property float x", b"property float x%s\nproperty float x%s" % (LONG, LONG)), ""),
    (declared(b"binary_little_endian", LONG), ""),
]


@pytest.mark.parametrize(("data", "expected"), REFUSED, ids=range(len(REFUSED)))
def test_a_file_that_is_wrong_is_refused_with_its_name_and_the_place(tmp_path, data, expected):
    refused(tmp_path / "in.ply", expected, data, read=read_ply)
    assert data == (tmp_path / "in.ply").read_bytes()


WRONG_ROWS = [
    (b"1", b"one", "property 'rot_0': expected a number of type float32"),
    (b"7", b"300", "expected a number of type uint8, got '300'"),
    (b" 7", b"", "expected 15 numbers, got 14"),
    (b"7", b"\xff", r"of type uint8, got '\\xff'"),
    (TEXT_ROW, b"\n" + TEXT_ROW, "expected 15 numbers, got 0"),
    (b"1", b"1\x1d5", r"of type float32, got '1\x1d5'"),
    (b" 7", b"\x1f7", "expected 15 numbers, got 14"),
]


@pytest.mark.parametrize(("old", "new", "expected"), WRONG_ROWS, ids=range(len(WRONG_ROWS)))
def test_a_text_row_that_is_wrong_is_refused_with_its_number(tmp_path, old, new, expected):
    """Rows count from 0, as those of a binary file do; the fourth one is wrong here."""
    good = TEXT_ROW * 2 + TEXT_ROW.replace(b"\n", b"   \n")  # as long as if none lacked
    for behind in (0, 1, 5):
        header = TEXT_HEADER.replace(b"vertex 2", b"vertex %d" % (4 + behind))
        data = header + good + TEXT_ROW.replace(old, new) + TEXT_ROW * behind
        assert ": vertex row 3: " in refused(tmp_path / "in.ply", expected, data, read=read_ply)


def test_a_small_file_cut_at_every_byte_is_refused(tmp_path):
    """Text without its line end is whole, and within its last number nobody can tell."""
    for cut in range(len(PLAIN)):
        with pytest.raises(RefineError, match=r"empty|not a PLY|header without end|truncated"):
            opened(tmp_path, PLAIN[:cut])
    data = TEXT_HEADER + TEXT_ROW + TEXT_ROW.replace(b"7", b"127")
    for cut in range(len(data) - 3):
        with pytest.raises(RefineError, match=re.escape(str(tmp_path / "in.ply"))):
            opened(tmp_path, data[:cut])
    tags = [opened(tmp_path, data[:cut]).rows["tag"].tolist() for cut in range(-3, 0)]
    assert tags == [[7, 1], [7, 12], [7, 127]]


def test_a_header_line_of_a_hundred_megabytes_costs_one(tmp_path):
    path = tmp_path / "in.ply"
    with path.open("wb") as stream:
        stream.write(b"ply\nformat ascii 1.0\ncomment ")
        stream.truncate(100_000_000)
    refused(path, "no 'end_header' line in the first 1048576 bytes", read=read_ply, memory=4e6)


def test_what_is_no_file_is_refused(tmp_path):
    if hasattr(os, "mkfifo"):  # not on Windows
        os.mkfifo(tmp_path / "pipe.ply")
        refused(tmp_path / "pipe.ply", "is a device, expected a PLY file", read=read_ply)
    for path, expected in {
        str(tmp_path): "is a folder, expected a PLY file",
        str(tmp_path / "none.ply"): "cannot be read (No such file or directory)",
        str(tmp_path / "zero\0.ply"): "cannot be read (",
        str(tmp_path / ("a" * 300)): "cannot be read (File name too long)",
        "~nobody-of-that-name/in.ply": "cannot be found (",
    }.items():
        refused(path, expected, read=read_ply, file=path.replace("\0", r"\x00"))
