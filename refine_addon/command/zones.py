"""Protected splats and those the user removes, from the options and the open scene."""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from typing import Any

from ..core import RefineError, Zone
from ..core.volumes import Role, Volume

ROLES: dict[str, Role] = {"protect": "protect", "remove_inside": "remove", "keep_inside": "keep"}
"""Options -> role of their volumes."""


def of_files(options: argparse.Namespace) -> tuple[Zone, ...]:
    """The volumes that decide on INPUT files."""
    return tuple(_zone(role, text, volume) for role, text, volume in _named(options))


def of_object(options: argparse.Namespace) -> Any:
    """The demands on the splats of --object, from the options and the scene."""
    import bpy

    from ..objects import demands, splat_group

    obj = splat_group.find(options.object)
    marks = {*obj.vertex_groups.keys(), *getattr(obj.data, "attributes", {}).keys()}
    names, zones = [], []
    for role, text, volume in _named(options):
        if role == "protect" and volume is None and text in marks:
            names.append(text)
        else:
            also = f", nor has '{obj.name}' a group or an attribute" if role == "protect" else ""
            zones.append(_zone(role, text, volume, also))
    scene = demands.Demands.of_scene(bpy.context.scene)
    return scene + demands.Demands(tuple(names), tuple(zones))


def words(done: dict[str, Any]) -> str:
    """The report's demands in one line, "" without."""
    counts = {"protected": "protected", "removed_by_user": "removed by you"}
    splats = done["splats"]
    parts = [f"{splats[key]:,} {what}" for key, what in counts.items() if splats.get(key)]
    volumes = "; ".join(
        f"{volume['role']} {volume['name'].removeprefix('object ')}: {volume['splats']:,}"
        for volume in done.get("volumes", ())
    )
    return " ".join([", ".join(parts), f"({volumes})" if volumes else ""]).strip()


def _named(options: argparse.Namespace) -> Iterator[tuple[Role, str, Volume | None]]:
    for option, role in ROLES.items():
        for text, volume in getattr(options, option) or ():
            yield role, text, volume


def _zone(role: Role, text: str, volume: Volume | None, also: str = "") -> Zone:
    if volume is not None:
        return Zone(role, f"'{text}'", volume)
    import bpy

    from ..objects import demands

    obj = bpy.context.scene.objects.get(text)
    if obj is None:
        fit = [o.name for o in bpy.context.scene.objects if demands.can_be_volume(o)]
        there = ", ".join(fit[:8]) or "none"
        raise RefineError(
            f"no object '{text}' in the open .blend{also} (objects that are volumes: {there})"
        )
    return demands.zone(role, obj)
