"""Preferences: the panel's defaults in scenes that splats are imported into."""

from __future__ import annotations

from typing import Any

import bpy
from bpy.props import BoolProperty, EnumProperty, IntProperty

from .properties import METHOD, UPRIGHT_TEXT, VIEWS, RefineSettings

PACKAGE = __package__.rpartition(".")[0]  # Such as ``bl_ext.user_default.refine_addon``

DEFAULTS = ("method", "views")  # Preferences that are scene settings of the same name


class RefinePreferences(bpy.types.AddonPreferences):
    """Defaults, in Blender's preferences beside the extension."""

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
    """Fill a scene's unset settings; in a window only, as scripts say what they want."""
    chosen = _chosen(context)
    if chosen is not None and not bpy.app.background:
        fill(context.scene.refine, chosen)


def fill(settings: RefineSettings, chosen: RefinePreferences) -> None:
    """Set preferred values that these settings do not set yet."""
    for name in DEFAULTS:
        if chosen.is_property_set(name) and not settings.is_property_set(name):
            setattr(settings, name, getattr(chosen, name))


def suggest(operator: Any, context: bpy.types.Context, name: str) -> None:
    """Give an operator that asks for its options the default of one not given."""
    chosen = _chosen(context)
    if chosen is not None and not operator.properties.is_property_set(name):
        setattr(operator, name, getattr(chosen, name))


def _chosen(context: bpy.types.Context) -> RefinePreferences | None:
    addon = context.preferences.addons.get(PACKAGE)
    if addon is None:
        return None
    return addon.preferences


CLASSES = (RefinePreferences,)
