"""Merging: kept splats take over what goes."""
