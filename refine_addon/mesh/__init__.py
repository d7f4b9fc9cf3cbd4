"""The data of a splat object, mesh or point cloud: attributes, editing, scores, how they show."""
