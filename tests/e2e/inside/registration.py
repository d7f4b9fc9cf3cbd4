"""Enable and disable the extension twice and list, each time, all it could have registered."""

from __future__ import annotations

from unittest import mock

import bpy
from extension import disable, enable


def main():
    """Return what is registered before, and after each of the four switches."""
    # Blender has no list of its commands; count them in and out.
    commands = {}
    register, unregister = bpy.utils.register_cli_command, bpy.utils.unregister_cli_command

    def register_counted(name, function):
        handle = register(name, function)
        commands[id(handle)] = name
        return handle

    def unregister_counted(handle):
        unregister(handle)
        del commands[id(handle)]

    counted = {
        "register_cli_command": register_counted,
        "unregister_cli_command": unregister_counted,
    }
    found = [registered(commands)]
    with mock.patch.multiple(bpy.utils, **counted):
        for switch in (enable, disable) * 2:
            switch()
            found.append(registered(commands))
    return found


def registered(commands):
    """Return a line for every class, property, handler, menu entry, key and command."""
    lines = [f"command {name}" for name in commands.values()]
    for name in dir(bpy.types):
        kind = getattr(bpy.types, name)
        lines.append(f"type {name}")
        if isinstance(kind, type) and issubclass(kind, bpy.types.ID):
            lines += [f"property {name}.{entry.identifier}" for entry in kind.bl_rna.properties]
        # A menu or panel that others append to keeps their functions here, and then its own.
        lines += [
            f"entry {name} {function.__module__}.{function.__qualname__}"
            for function in getattr(getattr(kind, "draw", None), "_draw_funcs", ())
            if function.__module__ != kind.__module__
        ]
    for module in dir(bpy.ops):
        lines += [f"operator {module}.{name}" for name in dir(getattr(bpy.ops, module))]
    for name in dir(bpy.app.handlers):
        functions = getattr(bpy.app.handlers, name)
        if isinstance(functions, list):
            lines += [f"handler {name} {f.__module__}.{f.__qualname__}" for f in functions]
    for keymap in bpy.context.window_manager.keyconfigs.addon.keymaps:
        lines += [f"key {keymap.name} {item.idname}" for item in keymap.keymap_items]
    return sorted(lines)
