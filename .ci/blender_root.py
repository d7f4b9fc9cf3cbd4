"""Provide a real Blender binary: a small Debian root, made once, apart from the machine's system.

Prints the root's path and exits with 0; `enter` gives the words that run a command in it. Where
the root cannot be had (not Linux, not root, a tool missing, no network, the release broken today)
it says why on stderr and exits with 69, so that a test can be skipped with that reason instead of
counted as passed.

    python .ci/blender_root.py trixie     # Blender 4.3, Python 3.13
    python .ci/blender_root.py sid        # the newest that Debian has; it moves
"""

from __future__ import annotations

import argparse
import os
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Iterable, Mapping
from pathlib import Path

from made_once import UnavailableError, cache_folder, made_once, print_path

PACKAGES = (
    "blender",
    "python3-numpy",
    # A window without a graphics card, and a picture of it.
    "libegl1",
    "libgl1-mesa-dri",
    "xvfb",
    "xauth",
    "imagemagick",
)

# Debian's Blender 5 runs its extension code on these and only recommends them.
RELEASES = {"trixie": (), "sid": ("python3-cattr", "python3-requests")}

# Each command the tool or its user needs, and the Debian package that has it.
COMMANDS = {"mmdebstrap": "mmdebstrap", "bwrap": "bubblewrap", "unshare": "util-linux"}


def install_commands() -> None:
    """Install the missing ones of `COMMANDS` with apt.

    Raises
    ------
    UnavailableError
        If one is missing and cannot be installed.
    """
    missing = [package for name, package in COMMANDS.items() if shutil.which(name) is None]
    if not missing:
        return
    install = ["apt-get", "install", "-y", "--no-install-recommends", *missing]
    hint = f"Debian package(s) missing: {', '.join(missing)}. Install with: {' '.join(install)}"
    if shutil.which("apt-get") is None or os.geteuid() != 0:
        raise UnavailableError(hint)
    for command in (["apt-get", "update"], install):
        done = subprocess.run(command, stdout=sys.stderr, check=False)
    if done.returncode != 0:
        raise UnavailableError(
            f"{hint}\nThat was tried and failed with exit code {done.returncode}."
        )


def make_root(release: str, root: Path, lock: int) -> None:
    """Bootstrap a Debian release with Blender into the empty folder ``root``.

    Parameters
    ----------
    release : str
        A key of `RELEASES`.
    root : Path
        An empty folder.
    lock : int
        A descriptor that the bootstrap inherits and thereby keeps locked.

    Raises
    ------
    UnavailableError
        If the bootstrap fails or the Blender in it does not start.
    """
    packages = ",".join(PACKAGES + RELEASES[release])
    command = [
        # mmdebstrap mounts /proc and /sys in the root: in a mount namespace of its own nothing
        # stays mounted when it is killed.
        *("unshare", "--mount", "--propagation", "private"),
        *("mmdebstrap", "--mode=root", "--variant=apt", f"--include={packages}"),
        # sid's index is valid for a week, and a mirror or this machine's clock may be off by more.
        '--aptopt=Acquire::Check-Valid-Until "false"',
        *(release, os.fspath(root)),
    ]
    with tempfile.TemporaryFile("w+") as log:
        done = subprocess.run(
            command, stdout=log, stderr=subprocess.STDOUT, pass_fds=(lock,), check=False
        )
        log.seek(0)
        errors = [line for line in log if line.startswith(("E:", "Err:", "dpkg: error"))]
    if done.returncode != 0:
        # Of a chain of errors the first ones name the cause.
        reason = "".join(errors[:3]).strip()
        raise UnavailableError(
            f"mmdebstrap {release} failed with exit code {done.returncode}:\n{reason}"
        )
    check_blender(root)


def enter(
    root: Path,
    *,
    read_only: Iterable[Path] = (),
    writable: Iterable[Path] = (),
    environment: Mapping[str, str] | None = None,
) -> list[str]:
    """Give the words before a command that make it run in the root.

    The root itself is read-only there, /tmp is empty and there is no network: what a command
    leaves behind is in ``writable`` alone.

    Parameters
    ----------
    root : Path
        A root of `provide`.
    read_only, writable : iterable of Path
        Folders of this machine that the command sees, under the same path.
    environment : mapping of str to str, optional
        Variables besides ``PATH`` and ``HOME``; nothing else of this process's gets through.

    Returns
    -------
    list of str
        A `bwrap` command line to put in front of the command.
    """
    words = ["bwrap", "--die-with-parent", "--unshare-net", "--unshare-pid", "--clearenv"]
    for name in ("usr", "etc", "var"):
        words += ["--ro-bind", os.fspath(root / name), f"/{name}"]
    for link in ("bin", "lib", "lib64", "sbin"):
        words += ["--symlink", f"usr/{link}", f"/{link}"]
    words += ["--dev", "/dev", "--proc", "/proc", "--tmpfs", "/run", "--tmpfs", "/tmp"]
    for option, folders in (("--ro-bind", read_only), ("--bind", writable)):
        for folder in folders:
            words += [option, os.fspath(folder), os.fspath(folder)]
    variables = {"PATH": "/usr/bin:/bin", "HOME": "/tmp", **(environment or {})}
    for name, value in variables.items():
        words += ["--setenv", name, value]
    return words


def check_blender(root: Path) -> None:
    """Start the root's Blender once.

    Raises
    ------
    UnavailableError
        If it does not print its version.
    """
    command = [*enter(root), "blender", "--background", "--version"]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    if done.returncode != 0 or not done.stdout.startswith("Blender "):
        raise UnavailableError(f"Blender in {root} does not start:\n{done.stdout}{done.stderr}")


def provide(release: str) -> Path:
    """Return the path of a root with Blender, made on first use.

    Parameters
    ----------
    release : str
        A key of `RELEASES`.

    Returns
    -------
    Path
        The root folder.

    Raises
    ------
    UnavailableError
        If it cannot be had here.
    """
    if sys.platform != "linux":
        raise UnavailableError(f"a Debian root needs Linux, this is {sys.platform}")
    if not (cache_folder() / release).is_dir() and os.geteuid() != 0:
        raise UnavailableError(
            f"making the root {release!r} needs to be run as root (mmdebstrap --mode=root)"
        )
    install_commands()
    return made_once(release, lambda root, lock: make_root(release, root, lock))


def main() -> int:
    """Print the path of the root that the command line names.

    Returns
    -------
    int
        0, or 69 where it cannot be had.
    """
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("release", choices=sorted(RELEASES))
    return print_path(provide, parser.parse_args().release)


if __name__ == "__main__":
    sys.exit(main())
