"""Splats drawn in Blender's 3D views, over Blender's own picture."""
