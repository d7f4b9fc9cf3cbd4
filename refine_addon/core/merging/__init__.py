"""Merging: splats become one with their neighbours, or are deleted, whichever costs less."""
