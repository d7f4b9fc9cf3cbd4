"""Blender as a module, with the source tree enabled as an extension, and a small scene."""

import importlib
import os
import tempfile

import numpy as np
import pytest

# Before the first `import bpy`: Blender reads it once, and the user's own settings stay theirs.
os.environ["BLENDER_USER_RESOURCES"] = tempfile.mkdtemp(prefix="refine-blender-")

import bpy  # noqa: I001
import addon_utils

from tests.places import ROOM, ROOT
from tests.strategies import splat_names

MODULE = "bl_ext.dev.refine_addon"


@pytest.fixture(scope="session", autouse=True)
def extension(tmp_path_factory):
    """Enable the source tree as an extension: the package under the name it has installed."""
    repository = tmp_path_factory.mktemp("extensions")
    package = repository / "refine_addon"
    package.mkdir()
    for path in (ROOT / "refine_addon").iterdir():
        if path.name != "__pycache__":
            (package / path.name).symlink_to(path)
    (package / "blender_manifest.toml").symlink_to(ROOT / "blender_manifest.toml")
    bpy.context.preferences.extensions.repos.new(
        name="Dev", module="dev", custom_directory=str(repository), source="USER"
    )
    failures = []
    addon_utils.enable(MODULE, default_set=True, handle_error=failures.append)
    assert not failures, failures
    yield importlib.import_module(MODULE)
    addon_utils.disable(MODULE, default_set=True)


@pytest.fixture(scope="session")
def addon(extension):
    """Return the package with its modules as attributes: ``addon.objects.splat_group``."""
    for path in (ROOT / "refine_addon").glob("*.py"):
        if not path.stem.startswith("__"):
            importlib.import_module(f"{MODULE}.{path.stem}")
    return extension


@pytest.fixture
def core(addon):
    return addon.core


def export(addon, checked, path, **options):
    """Write an object to a file, as *Export* does; see `read_for_export` for the options."""
    file = addon.objects.splat_group.read_for_export(checked, **options)()
    addon.core.formats.registry.write_splats(path, file)


def read(addon, obj, name):
    return addon.mesh.attributes.read_attribute(obj.data, name)


def choose(addon, obj, rows):
    """Select these splats alone."""
    count = addon.mesh.layout.splat_count(obj.data)
    addon.mesh.selection.select(obj, np.isin(np.arange(count), rows))


def splats_of(addon, obj):
    return addon.objects.splat_group.gather([addon.mesh.layout.check(obj)], whole=True)


def keep_mask(addon, obj, budget, protect=""):
    """Return which splats of a scored object stay, as *Apply* decides it; `protect` names some."""
    checked = addon.mesh.layout.check(obj)
    masks = addon.objects.demands.Demands((protect,) if protect else ()).masks([checked])
    stored, core = addon.objects.splat_group.stored_arguments, addon.core
    return core.prune(**stored([checked], budget, masks, core.Occlusion())).keep


def applied(addon, checked, result):
    """Do to an object what was decided, as *Apply* does it."""
    group = addon.objects.splat_group
    group.apply([checked], group.changes(group.frames_of([checked]), result))


@pytest.fixture(autouse=True)
def empty_scene():
    """Start from an empty file, with the extension enabled."""
    bpy.ops.wm.read_homefile(use_empty=True)
    scene = bpy.context.scene
    scene.render.resolution_x, scene.render.resolution_y = 240, 160
    return scene


def linked(name, data=None):
    """Return a new object of the scene."""
    obj = bpy.data.objects.new(name, data)
    bpy.context.scene.collection.objects.link(obj)
    return obj


def _imported(addon, path):
    obj = linked("room", addon.mesh.attributes.mesh_from_file(addon.core.read_ply(path)))
    bpy.context.view_layer.objects.active = obj
    obj.select_set(True)
    bpy.context.view_layer.update()
    return obj


@pytest.fixture
def room(addon, empty_scene):
    """Import the small trained room: 39,755 splats."""
    return _imported(addon, ROOM / "point_cloud.ply")


@pytest.fixture
def quarter(addon, room):
    """Keep every fourth splat of the room: 9,939."""
    addon.mesh.edit.delete_vertices(room, np.arange(len(room.data.vertices)) % 4 != 0)
    return room


@pytest.fixture
def few(addon, room_cameras, few_file):
    """Import every tenth splat of the room, 3,976, and the cameras."""
    return _imported(addon, few_file)


def _file(step):
    @pytest.fixture(scope="session")
    def file(addon, tmp_path_factory):
        path = tmp_path_factory.mktemp("part") / "room.ply"
        whole = addon.core.read_ply(ROOM / "point_cloud.ply")
        whole.write(path, np.arange(len(whole)) % step == 0)
        return path

    return file


quarter_file, few_file = _file(4), _file(10)


@pytest.fixture
def room_views(addon):
    return addon.core.read_cameras(ROOM / "cameras.json")


@pytest.fixture
def room_cameras(addon, empty_scene, room_views):
    """Import the room's cameras as objects, in a collection; score by the fastest method."""
    collection = bpy.data.collections.new("cameras")
    empty_scene.collection.children.link(collection)
    addon.cameras.create_cameras(room_views, collection)
    settings = empty_scene.refine
    settings.collection, settings.source = collection, "COLLECTION"
    settings.method = "closed-form"
    return collection


@pytest.fixture
def score(addon):
    """Return a function that scores an object by the views it is given, as the button does."""

    def score(obj, views):
        method, checked = addon.core.ClosedForm(), addon.mesh.layout.check(obj)
        scores = addon.core.score(addon.objects.splat_group.gather([checked]), views, method)
        addon.mesh.scores.store([checked], scores, method)

    return score


def snapshot():
    """Return what an operator must leave alone where it fails, as plain values."""
    data, scene = bpy.data, bpy.context.scene
    kinds = (data.objects, data.meshes, data.pointclouds, data.cameras, data.collections)
    facts = [sorted(each.name for each in kind) for kind in (*kinds, data.node_groups)]
    facts += [sorted(data.materials.keys()), scene.frame_current, scene.camera]
    for mesh in (*data.meshes, *data.pointclouds):
        position = mesh.attributes.get("position")
        attributes = sorted((a.name, a.data_type, a.domain) for a in mesh.attributes)
        facts += [len(position.data) if position else 0, attributes, sorted(mesh.keys())]
    for obj in data.objects:
        facts += [obj.data and obj.data.name, [modifier.name for modifier in obj.modifiers]]
        facts += [list(row) for row in obj.matrix_world]
    return facts


@pytest.fixture
def unchanged():
    """Return a function that checks that the scene is what it was when `start` was called."""
    state = []

    def check():
        assert snapshot() == state

    check.start = lambda: state.__setitem__(slice(None), snapshot())
    return check


@pytest.fixture
def make_splats():
    """Return a function that makes columns of random splats, in the order of the reference."""

    def make(count=8, *, degree=0, seed=0):
        rng, names = np.random.default_rng(seed), splat_names(degree, normals=True)
        columns = {name: rng.normal(size=count).astype(np.float32) for name in names}
        for index in range(3):
            columns[f"scale_{index}"] -= 3.0
        return columns

    return make
