"""COLMAP models, text and binary."""

import gc
import struct
from io import BufferedReader

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from refine_addon.core import RefineError, read_cameras
from tests.hostile import refused

from .test_camera_files import POINT, pixel

POSE = (0.5, 0.5, 0.5, -0.5, -2, 3, 1)
"""The camera of `test_camera_files.test_every_format_gives_the_same_view`."""

_LAYOUTS = (
    ("SIMPLE_PINHOLE", "f cx cy"), ("PINHOLE", "fx fy cx cy"), ("SIMPLE_RADIAL", "f cx cy k"),
    ("RADIAL", "f cx cy k k"), ("OPENCV", "fx fy cx cy k k p p"),
    ("OPENCV_FISHEYE", "fx fy cx cy k k k k"), ("FULL_OPENCV", "fx fy cx cy k k p p k k k k"),
    ("FOV", "fx fy cx cy omega"), ("SIMPLE_RADIAL_FISHEYE", "f cx cy k"),
    ("RADIAL_FISHEYE", "f cx cy k k"), ("THIN_PRISM_FISHEYE", "fx fy cx cy k k p p k k s s"),
    ("RAD_TAN_THIN_PRISM_FISHEYE", "fx fy cx cy k k k k k k p p s s s s"),
    ("SIMPLE_DIVISION", "f cx cy k"), ("DIVISION", "fx fy cx cy k"),
    ("SIMPLE_FISHEYE", "f cx cy"), ("FISHEYE", "fx fy cx cy"),
    ("EUCM", "fx fy cx cy alpha beta"),
)  # fmt: skip
MODELS = [(name, number, layout) for number, (name, layout) in enumerate(_LAYOUTS)]
"""Name, number and parameters, as COLMAP's ``src/colmap/sensor/models`` lists them."""

VALUES = {"f": 100, "fx": 100, "fy": 120, "cx": 30.5, "cy": 24}

PINHOLE = (1, 1, 64, 48, (100, 120, 32, 24))
IMAGE = (1, POSE, 1, "a.png", 0)
TWO = ([PINHOLE, (2, 0, 8, 8, (1, 2, 3))], [IMAGE, (2, POSE, 2, "b", 2)])


# Tiny writers: cameras as (id, model, width, height, parameters), images as
# (id, pose, camera id, name, number of points).


def binary_cameras(cameras):
    data = struct.pack("<Q", len(cameras))
    for camera_id, model, width, height, values in cameras:
        data += struct.pack("<IiQQ", camera_id, model, width, height)
        data += struct.pack(f"<{len(values)}d", *values)
    return data


def binary_images(images):
    data = struct.pack("<Q", len(images))
    for image_id, pose, camera_id, name, points in images:
        data += struct.pack("<I7dI", image_id, *pose, camera_id)
        data += name.encode() + b"\0" + struct.pack("<Q", points)
        data += struct.pack("<ddQ", 1.5, 2.5, 2**64 - 1) * points
    return data


def text_cameras(cameras):
    names = {number: name for name, number, _ in MODELS}
    lines = ["# Camera list with one line of data per camera:"]
    for camera_id, model, width, height, values in cameras:
        lines.append(f"{camera_id} {names[model]} {width} {height} {' '.join(map(repr, values))}")
    return ("\n".join(lines) + "\n").encode()


def text_images(images):
    lines = ["# Image list with two lines of data per image:", "#   POINTS2D[] as (X, Y, ID)"]
    for image_id, pose, camera_id, name, points in images:
        lines += [f"{image_id} {' '.join(map(repr, pose))} {camera_id} {name}"]
        lines += [" ".join(["1.5 2.5 -1"] * points)]
    return ("\n".join(lines) + "\n").encode()


HALVES = ("cameras", "images")
WRITERS = {".bin": (binary_cameras, binary_images), ".txt": (text_cameras, text_images)}


def write(folder, suffix, cameras=(PINHOLE,), images=(IMAGE,)):
    """Write a model; `cameras` and `images` may also be the bytes of the file."""
    for stem, things, made in zip(HALVES, (cameras, images), WRITERS[suffix], strict=True):
        data = things if isinstance(things, bytes) else made(things)
        (folder / f"{stem}{suffix}").write_bytes(data)
    return folder


