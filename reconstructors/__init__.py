"""Reconstructors that come with pcbench; each computes a point cloud from images."""
