"""What the budget of the panel would do, worked out when something changes, not when drawn.

What a slider needs at once, the number of splats that stay and what they cost, is looked up in a
table of the last scoring (`_Known`). What takes longer at a million splats waits until the slider
has come to rest (`refresh`): reading what is protected, marking what goes.
"""

from __future__ import annotations

import contextlib
import json
import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import bpy
import numpy as np
from bpy.app.handlers import persistent

from ..core.errors import RefineError
from ..core.execute import in_time
from ..core.methods import Occlusion
from ..core.prune import prune
from ..core.quality.alignment import Alignment
from ..core.quality.curve import (
    WAYS,
    Way,
    expected_seconds,
    in_views,
    in_words,
    out_of_reach,
    parted,
)
from ..core.report import MANY_UNSEEN, little_seen, sizes_in_words
from ..core.scores import Scores
from ..core.selection import Budget, Tally, quality_of
from ..mesh import layout as mesh_layout
from ..mesh import scores as mesh_scores
from ..mesh.records import parsed
from ..objects import demands, splat_group
from ..objects.splat_group import Outcome
from . import camera_list, price
from .chart import Histogram, Place

PLAN = "refine_plan"
"""Custom property of the mesh: the last plan, or why there is none, as JSON."""

REST = 0.2
"""Seconds without a change after which a slider has come to rest."""


@dataclass(frozen=True, eq=False)
class _Known:
    """What does not change while the budget does: of one object at one scoring."""

    state: tuple[Any, ...]
    tally: Tally
    row_bytes: int
    fixed_bytes: int
    kinds: Histogram
    unseen: int
    little_seen: str
    forced: int
    scored_s: float | None = None

    @property
    def count(self) -> int:
        """How many splats there are in all."""
        return len(self.tally.scores.values) + self.forced


_known: list[_Known] = []
"""One at most: that of the object that was looked at last."""

_waiting: list[tuple[str, str]] = []
"""Names of scene and objects whose plans are to be made as soon as the slider rests."""

_tried: list[tuple[Any, ...]] = []
"""For what the panel last asked to have a plan made; one at most. Not each draw asks again."""


def register() -> None:
    """Hear of undo."""
    for listening in (bpy.app.handlers.undo_post, bpy.app.handlers.redo_post):
        listening.append(_undone)


def unregister() -> None:
    """Forget all, and make no more plans."""
    for listening in (bpy.app.handlers.undo_post, bpy.app.handlers.redo_post):
        listening.remove(_undone)
    if bpy.app.timers.is_registered(_rested):
        bpy.app.timers.unregister(_rested)
    for kept in (_known, _waiting, _tried):
        kept.clear()


def key(settings: Any) -> str:
    """Return what a plan depends on; a stored plan of another key is out of date."""
    budget = f"{settings.budget} {getattr(settings, settings.budget)!r} {_demanded(settings)!r}"
    return f"{budget} {settings.rounds} {settings.method}"


def changed(context: bpy.types.Context) -> None:
    """Take in another budget: say at once what it comes to, and do the rest when it rests."""
    obj = getattr(context, "object", None)  # not in every editor
    if bpy.app.background:
        refresh(context)
    elif obj is not None and _can_have(obj):
        at_once(context.scene, obj)
        wait(context.scene, [obj], REST)


def at_once(scene: bpy.types.Scene, obj: bpy.types.Object) -> None:
    """Store what the budget comes to, if enough is known of the object; nothing is marked yet."""
    settings, mesh = scene.refine, obj.data
    objects = _objects(obj)
    if not _known or _known[0].state != _state(objects, settings):
        return
    plan = _noted(_known[0], settings) | {"key": _key(settings, objects)}
    mesh[PLAN] = json.dumps(plan | {"marked": False})
    price.move(mesh, _place(plan))
    _tell_cameras(_known[0].tally.scores, plan)


def refresh(context: bpy.types.Context) -> None:
    """Work out the plan for the active object if it has scores, store it, and mark what goes."""
    obj = getattr(context, "object", None)
    if obj is not None:
        refresh_object(context.scene, obj)