def wrong(folder, file, expected):  # 1.9e6 bytes are Python's table of names, when it grows
    return refused(folder, expected, read=read_cameras, file=folder / file, memory=2.5e6)


both = pytest.mark.parametrize("suffix", WRITERS)


@both
@pytest.mark.parametrize(("name", "number", "layout"), MODELS)
def test_every_camera_model_gives_its_pinhole(tmp_path, suffix, name, number, layout):
    """A second camera follows, which is found only if the number of parameters is right.

    COLMAP's centre of a 64 x 48 image is (32, 24) as is ours, so it is not shifted by 0.5.
    Distortion is noted of cameras that an image uses alone: here two of three.
    """
    fisheye = f"{{}} (fisheye, {name}) taken as pinhole: wrong away from the centre"
    values = [VALUES.get(key, 0) for key in layout.split()]
    images = [(1, POSE, 5, "a", 3), (2, POSE, 1, "b", 0)]
    views = read_cameras(write(tmp_path, suffix, [(5, number, 64, 48, values), PINHOLE], images))
    assert (views[0].fx, views[0].fy) == (100, 120 if "fy" in layout else 100)
    assert [(view.cx, view.cy) for view in views] == [(30.5, 24), (32, 24)]
    assert views.note == (fisheye.format("1 camera") if "FISHEYE" in name else "")
    if not {"k", "omega", "alpha"} & set(layout.split()):
        return
    values = [VALUES.get(key, 0.01) for key in layout.split()]
    cameras = [(index, number, 64, 48, values) for index in (1, 2, 3)]
    images = [(index, POSE, 1 + index % 2, f"{index}", 0) for index in range(5)]
    note = read_cameras(write(tmp_path, suffix, cameras, images)).note
    distorted = f"distortion of 2 cameras ignored (model {name})"
    assert note == (fisheye.format("2 cameras") if "FISHEYE" in name else distorted)


@both
def test_views_are_sorted_by_name_and_id_whatever_the_order_of_the_file(tmp_path, suffix):
    """Images without points do not swallow the next one's line."""
    given = [(9, "c"), (3, "b/2.png"), (4, "c"), (2, "a 1.png")]
    images = [(key, (*POSE[:6], key), 1, name, key % 3) for key, name in given]
    views = read_cameras(write(tmp_path, suffix, images=images))
    assert [view.name for view in views] == ["a 1.png", "b/2.png", "c", "c"]
    assert [(view.rotation @ -view.center)[2] for view in views] == pytest.approx([2, 3, 4, 9])


@settings(suppress_health_check=[HealthCheck.function_scoped_fixture], max_examples=30)
@given(
    quaternion=st.tuples(*[st.floats(-1, 1)] * 4).filter(lambda q: max(map(abs, q)) > 1e-3),
    center=st.tuples(*[st.floats(-1e6, 1e6)] * 3),
    length=st.sampled_from([1.0, -3.0, 1e-8]),
)
def test_any_pose_survives_a_round_trip(tmp_path, quaternion, center, length):
    """Rotating the basis by q v q* (the definition) gives the columns of R; t = -R c.

    A quaternion of any length and sign is the same rotation.
    """
    quaternion, center = (np.where(np.abs(v) < 1e-9, 0, v) for v in (quaternion, center))
    w, *axis = quaternion / np.linalg.norm(quaternion)
    basis = np.eye(3)
    once = np.cross(axis, basis)  # q v q* = v + 2 w (a x v) + 2 a x (a x v)
    rotation = (basis + 2 * w * once + 2 * np.cross(axis, once)).T
    pose = [float(v) for v in (*(length * turn for turn in (w, *axis)), *(-rotation @ center))]
    for suffix in WRITERS:
        write(tmp_path, suffix, [PINHOLE], [(1, pose, 1, "a", 0)])
        with np.errstate(all="raise"):
            (view,) = read_cameras(tmp_path / f"images{suffix}")
        np.testing.assert_allclose(view.rotation, rotation, atol=1e-12)
        np.testing.assert_allclose(view.center, center, atol=1e-8)


