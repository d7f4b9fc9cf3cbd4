"""What must stay and what must go: marks by hand, objects as volumes, in panel, command and API."""

from __future__ import annotations

import itertools
import json
import tempfile

import bpy
import numpy as np
import pytest

from tests.e2e.inside.clouds import as_cloud

CLOSED = ["--method", "closed-form"]

CORNERS = list(itertools.product((-1.0, 1.0), repeat=3))
FACES = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]


def means(addon, obj):
    """Return where the splats are in the world."""
    return addon.objects.splat_group.gather([addon.mesh.layout.check(obj)]).means


def middle(addon, obj):
    """Return the medians of the splats, and the quartiles above."""
    return np.quantile(means(addon, obj), (0.5, 0.75), axis=0)


def cube(location, size, name="Cube", faces=FACES):
    """Make a mesh object: a cube that is `size` wide each way."""
    mesh = bpy.data.meshes.new(name)
    mesh.from_pydata(CORNERS, [], faces)
    obj = bpy.data.objects.new(name, mesh)
    return place(obj, location, size)


def empty(location, size, kind="CUBE", name="Empty"):
    """Make an empty that is drawn from -1 to 1, scaled."""
    obj = bpy.data.objects.new(name, None)
    obj.empty_display_type = kind
    return place(obj, location, size)


def place(obj, location, size):
    obj.location, obj.scale = location, size
    bpy.context.scene.collection.objects.link(obj)
    bpy.context.view_layer.update()
    return obj


def volume(obj, role):
    """List an object in the panel."""
    item = bpy.context.scene.refine.volumes.add()
    item.object, item.role = obj, role
    return item


def mask(addon, obj, name):
    return addon.mesh.attributes.read_attribute(obj.data, name)


def command(addon, words):
    """Run the command on the open scene, which is saved."""
    if not bpy.data.filepath:
        bpy.ops.wm.save_as_mainfile(filepath=tempfile.mkdtemp() + "/scene.blend")
    return addon.command.main(words, scene=True)


def facts(addon, obj):
    return addon.objects.demands.facts(obj.data)


@pytest.fixture
def crop(addon, room, room_cameras):
    """Turn and move the room, and list volumes about its middle; return what they say of it.

    A turned cube with a Bevel modifier keeps; an ellipsoid in it removes; a box in that protects.
    """
    room.location, room.rotation_euler = (0.3, -0.2, 0.5), (0.1, 0.2, 0.3)
    bpy.context.view_layer.update()
    center, upper = middle(addon, room)
    half = upper - center
    outer = cube(center, 2.0 * half, "Outer")
    outer.rotation_euler = (0.2, 0.1, 0.4)
    outer.modifiers.new("Bevel", "BEVEL").width = 0.2
    inner, core = empty(center, half, "SPHERE", "Inner"), empty(center, 0.3 * half, "CUBE", "Core")
    for obj, role in ((outer, "KEEP"), (inner, "REMOVE"), (core, "PROTECT")):
        volume(obj, role)
    bpy.context.view_layer.update()
    offset = (means(addon, room) - center) / half
    ball, box = (offset**2).sum(axis=1) <= 1.0, (np.abs(offset) < 0.3).all(axis=1)
    solid = addon.objects.demands.zone("keep", outer).volume.inside(means(addon, room))
    turned = (
        (means(addon, room) - center) @ np.array(outer.matrix_world)[:3, :3] / ((2.0 * half) ** 2)
    )
    assert (solid <= (np.abs(turned) <= 1.0).all(axis=1)).all()
    assert solid.sum() < (np.abs(turned) <= 1.0).all(axis=1).sum()  # the bevel takes the edges
    return box, (ball | ~solid) & ~box


def test_the_panel_removes_what_volumes_say_and_keeps_what_they_protect(addon, room, crop):
    """Before scoring they are marked; the share counts them; nothing else is lost."""
    protected, removed = crop
    addon.ui.plans.refresh(bpy.context)
    marks = mask(addon, room, "refine_remove")
    force = mask(addon, room, "refine_force")
    bpy.context.scene.refine.ratio = 0.8
    bpy.ops.refine.score()
    scores = mask(addon, room, "refine_score")
    plan = addon.ui.plans.stored(room, bpy.context.scene.refine)
    goes = mask(addon, room, "refine_remove")
    bpy.ops.refine.apply()

    assert 100 < protected.sum() < removed.sum() < 31_000
    assert np.array_equal(marks, removed)
    assert np.array_equal(force, np.select([protected, removed], [1, 2]))
    assert np.array_equal(scores == 0.0, removed)
    assert plan["removed"] == goes.sum() == 31_804  # floor(.8 * 39755)
    assert goes[removed].all()
    assert not goes[protected].any()
    assert len(room.data.vertices) == 39_755 - 31_804


