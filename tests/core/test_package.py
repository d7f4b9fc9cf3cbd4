"""What is packaged: everything, with its types."""

from __future__ import annotations

import re
import tomllib
from pathlib import Path

import plyfile

PACKAGE = Path(__file__).parents[2] / "refine_addon"


def test_every_folder_of_modules_is_a_package():
    """Setuptools finds those with an ``__init__.py`` and would leave others out in silence."""
    folders = {path.parent for path in PACKAGE.rglob("*.py")}

    assert len(folders) > 5
    assert [folder for folder in folders if not (folder / "__init__.py").is_file()] == []


def test_types_are_announced():
    """Without ``py.typed`` type checkers take an installed package for untyped (PEP 561)."""
    assert (PACKAGE / "py.typed").is_file()


def test_the_manifest_names_who_holds_the_rights_to_plyfile():
    """The zip carries its wheel; the holder is whom the first line of its source names."""
    manifest = tomllib.loads((PACKAGE.parent / "blender_manifest.toml").read_text("utf-8"))
    first = Path(plyfile.__file__).read_text("utf-8").split("\n", maxsplit=1)[0]
    holder = re.search(r"Copyright [\d-]+ (.+?)\.?$", first)[1]

    assert any(holder in line for line in manifest["copyright"])
    assert manifest["website"].startswith("https://")
