"""What must stay and what must go, as the options and the open scene say it."""

from __future__ import annotations

import argparse
from dataclasses import dataclass
from typing import Any

from ..core import RefineError, Zone
from ..core.volumes import Role, Volume, parse

ROLES: dict[str, Role] = {"protect": "protect", "remove_inside": "remove", "keep_inside": "keep"}
"""Options -> what becomes of the splats in a volume."""


@dataclass(frozen=True)
class ZoneArgument:
    """What an option names.

    Attributes
    ----------
    text : str
        As it was given.
    volume : Volume or None
        In numbers; None for a name.
    """

    text: str
    volume: Volume | None


def zone_argument(text: str) -> ZoneArgument:
    """Return what an argument names.

    Raises
    ------
    argparse.ArgumentTypeError
        If it is nothing, or numbers that are no volume.
    """
    if not text:
        raise argparse.ArgumentTypeError("expected a name or a volume, got none")
    try:
        return ZoneArgument(text, parse(text))
    except RefineError as error:
        raise argparse.ArgumentTypeError(str(error)) from error


def add(parser: argparse.ArgumentParser, *, protects: bool = True, names: str = "") -> None:
    """Add the options to a subcommand.

    Parameters
    ----------
    parser : argparse.ArgumentParser
    protects : bool
        Whether it knows splats that stay.
    names : str
        What else may be named than a volume.
    """
    volume = "box:x0,y0,z0,x1,y1,z1 or sphere:x,y,z,radius in the coordinates of the cameras, or "
    volume += "in Blender an object, a closed mesh or an empty shown as cube or sphere"
    texts = {
        "--protect": f"splats in it stay unchanged, whatever else is said: {names}{volume}",
        "--remove-inside": "splats in it go first, and count as removed; see --protect"
        if protects
        else f"score as if the splats in it had gone, which score 0: {volume}",
        "--keep-inside": "all splats go that are in no volume of this kind; like --remove-inside",
    }
    for option, text in texts.items():
        if protects or option != "--protect":
            parser.add_argument(
                option,
                action="append",
                default=[],
                type=zone_argument,
                metavar="VOLUME" if not (names and option == "--protect") else "NAME_OR_VOLUME",
                help=f"{text}; may be given several times",
            )


def check(parser: argparse.ArgumentParser, options: argparse.Namespace) -> None:
    """Refuse names where there is no scene that could hold what they name; leaves with code 2."""
    if options.scene:
        return
    for name in ROLES:
        for item in getattr(options, name, ()):
            if item.volume is None:
                parser.error(
                    f"--{name.replace('_', '-')} {item.text}: objects have names in Blender alone; "
                    "here give box:x0,y0,z0,x1,y1,z1 or sphere:x,y,z,radius"
                )


def of_files(options: argparse.Namespace) -> tuple[Zone, ...]:
    """Return the volumes that decide on INPUT files.

    Raises
    ------
    RefineError
        If no object of the open scene has such a name, or one can be no volume.
    """
    return tuple(_zone(role, item, "") for role, item in _items(options))


def of_object(options: argparse.Namespace) -> Any:
    """Return what is demanded of the splats of --object: by the options, and by the scene.

    Raises
    ------
    RefineError
        See `of_files` and `Demands.of_scene`.
    """
    import bpy

    from ..objects import demands, splat_object

    obj = splat_object.find(options.object)
    names, zones = [], []
    for role, item in _items(options):
        if role == "protect" and item.volume is None and _marks(obj, item.text):
            names.append(item.text)
        else:
            also = f", nor has '{obj.name}' a group or an attribute" if role == "protect" else ""
            zones.append(_zone(role, item, also))
    scene = demands.Demands.of_scene(bpy.context.scene)
    return scene + demands.Demands(tuple(names), tuple(zones))


def words(done: dict[str, Any]) -> str:
    """Return what a report says of it in one line, "" where nothing was demanded."""
    splats, parts = done["splats"], []
    if splats.get("protected"):
        parts.append(f"{splats['protected']:,} protected")
    if splats.get("removed_by_user"):
        parts.append(f"{splats['removed_by_user']:,} removed by you")
    volumes = [
        f"{volume['role']} {volume['name'].removeprefix('object ')}: {volume['splats']:,}"
        for volume in done.get("volumes", ())
    ]
    return " ".join([", ".join(parts), f"({'; '.join(volumes)})" if volumes else ""]).strip()


def _items(options: argparse.Namespace) -> list[tuple[Role, ZoneArgument]]:
    return [
        (role, item) for name, role in ROLES.items() for item in getattr(options, name, ()) or ()
    ]


def _marks(obj: Any, name: str) -> bool:
    return name in obj.vertex_groups or name in getattr(obj.data, "attributes", ())


def _zone(role: Role, item: ZoneArgument, also: str) -> Zone:
    if item.volume is not None:
        return Zone(role, f"'{item.text}'", item.volume)
    import bpy

    from ..objects import demands

    obj = bpy.context.scene.objects.get(item.text)
    if obj is None:
        fit = [o.name for o in bpy.context.scene.objects if demands.can_be_volume(o)]
        there = ", ".join(fit[:8]) or "none"
        raise RefineError(
            f"no object '{item.text}' in the open .blend{also} (objects that are volumes: {there})"
        )
    return demands.zone(role, obj)