def refresh_object(scene: bpy.types.Scene, obj: bpy.types.Object) -> None:
    """Do the same for any object; without scores, mark what must stay and what must go."""
    if _can_have(obj):
        _refresh(scene, obj)
    elif _is_ours(obj):
        with contextlib.suppress(RefineError):  # which the panel shows
            demands.refresh(scene, [mesh_layout.check(obj)])


def refresh_objects(scene: bpy.types.Scene, objects: Sequence[bpy.types.Object]) -> None:
    """Do the same for several objects; the first is the one looked at, so it is done last."""
    done: set[bpy.types.Object] = set()
    first_of = []
    for obj in objects:
        if obj not in done:
            first_of.append(obj)
            done.update(_objects(obj) if _can_have(obj) else [obj])
    for obj in reversed(first_of):
        refresh_object(scene, obj)


def ask(context: bpy.types.Context, obj: bpy.types.Object) -> None:
    """Have a plan and its chart made soon where they are missing; to be called when drawn."""
    settings, mesh = context.scene.refine, obj.data
    plan = stored(obj, settings)
    objects = _objects(obj)
    drawn = price.shows(mesh) and price.fits(context.preferences)
    if bpy.app.background or (plan and drawn and plan.get("marked", True)) or not _can_have(obj):
        return
    state = (
        *_state(objects, settings),
        _key(settings, objects),
        price.look_of(context.preferences),
    )
    if _tried != [state] and not _waiting:
        _tried[:] = [state]
        wait(context.scene, [obj], 0.0)


def wait(scene: bpy.types.Scene, objects: Sequence[bpy.types.Object], seconds: float) -> None:
    """Have `refresh_objects` done after so long, or later if it is asked for others meanwhile."""
    asked = [(scene.name, obj.name) for obj in objects]
    _waiting[:] = [*asked, *(pair for pair in _waiting if pair not in asked)]
    if bpy.app.timers.is_registered(_rested):
        bpy.app.timers.unregister(_rested)
    bpy.app.timers.register(_rested, first_interval=seconds)


def stored(obj: bpy.types.Object, settings: Any) -> dict[str, Any] | None:
    """Return the stored plan if it is that of the current budget and mesh, else None."""
    try:
        plan: dict[str, Any] = parsed(obj.data[PLAN])
        objects = _objects(obj)
        count = sum(mesh_layout.splat_count(each.data) for each in objects)
        current = plan["key"] == _key(settings, objects) and plan["splats"] == count
    except (KeyError, TypeError, ValueError):
        return None
    return plan if current else None


def forget(mesh: bpy.types.Mesh) -> None:
    """Remove the stored plan."""
    if PLAN in mesh:
        del mesh[PLAN]


def sentence(plan: dict[str, Any]) -> str:
    """Return what a plan without an error comes to, as one sentence.

    Parameters
    ----------
    plan : dict
        See `stored`.

    Examples
    --------
    >>> plan = {"splats": 100, "kept": 50, "bytes_before": 5e6, "bytes_after": 2.5e6}
    >>> plan |= {"psnr": 38.2, "psnr_merged": 45.9, "psnr_refitted": 48.9, "becomes": "merge"}
    >>> sentence(plan).removeprefix("Keeps 50 of 100, 2.5 of 5.0 MB, ")
    'about 46 dB in these views (Occlusion: about 38, Refit: about 49)'
    >>> sentence(plan | {"psnr_between": 36.3}).removeprefix("Keeps 50 of 100, 2.5 of 5.0 MB, ")
    'about 46 dB in these views, about 36 between them (Occlusion: about 38, Refit: about 49)'
    """
    text = (
        f"Keeps {'about ' if plan.get('about') else ''}{plan['kept']:,} of {plan['splats']:,}, "
        + sizes_in_words(plan["bytes_after"], "of", plan["bytes_before"])
    )
    if "psnr" not in plan:
        return text
    if "psnr_merged" not in plan:  # not predicted
        unless = " by deleting" if plan["becomes"] != "delete" else ""
        return f"{text}, {in_views(plan['psnr'], plan.get('psnr_between'))}{unless}"
    ways: dict[Way, str] = dict(zip(WAYS, ("psnr", "psnr_merged", "psnr_refitted"), strict=True))
    # Deleting is done at once.
    taken = dict(plan.get("seconds", ()), delete=None)
    times = {name: f" in {in_time(taken[name])}" if taken.get(name) else "" for name in WAYS}
    way = plan["becomes"]
    here = in_views(plan[ways.pop(way)], plan.get("psnr_between")) + times[way]
    names: dict[str, str] = {"delete": "Occlusion", "merge": "Merge", "refit": "Refit"}
    others = ", ".join(
        f"{names[name]}: {in_words(plan[key]).removesuffix(' dB')}{times[name]}"
        for name, key in ways.items()
    )
    return f"{text}, {here} ({others})"


