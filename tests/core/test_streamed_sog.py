"""Streamed SOG: what splat-transform wrote, what we write, and files that lie."""

from __future__ import annotations

import json
import re
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from refine_addon.core import RefineError, images, read_splats
from refine_addon.core.formats import streamed_sog
from refine_addon.core.formats.streamed_sog import StreamedSog, folder_for
from refine_addon.core.splats import rotation_matrices

pytest.importorskip("PIL", reason="needs Pillow, which SOG does outside of Blender")

DATA = Path(__file__).parents[1] / "data"
ROOM = DATA / "room_small/point_cloud.ply"


def room(step):
    """Return every so many splats of the room."""
    return read_splats(ROOM).splats().take(slice(0, None, step))


def apart(one, other):
    """Return how far each position is from the nearest of others."""
    return np.linalg.norm(one.means[:, None] - other.means, axis=2).min(axis=1)


@pytest.mark.parametrize(("level", "step", "count"), [(0, 1, 151), (1, 2, 76)])
def test_a_level_is_read_with_the_environment(level, step, count):
    """Every 265th splat of the room or every second of them, and 15 of the environment.

    A coordinate is off by 1/65535 of 2.9, the range of the logarithms, times 4.3: 1.9e-4 in each
    of three axes.
    """
    file = read_splats(DATA / "other_tools/streamed/lod-meta.json", level=level)

    splats, source = file.splats(), room(265)
    assert file.format == f"streamed SOG, level {level}"
    assert len(splats) == count + 15
    assert apart(splats.take(slice(count)), source.take(slice(0, None, step))).max() < 4e-4
    assert apart(source.take(slice(0, None, step)), splats.take(slice(count))).max() < 4e-4
    assert apart(splats.take(slice(count, None)), source.take(slice(9, None, 10))).max() < 4e-4


@pytest.fixture
def written(tmp_path, monkeypatch):
    """Return the index of two levels of 2,485 and 498 splats in chunks of 500 or less."""
    monkeypatch.setattr(streamed_sog, "UNIT", 500)
    monkeypatch.setattr(streamed_sog, "LEAST", 50)
    path = tmp_path / "out/lod-meta.json"
    write(path, room(16), room(80))
    return path


def write(path, *levels, width=3.0, overwrite=False):
    """Write levels."""
    with folder_for(path, overwrite=overwrite) as made:
        scene = StreamedSog(levels[0].means, width, made)
        sizes = [scene.add(level) for level in levels]
        scene.publish(path, overwrite=overwrite)
    return sizes


def chunks_of(node):
    """Return the leaves of a tree."""
    children = node.get("children", [])
    return [node] if "lods" in node else [leaf for child in children for leaf in chunks_of(child)]


def test_what_is_written_is_read_level_by_level(written):
    """Counts, and positions as near as 16 bits of the chunk's folder have them."""
    for level, step in enumerate((16, 80)):
        splats, source = read_splats(written, level=level).splats(), room(step)
        assert len(splats) == len(source)
        assert max(apart(splats, source).max(), apart(source, splats).max()) < 3e-4


def test_a_folder_is_a_sog_and_chunks_follow_each_other_in_it(written):
    """Every folder but the last of a level has more than 500 splats, and fewer than 1,001."""
    meta = json.loads(written.read_text())
    held: dict[tuple[int, str], int] = {}
    for chunk in chunks_of(meta["tree"]):
        for level, span in chunk["lods"].items():
            key = (span["file"], level)
            assert span["offset"] == held.get(key, 0)
            held[key] = span["offset"] + span["count"]

    assert meta["counts"] == [2485, 497]
    assert meta["count"] == 2982
    assert [meta["filenames"][file].split("_")[0] for file, _ in sorted(held)] == [
        level for _, level in sorted(held)
    ]
    for (file, level), count in held.items():
        assert len(read_splats(written.parent / meta["filenames"][file])) == count
        if level == "0" and meta["filenames"][file] != max(
            name for name in meta["filenames"] if name.startswith("0")
        ):
            assert 500 < count <= 1000


