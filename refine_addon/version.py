"""The version, from blender_manifest.toml."""

from __future__ import annotations

import tomllib
from pathlib import Path


def _version() -> str:
    # The manifest is in the package of an installed extension, and beside it in the repository.
    for folder in Path(__file__).parents[:2]:
        manifest = folder / "blender_manifest.toml"
        if manifest.is_file():
            return str(tomllib.loads(manifest.read_text("utf-8"))["version"])
    from importlib import metadata

    return metadata.version("refine-addon")  # installed by pip


VERSION = _version()
