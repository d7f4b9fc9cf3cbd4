"""Cameras from JSON files, and which file of a folder is read."""

from __future__ import annotations

import json
import math
import os
import struct
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from refine_addon.core import RefineError, ViewSet, read_cameras, read_ply
from refine_addon.core.cameras.place import CameraPlace
from tests.users import closed_folder

ROOM = Path(__file__).parents[1] / "data" / "room_small"

POINT = np.array([-1.0, 2.5, 2.75])
"""See `test_every_format_gives_the_same_view`."""

INRIA = {
    "id": 7,
    "img_name": "a.png",
    "width": 64,
    "height": 48,
    "position": [1, 2, 3],
    "rotation": [[0, 0, -1], [1, 0, 0], [0, -1, 0]],
    "fx": 100,
    "fy": 120,
}

MATRIX = [[0, 0, 1, 1], [1, 0, 0, 2], [0, 1, 0, 3], [0, 0, 0, 1]]
FRAME = {"file_path": "a.png", "transform_matrix": MATRIX}
LENS = {"fl_x": 100, "fl_y": 120, "cx": 32, "cy": 24, "w": 64, "h": 48}
TRANSFORMS = {**LENS, "frames": [FRAME]}

CAMERAS_TXT = "1 PINHOLE 64 48 100 120 32 24\n"
IMAGES_TXT = "1 0.5 0.5 0.5 -0.5 -2 3 1 1 a.png\n\n"


@pytest.fixture(autouse=True)
def _loud_numpy():
    with np.errstate(all="raise"):
        yield


def pixel(view, point):
    """Project slowly, by the words of `View`."""
    x, y, z = view.rotation @ (point - view.center)
    return [view.fx * x / z + view.cx, view.fy * y / z + view.cy]


def write(path, data):
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(data if isinstance(data, str) else json.dumps(data))
    return path


def write_colmap(folder):
    write(folder / "cameras.txt", CAMERAS_TXT)
    write(folder / "images.txt", IMAGES_TXT)
    return folder


def read(tmp_path, data, name="cameras.json"):
    return read_cameras(write(tmp_path / name, data))


def refused(tmp_path, data, name="cameras.json"):
    """Return the message, which names the file."""
    with pytest.raises(RefineError) as caught:
        read(tmp_path, data, name)
    message = str(caught.value)

    assert message.startswith(str(tmp_path / name))

    return message


def with_frame(shared=LENS, **keys):
    return {**shared, "frames": [FRAME, {**FRAME, **keys}]}


# One camera, derived by hand -------------------------------------------------------------------


@pytest.mark.parametrize("kind", ["cameras.json", "transforms.json", "colmap"])
def test_every_format_gives_the_same_view(tmp_path, kind):
    """The camera stands at (1, 2, 3), looks along -X, and world Z is up in its picture.

    So its x axis (right) is world (0, 1, 0), y (down) is (0, 0, -1), z (forward) is (-1, 0, 0);
    x cross y is z, as it should. The point (-1, 2.5, 2.75) is the centre + 0.5 x + 0.25 y + 2 z,
    and lands at u = 100 * 0.5 / 2 + 32 = 57, v = 120 * 0.25 / 2 + 24 = 39.

    Inria stores x, y, z as columns; OpenGL x, -y, -z. COLMAP stores R with rows x, y, z: its
    trace is 0, so qw = 1/2, qx = (R21 - R12) / 2 = 1/2, qy = (R02 - R20) / 2 = 1/2,
    qz = (R10 - R01) / 2 = -1/2, and t = -R (1, 2, 3) = (-2, 3, 1).
    """
    write(tmp_path / "cameras.json", [INRIA])
    write(tmp_path / "transforms.json", TRANSFORMS)
    write_colmap(tmp_path / "colmap")

    (view,) = read_cameras(tmp_path / kind)

    assert pixel(view, POINT) == pytest.approx([57, 39], abs=1e-12)
    np.testing.assert_allclose(view.rotation, [[0, 1, 0], [0, 0, -1], [-1, 0, 0]], atol=1e-15)
    np.testing.assert_allclose(view.center, [1, 2, 3], atol=1e-15)
    assert (view.fx, view.fy, view.cx, view.cy) == (100, 120, 32, 24)
    assert (view.width, view.height, view.name) == (64, 48, "a.png")
    assert (view.near, view.far, view.weight) == (0, math.inf, 1)