def test_boxes_hold_the_splats_of_all_levels_and_parents_their_children(written):
    """A box around an ellipsoid reaches sum_j |R_ij| s_j from its centre; 1e-3 for 16 bits."""
    meta = json.loads(written.read_text())
    for chunk in chunks_of(meta["tree"]):
        low, high = (np.array(chunk["bound"][end]) for end in ("min", "max"))
        for span in chunk["lods"].values():
            unit = read_splats(written.parent / meta["filenames"][span["file"]]).splats()
            splats = unit.take(slice(span["offset"], span["offset"] + span["count"]))
            assert (splats.means > low - 1e-3).all()
            assert (splats.means < high + 1e-3).all()
    every = room(16)
    turns = np.abs(rotation_matrices(every.quaternions))
    half = (turns @ np.exp(every.log_scales)[..., None])[..., 0]
    outer = meta["tree"]["bound"]
    assert (outer["min"] <= (every.means - half).min(axis=0) + 1e-6).all()
    left = [meta["tree"]]
    while left:
        node = left.pop()
        left += node.get("children", [])
        for child in node.get("children", []):
            assert (np.array(node["bound"]["min"]) <= child["bound"]["min"]).all()
            assert (np.array(node["bound"]["max"]) >= child["bound"]["max"]).all()


def test_chunks_are_no_wider_than_asked_where_they_hold_enough(written):
    """2,485 splats in 7 units: a chunk of over 50 is 3 wide at most, in each axis."""
    meta = json.loads(written.read_text())
    chunks = chunks_of(meta["tree"])
    assert len(chunks) >= 8
    for chunk in chunks:
        span = chunk["lods"]["0"]
        unit = read_splats(written.parent / meta["filenames"][span["file"]]).splats()
        means = unit.means[span["offset"] : span["offset"] + span["count"]]
        assert span["count"] <= 50 or np.ptp(means, axis=0).max() <= 3.001


def test_splats_in_one_place_are_one_chunk(tmp_path, monkeypatch):
    """No plane parts them."""
    monkeypatch.setattr(streamed_sog, "UNIT", 10)
    same = replace(room(1000), means=np.ones((40, 3), np.float32))

    write(tmp_path / "lod-meta.json", same)

    meta = json.loads((tmp_path / "lod-meta.json").read_text())
    assert meta["tree"]["lods"]["0"]["count"] == len(same) == 40


def test_only_what_an_index_names_is_replaced(written):
    """And only when told: its folders, of more levels before; other files and folders stay."""
    (written.parent / "0_0/notes.txt").write_text("mine")
    (written.parent / "0_5").mkdir()
    with pytest.raises(RefineError, match="exists already"):
        write(written, room(400))

    write(written, room(400), overwrite=True)

    left = sorted(path.name for path in written.parent.iterdir())
    assert left == ["0_0", "0_5", "0_6", "lod-meta.json"]
    assert [path.name for path in (written.parent / "0_0").iterdir()] == ["notes.txt"]
    assert not list((written.parent / "0_5").iterdir())
    assert len(read_splats(written)) == 100


STEPS = ["rename", "write", "replace", "unlink", "rmdir"]


@pytest.mark.parametrize("step", STEPS)
@pytest.mark.parametrize("after", [False, True], ids=["before", "after"])
def test_a_replacement_that_is_stopped_leaves_one_that_is_whole(written, monkeypatch, step, after):
    """By a signal ahead of or behind any step: the old until the index is replaced, then the new.

    Index and old levels were deleted before the new ones were in their place, and the same command
    then refused what was there.
    """
    before = {path: path.read_bytes() for path in written.parent.rglob("*") if path.is_file()}
    owner = streamed_sog if step == "write" else Path
    name = "whole_file" if step == "write" else step
    done = getattr(owner, name)

    def stopped(*given, **named):
        if step == "replace" and given[0].parent != written.parent:
            return done(*given, **named)
        if after:
            done(*given, **named)
        raise KeyboardInterrupt

    with monkeypatch.context() as patched:
        patched.setattr(owner, name, stopped)
        with pytest.raises(KeyboardInterrupt):
            write(written, room(400), overwrite=True)

    count = len(read_splats(written))
    assert count in (100, len(room(16)))
    if count > 100:
        found = {path: path.read_bytes() for path in written.parent.rglob("*") if path.is_file()}
        assert found == before
    write(written, room(800), overwrite=True)
    assert len(read_splats(written)) == len(room(800))


