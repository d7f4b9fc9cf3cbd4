"""Streamed SOG: what splat-transform wrote, what we write, and files that lie."""

from __future__ import annotations

import json
import re
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from refine_addon.core import RefineError, read_splats
from refine_addon.core.formats import streamed_sog_write
from refine_addon.core.formats.streamed_sog_write import StreamedSog, folder_for
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
    monkeypatch.setattr(streamed_sog_write, "UNIT", 500)
    monkeypatch.setattr(streamed_sog_write, "LEAST", 50)
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
    monkeypatch.setattr(streamed_sog_write, "UNIT", 10)
    same = replace(room(1000), means=np.ones((40, 3), np.float32))

    write(tmp_path / "lod-meta.json", same)

    meta = json.loads((tmp_path / "lod-meta.json").read_text())
    assert meta["tree"]["lods"]["0"]["count"] == len(same) == 40


def test_only_what_an_index_names_is_replaced(written):
    """And only when told: its folders, of more levels before; other files stay."""
    (written.parent / "0_0/notes.txt").write_text("mine")
    with pytest.raises(RefineError, match="exists already"):
        write(written, room(400))

    write(written, room(400), overwrite=True)

    left = sorted(path.name for path in written.parent.iterdir())
    assert left == ["0_0", "lod-meta.json"]
    assert (written.parent / "0_0/notes.txt").read_text() == "mine"
    assert len(read_splats(written)) == 100


def test_a_folder_that_no_index_names_is_not_filled(tmp_path):
    """Whatever it holds; not even with overwrite."""
    (tmp_path / "3_1").mkdir()

    with pytest.raises(RefineError, match=r"3_1: exists already; write to another folder"):
        write(tmp_path / "lod-meta.json", room(400), overwrite=True)
    assert [path.name for path in tmp_path.iterdir()] == ["3_1"]


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