def test_any_file_of_the_model_leads_to_it(tmp_path):
    """Rigs and frames of newer models lie beside; the poses are in images all the same.

    Of a folder binary is preferred to text, as by COLMAP itself.
    """
    for suffix in WRITERS:
        write(tmp_path, suffix, images=[(1, POSE, 1, suffix, 0)])
        for stem in ("cameras", "images", "points3D", "rigs", "frames"):
            (tmp_path / f"{stem}{suffix}").touch()
            assert read_cameras(tmp_path / f"{stem}{suffix}")[0].name == suffix
    assert read_cameras(tmp_path)[0].name == ".bin"


LINE = b"1 0.5 0.5 0.5 -0.5 -2 3 1 1 a.png"


def test_the_line_of_points_may_be_empty_or_absent(tmp_path):
    for images in (
        LINE,
        b"\n\n" + LINE + b"\r\n\r\n\r\n",
        b"\xef\xbb\xbf# Images\n1  0.5 0.5 0.5\t-0.5 -2 3 1 1 a.png \n1 2 -1 3 4 5\n",
    ):
        (view,) = read_cameras(write(tmp_path, ".txt", images=images))
        assert pixel(view, POINT) == pytest.approx([57, 39], abs=1e-12)
        assert view.name == "a.png"


@both
@pytest.mark.parametrize("file", HALVES)
def test_an_empty_or_missing_half_is_named(tmp_path, suffix, file):
    path = write(tmp_path, suffix, **{file: b""}) / f"{file}{suffix}"
    wrong(tmp_path, path.name, "the file is empty, expected cameras")
    path.unlink()
    beside = tmp_path / f"points3D{suffix}"
    beside.touch()
    refused(beside, "cannot be read (", read=read_cameras, file=path)


FINITE = "expected a finite number up to 1e18, got"
NAN = float("nan")
FAR = (0.9238795325112867, 0, 0, 0.3826834323650898, 9e17, -9e17, 0)
"""Turned by 45 degrees about z, t = (9e17, -9e17, 0) is sqrt(2) * 9e17 along one axis."""


@both
@pytest.mark.parametrize(
    ("second", "problem"),
    [
        ((2, (NAN, *POSE[1:]), 1, "b", 0), f"QW: {FINITE} NaN"),
        ((2, (0, 0, 0, 0, 1, 2, 3), 1, "b", 0), "expected a quaternion (w, x, y, z)"),
        ((2, FAR, 1, "b", 0), "the camera's centre is farther than 1e18"),
        ((2, POSE, 7, "b", 0), "refers to camera 7, expected one of the 1 in cameras"),
        ((1, 1, 0, 48, (100, 120, 32, 24)), "width: expected a whole number of pixels"),
        ((1, 1, 64, 2**64 - 1, (100, 120, 32, 24)), f"height: {FINITE}"),
        ((1, 1, 64, 48, (100, 0.0, 32, 24)), "focal length: expected a positive focal length"),
        ((9, 1, 64, 48, (100, 120, 32, 24)), "camera 9 is there twice"),
    ],
    ids=range(8),
)
def test_a_wrong_image_or_camera_is_named_with_its_place(tmp_path, suffix, second, problem):
    if second[3] == "b":
        file, place = "images", "image row 1"
        write(tmp_path, suffix, images=[IMAGE, second])
    else:
        file, place = "cameras", "line 3" if suffix == ".txt" else "camera row 1 at byte 64"
        write(tmp_path, suffix, [(9, *PINHOLE[1:]), second])
    assert place in wrong(tmp_path, f"{file}{suffix}", problem)


@pytest.mark.slow
@pytest.mark.parametrize("file", HALVES)
def test_a_binary_cut_off_at_any_byte_is_refused(tmp_path, file):
    """The message tells the byte where the missing part should have started.

    A count of 1 where two are there is refused too: nobody can tell which the count is wrong about.
    """
    path = write(tmp_path, ".bin", *TWO) / f"{file}.bin"
    whole = path.read_bytes()
    for length in range(1, len(whole)):
        path.write_bytes(whole[:length])
        message = wrong(tmp_path, path.name, "truncated: ")
        assert int(message.split(": byte ")[1].split(":")[0]) <= length
    path.write_bytes(struct.pack("<Q", 1) + whole[8:])
    first = {"cameras": 8 + 24 + 4 * 8, "images": 8 + 64 + 14}[file]
    expected = f"byte {first}: expected the end of the file after 1 {file[:-1]}"
    wrong(tmp_path, path.name, f"{expected}, got {len(whole) - first} more bytes")


