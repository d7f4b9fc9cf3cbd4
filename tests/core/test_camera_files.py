"""Cameras from JSON files, and which file of a folder is read."""

import json
import math
import os
import struct

import numpy as np
import pytest

from refine_addon.core import read_cameras
from tests.hostile import refused
from tests.users import closed_folder

POINT = np.array([-1.0, 2.5, 2.75])
"""See `test_every_format_gives_the_same_view`."""

INRIA = {"id": 7, "img_name": "a.png", "width": 64, "height": 48, "fx": 100, "fy": 120}
INRIA |= {"position": [1, 2, 3], "rotation": [[0, 0, -1], [1, 0, 0], [0, -1, 0]]}

MATRIX = [[0, 0, 1, 1], [1, 0, 0, 2], [0, 1, 0, 3], [0, 0, 0, 1]]
FRAME = {"file_path": "a.png", "transform_matrix": MATRIX}
LENS = {"fl_x": 100, "fl_y": 120, "cx": 32, "cy": 24, "w": 64, "h": 48}
TRANSFORMS = {**LENS, "frames": [FRAME]}
BESIDE = "dataparser_transforms.json"
SHORT = {"fl_x": 100, "frames": [FRAME]}


def pixel(view, point):
    """Project slowly, by the words of `View`."""
    x, y, z = view.rotation @ (point - view.center)
    return [view.fx * x / z + view.cx, view.fy * y / z + view.cy]


def write(path, data):
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(data if isinstance(data, str) else json.dumps(data))
    return path


def write_colmap(folder):
    write(folder / "cameras.txt", "1 PINHOLE 64 48 100 120 32 24\n")
    write(folder / "images.txt", "1 0.5 0.5 0.5 -0.5 -2 3 1 1 a.png\n\n")


def read(tmp_path, data):
    with np.errstate(all="raise"):
        return read_cameras(write(tmp_path / "cameras.json", data))


def wrong(tmp_path, data, expected):
    refused(write(tmp_path / "cameras.json", data), expected, read=read_cameras)


def two(**keys):
    """Return frames of which the second has keys of its own."""
    return {**LENS, "frames": [FRAME, {**FRAME, **keys}]}


@pytest.mark.parametrize("kind", ["cameras.json", "transforms.json", "colmap"])
def test_every_format_gives_the_same_view(tmp_path, kind):
    """The camera stands at (1, 2, 3), looks along -X, and world Z is up in its picture.

    So its x axis (right) is world (0, 1, 0), y (down) is (0, 0, -1), z (forward) is (-1, 0, 0).
    The point (-1, 2.5, 2.75) is the centre + 0.5 x + 0.25 y + 2 z, and lands at
    u = 100 * 0.5 / 2 + 32 = 57, v = 120 * 0.25 / 2 + 24 = 39.

    Inria stores x, y, z as columns; OpenGL x, -y, -z. COLMAP stores R with rows x, y, z: its
    trace is 0, so qw = 1/2, qx = (R21 - R12) / 2 = 1/2, qy = (R02 - R20) / 2 = 1/2,
    qz = (R10 - R01) / 2 = -1/2, and t = -R (1, 2, 3) = (-2, 3, 1)."""
    write(tmp_path / "cameras.json", [INRIA])
    write(tmp_path / "transforms.json", TRANSFORMS)
    write_colmap(tmp_path / "colmap")
    (view,) = read_cameras(str(tmp_path / kind))
    assert pixel(view, POINT) == pytest.approx([57, 39], abs=1e-12)
    np.testing.assert_allclose(view.rotation, [[0, 1, 0], [0, 0, -1], [-1, 0, 0]], atol=1e-15)
    np.testing.assert_allclose(view.center, [1, 2, 3], atol=1e-15)
    assert (view.fx, view.fy, view.cx, view.cy) == (100, 120, 32, 24)
    assert (view.width, view.height, view.name) == (64, 48, "a.png")


