"""The extension enters and leaves Blender without a trace."""

from __future__ import annotations

import bpy

MENUS = ("TOPBAR_MT_file_import", "TOPBAR_MT_file_export", "TOPBAR_MT_render")


def _traces():
    """Return everything that a registration adds to Blender."""
    return {
        "types": sorted(name for name in dir(bpy.types) if "REFINE" in name or "Refine" in name),
        "operators": sorted(dir(bpy.ops.refine)),
        "scene": "refine" in bpy.types.Scene.bl_rna.properties,
        "menus": [len(getattr(bpy.types, menu)._dyn_ui_initialize()) for menu in MENUS],
    }


def test_unregister_takes_back_all_that_register_gave(extension):
    """Register, unregister, register again: the second time finds nothing of the first."""
    with_it = _traces()
    extension.unregister()
    without = _traces()
    extension.register()

    assert with_it["scene"]
    assert with_it["operators"]
    assert without["types"] == without["operators"] == []
    assert not without["scene"]
    assert [a - b for a, b in zip(with_it["menus"], without["menus"], strict=True)] == [1] * 3
    assert _traces() == with_it


def test_every_button_and_setting_explains_itself(addon):
    """A tooltip each: a docstring of operators, a description of properties."""
    operators = [getattr(bpy.ops.refine, name).get_rna_type() for name in dir(bpy.ops.refine)]
    silent = [kind.identifier for kind in operators if not kind.description]
    for cls in addon.registration.CLASSES:
        properties = [p for p in cls.bl_rna.properties if not p.is_readonly and not p.is_hidden]
        own = [p for p in properties if p.identifier in getattr(cls, "__annotations__", {})]
        silent += [f"{cls.__name__}.{p.identifier}" for p in own if not p.description]

    assert silent == []