def test_more_that_must_go_than_the_budget_takes_goes_all_the_same(addon, room, crop):
    """And nothing beside it."""
    _, removed = crop
    bpy.context.scene.refine.ratio = 0.01
    bpy.ops.refine.score()

    assert np.array_equal(mask(addon, room, "refine_remove"), removed)
    assert addon.ui.plans.stored(room, bpy.context.scene.refine)["removed"] == removed.sum()


def opacities(path, core):
    return core.read_ply(path).splats().opacity_logits


@pytest.mark.parametrize("method", ["closed-form", "merge"])
def test_panel_command_and_api_keep_the_same_set(addon, core, quarter, crop, tmp_path, method):
    """By the saved scene, by options that name its objects, and by masks: the same file."""
    protected, removed = crop
    settings = bpy.context.scene.refine
    settings.ratio, settings.method = 0.8, method
    settings.views = 8
    bpy.ops.wm.save_as_mainfile(filepath=str(tmp_path / "scene.blend"))
    views = addon.ui.operators.chosen_views(bpy.context)
    by_api = core.prune(
        addon.objects.splat_group.gather([addon.mesh.layout.check(quarter)], whole=True), views,
        core.Budget(ratio=0.8), core.METHODS[method](8),
        protected=protected, removed=removed,
    )  # fmt: skip
    bpy.ops.refine.score()
    bpy.ops.refine.apply()
    bpy.ops.refine.export_ply(filepath=str(tmp_path / "panel.ply"))
    bpy.ops.wm.open_mainfile(filepath=bpy.data.filepath)
    words = ["prune", "--object", "room", "--ratio", ".8", "--views", "8", "--method", method]
    told = tmp_path / "report.json"
    saved = [*words, "-o", str(tmp_path / "saved.ply"), "--report", str(told)]
    assert command(addon, saved) == 0
    bpy.context.scene.refine.volumes.clear()
    named = ["--keep-inside", "Outer", "--remove-inside", "Inner", "--protect", "Core"]
    assert command(addon, [*words, *named, "-o", str(tmp_path / "named.ply")]) == 0

    files = {name: (tmp_path / f"{name}.ply").read_bytes() for name in ("panel", "saved", "named")}
    assert files["panel"] == files["saved"] == files["named"]
    entry = json.loads(told.read_text())["results"][0]
    assert entry["splats"]["protected"] == protected.sum()
    assert entry["splats"]["removed_by_user"] == removed.sum()
    assert [v["name"] for v in entry["volumes"]] == [
        f"object '{n}'" for n in ("Outer", "Inner", "Core")
    ]
    kept = opacities(tmp_path / "saved.ply", core)
    assert len(kept) == by_api.keep.sum() == 9_939 - 7_951  # floor(.8 * 9939)
    if method == "closed-form":
        room = bpy.data.objects["room"]
        assert np.array_equal(kept, mask(addon, room, "opacity")[by_api.keep])


def test_boxes_in_numbers_lie_in_the_world(addon, room, room_cameras, tmp_path):
    """The room is moved by 5 in x; those below its median there go, half of all."""
    room.location.x = 5.0
    bpy.context.view_layer.update()
    x = float(np.median(means(addon, room)[:, 0]))
    options = ["--remove-inside", f"box:-inf,-inf,-inf,{x!r},inf,inf", "--ratio", "0", *CLOSED]
    out = tmp_path / "out.ply"

    assert command(addon, ["prune", "--object", "room", *options, "-o", str(out)]) == 0

    left = addon.core.read_ply(out).splats().means[:, 0]
    assert len(left) == 39_755 - (means(addon, room)[:, 0] < x).sum()
    assert (left >= x - 5.0 - 1e-5).all()


