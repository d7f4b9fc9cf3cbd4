"""Kept splats learn what the unpruned splats look like, from rays."""
