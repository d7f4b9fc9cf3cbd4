"""Splat files: reading and writing; one module a format."""