def test_input_files_go_by_objects_of_the_open_scene(addon, core, room, room_cameras, tmp_path):
    """In the cameras' world, where a file's coordinates are taken as they stand."""
    source = tmp_path / "in.ply"
    bpy.ops.refine.export_ply(filepath=str(source))
    center, upper = middle(addon, room)
    cube(center, upper - center, "Cube")
    out = tmp_path / "out.ply"
    words = ["prune", str(source), "--keep-inside", "Cube", "--ratio", "0", *CLOSED, "-o", str(out)]

    assert command(addon, words) == 0

    inside = (np.abs(means(addon, room) - center) < upper - center).all(axis=1)
    assert len(core.read_ply(out)) == inside.sum()


def test_score_of_an_object_leaves_out_what_must_go(addon, room, crop, tmp_path):
    """It scores 0 in the file, and the rest as in the panel."""
    _, removed = crop
    out = tmp_path / "out.ply"
    bpy.ops.refine.score()

    words = ["score", "--object", "room", "-o", str(out), *CLOSED]
    assert command(addon, words) == 0

    scores = addon.core.read_ply(out).rows["refine_score"]
    assert np.array_equal(scores, mask(addon, room, "refine_score"))
    assert np.array_equal(scores == 0.0, removed)


def test_marks_by_hand_protect_without_being_named_and_stay_in_the_file(
    addon,
    room,
    room_cameras,
    tmp_path,
):
    """The 100 lowest are selected and marked; of 500 that stay they are 100, saved or not."""
    bpy.ops.refine.score()
    lowest = np.argsort(mask(addon, room, "refine_score"), kind="stable")[:100]
    select(room, lowest)
    assert bpy.ops.refine.protect(mark="STAY") == {"FINISHED"}
    settings = bpy.context.scene.refine
    settings.budget, settings.keep = "keep", 500
    goes = mask(addon, room, "refine_remove")
    bpy.ops.wm.save_as_mainfile(filepath=str(tmp_path / "scene.blend"))
    bpy.ops.wm.open_mainfile(filepath=bpy.data.filepath)
    out = tmp_path / "out.ply"
    words = ["prune", "--object", "room", "--keep", "500", "-o", str(out), *CLOSED]
    assert command(addon, words) == 0

    assert not goes[lowest].any()
    assert goes.sum() == 39_755 - 500
    room = bpy.data.objects["room"]
    assert np.array_equal(np.flatnonzero(mask(addon, room, "refine_protect")), np.sort(lowest))
    kept = opacities(out, addon.core)
    assert np.array_equal(kept, mask(addon, room, "opacity")[~goes])
    names = addon.core.read_ply(out).rows.dtype.names
    assert not any(name.startswith("refine") for name in names)


def select(obj, rows):
    """Select some splats of a mesh, as edit mode leaves it."""
    flags = np.zeros(len(obj.data.vertices), np.bool_)
    flags[rows] = True
    obj.data.vertices.foreach_set("select", flags)


def test_marks_are_added_released_and_cleared(addon, room):
    """10 and 10 more that overlap in 5 are 15; 3 of them released are 12."""
    for rows, mark, count in (
        (range(10), "STAY", 10), (range(5, 15), "STAY", 15), (range(3), "NONE", 12),
    ):  # fmt: skip
        select(room, list(rows))
        bpy.ops.refine.protect(mark=mark)
        assert mask(addon, room, "refine_protect").sum() == count
        assert facts(addon, room)["protected"] == count
    bpy.ops.refine.select(action="ALL")
    bpy.ops.refine.protect(mark="NONE")

    assert "refine_protect" not in room.data.attributes
    assert "refine_force" not in room.data.attributes


def test_marks_are_set_in_edit_mode(addon, room):
    """Blender writes them there; the active attribute stays what it was."""
    room.data.attributes.active = room.data.attributes["opacity"]
    select(room, [7, 8, 9])
    bpy.ops.object.mode_set(mode="EDIT")
    assert bpy.ops.refine.protect(mark="STAY") == {"FINISHED"}
    active = room.data.attributes.active.name
    bpy.ops.object.mode_set(mode="OBJECT")
    added = np.flatnonzero(mask(addon, room, "refine_protect")).tolist()
    select(room, [8])
    bpy.ops.object.mode_set(mode="EDIT")
    bpy.ops.refine.protect(mark="NONE")
    bpy.ops.object.mode_set(mode="OBJECT")

    assert (added, active) == ([7, 8, 9], "opacity")
    assert np.flatnonzero(mask(addon, room, "refine_protect")).tolist() == [7, 9]


