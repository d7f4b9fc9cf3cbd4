"""Run the extension's command where Blender has no `--command`."""

from __future__ import annotations

import importlib

from extension import MODULE, enable


def main(arguments: list[str]) -> int:
    """Return the command's exit code."""
    enable()
    return importlib.import_module(f"{MODULE}.command").main(arguments)
