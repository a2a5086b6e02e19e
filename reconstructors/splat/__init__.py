"""Gaussian splatting: a differentiable rasterizer for the CPU and for CUDA, and a reconstructor built on it."""

from reconstructors.splat.rasterize import Rendering, rasterize

__all__ = ["Rendering", "rasterize"]
