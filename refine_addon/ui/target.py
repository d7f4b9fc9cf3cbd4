"""The object that long work is for: found again afterwards, and whether it is still the same."""

from __future__ import annotations

from dataclasses import dataclass

import bpy

from ..core.errors import RefineError
from ..mesh import attributes as mesh_attributes
from ..mesh import layout as mesh_layout
from ..mesh.layout import SplatObject


@dataclass(frozen=True)
class Target:
    """What an object was when it was read.

    Attributes
    ----------
    name : str
        To be named by.
    obj, data : int
        What Blender knows object and mesh by in this session, whatever they are called; an undo
        keeps it.
    mode : str
    count, digest : int
        Of its splats.
    """

    name: str
    obj: int
    data: int
    mode: str
    count: int
    digest: int

    @classmethod
    def of(cls, checked: SplatObject) -> Target:
        """Note what an object is."""
        obj, data = checked.obj, checked.mesh
        digest = mesh_attributes.digest(checked)
        return cls(obj.name, obj.session_uid, data.session_uid, obj.mode, len(checked), digest)

    def waits(self) -> str:
        """Return what has to happen before it can be written to, "" if nothing."""
        obj = self._object()
        if obj is None or obj.mode == self.mode:
            return ""
        return f"go back to {self.mode.replace('_', ' ').lower()} mode for the result"

    def unchanged(self) -> SplatObject:
        """Return the object, whose splats are still those that were read.

        Raises
        ------
        RefineError
            If they are not.
        """
        obj, label = self._object(), f"object '{self.name}'"
        if obj is None:
            raise RefineError(f"{label}: was deleted meanwhile; there is nothing to write to")
        checked = mesh_layout.check(obj)
        if checked.mesh.session_uid != self.data:
            raise RefineError(f"{label}: has other data, '{checked.mesh.name}', since; start again")
        if len(checked) != self.count:
            raise RefineError(
                f"{label}: had {self.count} splats and has {len(checked)} since; start again"
            )
        if mesh_attributes.digest(checked) != self.digest:
            raise RefineError(f"{label}: its splats were changed meanwhile; start again")
        return checked

    def _object(self) -> bpy.types.Object | None:
        """Return the object if it is still in a scene."""
        same = (obj for obj in bpy.data.objects if obj.session_uid == self.obj)
        return next((obj for obj in same if obj.users_scene), None)