@pytest.mark.parametrize("kind", [Path, str])
def test_a_path_may_be_a_string_or_a_path(tmp_path, kind):
    assert len(read_cameras(kind(write(tmp_path / "c.json", [INRIA])))) == 1


def test_a_tilde_is_the_home_folder(tmp_path, monkeypatch):
    write(tmp_path / "cameras.json", [INRIA])
    monkeypatch.setenv("HOME", str(tmp_path))
    monkeypatch.setenv("USERPROFILE", str(tmp_path))

    assert len(read_cameras("~/cameras.json")) == 1


# The scene of the repository -------------------------------------------------------------------


def test_the_room_has_72_cameras_in_the_order_of_the_file():
    """The names are 000 to 071; all pictures are 240 x 160, so the principal point is (120, 80)."""
    views = read_cameras(ROOM / "cameras.json")

    assert [view.name for view in views] == [f"{index:03d}" for index in range(72)]
    assert {(view.width, view.height, view.cx, view.cy) for view in views} == {(240, 160, 120, 80)}
    assert views.note == ""
    np.testing.assert_array_equal(views[0].center, [1.7000000476837158, 0.0, 1.25])


@pytest.mark.slow
def test_the_room_is_in_the_picture_of_every_camera():
    """A camera that looks away (a flipped axis) would have hardly a splat in its picture."""
    means = read_ply(ROOM / "point_cloud.ply").splats().means.astype(np.float64)
    for view in read_cameras(ROOM):
        x, y, z = view.rotation @ (means - view.center).T
        front = z > 0.01
        u = view.fx * x[front] / z[front] + view.cx
        v = view.fy * y[front] / z[front] + view.cy
        inside = (u >= 0) & (u <= view.width) & (v >= 0) & (v <= view.height)

        assert np.count_nonzero(inside) > 0.1 * len(means), view.name


# Inria cameras.json ----------------------------------------------------------------------------


def test_inria_cameras_keep_their_order_and_may_share_a_name(tmp_path):
    names = ["b", "a", "b"]

    views = read(tmp_path, [{**INRIA, "img_name": name} for name in names])

    assert [view.name for view in views] == names


def test_an_inria_camera_may_name_its_principal_point(tmp_path):
    (view,) = read(tmp_path, [{**INRIA, "cx": 30.5, "cy": 20}])

    assert (view.cx, view.cy) == (30.5, 20)


def test_a_camera_without_a_name_is_called_by_its_index(tmp_path):
    unnamed = {key: value for key, value in INRIA.items() if key != "img_name"}

    assert [view.name for view in read(tmp_path, [INRIA, unnamed])] == ["a.png", "1"]


def test_a_name_that_cannot_be_printed_is_made_printable(tmp_path):
    """Half a surrogate pair is valid JSON, and would raise wherever the name is written."""
    (view,) = read(tmp_path, [{**INRIA, "img_name": "\ud800ä"}])

    assert view.name == "?ä"


def test_a_rounded_rotation_is_made_exact(tmp_path):
    """Rows of 4 decimals are off by up to 5e-5; the view's rotation is orthonormal again."""
    c, s = round(math.cos(0.3), 4), round(math.sin(0.3), 4)

    (view,) = read(tmp_path, [{**INRIA, "rotation": [[c, -s, 0], [s, c, 0], [0, 0, 1]]}])

    np.testing.assert_allclose(view.rotation @ view.rotation.T, np.eye(3), atol=1e-14)
    assert view.rotation[0, 1] == pytest.approx(math.sin(0.3), abs=1e-4)


