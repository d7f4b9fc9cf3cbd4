"""What the steps share: where the extension is, and switching it on and off."""

from __future__ import annotations

import importlib
import sys

import addon_utils
import bpy

MODULE = "bl_ext.user_default.refine_addon"


def module(name):
    """Return a module of the extension, the package itself for ''."""
    return importlib.import_module(f"{MODULE}.{name}".rstrip("."))


def is_enabled():
    """Tell whether Blender has the extension's code loaded and registered."""
    return addon_utils.check(MODULE)[1] and MODULE in sys.modules


def enable():
    """Enable the installed extension, as the check box in the preferences does."""
    bpy.ops.preferences.addon_enable(module=MODULE)
    if not is_enabled():
        raise RuntimeError(f"{MODULE} cannot be enabled")


def disable():
    """Disable the extension."""
    bpy.ops.preferences.addon_disable(module=MODULE)
    if addon_utils.check(MODULE)[1]:
        raise RuntimeError(f"{MODULE} cannot be disabled")


def select(*objects):
    """Select objects; the first is the active one."""
    for obj in bpy.context.view_layer.objects:
        obj.select_set(obj in objects)
    bpy.context.view_layer.objects.active = objects[0]
