"""Constants that renderers of Gaussian splats share.

They are those of the reference implementation (Kerbl et al. 2023, "3D Gaussian Splatting for
Real-Time Radiance Field Rendering", `diff-gaussian-rasterization`), which other renderers follow;
except for the near plane, which is a length in scene units there.
"""

LOW_PASS = 0.3
"""Variance added to a footprint along both axes so that it is not thinner than a pixel, px^2."""

ALPHA_MAX = 0.99
"""Largest alpha of one splat at a pixel, 0..1: no splat hides everything behind it."""

ALPHA_CUT = 1.0 / 255.0
"""Least alpha that is drawn, 0..1; a splat's footprint ends where its alpha falls below it."""

NEAR_RELATIVE = 0.01
"""Near plane over the size of the scene, for views that have none of their own. Renderers use .2 or
.01 in the scene's unit; a multiple of the scene's size is independent of the unit."""
