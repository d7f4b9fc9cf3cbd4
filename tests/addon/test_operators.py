"""The buttons: what they do is what core decides, and where they fail nothing changes."""

import re

import bpy
import numpy as np
import pytest

from .conftest import ROOM, applied, export, keep_mask, linked, read, splats_of


def test_import_score_apply_export_writes_the_file_that_core_writes(
    addon, room_cameras, few_file, tmp_path
):
    """The panel's path from file to file, against `prune_file` with the camera file: 50 % off."""
    settings, core = bpy.context.scene.refine, addon.core
    settings.method, settings.ratio = "merge", 0.5
    bpy.ops.refine.import_ply(filepath=str(few_file))
    bpy.ops.refine.score()
    bpy.ops.refine.apply()
    bpy.ops.refine.export_ply(filepath=str(tmp_path / "panel.ply"))
    views = core.read_cameras(ROOM / "cameras.json")
    core.prune_file(few_file, tmp_path / "core.ply", views, core.Budget(ratio=0.5))

    assert len(room_cameras.objects) == len(views) == 72
    assert (tmp_path / "panel.ply").read_bytes() == (tmp_path / "core.ply").read_bytes()


@pytest.mark.parametrize("method", ["closed-form", "occlusion", "merge"])
def test_upright_keeps_the_splats_that_core_keeps_of_the_file_as_it_lies(
    addon, few_file, room_views, tmp_path, method
):
    """A quarter turn of splats and cameras, which is not in the data: the file is the same.
    The panel starts with the method and the budget that core starts with."""
    bpy.ops.refine.import_ply(filepath=str(few_file), upright=True)
    obj = bpy.context.object
    addon.mesh.attributes.write_attribute(obj.data, "row", "INT", np.arange(3976, dtype=np.int32))
    export(addon, addon.mesh.layout.check(obj), tmp_path / "out.ply")
    bpy.ops.refine.import_cameras(filepath=str(ROOM / "cameras.json"), upright=True)
    settings, core = bpy.context.scene.refine, addon.core
    assert settings.to_method() == core.Merge()
    assert settings.to_budget() == core.Budget(ratio=0.5)
    settings.method, settings.views, settings.ratio = method, 24, 0.9
    bpy.ops.refine.score()
    bpy.ops.refine.apply()
    splats, budget = core.read_ply(few_file).splats(), core.Budget(ratio=0.9)
    expected = core.prune(splats, room_views, budget, core.METHODS[method](24)).keep

    np.testing.assert_array_equal(read(addon, obj, "row"), np.flatnonzero(expected))
    np.testing.assert_allclose(
        np.array(obj.matrix_world)[:3, :3] @ [0, -1, 0], [0, 0, 1], atol=1e-6
    )
    np.testing.assert_array_equal(
        core.read_ply(tmp_path / "out.ply").splats().means, core.read_ply(few_file).splats().means
    )


def test_apply_removes_the_lowest_ranks_once_and_keeps_everything_else(addon, few):
    """Attributes, groups, custom properties, materials and modifiers of the kept vertices."""
    mesh, row = few.data, np.arange(3976, dtype=np.int32)
    addon.mesh.attributes.write_attribute(mesh, "row", "INT", row)
    few.vertex_groups.new(name="tenth").add([int(i) for i in row[::10]], 0.5, "REPLACE")
    mesh.materials.append(bpy.data.materials.new("mine"))
    mesh["mine"], few["yours"] = 3, "x"
    few.modifiers.new("mine", "SUBSURF")
    assert not bpy.ops.refine.apply.poll()
    bpy.ops.refine.score()
    score, rank = read(addon, few, "refine_score"), read(addon, few, "refine_rank")
    names = {a.name for a in mesh.attributes} - {"refine_remove"}
    bpy.ops.refine.apply()
    kept = read(addon, few, "row")

    assert np.array_equal(np.argsort(rank), np.argsort(score, kind="stable"))
    assert (rank.min(), rank.max()) == (0.0, 1.0)
    assert np.array_equal(kept, np.sort(np.argsort(score, kind="stable")[1988:]))
    assert names <= {a.name for a in few.data.attributes}
    assert "refine_remove" not in few.data.attributes
    assert [bool(v.groups) for v in few.data.vertices[:50]] == [i % 10 == 0 for i in kept[:50]]
    assert few.data.materials[0].name == "mine"
    assert (few.data["mine"], few["yours"]) == (3, "x")
    assert [m.name for m in few.modifiers] == ["mine"]
    assert not [t for t in bpy.data.node_groups if t.name.startswith("REFINE")]
    assert not bpy.ops.refine.apply.poll()
    with pytest.raises(RuntimeError, match="Score the splats first"):
        bpy.ops.refine.apply()
    assert len(few.data.vertices) == 1988


