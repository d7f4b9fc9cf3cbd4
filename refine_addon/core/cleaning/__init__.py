"""Floaters and outliers: what the cameras tell of splats that belong to no surface."""
