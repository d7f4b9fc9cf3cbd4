"""The buttons: what they do is what core decides, and where they fail nothing changes."""

from __future__ import annotations

import re
from operator import attrgetter
from pathlib import Path

import bpy
import numpy as np
import pytest

from .conftest import applied, deleted, export, keep_mask

ROOM = Path(__file__).parents[1] / "data" / "room_small"


def _bytes(path):
    return Path(path).read_bytes()


def test_import_score_apply_export_writes_the_file_that_core_writes(addon, room_cameras, tmp_path):
    """The panel's path from file to file, against `prune_file` with the camera file: 50 % off."""
    settings = bpy.context.scene.refine
    settings.method, settings.ratio = "merge", 0.5
    bpy.ops.refine.import_ply(filepath=str(ROOM / "point_cloud.ply"))
    bpy.ops.refine.score()
    bpy.ops.refine.apply()
    bpy.ops.refine.export_ply(filepath=str(tmp_path / "panel.ply"))
    core = addon.core
    views = core.read_cameras(ROOM / "cameras.json")
    core.prune_file(
        ROOM / "point_cloud.ply",
        tmp_path / "core.ply",
        views,
        core.Budget(ratio=0.5),
    )

    assert len(room_cameras.objects) == len(views) == 72
    assert _bytes(tmp_path / "panel.ply") == _bytes(tmp_path / "core.ply")


@pytest.mark.parametrize("method", ["occlusion", "merge"])
def test_upright_keeps_the_splats_that_core_keeps_of_the_file_as_it_lies(
    addon, quarter_file, method
):
    """A quarter turn of splats and cameras: the command without Blender never sees it."""
    bpy.ops.refine.import_ply(filepath=str(quarter_file), upright=True)
    obj = bpy.context.object
    obj.data.attributes.new("row", "INT", "POINT")
    obj.data.attributes["row"].data.foreach_set("value", np.arange(9939))
    bpy.ops.refine.import_cameras(filepath=str(ROOM / "cameras.json"), upright=True)
    settings = bpy.context.scene.refine
    settings.method, settings.views, settings.ratio = method, 24, 0.9
    bpy.ops.refine.score()
    bpy.ops.refine.apply()
    core = addon.core
    splats = core.read_ply(quarter_file).splats()
    expected = core.prune(
        splats,
        core.read_cameras(ROOM / "cameras.json"),
        core.Budget(ratio=0.9),
        core.METHODS[method](24),
    ).keep

    found = addon.mesh.attributes.read_attribute(obj.data, "row")

    np.testing.assert_array_equal(found, np.flatnonzero(expected))


@pytest.mark.parametrize(
    ("kind", "value"),
    [("ratio", 0.29), ("ratio", 0.7), ("keep", 1234), ("max_mb", 2.5), ("ratio", 0.0),
     ("psnr", 38.5)],
)  # fmt: skip
def test_every_budget_keeps_the_rows_that_core_keeps(addon, room, room_cameras, kind, value):
    """Blender stores 0.29 as 0.28999999165534973; floor(.29 * 39755) must still go."""
    settings = bpy.context.scene.refine
    settings.budget = kind
    setattr(settings, kind, value)
    bpy.ops.refine.score()
    got = keep_mask(addon, room, settings.to_budget())
    core = addon.core
    file = core.read_ply(ROOM / "point_cloud.ply")
    expected = core.prune(
        file,
        core.read_cameras(ROOM / "cameras.json"),
        core.Budget(**{kind: value}),
        addon.core.ClosedForm(),
    ).keep

    assert np.array_equal(got, expected)


def test_settings_reach_core_as_they_were_typed(addon):
    """The defaults of the panel are those of core; each change arrives."""
    core = addon.core
    settings = bpy.context.scene.refine
    assert settings.to_method() == core.Merge()
    assert settings.to_budget() == core.Budget(ratio=0.5)

    settings.views = 7
    for name, kind in core.METHODS.items():
        settings.method = name
        assert settings.to_method() == kind(7)


def test_scoring_writes_scores_ranks_and_views(addon, room, room_cameras):
    """Rank 0 belongs to the lowest score, 1 to the highest."""
    bpy.ops.refine.score()
    read = addon.mesh.attributes.read_attribute
    score, rank = read(room.data, "refine_score"), read(room.data, "refine_rank")
    seen = read(room.data, "refine_seen")

    assert rank[np.argmin(score)] == 0.0
    assert score[np.argmax(rank)] == score.max()
    assert np.array_equal(np.argsort(rank), np.argsort(score, kind="stable"))
    assert seen.max() <= 64