def test_a_file_that_is_no_index_is_not_replaced(tmp_path):
    """Another JSON of that name stays."""
    (tmp_path / "lod-meta.json").write_text('{"my": "notes"}')

    with pytest.raises(RefineError, match="missing 'lodLevels'"):
        write(tmp_path / "lod-meta.json", room(400), overwrite=True)
    assert (tmp_path / "lod-meta.json").read_text() == '{"my": "notes"}'


def interrupted(*_given, **_named):
    """Be what Ctrl-C is."""
    raise KeyboardInterrupt


@pytest.mark.parametrize("model", ["default", "antialiased", "2dgs"])
def test_the_model_is_kept(tmp_path, model):
    """Each folder says it, and so does what is read."""
    write(tmp_path / "lod-meta.json", replace(room(400), model=model))

    assert read_splats(tmp_path / "lod-meta.json").model == model
    assert read_splats(tmp_path / "0_0/meta.json").model == model


def test_what_is_stopped_leaves_nothing(tmp_path, monkeypatch):
    """Once both levels are written, before they are moved: neither folders nor what is above."""
    path = tmp_path / "a/out/lod-meta.json"
    monkeypatch.setattr(StreamedSog, "publish", interrupted)

    with pytest.raises(KeyboardInterrupt):
        write(path, room(400), room(800))
    assert not (tmp_path / "a").exists()


def _set(*path_and_value):
    *path, key, value = path_and_value

    def change(meta):
        held = meta
        for step in path:
            held = held[step]
        held[key] = value

    return change


SPAN = ("tree", "lods", "0")

FAULTS = {
    "version": (_set("version", 2), "version: expected 1, got 2"),
    "levels": (_set("lodLevels", 0), "lodLevels: expected a whole number from 1 to "),
    "level": (_set("lodLevels", "2"), "lodLevels: expected a whole number from 1 to "),
    "names": (_set("filenames", None), "filenames: expected a list, got null"),
    "a name": (_set("filenames", 0, 5), "filenames [0]: expected a string, got 5"),
    "elsewhere": (
        _set("filenames", 0, "../0_0/meta.json"),
        'filenames [0]: "../0_0/meta.json", expected a file in this folder or one below',
    ),
    "from the root": (
        _set("filenames", 0, "//etc/hostname"),
        'filenames [0]: "//etc/hostname", expected a file in this folder or one below',
    ),
    "away": (_set("filenames", 0, "9_9/meta.json"), 'filenames [0]: "9_9/meta.json" is not there'),
    "no tree": (_set("tree", []), "tree: expected an object, got a list of 0"),
    "children": (_set("tree", "children", {}), "tree children: expected a list, got an object"),
    "lods": (_set("tree", "lods", []), "tree chunk 0 level 0: expected an object, got a list"),
    "file": (
        _set(*SPAN, "file", 2),
        "tree chunk 0 level 0 file: expected a whole number from 0 to 1, got 2",
    ),
    "offset": (_set(*SPAN, "offset", -1), "tree chunk 0 level 0 offset: expected a whole number"),
    "count": (_set(*SPAN, "count", 0.5), "tree chunk 0 level 0 count: expected a whole number"),
    "many": (
        _set(*SPAN, "count", 10**15),
        f"filenames [0]: holds 151 splats, the tree takes those up to {10**15}",
    ),
    "none": (_set(*SPAN, "count", 0), "no splats in level 0"),
    "environment": (
        _set("environment", "0_0/meta.json"),
        'environment: "0_0/meta.json" is named twice',
    ),
}


