"""Plans: the effect of a budget, computed once its slider rests, never while drawing.
Likewise marks on protected and removed splats, renewed after a volume or a mark changed; changes
since scoring; values that panels keep until the scene changes."""

from __future__ import annotations

import contextlib
import math
from collections.abc import Callable, Hashable, Sequence
from typing import Any

import bpy
import numpy as np

from ..cameras import SOURCE, WEIGHT, CameraChoice, render_size
from ..core import ClosedForm, RefineError, prune
from ..core.execute import in_time
from ..core.operations import row_in
from ..core.quality.alignment import Alignment
from ..core.quality.curve import WAYS, Quality, expected_seconds, in_words, out_of_reach, parted
from ..core.report import MANY_UNSEEN, sizes_in_words
from ..core.scores import TELLING
from ..core.selection import Budget, quality_of
from ..core.splats import MODELS
from ..core.volumes import Forced
from ..mesh import attributes, edit, layout
from ..mesh import scores as mesh_scores
from ..objects import demands, splat_group
from . import images, operator_bases
from .wrapped import counted

REST = 0.2  # Seconds without a change after which a slider rests

_last: list[tuple[Any, dict[str, Any]]] = []  # The last plan, behind its key; empty without one

_rows: list[Any] = []  # What a splat takes in a format, behind format and objects

_waiting: list[tuple[str, str]] = []
"""Scene and objects, by name, to be marked when the slider rests."""

_values: dict[Hashable, Any] = {}  # What `cached` keeps
_NOISE = 1e-6  # Largest difference between machines, relative to the largest number in a list
_FITS = ("AUTO", "HORIZONTAL", "VERTICAL")

_WORDS = {
    "matrix": "object moved",
    "cameras": "cameras changed",
    "must_go": "what must go changed",
    "model": "Drawn As changed",
    "settings": "settings changed",
}


def changed(_settings: Any, context: bpy.types.Context) -> None:
    """Plan anew once the slider rests, in scripts at once. Settings call this."""
    obj = getattr(context, "object", None)  # not in every editor
    if obj is not None and (bpy.app.background or _can_have(obj)):
        _soon(context.scene, [obj], REST)


def refresh(context: bpy.types.Context) -> None:
    """Plan at once for the active object, or mark what goes if it has no scores."""
    obj = getattr(context, "object", None)
    if obj is not None:
        _refresh(context.scene, [obj])


def mark_again(_settings: Any, context: bpy.types.Context) -> None:
    """Renew the marks on protected and removed splats soon: of the active object or the first
    visible one, and of all that are selected, marked, scored, or searched for floaters."""
    active = getattr(context, "object", None)
    objects = [obj for obj in context.scene.objects if layout.looks_like_splats(obj)]
    first = [active] if active in objects else [obj for obj in objects if obj.visible_get()][:1]
    noted = {demands.RECORD, mesh_scores.RECORD, mesh_scores.FLOATERS}
    others = [obj for obj in objects if obj.select_get() or noted & set(obj.data.keys())]
    _soon(context.scene, [*first, *others], REST)


def stored(obj: bpy.types.Object, settings: Any) -> dict[str, Any] | None:
    """The plan of this object and budget, else None."""
    return _last[0][1] if _last and _last[0][0] == _key(obj, settings) else None


def shown(context: bpy.types.Context) -> dict[str, Any] | None:
    """The plan to draw; if there is none, one is made soon, and the last of the same scores is
    drawn meanwhile."""
    obj, settings = context.object, context.scene.refine
    plan = stored(obj, settings)
    if plan is None and not bpy.app.background and not _waiting and _can_have(obj):
        _soon(context.scene, [obj], 0.0)
    same = _waiting and _last and _last[0][0][0] == _key(obj, settings)[0]
    return _last[0][1] if same else plan


def sentence(plan: dict[str, Any]) -> str:
    """The splats and megabytes that a plan keeps, in words; not of a plan with an error.

    >>> plan = {"before": 100, "kept": 50, "bytes_before": 5e6, "bytes_after": 2.5e6}
    >>> sentence(plan | {"about": False})
    'Keeps 50 of 100, 2.5 of 5.0 MB'
    """
    about = "about " if plan["about"] else ""
    sizes = sizes_in_words(plan["bytes_after"], "of", plan["bytes_before"])
    return f"Keeps {about}{plan['kept']:,} of {plan['before']:,}, {sizes}"


