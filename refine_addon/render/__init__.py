"""Renders with splats: our own renderer draws them among what the scene's engine renders.
Each frame takes several of Blender's renders, of copies of the scene: meshes with their depth and
the world behind them (`meshes`), then the picture, in which our `engine` draws the splats. All are
renders of Blender, so that it shows progress, stops at Esc and writes files."""
