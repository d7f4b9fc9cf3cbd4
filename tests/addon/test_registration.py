"""What the extension adds to Blender; real Blenders show that it takes all of it back."""

import bpy

from tests.examples import broken_promises
from tests.places import ROOT


def test_every_button_and_setting_explains_itself(addon):
    """A tooltip each: a docstring of operators, a description of properties."""
    operators = [getattr(bpy.ops.refine, name).get_rna_type() for name in dir(bpy.ops.refine)]
    silent = [kind.identifier for kind in operators if not kind.description]
    for cls in addon.registration.CLASSES:
        properties = [p for p in cls.bl_rna.properties if not p.is_readonly and not p.is_hidden]
        own = [p for p in properties if p.identifier in getattr(cls, "__annotations__", {})]
        silent += [f"{cls.__name__}.{p.identifier}" for p in own if not p.description]
    assert silent == []


def test_examples_in_docstrings_give_what_they_promise(addon):
    """Those of what needs Blender, the command among it."""
    assert broken_promises(ROOT / "refine_addon", addon.__name__, but=".core.") == []