def test_inria_cameras_keep_their_order_and_may_share_a_name(tmp_path, monkeypatch):
    """One without a name is called by its index; half a surrogate pair could not be printed.
    A byte order mark and a tilde are understood."""
    named = [{**INRIA, "img_name": name} for name in ("b", "a", "b", "\ud800ä")]
    unnamed = {key: value for key, value in INRIA.items() if key != "img_name"}
    views = read(tmp_path, [*named, {**unnamed, "cx": 30.5, "cy": 20}])
    assert [view.name for view in views] == ["b", "a", "b", "?ä", "4"]
    assert (views[4].cx, views[4].cy) == (30.5, 20)
    (tmp_path / "cameras.json").write_bytes(b"\xef\xbb\xbf" + json.dumps([INRIA]).encode())
    for variable in ("HOME", "USERPROFILE"):
        monkeypatch.setenv(variable, str(tmp_path))
    assert len(read_cameras("~/cameras.json")) == 1


def test_a_rounded_rotation_is_made_exact(tmp_path):
    """Rows of 4 decimals are off by up to 5e-5; the view's rotation is orthonormal again.
    1e-200 squared would underflow: such entries are read as 0, and the result is exact."""
    c, s = round(math.cos(0.3), 4), round(math.sin(0.3), 4)
    rounded = {**INRIA, "rotation": [[c, -s, 0], [s, c, 0], [0, 0, 1]]}
    tiny = {**INRIA, "rotation": [[1, 1e-200, 0], [-1e-200, 1, 0], [0, 5e-324, 1]]}
    view, other = read(tmp_path, [rounded, {**tiny, "position": [0, 0, 1e-310]}])
    np.testing.assert_allclose(view.rotation @ view.rotation.T, np.eye(3), atol=1e-14)
    assert view.rotation[0, 1] == pytest.approx(math.sin(0.3), abs=1e-4)
    np.testing.assert_array_equal([*other.rotation, other.center], [*np.eye(3), [0, 0, 0]])


def test_a_path_that_leads_to_no_text_is_named(tmp_path):
    """A named pipe is refused rather than waited for; a folder that is closed is itself named."""
    refused("~no-such-user/cameras.json", "cannot be found (", read=read_cameras)
    no_text = b'[{"img_name": "\xff"}]'
    refused(tmp_path / "a.json", "byte 0xff in position 15", no_text, read=read_cameras)
    for name in ("nothing.json", "no/folder", "nul\0byte", "x" * 500):
        named = str(tmp_path / name).replace("\0", r"\x00")
        refused(tmp_path / name, "", read=read_cameras, file=named)
    if hasattr(os, "mkfifo"):  # not on Windows
        os.mkfifo(tmp_path / "cameras.json")
        expected = "is neither a file nor a folder, expected cameras"
        refused(tmp_path / "cameras.json", expected, read=read_cameras)
        with closed_folder({"cameras.json": json.dumps([INRIA])}) as closed:
            for path in (closed, closed / "cameras.json"):
                expected = "cannot be read (Permission denied)"
                refused(path, expected, read=read_cameras, file=closed / "cameras.json")


def test_what_a_frame_says_comes_before_what_all_share(tmp_path):
    shared, view = read(tmp_path, two(fl_x=50, cy=20, w=32, file_path="b.png"))
    assert (shared.fx, shared.fy, shared.cy, shared.width) == (100, 120, 24, 64)
    assert (view.fx, view.fy, view.cx, view.cy) == (50, 120, 32, 20)
    assert (view.width, view.height, view.name) == (32, 48, "b.png")


def test_focal_lengths_come_from_lengths_or_angles(tmp_path):
    """A field of view of 90 degrees spans a side s at the focal length s / 2: 32 or 24 pixels.
    What instant-ngp does inside itself moves no camera; a missing principal point is the middle."""
    inside = {"scale": 0.33, "offset": [0.5, 0.5, 0.5], "aabb_scale": 16, "aabb": [[0] * 3] * 2}
    quarter = math.pi / 2
    for keys, expected in (
        ({"fl_x": 100}, (100, 100)),
        ({"camera_angle_x": quarter, "camera_angle_y": quarter}, (32, 24)),
        ({"x_fov": 90}, (32, 32)),
        ({"fl_x": 100, "camera_angle_x": 1, "camera_angle_y": quarter}, (100, 24)),
    ):
        (view,) = read(tmp_path, {"w": 64, "h": 48.0, **keys, **inside, "frames": [FRAME]})
        assert (view.fx, view.fy) == pytest.approx(expected, rel=1e-12)
        assert (view.cx, view.cy, view.height) == (32, 24, 48)
        np.testing.assert_array_equal(view.center, [1, 2, 3])


