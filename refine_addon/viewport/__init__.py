"""Splats drawn in Blender's 3D views, over what Blender itself draws there."""
