"""Streamed SOG: what splat-transform wrote, what we write, and files that lie."""

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
from tests.hostile import refused, with_value
from tests.places import DATA

pytest.importorskip("PIL", reason="needs Pillow, which SOG does outside of Blender")

ROOM = DATA / "room_small/point_cloud.ply"
OTHER = DATA / "other_tools/streamed/lod-meta.json"


def room(step):
    """Return every so many splats of the room."""
    return read_splats(ROOM).splats().take(slice(0, None, step))


def apart(one, other):
    """Return how far positions of either are from the nearest of the other, at most."""
    a, b = one.means.astype(np.float64), other.means.astype(np.float64)
    squares = (a**2).sum(axis=1)[:, None] + (b**2).sum(axis=1) - 2.0 * a @ b.T
    return np.sqrt(max(squares.min(axis=0).max(), squares.min(axis=1).max()))


@pytest.mark.parametrize(("level", "step", "count"), [(0, 1, 151), (1, 2, 76)])
def test_a_level_is_read_with_the_environment(level, step, count):
    """Every 265th splat of the room or every second of them, and 15 of the environment.
    A coordinate is off by 1/65535 of 2.9, the range of the logarithms, times 4.3: 1.9e-4 in each
    of three axes."""
    file = read_splats(OTHER, level=level)
    splats, source = file.splats(), room(265)
    assert file.format == f"streamed SOG, level {level}"
    assert len(splats) == count + 15
    assert apart(splats.take(slice(count)), source.take(slice(0, None, step))) < 4e-4
    assert apart(splats.take(slice(count, None)), source.take(slice(9, None, 10))) < 4e-4


def write(path, *levels, width=3.0, overwrite=False):
    """Write levels."""
    with folder_for(path, overwrite=overwrite) as made:
        scene = StreamedSog(levels[0].means, width, made)
        for level in levels:
            scene.add(level)
        scene.publish(path, overwrite=overwrite)


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """Return the index of two levels of 2,485 and 497 splats in chunks of 500 or less."""
    path = tmp_path_factory.mktemp("streamed") / "lod-meta.json"
    with pytest.MonkeyPatch.context() as patched:
        patched.setattr(streamed_sog, "UNIT", 500)
        patched.setattr(streamed_sog, "LEAST", 50)
        write(path, room(16), room(80))
    return path


@pytest.fixture
def written(tmp_path):
    """Return the index of a level of 249 splats that may be replaced."""
    write(tmp_path / "out/lod-meta.json", room(160))
    return tmp_path / "out/lod-meta.json"


def chunks_of(node):
    """Return the leaves of a tree; parents' boxes hold those of their children."""
    found = [node] if "lods" in node else []
    for child in node.get("children", []):
        assert (np.array(node["bound"]["min"]) <= child["bound"]["min"]).all()
        assert (np.array(node["bound"]["max"]) >= child["bound"]["max"]).all()
        found += chunks_of(child)
    return found


def test_what_is_written_is_read_level_by_level(made):
    """Counts, and positions as near as 16 bits of the chunk's folder have them."""
    meta = json.loads(made.read_text())
    assert (meta["count"], meta["counts"]) == (2982, [2485, 497])
    for level, step in enumerate((16, 80)):
        splats = read_splats(made, level=level).splats()
        assert len(splats) == meta["counts"][level]
        assert apart(splats, room(step)) < 3e-4


