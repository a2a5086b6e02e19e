"""Cities whose colours change with all coordinates, as clouds; bent ones have a deformation that is found."""

import numpy as np
import shapes

from pcbench import Cloud


def coloured_city(count, seed, bowl=0.0):
    """Return points on a city, raised by `bowl` times their squared distance from the origin, in metres."""
    points = shapes.city(count, seed=seed)[0]
    colors = np.clip([40, 40, 60] + [4, 4, 10] * points, 0, 255).astype(np.uint8)
    raised = points + [0, 0, bowl] * (points[:, :2] ** 2).sum(axis=1)[:, None]
    return Cloud(raised, colors=colors, unit="m")