def test_without_a_selection_nothing_is_marked(addon, room, unchanged):
    """In one sentence, in both modes."""
    select(room, [])
    unchanged.start()
    with pytest.raises(RuntimeError, match="no splat is selected; select some first"):
        bpy.ops.refine.protect(mark="STAY")
    unchanged()
    bpy.ops.object.mode_set(mode="EDIT")
    with pytest.raises(RuntimeError, match="no splat is selected"):
        bpy.ops.refine.protect(mark="STAY")
    bpy.ops.object.mode_set(mode="OBJECT")


def test_native_point_clouds_go_by_volumes_and_marks_as_meshes_do(addon, room, crop):
    """Their selection is an attribute; marks made on the mesh came along."""
    protected, removed = crop
    select(room, [1, 2, 3])
    bpy.ops.refine.protect(mark="STAY")
    cloud = as_cloud(addon, room)
    came = np.flatnonzero(mask(addon, cloud, "refine_protect")).tolist()
    rows = np.arange(39_755)
    addon.mesh.attributes.write_attribute(
        cloud.data, ".selection", "BOOLEAN", (rows > 2) & (rows < 6)
    )
    bpy.ops.refine.protect(mark="STAY")
    marked = np.isin(rows, [1, 2, 3, 4, 5])
    bpy.context.scene.refine.ratio = 0.8
    bpy.ops.refine.score()
    force = mask(addon, cloud, "refine_force")
    bpy.ops.refine.apply()

    assert cloud.type == "POINTCLOUD"
    assert came == [1, 2, 3]
    stays = protected | marked
    assert np.array_equal(force, np.select([stays, removed & ~stays], [1, 2]))
    assert addon.mesh.layout.splat_count(cloud.data) == 39_755 - 31_804
    assert mask(addon, cloud, "refine_protect").sum() == 5


def test_a_volume_that_moved_asks_for_new_scores(addon, room, crop):
    """The panel says so; what had to go then and need not now has no score, and is not guessed."""
    bpy.ops.refine.score()
    before = addon.ui.plans.stale(bpy.context, room)
    bpy.data.objects["Inner"].location.x += 0.5
    bpy.context.view_layer.update()
    addon.ui.plans.refresh(bpy.context)

    assert before == []
    assert addon.ui.plans.stale(bpy.context, room) == ["what must go changed"]
    assert "score it again" in addon.ui.plans.stored(room, bpy.context.scene.refine)["error"]
    with pytest.raises(RuntimeError, match="score it again"):
        bpy.ops.refine.apply()
    bpy.ops.refine.score()
    assert addon.ui.plans.stale(bpy.context, room) == []
    assert bpy.ops.refine.apply() == {"FINISHED"}


def test_the_best_splat_is_not_deleted_unscored_when_its_volume_moves(addon, room, room_cameras):
    """Removed at scoring it has no score; then the volume moves to one that cannot be drawn.

    Now as many scores are 0 as there are splats that cannot be drawn, but not those.
    """
    opacity = mask(addon, room, "opacity")
    opacity[5] = np.nan
    addon.mesh.attributes.write_attribute(room.data, "opacity", "FLOAT", opacity)
    bpy.ops.refine.score()
    best = int(np.argmax(mask(addon, room, "refine_score")))
    places = means(addon, room)
    ball = empty(places[best], (1e-5,) * 3, "SPHERE")
    volume(ball, "REMOVE")
    bpy.ops.refine.score()
    ball.location = places[5]
    bpy.context.view_layer.update()

    with pytest.raises(RuntimeError, match="39755 now, 1 of them without a score; score it again"):
        bpy.ops.refine.apply()

    assert len(room.data.vertices) == 39_755


def test_a_volume_that_protects_alone_changes_no_score(addon, room, room_cameras):
    """What is protected is scored like the rest: nothing is out of date, and the plan follows."""
    bpy.ops.refine.score()
    center, upper = middle(addon, room)
    box = empty(center, upper - center)
    item = volume(box, "PROTECT")
    addon.ui.plans.refresh(bpy.context)
    stays = mask(addon, room, "refine_force") == 1

    assert addon.ui.plans.stale(bpy.context, room) == []
    assert stays.sum() == (np.abs(means(addon, room) - center) < upper - center).all(axis=1).sum()
    assert not mask(addon, room, "refine_remove")[stays].any()
    item.role = "REMOVE"
    assert addon.ui.plans.stale(bpy.context, room) == ["what must go changed"]


