"""Reading and writing splat files: one module a format, and one for those known only by name."""