def test_chunks_follow_each_other_in_a_folder_and_lie_in_their_boxes(made):
    """Every folder but the last of a level has more than 500 splats, and fewer than 1,001.
    2,485 splats in 7 units: a chunk of over 50 is 3 wide at most, in each axis. A box around an
    ellipsoid reaches sum_j |R_ij| s_j from its centre; 1e-3 for 16 bits."""
    meta = json.loads(made.read_text())
    units = [read_splats(made.parent / name).splats() for name in meta["filenames"]]
    held = [0] * len(units)
    for chunk in chunks_of(meta["tree"]):
        low, high = (np.array(chunk["bound"][end]) for end in ("min", "max"))
        for level, span in chunk["lods"].items():
            file, start, count = span["file"], span["offset"], span["count"]
            assert start == held[file]
            assert meta["filenames"][file].startswith(f"{level}_")
            held[file] += count
            means = units[file].means[start : start + count]
            assert (means > low - 1e-3).all()
            assert (means < high + 1e-3).all()
            assert level != "0" or count <= 50 or np.ptp(means, axis=0).max() <= 3.001
    assert held == [len(unit) for unit in units]
    finest = [count for name, count in zip(meta["filenames"], held, strict=True) if name[0] == "0"]
    assert min(finest[:-1]) > 500
    assert max(finest) <= 1000
    every = room(16)
    turns = np.abs(rotation_matrices(every.quaternions))
    half = (turns @ np.exp(every.log_scales)[..., None])[..., 0]
    outer = meta["tree"]["bound"]
    assert (outer["min"] <= (every.means - half).min(axis=0) + 1e-6).all()


def test_splats_in_one_place_are_one_chunk_and_keep_their_model(tmp_path, monkeypatch):
    """No plane parts them. Each folder says the model."""
    monkeypatch.setattr(streamed_sog, "UNIT", 10)
    path = tmp_path / "lod-meta.json"
    write(path, replace(room(1000), means=np.ones((40, 3), np.float32), model="2dgs"))
    assert json.loads(path.read_text())["tree"]["lods"]["0"]["count"] == 40
    assert read_splats(path).model == read_splats(tmp_path / "0_0/meta.json").model == "2dgs"


def test_only_what_an_index_names_is_replaced(written):
    """And only when told: its folders; other files and folders stay, and another JSON."""
    folder = written.parent
    (folder / "0_0/notes.txt").write_text("mine")
    (folder / "0_5").mkdir()
    with pytest.raises(RefineError, match="exists already"):
        write(written, room(400))
    write(written, room(400), overwrite=True)
    assert sorted(path.name for path in folder.iterdir()) == ["0_0", "0_1", "0_5", "lod-meta.json"]
    assert [path.name for path in (folder / "0_0").iterdir()] == ["notes.txt"]
    assert not list((folder / "0_5").iterdir())
    assert len(read_splats(written)) == 100
    written.write_text('{"my": "notes"}')
    with pytest.raises(RefineError, match="missing 'lodLevels'"):
        write(written, room(400), overwrite=True)
    assert written.read_text() == '{"my": "notes"}'


@pytest.mark.parametrize("step", ["rename", "write", "replace", "unlink", "rmdir"])
@pytest.mark.parametrize("after", [False, True], ids=["before", "after"])
def test_a_replacement_that_is_stopped_leaves_one_that_is_whole(written, monkeypatch, step, after):
    """By a signal ahead of or behind any step: the old until the index is replaced, then the new.
    Index and old levels were deleted before the new ones were in their place, and the same command
    then refused what was there."""
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
    assert count in (100, 249)
    if count > 100:
        found = {path: path.read_bytes() for path in written.parent.rglob("*") if path.is_file()}
        assert found == before
    write(written, room(800), overwrite=True)
    assert len(read_splats(written)) == len(room(800))


INDEX = json.loads(OTHER.read_text())
FIRST, CHUNK = "filenames [0]: ", "tree chunk 0 level 0"
SPAN = ("tree", "lods", "0")
OUTSIDE = "expected a file in this folder or one below"

FAULTS = [
    ("version", 2, "version: expected 1, got 2"),
    ("lodLevels", 0, "lodLevels: expected a whole number from 1 to "),
    ("filenames", None, "filenames: expected a list, got null"),
    ("filenames", 0, 5, f"{FIRST}expected a string, got 5"),
    ("filenames", 0, "../0_0/meta.json", f'{FIRST}"../0_0/meta.json", {OUTSIDE}'),
    ("filenames", 0, "9_9/meta.json", f'{FIRST}"9_9/meta.json" is not there'),
    ("tree", [], "tree: expected an object, got a list of 0"),
    ("tree", "children", {}, "tree children: expected a list, got an object"),
    ("tree", {"children": [INDEX["tree"]] * 2}, f"{FIRST}the tree takes a splat twice"),
    ("tree", "lods", [], f"{CHUNK}: expected an object, got a list"),
    (*SPAN, "file", 2, f"{CHUNK} file: expected a whole number from 0 to 1, got 2"),
    (*SPAN, "offset", -1, f"{CHUNK} offset: expected a whole number"),
    (*SPAN, "count", 0.5, f"{CHUNK} count: expected a whole number"),
    (*SPAN, "count", 10**15, f"{FIRST}holds 151 splats, the tree takes those up to {10**15}"),
    (*SPAN, "count", 0, "no splats in level 0"),
    ("environment", "0_0/meta.json", 'environment: "0_0/meta.json" is named twice'),
]


