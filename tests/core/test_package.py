"""What is packaged: everything, with its types."""

from pathlib import Path

PACKAGE = Path(__file__).parents[2] / "refine_addon"


def test_every_folder_of_modules_is_a_package_with_types():
    """Setuptools leaves out those without ``__init__.py``; PEP 561 asks for ``py.typed``."""
    folders = {path.parent for path in PACKAGE.rglob("*.py")}

    assert len(folders) > 5
    assert [folder for folder in folders if not (folder / "__init__.py").is_file()] == []
    assert (PACKAGE / "py.typed").is_file()
