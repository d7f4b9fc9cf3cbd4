"""Say which system packages Blender as a module lacks, by name, before an import fails."""

import ctypes
import importlib.util
import subprocess
import sys
from pathlib import Path

DEBIAN = {
    "libEGL.so.1": "libegl1",
    "libGL.so.1": "libgl1",
    "libICE.so.6": "libice6",
    "libSM.so.6": "libsm6",
    "libX11.so.6": "libx11-6",
    "libXfixes.so.3": "libxfixes3",
    "libXi.so.6": "libxi6",
    "libXrender.so.1": "libxrender1",
    "libXxf86vm.so.1": "libxxf86vm1",
    "libxkbcommon.so.0": "libxkbcommon0",
}


def missing() -> list[str]:
    """Return the shared libraries that bpy needs, or draws with, and the system lacks."""
    spec = importlib.util.find_spec("bpy")
    if not sys.platform.startswith("linux") or spec is None or spec.origin is None:
        return []
    module = next(Path(spec.origin).parent.glob("__init__*.so"))
    linked = subprocess.run(["ldd", module], capture_output=True, text=True, check=False).stdout
    lacking = [line.split()[0] for line in linked.splitlines() if "not found" in line]
    try:
        ctypes.CDLL("libEGL.so.1")  # opened at run time, so ldd does not know
    except OSError:
        lacking.append("libEGL.so.1")
    return lacking


libraries = missing()
if libraries:
    packages = " ".join(sorted({DEBIAN.get(name, name) for name in libraries}))
    sys.exit(
        f"error: Blender needs {', '.join(libraries)}, which this system lacks.\n"
        f"On Debian or Ubuntu: apt-get install {packages}"
    )
