"""The harness ends whatever hangs, so that no Blender stops the tests."""

from __future__ import annotations

import sys
import time

import blenders
import pytest


def test_a_command_that_hangs_is_ended_with_all_that_it_started():
    """Its child holds the pipes open for a minute; it is over at once, and says what was said."""
    script = (
        "import subprocess, sys, time; print('so far', flush=True); "
        "subprocess.Popen([sys.executable, '-c', 'import time; time.sleep(60)']); time.sleep(60)"
    )
    began = time.monotonic()

    with pytest.raises(blenders.StepError, match=r"(?s)was ended after 1 s:.*so far"):
        blenders._run([sys.executable, "-c", script], patience=1.0)

    assert time.monotonic() - began < 30.0
