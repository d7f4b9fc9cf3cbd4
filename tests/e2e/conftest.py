"""Fixtures for the tests against real Blenders.

A Blender that cannot be had on this machine is skipped with the reason. Where it has to be had
(continuous integration), name it in REFINE_E2E_REQUIRE, for example "trixie bpy-4.5.15": then its
absence fails.
"""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

# The harness and the tools it stands on are modules of the tests, not of the package.
sys.path[:0] = [str(Path(__file__).parent), str(Path(__file__).parents[2] / ".ci")]

from blenders import BINARIES, MODULES, PROJECT, Binary, Blender, Module, provide, without_blender

PICTURES = PROJECT / "build" / "e2e"
SCENE = PROJECT / "tests" / "data" / "room_small"


@pytest.fixture(scope="session")
def extension_zip() -> Path:
    """Give the extension, built from this checkout as `make build` does it."""
    build = [sys.executable, PROJECT / ".ci" / "build_extension.py"]
    done = subprocess.run(build, capture_output=True, text=True, check=False)
    if done.returncode != 0:
        pytest.fail(f"the extension does not build:\n{done.stdout}{done.stderr}", pytrace=False)
    return Path(done.stdout.strip())


def have(name: str, work: Path, resources: Path) -> Blender:
    """Return the named Blender, or skip the test with the reason."""
    path, reason = provide(name)
    if path is None:
        if name in os.environ.get("REFINE_E2E_REQUIRE", "").split():
            pytest.fail(reason, pytrace=False)
        pytest.skip(reason)
    kind = Binary if name in BINARIES else Module
    resources.mkdir(parents=True, exist_ok=True)
    return kind(name, path, work, resources)


@pytest.fixture(scope="session")
def installed(extension_zip: Path, tmp_path_factory: pytest.TempPathFactory):
    """Give a function: name of a Blender -> resources in which the zip was installed, once."""
    made: dict[str, Path] = {}

    def resources(name: str) -> Path:
        if name not in made:
            work = tmp_path_factory.mktemp(name)
            shutil.copy(extension_zip, work)
            blender = have(name, work, work / "resources")
            blender.step("install", archive=work / extension_zip.name)
            made[name] = blender.resources
        return made[name]

    return resources


@pytest.fixture(params=BINARIES)
def fresh_binary(request: pytest.FixtureRequest, tmp_path: Path) -> Iterator[Blender]:
    """Give a real Blender without the extension."""
    yield from ready(request.param, tmp_path)


@pytest.fixture(params=MODULES + BINARIES)
def blender(request: pytest.FixtureRequest, tmp_path: Path, installed) -> Iterator[Blender]:
    """Give a Blender of either kind with the extension installed and enabled."""
    yield from ready(request.param, tmp_path, installed)


@pytest.fixture(params=BINARIES)
def binary(request: pytest.FixtureRequest, tmp_path: Path, installed) -> Iterator[Blender]:
    """Give a real Blender with the extension installed and enabled."""
    yield from ready(request.param, tmp_path, installed)


def ready(name: str, work: Path, installed=None) -> Iterator[Blender]:
    """Copy the pictures that a test took, failed or not, to where a person looks at them."""
    if installed:
        shutil.copytree(installed(name), work / "resources")
    blender = have(name, work, work / "resources")
    yield blender
    PICTURES.mkdir(parents=True, exist_ok=True)
    for picture in blender.work.glob("*.png"):
        shutil.copy(picture, PICTURES / f"{blender.name}-{picture.name}")


@pytest.fixture(scope="session")
def cloud() -> Path:
    """Give the splats of the small room, 39,755 of them."""
    return SCENE / "point_cloud.ply"


@pytest.fixture(scope="session")
def cameras() -> Path:
    """Give the small room's 72 cameras."""
    return SCENE / "cameras.json"


@pytest.fixture(scope="session")
def pruned(cloud: Path, cameras: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Give what ``python -m refine_addon`` makes of the small room: half of its splats."""
    output = tmp_path_factory.mktemp("python") / "pruned.ply"
    words = ("prune", cloud, "--cameras", cameras, "--ratio", "0.5", "--method", "occlusion")
    done = without_blender(*words, "-o", output)
    if done.returncode != 0:
        pytest.fail(done.stdout + done.stderr, pytrace=False)
    return output


@pytest.fixture
def blend(binary: Blender, cloud: Path, cameras: Path) -> Path:
    """Save the room as a .blend: object "Splats" by Blender's own importer, and the cameras."""
    path = binary.work / "room.blend"
    binary.step("make_scene", cloud=cloud, cameras=cameras, blend=path)
    return path
