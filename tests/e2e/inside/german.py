"""What Blender shows of the extension's texts in German, and without it."""

from __future__ import annotations

import bpy
import extension


def main() -> dict[str, list[str]]:
    """Return a property's name, a button and a tooltip, with the extension and without."""
    view = bpy.context.preferences.view
    view.language = "de_DE"
    view.use_translate_interface = view.use_translate_tooltips = True
    extension.enable()
    found = {"with": texts()}
    extension.disable()
    return found | {"without": texts()}


def texts() -> list[str]:
    """Return three texts as Blender shows them."""
    shown = bpy.app.translations
    return [
        shown.pgettext_iface("Absorb"),
        shown.pgettext_iface("Find Floaters", "Operator"),
        shown.pgettext_tip("How many splats stay"),
    ]