def test_dataparser_transforms_beside_it_lead_to_the_splats_of_ns_export(tmp_path):
    """Nerfstudio turned the poses by D: (x, y, z) -> (y, -x, z) + (1, 1, 1), and then halved them.
    Before, ns-process-data had applied A: (x, y, z) -> (x, z, -y) + (5, 0, 0). The file stores
    D after A: (x, y, z) -> (z, -x, -y) + D(5, 0, 0) = (z, -x, -y) + (1, -4, 1), and 0.5; with a
    scale of 4 that was applied before, 2.
    The camera at (1, 2, 3) goes to (2, -1, 3) + 1 = (3, 0, 4), halved (1.5, 0, 2); the point at
    (-1, 2.5, 2.75) to (3.5, 2, 3.75) / 2, and it still lands at pixel (57, 39)."""
    applied = [[1, 0, 0, 5], [0, 0, 1, 0], [0, -1, 0, 0]]
    views = read(tmp_path, {**TRANSFORMS, "applied_transform": applied, "applied_scale": 2})
    assert views.note == "splats of ns-export need dataparser_transforms.json beside it"
    stored = [[0, 0, 1, 1], [-1, 0, 0, -4], [0, -1, 0, 1]]
    for before in (1, 4):
        write(tmp_path / BESIDE, {"transform": stored, "scale": 0.5 * before})
        own = {"applied_transform": applied, "applied_scale": before}
        views = read(tmp_path, {**TRANSFORMS, **own})
        np.testing.assert_allclose(views[0].center, [1.5, 0, 2], atol=1e-12)
        assert pixel(views[0], np.array([1.75, 1, 1.875])) == pytest.approx([57, 39], abs=1e-9)
        assert views.note == "dataparser_transforms.json applied"


def test_older_colmap_projects_of_nerfstudio_have_a_transform_of_their_own(tmp_path):
    """Where none is named but colmap/sparse/0 is there, A is (x, y, z) -> (y, x, -z).
    With A itself stored, nerfstudio's own part is nothing and the camera stays. Errors name it."""
    (tmp_path / "colmap" / "sparse" / "0").mkdir(parents=True)
    stored = {"transform": [[0, 1, 0, 0], [1, 0, 0, 0], [0, 0, -1, 0]], "scale": 1}
    write(tmp_path / BESIDE, stored)
    (view,) = read(tmp_path, TRANSFORMS)
    np.testing.assert_allclose(view.center, [1, 2, 3], atol=1e-15)
    assert pixel(view, POINT) == pytest.approx([57, 39], abs=1e-12)
    for data, problem in (
        ({"scale": 1}, "missing 'transform'"),
        ({"transform": MATRIX, "scale": 1}, "'transform': expected a 3 x 4 matrix"),
        ({"transform": MATRIX[:3], "scale": 0}, "'scale': expected a positive scale, got 0"),
        ([], "expected an object, got a list of 0"),
    ):
        write(tmp_path / BESIDE, data)
        refused(tmp_path / "cameras.json", problem, read=read_cameras, file=tmp_path / BESIDE)


FISHEYE = "1 frame (fisheye, OPENCV_FISHEYE) taken as pinhole: wrong away from the centre"
SCALED = [[3 * value for value in row[:3]] + row[3:] for row in MATRIX[:3]] + MATRIX[3:]
MIRRORED = [[-row[0], *row[1:]] for row in MATRIX[:3]] + MATRIX[3:]


