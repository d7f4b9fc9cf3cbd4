"""Constants that renderers of Gaussian splats share.

They are those of the reference implementation (Kerbl et al. 2023, "3D Gaussian Splatting for
Real-Time Radiance Field Rendering", `diff-gaussian-rasterization`), which other renderers follow;
except for the near plane, which is a length in scene units there.

Splats are trained to be drawn in one of three ways, their *model*, and look wrong in another. The
words are those of splat-transform and SOG; how a PLY says it: `formats.ply`.
"""

from __future__ import annotations

from typing import Literal, get_args

Model = Literal["default", "antialiased", "2dgs"]
"""How splats are drawn.

- ``default``: the footprint is widened by `LOW_PASS`, and its opacity stays (Kerbl et al. 2023).
- ``antialiased``: it is widened likewise, and its opacity falls so that the integral of alpha
  stays: times ``sqrt(det C / det(C + LOW_PASS I))``, C the covariance in the image (Yu et al.
  2024, "Mip-Splatting"; gsplat's ``rasterize_mode="antialiased"``).
- ``2dgs``: a splat is a flat disc without a third scale, hit where the ray meets its plane (Huang
  et al. 2024, "2D Gaussian Splatting for Geometrically Accurate Radiance Fields").
"""

MODELS: tuple[Model, ...] = get_args(Model)
"""All models. The first is meant where a file does not say."""

LOW_PASS = 0.3
"""Variance added to a footprint along both axes so that it is not thinner than a pixel, px^2."""

DISC_LOW_PASS = 0.5
"""Variance of the Gaussian that a disc is at least drawn as, px^2: the larger of the two alphas
counts (Huang et al. 2024, Eq. 11, with sigma = sqrt(2) / 2)."""

ALPHA_MAX = 0.99
"""Largest alpha of one splat at a pixel, 0..1: no splat hides everything behind it."""

ALPHA_CUT = 1.0 / 255.0
"""Least alpha that is drawn, 0..1; a splat's footprint ends where its alpha falls below it."""

NEAR_RELATIVE = 0.01
"""Near plane over the size of the scene, for views that have none of their own. Renderers use .2 or
.01 in the scene's unit; a multiple of the scene's size is independent of the unit."""