@pytest.mark.parametrize(
    ("key", "value", "place", "problem"),
    [
        ("fx", "100", "camera 1 'fx'", 'expected a number, got "100"'),
        ("fx", True, "camera 1 'fx'", "expected a number, got true"),
        ("fx", None, "camera 1 'fx'", "expected a number, got null"),
        ("fx", 0, "camera 1 'fx'", "expected a positive focal length in pixels, got 0"),
        ("fy", -120, "camera 1 'fy'", "expected a positive focal length in pixels, got -120"),
        ("fy", math.nan, "camera 1 'fy'", "expected a finite number up to 1e18, got NaN"),
        ("fy", math.inf, "camera 1 'fy'", "expected a finite number up to 1e18, got Infinity"),
        ("fy", 10**400, "camera 1 'fy'", "expected a finite number up to 1e18, got 1000000"),
        ("cx", [], "camera 1 'cx'", "expected a number, got a list of 0"),
        ("width", 64.5, "camera 1 'width'", "expected a whole number of pixels"),
        ("width", 0, "camera 1 'width'", "expected a whole number of pixels"),
        ("height", 2**63, "camera 1 'height'", "expected a finite number up to 1e18"),
        ("height", 10**7, "camera 1 'height'", "expected a whole number of pixels"),
        ("img_name", 3, "camera 1 'img_name'", "expected a string, got 3"),
        ("position", [1, 2], "camera 1 'position'", "expected a list of 3 numbers"),
        ("position", [1, 2, "3"], "camera 1 'position' [2]", 'expected a number, got "3"'),
        ("position", [1, [2], 3], "camera 1 'position' [1]", "expected a number, got a list of 1"),
        ("position", {"x": 1}, "camera 1 'position'", "got an object with 1 keys"),
        ("position", [1, 2, 1e300], "camera 1 'position' [2]", "expected a finite number"),
        ("rotation", [[1, 0, 0], [0, 1, 0]], "camera 1 'rotation'", "expected a 3 x 3 matrix"),
        ("rotation", [1, 0, 0], "camera 1 'rotation' row 0", "expected a list of 3 numbers"),
        ("rotation", [[1, 0, 0], [0, 1, 0], [0, 0, 2]], "camera 1 'rotation'", "orthonormal"),
        ("rotation", [[0, 0, 0]] * 3, "camera 1 'rotation'", "orthonormal"),
        ("rotation", [[1e17] * 3] * 3, "camera 1 'rotation'", "orthonormal"),
        ("rotation", [[1, 0, 0], [0, 1, 0], [0, 0, -1]], "camera 1 'rotation'", "reflection"),
    ],
)
def test_a_wrong_value_is_named_with_camera_and_key(tmp_path, key, value, place, problem):
    message = refused(tmp_path, [INRIA, {**INRIA, key: value}])

    assert f": {place}: " in message
    assert problem in message


@pytest.mark.parametrize("key", ["position", "rotation", "fx", "fy", "width", "height"])
def test_a_missing_key_is_named(tmp_path, key):
    message = refused(tmp_path, [{name: INRIA[name] for name in INRIA if name != key}])

    assert f"camera 0: missing '{key}', expected the keys position, " in message


@pytest.mark.parametrize("item", [[], "x", 3, None, True])
def test_a_camera_that_is_no_object_is_refused(tmp_path, item):
    assert "camera 1: expected an object, got " in refused(tmp_path, [INRIA, item])


def test_poses_of_ns_export_cameras_are_told_apart(tmp_path):
    message = refused(tmp_path, [{"file_path": "a.png", "transform": MATRIX[:3]}])

    assert "camera 0: poses of `ns-export cameras` have no focal length" in message


def test_numbers_too_small_to_multiply_are_nothing(tmp_path):
    """1e-200 squared would underflow; the entries are read as 0 and the result is exact."""
    tiny = [[1, 1e-200, 0], [-1e-200, 1, 0], [0, 5e-324, 1]]

    (view,) = read(tmp_path, [{**INRIA, "rotation": tiny, "position": [0, 0, 1e-310]}])

    np.testing.assert_array_equal(view.rotation, np.eye(3))
    np.testing.assert_array_equal(view.center, [0, 0, 0])


# The text around it ----------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("text", "problem"),
    [
        ("", "the file is empty"),
        (" \n\t ", "the file is empty"),
        ("[", "line 1 column 2: invalid JSON"),
        ('[\n{"id" 1}]', "line 2 column 7: invalid JSON"),
        ("[1] 2", "line 1 column 5: invalid JSON: Extra data"),
        ("[" * 100_000, "nested too deeply"),
        ('{"frames": ' * 100_000, "nested too deeply"),
        (f"[{'9' * 5000}]", "invalid JSON: Exceeds the limit"),
        ("ply\nformat", "not a camera file: expected JSON"),
        ("hello", "not a camera file: expected JSON"),
        ("[]", "the list of cameras is empty, expected at least one"),
        ("{}", "expected a list of cameras (cameras.json) or an object with 'frames'"),
        ('{"cameras": []}', "got an object with 1 keys"),
    ],
)
def test_text_that_holds_no_cameras_is_refused(tmp_path, text, problem):
    assert problem in refused(tmp_path, text)


def test_a_byte_order_mark_is_skipped(tmp_path):
    path = tmp_path / "cameras.json"
    path.write_bytes(b"\xef\xbb\xbf" + json.dumps([INRIA]).encode())

    assert len(read_cameras(path)) == 1


