"""Levels a model in an arbitrary frame by the up direction of its cameras."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from pcbench.geometry.cameras import Camera
from pcbench.geometry.transform import Similarity
from pcbench.geometry.upright import find_up, rotation_to_z


def leveling_rotation(cameras: Mapping[str, Camera]) -> tuple[Similarity | None, str]:
    """Return the rotation about the origin that makes +z up, and a note on how up was found.

    Args:
        cameras: Cameras by image name.

    Returns:
        None and the reason if the cameras do not determine the up direction.
    """
    up, reason = find_up(cameras.values())
    if up is None:
        return None, f"not levelled, z is not up: {reason}"
    turn = Similarity(rotation_to_z(up), np.zeros(3))
    return turn, f"levelled, +z is up: {reason}; origin and scale are arbitrary"
