"""What the steps share: where the extension is, and switching it on and off."""

from __future__ import annotations

import sys

import addon_utils
import bpy

MODULE = "bl_ext.user_default.refine_addon"


def is_enabled() -> bool:
    """Tell whether Blender has the extension's code loaded and registered."""
    return addon_utils.check(MODULE)[1] and MODULE in sys.modules


def enable() -> None:
    """Enable the installed extension, as the check box in the preferences does."""
    bpy.ops.preferences.addon_enable(module=MODULE)
    if not is_enabled():
        raise RuntimeError(f"{MODULE} cannot be enabled")


def disable() -> None:
    """Disable the extension."""
    bpy.ops.preferences.addon_disable(module=MODULE)
    if addon_utils.check(MODULE)[1]:
        raise RuntimeError(f"{MODULE} cannot be disabled")