def test_apply_keeps_everything_else_of_the_object(addon, room, room_cameras):
    """Attributes, groups, custom properties, materials and modifiers of the kept vertices."""
    mesh = room.data
    row = np.arange(len(mesh.vertices), dtype=np.int32)
    addon.mesh.attributes.write_attribute(mesh, "row", "INT", row)
    group = room.vertex_groups.new(name="tenth")
    group.add([int(i) for i in row[::10]], 0.5, "REPLACE")
    mesh.materials.append(bpy.data.materials.new("mine"))
    mesh["mine"], room["yours"] = 3, "x"
    room.modifiers.new("mine", "SUBSURF")
    bpy.ops.refine.score()
    keep = keep_mask(addon, room, bpy.context.scene.refine.to_budget())
    names = {a.name for a in mesh.attributes} - {"refine_remove"}
    bpy.ops.refine.apply()
    kept = addon.mesh.attributes.read_attribute(room.data, "row")

    assert np.array_equal(kept, row[keep])
    assert names <= {a.name for a in room.data.attributes}
    assert "refine_remove" not in room.data.attributes
    assert [bool(v.groups) for v in room.data.vertices[:50]] == [i % 10 == 0 for i in kept[:50]]
    assert room.data.materials[0].name == "mine"
    assert (room.data["mine"], room["yours"]) == (3, "x")
    assert [m.name for m in room.modifiers] == ["mine"]
    assert not [t for t in bpy.data.node_groups if t.name.startswith("REFINE")]


def test_apply_asks_for_new_scores_before_it_removes_more(room, room_cameras):
    """Pressed twice, it must not halve twice."""
    assert not bpy.ops.refine.apply.poll()
    bpy.ops.refine.score()
    bpy.ops.refine.apply()
    count = len(room.data.vertices)

    assert not bpy.ops.refine.apply.poll()
    with pytest.raises(RuntimeError, match="Score the splats first"):
        bpy.ops.refine.apply()
    assert len(room.data.vertices) == count


def test_apply_is_one_undo_step(room, room_cameras):
    """One undo brings back the 39755 splats with their scores and plan."""
    bpy.ops.refine.score()
    bpy.ops.ed.undo_push(message="scored")
    bpy.ops.refine.apply()
    bpy.ops.ed.undo_push(message="applied")  # what a window does for an operator with UNDO
    after = len(bpy.data.objects[room.name].data.vertices)
    bpy.ops.ed.undo()
    mesh = bpy.data.objects["room"].data

    assert after == 39755 - 39755 // 2
    assert len(mesh.vertices) == 39755
    assert "refine_scores" in mesh
    assert bpy.ops.refine.apply.poll()


@pytest.mark.parametrize("name", ["score", "apply", "import_ply", "import_cameras", "levels"])
def test_operators_that_change_the_scene_can_be_undone(name):
    """Blender pushes an undo step for operators with UNDO."""
    cls = getattr(bpy.types, f"REFINE_OT_{name}")
    assert "UNDO" in cls.bl_options


def test_protected_splats_stay_by_group_or_attribute(addon, room, room_cameras):
    """Keeping 500 of 39755 with 100 protected that would all go: the 100 are among the 500."""
    bpy.ops.refine.score()
    score = addon.mesh.attributes.read_attribute(room.data, "refine_score")
    lowest = np.argsort(score, kind="stable")[:100]
    group = room.vertex_groups.new(name="group")
    group.add([int(i) for i in lowest], 0.1, "REPLACE")
    mask = np.zeros(len(score), np.bool_)
    mask[lowest] = True
    addon.mesh.attributes.write_attribute(room.data, "mask", "BOOLEAN", mask)
    budget = addon.core.Budget(keep=500)
    by_group = keep_mask(addon, room, budget, "group")
    by_mask = keep_mask(addon, room, budget, "mask")

    assert by_group[lowest].all()
    assert by_group.sum() == 500
    assert np.array_equal(by_group, by_mask)
    assert "REFINE read" not in bpy.data.objects
    with pytest.raises(addon.core.RefineError, match="named 'opacity' \\('opacity' is FLOAT"):
        keep_mask(addon, room, budget, "opacity")


def test_the_plan_says_before_apply_what_apply_does(addon, room, room_cameras):
    """Made by scoring and by every change of the budget; never by drawing."""
    settings = bpy.context.scene.refine
    bpy.ops.refine.score()
    first = addon.ui.plans.stored(room, settings)
    settings.ratio = 0.75
    second = addon.ui.plans.stored(room, settings)
    bpy.ops.refine.apply()

    assert (first["kept"], first["removed"]) == (19878, 19877)
    assert second["removed"] == 39755 * 3 // 4
    assert len(room.data.vertices) == second["kept"]
    assert addon.mesh.attributes.file_size(addon.mesh.layout.check(room))[0] == 248
    assert (
        second["bytes_after"]
        == addon.mesh.attributes.file_from_object(addon.mesh.layout.check(room)).size()
    )


