"""Gaussian splatting: a differentiable rasterizer for the CPU and for CUDA, and what is built on it."""