def test_bytes_that_are_no_utf8_are_named(tmp_path):
    path = tmp_path / "cameras.json"
    path.write_bytes(b'[{"img_name": "\xff"}]')

    with pytest.raises(
        RefineError, match=r"cameras\.json: invalid JSON: .* byte 0xff in position 15"
    ):
        read_cameras(path)


@pytest.mark.parametrize("name", ["nothing.json", "no/folder", "nul\0byte", "x" * 5000])
def test_a_path_that_is_not_there_is_named(tmp_path, name):
    with pytest.raises(RefineError) as caught:
        read_cameras(tmp_path / name)

    assert str(tmp_path / name).replace("\0", r"\x00") in str(caught.value)


def test_an_unknown_home_is_no_crash():
    with pytest.raises(RefineError, match="~no-such-user-of-this-machine"):
        read_cameras("~no-such-user-of-this-machine/cameras.json")


def test_a_file_that_may_not_be_read_says_why(tmp_path, monkeypatch):
    path = write(tmp_path / "cameras.json", [INRIA])

    def refuse(*_):
        raise PermissionError(13, "Permission denied")

    monkeypatch.setattr(Path, "open", refuse)

    with pytest.raises(RefineError, match=r"cameras\.json: cannot be read \(Permission denied\)"):
        read_cameras(path)


@pytest.mark.skipif(os.name != "posix", reason="needs permissions")
def test_a_folder_that_may_not_be_entered_says_why():
    """The folder itself, and one that a name leads through."""
    with closed_folder({"cameras.json": json.dumps([INRIA])}) as folder:
        for path in (folder, folder / "cameras.json"):
            with pytest.raises(RefineError) as caught:
                read_cameras(path)

            expected = f"{folder / 'cameras.json'}: cannot be read (Permission denied)"
            assert str(caught.value) == expected


@pytest.mark.parametrize("name", ["transforms.json", "dataparser_transforms.json"])
def test_files_beside_that_may_not_be_looked_for_say_why(tmp_path, monkeypatch, name):
    """Simulated: the folder is closed once the cameras have been read."""
    write(tmp_path / "transforms.json", TRANSFORMS)
    asking = Path.stat

    def refuse(path, **how):
        if path.name == name:
            raise PermissionError(13, "Permission denied")
        return asking(path, **how)

    monkeypatch.setattr(Path, "stat", refuse)

    with pytest.raises(RefineError, match=rf"{name}: cannot be read \(Permission denied\)"):
        read_cameras(tmp_path / "transforms.json")


def test_what_a_view_refuses_is_refused_with_the_place():
    place = CameraPlace(Path("cameras.json"), "camera 3")

    with pytest.raises(RefineError, match=r"^cameras\.json: camera 3: view 'a': .*focal lengths"):
        place.view("a", (np.eye(3), np.zeros(3)), ((-1, 1), (0, 0), (1, 1)))


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="needs named pipes")
def test_a_named_pipe_is_refused_rather_than_waited_for(tmp_path):
    os.mkfifo(tmp_path / "cameras.json")

    with pytest.raises(RefineError, match=r"json: is neither a file nor a folder, expected came"):
        read_cameras(tmp_path / "cameras.json")
    with pytest.raises(RefineError, match="no such file or folder, expected cameras"):
        read_cameras(tmp_path / "other.json")


# transforms.json -------------------------------------------------------------------------------


def test_what_a_frame_says_comes_before_what_all_share(tmp_path):
    own = {"fl_x": 50, "cy": 20, "w": 32, "file_path": "b.png"}

    shared, view = read(tmp_path, with_frame(**own))

    assert (shared.fx, shared.fy, shared.cy, shared.width) == (100, 120, 24, 64)
    assert (view.fx, view.fy, view.cx, view.cy) == (50, 120, 32, 20)
    assert (view.width, view.height, view.name) == (32, 48, "b.png")


@pytest.mark.parametrize(
    ("keys", "expected"),
    [
        ({"fl_x": 100}, (100, 100)),
        ({"fl_y": 120}, (120, 120)),
        ({"camera_angle_x": math.pi / 2}, (32, 32)),
        ({"camera_angle_x": math.pi / 2, "camera_angle_y": math.pi / 2}, (32, 24)),
        ({"x_fov": 90}, (32, 32)),
        ({"fl_x": 100, "camera_angle_x": 1, "camera_angle_y": math.pi / 2}, (100, 24)),
    ],
)
def test_focal_lengths_come_from_lengths_or_angles(tmp_path, keys, expected):
    """A field of view of 90 degrees spans a side s at the focal length s / 2: 32 or 24 pixels."""
    (view,) = read(tmp_path, {"w": 64, "h": 48, **keys, "frames": [FRAME]})

    assert (view.fx, view.fy) == pytest.approx(expected, rel=1e-12)


