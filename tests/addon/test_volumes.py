"""What must stay and what must go: marks by hand, objects as volumes, in panel, command and API."""

import itertools
import json
import tempfile
from types import SimpleNamespace
from unittest.mock import MagicMock

import bpy
import numpy as np
import pytest

from tests.e2e.inside.clouds import as_cloud

from .conftest import choose, linked, read, splats_of

COUNT = 9_939
CLOSED = ["--method", "closed-form"]
PRUNE = ["prune", "--object", "room"]

CORNERS = list(itertools.product((-1.0, 1.0), repeat=3))
FACES = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]


def means(addon, obj):
    return splats_of(addon, obj).means


def middle(addon, obj):  # and from there to the quartiles above
    center, upper = np.quantile(means(addon, obj), (0.5, 0.75), axis=0)
    return center, upper - center


def cube(location, size, name="Cube", faces=FACES):
    mesh = bpy.data.meshes.new(name)
    mesh.from_pydata(CORNERS, [], faces)
    return place(name, location, size, mesh)


def empty(location, size, kind="CUBE", name="Empty"):
    obj = place(name, location, size)
    obj.empty_display_type = kind
    return obj


def place(name, location, size, data=None):
    obj = linked(name, data)
    obj.location, obj.scale = location, size
    bpy.context.view_layer.update()
    return obj


def volume(obj, role):
    item = bpy.context.scene.refine.volumes.add()
    item.object, item.role = obj, role
    return item


def facts(addon, obj):
    return addon.objects.demands.record(obj.data)


def stale(addon, obj):
    """Return what the panel says of the scores once the scene is evaluated."""
    bpy.context.view_layer.update()
    addon.ui.plans.refresh(bpy.context)
    return addon.ui.plans.stale(obj)


def command(addon, words):
    """Run the command on the open scene, which is saved."""
    if not bpy.data.filepath:
        bpy.ops.wm.save_as_mainfile(filepath=tempfile.mkdtemp() + "/scene.blend")
    return addon.command.main(words, scene=True)


def test_edges_of_volumes_are_violet_only_where_the_inside_goes(addon, monkeypatch):
    """What *Keep Inside* holds stays, as what *Protect Inside* holds."""
    overlays, drawn = addon.viewport.overlays, []
    monkeypatch.setattr(overlays, "gpu", MagicMock())  # there is no graphics card
    shape = lambda _kind, _ends, colors: lambda: drawn.append(tuple(colors[0, :3]))  # noqa: E731
    monkeypatch.setattr(overlays, "shape", shape)
    for role in ("PROTECT", "REMOVE", "KEEP"):
        volume(empty((0.0, 0.0, 0.0), (1.0, 1.0, 1.0)), role)
    areas = (area for screen in bpy.data.screens for area in screen.areas)
    space = next(area.spaces.active for area in areas if area.type == "VIEW_3D")
    context = SimpleNamespace(space_data=space, scene=bpy.context.scene)

    overlays.draw(context, mixed=False, has_depths=True)

    green, violet = addon.viewport.arrays.MARKS.values()
    assert drawn == [green, violet, green]


@pytest.fixture
def crop(addon, quarter, room_cameras):
    """Turn the room; a bevelled cube keeps, an ellipsoid in it removes, a box in that protects."""
    quarter.location, quarter.rotation_euler = (0.3, -0.2, 0.5), (0.1, 0.2, 0.3)
    bpy.context.view_layer.update()
    center, half = middle(addon, quarter)
    outer = cube(center, 2.0 * half, "Outer")
    outer.rotation_euler = (0.2, 0.1, 0.4)
    outer.modifiers.new("Bevel", "BEVEL").width = 0.2
    inner, core = empty(center, half, "SPHERE", "Inner"), empty(center, 0.3 * half, "CUBE", "Core")
    for obj, role in ((outer, "KEEP"), (inner, "REMOVE"), (core, "PROTECT")):
        volume(obj, role)
    bpy.context.view_layer.update()
    points = means(addon, quarter)
    offset = (points - center) / half
    ball, box = (offset**2).sum(axis=1) <= 1.0, (np.abs(offset) < 0.3).all(axis=1)
    solid = addon.objects.demands.zone("keep", outer).volume.inside(points)
    turned = (points - center) @ np.array(outer.matrix_world)[:3, :3] / ((2.0 * half) ** 2)
    cut_off = (np.abs(turned) <= 1.0).all(axis=1) ^ solid  # by the bevel
    assert 0 < cut_off.sum() == (cut_off & ~solid).sum()
    return box, (ball | ~solid) & ~box


