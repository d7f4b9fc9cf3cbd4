"""Registration with Blender, in order; `unregister` undoes it in reverse.
Every class of Blender's kinds in `MODULES` is registered; an operator's name is that of its class:
``refine.apply`` is `REFINE_OT_apply`. Modules list functions that draw into Blender's menus in
`MENUS`, and handlers of Blender's events, with the events, in `HANDLERS`."""

from __future__ import annotations

import importlib
from contextlib import ExitStack
from functools import partial

import bpy
from bpy.app.handlers import persistent
from bpy.props import PointerProperty

from . import command
from .core import images
from .main_thread import BlenderImages
from .ui.properties import RefineSettings

_NAMES = """
    ui.marks ui.properties ui.images ui.plans ui.operator_bases ui.transforms ui.import_operators
    ui.select_tools ui.select_operators ui.operators ui.render_operators ui.export_operators
    ui.camera_operators ui.panel viewport.draw
"""
MODULES = [importlib.import_module(f".{name}", __package__) for name in _NAMES.split()]
CLASSES = [
    cls
    for module in MODULES
    for cls in vars(module).values()
    if hasattr(cls, "bl_rna") and cls.__module__ == module.__name__  # not an imported one
]
MENUS = [pair for module in MODULES for pair in getattr(module, "MENUS", {}).items()]
_HANDLERS = [
    (getattr(bpy.app.handlers, event), persistent(handler))  # stays when a file is opened
    for module in MODULES
    for handler, events in getattr(module, "HANDLERS", {}).items()
    for event in events
]

_undo = ExitStack()  # Undoes what `register` did, in reverse


def register() -> None:
    """Register classes, properties, menu entries and the command ``refine``."""
    for cls in CLASSES:
        if issubclass(cls, bpy.types.Operator):
            cls.bl_idname = cls.__name__.replace("REFINE_OT_", "refine.")
        bpy.utils.register_class(cls)
        _undo.callback(bpy.utils.unregister_class, cls)
    bpy.types.Scene.refine = PointerProperty(type=RefineSettings)
    _undo.callback(delattr, bpy.types.Scene, "refine")
    menus = [(getattr(bpy.types, name), entry) for name, entry in MENUS]
    for parts, part in [*menus, *_HANDLERS]:
        parts.append(part)
        _undo.callback(parts.remove, part)
    for module in MODULES:
        if hasattr(module, "register"):
            module.register()
        if hasattr(module, "unregister"):
            _undo.callback(module.unregister)
    images.use(BlenderImages())
    _undo.callback(images.use, None)
    added = bpy.utils.register_cli_command("refine", partial(command.main, scene=True))
    _undo.callback(bpy.utils.unregister_cli_command, added)


unregister = _undo.close