def test_poses_and_lenses_that_are_no_pinholes_are_noted(tmp_path):
    """A scaled camera sees the same picture: u = fx (s x) / (s z) + cx. Its centre stays.
    With x negated, the point's x is -0.5 and u = 32 - 25 = 7. A matrix of three rows will do."""
    for keys, note in (
        ({"transform_matrix": MATRIX[:3]}, ""),
        ({"transform_matrix": SCALED}, "uniform scale taken out of 1 frame"),
        ({"transform_matrix": MIRRORED}, "mirrored pose (determinant -1) of 1 frame"),
        ({"k1": 0.1}, "distortion of 1 frame ignored (model OPENCV)"),
        ({"k4": 0.1, "camera_model": "PINHOLE"}, "distortion of 1 frame ignored (model PINHOLE)"),
        ({"camera_model": "OPENCV_FISHEYE"}, FISHEYE),
        ({"is_fisheye": True, "k1": 0}, ""),
    ):
        views = read(tmp_path, two(**keys))
        u = 7 if keys.get("transform_matrix") == MIRRORED else 57
        assert pixel(views[1], POINT) == pytest.approx([u, 39], abs=1e-9)
        assert views.note == note
        shared = {**TRANSFORMS, **keys, "frames": [FRAME, FRAME]}
        if "transform_matrix" not in keys:
            assert read(tmp_path, shared).note == note.replace("1 frame", "2 frames")


NUMBER = "expected a number, got"
FINITE = "expected a finite number up to 1e18, got"
THREE = "expected a list of 3 numbers"
TURN = "expected an orthonormal"
X, Y = [1, 0, 0], [0, 1, 0]


WRONG = [
    ("fx", ["100", True, None, []], f": {NUMBER} "),
    ("fx", [0, -120], ": expected a positive focal length in pixels, got "),
    ("fy", [math.nan, math.inf, 10**400], f": {FINITE} "),
    ("cx", [[]], f": {NUMBER} a list of 0"),
    ("width", [64.5, 0, 10**7], ": expected a whole number of pixels"),
    ("position", [[1, 2], {"x": 1}], f": {THREE}, got "),
    ("position", [[1, 2, "3"], [1, 2, [3]]], f" [2]: {NUMBER} "),
    ("rotation", [[X, Y]], ": expected a 3 x 3 matrix"),
    ("rotation", [X], f" row 0: {THREE}"),
    ("rotation", [[X, Y, [0, 0, 2]], [[0] * 3] * 3, [[1e17] * 3] * 3], f": {TURN}"),
    ("rotation", [[X, Y, [0, 0, -1]]], ": expected a rotation, got a reflection"),
    ("camera_model", ["LENS"], ": unknown model 'LENS', expected one of"),
    ("transform_matrix", [MATRIX[:2]], ": expected a 3 x 4 or 4 x 4"),
    ("transform_matrix", [[[0] * 4] * 3, [[1e18] * 4] * 3], f": {TURN}"),
    ("transform_matrix", [[*MATRIX[:3], [0, 0, 0, 2]]], " row 3: expected [0, 0, 0, 1]"),
]


@pytest.mark.parametrize(("key", "values", "problem"), WRONG, ids=range(len(WRONG)))
def test_a_wrong_value_is_named_with_its_camera_or_frame_and_key(tmp_path, key, values, problem):
    for value in values:
        if key in INRIA or key == "cx":
            wrong(tmp_path, [INRIA, {**INRIA, key: value}], f": camera 1 '{key}'{problem}")
        else:
            wrong(tmp_path, two(**{key: value}), f": frame 1 '{key}'{problem}")


ANGLE = {"w": 64, "h": 48, "frames": [FRAME]}


NO_CAMERAS = [
    ("", "the file is empty"),
    ('[\n{"id" 1}]', "line 2 column 7: invalid JSON"),
    ("ply\nformat", "not a camera file: expected JSON"),
    ("[]", "the list of cameras is empty, expected at least one"),
    ("{}", "expected a list of cameras (cameras.json) or an object with 'frames'"),
    ("[null]", "camera 0: expected an object, got null"),
    ('[{"transform": []}]', "camera 0: poses of `ns-export cameras` have no focal length"),
    *(
        ([{name: INRIA[name] for name in INRIA if name != key}], f"camera 0: missing '{key}'")
        for key in ("position", "rotation", "fx", "fy", "width", "height")
    ),
    ({"frames": []}, "'frames': the list is empty, expected at least one frame"),
    (ANGLE, "frame 0: missing 'fl_x'"),
    ({**SHORT, "h": 48}, "frame 0: missing 'w', expected w and h"),
    (
        {**ANGLE, "camera_angle_x": math.pi},
        "'camera_angle_x': expected a field of view below 180°",
    ),
    (two(camera_model="EQUIRECTANGULAR"), "frame 1: 'EQUIRECTANGULAR' cameras are not pin"),
]