@pytest.mark.parametrize("kind", ["MESH", "POINTCLOUD"])
def test_the_panel_does_what_volumes_say(addon, quarter, crop, kind):
    """All that must go goes, also where the budget takes fewer; no level has any of it."""
    (protected, removed), obj = crop, quarter if kind == "MESH" else as_cloud(addon, quarter)
    settings = bpy.context.scene.refine
    addon.ui.plans.refresh(bpy.context)
    assert np.array_equal(read(addon, obj, "refine_remove"), removed)
    force = np.select([protected, removed], [1, 2])
    assert np.array_equal(read(addon, obj, "refine_force"), force)

    bpy.ops.refine.score()
    assert np.array_equal(read(addon, obj, "refine_score") == 0.0, removed)
    settings.ratio = 0.01
    assert np.array_equal(read(addon, obj, "refine_remove"), removed)
    settings.ratio = 0.8
    goes = read(addon, obj, "refine_remove")
    assert 25 < protected.sum() < removed.sum() < goes.sum() == 7951  # floor(.8 * 9939)
    assert addon.ui.plans.stored(obj, settings)["removed"] == 7951
    assert goes[removed].all()
    assert not goes[protected].any()

    settings.levels, settings.views = "0.2", 4
    bpy.ops.refine.levels()
    kept = {tuple(row) for row in means(addon, bpy.data.objects["room_lod1"])}
    gone, stay = ({tuple(row) for row in means(addon, obj)[rows]} for rows in (removed, protected))
    assert len(kept) == 1988  # .2 of 9939, rounded up
    assert not kept & gone
    assert kept >= stay
    bpy.ops.refine.find_floaters()
    assert not (read(addon, obj, "refine_floats") > 0)[removed | protected].any()
    bpy.ops.refine.apply()
    assert addon.mesh.layout.splat_count(obj.data) == COUNT - 7951


@pytest.mark.parametrize("method", ["closed-form", pytest.param("merge", marks=pytest.mark.slow)])
def test_panel_command_and_api_keep_the_same_set(addon, core, quarter, crop, tmp_path, method):
    """By the saved scene, by options that name its objects, and by masks: the same file.

    Splats 0 to 99 are marked by hand to stay, which volumes do not overrule, 100 to 199 to go.
    """
    (protected, removed), rows = crop, np.arange(COUNT)
    stay, go = rows < 100, rows // 100 == 1
    assert (stay & removed).any()
    assert (go & ~removed).any()
    protected = protected | stay
    removed = (removed | go) & ~protected
    for marked, mark in ((stay, "STAY"), (go, "GO")):
        choose(addon, quarter, rows[marked])
        bpy.ops.refine.protect(mark=mark)
    settings = bpy.context.scene.refine
    settings.ratio, settings.method, settings.views = 0.8, method, 4
    bpy.ops.wm.save_as_mainfile(filepath=str(tmp_path / "scene.blend"))
    splats, views = splats_of(addon, quarter), addon.ui.operators.chosen_views(bpy.context)
    masks = {"protected": protected, "removed": removed}
    by_api = core.prune(splats, views, core.Budget(ratio=0.8), core.METHODS[method](4), **masks)
    bpy.ops.refine.score()
    bpy.ops.refine.apply()
    bpy.ops.refine.export_ply(filepath=str(tmp_path / "panel.ply"))
    bpy.ops.wm.open_mainfile(filepath=bpy.data.filepath)
    words = [*PRUNE, "--ratio", ".8", "--views", "4", "--method", method]
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
    rows = core.read_ply(tmp_path / "saved.ply").rows
    assert len(rows) == COUNT - 7951
    assert not any(name.startswith("refine") for name in rows.dtype.names)
    positions = read(addon, bpy.data.objects["room"], "position")[by_api.keep]
    if method == "closed-form":
        assert np.array_equal(np.stack([rows[axis] for axis in "xyz"], axis=1), positions)


