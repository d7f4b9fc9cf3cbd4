"""Floaters and outliers: splats that belong to no surface, by what the cameras see."""
