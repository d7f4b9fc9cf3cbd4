"""REFINE: prune 3D Gaussian splats by how much the cameras of the scene would miss them."""

# SPDX-License-Identifier: GPL-3.0-or-later


def register() -> None:
    """Register everything with Blender."""
    from . import registration

    registration.register()


def unregister() -> None:
    """Undo `register`, in reverse."""
    from . import registration

    registration.unregister()
