"""Tell where the enabled extension and what it imports were loaded from."""

from __future__ import annotations

import importlib.metadata
import sys

from extension import MODULE, enable


def main() -> dict[str, str]:
    """Enable the extension; return the files of it and of the wheel it brings."""
    enable()
    import plyfile

    return {
        "extension": sys.modules[MODULE].__file__,
        "plyfile": plyfile.__file__,
        "plyfile_version": importlib.metadata.version("plyfile"),
    }
