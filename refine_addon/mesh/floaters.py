"""Floaters stored on a mesh: the reason for each splat, and which are to be removed."""

from __future__ import annotations

import json
from collections.abc import Collection
from typing import Any

import bpy
import numpy as np
from numpy.typing import NDArray

from ..core.cleaning.clean import REASONS, Cleaned
from ..core.errors import RefineError
from . import attributes as mesh_attributes
from . import edit as mesh_edit
from .layout import SplatObject, recorded, splat_count

REASON = "refine_floats"  # Integer point attribute: 0, or the splat's place in `REASONS`, from 1

FOUND = "refine_floaters"  # Custom property of the mesh: floaters by reason, and how sure, JSON


def store(checked: SplatObject, cleaned: Cleaned) -> None:
    """Write the cleaning result to an object's mesh."""
    mesh_edit.check_writable(checked.obj)
    if len(checked) != len(cleaned.keep):
        raise RefineError(
            f"object '{checked.obj.name}': has {len(checked)} splats, floaters were looked for "
            f"among {len(cleaned.keep)}; look again"
        )
    reasons = np.zeros(len(cleaned.keep), np.int32)
    for number, name in enumerate(REASONS, start=1):
        reasons[cleaned.by_reason[name]] = number
    mesh_attributes.write_attribute(checked.mesh, REASON, "INT", reasons)
    counts = {name: int(np.count_nonzero(mask)) for name, mask in cleaned.by_reason.items()}
    noted = {"splats": len(reasons), "counts": counts, "sure": cleaned.surety()}
    checked.mesh[FOUND] = json.dumps(noted)
    mesh_attributes.updated(checked.mesh)


def counts(mesh: bpy.types.Mesh | bpy.types.PointCloud) -> dict[str, int] | None:
    """Floaters for each reason; None without a search since the last change."""

    def read(noted: Any) -> dict[str, int] | None:
        current = noted["splats"] == splat_count(mesh) and REASON in mesh.attributes
        return {name: int(noted["counts"][name]) for name in REASONS} if current else None

    return recorded(mesh, FOUND, read)


def surety(mesh: bpy.types.Mesh | bpy.types.PointCloud) -> dict[str, float]:
    """Share of further views that see past the splats of each reason, 0..1, where known."""

    def read(noted: Any) -> dict[str, float]:
        return {name: float(sure) for name, sure in noted["sure"].items() if sure is not None}

    return recorded(mesh, FOUND, read) or {}


def mask(checked: SplatObject, reasons: Collection[str]) -> NDArray[np.bool_]:
    """Floaters of these reasons, (N,); `RefineError` without a search since the splats changed."""
    if counts(checked.mesh) is None:
        raise RefineError(f"object '{checked.obj.name}': look for floaters first")
    numbers = [number for number, name in enumerate(REASONS, start=1) if name in reasons]
    return np.isin(mesh_attributes.read_attribute(checked.mesh, REASON), numbers)


def mark(checked: SplatObject, reasons: Collection[str]) -> None:
    """Mark the floaters of these reasons as removed, for the preview."""
    mesh_edit.mark_removed(checked.obj, mask(checked, reasons))


def forget(mesh: bpy.types.Mesh | bpy.types.PointCloud) -> None:
    """Remove the cleaning result."""
    mesh_attributes.remove_attribute(mesh, REASON)
    mesh.pop(FOUND, None)