@pytest.fixture
def guarded(addon, room, room_cameras):
    """Protect a box of the room by a volume, with a Quality of 35 dB as the budget."""
    settings = bpy.context.scene.refine
    settings.method, settings.views, settings.budget, settings.psnr = "occlusion", 4, "psnr", 35.0
    center, upper = middle(addon, room)
    box = empty(center, 0.8 * (upper - center))
    volume(box, "PROTECT")
    return box


def test_a_quality_keeps_in_the_panel_what_the_command_keeps(addon, core, room, guarded, tmp_path):
    """The curve of the panel is with the box protected; by that of free splats 81 fewer stay."""
    bpy.ops.refine.score()
    wanted = addon.mesh.scores.record(room.data)["protected"][0]
    plan = addon.ui.plans.stored(room, bpy.context.scene.refine)
    goes = mask(addon, room, "refine_remove")
    stays = mask(addon, room, "refine_force") == 1
    out = tmp_path / "out.ply"
    words = ["prune", "--object", "room", "--method", "occlusion", "--views", "4"]
    assert command(addon, [*words, "--psnr", "35", "-o", str(out)]) == 0
    written = core.read_ply(out).splats().means

    assert wanted == stays.sum() > 1000
    assert plan["kept"] == (~goes).sum() == len(written)
    assert np.array_equal(mask(addon, room, "position").reshape(-1, 3)[~goes], written)


def test_what_is_protected_otherwise_asks_for_new_scores(addon, room, guarded):
    """The estimate is of other kept sets then: after a move, not after it is undone."""
    bpy.ops.refine.score()
    found = [addon.ui.plans.stale(bpy.context, room)]
    for x in (0.3, -0.3):
        guarded.location.x += x
        bpy.context.view_layer.update()
        addon.ui.plans.refresh(bpy.context)
        found.append(addon.ui.plans.stale(bpy.context, room))

    assert found == [[], ["what is protected changed"], []]


def test_a_plan_to_merge_keeps_no_fewer_than_are_protected(addon, room, guarded):
    """At 1 dB 95% could go by the curve, and less than that is free."""
    guarded.scale = [2.0 * x for x in guarded.scale]
    settings = bpy.context.scene.refine
    bpy.ops.refine.score()
    settings.method, settings.psnr = "merge", 1.0
    addon.ui.plans.refresh(bpy.context)
    plan = addon.ui.plans.stored(room, settings)
    protected = (mask(addon, room, "refine_force") == 1).sum()

    assert protected > 0.05 * plan["splats"]
    assert plan["kept"] == protected


def test_a_mesh_of_another_shape_is_another_volume(addon, room, room_cameras):
    """A corner of the cube pulled inwards: matrix and dimensions stay the same."""
    box = cube(middle(addon, room)[0], (0.5, 0.5, 0.5))
    volume(box, "REMOVE")
    bpy.ops.refine.score()
    before = addon.ui.plans.stale(bpy.context, room)
    size = box.dimensions[:]
    box.data.vertices[7].co *= 0.2
    bpy.context.view_layer.update()
    addon.ui.plans.mark_again(bpy.context)

    assert before == []
    assert box.dimensions[:] == size
    assert addon.ui.plans.stale(bpy.context, room) == ["what must go changed"]


def test_a_volume_that_moves_marks_all_splats_anew(addon, room, room_cameras):
    """Those of the active object, of one selected too, and of one that was marked before.

    The plan of another place of the volume no longer holds.
    """
    others = []
    for name in ("selected", "marked"):
        others.append(bpy.data.objects.new(name, room.data.copy()))
        bpy.context.scene.collection.objects.link(others[-1])
    box = empty(middle(addon, room)[0], (0.5, 0.5, 0.5))
    volume(box, "REMOVE")
    bpy.ops.refine.score()
    others[0].select_set(True)
    addon.objects.demands.refresh(bpy.context.scene, [addon.mesh.layout.check(others[1])])
    before = mask(addon, others[1], "refine_force")
    bpy.context.view_layer.objects.active = room
    addon.ui.plans.refresh(bpy.context)
    held = addon.ui.plans.stored(room, bpy.context.scene.refine)
    box.location.x += 0.4
    bpy.context.view_layer.update()
    moved = addon.ui.plans.stored(room, bpy.context.scene.refine)
    addon.ui.plans.mark_again(bpy.context)
    now = mask(addon, room, "refine_force")

    assert not np.array_equal(before, now)
    assert all(np.array_equal(mask(addon, obj, "refine_force"), now) for obj in others)
    assert (held is None, moved is None) == (False, True)
    assert addon.ui.plans.stored(room, bpy.context.scene.refine) is not None