def remark(plan: dict[str, Any], record: dict[str, Any]) -> str:
    """Return what else there is to say of a plan and of the scoring, or ""."""
    if "psnr" in plan:
        return str(plan.get("remark", ""))
    if record.get("method") == "closed-form":
        return "Score by another method, or with Quality as the budget, to see dB"
    return "The views see too little to tell dB"


@dataclass(frozen=True)
class Warned:
    """What the cameras do not know, and what can be done about it.

    Attributes
    ----------
    text : str
        A sentence.
    remedy : str
        Name of an operator; "" where none helps.
    options : dict of str to Any
        Its properties.
    """

    text: str
    remedy: str = ""
    options: dict[str, Any] = field(default_factory=dict)


def warnings(plan: dict[str, Any], record: dict[str, Any]) -> list[Warned]:
    """Return what the cameras do not know, as far as it matters to a plan.

    Parameters
    ----------
    plan : dict
        See `stored`.
    record : dict
        The record of the scoring.
    """
    alignment = Alignment.from_facts(record.get("alignment"))
    warned = [turned(alignment)] if alignment.turn else []
    if record["views_used"] == 1:
        text = "One camera decides: add others if the splats are seen from elsewhere too"
        warned.append(Warned(text, "refine.add_ring"))
    some_useful = len(camera_list.useless(record)) < len(record.get("cameras") or ())
    remedy = "refine.leave_out" if some_useful else "refine.add_ring"
    if plan.get("parted"):
        text = f"Views between these lose more: {in_words(plan['psnr_between'])}"
        warned.append(Warned(text, "refine.add_between"))
    texts = (camera_list.warning(record), _sentence(alignment.distant()))
    warned += [Warned(text, remedy) for text in texts if text]
    unseen = plan.get("unseen", 0)
    if unseen >= MANY_UNSEEN * plan["splats"]:
        text = f"{unseen / plan['splats']:.0%} of the splats lie in no view"
        if "unseen_gone" in plan:
            text += f"; {plan['unseen_gone'] / unseen:.0%} of these go"
        some_go = plan.get("unseen_gone") != 0
        warned.append(Warned(text, "refine.keep_unseen" if some_go else ""))
    elif plan.get("little_seen"):
        warned.append(Warned(_sentence(plan["little_seen"]), "refine.add_ring"))
    return warned


def turned(alignment: Alignment) -> Warned:
    """Return the warning of cameras that are to be turned."""
    options = {"quarter": str(alignment.turn)}
    return Warned(_sentence(alignment.turned()), "refine.turn_cameras", options)


def _sentence(note: str) -> str:
    """Return what core says as a sentence of the panel."""
    return note[:1].upper() + note[1:]


def _can_have(obj: bpy.types.Object) -> bool:
    """Tell whether an object can have a plan: it is scored, and may be written to."""
    return _is_ours(obj) and mesh_scores.record(obj.data) is not None


