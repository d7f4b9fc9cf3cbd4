"""What panel and command do with splat objects: one, several as a scene, levels; what must stay."""
