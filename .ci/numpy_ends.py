"""Run the core tests on the oldest and the newest NumPy that a supported Blender carries."""

import subprocess
import sys

# Blender 4.2 carries 1.24, 5.1 and later 2.x.
for numpy in ("1.24.*", "2.*"):
    folder = f".venv-numpy{numpy[0]}"
    subprocess.run(["sh", ".ci/make_venv", folder], check=True)
    python = f"{folder}/bin/python"
    packages = [f"numpy=={numpy}", "plyfile", "pytest", "hypothesis", "mpmath"]
    subprocess.run([python, "-m", "pip", "install", "--quiet", *packages], check=True)
    code = subprocess.run([python, "-m", "pytest", "tests/core", "-q"], check=False).returncode
    if code:
        sys.exit(code)
