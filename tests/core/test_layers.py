"""Imports in the package have no circles, those for types included (docs/architecture.md).

What is packaged: everything, with its types.
"""

import ast
import subprocess
import sys
from graphlib import TopologicalSorter

import pytest

from tests.places import ROOT

PACKAGE = ROOT / "refine_addon"
MODULES = {
    ".".join(path.relative_to(PACKAGE).with_suffix("").parts).removesuffix("__init__").strip("."): (
        path
    )
    for path in PACKAGE.rglob("*.py")
}


def imported(name, path):
    """Return the modules of the package that one imports, anywhere in it."""
    parts = name.split(".") if name else []
    package = parts if path.name == "__init__.py" else parts[:-1]
    found = set()
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.ImportFrom) and node.level:
            start = package[: len(package) - node.level + 1]
            module = ".".join([*start, *(node.module or "").split(".")]).strip(".")
            for alias in node.names:
                inner = f"{module}.{alias.name}".strip(".")
                found.add(inner if inner in MODULES else module)
    return found & set(MODULES) - {name}


IMPORTS = {name: imported(name, path) for name, path in MODULES.items()}


def room(name):
    """Return the folder of a module, or the module where it lies in no room of its own."""
    parts = name.split(".")
    depth = 2 if parts[0] == "core" else 1
    return ".".join(parts[:depth])


ROOMS: dict[str, set[str]] = {}
for _name, _others in IMPORTS.items():
    ROOMS.setdefault(room(_name), set()).update({room(other) for other in _others} - {room(_name)})


@pytest.mark.parametrize("graph", [IMPORTS, ROOMS], ids=["modules", "rooms"])
def test_imports_have_no_circle(graph):
    assert len(graph) > 1
    TopologicalSorter(graph).prepare()  # else it raises, and names the circle


def test_nothing_in_core_imports_what_needs_blender():
    """`ui`, `objects`, `mesh` and the others stand on core, not beside it."""
    outside = {
        other
        for name, others in IMPORTS.items()
        for other in others
        if room(name).startswith("core") and not room(other).startswith("core")
    }
    assert outside <= {"version"}


def test_every_module_of_core_is_imported_where_there_is_no_blender():
    """None in `sys.modules` makes an import fail, as where nothing is installed."""
    code = """
import importlib, sys
sys.modules.update(dict.fromkeys(["bpy", "bmesh", "mathutils", "gpu", "gpu_extras", "blf"]))
for name in sys.argv[1:]:
    importlib.import_module("refine_addon." + name)
"""
    core = [name for name in MODULES if name.split(".")[0] == "core"]
    assert len(core) > 50
    subprocess.run([sys.executable, "-c", code, *core], check=True, cwd=PACKAGE.parent)


def test_every_folder_of_modules_is_a_package_with_types():
    """Setuptools leaves out those without ``__init__.py``; PEP 561 asks for ``py.typed``."""
    folders = {path.parent for path in MODULES.values()}
    assert len(folders) > 5
    assert [folder for folder in folders if not (folder / "__init__.py").is_file()] == []
    assert (PACKAGE / "py.typed").is_file()