def test_a_missing_principal_point_is_the_middle(tmp_path):
    (view,) = read(tmp_path, {"w": 65, "h": 48.0, "fl_x": 9, "frames": [FRAME]})

    assert (view.cx, view.cy, view.width, view.height) == (32.5, 24, 65, 48)


def test_what_instant_ngp_does_inside_itself_moves_no_camera(tmp_path):
    inside = {"scale": 0.33, "offset": [0.5, 0.5, 0.5], "aabb_scale": 16, "aabb": [[0] * 3] * 2}

    (view,) = read(tmp_path, {**TRANSFORMS, **inside})

    np.testing.assert_array_equal(view.center, [1, 2, 3])


def test_a_transform_that_was_applied_already_is_not_applied_again(tmp_path):
    """But ns-export writes splats of another frame, so the note says what would be needed."""
    applied = [[1, 0, 0, 5], [0, 0, 1, 0], [0, -1, 0, 0]]

    views = read(tmp_path, {**TRANSFORMS, "applied_transform": applied, "applied_scale": 2})

    np.testing.assert_array_equal(views[0].center, [1, 2, 3])
    assert views.note == "splats of ns-export need dataparser_transforms.json beside it"


def test_dataparser_transforms_beside_it_lead_to_the_splats_of_ns_export(tmp_path):
    """Nerfstudio turned the poses by D: (x, y, z) -> (y, -x, z) + (1, 1, 1), and then halved them.

    Before, ns-process-data had applied A: (x, y, z) -> (x, z, -y) + (5, 0, 0). The file stores
    D after A: (x, y, z) -> (z, -x, -y) + D(5, 0, 0) = (z, -x, -y) + (1, -4, 1), and 0.5.
    The camera at (1, 2, 3) goes to (2, -1, 3) + 1 = (3, 0, 4), halved (1.5, 0, 2); the point at
    (-1, 2.5, 2.75) to (3.5, 2, 3.75) / 2, and it still lands at pixel (57, 39).
    """
    applied = [[1, 0, 0, 5], [0, 0, 1, 0], [0, -1, 0, 0]]
    stored = [[0, 0, 1, 1], [-1, 0, 0, -4], [0, -1, 0, 1]]
    write(tmp_path / "dataparser_transforms.json", {"transform": stored, "scale": 0.5})

    views = read(tmp_path, {**TRANSFORMS, "applied_transform": applied}, "transforms.json")

    np.testing.assert_allclose(views[0].center, [1.5, 0, 2], atol=1e-12)
    assert pixel(views[0], np.array([1.75, 1, 1.875])) == pytest.approx([57, 39], abs=1e-9)
    assert views.note == "dataparser_transforms.json applied"


def test_an_applied_scale_is_undone_as_well(tmp_path):
    """The stored scale is 0.5 (nerfstudio's own) times 4 (applied): (1, 2, 3) goes to half."""
    write(
        tmp_path / "dataparser_transforms.json", {"transform": np.eye(4)[:3].tolist(), "scale": 2}
    )

    (view,) = read(tmp_path, {**TRANSFORMS, "applied_scale": 4})

    np.testing.assert_allclose(view.center, [0.5, 1, 1.5], atol=1e-15)


def test_older_colmap_projects_of_nerfstudio_have_a_transform_of_their_own(tmp_path):
    """Where none is named but colmap/sparse/0 is there, A is (x, y, z) -> (y, x, -z).

    With A itself stored, nerfstudio's own part is nothing and the camera stays.
    """
    (tmp_path / "colmap" / "sparse" / "0").mkdir(parents=True)
    stored = {"transform": [[0, 1, 0, 0], [1, 0, 0, 0], [0, 0, -1, 0]], "scale": 1}
    write(tmp_path / "dataparser_transforms.json", stored)

    (view,) = read(tmp_path, TRANSFORMS)

    np.testing.assert_allclose(view.center, [1, 2, 3], atol=1e-15)
    assert pixel(view, POINT) == pytest.approx([57, 39], abs=1e-12)