def _is_ours(obj: bpy.types.Object) -> bool:
    """Tell whether an object holds splats that may be marked."""
    if not mesh_layout.looks_like_splats(obj) or obj.mode == "EDIT":
        return False
    return not obj.data.library and not obj.library


@persistent
def _undone(*_: object) -> None:
    """Draw the chart anew after undo, which brings back the plan but not the picture of it."""
    obj = getattr(bpy.context, "object", None)
    if not bpy.app.background and obj is not None and _can_have(obj):
        wait(bpy.context.scene, [obj], 0.0)


def _rested() -> None:
    """Make the plan that is waited for; Blender's timer calls it once."""
    pairs = [(bpy.data.scenes.get(scene), bpy.data.objects.get(name)) for scene, name in _waiting]
    objects = [obj for scene, obj in pairs if scene is not None and obj is not None]
    if objects:
        refresh_objects(pairs[0][0], objects)
    _waiting.clear()
    for window in bpy.context.window_manager.windows:
        for area in window.screen.areas:
            if area.type == "VIEW_3D":
                area.tag_redraw()


def _refresh(scene: bpy.types.Scene, obj: bpy.types.Object) -> None:
    settings, mesh, objects = scene.refine, obj.data, _objects(obj)
    bpy.context.view_layer.update()  # or volumes that a script moved are not yet there
    camera_list.fill(mesh_scores.record(mesh) or {})
    count = sum(mesh_layout.splat_count(each.data) for each in objects)
    depends: dict[str, Any] = {"key": _key(settings, objects), "splats": count}
    plan = depends
    try:
        group = splat_group.members(bpy.context.view_layer, mesh_layout.check(obj))
        forced = splat_group.refresh(scene, group)
        arguments = splat_group.stored_arguments(
            group, settings.to_budget(), forced, Occlusion(settings.views)
        )
        known = _know(arguments, _state(objects, settings), _scored_s(mesh))
        plan = _noted(known, settings) | depends
        keep = prune(**arguments).keep
        splat_group.mark_removed(group, keep)
        removed = arguments["removed"]
        keep = keep if removed is None else keep[~removed]
        plan["unseen_gone"] = int(np.count_nonzero(~keep & (known.tally.scores.seen == 0)))
        price.show(mesh, known.tally.scores, known.kinds, _place(plan), keep)
        _tell_cameras(known.tally.scores, plan)
    except RefineError as error:
        plan["error"] = str(error)
    mesh[PLAN] = json.dumps(plan)


def _objects(obj: bpy.types.Object) -> list[bpy.types.Object]:
    """Return the objects that a plan is for: those that *Apply* would work on."""
    return splat_group.chosen(bpy.context.view_layer, obj)


def _key(settings: Any, objects: list[bpy.types.Object]) -> str:
    """Return what a plan for several objects depends on; see `key`."""
    others = [obj.name for obj in objects] if len(objects) > 1 else []
    return " ".join([key(settings), *map(repr, others)])


def _scored_s(mesh: bpy.types.Mesh) -> float | None:
    """Return how long scoring by *occlusion* took, seconds."""
    record = mesh_scores.record(mesh) or {}
    seconds = None if record.get("method") == "closed-form" else record.get("seconds")
    return float(seconds) if isinstance(seconds, (int, float)) else None


def _know(arguments: dict[str, Any], state: tuple[Any, ...], scored_s: float | None) -> _Known:
    """Return what holds for any budget; what was known before, where it still does."""
    scores, protected, removed = (arguments[name] for name in ("scores", "protected", "removed"))
    gone = 0
    if removed is not None:
        rest = ~removed if protected is None else ~removed | protected
        gone = int(np.count_nonzero(~rest))
        scores = scores.of(rest)
        protected = None if protected is None else protected[rest]
    old = _known[0] if _known else None
    if old is not None and old.state == state and old.tally.is_of(scores, protected):
        return old
    kinds = price.histogram(scores)
    tally, unseen = Tally(scores, protected), int(np.count_nonzero(scores.seen == 0))
    known = _Known(
        state,
        tally,
        *map(int, arguments["sizes"]),
        kinds,
        unseen,
        little_seen(scores.seen),
        gone,
        scored_s,
    )
    _known[:] = [known]
    return known


