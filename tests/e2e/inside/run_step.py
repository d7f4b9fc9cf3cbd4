"""Run one step inside Blender: ``run_step.py -- NAME ARGUMENTS ANSWER``.

Calls ``main(**ARGUMENTS)`` of `NAME.py` beside this file and writes what it returns to the file
ANSWER, both as JSON. If `main` is a generator, it runs in steps between which Blender draws and
handles events; then Blender is closed.
"""

from __future__ import annotations

import faulthandler
import importlib
import inspect
import json
import os
import sys
import traceback
from pathlib import Path

import bpy

# Seconds. Ended from outside a step would not say where it was; Blender that quits amid a render of
# its own may never end.
PATIENCE, PATIENCE_TO_QUIT = float(os.environ["REFINE_PATIENCE"]), 60


def fail():
    """Say what was raised, and end at once."""
    traceback.print_exc()
    sys.stderr.flush()
    os._exit(1)


def drive(steps, answer):
    """Let a generator run between Blender's own work; each value is a pause in seconds."""

    def advance():
        try:
            return next(steps)
        except StopIteration as end:
            answer.write_text(json.dumps(end.value), encoding="utf-8")
        except Exception:
            fail()
        faulthandler.dump_traceback_later(PATIENCE_TO_QUIT, exit=True)
        bpy.ops.wm.quit_blender()
        return None

    # Persistent: a step may open another file.
    bpy.app.timers.register(advance, first_interval=1.0, persistent=True)


def run():
    """Run the step that the command line names."""
    faulthandler.dump_traceback_later(PATIENCE, exit=True)
    name, arguments, answer = sys.argv[sys.argv.index("--") + 1 :]
    sys.path.insert(0, str(Path(__file__).parent))
    value = importlib.import_module(name).main(**json.loads(arguments))
    if inspect.isgenerator(value):
        drive(value, Path(answer))
    else:
        Path(answer).write_text(json.dumps(value), encoding="utf-8")


try:
    run()
except Exception:
    fail()
