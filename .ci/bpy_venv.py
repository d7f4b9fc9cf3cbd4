"""Provide a Python with Blender as a module: a virtual environment with one version of `bpy`.

Prints the path of its interpreter and exits with 0, or says why not and exits with 69. Made once,
in the same cache as `blender_root.py`'s roots. Nothing but `bpy` and what it requires is in it, so
an add-on tested there has only what it brings along.

    python .ci/bpy_venv.py 4.5.15
"""

from __future__ import annotations

import argparse
import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

from made_once import UnavailableError, made_once, print_path

# Every `bpy` from Blender 4.2 to 5.0 is built for this Python and no other.
PYTHON = (3, 11)

# Blender 4.2 carries numpy 1.24, which its wheel does not ask for; the later ones ask for theirs.
NUMPY = {"4.2": "numpy==1.24.*"}


def find_python() -> str:
    """Find an interpreter of the version that `bpy` is built for.

    Returns
    -------
    str
        Its path.

    Raises
    ------
    UnavailableError
        If there is none.
    """
    if sys.version_info[:2] == PYTHON:
        return sys.executable
    name = "python{}.{}".format(*PYTHON)
    if found := shutil.which(name):
        return found
    raise UnavailableError(
        f"bpy needs {name}: not on PATH (Debian 12: apt-get install {name} {name}-venv)"
    )


def make_environment(version: str, folder: Path, lock: int) -> None:
    """Make a virtual environment with ``bpy==version`` in the empty folder ``folder``.

    Raises
    ------
    UnavailableError
        If `venv` or `pip` fails.
    """
    python = os.fspath(folder / "bin" / "python")
    numpy = NUMPY.get(version.rpartition(".")[0], "numpy")
    install = [python, "-m", "pip", "install", "--quiet", "--no-cache-dir"]
    for command in (
        [find_python(), "-m", "venv", os.fspath(folder)],
        [*install, f"bpy=={version}", numpy],
    ):
        done = subprocess.run(
            command,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
            pass_fds=(lock,),
            check=False,
        )
        if done.returncode != 0:
            # pip says last what could not be had, after all its attempts.
            reason = "\n".join(done.stdout.strip().splitlines()[-2:])
            raise UnavailableError(f"{' '.join(command)} failed:\n{reason}")


def provide(version: str) -> Path:
    """Return the path of an interpreter that can ``import bpy`` of this version.

    Parameters
    ----------
    version : str
        Such as ``"4.5.15"``, one that PyPI has.

    Returns
    -------
    Path
        The environment's ``bin/python``.

    Raises
    ------
    UnavailableError
        If it cannot be had here.
    """
    if not re.fullmatch(r"\d+\.\d+\.\d+", version):
        raise UnavailableError(f"a version like 4.5.15 was expected, not {version!r}")
    folder = made_once(
        f"bpy-{version}", lambda partial, lock: make_environment(version, partial, lock)
    )
    return folder / "bin" / "python"


def main() -> int:
    """Print the interpreter's path for the version that the command line names.

    Returns
    -------
    int
        0, or 69 where it cannot be had.
    """
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("version")
    return print_path(provide, parser.parse_args().version)


if __name__ == "__main__":
    sys.exit(main())
