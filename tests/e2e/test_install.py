"""The zip installs from its file, brings what it needs, and leaves nothing behind when disabled."""

from __future__ import annotations

import tomllib
import zipfile
from pathlib import Path

import pytest
from blenders import PROJECT, Binary, Blender

MANIFEST = tomllib.loads((PROJECT / "blender_manifest.toml").read_text(encoding="utf-8"))


def test_zip_holds_the_package_and_nothing_else(extension_zip: Path):
    """Manifest, wheels, license, the package's modules and type marker: no tests, no caches."""
    package = PROJECT / "refine_addon"
    modules = {path.relative_to(package).as_posix() for path in package.rglob("*.py")}
    wheels = {entry.removeprefix("./") for entry in MANIFEST["wheels"]}
    license_text = {path.name for path in PROJECT.glob("LICENSE")}

    with zipfile.ZipFile(extension_zip) as archive:
        names = set(archive.namelist())

    assert names == modules | wheels | license_text | {"blender_manifest.toml", "py.typed"}


def test_zip_is_named_after_the_manifest(extension_zip: Path):
    assert extension_zip.name == f"refine_addon-{MANIFEST['version']}.zip"


def test_wheels_fit_every_python(extension_zip: Path):
    """A compiled wheel is for one Python; Blender goes from 3.11 to 3.14."""
    with zipfile.ZipFile(extension_zip) as archive:
        wheels = [name for name in archive.namelist() if name.endswith(".whl")]

    assert wheels
    assert [name for name in wheels if not name.endswith("-py3-none-any.whl")] == []


def test_blender_validates_the_zip(fresh_binary: Binary, extension_zip: Path):
    done = fresh_binary.blender("--command", "extension", "validate", extension_zip)

    assert done.returncode == 0, done.stdout + done.stderr


def test_blender_builds_the_same_zip(fresh_binary: Binary, extension_zip: Path):
    """The script out of the bpy wheel packs the files that a real Blender packs."""
    stage = extension_zip.parent / "stage" / MANIFEST["id"]
    target = fresh_binary.work / "built.zip"

    done = fresh_binary.blender(
        *("--command", "extension", "build"),
        *(f"--source-dir={stage}", f"--output-filepath={target}"),
    )

    assert done.returncode == 0, done.stdout + done.stderr
    with zipfile.ZipFile(extension_zip) as ours, zipfile.ZipFile(target) as theirs:
        assert {entry.filename: entry.CRC for entry in theirs.infolist()} == {
            entry.filename: entry.CRC for entry in ours.infolist()
        }


def test_command_line_installs_and_removes_the_zip(fresh_binary: Binary, extension_zip: Path):
    """After `install-file --enable` the command `refine` is there, after `remove` it is not."""
    extension = ("--command", "extension")

    installed = fresh_binary.blender(
        *extension, "install-file", "--repo", "user_default", "--enable", extension_zip
    )
    listed = fresh_binary.blender("--command", "help")
    removed = fresh_binary.blender(*extension, "remove", MANIFEST["id"])
    listed_after = fresh_binary.blender("--command", "help")

    assert installed.returncode == 0, installed.stdout + installed.stderr
    assert "refine" in listed.stdout.split()
    assert removed.returncode == 0, removed.stdout + removed.stderr
    assert "refine" not in listed_after.stdout.split()


def test_everything_is_loaded_from_the_zip(blender: Blender):
    """Neither the checkout nor a plyfile of the machine is what the other tests test."""
    origins = blender.step("origins")

    places = [Path(origins["extension"]), Path(origins["plyfile"])]
    assert [place for place in places if not place.is_relative_to(blender.resources)] == []
    assert f"./wheels/plyfile-{origins['plyfile_version']}-py3-none-any.whl" in MANIFEST["wheels"]


def test_a_missing_zip_does_not_count_as_installed(fresh_binary: Binary):
    """Blender reports FINISHED for it; the step that all tests stand on must not believe that."""
    with pytest.raises(AssertionError, match="is not enabled"):
        fresh_binary.step("install", archive=fresh_binary.work / "missing.zip")


def test_enabling_and_disabling_twice_leaves_nothing_behind(blender: Blender):
    """What is registered after disabling is what there was before, the second time too."""
    found = {when: set(lines) for when, lines in blender.step("registration").items()}

    added = found["enabled"] - found["before"]
    assert {"operator refine.score", "property Scene.refine", "command refine"} <= added
    own = ("refine", "select splats:")  # a key of our tools may call an operator of Blender's
    assert [line for line in added if not any(name in line.lower() for name in own)] == []
    assert found["disabled"] ^ found["before"] == set()
    assert found["enabled again"] ^ found["enabled"] == set()
    assert found["disabled again"] ^ found["before"] == set()
