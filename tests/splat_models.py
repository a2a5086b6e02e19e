"""Clouds of Gaussian splats as trainers write them: logits of opacities, logarithms of axes."""

import numpy as np

from pcbench import Cloud


def model(points, opacities, axes, degree=3):
    """Return one splat per point (N, 3) with opacities (N,) and standard deviations along 2 or 3 axes (N, 2 or 3)."""
    count = len(points)
    attributes = {f"f_dc_{k}": np.full(count, 0.5, np.float32) for k in range(3)}
    attributes |= {f"f_rest_{k}": np.zeros(count, np.float32) for k in range(3 * ((degree + 1) ** 2 - 1))}
    attributes["opacity"] = np.log(opacities / (1 - opacities)).astype(np.float32)
    attributes |= {f"scale_{k}": np.log(axis).astype(np.float32) for k, axis in enumerate(np.transpose(axes))}
    attributes |= {f"rot_{k}": np.full(count, float(k == 0), np.float32) for k in range(4)}
    return Cloud(points, attributes=attributes)


def make_gaussians(count=5, dimensions=3, degree=3):
    """Return splats with opacities 0.1, 0.3, ... and axes 0.01, 0.02, ... times 1, 2 and 3."""
    opacities = np.linspace(0.1, 0.9, count)
    axes = 0.01 * np.arange(1, count + 1)[:, None] * np.arange(1, dimensions + 1)
    return model(np.arange(3.0 * count).reshape(count, 3), opacities, axes, degree)