@pytest.mark.parametrize(
    ("data", "problem"),
    [
        ({"scale": 1}, "missing 'transform'"),
        ({"transform": MATRIX, "scale": 1}, "'transform': expected a 3 x 4 matrix"),
        ({"transform": MATRIX[:3], "scale": 0}, "'scale': expected a positive scale, got 0"),
        ([], "expected an object, got a list of 0"),
    ],
)
def test_errors_of_dataparser_transforms_name_that_file(tmp_path, data, problem):
    path = write(tmp_path / "dataparser_transforms.json", data)

    with pytest.raises(RefineError) as caught:
        read(tmp_path, TRANSFORMS)

    assert str(path) in str(caught.value)
    assert problem in str(caught.value)


def test_a_uniform_scale_is_taken_out_and_noted(tmp_path):
    """A scaled camera sees the same picture: u = fx (s x) / (s z) + cx. Its centre stays."""
    scaled = [[3 * value for value in row[:3]] + row[3:] for row in MATRIX[:3]] + MATRIX[3:]

    views = read(tmp_path, with_frame(transform_matrix=scaled))

    assert pixel(views[1], POINT) == pytest.approx([57, 39], abs=1e-9)
    assert views.note == "uniform scale taken out of 1 frame"


def test_a_mirrored_pose_is_kept_and_noted(tmp_path):
    """With x negated, the point's x is -0.5 and u = 32 - 25 = 7."""
    mirrored = [[-row[0], *row[1:]] for row in MATRIX[:3]] + MATRIX[3:]

    views = read(tmp_path, with_frame(transform_matrix=mirrored))

    assert pixel(views[1], POINT) == pytest.approx([7, 39], abs=1e-9)
    assert views.note == "mirrored pose (determinant -1) of 1 frame"


def test_a_matrix_of_three_rows_will_do(tmp_path):
    _, view = read(tmp_path, with_frame(transform_matrix=MATRIX[:3]))

    assert pixel(view, POINT) == pytest.approx([57, 39], abs=1e-12)


@pytest.mark.parametrize(
    ("keys", "note"),
    [
        ({"k1": 0, "k2": 0.0, "p1": 0}, ""),
        ({"k1": 0.1}, "distortion of 2 frames ignored (model OPENCV)"),
        ({"k4": 0.1, "camera_model": "PINHOLE"}, "distortion of 2 frames ignored (model PINHOLE)"),
        ({"camera_model": "OPENCV"}, ""),
        (
            {"camera_model": "OPENCV_FISHEYE"},
            "2 frames (fisheye, OPENCV_FISHEYE) taken as pinhole: wrong away from the centre",
        ),
        (
            {"is_fisheye": True, "k1": 0.1},
            "2 frames (fisheye, OPENCV_FISHEYE) taken as pinhole: wrong away from the centre",
        ),
        ({"is_fisheye": True, "k1": 0}, ""),
    ],
)
def test_lenses_that_are_no_pinholes_are_noted(tmp_path, keys, note):
    assert read(tmp_path, {**TRANSFORMS, **keys, "frames": [FRAME, FRAME]}).note == note


def test_the_lens_of_one_frame_is_noted_as_one(tmp_path):
    assert read(tmp_path, with_frame(k1=1)).note == "distortion of 1 frame ignored (model OPENCV)"


@pytest.mark.parametrize(
    "keys",
    [
        {"camera_model": "EQUIRECTANGULAR"},
        {"camera_model": "VR180_L"},
        {"camera_model": "ORTHOPHOTO"},
        {"equirectangular": True},
    ],
)
def test_panoramas_are_refused(tmp_path, keys):
    message = refused(tmp_path, with_frame(**keys))

    assert "frame 1: '" in message
    assert "cameras are not pinholes, expected a perspective camera" in message


