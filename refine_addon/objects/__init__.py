"""Operations of panel and command on splat objects: one, several as a scene, levels."""
