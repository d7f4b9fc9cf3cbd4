"""*Render with Splats*: an operator that has Blender do one render after another.
F12 does not show splats: the status bar names the right button."""

from __future__ import annotations

import sys
import time
from collections.abc import Generator
from functools import partial
from types import SimpleNamespace
from typing import Any

import bpy
import numpy as np
from bpy.props import BoolProperty

from .. import main_thread
from ..core import Cancelled
from ..render import card, engine, meshes
from ..viewport import draw as viewport_draw
from .images import put
from .operator_bases import Answer, Needing, Running, fail, idle
from .wrapped import counted

IMAGE = "Render with Splats"  # Name of the image with the last frame

_NEEDS_WINDOW = bpy.app.version < (5, 0, 0)
"""Whether Blender frees the GPU data of a running render whose scene no window shows (its
`RE_FreeUnusedGPUResources`). One frame in 60 crashed Blender 4.3 on X11."""

_SETTLED = 0.5  # Seconds after a render until windows have drawn; see `_draw_whole`
NOTICE = "Splats are not in this render: use Render > Render with Splats"
IN_BACKGROUND = "refine: splats are not in this render; use --command refine render"
_LINGERS = 10.0  # Seconds that `NOTICE` stays after the render
_until: list[float] = []  # Time until which `NOTICE` is shown

_watched: list[engine.Shared] = []
"""The render that Esc stops. A watcher keeps the list of its start, and ends once that is empty."""


def _watch_anew(shared: engine.Shared) -> None:
    """Watch for Esc ahead of other handlers, in all windows: one may show the render."""
    global _watched
    _watched.clear()
    _watched = [shared]
    for window in bpy.context.window_manager.windows:
        with bpy.context.temp_override(window=window):
            bpy.ops.refine.watch_render("INVOKE_DEFAULT")


def no_render(_context: bpy.types.Context) -> str:
    """A need: no render runs."""
    return "A render is under way" if bpy.app.is_job_running("RENDER") else ""


class REFINE_OT_watch_render(bpy.types.Operator):
    """Stop a render with splats at Esc, which Blender's render gets as well"""

    # Blender passes an event first to the modal operator that started last. Blender's own render
    # passes Esc to no other, even if it has just ended by itself and so is not stopped.
    bl_label = "Watch a Render"
    bl_options = {"INTERNAL"}

    def invoke(self, context: bpy.types.Context, _event: bpy.types.Event) -> Answer:
        """Begin to watch."""
        self._watched = _watched
        context.window_manager.modal_handler_add(self)
        return {"RUNNING_MODAL"}

    def modal(self, _context: bpy.types.Context, event: bpy.types.Event) -> Answer:
        """Stop the render at Esc; end at the first event after the render."""
        if not self._watched:
            return {"FINISHED", "PASS_THROUGH"}
        self._watched[0].stopped |= event.type == "ESC" and event.value == "PRESS"
        return {"PASS_THROUGH"}