@pytest.mark.parametrize(
    ("key", "value", "place", "problem"),
    [
        ("fl_x", "100", "frame 1 'fl_x'", 'expected a number, got "100"'),
        ("fl_x", 0, "frame 1 'fl_x'", "expected a positive focal length"),
        ("fl_y", None, "frame 1 'fl_y'", "expected a number, got null"),
        ("w", math.nan, "frame 1 'w'", "expected a finite number"),
        ("h", -1, "frame 1 'h'", "expected a whole number of pixels"),
        ("cx", True, "frame 1 'cx'", "expected a number, got true"),
        ("camera_model", 4, "frame 1 'camera_model'", "expected a string, got 4"),
        ("camera_model", "LENS", "frame 1 'camera_model'", "unknown model 'LENS', expected one of"),
        ("file_path", None, "frame 1 'file_path'", "expected a string, got null"),
        ("transform_matrix", MATRIX[:2], "frame 1 'transform_matrix'", "expected a 3 x 4 or 4 x 4"),
        ("transform_matrix", [[1] * 3] * 4, "frame 1 'transform_matrix' row 0", "list of 4"),
        ("transform_matrix", [[1] * 4] * 3, "frame 1 'transform_matrix'", "orthonormal"),
        ("transform_matrix", [[0] * 4] * 3, "frame 1 'transform_matrix'", "orthonormal"),
        ("transform_matrix", [[1e18] * 4] * 3, "frame 1 'transform_matrix'", "orthonormal"),
        (
            "transform_matrix",
            [*MATRIX[:3], [0, 0, 0, 2]],
            "frame 1 'transform_matrix' row 3",
            "expected [0, 0, 0, 1]",
        ),
    ],
)
def test_a_wrong_value_is_named_with_frame_and_key(tmp_path, key, value, place, problem):
    message = refused(tmp_path, with_frame(**{key: value}))

    assert f": {place}: " in message
    assert problem in message


@pytest.mark.parametrize("angle", [0, -1, math.pi, 7])
def test_a_field_of_view_that_no_pinhole_has_is_refused(tmp_path, angle):
    message = refused(tmp_path, {"w": 64, "h": 48, "camera_angle_x": angle, "frames": [FRAME]})

    assert "frame 0 'camera_angle_x': expected a field of view below 180°" in message


@pytest.mark.parametrize(
    ("data", "problem"),
    [
        ({"frames": []}, "'frames': the list is empty, expected at least one frame"),
        ({"frames": {}}, "'frames': expected a list, got an object with 0 keys"),
        ({"frames": [3]}, "frame 0: expected an object, got 3"),
        ({"frames": [{}]}, "frame 0: missing 'transform_matrix'"),
        ({"w": 64, "h": 48, "frames": [FRAME]}, "frame 0: missing 'fl_x'"),
        ({"fl_x": 100, "h": 48, "frames": [FRAME]}, "frame 0: missing 'w', expected w and h"),
        ({"fl_x": 100, "w": 64, "frames": [FRAME]}, "frame 0: missing 'h', expected w and h"),
    ],
)
def test_missing_parts_are_named(tmp_path, data, problem):
    assert problem in refused(tmp_path, data)


# The image's own size --------------------------------------------------------------------------

PNG = b"\x89PNG\r\n\x1a\n" + struct.pack(">I4sII", 13, b"IHDR", 300, 200) + b"\x08\x06\0\0\0"
JPEG = (
    b"\xff\xd8\xff\xe0"
    + struct.pack(">H", 16)
    + bytes(14)
    + b"\xff\xff\xc2"  # a fill byte, then a progressive frame
    + struct.pack(">HBHHB", 17, 8, 200, 300, 3)
)


@pytest.mark.parametrize(
    ("file", "named", "data"),
    [
        ("train/r_0.png", "./train/r_0", PNG),
        ("train/r_0.png", "train\\r_0.png", PNG),
        ("r_0.jpg", "r_0.jpg", JPEG),
        ("r.0.jpeg", "r.0", JPEG),
    ],
)
def test_an_image_tells_the_size_that_the_file_does_not(tmp_path, file, named, data):
    """As in the NeRF synthetic scenes: f = 300 / 2 / tan(pi / 4) = 150."""
    path = tmp_path / file
    path.parent.mkdir(exist_ok=True)
    path.write_bytes(data)
    frame = {"file_path": named, "transform_matrix": MATRIX}

    (view,) = read(tmp_path, {"camera_angle_x": math.pi / 2, "frames": [frame]})

    assert (view.width, view.height, view.name) == (300, 200, named)
    assert view.fx == view.fy == pytest.approx(150)


@pytest.mark.parametrize(
    "data",
    [
        *(PNG[:length] for length in range(24)),
        *(JPEG[:length] for length in range(len(JPEG) - 1)),
        PNG[:16] + bytes(8),
        b"\xff\xd8" + b"\xff" * 100_000,
        b"\xff\xd8\xff\xe0\0\0" * 100,
        b"\xff\xd8\xff\xda",
    ],
)
def test_an_image_that_does_not_tell_its_size_is_no_crash(tmp_path, data):
    (tmp_path / "a.png").write_bytes(data)

    assert "frame 0" in refused(tmp_path, {"fl_x": 100, "frames": [FRAME]})