@pytest.mark.parametrize("kind", ["MESH", "POINTCLOUD"])
def test_marks_are_added_released_and_cleared(addon, quarter, unchanged, kind):
    """10 and 10 more that overlap in 5 are 15; 3 of them released are 12."""
    obj = as_cloud(addon, quarter) if kind == "POINTCLOUD" else quarter
    choose(addon, obj, ())
    unchanged.start()
    with pytest.raises(RuntimeError, match="no splat is selected; select some first"):
        bpy.ops.refine.protect(mark="STAY")
    unchanged()
    for rows, mark, marked in (
        (range(10), "STAY", range(10)), (range(5, 15), "STAY", range(15)),
        (range(3), "NONE", range(3, 15)),
    ):  # fmt: skip
        choose(addon, obj, rows)
        assert bpy.ops.refine.protect(mark=mark) == {"FINISHED"}
        assert np.flatnonzero(read(addon, obj, "refine_protect")).tolist() == list(marked)
        assert facts(addon, obj)["protected"] == len(marked)
    choose(addon, obj, range(COUNT))
    bpy.ops.refine.protect(mark="NONE")
    assert "refine_protect" not in obj.data.attributes
    assert "refine_force" not in obj.data.attributes


def test_a_volume_that_changed_asks_for_new_scores(addon, quarter, crop):
    """Moved, or a corner of its mesh pulled; what had to go has no score, and none is guessed."""
    settings, objects = bpy.context.scene.refine, bpy.data.objects
    bpy.ops.refine.score()
    bpy.ops.object.mode_set(mode="EDIT")  # there marks cannot be read
    assert stale(addon, quarter) == []
    bpy.ops.object.mode_set(mode="OBJECT")
    assert stale(addon, quarter) == []
    corner = objects["Outer"].data.vertices[7]
    corner.co *= 0.2
    assert stale(addon, quarter) == ["what must go changed"]
    corner.co *= 5.0
    assert stale(addon, quarter) == []
    objects["Inner"].location.x += 0.5
    assert stale(addon, quarter) == ["what must go changed"]
    assert "score it again" in addon.ui.plans.stored(quarter, settings)["error"]
    with pytest.raises(RuntimeError, match="score it again"):
        bpy.ops.refine.apply()
    bpy.ops.refine.score()
    assert stale(addon, quarter) == []


def test_a_quality_counts_what_is_protected(addon, quarter, room_cameras):
    """A plan to merge keeps all of it, though 1 dB needs less."""
    settings = bpy.context.scene.refine
    settings.method, settings.views, settings.budget, settings.psnr = "occlusion", 4, "psnr", 35.0
    center, half = middle(addon, quarter)
    box = empty(center, 1.2 * half)
    volume(box, "PROTECT")
    bpy.ops.refine.score()
    stays = (read(addon, quarter, "refine_force") == 1).sum()
    goes = read(addon, quarter, "refine_remove")
    assert addon.mesh.scores.record(quarter.data)["protected"][0] == stays > 0.05 * COUNT
    assert addon.ui.plans.stored(quarter, settings)["kept"] == (~goes).sum()

    for x, said in ((0.0, []), (0.3, ["what is protected changed"]), (-0.3, [])):
        box.location.x += x
        assert stale(addon, quarter) == said
    settings.method, settings.psnr = "merge", 1.0
    addon.ui.plans.refresh(bpy.context)
    assert addon.ui.plans.stored(quarter, settings)["kept"] == stays


