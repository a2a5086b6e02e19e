"""Dense multi-view stereo: depth and normal maps of the images, fused into a point cloud."""
