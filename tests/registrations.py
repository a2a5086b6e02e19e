"""Known motions of clouds, and errors of estimated registrations."""

import numpy as np
import shapes

from pcbench import Similarity


def motion(angle_deg=2.0, shift=(0.6, -0.4, 0.3), scale=1.0):
    """Return a motion candidate -> reference of a size typical after rough alignment."""
    return Similarity(shapes.rotation([0.3, -0.5, 0.8], angle_deg), np.array(shift), scale)


def error(estimate, true, points):
    """Return the RMS distance between points (N, 3), in the reference, under the true and the estimated pose."""
    candidate_points = true.inverse().apply(points)
    return float(np.sqrt(np.mean(np.square(estimate.apply(candidate_points) - points).sum(axis=1))))


def codes(registration):
    """Return the codes of a registration's warnings."""
    return {notice.code for notice in registration.warnings}