@pytest.mark.parametrize("name", ["", "nul\0", "x" * 5000, "/dev/zero", "."])
def test_an_image_name_that_leads_nowhere_is_no_crash(tmp_path, name):
    frame = {**FRAME, "file_path": name}

    assert "frame 0: missing 'w'" in refused(tmp_path, {"fl_x": 100, "frames": [frame]})


# Folders ---------------------------------------------------------------------------------------


def test_a_folder_prefers_cameras_json_and_names_the_rest(tmp_path):
    write(tmp_path / "cameras.json", [{**INRIA, "img_name": "inria"}])
    write(tmp_path / "transforms.json", TRANSFORMS)
    write_colmap(tmp_path / "sparse" / "0")

    views = read_cameras(tmp_path)

    assert views[0].name == "inria"
    assert views.note == "read cameras.json, not transforms.json, COLMAP model in sparse/0"


def test_a_folder_prefers_transforms_json_to_the_train_split_and_to_colmap(tmp_path):
    named = {**FRAME, "file_path": "train"}
    write(tmp_path / "transforms.json", {**TRANSFORMS, "k1": 1})
    write(tmp_path / "transforms_train.json", {**TRANSFORMS, "frames": [named]})
    write_colmap(tmp_path)

    views = read_cameras(tmp_path)

    assert views[0].name == "a.png"
    assert views.note == (
        "distortion of 1 frame ignored (model OPENCV); "
        "read transforms.json, not transforms_train.json, COLMAP model in ."
    )


def test_a_folder_with_the_train_split_alone_is_read(tmp_path):
    write(tmp_path / "transforms_train.json", TRANSFORMS)

    assert read_cameras(tmp_path).note == ""


@pytest.mark.parametrize("place", [".", "sparse/0", "sparse", "colmap/sparse/0"])
def test_a_colmap_model_is_found_in_its_project(tmp_path, place):
    write_colmap(tmp_path / place)

    assert read_cameras(tmp_path)[0].name == "a.png"


def test_a_file_is_read_whatever_lies_beside_it(tmp_path):
    write(tmp_path / "cameras.json", [{**INRIA, "img_name": "inria"}])
    path = write(tmp_path / "transforms_test.json", TRANSFORMS)

    views = read_cameras(path)

    assert (views[0].name, views.note) == ("a.png", "")


@pytest.mark.parametrize("lone", [None, "cameras.bin", "images.txt", "images.png"])
def test_a_folder_without_cameras_says_what_was_looked_for(tmp_path, lone):
    if lone:
        (tmp_path / lone).write_bytes(b"")

    with pytest.raises(RefineError) as caught:
        read_cameras(tmp_path)

    assert f"{tmp_path}: no cameras in this folder, expected cameras.json" in str(caught.value)


# Anything at all -------------------------------------------------------------------------------

SCALARS = st.one_of(
    st.none(),
    st.booleans(),
    st.integers(),
    st.floats(),
    st.text(max_size=5),
    st.sampled_from([10**400, 2**63, -0.0, 5e-324, 1e308, "\ud800"]),
)
VALUES = st.recursive(SCALARS, lambda inner: st.lists(inner, max_size=4), max_leaves=16)


@pytest.mark.slow
@settings(max_examples=100, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(data=st.data())
def test_any_values_give_views_or_a_located_error(tmp_path, data):
    """Whatever stands at any key, there is no other exception and no NumPy warning."""
    keys = st.sampled_from([*INRIA, *LENS, *FRAME, "applied_transform", "camera_angle_x", "k1"])
    changes = data.draw(st.dictionaries(keys, VALUES, max_size=3))
    rotation = data.draw(st.lists(st.lists(st.floats(-2, 2), min_size=3, max_size=3), max_size=3))
    for content in (
        [{**INRIA, **changes}],
        [{**INRIA, "rotation": rotation}],
        {**TRANSFORMS, **changes},
        with_frame(**changes),
    ):
        try:
            views = read(tmp_path, content)
        except RefineError as error:
            assert str(error).startswith(str(tmp_path / "cameras.json"))
        else:
            assert isinstance(views, ViewSet)
            assert np.isfinite(views.rotations).all()


@given(text=st.text())
@settings(suppress_health_check=[HealthCheck.function_scoped_fixture])
def test_any_text_gives_a_located_error(tmp_path, text):
    path = tmp_path / "cameras.json"
    path.write_bytes(text.encode("utf-8", "surrogatepass"))

    with pytest.raises(RefineError, match=r"cameras\.json"):
        read_cameras(path)