def test_a_plan_of_another_budget_is_not_shown(addon, room, room_cameras):
    """While another object was active the budget changed: the stored plan no longer holds."""
    settings = bpy.context.scene.refine
    bpy.ops.refine.score()
    bpy.context.view_layer.objects.active = None
    settings.ratio = 0.9
    stale = addon.ui.plans.stored(room, settings)
    bpy.context.view_layer.objects.active = room
    addon.ui.plans.refresh(bpy.context)

    assert stale is None
    assert addon.ui.plans.stored(room, settings)["removed"] == 39755 * 9 // 10


def test_an_impossible_budget_is_said_in_the_plan_and_refused_by_apply(
    addon,
    room,
    room_cameras,
    unchanged,
):
    """Not one splat fits into so small a file."""
    settings = bpy.context.scene.refine
    bpy.ops.refine.score()
    settings.budget, settings.max_mb = "max_mb", 1e-6
    unchanged.start()

    assert "too small for one splat" in addon.ui.plans.stored(room, settings)["error"]
    with pytest.raises(RuntimeError, match="too small for one splat"):
        bpy.ops.refine.apply()
    unchanged()


def test_a_budget_that_means_nothing_to_the_scores_is_refused(addon, room, room_cameras, unchanged):
    """As the command refuses it: the closed form told nothing of the pictures."""
    settings, reason = bpy.context.scene.refine, "score again with a PSNR as budget"
    bpy.ops.refine.score()
    settings.budget = "psnr"
    addon.ui.plans.refresh(bpy.context)
    unchanged.start()

    assert reason in addon.ui.plans.stored(room, settings)["error"]
    with pytest.raises(RuntimeError, match=reason):
        bpy.ops.refine.apply()
    unchanged()


def test_upright_turns_the_object_and_the_cameras_but_not_the_data(addon, tmp_path):
    """The same rows go as without: a rigid motion of the whole scene changes no score."""
    masks = []
    for upright in (False, True):
        bpy.ops.wm.read_homefile(use_empty=True)
        bpy.ops.refine.import_ply(filepath=str(ROOM / "point_cloud.ply"), upright=upright)
        obj = bpy.context.object
        bpy.ops.refine.import_cameras(filepath=str(ROOM / "cameras.json"), upright=upright)
        bpy.ops.refine.score()
        masks.append(keep_mask(addon, obj, addon.core.Budget(ratio=0.5)))
        bpy.ops.refine.export_ply(filepath=str(tmp_path / f"{upright}.ply"))
    up = np.array(obj.matrix_world)[:3, :3] @ [0, -1, 0]

    assert np.array_equal(*masks)
    assert np.allclose(up, [0, 0, 1], atol=1e-6)
    assert _bytes(tmp_path / "False.ply") == _bytes(tmp_path / "True.ply")


def test_importing_cameras_chooses_them_and_leaves_the_render_size(empty_scene):
    """72 cameras in a collection, which decides from now on; 240 x 160 only when asked for."""
    empty_scene.render.resolution_x = 1000
    bpy.ops.refine.import_cameras(filepath=str(ROOM / "cameras.json"))
    before = empty_scene.render.resolution_x
    bpy.ops.refine.import_cameras(filepath=str(ROOM / "cameras.json"), set_resolution=True)

    assert empty_scene.refine.source == "COLLECTION"
    assert len(empty_scene.refine.collection.objects) == 72
    assert empty_scene.camera is not None
    assert before == 1000
    assert (empty_scene.render.resolution_x, empty_scene.render.resolution_y) == (240, 160)


def test_several_files_are_imported_at_once_and_a_bad_one_is_reported(tmp_path):
    """Two good files and an empty one: two objects."""
    for name in ("a.ply", "b.ply"):
        (tmp_path / name).write_bytes(_bytes(ROOM / "point_cloud.ply"))
    (tmp_path / "bad.ply").touch()
    files = [{"name": name} for name in ("a.ply", "bad.ply", "b.ply")]
    result = bpy.ops.refine.import_ply(directory=str(tmp_path), files=files)

    assert result == {"FINISHED"}
    assert sorted(obj.name for obj in bpy.context.selected_objects) == ["a", "b"]


