"""The panel's settings, their conversion to those of core, and their defaults (preferences)."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import bpy
import numpy as np
from bpy.props import (
    BoolProperty,
    CollectionProperty,
    EnumProperty,
    FloatProperty,
    IntProperty,
    PointerProperty,
    StringProperty,
)

from ..core import Budget, Levels, Merge, Method, RefineError
from ..core.cleaning.clean import DEFAULT_REASONS
from ..core.formats.format import Format
from ..core.formats.ply import REQUIRED
from ..core.formats.registry import SUFFIXES, format_named
from ..core.methods import METHODS as CORE_METHODS
from ..core.splats import MODELS
from ..mesh import layout as mesh_layout
from ..mesh.edit import MARKING
from . import plans, wrapped
from .marks import RefineVolume
from .select_tools import MODES

METHODS = (
    ("closed-form", "Closed Form", "REFINE's formula, ignores occlusion. Kept splats unchanged"),
    ("occlusion", "Occlusion", "Knows what hides what. Only deletes; kept splats are unchanged"),
    ("merge", "Merge", "Merges what goes into what stays; deletes where that is as good"),
    ("refit", "Refit", "Merges, then fits kept splats to the original look: closest, slowest"),
)
"""The dial, from instant to best, by core's names."""

HINTS = ("only deletes", "only deletes", "what goes is merged", "merged, then fitted")
"""The panel's text on each method before there are scores."""

BUDGETS = (
    ("ratio", "Share", "Remove this share of the splats"),
    ("keep", "Count", "Keep this many splats"),
    ("max_mb", "File Size", "Keep as many splats as fit in a file of this size"),
    ("psnr", "Quality", "Remove as many splats as leave the pictures this close to the unpruned"),
)
"""Kinds of budget, by core's names."""

SPZ_Y_UP: dict[str, Any] = {
    "name": "SPZ y Up", "options": {"SKIP_SAVE"},
    "description": "In an SPZ y points up and z back, as it is documented, in other files y down. "
    "Not ticked, imported cameras decide, or an SPZ is read and written as it stands",
}  # fmt: skip

UPRIGHT_TEXT = (
    "Turn the object, not the data, a quarter about X: from the y-down world of COLMAP to the "
    "z-up world of Blender"
)

DRAWN = (
    ("default", "Default", "As ordinary 3D Gaussian splats"),
    ("antialiased", "Antialiased", "Trained antialiased in Mip-Splatting, gsplat, Brush, Postshot"),
    ("2dgs", "2DGS", "As flat discs, which have no third scale"),
)
"""Drawing models, by the names of `splats.MODELS` and in their order."""

STRENGTHS = (
    ("CAREFUL", "Careful", "What stands in front of surfaces, and small clusters by themselves"),
    ("USUAL", "Usual", "Also huge veils, and needles that cross the pictures"),
    ("STRONG", "Strong", "Also what floats and changes no picture visibly, near cameras too"),
)
"""How many of the floaters are removed."""

_REASONS = {
    "CAREFUL": ("front", "isolated"),
    "USUAL": DEFAULT_REASONS,
    "STRONG": (*DEFAULT_REASONS, "transparent", "haze"),
}

SOURCES = (
    ("VISIBLE", "Visible", "All cameras that are visible in the scene"),
    ("ACTIVE", "Active", "The scene's active camera, at the current frame"),
    ("SELECTED", "Selected", "The cameras that are selected"),
    ("COLLECTION", "Collection", "The cameras of a collection, hidden ones too"),
    ("FRAMES", "Frames", "The active camera at each frame of a range: an animated shot"),
)


def _model(_settings: RefineSettings) -> int:
    layout = mesh_layout.layout_if_any(getattr(bpy.context, "object", None))
    return MODELS.index(layout.model) if layout else 0


def _set_model(_settings: RefineSettings, value: int) -> None:
    obj = getattr(bpy.context, "object", None)
    if mesh_layout.looks_like_splats(obj):
        obj.data[mesh_layout.MODEL] = MODELS[value]
        obj.data.update_tag()


def _protectable(
    _settings: RefineSettings, context: bpy.types.Context, _text: str
) -> Iterator[str]:
    obj = context.object
    if mesh_layout.looks_like_splats(obj):
        yield from (group.name for group in obj.vertex_groups)
        for attribute in obj.data.attributes:
            ours = attribute.name.startswith((".", "refine_", "f_rest_"))
            ours = ours or attribute.name in {*REQUIRED, "radius"}
            if attribute.data_type in MARKING and attribute.domain == "POINT" and not ours:
                yield attribute.name


def decimal(value: float) -> float:
    """The number as typed, so that panel and command remove the same splats.

    >>> decimal(0.28999999165534973)  # as Blender keeps 0.29
    0.29
    """
    return float(str(np.float32(value)))


class _Preferred:
    """Settings of the scene that have a default in the preferences."""

    method: EnumProperty(
        name="Method",
        description="How splats are pruned, from instant to best",
        items=METHODS,
        default=Merge.name,
        update=plans.changed,
    )
    views: IntProperty(
        name="Views",
        description="Use at most this many views, spread out evenly; 0 uses all",
        default=Merge.views,
        min=0,
    )


