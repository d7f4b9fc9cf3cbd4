"""Splats in each scoring camera's view, and the change of its picture."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any, NamedTuple

import bpy

from ..core.quality.curve import in_words
from .wrapped import counted

_MOST = 8  # Cameras shown


class Camera(NamedTuple):
    """View's name, splats in it, estimated dB or None, whether it is far away."""

    name: str
    seen: int
    psnr: float | None
    far: bool


def cameras(record: dict[str, Any], psnr: Mapping[str, float]) -> list[Camera]:
    """Cameras of a record: useless ones first, then by change; `psnr`: known dB by view."""
    far = set((record.get("alignment") or {}).get("far", ()))
    each = (
        Camera(name, seen, psnr.get(name), name in far)
        for name, seen in record.get("cameras") or ()
    )
    return sorted(
        each, key=lambda c: (c.seen > 0, not c.far, math.inf if c.psnr is None else c.psnr, c.seen)
    )


def warning(record: dict[str, Any]) -> str:
    """A sentence if cameras of a scoring see no splat, else ""."""
    none = sum(seen == 0 for _, seen in record.get("cameras") or ())
    return f"no splat lies in the view of {counted(none, 'camera')}" if none else ""


def draw(layout: bpy.types.UILayout, record: dict[str, Any], psnr: Mapping[str, float]) -> None:
    """Draw the first of `cameras`; folded at first."""
    header, body = layout.panel("REFINE_cameras", default_closed=True)
    header.label(text="What Each Sees")
    if not body:
        return
    column = body.column(align=True)
    every = cameras(record, psnr)
    for camera in every[:_MOST]:
        text = "far away" if camera.far else f"{camera.seen:,}" if camera.seen else "nothing"
        if camera.psnr is not None:
            text += f", {in_words(camera.psnr)}"
        useless = camera.far or not camera.seen
        column.label(text=f"{camera.name}: {text}", icon="ERROR" if useless else "CAMERA_DATA")
    if len(every) > _MOST:
        column.label(text=f"and {len(every) - _MOST} that change less")