def test_what_must_go_is_deleted_at_once_without_scores(addon, room, crop):
    """And nothing else; the volumes then hold nothing, which is no fault."""
    protected, removed = crop
    opacity = mask(addon, room, "opacity")
    assert bpy.ops.refine.delete(what="VOLUMES") == {"FINISHED"}

    assert np.array_equal(mask(addon, room, "opacity"), opacity[~removed])
    assert facts(addon, room)["protected"] == protected.sum()
    assert facts(addon, room)["removed_by_user"] == 0
    with pytest.raises(RuntimeError, match="no volume says of any splat that it must go"):
        bpy.ops.refine.delete(what="VOLUMES")
    bpy.ops.refine.score()
    assert bpy.ops.refine.apply() == {"FINISHED"}


def test_levels_and_floaters_leave_out_what_must_go(addon, core, room, quarter, crop):
    """No level has any of it, and it is evidence of nothing."""
    protected, removed = crop
    settings = bpy.context.scene.refine
    settings.levels, settings.views = "0.2", 8
    expected = core.clean(
        addon.objects.splat_group.gather([addon.mesh.layout.check(room)]),
        addon.ui.operators.chosen_views(bpy.context), core.Cleaning(views=8),
        protected=protected, removed=removed,
    )  # fmt: skip
    bpy.ops.refine.find_floaters()
    found = mask(addon, room, "refine_floats") > 0
    bpy.ops.refine.levels()

    assert not found[removed | protected].any()
    counts = addon.mesh.scores.floater_counts(room.data)
    assert {name: counts[name] for name in expected.settings.reasons} == expected.counts()
    level = bpy.data.objects["room_lod1"]
    assert len(level.data.vertices) == 1988  # .2 of 9939, rounded up
    kept = {tuple(row) for row in means(addon, level)}
    world = means(addon, room)
    assert not kept & {tuple(row) for row in world[removed]}
    assert {tuple(row) for row in world[protected]} <= kept


@pytest.mark.parametrize("shape", ["BOX", "SPHERE"])
@pytest.mark.parametrize("role", ["PROTECT", "REMOVE", "KEEP"])
def test_a_new_volume_lies_about_the_splats_and_can_be_moved(addon, room, shape, role):
    """It is selected alone and the splats stay active; it holds a part of them, or nearly all."""
    bpy.ops.refine.add_volume(shape=shape, role=role)

    item = bpy.context.scene.refine.volumes[0]
    assert bpy.context.selected_objects == [item.object]
    assert bpy.context.object == room
    assert (item.role, item.object.empty_display_type) == (
        role,
        "CUBE" if shape == "BOX" else shape,
    )
    held = facts(addon, room)["volumes"][f"object '{item.object.name}'"]
    assert (1000 < held < 30_000) if role != "KEEP" else (30_000 < held <= 39_755)
    bpy.ops.refine.drop_volume(index=0)
    assert len(bpy.context.scene.refine.volumes) == 0
    assert "refine_force" not in room.data.attributes
    assert "refine_remove" not in room.data.attributes


def test_a_volume_that_was_deleted_counts_no_more(addon, room):
    """The list holds on to the object; it is in no scene, and nobody sees it crop."""
    center, upper = middle(addon, room)
    box = cube(center, upper - center, "Cube")
    box.select_set(True)
    bpy.ops.refine.add_volume(shape="SELECTED", role="REMOVE")
    checked = addon.mesh.layout.check(room)
    before = addon.objects.demands.Demands.of_scene(bpy.context.scene).forced(checked)
    for collection in list(box.users_collection):
        collection.objects.unlink(box)
    after = addon.objects.demands.Demands.of_scene(bpy.context.scene).forced(checked)

    assert before.removed.any()
    assert after.removed is None


def test_selected_objects_become_volumes(addon, room):
    """Two meshes at once, each listed once."""
    center, upper = middle(addon, room)
    objects = [cube(center, upper - center, f"Cube{k}") for k in range(2)]
    for obj in objects:
        obj.select_set(True)
    bpy.ops.refine.add_volume(shape="SELECTED", role="REMOVE")

    assert [item.object for item in bpy.context.scene.refine.volumes] == objects
    with pytest.raises(RuntimeError, match="no volume: select closed meshes or empties"):
        bpy.ops.refine.add_volume(shape="SELECTED", role="REMOVE")