@pytest.mark.parametrize(("data", "problem"), NO_CAMERAS, ids=range(len(NO_CAMERAS)))
def test_what_holds_no_cameras_or_not_all_of_them_is_refused(tmp_path, data, problem):
    wrong(tmp_path, data, problem)


PNG = b"\x89PNG\r\n\x1a\n" + struct.pack(">I4sII", 13, b"IHDR", 300, 200) + b"\x08\x06\0\0\0"
JPEG = b"\xff\xd8\xff\xe0" + struct.pack(">H", 16) + bytes(14)
JPEG += b"\xff\xff\xc2" + struct.pack(">HBHHB", 17, 8, 200, 300, 3)  # fill byte, progressive frame


def test_an_image_tells_the_size_that_the_file_does_not(tmp_path):
    """As in the NeRF synthetic scenes: f = 300 / 2 / tan(pi / 4) = 150."""
    (tmp_path / "train").mkdir()
    for file, named, data in (
        ("train/r_0.png", "./train/r_0", PNG),
        ("train/r_0.png", "train\\r_0.png", PNG),
        ("r.0.jpeg", "r.0", JPEG),
    ):
        (tmp_path / file).write_bytes(data)
        frame = {**FRAME, "file_path": named}
        (view,) = read(tmp_path, {"camera_angle_x": math.pi / 2, "frames": [frame]})
        assert (view.width, view.height, view.name) == (300, 200, named)
        assert view.fx == view.fy == pytest.approx(150)


def test_an_image_that_does_not_tell_its_size_is_no_crash(tmp_path):
    """Nor a name that leads nowhere."""
    for data in (
        *(PNG[:length] for length in range(24)),
        *(JPEG[:length] for length in range(len(JPEG) - 1)),
        *(PNG[:16] + bytes(8), b"\xff\xd8" + b"\xff" * 100_000, b"\xff\xd8\xff\xda"),
        b"\xff\xd8\xff\xe0\0\0" * 100,
    ):
        (tmp_path / "a.png").write_bytes(data)
        wrong(tmp_path, SHORT, "frame 0")
    for name in ("", "nul\0", "x" * 5000, "/dev/zero", "."):
        wrong(tmp_path, {**SHORT, "frames": [{**FRAME, "file_path": name}]}, "frame 0: missing 'w'")


def test_a_folder_prefers_some_names_and_notes_the_rest(tmp_path):
    """First cameras.json, then transforms.json, the train split, and COLMAP in ``sparse/0``.
    A file that is named itself is read whatever lies beside it."""
    write_colmap(tmp_path / "sparse" / "0")
    others = "COLMAP model in sparse/0"
    train = {**TRANSFORMS, "frames": [{**FRAME, "file_path": "train"}]}
    files = {"transforms_train.json": train, "transforms.json": TRANSFORMS, "cameras.json": [INRIA]}
    for name, data in files.items():
        write(tmp_path / name, data)
        assert read_cameras(tmp_path).note == f"read {name}, not {others}"
        others = f"{name}, {others}"
    alone = read_cameras(tmp_path / "transforms_train.json")
    assert (alone[0].name, alone.note) == ("train", "")


def test_a_colmap_model_is_found_in_its_project(tmp_path):
    """Half of one is none."""
    for number, place in enumerate((".", "sparse/0", "sparse", "colmap/sparse/0")):
        write_colmap(tmp_path / str(number) / place)
        assert read_cameras(tmp_path / str(number))[0].name == "a.png"
    for lone in ("cameras.bin", "images.txt", "images.png"):
        (tmp_path / lone).touch()
        refused(tmp_path, "no cameras in this folder, expected cameras.json", read=read_cameras)
        (tmp_path / lone).unlink()
