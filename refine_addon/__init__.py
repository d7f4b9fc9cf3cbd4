"""REFINE: prune 3D Gaussian splats by how much the cameras of the scene would miss them."""

# SPDX-License-Identifier: GPL-3.0-or-later


def register() -> None:
    """Register everything with Blender."""
    from . import registration  # noqa: PLC0415 - core must import where there is no bpy

    registration.register()


def unregister() -> None:
    """Undo `register`, in reverse."""
    from . import registration  # noqa: PLC0415

    registration.unregister()
