"""Blender's cameras as views, and views as Blender's cameras."""
