"""What a user may not do, though tests may be run by the root user, who may do anything."""

import contextlib
import os
import tempfile
from collections.abc import Iterator, Mapping
from pathlib import Path

NOBODY = 65534


@contextlib.contextmanager
def _nobody() -> Iterator[None]:
    """Let the root user be nobody for that long."""
    root = os.geteuid() == 0
    if root:
        os.seteuid(NOBODY)
    try:
        yield
    finally:
        if root:
            os.seteuid(0)


@contextlib.contextmanager
def closed_folder(files: Mapping[str, str]) -> Iterator[Path]:
    """Make a folder of files that may not be entered; the root user is nobody for that long."""
    with tempfile.TemporaryDirectory() as made:
        Path(made).chmod(0o755)
        folder = Path(made) / "closed"
        folder.mkdir()
        for name, content in files.items():
            (folder / name).write_text(content)
        folder.chmod(0)
        with _nobody():
            yield folder
        folder.chmod(0o700)


@contextlib.contextmanager
def own_folder() -> Iterator[Path]:
    """Make a folder; the root user, who may read what nobody else may, is nobody for that long."""
    with tempfile.TemporaryDirectory() as made:
        if os.geteuid() == 0:
            os.chown(made, NOBODY, NOBODY)
        with _nobody():
            yield Path(made)