def test_a_volume_that_moves_marks_all_splats_anew(addon, quarter, room_cameras):
    """Of the active object, of one selected too, and of one marked before; no old plan holds."""
    settings, plans = bpy.context.scene.refine, addon.ui.plans
    others = [place(name, (0, 0, 0), (1, 1, 1), quarter.data.copy()) for name in "ab"]
    box = empty(middle(addon, quarter)[0], (0.5, 0.5, 0.5))
    volume(box, "REMOVE")
    bpy.ops.refine.score()
    others[0].select_set(True)
    addon.objects.demands.refresh(bpy.context.scene, [addon.mesh.layout.check(others[1])])
    before = read(addon, others[1], "refine_force")
    bpy.context.view_layer.objects.active = quarter
    plans.refresh(bpy.context)
    assert plans.stored(quarter, settings) is not None
    box.location.x += 0.4
    bpy.context.view_layer.update()
    assert plans.stored(quarter, settings) is None
    plans.mark_again(None, bpy.context)

    now = [read(addon, obj, "refine_force") for obj in (quarter, *others)]
    assert not np.array_equal(now[0], before)
    assert np.array_equal(now[0], now[1])
    assert np.array_equal(now[0], now[2])
    assert plans.stored(quarter, settings) is not None


def test_volumes_are_added_dropped_and_deleted(addon, quarter):
    """What must go is deleted without scores; a volume in no scene counts no more."""
    volumes = bpy.context.scene.refine.volumes
    for shape, kind, role, least, most in (
        ("BOX", "CUBE", "PROTECT", 250, 7500), ("SPHERE", "SPHERE", "REMOVE", 250, 7500),
        ("BOX", "CUBE", "KEEP", 7500, COUNT),
    ):  # fmt: skip
        bpy.ops.refine.add_volume(shape=shape, role=role)
        obj = volumes[0].object
        assert (bpy.context.selected_objects, bpy.context.object) == ([obj], quarter)
        assert (volumes[0].role, obj.empty_display_type) == (role, kind)
        assert least < facts(addon, quarter)["volumes"][f"object '{obj.name}'"] <= most
        bpy.ops.refine.drop_volume(index=0)
        assert len(volumes) == 0
        assert not {"refine_force", "refine_remove"} & set(quarter.data.attributes.keys())

    obj.select_set(False)
    center, half = middle(addon, quarter)
    objects = [cube(center + k, half, f"Cube{k}") for k in range(2)]
    for obj in objects:
        obj.select_set(True)
    bpy.ops.refine.add_volume(shape="SELECTED", role="REMOVE")
    assert [item.object for item in volumes] == objects
    with pytest.raises(RuntimeError, match="no volume: select closed meshes or empties"):
        bpy.ops.refine.add_volume(shape="SELECTED", role="REMOVE")
    bpy.context.scene.collection.objects.unlink(objects[0])
    inside = (np.abs(means(addon, quarter) - center - 1.0) < half).all(axis=1)
    opacity = read(addon, quarter, "opacity")
    assert bpy.ops.refine.delete(what="VOLUMES") == {"FINISHED"}
    assert 0 < inside.sum() < COUNT
    assert np.array_equal(read(addon, quarter, "opacity"), opacity[~inside])
    assert facts(addon, quarter)["removed_by_user"] == 0
    with pytest.raises(RuntimeError, match="no splat must go"):
        bpy.ops.refine.delete(what="VOLUMES")


NO_VOLUMES = {
    "no faces": "has no faces, expected a closed mesh",
    "open": "is not closed: 4 of its edges belong to an odd number of faces",
    "flat": "is flat",
    "axes": "is an empty shown as plain axes, expected a mesh, or an empty",
    "camera": "is of type CAMERA, expected a mesh, or an empty",
    "far": "holds the centre of no splat (they lie from",
}


