"""Estimated PSNR of the views, and whether cameras and splats belong together."""
