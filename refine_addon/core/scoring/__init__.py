"""Scoring methods: how much the views would miss each splat."""
