"""Survivors learn what the unpruned splats look like, from rays."""