def test_undo_and_redo_of_apply_give_bit_equal_attributes(addon, few):
    """The module pushes no undo steps by itself; a window does for operators with UNDO."""

    def now():
        obj = bpy.data.objects["room"]
        names = [a.name for a in obj.data.attributes if a.domain == "POINT"]
        return {name: read(addon, obj, name).tobytes() for name in names if name[0] != "."}

    bpy.ops.refine.score()
    bpy.ops.ed.undo_push(message="score")
    scored = now()
    bpy.ops.refine.apply()
    bpy.ops.ed.undo_push(message="apply")
    applied = now()
    bpy.ops.ed.undo()

    assert now() == scored
    assert bpy.ops.refine.apply.poll()
    bpy.ops.ed.redo()
    assert now() == applied
    cameras = ("import_cameras", "turn_cameras", "add_ring")
    for name in ("score", "apply", "import_ply", "levels", *cameras):
        assert "UNDO" in getattr(bpy.types, f"REFINE_OT_{name}").bl_options


def test_an_impossible_budget_is_said_in_the_plan_and_refused_by_apply(addon, few, unchanged):
    """Not one splat fits into so small a file; the closed form told nothing of the pictures."""
    settings, plans = bpy.context.scene.refine, addon.ui.plans
    bpy.ops.refine.score()
    unchanged.start()
    for kind, value, reason in (
        ("max_mb", 1e-6, "too small for one splat"),
        ("psnr", 38.0, "score again with a PSNR as budget"),
    ):
        settings.budget = kind
        setattr(settings, kind, value)
        assert reason in plans.stored(few, settings)["error"]
        with pytest.raises(RuntimeError, match=reason):
            bpy.ops.refine.apply()
        unchanged()


