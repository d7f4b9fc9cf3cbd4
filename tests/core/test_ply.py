"""3DGS PLY files: what is read, what is written, and what is refused in which words."""

from __future__ import annotations

import io
import mmap
import os
import re
import time
import tracemalloc
import warnings
from pathlib import Path

import numpy as np
import plyfile
import pytest
from hypothesis import given
from hypothesis import strategies as st

from refine_addon.core import RefineError, read_ply, read_splats
from refine_addon.core.formats import registry
from refine_addon.core.formats.ply_columns import splats_from_columns, values_by_name
from tests.strategies import (
    LINE_ENDS,
    TYPES,
    masks,
    plain_header,
    plain_ply,
    ply_files,
    ply_of,
    splat_names,
)

BINARY = ("binary_little_endian", "binary_big_endian")

ROOM = Path(__file__).parents[1] / "data/room_small/point_cloud.ply"


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """One folder for all examples of a law."""
    return tmp_path_factory.mktemp("ply")


@pytest.fixture(autouse=True)
def _strict_numbers():
    with np.errstate(all="raise"):
        yield


def opened(folder: Path, data: bytes):
    path = folder / "in.ply"
    path.unlink(missing_ok=True)  # never cut short what an earlier example may still map
    path.write_bytes(data)
    return read_ply(path)


# What is read.


@given(case=ply_files())
def test_every_number_is_read_as_it_stands(folder, case):
    """Binary rows are the file's bytes, NaN payloads included; text reads back as its numbers."""
    file = opened(folder, case.data)

    assert case.rows.dtype == file.rows.dtype
    if case.form == "ascii":
        for name in case.rows.dtype.names:
            np.testing.assert_array_equal(case.rows[name], file.rows[name])
    else:
        assert case.rows.tobytes() == file.rows.tobytes()


@given(case=ply_files(least=1))
def test_splats_are_made_of_the_properties_that_the_format_names(folder, case):
    """f_rest is channel by channel: coefficient k of channel c is f_rest_(c K + k)."""
    file = opened(folder, case.data)
    splats, rows = file.splats(), file.rows
    basis = sum(name.startswith("f_rest_") for name in rows.dtype.names) // 3

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
    assert (len(rows), basis, 3) == splats.sh_rest.shape


@given(case=ply_files(least=1))
def test_plyfile_reads_the_same_rows(folder, case):
    """That package is the reference, where it takes the file: comments in ASCII, no blank line."""
    data = b"".join([*case.head, case.before, *case.parts, case.after])
    if not data.isascii() and case.form == "ascii":
        return
    try:
        with np.errstate(all="ignore"), warnings.catch_warnings(action="ignore"):
            element = plyfile.PlyData.read(io.BytesIO(data))["vertex"]
    except (plyfile.PlyParseError, ValueError):
        return

    rows = opened(folder, data).rows

    for name in element.data.dtype.names:
        np.testing.assert_array_equal(element.data[name], rows[name])


def test_a_binary_file_is_mapped_and_not_read():
    """Every array of the usual layout shares the memory of one map of the file."""
    file = read_ply(ROOM)
    base = file.rows
    while isinstance(base, np.ndarray):
        base = base.base

    assert isinstance(base.obj if isinstance(base, memoryview) else base, mmap.mmap)
    splats = file.splats()
    for values in (splats.means, splats.sh_rest, splats.quaternions, splats.opacity_logits):
        assert np.shares_memory(values, file.rows)
        assert not values.flags.writeable


def test_a_prune_holds_a_few_megabytes_of_a_file(tmp_path):
    """80,000 splats of degree 3 are 19 MB; opening and writing half of them takes under 10 MB."""
    path = tmp_path / "in.ply"
    path.write_bytes(plain_ply(80_000, 3))
    keep = np.arange(80_000) % 2 == 0
    tracemalloc.start()

    file = read_ply(path)
    file.splats()
    file.write(tmp_path / "out.ply", keep, columns={"refine_score": np.zeros(80_000, np.float32)})
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()

    assert peak < 10e6


