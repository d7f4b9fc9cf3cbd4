"""Tiles behind URLs, against the same tiles on the disk."""

from __future__ import annotations

import io
import json
import re
import sys
import threading
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path

import numpy as np
import pytest

from refine_addon.command import main
from refine_addon.core import (
    Budget,
    PruneRequest,
    RefineError,
    Settings,
    prune_tiles,
    read_cameras,
    read_splats,
)
from refine_addon.core.tiles import storage, units, writing
from refine_addon.core.urls import Url
from tests.strategies import plain_header, plain_ply, splat_names
from tests.tiles import told_by_plan

ROOM = Path(__file__).parents[2] / "tests/data/room_small"
CLOSED = Settings(method="closed-form", views=8)
HALF = Budget(ratio=0.5)
NAMES = ("a.ply", "b.ply")


@pytest.fixture
def fsspec():
    """Give fsspec, with nothing in its memory, afterwards too."""
    fsspec = pytest.importorskip("fsspec")
    memory = fsspec.filesystem("memory")
    memory.rm("/", recursive=True) if memory.ls("/") else None
    yield fsspec
    memory.store.clear()
    memory.pseudo_dirs[:] = [""]


@pytest.fixture(scope="module")
def views():
    """Give the room's cameras."""
    return read_cameras(ROOM / "cameras.json")


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """Stand in a folder with two tiles; the second has elements before and after its splats."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(units, "ROWS", 100)
    told_by_plan(monkeypatch)
    random = np.random.default_rng(1)
    (tmp_path / "a.ply").write_bytes(plain_ply(130, seed=1))
    rows = random.normal(size=(170, len(splat_names(1)))).astype("<f4")
    whole = plain_header(170, splat_names(1))
    whole = whole.replace(b"element vertex", b"element cell 3\nproperty uchar id\nelement vertex")
    whole = whole.replace(b"end_header", b"element more 2\nproperty short id\nend_header")
    (tmp_path / "b.ply").write_bytes(whole + b"abc" + rows.tobytes() + b"more")
    return tmp_path


@pytest.fixture
def memory(fsspec, folder):
    """Give the file system in memory, with the two tiles."""
    system = fsspec.filesystem("memory")
    for name in NAMES:
        system.pipe_file(f"/in/{name}", (folder / name).read_bytes())
    return system


URLS = [f"memory://in/{name}" for name in NAMES]


def here(folder, views, settings=CLOSED, **options):
    """Return the bytes of the tiles pruned on the disk."""
    prune_tiles(NAMES, folder / "here", PruneRequest(views, HALF, settings, **options))
    return [(folder / "here" / name).read_bytes() for name in NAMES]


@pytest.mark.slow
@pytest.mark.parametrize("survivors", ["unchanged", "absorb"])
def test_behind_urls_the_same_bytes_are_written(folder, memory, views, survivors):
    """Tiles and folder are in memory; nothing else is left there, nor here."""
    settings = Settings(method="occlusion", views=4) if survivors == "absorb" else CLOSED
    report = prune_tiles(
        URLS, "memory://out/deep", PruneRequest(views, HALF, settings, survivors=survivors)
    )

    assert not list(folder.glob(".refine*"))
    assert sorted(memory.find("/out")) == [f"/out/deep/{name}" for name in NAMES]
    found = [memory.cat_file(f"/out/deep/{name}") for name in NAMES]
    assert found == here(folder, views, settings, survivors=survivors)
    assert [tile["input"] for tile in report["tiles"]] == URLS
    assert [tile["output"] for tile in report["tiles"]] == [
        f"memory://out/deep/{name}" for name in NAMES
    ]
    assert [tile["output_bytes"] for tile in report["tiles"]] == [*map(len, found)]


@pytest.mark.usefixtures("memory")
def test_paths_and_urls_go_together(folder, views):
    """One tile of each, written to the disk; the dry run tells the same bytes."""
    tiles = [NAMES[0], URLS[1]]
    told = prune_tiles(tiles, None, PruneRequest(views, HALF, CLOSED))
    prune_tiles(tiles, folder / "out", PruneRequest(views, HALF, CLOSED))

    found = [(folder / "out" / name).read_bytes() for name in NAMES]
    assert found == here(folder, views)
    assert [tile["output_bytes"] for tile in told["tiles"]] == [*map(len, found)]


def test_of_a_tile_no_more_than_its_rows_are_read(folder, memory, views, monkeypatch):
    """Once to score and once to write, and the header and what is beside the rows, once each.

    Looking at the tile fetches its first bytes besides; here that is all of it, so it is left out.
    """
    taken = []
    read = type(memory).cat_file

    def noting(self, path, *, start, end):  # by name, as storages have others between these
        taken.append(end - start)
        return read(self, path, start, end)

    monkeypatch.setattr(type(memory), "cat_file", noting)

    prune_tiles(URLS, folder / "out", PruneRequest(views, HALF, CLOSED))

    tiles = [units.tile_at(url) for url in URLS]
    rows = sum(tile.splats * tile.row_bytes for tile in tiles)
    once = 2 * rows + sum(tile.fixed_bytes + tile.header for tile in tiles)
    assert sum(taken) <= once
    assert max(taken) <= 100 * tiles[1].row_bytes


def test_files_there_are_replaced_only_when_told(memory, views):
    """Both or none: the second is there, so the first is not written."""
    memory.pipe_file("/out/b.ply", b"old")

    with pytest.raises(RefineError, match=r"^memory://out/b\.ply: exists already"):
        prune_tiles(URLS, "memory://out", PruneRequest(views, HALF, CLOSED))
    assert memory.find("/out") == ["/out/b.ply"]

    prune_tiles(URLS, "memory://out", PruneRequest(views, HALF, CLOSED, overwrite=True))
    assert memory.cat_file("/out/b.ply") != b"old"
    assert memory.find("/out") == ["/out/a.ply", "/out/b.ply"]


@pytest.mark.usefixtures("memory")
def test_what_is_read_is_not_replaced(folder, views):
    """However it is called: by the same URL, or as a path here and a URL of a link there."""
    (folder / "link").symlink_to(folder)
    with pytest.raises(RefineError, match=r"memory:///in/a\.ply: is read until all"):
        prune_tiles(URLS, "memory:///in", PruneRequest(views, HALF, CLOSED, overwrite=True))
    with pytest.raises(RefineError, match=r"a\.ply: is read until all"):
        prune_tiles(
            NAMES, f"file://{folder}/link", PruneRequest(views, HALF, CLOSED, overwrite=True)
        )


def test_a_tile_that_changes_meanwhile_stops_all(folder, memory, views):
    """Its bytes and size stay, the time does not; nothing is left here or there."""

    def progress(fraction, _what):
        if fraction > 0.5:
            memory.pipe_file("/in/b.ply", memory.cat_file("/in/b.ply"))

    with pytest.raises(RefineError, match=r"^memory://in/b\.ply: was changed while it was worked"):
        prune_tiles(URLS, "memory://out", PruneRequest(views, HALF, CLOSED), progress=progress)

    assert memory.find("/out") == []
    assert not list(folder.glob(".refine*"))


def test_a_storage_that_fails_leaves_what_is_done(folder, memory, views, monkeypatch):
    """The second upload fails; the same call then reads and writes no tile again."""
    put, sent = type(memory).put_file, []

    def failing(self, source, target, **options):
        sent.append(target)
        if len(sent) == 2:
            raise ConnectionError("the line is dead")
        return put(self, source, target, **options)

    monkeypatch.setattr(type(memory), "put_file", failing)
    with pytest.raises(
        RefineError, match=r"000001: cannot be written \(the line is dead\); the same command goes"
    ):
        prune_tiles(URLS, "memory://out", PruneRequest(views, HALF, CLOSED))
    assert len(memory.find("/out")) == 1

    with monkeypatch.context() as patched:
        patched.setattr(writing, "rows_of", None)
        prune_tiles(URLS, "memory://out", PruneRequest(views, HALF, CLOSED))
    assert [Path(path).name[-6:] for path in sent] == ["000000", "000001", "000001"]
    assert memory.find("/out") == ["/out/a.ply", "/out/b.ply"]
    assert [memory.cat_file(f"/out/{name}") for name in NAMES] == here(folder, views)


def test_a_storage_that_cannot_be_written_to_is_known_at_once(memory, views, monkeypatch):
    """Before anything is scored."""

    def refused(_self, _path, _value, **_options):
        raise PermissionError("read-only")

    monkeypatch.setattr(type(memory), "pipe_file", refused)
    monkeypatch.setattr(units.Unit, "take", None)

    with pytest.raises(RefineError, match=r"^memory://out: cannot be written to \(read-only\)$"):
        prune_tiles(URLS, "memory://out", PruneRequest(views, HALF, CLOSED))


ASCII = plain_header(1, splat_names(0), "ascii") + b"0 " * 17 + b"\n"
LISTS = plain_ply(1).replace(
    b"element vertex", b"element face 1\nproperty list uchar int i\nelement vertex"
)


@pytest.mark.parametrize(
    ("content", "words"),
    [
        (None, r"cannot be read \(there is no such file\)"),
        (b"", "the file is empty"),
        (b"ply\nformat", "header without end"),
        (plain_ply(9)[:-1], r"truncated: .* announces 9 rows of 'vertex'"),
        (b"NGSP1234", "an SPZ file: 'refine convert"),
        (ASCII, "is ascii 1.0, expected a plain binary PLY as a tile"),
        (LISTS, "has lists before the splats, expected none"),
    ],
    ids=["missing", "empty", "header", "truncated", "spz", "text", "lists"],
)
def test_what_is_no_tile_is_named_by_its_url(memory, views, content, words):
    """The message begins with the URL as it was given."""
    if content is not None:
        memory.pipe_file("/in/b.ply", content)
    else:
        memory.rm_file("/in/b.ply")

    with pytest.raises(RefineError, match=rf"^memory://in/b\.ply: {words}"):
        prune_tiles(URLS, "memory://out", PruneRequest(views, HALF, CLOSED))


def test_a_storage_that_only_sends_whole_files_is_refused(memory, monkeypatch):
    """As a server without ranges: what it sends can be read, but not from the middle."""

    class Stream(io.BytesIO):
        def seek(self, place, _whence=0):
            if place:
                raise ValueError("no ranges")

    opened = Stream(memory.cat_file("/in/a.ply"))
    monkeypatch.setattr(type(memory), "open", lambda *_given, **_options: opened)

    with pytest.raises(RefineError, match=r"^memory://in/a\.ply: cannot be read \(no ranges\)$"):
        units.tile_at(URLS[0])


def test_a_long_header_is_read_whole(memory):
    """A header of 100 kB, of which the first bytes fetched hold only a part."""
    header = plain_header(1, splat_names(0)).replace(b"element", b"comment " * 12500 + b"\nelement")
    memory.pipe_file("/long.ply", header + b"\0" * 68)

    tile = units.tile_at("memory://long.ply")

    assert (tile.splats, tile.begin, tile.size) == (1, len(header), len(header) + 68)


@pytest.mark.usefixtures("memory")
@pytest.mark.parametrize(
    ("url", "words"),
    [
        ("nowhere://in/a.ply", "Protocol not known: nowhere"),
        ("lacking://in/a.ply", "Install lacking to use it"),
        ("memory://in", "is a folder, expected a PLY file"),
    ],
)
def test_urls_that_cannot_be_opened_are_named(monkeypatch, url, words):
    """A scheme nobody knows, one whose package is not installed, and a folder."""
    needs = {"class": "refine_lacking.System", "err": "Install lacking to use it"}
    known = sys.modules["fsspec.registry"].known_implementations
    monkeypatch.setitem(known, "lacking", needs)

    with pytest.raises(RefineError, match=rf"^{url}: .*{words}"):
        units.tile_at(url)


def test_without_fsspec_the_extra_is_named(folder, views, monkeypatch):
    """Paths need none."""
    monkeypatch.setitem(sys.modules, "fsspec.core", None)

    needed = r": URLs need fsspec: pip install 'refine-addon\[distributed\]'"
    with pytest.raises(RefineError, match=rf"^memory://in/a\.ply{needed}"):
        prune_tiles(URLS, None, PruneRequest(views, HALF, CLOSED))
    with pytest.raises(RefineError, match=rf"^memory://out{needed}"):
        prune_tiles(NAMES, "memory://out", PruneRequest(views, HALF, CLOSED))
    assert here(folder, views)


@pytest.mark.parametrize(
    ("url", "name", "suffix"),
    [
        ("s3://bucket/deep/a.ply", "a.ply", ".ply"),
        ("https://host/a.ply?key=1/2.x", "a.ply", ".ply"),
        ("https://host/", "", ""),
        ("memory://a?b.ply", "a?b.ply", ".ply"),
    ],
)
def test_a_url_has_a_name(url, name, suffix):
    """What is behind the last slash; a query is part of it only where it is none."""
    assert (Url(url).name, Url(url).suffix) == (name, suffix)


def test_what_is_a_url_and_what_a_path():
    """A drive of Windows has one letter; a slash less makes a path; folders end with a slash."""
    assert isinstance(storage.located("C://a.ply"), Path)
    assert isinstance(storage.located("s3:/a.ply"), Path)
    assert isinstance(storage.located("simplecache::s3://a.ply"), Url)
    assert Url("memory://") / "a" == Url("memory://a")
    assert Url("memory://a") / "b" == Url("memory://a/b")


class Server(BaseHTTPRequestHandler):
    """Serves files of the directory, by ranges unless told otherwise."""

    ranges = True
    sent: list[int]

    def do_HEAD(self):
        """Say how long a file is."""
        self._answer(body=False)

    def do_GET(self):
        """Send a file or a part of it."""
        self._answer(body=True)

    def _answer(self, *, body):
        path = Path(self.path[1:])
        if not path.exists():
            self.send_error(404)
            return
        content, code = path.read_bytes(), 200
        size = len(content)
        found = re.fullmatch(r"bytes=(\d+)-(\d+)", self.headers.get("Range", ""))
        if found and self.ranges:
            start, last = map(int, found.groups())
            content, code = content[start : last + 1], 206
        self.send_response(code)
        if code == 206:
            self.send_header("Content-Range", f"bytes {start}-{last}/{size}")
        self.send_header("Content-Length", str(len(content)))
        self.send_header("ETag", str(path.stat().st_mtime_ns))
        self.end_headers()
        if body:
            self.sent.append(len(content))
            self.wfile.write(content)

    def log_message(self, *_words):
        """Say nothing."""


@pytest.fixture
def server(fsspec):
    """Serve the current directory; give the server, which has its address."""
    pytest.importorskip("aiohttp", reason="fsspec opens http:// by aiohttp")
    handler = type("Handler", (Server,), {"sent": []})
    with ThreadingHTTPServer(("127.0.0.1", 0), handler) as server:
        threading.Thread(target=server.serve_forever, daemon=True).start()
        server.address = f"http://127.0.0.1:{server.server_port}"
        yield server
        server.shutdown()
        fsspec.asyn.reset_lock()


@pytest.mark.slow
@pytest.mark.filterwarnings("default")
def test_a_server_sends_ranges(folder, server, views):
    """The same bytes as from the disk; nobody can write there."""
    urls = [f"{server.address}/{name}" for name in NAMES]

    prune_tiles(urls, folder / "out", PruneRequest(views, HALF, CLOSED))

    assert [(folder / "out" / name).read_bytes() for name in NAMES] == here(folder, views)
    with pytest.raises(RefineError, match=r"^http://.*/out: cannot be written to \("):
        prune_tiles(urls, f"{server.address}/out", PruneRequest(views, HALF, CLOSED))
    tile = units.tile_at(urls[0])
    (folder / "a.ply").write_bytes(plain_ply(130, seed=2))
    with pytest.raises(RefineError, match=r"^http://.*/a\.ply: was changed"):
        units.header_of(tile)


@pytest.mark.filterwarnings("default")
def test_a_server_that_only_sends_whole_files_is_refused(folder, server):
    """It is noticed by the last byte: of a large file only the beginning would have been sent."""
    (folder / "large.ply").write_bytes(plain_ply(2000))
    server.RequestHandlerClass.ranges = False

    with pytest.raises(RefineError, match=r"large\.ply: cannot be read \(.*range requests"):
        units.tile_at(f"{server.address}/large.ply")


def call(*words):
    """Run the command with cameras, and return its exit code."""
    return main([*words, "--cameras", str(ROOM / "cameras.json")])


def test_the_command_takes_urls_for_tiles(folder, memory, views, capsys):
    """And says the name of each tile."""
    options = ["--together", "--method", "closed-form", "--views", "8"]
    options += ["--output-dir", "memory://out", "--report", "told.json"]

    assert call("prune", *URLS, *options) == 0

    assert [memory.cat_file(f"/out/{name}") for name in NAMES] == here(folder, views)
    assert "  b.ply: " in capsys.readouterr().out
    (told,) = json.loads((folder / "told.json").read_text())["results"]
    assert told["files"]["output"] == "memory://out"


@pytest.mark.parametrize(
    "words",
    [
        ["prune", "s3://in/a.ply", "--output-dir", "out"],
        ["prune", "a.ply", "--output-dir", "s3://out"],
        ["prune", "a.ply", "-o", "s3://out/a.ply"],
        ["clean", "s3://in/a.ply"],
        ["clean", "a.ply", "--output-dir", "s3://out"],
        ["score", "s3://in/a.ply", "-o", "out.ply"],
        ["lod", "a.ply", "-o", "s3://out"],
        ["prune", "a.ply", "--together", "--output-dir", "out", "--report", "s3://out/told.json"],
    ],
    ids=" ".join,
)
def test_elsewhere_a_url_is_wrong_usage(folder, capsys, words):
    """Exit code 2; it is not taken for a path, so no folder of its name is made."""
    assert call(*words) == 2

    assert re.search(r"s3://\S+: is a URL, expected a local path", capsys.readouterr().err)
    assert sorted(path.name for path in folder.iterdir()) == [*NAMES]


@pytest.mark.parametrize("words", [["info", "s3://a.ply"], ["convert", "a.ply", "s3://b.spz"]])
def test_commands_without_cameras_refuse_urls_too(capsys, words):
    """Exit code 2."""
    assert main(words) == 2
    assert "is a URL, expected a local path" in capsys.readouterr().err


def test_only_a_ply_is_made_behind_a_url(folder, memory, capsys):
    """What is there cannot be looked into to see that it holds splats."""
    memory.pipe_file("/in/cameras", (folder / "a.ply").read_bytes())

    words = ["memory://in/cameras", "--together", "--output-dir", "memory://out"]
    assert call("prune", *words) == 2
    assert "memory://out/cameras: expected a name that ends in .ply" in capsys.readouterr().err


def test_functions_for_one_file_refuse_urls():
    """As the command does."""
    with pytest.raises(RefineError, match=r"^s3://in/a\.ply: is a URL, expected a local path"):
        read_splats("s3://in/a.ply")
