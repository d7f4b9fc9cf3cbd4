"""What is packaged: everything, with its types."""

from __future__ import annotations

from pathlib import Path

PACKAGE = Path(__file__).parents[2] / "refine_addon"


def test_every_folder_of_modules_is_a_package():
    """Setuptools finds those with an ``__init__.py`` and would leave others out in silence."""
    folders = {path.parent for path in PACKAGE.rglob("*.py")}

    assert len(folders) > 5
    assert [folder for folder in folders if not (folder / "__init__.py").is_file()] == []


def test_types_are_announced():
    """Without ``py.typed`` type checkers take an installed package for untyped (PEP 561)."""
    assert (PACKAGE / "py.typed").is_file()