def price(plan: dict[str, Any] | None, method: str) -> str:
    """A method's cost under a plan's budget, dB and seconds, "" if unknown."""
    curve: Quality | None = plan.get("quality") if plan else None
    if plan is None or curve is None or plan["closed"] != (method == ClosedForm.name):
        return ""
    way, share = method if method in WAYS else "delete", plan["share"]
    if way != "delete" and not curve.foretold:
        return ""
    words = in_words(curve.at(share, way))
    between = curve.at_between(share, way)
    if between is not None and in_words(between) != words:
        words += f", {in_words(between).removeprefix('about ').removesuffix(' dB')} between"
    seconds = plan["seconds"].get(way, 0.0)
    seconds = 60.0 * round(seconds / 60.0) if seconds > 60.0 else seconds  # rows are short
    return words + (f" · {in_time(seconds)}" if seconds else "")


def warnings(plan: dict[str, Any], record: dict[str, Any]) -> list[str]:
    """The panel's warnings on a plan without an error; `record`: of its scoring."""
    alignment = Alignment.from_facts(record.get("alignment"))
    curve, share, texts = plan["quality"], plan["share"], [alignment.turned()]
    if record["views_used"] < TELLING:
        texts.append("few cameras decide: add others if the splats are seen from elsewhere too")
    if curve is not None:
        way = plan["becomes"] if curve.foretold else "delete"
        between = curve.at_between(share, way)
        if parted(curve.at(share, way), between):
            texts.append(f"views between these lose more: {in_words(between)}")
    if none := sum(seen == 0 for _, seen in record.get("cameras") or ()):
        texts.append(f"no splat lies in the view of {counted(none, 'camera')}")
    texts.append(alignment.distant())
    unseen = plan["unseen"]
    if unseen >= MANY_UNSEEN * plan["before"]:
        go = f"{plan['unseen_removed'] / unseen:.0%} of these go"
        texts.append(f"{unseen / plan['before']:.0%} of the splats lie in no view; {go}")
    return [_sentence(text) for text in texts if text]


def _sentence(note: str) -> str:
    return note[:1].upper() + note[1:]


def _can_have(obj: bpy.types.Object) -> bool:
    return _is_ours(obj) and mesh_scores.record(obj.data) is not None


def _is_ours(obj: bpy.types.Object) -> bool:
    ours = layout.looks_like_splats(obj) and obj.mode != "EDIT"
    return ours and not obj.data.library and not obj.library


def _key(obj: bpy.types.Object, settings: Any) -> Any:
    meshes = [each.data for each in splat_group.chosen(obj)]
    counts = [layout.splat_count(mesh) for mesh in meshes]
    scorings = [(mesh.session_uid, mesh.get(mesh_scores.RECORD)) for mesh in meshes], counts
    volumes = [
        (item.role, item.object.session_uid, *map(tuple, item.object.matrix_world))
        for item in demands.listed(settings.id_data)
    ]
    amount = getattr(settings, settings.budget)
    budget = (settings.budget, amount, settings.max_mb_in, settings.method)
    return scorings, budget, settings.protect, volumes, images.look(bpy.context.preferences)


def _soon(scene: bpy.types.Scene, objects: Sequence[bpy.types.Object], seconds: float) -> None:
    """Schedule `_refresh` of these objects and of those that wait already; in scripts do it."""
    if bpy.app.background:
        _refresh(scene, objects)
        return
    pairs = [(scene.name, obj.name) for obj in objects]
    _waiting[:] = [*pairs, *(pair for pair in _waiting if pair not in pairs)]
    if bpy.app.timers.is_registered(_rested):
        bpy.app.timers.unregister(_rested)
    bpy.app.timers.register(_rested, first_interval=seconds)


def _rested() -> None:
    pairs = [(bpy.data.scenes.get(scene), bpy.data.objects.get(name)) for scene, name in _waiting]
    objects = [obj for scene, obj in pairs if scene is not None and obj is not None]
    if objects:
        _refresh(pairs[0][0] or bpy.context.scene, objects)
    _waiting.clear()
    operator_bases.redraw_panels(bpy.context)


