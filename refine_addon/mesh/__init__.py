"""A splat object's mesh: its attributes, editing, scores and how they are shown."""
