"""Reflections that mirror a cloud: exports for left-handed frames negate one axis or exchange two."""

from __future__ import annotations

import numpy as np

from pcbench.geometry.transform import Affine

_EXCHANGED = {"xy": (1, 0, 2), "xz": (2, 1, 0), "yz": (0, 2, 1)}

REFLECTIONS = ("x", "y", "z", *_EXCHANGED)  # axes that are negated (one) or exchanged (two)


def reflection(axes: str) -> Affine:
    """Return the reflection of `REFLECTIONS` that negates one axis or exchanges two."""
    if axes in _EXCHANGED:
        return Affine(np.eye(3)[list(_EXCHANGED[axes])], np.zeros(3))
    return Affine(np.diag([-1.0 if axis == axes else 1.0 for axis in "xyz"]), np.zeros(3))
