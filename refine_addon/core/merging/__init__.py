"""Absorbing: survivors take over the splats that go."""