@pytest.mark.parametrize(
    ("content", "reason"),
    [
        (None, "cannot be read"),
        (b"", "empty"),
        (b"plx", "not a PLY"),
        (b"ply\nformat binary_little_endian 1.0\nelement vertex 1\nproperty float x\n"
         b"property float y\nproperty float z\nend_header\n" + bytes(12), "not splats"),
    ],
)  # fmt: skip
def test_a_file_that_cannot_be_imported_is_explained(tmp_path, unchanged, content, reason):
    """The message names the file and what is wrong; nothing is added."""
    path = tmp_path / "in.ply"
    if content is not None:
        path.write_bytes(content)
    unchanged.start()

    with pytest.raises(RuntimeError, match=reason):
        bpy.ops.refine.import_ply(filepath=str(path))
    unchanged()


def test_a_truncated_file_is_refused(tmp_path, unchanged):
    """Half of the room's bytes."""
    whole = _bytes(ROOM / "point_cloud.ply")
    (tmp_path / "half.ply").write_bytes(whole[: len(whole) // 2])
    unchanged.start()

    with pytest.raises(RuntimeError, match="truncated"):
        bpy.ops.refine.import_ply(filepath=str(tmp_path / "half.ply"))
    unchanged()


def test_cameras_that_cannot_be_read_are_explained(tmp_path, unchanged):
    """No file at all."""
    unchanged.start()

    with pytest.raises(RuntimeError, match=r"none\.json"):
        bpy.ops.refine.import_cameras(filepath=str(tmp_path / "none.json"))
    unchanged()


def test_an_existing_file_is_not_overwritten_unasked(room, tmp_path):
    """From a script; the file browser asks by itself."""
    target = tmp_path / "out.ply"
    target.write_bytes(b"mine")
    with pytest.raises(RuntimeError, match="exists already"):
        bpy.ops.refine.export_ply(filepath=str(target))
    assert target.read_bytes() == b"mine"

    bpy.ops.refine.export_ply(filepath=str(target), overwrite=True)
    assert target.read_bytes() == _bytes(ROOM / "point_cloud.ply")
    with pytest.raises(RuntimeError, match="no folder"):
        bpy.ops.refine.export_ply(filepath=str(tmp_path / "no" / "out.ply"))


def _no_cameras(_room):
    bpy.context.scene.refine.source = "VISIBLE"


def _no_active_camera(_room):
    bpy.context.scene.refine.source = "ACTIVE"


def _none_selected(_room):
    bpy.context.scene.refine.source = "SELECTED"


def _no_collection(_room):
    bpy.context.scene.refine.source = "COLLECTION"


def _looking_away(_room):
    camera = bpy.data.objects.new("away", bpy.data.cameras.new("away"))
    camera.location.z = -1000.0
    bpy.context.scene.collection.objects.link(camera)
    bpy.context.scene.camera = camera
    bpy.context.scene.refine.source = "ACTIVE"


def _orthographic(room):
    _looking_away(room)
    bpy.context.scene.camera.data.type = "ORTHO"


def _flat(room):
    _looking_away(room)
    room.scale = (1.0, 1.0, 0.0)


@pytest.mark.parametrize(
    ("prepare", "reason"),
    [
        (_no_cameras, "none is visible"),
        (_no_active_camera, "no active camera"),
        (_none_selected, "none is selected"),
        (_no_collection, "choose the collection"),
        (_looking_away, "no camera sees the splats"),
        (_orthographic, "'away' is orthographic"),
        (_flat, "flat"),
    ],
)
def test_scoring_that_cannot_be_done_is_explained(room, unchanged, prepare, reason):
    """No camera, none of use, or none that sees the object: a sentence, and no attribute."""
    prepare(room)
    bpy.context.view_layer.update()
    unchanged.start()

    with pytest.raises(RuntimeError, match=reason):
        bpy.ops.refine.score()
    unchanged()


def _shared(room):
    other = bpy.data.objects.new("other", room.data)
    bpy.context.scene.collection.objects.link(other)


def _keyed(room):
    room.shape_key_add(name="Basis")


def _painting(room):
    bpy.ops.object.mode_set(mode="WEIGHT_PAINT")


@pytest.mark.parametrize(
    ("prepare", "reason"),
    [(_shared, "shares its data"), (_keyed, "shape keys"), (_painting, "weight paint mode")],
)
def test_an_object_that_cannot_lose_vertices_is_refused(
    room,
    room_cameras,
    unchanged,
    prepare,
    reason,
):
    """Shared meshes, shape keys, other modes: the sentence says what to do about it."""
    bpy.ops.refine.score()
    prepare(room)
    unchanged.start()

    with pytest.raises(RuntimeError, match=reason):
        bpy.ops.refine.apply()
    unchanged()


def test_edit_mode_greys_the_buttons(room, room_cameras):
    """In edit mode attributes are not to be had."""
    bpy.ops.refine.score()
    bpy.ops.object.mode_set(mode="EDIT")
    polls = [
        getattr(bpy.ops.refine, name).poll()
        for name in ("score", "apply", "export_ply", "import_ply")
    ]
    bpy.ops.object.mode_set(mode="OBJECT")

    assert polls == [False] * 4


@pytest.mark.parametrize("how", ["hide_set", "hide_viewport", "exclude"])
def test_hidden_objects_are_scored_and_pruned_like_others(addon, room, room_cameras, score, how):
    """By the eye, by the monitor icon, by excluding the collection; the command reaches all."""
    views = addon.cameras.CameraChoice("COLLECTION", room_cameras).views(bpy.context)
    expected = addon.core.prune(
        addon.objects.splat_group.gather([addon.mesh.layout.check(room)]),
        views,
        addon.core.Budget(ratio=0.5),
        addon.core.ClosedForm(),
    ).keep
    if how == "hide_set":
        room.hide_set(True)
    elif how == "hide_viewport":
        room.hide_viewport = True
    else:
        collection = bpy.data.collections.new("excluded")
        bpy.context.scene.collection.children.link(collection)
        collection.objects.link(room)
        bpy.context.scene.collection.objects.unlink(room)
        bpy.context.view_layer.layer_collection.children["excluded"].exclude = True
    score(room, views)
    keep = keep_mask(addon, room, addon.core.Budget(ratio=0.5))
    result = deleted(addon, addon.mesh.layout.check(room), addon.core.Budget(ratio=0.5))
    applied(addon, addon.mesh.layout.check(room), result)

    assert np.array_equal(keep, expected)
    assert len(room.data.vertices) == expected.sum()


def test_linked_objects_are_refused(addon, room, room_cameras, score, tmp_path):
    """What lies in a library cannot be changed from here; exporting it is no change."""
    bpy.ops.wm.save_as_mainfile(filepath=str(tmp_path / "library.blend"))
    bpy.ops.wm.read_homefile(use_empty=True)
    with bpy.data.libraries.load(str(tmp_path / "library.blend"), link=True) as (_, here):
        here.objects = ["room"]
    room = bpy.data.objects["room"]
    bpy.context.scene.collection.objects.link(room)
    views = addon.core.read_cameras(ROOM / "cameras.json")

    with pytest.raises(addon.core.RefineError, match="is linked from"):
        score(room, views)
    export(addon, addon.mesh.layout.check(room), tmp_path / "out.ply")
    assert _bytes(tmp_path / "out.ply") == _bytes(ROOM / "point_cloud.ply")


@pytest.mark.usefixtures("room")
def test_a_home_folder_of_nobody_is_refused_in_a_sentence(addon):
    """By the export as by the command; Python's own error would end in a traceback."""
    with pytest.raises(RuntimeError, match=r"^Error: ~nouser/x\.ply: cannot be found"):
        bpy.ops.refine.export_ply(filepath="~nouser/x.ply")
    core = addon.core
    views = core.read_cameras(ROOM / "cameras.json")
    with pytest.raises(core.RefineError, match=r"^~nouser/x\.ply: cannot be found"):
        addon.objects.splat_group.prune_object(
            "room", views, core.Budget(ratio=0.5), output=Path("~nouser/x.ply")
        )


@pytest.mark.parametrize(
    ("module", "function", "operator", "arguments"),
    [
        ("ui.operators", "score", "score", {}),
        ("ui.operators", "prune", "apply", {}),
        ("ui.import_operators", "read_splats", "import_ply", {"filepath": "in.ply"}),
        ("ui.import_operators", "read_cameras", "import_cameras", {"filepath": "cameras.json"}),
        ("ui.export_operators", "write_splats", "export_ply", {"filepath": "out.ply"}),
    ],
)
@pytest.mark.usefixtures("room_cameras")
@pytest.mark.parametrize("said", ["", "Unable to allocate 9 GiB"])
def test_too_little_memory_is_a_sentence(
    addon, room, room_views, score, monkeypatch, module, function, operator,
    arguments, said
):  # fmt: skip
    """NumPy says how much it was; Python itself says nothing at all."""

    def refuse(*_, **__):
        raise MemoryError(said)

    score(room, room_views)
    monkeypatch.setattr(attrgetter(module)(addon), function, refuse)

    expected = "not enough memory" + (f" ({said})" if said else "")
    with pytest.raises(RuntimeError, match=f"^Error: {re.escape(expected)}\n$"):
        getattr(bpy.ops.refine, operator)(**arguments)