@pytest.fixture
def copied(tmp_path):
    """Return a copy of the index of splat-transform."""
    shutil.copytree(OTHER.parent, tmp_path / "a")
    return tmp_path / "a/lod-meta.json"


@pytest.mark.parametrize("case", range(len(FAULTS)))
def test_what_is_wrong_is_named_with_its_place(copied, case):
    *change, expected = FAULTS[case]
    refused(copied, expected, json.dumps(with_value(INDEX, *change)).encode())


def test_images_that_many_folders_share_count_once(tmp_path):
    """Images of 4,096 splats in some 45 kB, named by 40 files of 1.4 kB: 164,000 splats.
    1.4 MB became 40 million splats, and 2.3 GB of memory. Each file alone holds what it says."""
    pixels = np.random.default_rng(0).integers(252, 256, (64, 64, 4)).astype(np.uint8)
    pixels[..., :3] *= np.arange(64, dtype=np.uint8)[:, None]
    for name in "luqsc":
        (tmp_path / name).write_bytes(images._Pillow().encode(pixels))
    places, table = {"mins": [0] * 3, "maxs": [1] * 3, "files": ["l", "u"]}, [0] * 256
    one = {"version": 2, "count": 4096, "means": places, "quats": {"files": ["q"]}}
    one |= {key: {"codebook": table, "files": [f]} for key, f in (("scales", "s"), ("sh0", "c"))}
    names = [f"{number}-meta.json" for number in range(40)]
    for name in names:
        (tmp_path / name).write_text(json.dumps(one, separators=(",", ":")))
    spans = [{"file": file, "offset": 0, "count": 4096} for file in range(40)]
    tree = {"children": [{"lods": {"0": span}} for span in spans]}
    path, index = tmp_path / "lod-meta.json", {"lodLevels": 1, "filenames": names, "tree": tree}
    path.write_text(json.dumps(index))
    size = sum(path.stat().st_size for path in tmp_path.iterdir())
    assert len(read_splats(tmp_path / names[0])) == 4096 < size / 20
    refused(path, f"163840 splats, expected at most {size}, the bytes of all files together")


def test_levels_that_are_not_there_and_two_models_are_refused(copied):
    """Of two levels, 0 and 1 are; what a viewer draws one way is not merged with another."""
    for level in (2, -1):
        with pytest.raises(RefineError, match=f"no level {level}, expected 0 to 1"):
            read_splats(copied, level=level)
    with pytest.raises(RefineError, match=re.escape("has no level 1: only lod-meta.json has lev")):
        read_splats(ROOM, level=1)
    around = copied.parent / "env/meta.json"
    around.write_text(json.dumps({**json.loads(around.read_text()), "model": "antialiased"}))
    refused(copied, "model antialiased, others have default", file=around)


def test_what_links_lead_to_is_left_alone(written):
    """A folder that the old index names; and an index, which must lie beside its folders."""
    folder, mine = written.parent, written.parents[1] / "mine"
    (folder / "0_0").rename(mine)
    (folder / "0_0").symlink_to(mine)
    held = sorted(mine.iterdir())
    write(written, room(400), overwrite=True)
    assert sorted(mine.iterdir()) == held
    link = folder.parent / "lod-meta.json"
    link.symlink_to(written)
    with pytest.raises(RefineError, match="is a link, expected the index itself"):
        write(link, room(160), overwrite=True)
    assert len(read_splats(written)) == 100
