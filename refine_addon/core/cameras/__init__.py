"""Camera files: one module a format, and `read`, which chooses."""
