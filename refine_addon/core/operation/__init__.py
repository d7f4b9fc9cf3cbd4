"""One way through for every operation on splats: refuse, read, decide, write, report (`run`)."""
