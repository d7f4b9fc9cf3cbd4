"""A folder in the user's cache that is made once, whole or not at all, or the reason why not."""

from __future__ import annotations

import fcntl
import os
import shutil
import sys
from collections.abc import Callable
from pathlib import Path

UNAVAILABLE = 69  # EX_UNAVAILABLE of sysexits.h


class UnavailableError(Exception):
    """Something cannot be had on this machine; the message says why and what would help."""


def print_path(provide: Callable[[str], Path], name: str) -> int:
    """Print the path that ``provide(name)`` returns, or why there is none on stderr.

    Returns
    -------
    int
        The program's exit code: 0, or 69 where it cannot be had.
    """
    try:
        path = provide(name)
    except UnavailableError as error:
        print(f"{Path(sys.argv[0]).stem}: {name} cannot be had here: {error}", file=sys.stderr)
        return UNAVAILABLE
    print(path)
    return 0


def cache_folder() -> Path:
    """Give the folder that holds what the tools download and build.

    Returns
    -------
    Path
        ``$REFINE_CACHE``, else ``$XDG_CACHE_HOME/refine-addon``, else ``~/.cache/refine-addon``.
    """
    if own := os.environ.get("REFINE_CACHE"):
        return Path(own).absolute()
    base = os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache"
    return Path(base).absolute() / "refine-addon"


def made_once(name: str, make: Callable[[Path, int], None]) -> Path:
    """Return the cached folder ``name``, making it first where it is not there yet.

    Parameters
    ----------
    name : str
        The folder's name in `cache_folder`.
    make : callable
        Called as ``make(partial, lock)`` where there is no such folder: fills the new folder
        ``partial``, which gets its final name once ``make`` returns. ``lock`` is the descriptor
        of the held lock: a child process that inherits it keeps others out for as long as it
        runs, also when this process is killed.

    Returns
    -------
    Path
        The complete folder.

    Raises
    ------
    RuntimeError
        If a killed run's half folder still has something mounted in it.
    """
    folder = cache_folder() / name
    if folder.is_dir():
        return folder
    folder.parent.mkdir(parents=True, exist_ok=True)
    with folder.with_name(f"{name}.lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        # Another run may have made it while this one waited for the lock.
        if not folder.is_dir():
            partial = folder.with_name(f"{name}.partial")
            _remove(partial)
            partial.mkdir()
            try:
                make(partial, lock.fileno())
            except BaseException:
                _remove(partial)
                raise
            partial.rename(folder)
    return folder


def _remove(folder: Path) -> None:
    """Remove a folder, but never reach through a mount point to what is mounted there."""
    mounts = Path("/proc/self/mountinfo")
    if mounts.exists():
        points = [line.split()[4] for line in mounts.read_text().splitlines()]
        if inside := [point for point in points if Path(point).is_relative_to(folder)]:
            raise RuntimeError(
                f"{folder} is left of a killed run and has mounts: unmount {inside} first"
            )
    if folder.exists():
        shutil.rmtree(folder)