@pytest.mark.parametrize("count", [2, 2**32, 2**63, 2**64 - 1])
def test_a_count_that_the_file_does_not_back_allocates_nothing(tmp_path, count):
    number = struct.pack("<Q", count)
    for file in ("cameras", "images"):
        path = write(tmp_path, ".bin") / f"{file}.bin"
        path.write_bytes(number + path.read_bytes()[8:])
        wrong(tmp_path, path.name, f"truncated: {file[:-1]} row 1: expected ")
    write(tmp_path, ".bin", images=binary_images([IMAGE])[:-8] + number)
    wrong(tmp_path, "images.bin", f"truncated: {count} points of image row 0")


def only(model, *values):
    """Return a second camera behind a good one, as it is in binary files."""
    return binary_cameras([PINHOLE, (2, model, 64, 48, values)])


UNTERMINATED = binary_images([IMAGE])[: 8 + 64] + b"x" * 100
NAMELESS = "byte 72: truncated: name of image row 0: expected a zero byte"
CAMERA, LINES = "1 PINHOLE 64 48 100 120 32", "1 1 0 0 0 0 0 0 1 a\n"
ID = "expected a whole number as id"
FIELDS = "expected IMAGE_ID, QW, QX, QY, QZ, TX, TY, TZ, CAMERA_ID, NAME"
ROWS = [
    ("cameras.bin", only(17, 64, 48), "EQUIRECTANGULAR is a panorama"),
    ("cameras.bin", only(-1), "camera row 1 at byte 64: unknown camera model -1, expected 0"),
    ("images.bin", binary_images([]), "no registered image, expected at least one"),
    ("images.bin", UNTERMINATED, NAMELESS),
    ("cameras.txt", "#\n\n1 LENS 64 48 1 2 3", "line 3: unknown camera model 'LENS'"),
    ("cameras.txt", "\x1c", "line 1: unknown camera model ''"),  # white space to str alone
    ("cameras.txt", CAMERA, "line 1: expected width, height and 4 parameters of P"),
    ("cameras.txt", f"{'9' * 5000}{CAMERA[1:]} 24", ID),
    ("cameras.txt", "1 PINHOLE 64.5 48 100 120 32 24", "width: expected a whole number of p"),
    ("images.txt", f"{LINES}\n1 1 0 0 0 0 0 0 1", f"line 3 image row 1: {FIELDS}"),
    ("images.txt", "1 1 0 0 zero 0 0 0 1 a.png", "expected a number, got 'zero'"),
    # Else every second image would be taken for the points of the one before, and vanish.
    ("images.txt", LINES * 4, "line 2: expected the points of image row 0"),
    # A place was made for each empty line and kept: 250 bytes of memory for one of the file.
    ("images.txt", "\n" * 20_000 + "1 2 3", "line 20001 image row 0"),
]


@pytest.mark.parametrize(("file", "data", "problem"), ROWS, ids=range(len(ROWS)))
def test_a_wrong_row_or_line_is_named(tmp_path, file, data, problem):
    data = data if isinstance(data, bytes) else data.encode()
    write(tmp_path, file[-4:], **{file[:-4]: data})
    wrong(tmp_path, file, problem)


def test_a_file_that_is_refused_is_closed(tmp_path):
    """The error holds what was being read; Windows deletes no file that is open."""
    write(tmp_path, ".txt", images=b"1 2 3\n")
    with pytest.raises(RefineError) as caught:
        read_cameras(tmp_path)
    readers = [each for each in gc.get_objects() if isinstance(each, BufferedReader)]
    names = [str(getattr(each, "name", "")) for each in readers if not each.closed]
    assert str(tmp_path / "images.txt") not in names
    del caught
