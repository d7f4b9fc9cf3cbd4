"""What is told about the pictures of the views: their PSNR, and how cameras and splats stand."""