def _refresh(scene: bpy.types.Scene, objects: Sequence[bpy.types.Object]) -> None:
    """Plan for each object, or mark its demands if it has no scores.
    One plan does for all objects of a scene. The first object's comes last, and so is kept."""
    leading: dict[tuple[bpy.types.Object, ...], bpy.types.Object] = {}  # an object of each scene
    for obj in objects:
        leading.setdefault(tuple(splat_group.chosen(obj)) if _can_have(obj) else (obj,), obj)
    bpy.context.view_layer.update()  # or volumes that a script moved are still elsewhere
    for obj in reversed(leading.values()):
        if _can_have(obj):
            try:
                plan = _plan(scene, obj)
            except RefineError as error:
                plan = {"error": str(error)}
            _last[:] = [(_key(obj, scene.refine), plan)]
        elif _is_ours(obj):
            with contextlib.suppress(RefineError):  # the panel shows it
                demands.refresh(scene, [layout.check(obj)])


def _plan(scene: bpy.types.Scene, obj: bpy.types.Object) -> dict[str, Any]:
    settings, record = scene.refine, mesh_scores.record(obj.data) or {}
    group = splat_group.members(obj)
    masks, budget = demands.refresh(scene, group), settings.to_budget()
    method = settings.to_method()
    arguments = splat_group.stored_arguments(group, budget, masks, method.deleting())
    scores, forced = arguments["scores"], Forced(**masks).counts()
    count, curve = len(scores.values), scores.quality
    left, way = count - forced["removed_by_user"], method.name if method.changes else "delete"
    form, uids = settings.to_form(), [member.mesh.session_uid for member in group]
    if form is not None:
        if (form, uids, count) != (_rows or [None])[0]:
            files = [attributes.read_for_file(member)() for member in group]
            _rows[:] = [(form, uids, count), row_in(form, files)]
        arguments["sizes"] = (_rows[1], 0)
    predicted = budget.psnr is not None and way != "delete"
    about = predicted or form is not None
    if predicted:
        gone = math.floor(quality_of(scores).share(budget.psnr, way) * left)
        arguments["budget"] = Budget(keep=max(left - min(gone, left - forced["protected"]), 1))
    result = prune(**arguments)
    splat_group.mark_removed(group, result.keep)
    counts = result.report["splats"]
    outcome = splat_group.Outcome.of(count, counts["kept"], *map(int, arguments["sizes"]))
    gone = left - outcome.kept
    share = gone / left
    becomes = "delete" if curve is None or curve.as_good(share, way) else way
    closed = record.get("method") == ClosedForm.name
    remark, seconds, views = "", {}, {}
    if curve is None:
        remark = "The views see too little to tell dB"
        if closed:
            remark = "Score by another method, or with Quality as the budget, to see dB"
    else:
        images.show_chart(curve, share)
        views = curve.of_views(share, becomes if curve.foretold else "delete")
        if budget.psnr is not None:
            remark = _sentence(out_of_reach(budget.psnr, gone, left, curve.at(share, becomes)))
        if record.get("seconds") and not closed:
            seconds = {**expected_seconds(record["seconds"], share, once=False), "delete": 0.0}
    return {
        **counts, **outcome._asdict(), "about": about, "share": share, "becomes": becomes,
        "quality": curve, "closed": closed, "seconds": seconds, "remark": remark, "views": views,
    }  # fmt: skip


def origin(obj: bpy.types.Object) -> dict[str, Any]:
    """An object's transform, the panel's cameras, and the settings that decide: JSON."""
    scene = bpy.context.scene
    method = scene.refine.to_method()
    return {
        "matrix": np.array(obj.matrix_world).tolist(),
        "frame": scene.frame_current,
        "cameras": _cameras(scene),
        "must_go": _marked(obj, 2),
        "model": obj.data.get(layout.MODEL, MODELS[0]),
        # All methods but the closed form score by occlusion.
        "settings": [method.name == "closed-form", method.views, method.exact],
    }


def stale(*objects: bpy.types.Object) -> list[str]:
    """Changes since any object was scored, in few words; none without an origin or in edit mode."""
    changes: dict[str, None] = {}
    for obj in (each for each in objects if each.mode != "EDIT"):  # there marks cannot be read
        record = mesh_scores.record(obj.data) or {}
        now = origin(obj)
        try:
            then = {name: record["origin"][name] for name in now}
            source, others = then["cameras"][0], now["cameras"]
        except (IndexError, KeyError, TypeError):  # not written by `origin`
            continue
        if source == "FRAMES" and then["frame"] != now["frame"]:
            then["matrix"] = now["matrix"]  # views of a shot follow the object as it moves
        if source == "SELECTED" and others[:2] == ["SELECTED", 0]:
            then["cameras"] = others  # selecting the splats deselected the cameras
        changes |= {_WORDS[name]: None for name in _WORDS if not _same(then[name], now[name])}
        if record.get("quality") and record.get("protected") != _marked(obj, 1):
            changes["what is protected changed"] = None
    return list(changes)


