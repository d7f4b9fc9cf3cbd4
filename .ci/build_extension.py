"""Build the installable extension: `build/refine_addon-VERSION.zip`.

Stages the package, the manifest and the manifest's wheels in `build/stage/refine_addon/` (Blender's
builder wants `__init__.py` beside the manifest), then has Blender's own tool validate the folder,
build the zip and validate that. The tool is a plain Python script which the `bpy` wheel carries, so
no Blender binary is needed; with `--blender PATH` a binary does the same. Prints the zip's path.

    python .ci/build_extension.py
    python .ci/build_extension.py --blender /path/to/blender
"""

from __future__ import annotations

import argparse
import hashlib
import importlib.util
import shutil
import subprocess
import sys
import tomllib
from pathlib import Path
from typing import Any

PROJECT = Path(__file__).resolve().parent.parent
BUILD = PROJECT / "build"
MANIFEST = PROJECT / "blender_manifest.toml"
PACKAGE = PROJECT / "refine_addon"

# What the extension brings along is pinned to its content, wherever pip finds it.
WHEEL_SHA256 = {
    "plyfile-1.1.3-py3-none-any.whl": (
        "581302f07b1c298431dcaa9038bba2ae80f3f7868b29ccb826a07bc4488ff38a"
    ),
}

TAGS = "scripts/modules/_bpy_internal/extensions/tags.py"
EXTENSION_TOOL = "scripts/addons_core/bl_pkg/cli/blender_ext.py"


class BuildError(Exception):
    """The extension cannot be built; the message says why and what would help."""


def fetch_wheel(name: str) -> Path:
    """Return the named wheel in `build/wheels`, downloaded by pip where it is not there yet.

    Parameters
    ----------
    name : str
        The wheel's file name, one of `WHEEL_SHA256`.

    Returns
    -------
    Path
        The wheel.

    Raises
    ------
    BuildError
        If it is unknown, cannot be downloaded or is not the file that was pinned.
    """
    if name not in WHEEL_SHA256:
        raise BuildError(
            f"{MANIFEST.name} names {name}, and {Path(__file__).name} has no SHA-256 for it"
        )
    wheel = BUILD / "wheels" / name
    if not wheel.exists():
        project, version = name.split("-")[:2]
        command = [sys.executable, "-m", "pip", "download", "--quiet", "--no-deps"]
        command += ["--only-binary=:all:", f"--dest={wheel.parent}", f"{project}=={version}"]
        run(command)
    found = hashlib.sha256(wheel.read_bytes()).hexdigest()
    if found != WHEEL_SHA256[name]:
        raise BuildError(f"{wheel} has SHA-256 {found}, expected {WHEEL_SHA256[name]}")
    return wheel


def run(command: list[str]) -> None:
    """Run a command, its output on stderr, and raise `BuildError` where it fails."""
    done = subprocess.run(
        command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, check=False
    )
    print(done.stdout, end="", file=sys.stderr)
    if done.returncode != 0:
        raise BuildError(f"exit code {done.returncode}: {' '.join(command)}")


def stage(manifest: dict[str, Any]) -> Path:
    """Lay out the extension's folder as Blender's builder wants it.

    Parameters
    ----------
    manifest : dict
        The parsed `blender_manifest.toml`.

    Returns
    -------
    Path
        The folder, made anew.
    """
    folder = BUILD / "stage" / str(manifest["id"])
    if folder.exists():
        shutil.rmtree(folder)
    shutil.copytree(PACKAGE, folder, ignore=shutil.ignore_patterns("__pycache__", "*.pyc", ".*"))
    shutil.copy2(MANIFEST, folder)
    if (license_text := PROJECT / "LICENSE").exists():
        shutil.copy2(license_text, folder)
    for entry in manifest.get("wheels", ()):
        target = folder / entry
        target.parent.mkdir(exist_ok=True)
        shutil.copy2(fetch_wheel(target.name), target)
    return folder


def extension_tool(blender: str | None) -> tuple[list[str], list[str]]:
    """Find Blender's tool for extensions.

    Parameters
    ----------
    blender : str, optional
        A Blender binary; without it the tool inside the installed `bpy` wheel.

    Returns
    -------
    list of str
        The command line up to the subcommand.
    list of str
        Options that its subcommands need.

    Raises
    ------
    BuildError
        If neither is there.
    """
    if blender:
        return [blender, "--factory-startup", "--command", "extension"], []
    spec = importlib.util.find_spec("bpy")
    for place in (spec and spec.submodule_search_locations) or ():
        for script in Path(place).glob(f"*/{EXTENSION_TOOL}"):
            # Only Blender itself fills in the list of tags that extensions.blender.org allows.
            tags = script.parents[4] / TAGS
            return [sys.executable, str(script)], [f"--valid-tags={tags}"]
    raise BuildError("no Blender: pip install bpy==4.5.15 (Python 3.11), or give --blender PATH")


def build(blender: str | None = None) -> Path:
    """Stage, validate and build the extension.

    Parameters
    ----------
    blender : str, optional
        A Blender binary, else the `bpy` wheel's tool is used.

    Returns
    -------
    Path
        The zip.

    Raises
    ------
    BuildError
        If a step fails.
    """
    manifest = tomllib.loads(MANIFEST.read_text(encoding="utf-8"))
    archive = BUILD / f"{manifest['id']}-{manifest['version']}.zip"
    tool, options = extension_tool(blender)
    folder = stage(manifest)
    run([*tool, "validate", *options, str(folder)])
    run([*tool, "build", *options, f"--source-dir={folder}", f"--output-filepath={archive}"])
    run([*tool, "validate", *options, str(archive)])
    return archive


def main() -> int:
    """Build the extension and print the zip's path.

    Returns
    -------
    int
        0, or 1 where it cannot be built.
    """
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--blender", metavar="PATH", help="a Blender binary to build with")
    try:
        archive = build(parser.parse_args().blender)
    except BuildError as error:
        print(f"build_extension: {error}", file=sys.stderr)
        return 1
    print(archive)
    return 0


if __name__ == "__main__":
    sys.exit(main())
