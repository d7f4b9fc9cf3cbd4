"""What the user sets in the panel, and its conversion to the settings of core."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
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

from ..core.cleaning.clean import DEFAULT_REASONS
from ..core.errors import RefineError
from ..core.formats.ply import REQUIRED
from ..core.lod import Levels
from ..core.methods import METHODS as CORE_METHODS
from ..core.methods import Merge, Method, Refit
from ..core.selection import Budget
from ..core.splats import MODELS
from ..mesh import floaters
from ..mesh import layout as mesh_layout
from ..mesh.edit import MARKING
from . import plans
from .select_panel import SelectSettings
from .volumes import RefineVolume

METHODS = (
    (
        "closed-form",
        "Closed Form",
        "REFINE's formula; takes nothing as hidden. Rows stay as they were",
    ),
    ("occlusion", "Occlusion", "Knows what hides what; deletes. Rows stay as they were"),
    (
        "merge",
        "Merge",
        "What goes is merged into what stays, by what the cameras see of it; deletes where that is "
        "as good",
    ),
    (
        "refit",
        "Refit",
        "Merges, then fits what stays to what all splats looked like: closest, and slowest",
    ),
)
"""The dial, from instant to best, by the names of core."""

BUDGETS = (
    ("ratio", "Share", "Remove this share of the splats"),
    ("keep", "Count", "Keep this many splats"),
    ("max_mb", "File Size", "Keep as many splats as fit in a file of this size"),
    ("threshold", "Score", "Remove splats that score below this"),
    ("min_seen", "Views", "Remove splats that lie in fewer than this share of the views"),
    ("psnr", "Quality", "Remove as many splats as leave the pictures this close to the unpruned"),
)
"""Kinds of budget, by the names that core gives them."""

UPRIGHT_TEXT = (
    "Turn the object, not the data, a quarter about X: from the y-down world of COLMAP to the "
    "z-up world of Blender"
)

VIEWS: dict[str, Any] = {
    "name": "Views",
    "description": "Use at most this many views, spread out evenly; 0 uses all",
    "default": Merge.views,
    "min": 0,
}

AMOUNTS: dict[str, dict[str, Any]] = {
    "budget": {
        "name": "Budget",
        "description": "How the number of splats that go is given",
        "items": BUDGETS,
    },
    "percent": {
        "name": "Remove",
        "description": "Share of the splats to remove, in per cent",
        "subtype": "PERCENTAGE",
        "precision": 1,
        "default": 50.0,
        "min": 0.0,
        "max": 99.99,
    },
    "keep": {
        "name": "Keep",
        "description": "How many splats stay",
        "default": 100_000,
        "min": 1,
    },
    "max_mb": {
        "name": "MB",
        "description": "Size of the exported file, in megabytes of a million bytes",
        "default": 100.0,
        "min": 1e-6,
    },
    "threshold": {
        "name": "Score",
        "description": "Splats that score below this are removed",
        "default": 0.01,
        "precision": 5,
    },
    "min_seen": {
        "name": "Seen by",
        "description": "Splats that lie in fewer than this share of the views are removed",
        "subtype": "PERCENTAGE",
        "default": 1.0,
        "min": 0.0,
        "max": 100.0,
    },
    "psnr": {
        "name": "PSNR (dB)",
        "description": "How close the pictures of the cameras stay to those of all splats, in dB: "
        "40 is hard to tell apart, 30 is visible",
        "default": 40.0,
        "min": 1.0,
        "max": 99.0,
    },
    "method": {
        "name": "Method",
        "description": "How splats are pruned, from instant to best",
        "items": METHODS,
        "default": Merge.name,
    },
    "rounds": {
        "name": "Rounds",
        "description": "Refit so many times at most, each time to other rays. 0: 2 to 4 times, "
        "fewer of more splats; more rounds bring up to 1 dB, and take longer",
        "default": 0,
        "min": 0,
        "max": 100,
    },
}
"""How much is removed, and how: properties of the panel and of *Apply*."""

DRAWN = (
    ("default", "Default", "As ordinary 3D Gaussian splats"),
    (
        "antialiased",
        "Antialiased",
        "Trained with antialiasing (Mip-Splatting, gsplat, Brush, Postshot)",
    ),
    ("2dgs", "2DGS", "Flat discs without a third scale"),
)
"""How splats are drawn, by the names of `rendering.MODELS` and in their order."""

FLOATERS = (
    ("front", "In Front", "Stands in front of a surface, and cameras see past it"),
    ("isolated", "Isolated", "Is in a small cluster that touches nothing else"),
    ("giant", "Giant", "Is a huge veil across the pictures"),
    ("needle", "Needle", "Is long and thin, and crosses the pictures"),
    ("transparent", "Transparent", "Floats, but no picture changes visibly without it"),
    ("haze", "Haze", "Floats near a camera, faint; no picture changes visibly without one of it"),
    ("outside", "Outside", "Lies outside all views: none of the cameras can judge it"),
)
"""Reasons why a splat floats, by the names that core gives them."""

SOURCES = (
    ("VISIBLE", "Visible", "All cameras that are visible in the scene"),
    ("ACTIVE", "Active", "The scene's active camera, at the current frame"),
    ("SELECTED", "Selected", "The cameras that are selected"),
    ("COLLECTION", "Collection", "The cameras of a collection, hidden ones too"),
    ("FRAMES", "Frames", "The active camera at each frame of a range: an animated shot"),
)


def _plan_again(_settings: RefineSettings, context: bpy.types.Context) -> None:
    plans.changed(context)


def _percent(settings: RefineSettings) -> float:
    return 100.0 * decimal(settings.ratio)


def _set_percent(settings: RefineSettings, value: float) -> None:
    settings.ratio = decimal(value) / 100.0


def _model(_settings: RefineSettings) -> int:
    obj = getattr(bpy.context, "object", None)
    if not mesh_layout.looks_like_splats(obj):
        return 0
    try:
        return MODELS.index(mesh_layout.layout_of(obj).model)
    except RefineError:
        return 0


def _set_model(_settings: RefineSettings, value: int) -> None:
    obj = getattr(bpy.context, "object", None)
    if mesh_layout.looks_like_splats(obj):
        obj.data[mesh_layout.MODEL] = MODELS[value]
        obj.data.update_tag()


def _mark_floaters(settings: RefineSettings, context: bpy.types.Context) -> None:
    """Mark the floaters of the reasons chosen as what goes, if they were looked for."""
    obj = getattr(context, "object", None)  # not in every editor
    if not mesh_layout.looks_like_splats(obj) or floaters.counts(obj.data) is None:
        return
    if obj.mode == "EDIT":
        return
    with contextlib.suppress(RefineError):  # *Delete Floaters* says what is wrong
        floaters.mark(mesh_layout.check(obj), settings.reasons)


def _protectable(
    _settings: RefineSettings, context: bpy.types.Context, _text: str
) -> Iterator[str]:
    """Suggest what the active object has that can protect splats."""
    obj = context.object
    if mesh_layout.looks_like_splats(obj):
        yield from (group.name for group in obj.vertex_groups)
        for attribute in obj.data.attributes:
            ours = attribute.name.startswith((".", "refine_", "f_rest_"))
            ours = ours or attribute.name in {*REQUIRED, "radius"}
            if attribute.data_type in MARKING and attribute.domain == "POINT" and not ours:
                yield attribute.name


def decimal(value: float) -> float:
    """Return the number that the user typed: Blender keeps 0.29 as 0.28999999165534973.

    Without this, the panel would remove another number of splats than the command.

    Examples
    --------
    >>> decimal(0.28999999165534973)
    0.29
    """
    return float(str(np.float32(value)))


class RefineSettings(SelectSettings, bpy.types.PropertyGroup):
    """Settings of the panel, at ``scene.refine``."""

    method: EnumProperty(**AMOUNTS["method"], update=_plan_again)
    model: EnumProperty(
        name="Drawn As",
        description="How the splats of the active object are drawn, in all of the panel and in the "
        "exported file; by default as the imported file says",
        items=DRAWN,
        get=_model,
        set=_set_model,
    )
    views: IntProperty(**VIEWS)
    source: EnumProperty(name="Cameras", description="Which cameras decide", items=SOURCES)
    collection: PointerProperty(
        name="Collection", description="The collection of the cameras", type=bpy.types.Collection
    )
    scene_frames: BoolProperty(
        name="Scene Range", description="Use the frame range of the scene", default=True
    )
    frame_start: IntProperty(name="Start", description="First frame", default=1)
    frame_end: IntProperty(name="End", description="Last frame", default=250)
    frame_step: IntProperty(name="Step", description="Every how many frames", default=10, min=1)
    reasons: EnumProperty(
        name="Floaters",
        description="What counts as a floater",
        items=FLOATERS,
        options={"ENUM_FLAG"},
        default=set(DEFAULT_REASONS),
        update=_mark_floaters,
    )
    budget: EnumProperty(**AMOUNTS["budget"], update=_plan_again)
    ratio: FloatProperty(
        name="Remove",
        description="Share of the splats to remove",
        subtype="FACTOR",
        default=0.5,
        min=0.0,
        max=0.9999,
        update=_plan_again,
    )
    percent: FloatProperty(**AMOUNTS["percent"], get=_percent, set=_set_percent)
    keep: IntProperty(**AMOUNTS["keep"], update=_plan_again)
    max_mb: FloatProperty(**AMOUNTS["max_mb"], update=_plan_again)
    threshold: FloatProperty(**AMOUNTS["threshold"], update=_plan_again)
    min_seen: FloatProperty(**AMOUNTS["min_seen"], update=_plan_again)
    psnr: FloatProperty(**AMOUNTS["psnr"], update=_plan_again)
    rounds: IntProperty(**AMOUNTS["rounds"], update=_plan_again)
    protect: StringProperty(
        name="Protect",
        description="Vertex group, or boolean or float point attribute: the splats in it stay",
        search=_protectable,
        search_options={"SORT", "SUGGESTION"},
        update=_plan_again,
    )
    volumes: CollectionProperty(
        name="Volumes", description="Objects that mark what must stay and go", type=RefineVolume
    )

    levels: StringProperty(
        name="Levels",
        description="Shares of the splats that stay in the levels of detail, the finest first",
        default="0.5, 0.25, 0.12, 0.06",
    )

    def to_method(self) -> Method:
        """The method of core; raises `RefineError` where a value cannot be."""
        if self.method == Refit.name:
            return Refit(self.views, self.rounds or None)
        return CORE_METHODS[self.method](self.views)

    def to_budget(self) -> Budget:
        """Return the budget of core.

        Raises
        ------
        RefineError
            If it cannot be.
        """
        value = getattr(self, self.budget)
        amount: dict[str, Any] = {self.budget: value if self.budget == "keep" else decimal(value)}
        return Budget(**amount)

    def to_levels(self) -> Levels:
        """Return the levels of detail of core.

        Raises
        ------
        RefineError
            If they cannot be.
        """
        try:
            shares = tuple(float(word) for word in self.levels.split(","))
        except ValueError as error:
            raise RefineError(
                f"Levels is {self.levels!r}, expected numbers with commas between them"
            ) from error
        return Levels(shares)

    def to_frames(self, scene: bpy.types.Scene) -> range:
        """Return the frames whose views count."""
        if self.scene_frames:
            return range(scene.frame_start, scene.frame_end + 1, self.frame_step)
        return range(self.frame_start, self.frame_end + 1, self.frame_step)


CLASSES = (RefineSettings,)
