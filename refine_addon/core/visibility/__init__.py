"""What the views see of splats: footprints, points in cells, rays and what they hit."""
