"""Run the core tests on the oldest and the newest NumPy and plyfile that a Blender may have.

Blender 4.2 carries NumPy 1.24, 5.1 and later 2.x. Our zip carries plyfile, but the wheels of all
extensions share one folder in which the newest wins: another extension may bring a newer plyfile,
also beside a NumPy that this one does not ask for.

Every test runs on both NumPys, with few random examples: `make test` has many, on a NumPy between
them. The newest plyfile beside the oldest NumPy needs only the quick tests.
"""

import subprocess
import sys

TOOLS = ["pytest", "pytest-xdist", "hypothesis", "mpmath"]
SIDE_BY_SIDE = ["-n", "auto", "--maxprocesses", "4", "--dist", "worksteal"]
SIDE_BY_SIDE += ["--hypothesis-profile=quick"]
NOT_SLOW = ["-m", "not slow"]


def tested(folder: str, packages: list[str], *options: str) -> None:
    """Install packages into an environment, made where it is not there, and run the tests in it."""
    subprocess.run(["sh", ".ci/make_venv", folder], check=True)
    python = f"{folder}/bin/python"
    subprocess.run([python, "-m", "pip", "install", "--quiet", *packages], check=True)
    versions = "import numpy, plyfile; from importlib.metadata import version as v; "
    versions += "print('NumPy', v('numpy'), 'and plyfile', v('plyfile'), flush=True)"
    subprocess.run([python, "-c", versions], check=True)
    done = subprocess.run(
        [python, "-m", "pytest", "tests/core", "-q", *SIDE_BY_SIDE, *options], check=False
    )
    if done.returncode:
        sys.exit(done.returncode)


tested(".venv-numpy1", ["numpy==1.24.*", "plyfile==1.1.3", *TOOLS])
tested(".venv-numpy1", ["--no-deps", "--upgrade", "plyfile"], *NOT_SLOW)
tested(".venv-numpy2", ["numpy==2.*", "plyfile", "--upgrade", *TOOLS])
