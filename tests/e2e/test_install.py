"""The zip installs from its file, brings what it needs, and leaves nothing behind when disabled."""

from __future__ import annotations

import zipfile
from pathlib import Path

import pytest
from blenders import MANIFEST, PROJECT, Binary, Blender


def test_the_zip_holds_the_package_and_nothing_else(extension_zip: Path):
    """Manifest, wheels, license, modules and type marker: no tests, no caches.

    A compiled wheel would be for one Python; Blender goes from 3.11 to 3.14.
    """
    package = PROJECT / "refine_addon"
    modules = {path.relative_to(package).as_posix() for path in package.rglob("*.py")}
    wheels = {entry.removeprefix("./") for entry in MANIFEST["wheels"]}

    with zipfile.ZipFile(extension_zip) as archive:
        names = set(archive.namelist())

    assert extension_zip.name == f"refine_addon-{MANIFEST['version']}.zip"
    assert names == modules | wheels | {"LICENSE", "blender_manifest.toml", "py.typed"}
    assert all(wheel.endswith("-py3-none-any.whl") for wheel in wheels)


def test_blender_validates_builds_installs_and_removes_the_zip(
    fresh_binary: Binary, extension_zip: Path
):
    """A real Blender packs the files that the script out of the bpy wheel packs.

    After `install-file --enable` the command `refine` is there, after `remove` it is not.
    """

    def extension(*words: str | Path) -> None:
        done = fresh_binary.blender("--command", "extension", *words)
        assert done.returncode == 0, done.stdout + done.stderr

    def commands() -> list[str]:
        return fresh_binary.blender("--command", "help").stdout.split()

    stage = extension_zip.parent / "stage" / MANIFEST["id"]
    built = fresh_binary.work / "built.zip"
    extension("validate", extension_zip)
    extension("build", f"--source-dir={stage}", f"--output-filepath={built}")
    with zipfile.ZipFile(extension_zip) as ours, zipfile.ZipFile(built) as theirs:
        packed, expected = (
            {entry.filename: entry.CRC for entry in archive.infolist()}
            for archive in (theirs, ours)
        )
    assert packed == expected

    extension("install-file", "--repo", "user_default", "--enable", extension_zip)
    assert "refine" in commands()
    extension("remove", MANIFEST["id"])
    assert "refine" not in commands()


def test_a_missing_zip_does_not_count_as_installed(fresh_binary: Binary):
    """Blender reports FINISHED for it; the step that all tests stand on must not believe that."""
    with pytest.raises(AssertionError, match="is not enabled"):
        fresh_binary.step("install", archive=fresh_binary.work / "missing.zip")


def test_enabling_and_disabling_twice_leaves_nothing_behind(blender: Blender):
    """What is registered after disabling is what there was before, the second time too."""
    before, enabled, disabled, again, at_last = map(set, blender.step("registration"))

    added = enabled - before
    assert {"operator refine.score", "property Scene.refine", "command refine"} <= added
    own = ("refine", "select splats:")  # a key of our tools may call an operator of Blender's
    assert [line for line in added if not any(name in line.lower() for name in own)] == []
    assert disabled ^ before == set()
    assert again ^ enabled == set()
    assert at_last ^ before == set()