def _same(one: Any, other: Any, scale: float = 0.0) -> bool:
    """Whether JSON values are equal up to noise in lists of numbers."""
    if isinstance(one, list) and isinstance(other, list):
        scale = max((abs(each) for each in one if isinstance(each, float)), default=0.0)
        pairs = zip(one, other, strict=False)
        return len(one) == len(other) and all(_same(*pair, scale) for pair in pairs)
    if isinstance(one, float) and isinstance(other, float):
        return abs(one - other) <= _NOISE * scale
    return bool(one == other)


def _marked(obj: bpy.types.Object, kind: int) -> list[int]:
    force = attributes.attribute_if_any(obj.data, edit.FORCE, "INT")
    return mesh_scores.digest(None if force is None else force == kind)


def _cameras(scene: bpy.types.Scene) -> list[Any]:
    """Numbers by which a change of the deciding cameras is noticed, JSON."""
    choice = CameraChoice.of_scene(scene)
    if choice.source == "FRAMES":
        frames, name = choice.frames, scene.camera.name if scene.camera else ""
        return ["FRAMES", frames.start, frames.stop, frames.step, name]
    cameras = choice.cameras(bpy.context)
    chosen = ["SELECTED" if choice.source == "SELECTED" else "OTHERS", len(cameras)]
    if not cameras:
        return chosen
    frame = render_size(scene)
    numbers = np.array([_numbers(camera, frame) for camera in cameras])
    # Means and root mean squares, (2, C), which do not depend on the order of cameras.
    means = np.array([numbers.mean(axis=0), np.sqrt((numbers**2).mean(axis=0))])
    axes, place, rest = np.split(means, (9, 12), axis=1)
    return [*chosen, axes.ravel().tolist(), place.ravel().tolist(), *rest.T.tolist()]


def _numbers(camera: bpy.types.Object, frame: tuple[int, int, float]) -> tuple[float, ...]:
    matrix, data = np.array(camera.matrix_world), camera.data
    weight = camera.get(WEIGHT, 1.0)
    return (
        *(*matrix[:3, :3].ravel(), *matrix[:3, 3]),
        *(data.lens, data.sensor_width, data.sensor_height, data.shift_x, data.shift_y),
        *(data.clip_start, data.clip_end, _FITS.index(data.sensor_fit)),
        *((0, 0, 0) if SOURCE in camera else frame),  # imported ones keep the size of their file
        weight if isinstance(weight, (int, float)) else -1.0,
    )


def cached(what: Hashable, compute: Callable[[], Any]) -> Any:
    """Value of `compute` (of the scene, active object, settings), kept until anything changes.
    A script's silent changes, such as custom properties, show after the next change."""
    scene, obj = bpy.context.scene, bpy.context.object
    settings = scene.refine
    values = repr([getattr(settings, each.identifier) for each in settings.bl_rna.properties])
    key = (what, scene.session_uid, obj and obj.session_uid, values)
    if key not in _values:
        _values[key] = compute()
    return _values[key]


def _forget(*_arguments: object) -> None:
    _values.clear()


def _undone(*_: object) -> None:
    """After undo or redo, mark again what may differ, and draw the right chart."""
    _forget()
    _last.clear()
    if not bpy.app.background:
        (mark_again if bpy.context.scene.refine.volumes else changed)(None, bpy.context)


def _updated(scene: bpy.types.Scene, depsgraph: bpy.types.Depsgraph | None = None) -> None:
    """Renew the marks after volumes, or splats, have moved."""
    _forget()
    if depsgraph is None or bpy.app.background or not scene.refine.volumes:
        return
    volumes = {item.object for item in demands.listed(scene)}
    shapes = volumes | {obj.data for obj in volumes}
    for update in depsgraph.updates if volumes else ():
        original = update.id.original
        moved = update.is_updated_transform and isinstance(original, bpy.types.Object)
        if original in shapes or (moved and layout.looks_like_splats(original)):
            mark_again(None, bpy.context)
            return


HANDLERS = {
    _undone: ("undo_post", "redo_post", "load_post"),
    _updated: ("depsgraph_update_post",),
    _forget: ("frame_change_post",),
}


def unregister() -> None:
    """Stop the timer, and forget all plans."""
    if bpy.app.timers.is_registered(_rested):
        bpy.app.timers.unregister(_rested)
    for kept in (_last, _waiting, _values, _rows):
        kept.clear()
