"""What operators have in common: what they need to run, and how they say what went wrong."""

from __future__ import annotations

from collections.abc import Callable

import bpy

from ..core.errors import RefineError
from ..mesh import layout as mesh_layout
from ..mesh import scores as mesh_scores
from . import running

Answer = set[str]
"""What Blender is told of an operator: FINISHED, CANCELLED, RUNNING_MODAL or PASS_THROUGH."""

Need = Callable[[bpy.types.Context], str]
"""Returns what an operator lacks to run, "" if nothing."""

FAILURES = (RefineError, MemoryError)
"""What an operator reports as an error; all else is a fault of the program."""


def fail(operator: bpy.types.Operator, error: Exception) -> Answer:
    """Report an error to the user, and return that nothing was done."""
    operator.report({"ERROR"}, described(error))
    return {"CANCELLED"}


def described(error: Exception) -> str:
    """Return one of `FAILURES` as a sentence."""
    if isinstance(error, MemoryError):
        return f"not enough memory ({error})" if str(error) else "not enough memory"
    return str(error)


def idle(_context: bpy.types.Context) -> str:
    """Return why another operation has to be over first, "" if none works on a thread."""
    return running.refusal()


def in_object_mode(context: bpy.types.Context) -> str:
    """Return that object mode is needed, "" in it."""
    return "" if context.mode == "OBJECT" else "Go to object mode first"


def on_splats(context: bpy.types.Context) -> str:
    """Return that the active object must hold splats, "" if it does."""
    if mesh_layout.looks_like_splats(context.object):
        return ""
    return "Select an object that holds splats: import a file of splats"


def out_of_edit_mode(context: bpy.types.Context) -> str:
    """Return that the active object must leave edit mode, "" if it is not in it."""
    return "Leave edit mode first" if context.object.mode == "EDIT" else ""


def scored(context: bpy.types.Context) -> str:
    """Return that the active object needs scores, "" if it has them."""
    return "" if mesh_scores.record(context.object.data) else "Score the splats first"


class Needing:
    """An operator that can run if nothing of what it needs is missing.

    Attributes
    ----------
    needs : tuple of Need
        Asked in this order.
    """

    needs: tuple[Need, ...] = (idle,)

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        """Tell whether the operator can run, and if not, why."""
        missing = next(filter(None, (need(context) for need in cls.needs)), "")
        if missing:
            cls.poll_message_set(missing)
        return not missing


class OnSplats(Needing):
    """An operator on the active object, which must hold splats."""

    needs: tuple[Need, ...] = (idle, on_splats, out_of_edit_mode)


class OnScored(OnSplats):
    """An operator on the active object, which must be scored."""

    needs = (*OnSplats.needs, scored)


class AtOnce:
    """An operator that does all of it when it is clicked, without a thread."""

    def act(self, context: bpy.types.Context) -> Answer:
        """Do it; what is raised of `FAILURES` is reported as an error."""
        raise NotImplementedError

    def execute(self, context: bpy.types.Context) -> Answer:
        """Do it, or report why it cannot be done."""
        try:
            return self.act(context)
        except FAILURES as error:
            return fail(self, error)