class RefineSettings(_Preferred, bpy.types.PropertyGroup):
    """Settings of the panel, at ``scene.refine``."""

    model: EnumProperty(
        name="Drawn As",
        description="The model that the splats of the active object were trained with. Views, "
        "scores, pictures and the exported file follow it; by default as the imported file says",
        items=DRAWN,
        get=_model,
        set=_set_model,
    )
    source: EnumProperty(name="Cameras", description="Cameras that decide", items=SOURCES)
    exact: BoolProperty(
        name="Exactly These",
        description="No other views decide, too, where there are few cameras",
    )
    collection: PointerProperty(
        name="Collection", description="The collection of the cameras", type=bpy.types.Collection
    )
    frame_step: IntProperty(name="Step", description="Frames from view to view", default=10, min=1)
    strength: EnumProperty(
        name="Strength",
        description="How many of the floaters go",
        items=STRENGTHS,
        default="USUAL",
        update=plans.mark_again,
    )
    budget: EnumProperty(
        name="Budget",
        description="How the budget is given",
        items=BUDGETS,
        update=plans.changed,
    )
    percent: FloatProperty(
        name="Remove",
        description="Share of the splats to remove, in per cent",
        subtype="PERCENTAGE",
        precision=1,
        default=50.0,
        min=0.0,
        max=99.99,
        update=plans.changed,
    )
    keep: IntProperty(
        name="Keep",
        description="How many splats stay",
        default=100_000,
        min=1,
        update=plans.changed,
    )
    max_mb: FloatProperty(
        name="MB",
        description="Size of the exported file, in megabytes of a million bytes",
        default=100.0,
        min=1e-6,
        update=plans.changed,
    )
    max_mb_in: EnumProperty(
        name="In", description="Format of the exported file",
        items=[(end, end, "") for end in SUFFIXES], update=plans.changed,
    )  # fmt: skip
    psnr: FloatProperty(
        name="PSNR (dB)",
        description="How close the pictures of the cameras stay to those of all splats, in dB: "
        "40 is hard to tell apart, 30 is visible",
        default=40.0,
        min=1.0,
        max=99.0,
        update=plans.changed,
    )
    protect: StringProperty(
        name="Protect",
        description="Vertex group, or boolean or float point attribute, whose splats stay",
        search=_protectable,
        search_options={"SORT", "SUGGESTION"},
        update=plans.mark_again,
    )
    volumes: CollectionProperty(
        name="Volumes", description="Objects that mark what must stay and go", type=RefineVolume
    )

    levels: StringProperty(
        name="Levels",
        description="Shares of the splats that stay in the levels of detail, the finest first",
        default="0.5, 0.25, 0.12, 0.06",
    )
    select_radius: FloatProperty(
        name="Radius",
        description="Radius of the brush, in pixels",
        subtype="PIXEL",
        default=40.0,
        min=1.0,
        max=1000.0,
    )
    select_hidden: BoolProperty(
        name="Through", description="Also select splats that others hide, behind surfaces"
    )
    select_tolerance: FloatProperty(
        name="Tolerance",
        description="How much red, green or blue may differ from the colour under the mouse",
        subtype="FACTOR",
        default=0.1,
        min=0.0,
        max=1.0,
    )
    select_connected: BoolProperty(
        name="Connected", description="Select only the connected piece under the mouse"
    )
    select_mode: EnumProperty(
        name="Mode", description="How Select By changes the selection", items=MODES
    )
    select_opacity: FloatProperty(
        name="Opacity", description="Limit of Opacity Below", default=0.1, min=0.0, max=1.0
    )
    select_size: FloatProperty(
        name="Size",
        description="Limit of Size Above: the longest standard deviation, units of the object",
        default=0.1,
        min=1e-6,
        precision=3,
    )

    @property
    def ratio(self) -> float:
        """Share of splats to remove, 0 to 1, from `percent`."""
        return decimal(decimal(self.percent) / 100.0)

    @ratio.setter
    def ratio(self, value: float) -> None:
        self.percent = 100.0 * value

    def to_method(self) -> Method:
        """Core's method."""
        return CORE_METHODS[self.method](self.views, exact=self.exact)

    def to_budget(self) -> Budget:
        """Core's budget."""
        value = getattr(self, self.budget)
        amount: dict[str, Any] = {self.budget: value if self.budget == "keep" else decimal(value)}
        return Budget(**amount)

    def to_form(self) -> Format | None:
        """Format whose file's size is the budget; None for plain PLY and other budgets."""
        return format_named(Path(self.max_mb_in)) if self.budget == "max_mb" else None

    def to_levels(self) -> Levels:
        """Core's levels of detail."""
        try:
            shares = tuple(float(word) for word in self.levels.split(","))
        except ValueError as error:
            raise RefineError(
                f"Levels is {self.levels!r}, expected numbers with commas between them"
            ) from error
        return Levels(shares)

    def to_frames(self, scene: bpy.types.Scene) -> range:
        """Frames whose views decide."""
        return range(scene.frame_start, scene.frame_end + 1, self.frame_step)

    def to_reasons(self) -> tuple[str, ...]:
        """Reasons for floaters, by core's names."""
        return _REASONS[self.strength]


PACKAGE = __package__.rpartition(".")[0]  # Such as ``bl_ext.user_default.refine_addon``
DEFAULTS = ("method", "views")  # Preferences that are scene settings of the same name


class RefinePreferences(_Preferred, bpy.types.AddonPreferences):
    """Defaults, in the extension's preferences."""

    bl_idname = PACKAGE

    upright: BoolProperty(name="Upright", description=UPRIGHT_TEXT)

    def draw(self, _context: bpy.types.Context) -> None:
        """Draw them."""
        layout = wrapped.named_column(self.layout)
        layout.label(text="Defaults for scenes into which splats are imported")
        for name in (*DEFAULTS, "upright"):
            layout.prop(self, name)


def fill(values: Any, context: bpy.types.Context, *names: str) -> None:
    """Set settings or an operator's properties from the preferences, unless they are set."""
    addon = context.preferences.addons.get(PACKAGE)
    for name in names if addon else ():
        if addon.preferences.is_property_set(name) and not values.is_property_set(name):
            setattr(values, name, getattr(addon.preferences, name))
