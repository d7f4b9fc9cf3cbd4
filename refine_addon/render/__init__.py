"""Renders that show splats, drawn by our own renderer among what the scene's engine renders.

A frame is rendered in up to three steps, each by Blender's own rendering of a scene that is a copy
of the user's: the meshes, with their depth (`meshes`); the world behind them; and the picture as a
whole by a render engine of ours (`engine`), which draws the splats among the meshes. So Blender
shows the progress, stops at Esc, and writes the files. `frames` goes through the steps.
"""
