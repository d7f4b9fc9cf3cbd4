"""Levels of detail: ever fewer splats of one scene, and from how far away each will do."""