def test_beside_a_linked_collection_a_volume_is_put_into_the_scene(quarter, tmp_path):
    """The active collection takes no object of this file."""
    scene, layer, path = bpy.context.scene, bpy.context.view_layer, str(tmp_path / "set.blend")
    bpy.data.libraries.write(path, {bpy.data.collections.new("set")}, fake_user=True)
    with bpy.data.libraries.load(path, link=True) as (_, wanted):
        wanted.collections = ["set"]
    scene.collection.children.link(wanted.collections[0])
    layer.active_layer_collection = layer.layer_collection.children[0]
    bpy.ops.refine.add_volume(shape="BOX", role="KEEP")
    assert set(scene.collection.objects) == {quarter, scene.refine.volumes[0].object}


def test_what_is_no_volume_is_refused_by_name(addon, quarter, room_cameras, capsys, unchanged):
    """By the command in one sentence, by the panel in a note; far away is no fault there."""
    center, half = middle(addon, quarter)
    cube(center, half, "no faces", [])
    cube(center, half, "open", FACES[1:])
    empty(center, half * [1, 0, 1], "CUBE", "flat")
    empty(center, half, "PLAIN_AXES", "axes")
    place("camera", center, (1, 1, 1), bpy.data.cameras.new("camera"))
    empty(center + 1000.0, half, "CUBE", "far")
    unchanged.start()
    for name, expected in NO_VOLUMES.items():
        assert command(addon, [*PRUNE, "--remove-inside", name, "--dry-run", *CLOSED]) == 1
        error = capsys.readouterr().err
        assert f"object '{name}'" in error
        assert expected in error
        assert error.count("\n") == 1
        unchanged()

    for name in ("no faces", "open", "flat"):
        volume(bpy.data.objects[name], "REMOVE")
        assert NO_VOLUMES[name] in facts(addon, quarter)["error"]
        with pytest.raises(RuntimeError, match=f"object '{name}'"):
            bpy.ops.refine.delete(what="VOLUMES")
        bpy.context.scene.refine.volumes.clear()

    item = volume(bpy.data.objects["far"], "REMOVE")
    assert "error" not in facts(addon, quarter)
    item.role = "KEEP"
    assert "all 9939 splats lie where they must go" in facts(addon, quarter)["error"]
    with pytest.raises(RuntimeError, match="all 9939 splats"):
        bpy.ops.refine.score()


def test_the_command_takes_names(addon, quarter, quarter_file, room_cameras, capsys):
    """Volumes lie in the world, where a file's coordinates are taken as they stand."""
    box = cube(*middle(addon, quarter))
    inside = (np.abs(means(addon, quarter) - box.location) < box.scale).all(axis=1)
    quarter.vertex_groups.new(name="mine").add(list(range(100)), 1.0, "REPLACE")
    quarter.location.x = 5.0
    for source, options, said in (
        (PRUNE, ["--protect", "mine"], "100 protected\n"),
        (["prune", str(quarter_file)], ["--keep-inside", "Cube"],
         f"{COUNT - inside.sum():,} removed by you"),
    ):  # fmt: skip
        assert command(addon, [*source, *options, "--dry-run", *CLOSED]) == 0
        assert f"\n  {said}" in capsys.readouterr().out

    for option in ("--protect", "--keep-inside"):
        assert command(addon, [*PRUNE, option, "Cbue", "--dry-run", *CLOSED]) == 1
    first, second = capsys.readouterr().err.splitlines()
    assert "no object 'Cbue' in the open .blend, nor a group or attribute of 'room'" in first
    assert second.endswith("in the open .blend (objects that can be volumes: Cube)")


def test_a_damaged_note_counts_as_none(addon, quarter):
    """A .blend may come from anywhere."""
    whole = '{"splats": 9939, "protected": %s, "removed_by_user": 1, "volumes": []}'
    for text in ("", "{", "[]", '{"splats": 9939}', whole % '"x"', whole % 7):
        quarter.data[addon.objects.demands.RECORD] = text
        assert ("protected" in facts(addon, quarter)) == (text == whole % 7)
