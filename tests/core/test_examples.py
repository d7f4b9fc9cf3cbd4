"""Examples in docstrings give what they promise, and what the documents tell to run runs."""

import os
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from refine_addon.core import read_ply
from tests.examples import blocks, broken_promises
from tests.places import ROOM, ROOT

DOCUMENTS = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *sorted((ROOT / "docs").glob("*.md"))]
SNIPPETS = [
    pytest.param(block, id=block.place)
    for document in DOCUMENTS
    for block in blocks(document)
    if block.language in ("sh", "python") and not block.excused
]


def test_examples_in_docstrings_give_what_they_promise():
    """To the last digit that is written."""
    assert broken_promises(ROOT / "refine_addon/core", "refine_addon.core") == []


@pytest.fixture
def folder(tmp_path):
    """Give a folder with what the documents call in.ply, every 100th splat, and cameras.json."""
    file = read_ply(ROOM / "point_cloud.ply")
    file.write(tmp_path / "in.ply", np.arange(len(file)) % 100 == 0)
    shutil.copy(ROOM / "cameras.json", tmp_path)
    return tmp_path


@pytest.mark.slow
@pytest.mark.parametrize("block", SNIPPETS)
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
    assert len(SNIPPETS) >= 2
