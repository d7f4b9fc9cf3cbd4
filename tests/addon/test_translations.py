"""Every label and tooltip of the interface has its translation, and none is left over."""

from __future__ import annotations

import ast
from pathlib import Path

import bpy
import pytest

UI = Path(__file__).parents[2] / "refine_addon" / "ui"


def shown(addon):
    """Return what the interface shows: names and tooltips that Blender knows, texts of panels."""
    found = set()
    for cls in addon.registration.CLASSES:
        if issubclass(cls, bpy.types.Panel):
            found.add(cls.bl_label)
        elif issubclass(cls, bpy.types.Operator):
            module, name = cls.bl_idname.split(".")
            kind = getattr(getattr(bpy.ops, module), name).get_rna_type()
            internal = "INTERNAL" in cls.bl_options
            found |= {kind.name} | (set() if internal else {kind.description})
            found |= of_properties(kind)
        elif issubclass(cls, (bpy.types.PropertyGroup, bpy.types.AddonPreferences)):
            found |= of_properties(cls.bl_rna)
    return {text for text in found | written() if text and not text.startswith(".")}


def of_properties(kind):
    """Return the names and tooltips of properties that are ours and are drawn."""
    bases = {prop.identifier for prop in kind.base.properties} if kind.base else set()
    blenders = {"filepath", "check_existing", "bl_idname"}  # has translations of its own
    found = set()
    for prop in kind.properties:
        if prop.identifier not in bases | blenders and not prop.is_hidden:
            found |= {prop.name, prop.description}
            for item in getattr(prop, "enum_items_static", ()):
                found |= {item.name, item.description}
    return found


def written():
    """Return the constant texts that panels give to labels and buttons."""
    found = set()
    for path in UI.glob("*.py"):
        for node in ast.walk(ast.parse(path.read_text("utf-8"))):
            if isinstance(node, ast.Call):
                given = [each.value for each in node.keywords if each.arg == "text"]
                if ast.unparse(node.func) in {"wrapped.label", "label"}:
                    given += node.args[2:]
                found |= {each.value for each in given if isinstance(each, ast.Constant)}
    return found


def test_every_text_has_a_translation_and_none_is_stale(addon):
    """What is missing or left over is named."""
    there, needed = set(addon.ui.translations.GERMAN), shown(addon)

    assert {"missing": sorted(needed - there), "stale": sorted(there - needed)} == {
        "missing": [],
        "stale": [],
    }
    assert all(addon.ui.translations.GERMAN.values())


@pytest.fixture
def german():
    """Set Blender to German; English again afterwards."""
    view = bpy.context.preferences.view
    if "de_DE" not in bpy.app.translations.locales:
        pytest.skip("this Blender has no German")
    before = view.language
    view.language = "de_DE"
    view.use_translate_interface = view.use_translate_tooltips = True
    yield
    view.language = before


@pytest.mark.usefixtures("german")
def test_blender_shows_them(addon):
    """Names of properties, tooltips, and buttons, which Blender looks up as operators."""
    translated = bpy.app.translations

    assert translated.pgettext_iface("Absorb") == "Aufnehmen"
    assert translated.pgettext_iface("Find Floaters", "Operator") == "Schwebende finden"
    assert translated.pgettext_tip("How many splats stay") == "Wie viele Splats bleiben"
    texts = []
    layout = type("Layout", (), {"column": lambda self, **_: self})()
    layout.label = lambda text, **_: texts.append(text)
    addon.ui.wrapped.label(layout, bpy.context, "Scored and pruned as one scene")
    assert " ".join(texts) == "Als eine Szene bewertet und ausgedünnt"
