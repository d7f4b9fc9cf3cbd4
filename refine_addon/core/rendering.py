"""What every renderer of Gaussian splats does alike, as numbers.

All four are facts of the reference implementation (Kerbl et al. 2023, "3D Gaussian Splatting for
Real-Time Radiance Field Rendering", `diff-gaussian-rasterization`) that other renderers follow,
but for the near plane, which there is a length in scene units.
"""

LOW_PASS = 0.3
"""Variance added to a footprint along both axes so that it is not thinner than a pixel, px^2."""

ALPHA_MAX = 0.99
"""Largest alpha with which one splat covers a pixel, 0..1: none hides all that is behind it."""

ALPHA_CUT = 1.0 / 255.0
"""Least alpha that is drawn, 0..1; where a splat's falls below it, its footprint ends."""

NEAR_RELATIVE = 0.01
"""Near plane over the size of the scene, where a view brings none of its own. Renderers have a
fixed length here, .2 or .01 of whatever unit; a share of the scene's size is the same in any."""
