"""Renders with splats, drawn by our own renderer among what the scene's engine renders.
A frame takes up to three of Blender's renders, of copies of the scene: the meshes with their depth
(`meshes`), the world behind them, and the picture, in which our `engine` draws the splats. So
Blender shows progress, stops at Esc and writes files. `frames` goes through the steps."""
