"""What a user sets once: defaults of the panel in scenes into which splats are imported."""

from __future__ import annotations

from typing import Any

import bpy
from bpy.props import BoolProperty, EnumProperty, IntProperty

from .properties import METHOD, UPRIGHT_TEXT, VIEWS, RefineSettings

PACKAGE = __package__.rpartition(".")[0]
"""The name under which the extension is enabled, such as ``bl_ext.user_default.refine_addon``."""

DEFAULTS = ("method", "views")
"""The preferences that are settings of a scene, by the same names."""


class RefinePreferences(bpy.types.AddonPreferences):
    """Defaults, in the preferences of Blender beside the extension."""

    bl_idname = PACKAGE

    method: EnumProperty(**METHOD)
    views: IntProperty(**VIEWS)
    upright: BoolProperty(name="Upright", description=UPRIGHT_TEXT)

    def draw(self, _context: bpy.types.Context) -> None:
        """Draw them."""
        layout = self.layout
        layout.use_property_split = True
        layout.use_property_decorate = False
        layout.label(text="Defaults for scenes into which splats are imported")
        for name in (*DEFAULTS, "upright"):
            layout.prop(self, name)


def give_defaults(context: bpy.types.Context) -> None:
    """Set what nobody has set in a scene yet; in a window only: scripts say what they want."""
    chosen = _chosen(context)
    if chosen is not None and not bpy.app.background:
        fill(context.scene.refine, chosen)


def fill(settings: RefineSettings, chosen: RefinePreferences) -> None:
    """Set what a user prefers, and has not set in these settings yet."""
    for name in DEFAULTS:
        if chosen.is_property_set(name) and not settings.is_property_set(name):
            setattr(settings, name, getattr(chosen, name))


def suggest(operator: Any, context: bpy.types.Context, name: str) -> None:
    """Give an operator that asks for its options the default of one that was not given."""
    chosen = _chosen(context)
    if chosen is not None and not operator.properties.is_property_set(name):
        setattr(operator, name, getattr(chosen, name))


def _chosen(context: bpy.types.Context) -> RefinePreferences | None:
    """Return the preferences; None where the extension is not enabled as one."""
    addon = context.preferences.addons.get(PACKAGE)
    if addon is None:
        return None
    return addon.preferences


CLASSES = (RefinePreferences,)