@pytest.fixture
def copied(tmp_path):
    """Return a copy of the index of splat-transform, and what it says."""
    shutil.copytree(DATA / "other_tools/streamed", tmp_path / "a")
    path = tmp_path / "a/lod-meta.json"
    return path, json.loads(path.read_text())


@pytest.mark.parametrize("name", FAULTS)
def test_what_is_wrong_is_named_with_its_place(copied, name):
    """What was got, and what was expected."""
    (path, meta), (change, expected) = copied, FAULTS[name]
    change(meta)
    path.write_text(json.dumps(meta))

    with pytest.raises(RefineError, match=re.escape(f"{path}: {expected}")):
        read_splats(path)


def test_no_splat_is_taken_twice(copied):
    """A small tree would show a file as often as it likes."""
    path, meta = copied
    leaf = meta["tree"]
    meta["tree"] = {"children": [leaf, leaf]}
    path.write_text(json.dumps(meta))

    with pytest.raises(RefineError, match=r"filenames \[0\]: the tree takes a splat twice"):
        read_splats(path)


def test_images_that_many_folders_share_count_once(tmp_path):
    """Images of 4,096 splats in some 45 kB, named by 40 files of 1.4 kB: 164,000 splats.

    1.4 MB became 40 million splats, and 2.3 GB of memory. Each file alone holds what it says.
    """
    pixels = np.random.default_rng(0).integers(252, 256, (64, 64, 4)).astype(np.uint8)
    pixels[..., :3] *= np.arange(64, dtype=np.uint8)[:, None]
    for name in "luqsc":
        (tmp_path / name).write_bytes(images._Pillow().encode(pixels))
    places = {"mins": [0] * 3, "maxs": [1] * 3, "files": ["l", "u"]}
    table = [0] * 256
    parts = {"scales": {"codebook": table, "files": ["s"]}, "quats": {"files": ["q"]}}
    one = {"version": 2, "count": 4096, "means": places, **parts}
    one["sh0"] = {"codebook": table, "files": ["c"]}
    names = [f"{number}-meta.json" for number in range(40)]
    for name in names:
        (tmp_path / name).write_text(json.dumps(one, separators=(",", ":")))
    span = {"offset": 0, "count": 4096}
    leaves = [{"lods": {"0": {"file": file, **span}}} for file in range(40)]
    index = {"lodLevels": 1, "filenames": names, "tree": {"children": leaves}}
    (tmp_path / "lod-meta.json").write_text(json.dumps(index))
    size = sum(path.stat().st_size for path in tmp_path.iterdir())

    assert len(read_splats(tmp_path / names[0])) == 4096 < size / 20
    said = f"163840 splats, expected at most {size}, the bytes of all files together"
    with pytest.raises(RefineError, match=said):
        read_splats(tmp_path / "lod-meta.json")


def test_folders_of_two_models_are_refused(copied):
    """What a viewer draws one way is not merged with what it draws another."""
    path, _ = copied
    around = path.parent / "env/meta.json"
    around.write_text(json.dumps({**json.loads(around.read_text()), "model": "antialiased"}))

    with pytest.raises(RefineError, match=r"env/meta.json: model antialiased, others have default"):
        read_splats(path)


@pytest.mark.parametrize("level", [2, -1])
def test_a_level_that_is_not_there_is_refused(level):
    """Of two, 0 and 1 are."""
    with pytest.raises(RefineError, match=f"no level {level}, expected 0 to 1"):
        read_splats(DATA / "other_tools/streamed/lod-meta.json", level=level)
    with pytest.raises(RefineError, match=r"has no level 1: only lod-meta.json has levels"):
        read_splats(ROOM, level=1)