@pytest.mark.parametrize("form", ["binary_little_endian", "ascii"])
def test_a_file_without_a_splat_is_read(tmp_path, form):
    """It says so; whether that is an error is for those to decide who need splats."""
    header = plain_header(0, splat_names(1), form)
    file = opened(tmp_path, header)

    assert len(file) == 0
    assert len(file.splats()) == 0
    assert file.splats().sh_degree == 1
    file.write(tmp_path / "out.ply")
    expected = header.replace(b"ascii", b"binary_little_endian")
    assert expected == (tmp_path / "out.ply").read_bytes()


def test_a_carriage_return_ends_a_header_whose_body_begins_with_a_newline(tmp_path):
    """The line end is that of the first line; 0x0a then is the first byte of x."""
    header = plain_header(1, splat_names(0)).replace(b"\n", b"\r")
    row = b"\n" + bytes(range(1, 4 * len(splat_names(0))))

    assert row == opened(tmp_path, header + row).rows.tobytes()


def test_thousands_of_properties_are_read_and_kept(tmp_path):
    """A vertex may have any number of properties that are nothing to us."""
    names = [*splat_names(0), *(f"other_{index}" for index in range(5_000))]
    data = plain_header(2, names) + bytes(range(256)) * (8 * len(names) // 256 + 1)

    file = opened(tmp_path, data)
    file.write(tmp_path / "out.ply")

    assert len(names) == len(file.rows.dtype.names)
    assert data == (tmp_path / "out.ply").read_bytes()


def test_the_home_folder_and_odd_names_are_found(tmp_path, monkeypatch):
    """``~`` is the home folder; spaces, other scripts and links are names like any other."""
    monkeypatch.setenv("HOME", str(tmp_path))
    monkeypatch.setenv("USERPROFILE", str(tmp_path))
    data = plain_ply()
    named = tmp_path / "mein Scan – 部屋 🎈.ply"
    named.write_bytes(data)
    (tmp_path / "link.ply").symlink_to(named)

    for path in (f"~/{named.name}", "~/link.ply", str(named)):
        file = read_ply(path)
        file.write("~/my out ü.ply", overwrite=True)

        assert len(file) == 3
        assert data == (tmp_path / "my out ü.ply").read_bytes()


# What is written.


@given(case=ply_files(forms=BINARY))
def test_nothing_pruned_is_the_same_file_byte_for_byte(folder, case):
    """Whatever the byte order, the comments, the spelling of the count and what trails."""
    file = opened(folder, case.data)
    file.write(folder / "out.ply", overwrite=True)

    assert case.data == (folder / "out.ply").read_bytes()
    assert len(case.data) == file.size()


@given(case=ply_files(forms=BINARY), data=st.data())
def test_a_pruned_file_is_the_kept_rows_and_another_count(folder, case, data):
    """Everything else is what it was, and `size` knew how long it would be."""
    keep = data.draw(masks(len(case.rows)))
    file = opened(folder, case.data)
    file.write(folder / "out.ply", keep, overwrite=True)

    assert case.pruned(keep) == (folder / "out.ply").read_bytes()
    assert len(case.pruned(keep)) == file.size(keep)
    fitting = file.fixed_bytes + file.row_bytes * int(keep.sum())
    assert file.size(keep) <= fitting or case.head[1].startswith(b"0")


@given(
    case=ply_files(forms=BINARY),
    data=st.data(),
    kind=st.sampled_from(["f4", "f8", "u1", "i2", "u4"]),
)
def test_a_new_property_comes_last_and_all_else_stays(folder, case, data, kind):
    """In binary, each row is its old bytes and the value in the file's byte order."""
    keep = data.draw(masks(len(case.rows)))
    values = (np.arange(len(keep)) * 1.5 + 0.25).astype(kind)
    file = opened(folder, case.data)
    file.write(folder / "out.ply", keep, columns={"refine_score": values}, overwrite=True)

    declared = next(name for name, value in TYPES.items() if value == kind)
    line = b"property %s refine_score" % declared.encode()
    written = (folder / "out.ply").read_bytes()
    assert written.count(case.line_end + line + case.line_end) == 1
    assert len(written) == file.size(keep, {"refine_score": values})
    again = read_ply(folder / "out.ply")
    np.testing.assert_array_equal(values[keep], again.rows["refine_score"])
    assert again.rows.dtype.names[-1] == "refine_score"
    order = file.rows.dtype["x"].byteorder
    for part, value, stays in zip(case.parts, values, keep, strict=True):
        if stays:
            cell = np.array([value], values.dtype.newbyteorder(order))
            assert part + cell.tobytes() in written
    assert written.endswith(case.after)


def test_a_property_may_have_any_name_where_another_is_appended(tmp_path):
    """NumPy hands out no buffer of rows with a colon in a name."""
    tag = np.arange(3, dtype=np.float32)
    (tmp_path / "in.ply").write_bytes(ply_of(dict.fromkeys([*splat_names(0), "t:ag"], tag)))

    read_ply(tmp_path / "in.ply").write(tmp_path / "out.ply", columns={"more": 2 * tag})

    again = read_ply(tmp_path / "out.ply").rows
    assert (again["t:ag"].tolist(), again["more"].tolist()) == ([0, 1, 2], [0, 2, 4])


@given(case=ply_files(least=1, forms=BINARY))
def test_a_property_that_is_there_is_set_in_place(folder, case):
    """Opacity becomes 1/3 in its own type; the header and every other property stay."""
    file = opened(folder, case.data)
    third = np.full(len(case.rows), 1 / 3)
    file.write(folder / "out.ply", columns={"opacity": third}, overwrite=True)
    again = read_ply(folder / "out.ply")

    assert case.data[: len(file.header)] == again.header
    assert (folder / "out.ply").stat().st_size == file.size(columns={"opacity": third})
    expected = case.rows.copy()
    expected["opacity"] = 1 / 3
    assert expected.dtype == again.rows.dtype
    for name in expected.dtype.names:
        np.testing.assert_array_equal(expected[name], again.rows[name])
    assert expected.tobytes() == again.rows.tobytes()


@given(case=ply_files(forms=("ascii",)), data=st.data())
def test_text_is_written_as_the_binary_file_of_its_splats(folder, case, data):
    """With its comments and the spelling of its count; elements beside the splats are named."""
    keep = data.draw(masks(len(case.rows)))
    file = opened(folder, case.data)
    file.write(folder / "out.ply", keep, overwrite=True)

    written = (folder / "out.ply").read_bytes()
    beside = [line for part in case.head[::2] for line in part.split(case.line_end)]
    kept = [line for line in beside if line.startswith((b"comment", b"obj_info"))]
    again = read_ply(folder / "out.ply")
    assert case.rows.dtype == again.rows.dtype
    for name in case.rows.dtype.names:
        np.testing.assert_array_equal(case.rows[name][keep], again.rows[name])
    assert len(written) == file.size(keep) == len(again.header) + again.rows.nbytes
    assert kept == [line for line in again.header.split(case.line_end) if line in kept]
    assert (file.format, again.format) == ("ascii 1.0", "binary_little_endian 1.0")
    assert file.stored_bytes == len(case.data)
    (note,) = registry.notes(file, None, keep)
    assert note.startswith("in.ply is text; a PLY that is written of it is binary")
    for line in beside:
        words = line.split()
        if words[:1] == [b"element"] and words[1:] and words[-1] not in (b"0", b"vertex"):
            assert words[1].decode() in note


@pytest.mark.parametrize("end", LINE_ENDS)
def test_a_byte_sized_first_property_does_not_turn_the_byte_order(tmp_path, end):
    """The new property is big-endian, as the file is: 1.0 is 3f 80 00 00."""
    header = plain_header(1, ["first", *splat_names(0)], "binary_big_endian")
    header = header.replace(b"float first", b"uchar first").replace(b"\n", end.encode())
    file = opened(tmp_path, header + b"\x07" + bytes(4 * 14))
    file.write(tmp_path / "out.ply", columns={"s": np.ones(1, "f4")})

    assert (tmp_path / "out.ply").read_bytes().endswith(b"\x07" + bytes(56) + b"\x3f\x80\x00\x00")


def test_an_indented_or_oddly_spaced_header_is_changed_in_its_count_alone(tmp_path):
    """The count is the third word of the line, wherever it stands."""
    header = plain_header(2, splat_names(0)).replace(
        b"element vertex 2", b"  element \t vertex   0002  "
    )
    rows = bytes(range(112))
    file = opened(tmp_path, header + rows)
    file.write(tmp_path / "out.ply", np.array([False, True]))

    expected = header.replace(b"0002", b"1") + rows[56:]
    assert expected == (tmp_path / "out.ply").read_bytes()


def test_columns_make_a_file_that_reads_as_the_same_splats(tmp_path):
    """`values_by_name` and `read_ply` are inverse, in the usual order."""
    source = read_ply(ROOM).splats().take(slice(100))
    columns = {name: values.astype(np.float32) for name, values in values_by_name(source).items()}
    (tmp_path / "out.ply").write_bytes(ply_of(columns, ["made here"]))
    file = read_ply(tmp_path / "out.ply")

    assert splat_names(3) == list(columns) == list(file.rows.dtype.names)
    assert b"\ncomment made here\n" in file.header
    for name in ("means", "log_scales", "quaternions", "opacity_logits", "sh_dc", "sh_rest"):
        expected = getattr(source, name)
        np.testing.assert_array_equal(expected, getattr(file.splats(), name))
        np.testing.assert_array_equal(expected, getattr(splats_from_columns(columns), name))


@pytest.mark.parametrize(
    ("arguments", "expected"),
    [
        ({"keep": np.ones(2, bool)}, "keep is bool (2,), expected one bool for each of 3 splats"),
        ({"keep": np.ones(3)}, "keep is float64 (3,), expected one bool"),
        ({"columns": {"s": np.zeros(2)}}, "column 's' has shape (2,), expected (3,)"),
        ({"columns": {"s": np.zeros(3, "i8")}}, "column 's' of type int64 cannot be a property"),
        ({"columns": {"my s": np.zeros(3)}}, "column 'my s' of type float64 cannot be a property"),
        ({"columns": {"tag": np.zeros(3)}}, "'tag' is there already, of type uint8; expected one"),
    ],
)
def test_what_does_not_fit_the_rows_is_refused_before_anything_is_written(
    tmp_path, arguments, expected
):
    """A mask or a column that is too short would otherwise write another file than meant."""
    header = plain_header(3, [*splat_names(0), "tag"]).replace(b"float tag", b"uchar tag")
    file = opened(tmp_path, header + bytes(3 * 57))

    with pytest.raises(RefineError, match=re.escape(expected)):
        file.write(tmp_path / "out.ply", **arguments)

    assert [tmp_path / "in.ply"] == list(tmp_path.iterdir())


# What is refused.

PLAIN = plain_ply()
NAMES = splat_names(0)


def declared(*changes: tuple[bytes, bytes]) -> bytes:
    """Return a good file with changes to its header, each of which must be one."""
    data = PLAIN
    for old, new in changes:
        assert old in data
        data = data.replace(old, new, 1)
    return data


MESH = b"""ply
format ascii 1.0
element vertex 3
property float x
property float y
property float z
element face 1
property list uchar int vertex_indices
end_header
0 0 0
1 0 0
0 1 0
3 0 1 2
"""
CLOUD = MESH.replace(b"element face 1\nproperty list uchar int vertex_indices\n", b"")
VERTEX = b"element vertex 3\n"
LIST_AHEAD = b"element face 2\nproperty list %s int corners\n" + VERTEX

REFUSED = {
    "empty": (b"", "the file is empty, expected a PLY"),
    "not a PLY": (b"\x89PNG\r\n\x1a\n....", r"not a PLY: it starts with b'\x89PNG\r\n\x1a\n'"),
    "only its name": (b"ply", "not a PLY: it starts with b'ply', expected 'ply' and a line end"),
    "byte order mark": (b"\xef\xbb\xbf" + PLAIN, "not a PLY: it starts with b'\\xef\\xbb\\xbfply"),
    "no end": (PLAIN[:100], "header without end: no 'end_header' line in the first 100 bytes"),
    "other line end": (
        declared((b"ply\n", b"ply\r\n")),
        f"header without end: no 'end_header' line in the first {len(PLAIN) + 1} bytes",
    ),
    "format": (declared((b"little_endian 1", b"middle 1")), "line 2: don't understand format"),
    "version": (declared((b"n 1.0", b"n 2.0")), "line 2: expected version '1.0'"),
    "keyword": (declared((VERTEX, b"elements vertex 3\n")), "line 3: expected one of {element"),
    "unknown type": (declared((b"float y", b"half y")), "line 5: field type 'half' not in"),
    "half a property": (declared((b"float y\n", b"float\n")), "line 5: bad 'property' line"),
    "words behind the end": (
        declared((b"end_header\n", b"end_header now\nend_header\n")),
        "unexpected data after 'end_header'",
    ),
    "control character": (
        declared((b"float y", b"float\x1cy")),
        r"header line 5: expected ASCII text, got b'property float\x1cy'",
    ),
    "name that is not ASCII": (
        declared((b"float y", "float ÿ".encode())),
        "header line 5: expected ASCII text",
    ),
    "property twice": (
        declared((b"float y", b"float x")),
        "header line 5: 'x' is declared twice, expected once",
    ),
    "element twice": (
        declared((b"end_header", b"element vertex 3\nend_header")),
        "header line 18: 'vertex' is declared twice, expected once",
    ),
    "a mesh": (MESH, "a mesh, not splats: vertex lacks f_dc_0"),
    "a point cloud": (CLOUD, "a point cloud, not splats: vertex lacks f_dc_0"),
    "no vertex": (
        declared((VERTEX, b"element point 3\n")),
        "expected an element 'vertex', got point",
    ),
    "no element": (
        b"ply\nformat ascii 1.0\nend_header\n",
        "expected an element 'vertex', got none",
    ),
    "no property": (
        b"ply\nformat ascii 1.0\nelement vertex 0\nend_header\n",
        "scale_0, scale_1, scale_2, rot_0, rot_1, rot_2, rot_3 (it has no property)",
    ),
    "compressed": (
        b"ply\nformat binary_little_endian 1.0\nelement chunk 1\nproperty float min_x\n"
        b"element vertex 1\nproperty uint packed_position\nproperty uint packed_rotation\n"
        b"end_header\n" + bytes(12),
        "a compressed splat PLY, which 'refine convert IN OUT.ply' makes a plain one of",
    ),
    "no rotation": (
        declared((b"property float rot_3\n", b"")),
        "incomplete splats: vertex lacks rot_3 (it has x, y, z, f_dc_0, f_dc_1, f_dc_2, opacity, ",
    ),
    "odd harmonics": (
        declared((b"end_header", b"property float f_rest_0\nend_header")),
        "found 1 f_rest properties, expected f_rest_0 onward, 0, 9, 24, 45 or 72 of them",
    ),
    "gap in the harmonics": (
        plain_header(0, [*NAMES, *(f"f_rest_{index}" for index in range(1, 10))]),
        "found 9 f_rest properties, expected f_rest_0 onward",
    ),
    "list among the splats": (
        declared((b"end_header", b"property list uchar int links\nend_header")),
        "property 'links' is a list, expected one number a splat",
    ),
    "whole positions": (
        declared((b"float y", b"int y")),
        "property 'y' is of type i4, expected float or double",
    ),
    "byte harmonics": (
        plain_header(0, splat_names(1)).replace(b"float f_rest_4", b"uchar f_rest_4"),
        "property 'f_rest_4' is of type u1, expected float or double",
    ),
    "negative count": (
        declared((VERTEX, b"element vertex -1\n")),
        "header line 3: expected a number of rows, got '-1'",
    ),
    "worded count": (
        declared((VERTEX, b"element vertex many\n")),
        "header line 3: expected a number of rows, got 'many'",
    ),
    "grouped count": (
        declared((VERTEX, b"element vertex 1_0\n")),
        "header line 3: expected a number of rows, got '1_0'",
    ),
    "endless count": (
        declared((VERTEX, b"element vertex " + b"9" * 5000 + b"\n")),
        "header line 3: expected a number of rows, got '999",
    ),
    "count of 2^63": (
        declared((VERTEX, b"element vertex %d\n" % 2**63)),
        "announces 9223372036854775808 rows of 'vertex', at least 516508834063867445248 bytes so",
    ),
    "count of 2^63 of another element": (
        declared((VERTEX, b"element other %d\nproperty uchar a\n" % 2**63 + VERTEX)),
        "announces 9223372036854775808 rows of 'other'",
    ),
    "count of 2^63 of lists": (
        declared((b"end_header", b"element f %d\nproperty list uchar int a\nend_header" % 2**63)),
        "announces 9223372036854775808 rows of 'f'",
    ),
    "rows of nothing": (
        declared((VERTEX, b"element other %d\n" % 10**12 + VERTEX)),
        "element 'other' has 1000000000000 rows and no property",
    ),
    "rows of nothing in text": (
        MESH.replace(b"element face", b"element other 7\nelement face"),
        "a mesh",
    ),
    "another row": (
        declared((VERTEX, b"element vertex 4\n")),
        "truncated: the header announces 4 rows of 'vertex', at least 224 bytes",
    ),
    "missing tail": (
        declared((b"end_header", b"element cell 1\nproperty double a\nend_header")),
        "truncated: the header announces 1 rows of 'cell', at least 176 bytes so far, but only 168",
    ),
    "lists before the splats": (
        declared((VERTEX, LIST_AHEAD % b"uchar"), (b"end_header\n", b"end_header\n\x00\x00")),
        "element 'face' has a list and stands before the splats, expected it behind them",
    ),
}


@pytest.mark.parametrize("name", REFUSED)
def test_a_file_that_is_wrong_is_refused_with_its_name_and_the_place(tmp_path, name):
    """The message starts with the path and says what was found and what was expected."""
    data, expected = REFUSED[name]
    with pytest.raises(RefineError) as caught:
        opened(tmp_path, data)

    assert str(caught.value).startswith(f"{tmp_path / 'in.ply'}: ")
    assert expected in str(caught.value)
    assert len(str(caught.value)) < 1000
    assert data == (tmp_path / "in.ply").read_bytes()


LONG = b"n" * 5000


@pytest.mark.parametrize(
    "data",
    [
        declared((b"float rot_3", b"float " + LONG)),
        declared((b"element vertex", b"element " + LONG)),
        declared((b"end_header", b"property list uchar int %s\nend_header" % LONG)),
        declared((b"end_header", b"property float f_rest_%s\nend_header" % LONG)),
        declared((b"end_header", b"element %s 1\nproperty double a\nend_header" % LONG)),
        declared((b"end_header", b"element %s 7\nend_header" % LONG)),
        declared((VERTEX, LIST_AHEAD.replace(b"face", LONG) % b"float")),
        declared(
            (VERTEX, LIST_AHEAD.replace(b"face", LONG) % b"uchar"),
            (b"end_header\n", b"end_header\n\xff"),
        ),
        declared((b"property float x", b"property float x%s\nproperty float x%s" % (LONG, LONG))),
        declared((b"property float x", b"property %s x" % LONG)),
        declared((b"property float x", b"%s float x" % LONG)),
        declared((VERTEX, b"element vertex %s\n" % LONG)),
        declared((b"binary_little_endian", LONG)),
    ],
)
def test_names_that_do_not_end_do_not_flood_the_message(tmp_path, data):
    """Forty characters of each are shown."""
    with pytest.raises(RefineError) as caught:
        opened(tmp_path, data)

    assert len(str(caught.value)) < 1000


TEXT_HEADER = plain_header(2, NAMES, "ascii").replace(
    b"end_header", b"property uchar tag\nend_header"
)
TEXT_ROW = b"0 0 0 0 0 0 0 0 0 0 1 0 0 0 7\n"


TEXT_WRONG = {
    "word": (TEXT_ROW.replace(b"1", b"one"), "property 'rot_0': expected a number of type float32"),
    "too large": (TEXT_ROW.replace(b"7", b"300"), "expected a number of type uint8, got '300'"),
    "broken": (TEXT_ROW.replace(b"7", b"7.5"), "expected a number of type uint8, got '7.5'"),
    "negative": (TEXT_ROW.replace(b"7", b"-7"), "expected a number of type uint8, got '-7'"),
    "one less": (TEXT_ROW.replace(b" 7", b""), "expected 15 numbers, got 14"),
    "one more": (TEXT_ROW.replace(b" 7", b" 7 7"), "expected 15 numbers, got 16"),
    "remark": (TEXT_ROW.replace(b"7", b"7 # 7"), "expected 15 numbers, got 17"),
    "foreign": (TEXT_ROW.replace(b"7", b"\xff"), r"of type uint8, got '\\xff'"),
    "blank": (b"\n" + TEXT_ROW, "expected 15 numbers, got 0"),
    "separator": (TEXT_ROW.replace(b"1", b"1\x1d5"), r"of type float32, got '1\x1d5'"),
    "separator alone": (TEXT_ROW.replace(b" 7", b"\x1f7"), "expected 15 numbers, got 14"),
}


@pytest.mark.parametrize("name", TEXT_WRONG)
@pytest.mark.parametrize("behind", [0, 1, 5])
def test_a_text_row_that_is_wrong_is_refused_with_its_number(tmp_path, name, behind):
    """Rows count from 0, as those of a binary file do; the fourth one is wrong here."""
    row, expected = TEXT_WRONG[name]
    header = TEXT_HEADER.replace(b"vertex 2", b"vertex %d" % (4 + behind))
    good = TEXT_ROW * 2 + TEXT_ROW.replace(b"\n", b"   \n")  # as long as if none lacked

    with pytest.raises(RefineError) as caught:
        opened(
            tmp_path,
            header + good + row + TEXT_ROW * behind,
        )

    assert str(caught.value).startswith(f"{tmp_path / 'in.ply'}: vertex row 3: ")
    assert expected in str(caught.value)


def test_text_that_ends_early_is_refused_with_the_row(tmp_path):
    """Two rows are announced and one is there, long enough to be two by its bytes."""
    row = TEXT_ROW.replace(b"\n", b" " * 40 + b"\n")

    with pytest.raises(RefineError, match="truncated: the file ends in row 1 of 2 of 'vertex'"):
        opened(tmp_path, TEXT_HEADER + row)


@pytest.mark.parametrize("form", ["binary_little_endian", "binary_big_endian"])
def test_a_file_that_claims_the_other_byte_order_is_no_crash(tmp_path, form):
    """Nothing in a PLY tells; the numbers are then those of the bytes as declared."""
    data = PLAIN.replace(b"binary_little_endian", form.encode())
    order = {"binary_little_endian": "<", "binary_big_endian": ">"}[form]
    expected = np.frombuffer(data[-168:], f"{order}f4")[0]

    assert expected == opened(tmp_path, data).rows["x"][0]


@pytest.mark.slow
@given(case=ply_files(least=1, forms=("binary_little_endian", "binary_big_endian")))
def test_a_binary_file_cut_anywhere_in_its_splats_is_refused(folder, case):
    """Cut at every byte up to the end of the last vertex row."""
    whole = len(case.data) - len(case.after)
    step = max(whole // 40, 1)
    for cut in [*range(0, whole, step), whole - 1]:
        with pytest.raises(RefineError, match=re.escape(str(folder / "in.ply"))):
            opened(folder, case.data[:cut])


def test_a_small_file_cut_at_every_byte_is_refused(tmp_path):
    """Every prefix lacks something: the end of the header, or of the last row."""
    for cut in range(len(PLAIN)):
        with pytest.raises(RefineError, match=r"empty|not a PLY|header without end|truncated"):
            opened(tmp_path, PLAIN[:cut])


def test_a_text_file_cut_at_every_byte_is_refused_or_lacks_digits_of_its_last_number(tmp_path):
    """Without its line end the last row is still one; within its last number nobody can tell."""
    data = TEXT_HEADER + TEXT_ROW + TEXT_ROW.replace(b"7", b"127")
    for cut in range(len(data) - 3):
        with pytest.raises(RefineError, match=re.escape(str(tmp_path / "in.ply"))):
            opened(tmp_path, data[:cut])
    tags = [opened(tmp_path, data[:cut]).rows["tag"].tolist() for cut in range(-3, 0)]

    assert tags == [[7, 1], [7, 12], [7, 127]]


def test_a_header_line_of_a_hundred_megabytes_costs_one(tmp_path):
    """The header is looked for in the first 2^20 bytes."""
    path = tmp_path / "in.ply"
    with path.open("wb") as stream:
        stream.write(b"ply\nformat ascii 1.0\ncomment ")
        stream.truncate(100_000_000)
    tracemalloc.start()

    with pytest.raises(RefineError, match="no 'end_header' line in the first 1048576 bytes"):
        read_ply(path)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()

    assert peak < 4e6


def seconds(work, size):
    """Return the processor time of one thread that `work(size)` takes, the least of three tries."""
    times = []
    for _ in range(3):
        start = time.thread_time()
        work(size)
        times.append(time.thread_time() - start)
    return min(times)


def test_a_header_of_empty_lines_is_refused_in_time_that_grows_with_its_length(tmp_path):
    """For eight times the length about eight times the time; it was the square, 64 times."""

    def refused(size):
        (tmp_path / "a.ply").write_bytes(b"ply" + b"\n" * size)
        with pytest.raises(RefineError, match="header without end"):
            read_splats(tmp_path / "a.ply")

    assert seconds(refused, 32_000) < 24 * max(seconds(refused, 4_000), 1e-3)


def test_what_is_no_file_is_refused(tmp_path):
    """A folder, nothing, a pipe, a name with a zero byte, a name too long, nobody's home."""
    pipe = tmp_path / "pipe.ply"
    if hasattr(os, "mkfifo"):  # not on Windows
        os.mkfifo(pipe)
        with pytest.raises(RefineError, match=r"pipe\.ply: is a device, expected a PLY file"):
            read_ply(pipe)
    for path, expected in {
        str(tmp_path): "is a folder, expected a PLY file",
        str(tmp_path / "none.ply"): "cannot be read (No such file or directory)",
        str(tmp_path / "zero\0.ply"): "cannot be read (",
        str(tmp_path / ("a" * 300)): "cannot be read (File name too long)",
        "~nobody-of-that-name/in.ply": "cannot be found (",
    }.items():
        named = path.replace("\0", r"\x00")
        with pytest.raises(RefineError, match=re.escape(f"{named}: {expected}")):
            read_ply(path)