class REFINE_OT_render(Needing, bpy.types.Operator):
    """Render splats among what the scene's engine renders; animations go where Output says"""

    bl_label = "Render with Splats"
    bl_options = {"REGISTER"}
    needs = (idle, no_render)
    doing = "Rendering"

    animation: BoolProperty(
        name="Animation",
        description="Render all frames of the scene, and write them",
        options={"SKIP_SAVE"},
    )
    _running: Running | None = None

    def execute(self, context: bpy.types.Context) -> Answer:
        """Render at once."""
        self._begin(context)
        try:
            for step in filter(None, self._steps):
                bpy.ops.render.render(scene=step.scene, animation=step.animation)
        except BaseException as error:
            return self._stopped(context, error)
        return self._finished(context)

    def invoke(self, context: bpy.types.Context, _event: bpy.types.Event) -> Answer:
        """Start the first render; in the background render at once."""
        if bpy.app.background or context.window is None:
            return self.execute(context)
        self._begin(context)
        answer = self._go_on(context)
        if "RUNNING_MODAL" in answer:  # Blender frees a finished operator, not its handler
            stop = partial(setattr, self._shared, "stopped", True)
            worker = SimpleNamespace(
                fraction=0.0, what="", partial_step=None, cancel=stop, end=stop
            )
            self._running = Running(self, context, ([], None), worker)
            context.window_manager.modal_handler_add(self)
            _watch_anew(self._shared)
        return answer

    def modal(self, context: bpy.types.Context, event: bpy.types.Event) -> Answer:
        """Start the next render when one is over."""
        if event.type == "TIMER":
            main_thread.serve()
            if not bpy.app.is_job_running("RENDER"):
                return self._go_on(context)
            self._running.tell(context)
        return {"PASS_THROUGH"}

    def _begin(self, context: bpy.types.Context) -> None:
        scene = context.scene
        every = range(scene.frame_start, scene.frame_end + 1, scene.frame_step)
        self._frames = every if self.animation else [scene.frame_current]
        self._shared = engine.Shared(card=card.available())
        self._steps = engine.steps(scene, self._frames, self._shared, write=self.animation)
        self._started, self._done = time.monotonic(), 0
        self._next: meshes.Step | None = None

    def _go_on(self, context: bpy.types.Context) -> Answer:
        """Take the last render's result, or start the next render. One event does one of both: a
        render that begins would drop an Esc that waits behind the event."""
        try:
            step, self._next = self._next, None
            if self._shared.stopped:
                raise Cancelled
            if step is None:
                self._next = next(self._steps)
                self._show()
            else:
                self._render(context, step)
        except StopIteration:
            return self._finished(context)
        except BaseException as error:
            return self._stopped(context, error)
        return {"RUNNING_MODAL"}

    def _render(self, context: bpy.types.Context, step: meshes.Step) -> None:
        """Make Blender render; the first time it opens its render view, as F12 does."""
        scene = meshes.existing(step.scene)
        number, total = len(self._shared.frames) + 1, len(self._frames)
        worker = self._running.worker
        worker.what = f"frame {number} of {total}: {step.what}" if total > 1 else step.what
        worker.fraction = min(self._done / (total * self._shared.renders), 1.0)
        self._done += 1
        self._running.tell(context)
        view = context.preferences.view
        display = view.render_display_type
        if self._done > 1:
            view.render_display_type = "NONE"
        shows = _NEEDS_WINDOW and step.what == "meshes"
        if shows:
            context.window.scene = scene
        try:
            bpy.ops.render.render("INVOKE_DEFAULT", scene=step.scene, animation=step.animation)
        finally:
            view.render_display_type = display
        if shows and self._done == 1:
            _draw_whole()
        _watch_anew(self._shared)

    def _show(self) -> None:
        picture, self._shared.picture = self._shared.picture, None
        if picture is None:
            return
        alphas = picture[3:]
        straight = np.concatenate([picture[:3] / np.maximum(alphas, 1e-6), alphas])
        image = put(IMAGE, np.moveaxis(straight, 0, -1).clip(0.0, 1.0))
        for area in viewport_draw.areas(bpy.context, "IMAGE_EDITOR"):
            shown = area.spaces.active.image
            if shown and shown.type == "RENDER_RESULT":
                area.spaces.active.image = image

    def _finished(self, context: bpy.types.Context) -> Answer:
        self._show()
        self.cancel(context)
        shared, seconds = self._shared, time.monotonic() - self._started
        what = counted(len(shared.frames), "frame") if self.animation else "Rendered"
        among = f" among what {shared.engine} rendered" if shared.engine else ""
        self.report({"INFO"}, f"{what}: {shared.splats:,} splats{among}, {seconds:.1f} s")
        self.tell(engine.left_out(context.scene))
        return {"FINISHED"}

    def _stopped(self, context: bpy.types.Context, error: BaseException) -> Answer:
        self.cancel(context)
        if not isinstance(error, Cancelled):
            return fail(self, error, RuntimeError)  # Blender's own
        self.report({"INFO"}, "Render cancelled")
        return {"CANCELLED"}

    def cancel(self, context: bpy.types.Context) -> None:
        """Clean up, also when Blender ends the operator, closing its window or file."""
        _watched.clear()
        if (later := _close(self._steps)) is not None:
            bpy.app.timers.register(partial(_close, self._steps), first_interval=later)
        if _NEEDS_WINDOW and not bpy.app.background:
            bpy.app.timers.register(_draw_whole, first_interval=_SETTLED)
        if self._running is not None:
            self._running.over(context)


def _close(steps: Generator[Any, None, None]) -> float | None:
    """End the steps of a render, or say when to try again: Blender's render needs their engine."""
    if bpy.app.is_job_running("RENDER"):
        return 0.1
    steps.close()
    return None


def _draw_whole() -> None:
    """Redraw whole windows: where a scene changed, 4.3 leaves the top bar empty."""
    for window in bpy.context.window_manager.windows:
        window.screen.show_statusbar = window.screen.show_statusbar


def draw_buttons(layout: bpy.types.UILayout, animation: str = "Render Animation") -> None:
    """Draw a button, or an entry, for a picture and one for an animation."""
    layout.operator("refine.render", icon="RENDER_STILL")
    layout.operator("refine.render", text=animation, icon="RENDER_ANIMATION").animation = True


def draw_menu(menu: bpy.types.Menu, _context: bpy.types.Context) -> None:
    """Draw the entries of Blender's menu Render."""
    menu.layout.separator()
    draw_buttons(menu.layout, "Render Animation with Splats")


def _began(scene: bpy.types.Scene, *_: object) -> None:
    """Check whether a render leaves splats out; runs on the rendering thread."""
    if meshes.COPY_OF in scene:
        return
    shown = (layer.objects for layer in scene.view_layers if layer.use)
    if not any(meshes.drawn_by_us(obj) and not obj.hide_render for group in shown for obj in group):
        return
    if bpy.app.background:
        sys.stderr.write(f"{IN_BACKGROUND}\n")
    elif not _until:
        _until.append(time.monotonic() + _LINGERS)
        bpy.app.timers.register(_say, first_interval=0.0)


def _say() -> float | None:
    if bpy.app.is_job_running("RENDER"):
        _until[0] = time.monotonic() + _LINGERS
    over = time.monotonic() > _until[0]
    for workspace in bpy.data.workspaces:
        workspace.status_text_set(None if over else NOTICE)
    if over:
        _until.clear()
    return None if over else 0.5


def _returned(*_: object) -> None:
    """Remove leftovers of a finished render that an undo or a file brought back."""
    if not bpy.app.is_job_running("RENDER"):
        meshes.remove_all()
        meshes.restore()


MENUS = {"TOPBAR_MT_render": draw_menu}
HANDLERS = {_began: ("render_init",), _returned: ("undo_post", "redo_post", "load_post")}