def test_several_files_are_imported_at_once_and_a_bad_one_is_reported(
    few_file, tmp_path, unchanged, capfd
):
    """Half of a file is no file; of bad ones alone nothing is added."""
    whole = few_file.read_bytes()
    for name, content in {"a": whole, "b": whole, "bad": whole[: len(whole) // 2]}.items():
        (tmp_path / f"{name}.ply").write_bytes(content)
    unchanged.start()
    for call, name in (("ply", "none.ply"), ("cameras", "none.json"), ("ply", "bad.ply")):
        with pytest.raises(RuntimeError, match=rf"{name}: (cannot|no such|.*truncated)"):
            getattr(bpy.ops.refine, f"import_{call}")(filepath=str(tmp_path / name))
    unchanged()
    capfd.readouterr()
    files = [{"name": f"{name}.ply"} for name in ("a", "bad", "b")]
    assert bpy.ops.refine.import_ply(directory=str(tmp_path), files=files) == {"FINISHED"}
    assert sorted(obj.name for obj in bpy.context.selected_objects) == ["a", "b"]
    assert "bad.ply: " in capfd.readouterr().out


@pytest.mark.usefixtures("few")
def test_an_export_that_cannot_be_leaves_the_file_that_is_there(
    addon, few_file, tmp_path, monkeypatch
):
    """It is not overwritten unasked: the file browser asks by itself.
    Too little memory is a sentence: NumPy says how much it was, Python itself nothing at all."""
    target, export = tmp_path / "out.ply", bpy.ops.refine.export_ply
    target.write_bytes(b"mine")
    with pytest.raises(RuntimeError, match="exists already"):
        export(filepath=str(target))
    assert target.read_bytes() == b"mine"
    export(filepath=str(target), overwrite=True)
    assert target.read_bytes() == few_file.read_bytes()
    with pytest.raises(RuntimeError, match="no folder"):
        export(filepath=str(tmp_path / "no" / "out.ply"))
    with pytest.raises(RuntimeError, match=r"^Error: ~nouser/x\.ply: cannot be found"):
        export(filepath="~nouser/x.ply")
    for said in ("", "Unable to allocate 9 GiB"):

        def refuse(*_, said=said, **__):
            raise MemoryError(said)

        monkeypatch.setattr(addon.ui.export_operators, "write_splats", refuse)
        expected = re.escape("not enough memory" + (f" ({said})" if said else ""))
        with pytest.raises(RuntimeError, match=f"^Error: {expected}\n$"):
            export(filepath=str(target), overwrite=True)
    assert target.read_bytes() == few_file.read_bytes()


def _away(scene, kind="PERSP"):
    camera = scene.camera = linked("away", bpy.data.cameras.new("away"))
    camera.location.z, camera.data.type = -1000.0, kind
    scene.refine.source = "ACTIVE"


@pytest.mark.parametrize(
    ("prepare", "reason"),
    [
        (lambda scene: setattr(scene.refine, "source", "VISIBLE"), "none is visible"),
        (lambda scene: setattr(scene.refine, "source", "ACTIVE"), "no active camera"),
        (lambda scene: setattr(scene.refine, "source", "SELECTED"), "none is selected"),
        (lambda scene: setattr(scene.refine, "collection", None), "choose the collection"),
        (_away, "no camera sees the splats"),
        (lambda scene: _away(scene, "ORTHO"), "'away' is orthographic"),
        (lambda _scene: setattr(bpy.data.objects["room"], "scale", (1, 1, 0)), "flat"),
    ],
)
@pytest.mark.usefixtures("few")
def test_scoring_that_cannot_be_done_is_explained(room_cameras, unchanged, prepare, reason):
    for camera in room_cameras.objects:
        camera.hide_set(True)
    prepare(bpy.context.scene)
    bpy.context.view_layer.update()
    unchanged.start()

    with pytest.raises(RuntimeError, match=reason):
        bpy.ops.refine.score()
    unchanged()


@pytest.mark.parametrize(
    ("prepare", "reason"),
    [
        (lambda obj: linked("other", obj.data), "shares its data"),
        (lambda obj: obj.shape_key_add(name="Basis"), "shape keys"),
        (lambda _obj: bpy.ops.object.mode_set(mode="WEIGHT_PAINT"), "weight paint mode"),
    ],
)
def test_an_object_that_cannot_lose_vertices_is_refused(few, unchanged, prepare, reason):
    bpy.ops.refine.score()
    prepare(few)
    unchanged.start()

    with pytest.raises(RuntimeError, match=reason):
        bpy.ops.refine.apply()
    unchanged()
    bpy.ops.object.mode_set(mode="EDIT")  # where attributes are not to be had
    names = ("score", "apply", "export_ply", "import_ply")
    assert not any(getattr(bpy.ops.refine, name).poll() for name in names)


def test_splats_added_after_scoring_are_never_deleted_unscored(few):
    """Joining, or adding, gives them a score of 0, the lowest: apply refuses instead."""
    bpy.ops.refine.score()
    few.data.vertices.add(24)

    with pytest.raises(RuntimeError, match="scored with 3976 splats, has 4000 now"):
        bpy.ops.refine.apply()
    assert len(few.data.vertices) == 4000


def test_hidden_objects_are_scored_and_pruned_like_others(addon, few, room_views, score):
    """By the eye, by the monitor icon, by excluding the collection; the command reaches all."""
    half, method = addon.core.Budget(ratio=0.5), addon.core.ClosedForm()
    expected = addon.core.prune(splats_of(addon, few), room_views, half, method)
    few.hide_set(True)
    few.hide_viewport = True
    bpy.context.scene.collection.objects.unlink(few)
    bpy.data.collections.new("excluded").objects.link(few)
    bpy.context.scene.collection.children.link(bpy.data.collections["excluded"])
    bpy.context.view_layer.layer_collection.children["excluded"].exclude = True
    score(few, room_views)

    assert np.array_equal(keep_mask(addon, few, half), expected.keep)
    applied(addon, addon.mesh.layout.check(few), expected)
    assert len(few.data.vertices) == 1988


@pytest.mark.usefixtures("few")
def test_linked_objects_are_refused(addon, few_file, room_views, score, tmp_path):
    """What lies in a library cannot be changed from here; exporting it is no change."""
    bpy.ops.wm.save_as_mainfile(filepath=str(tmp_path / "library.blend"))
    bpy.ops.wm.read_homefile(use_empty=True)
    with bpy.data.libraries.load(str(tmp_path / "library.blend"), link=True) as (_, here):
        here.objects = ["room"]
    obj = bpy.data.objects["room"]
    bpy.context.scene.collection.objects.link(obj)

    with pytest.raises(addon.core.RefineError, match="is linked from"):
        score(obj, room_views)
    export(addon, addon.mesh.layout.check(obj), tmp_path / "out.ply")
    assert (tmp_path / "out.ply").read_bytes() == few_file.read_bytes()