def _no_faces(_addon, center, size):
    return cube(center, size, "Odd", [])


def _open(_addon, center, size):
    return cube(center, size, "Odd", FACES[1:])


def _axes(_addon, center, size):
    return empty(center, size, "PLAIN_AXES", "Odd")


def _camera(_addon, center, _size):
    return place(bpy.data.objects.new("Odd", bpy.data.cameras.new("Odd")), center, (1, 1, 1))


def _flat(_addon, center, size):
    return empty(center, (size[0], 0.0, size[2]), "CUBE", "Odd")


def _far(_addon, center, size):
    return empty(center + 1000.0, size, "CUBE", "Odd")


ODD = {
    "no faces": (_no_faces, "object 'Odd': has no faces, expected a closed mesh"),
    "open": (_open, "object 'Odd': is not closed: 4 of its edges belong to an odd number of faces"),
    "axes": (_axes, "object 'Odd': is an empty shown as plain axes, expected a mesh, or an empty"),
    "camera": (_camera, "object 'Odd': is of type CAMERA, expected a mesh, or an empty"),
    "flat": (_flat, "object 'Odd': is flat"),
    "far": (_far, "object 'Odd' holds the centre of no splat (they lie from"),
}


@pytest.mark.parametrize("case", ODD)
def test_what_is_no_volume_is_refused_by_name(addon, room, room_cameras, capsys, unchanged, case):
    """By the command: code 1, one sentence, and nothing is changed."""
    make, expected = ODD[case]
    center, upper = middle(addon, room)
    make(addon, center, upper - center)
    unchanged.start()
    words = ["prune", "--object", "room", "--remove-inside", "Odd", "--dry-run", *CLOSED]

    assert command(addon, words) == 1
    error = capsys.readouterr().err
    assert expected in error
    assert error.count("\n") == 1
    unchanged()


@pytest.mark.parametrize("case", ["no faces", "open", "flat"])
def test_the_panel_says_what_is_wrong_with_a_volume(addon, room, case):
    """In the panel's note, and when it is applied; what is merely far away is no fault there."""
    make, expected = ODD[case]
    center, upper = middle(addon, room)
    volume(make(addon, center, upper - center), "REMOVE")

    assert expected in facts(addon, room)["error"]
    with pytest.raises(RuntimeError, match="object 'Odd'"):
        bpy.ops.refine.delete(what="VOLUMES")


def test_names_that_there_are_not_are_refused(addon, room, room_cameras, capsys):
    """With the objects that would do; a group is looked for first where splats stay."""
    cube((0, 0, 0), (1, 1, 1), "Cube")
    words = ["prune", "--object", "room", "--dry-run", *CLOSED]

    assert command(addon, [*words, "--protect", "Cbue"]) == 1
    assert command(addon, [*words, "--keep-inside", "Cbue"]) == 1
    first, second = capsys.readouterr().err.splitlines()
    assert "no object 'Cbue' in the open .blend, nor has 'room' a group or an attribute" in first
    assert second.endswith("in the open .blend (objects that are volumes: Cube)")


def test_a_volume_that_leaves_nothing_is_refused(addon, room, room_cameras):
    """A volume far away keeps nothing."""
    volume(empty((1000, 0, 0), (1, 1, 1)), "KEEP")

    assert "all 39755 splats lie where they must go" in facts(addon, room)["error"]
    with pytest.raises(RuntimeError, match="all 39755 splats"):
        bpy.ops.refine.score()


def test_a_group_named_by_the_command_protects(addon, room, room_cameras, capsys):
    """As the panel's; the terminal says how many."""
    group = room.vertex_groups.new(name="mine")
    group.add(list(range(100)), 1.0, "REPLACE")
    words = ["prune", "--object", "room", "--dry-run", "--protect", "mine", *CLOSED]

    assert command(addon, words) == 0
    assert "\n  100 protected\n" in capsys.readouterr().out


@pytest.mark.parametrize(
    "text",
    [
        "",
        "{",
        "[]",
        '{"splats": 39755}',
        '{"splats": 39755, "protected": "x", "removed_by_user": 1}',
    ],
)
def test_a_damaged_note_counts_as_none(addon, room, text):
    """A .blend may come from anywhere."""
    room.data[addon.objects.demands.FACTS] = text

    assert facts(addon, room) == {}
