"""Splat files: reading and writing; one module a format, or for those that only a name tells."""