def _state(objects: list[bpy.types.Object], settings: Any) -> tuple[Any, ...]:
    """Return what tells a scoring of objects from another, and what is protected in them."""
    scorings = tuple(
        (
            obj.data.session_uid,
            mesh_layout.splat_count(obj.data),
            obj.data.get(mesh_scores.RECORD),
        )
        for obj in objects
    )
    return scorings, _demanded(settings)


def _demanded(settings: Any) -> tuple[Any, ...]:
    """Return the names and the volumes that say what must stay and go, and where these stand."""
    return (
        settings.protect,
        *(
            (item.role, item.object.session_uid, *map(tuple, item.object.matrix_world))
            for item in demands.listed(settings.id_data)
        ),
    )


def _noted(known: _Known, settings: Any) -> dict[str, Any]:
    """Return the plan for a budget as plain values."""
    count, rest = known.count, known.count - known.forced
    plan: dict[str, Any] = {"key": key(settings), "splats": count, "unseen": known.unseen}
    try:
        budget = settings.to_budget()
        becomes = _way(settings)
        removed, about = _removed(known, budget, becomes)
    except RefineError as error:
        return plan | {"error": str(error)}
    if about:
        plan["about"] = True
    outcome = Outcome.of(count, rest - removed, known.row_bytes, known.fixed_bytes)
    curve = known.tally.scores.quality
    if becomes == "merge" and (curve is None or curve.as_good(removed / rest)):
        becomes = "delete"
    plan |= {**vars(outcome), "forced": known.forced, "becomes": becomes}
    if curve is None:
        return plan
    plan["psnr"] = curve.at(removed / rest)
    told: Way = becomes if curve.foretold else "delete"
    between = curve.at_between(removed / rest, told)
    if between is not None:
        plan["psnr_between"] = between
        plan["parted"] = parted(curve.at(removed / rest, told), between)
        plan["little_seen"] = known.little_seen
    if known.scored_s is not None:
        plan["seconds"] = expected_seconds(known.scored_s, removed / rest, once=False)
    if curve.foretold:
        plan["psnr_merged"] = curve.at(removed / rest, "merge")
        plan["psnr_refitted"] = curve.at(removed / rest, "refit")
    if budget.psnr is not None:
        psnr = curve.at(removed / rest, becomes)
        plan["remark"] = _sentence(out_of_reach(budget.psnr, removed, rest, psnr))
    return plan


def _way(settings: Any) -> Way:
    """What the method of the panel does."""
    changing: dict[str, Way] = {"merge": "merge", "refit": "refit"}
    return changing.get(settings.method, "delete")


def _removed(known: _Known, budget: Budget, way: Way) -> tuple[int, bool]:
    """Return how many splats a budget removes beside those that must go, and whether it is a guess.

    Raise `RefineError` if the budget means nothing to the scores.
    """
    if budget.psnr is not None and way != "delete":
        share = quality_of(known.tally.scores).share(budget.psnr, way)
        rest = known.count - known.forced
        return min(math.floor(share * rest), known.tally.free), True
    left = budget.after(known.forced, known.count)
    return known.tally.removed(left, known.row_bytes, known.fixed_bytes), False


def _tell_cameras(scores: Scores, plan: dict[str, Any]) -> None:
    """Have the list of the cameras say how much of each picture a plan changes."""
    curve, place = scores.quality, _place(plan)
    if curve is None or place is None:
        camera_list.tell({})
        return
    way = place.way if curve.foretold else "delete"
    camera_list.tell(curve.of_views(place.share, way))


def _place(plan: dict[str, Any]) -> Place | None:
    if "error" in plan:
        return None
    forced = plan["forced"]  # the chart is of the others
    return Place((plan["removed"] - forced) / (plan["splats"] - forced), plan["becomes"])
