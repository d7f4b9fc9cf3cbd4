"""Data of a splat object, mesh or point cloud: attributes, editing, scores, display."""
