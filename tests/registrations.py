"""Known motions of clouds, and how far a registration that was found is from them."""

import numpy as np
import shapes

from pcbench import Similarity


def motion(angle_deg=2.0, shift=(0.6, -0.4, 0.3), scale=1.0):
    """A motion candidate -> reference as large as ICP meets after a rough alignment."""
    return Similarity(shapes.rotation([0.3, -0.5, 0.8], angle_deg), np.array(shift), scale)


def error(found, true, points):
    """RMS distance between where the true and the found pose put the candidate; points in the reference's frame."""
    moved = true.inverse().apply(points)
    return float(np.sqrt(np.mean(np.square(found.apply(moved) - points).sum(axis=1))))


def codes(registration):
    """The codes of a registration's warnings."""
    return {notice.code for notice in registration.warnings}
