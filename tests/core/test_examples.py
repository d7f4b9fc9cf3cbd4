"""Examples in docstrings give what they promise, and what the documents tell to run runs."""

from __future__ import annotations

import doctest
import importlib
import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from refine_addon.core import read_ply
from refine_addon.core.formats.ply import with_count
from tests.examples import blocks, modules_with_examples

ROOT = Path(__file__).parents[2]
ROOM = ROOT / "tests/data/room_small"
DOCUMENTS = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *sorted((ROOT / "docs").glob("*.md"))]
SNIPPETS = [
    block
    for document in DOCUMENTS
    for block in blocks(document)
    if block.language in ("sh", "python")
]


@pytest.mark.parametrize(
    "name", modules_with_examples(ROOT / "refine_addon/core", "refine_addon.core")
)
def test_examples_in_docstrings_give_what_they_promise(name):
    """To the last digit that is written."""
    result = doctest.testmod(importlib.import_module(name))

    assert result.attempted > 0
    assert result.failed == 0


@pytest.fixture
def folder(tmp_path):
    """Give a folder with what the documents call in.ply, every eighth splat, and cameras.json."""
    file = read_ply(ROOM / "point_cloud.ply")
    rows = file.rows[::8]
    (tmp_path / "in.ply").write_bytes(with_count(file.header, len(rows)) + rows.tobytes())
    shutil.copy(ROOM / "cameras.json", tmp_path)
    return tmp_path


@pytest.mark.slow
@pytest.mark.parametrize(
    "block", [pytest.param(block, id=block.place) for block in SNIPPETS if not block.excused]
)
def test_what_the_documents_tell_to_run_runs(block, folder):
    """In a folder with splats of the committed scene, by this interpreter, to the end."""
    paths = [str(Path(sys.executable).parent), os.environ["PATH"]]
    run = {"sh": ["sh", "-eu", "-c"], "python": [sys.executable, "-c"]}[block.language]
    environment = {**os.environ, "PATH": os.pathsep.join(paths), "PYTHONPATH": str(ROOT)}

    done = subprocess.run(
        [*run, block.text], cwd=folder, env=environment, capture_output=True, text=True, check=False
    )

    assert done.returncode == 0, done.stdout + done.stderr


def test_no_fenced_block_is_overlooked():
    """Each fence has its other half at the start of a line, and some blocks do run."""
    for document in DOCUMENTS:
        assert document.read_text(encoding="utf-8").count("```") == 2 * len(blocks(document))
    assert sum(not block.excused for block in SNIPPETS) >= 2
