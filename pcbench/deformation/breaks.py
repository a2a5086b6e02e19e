"""Detection of two parts of a scene that are offset against each other, such as strips that were aligned separately.

No smooth deformation explains such an offset.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from pcbench.deformation.verdict import PairEvidence
from pcbench.geometry.arrays import FloatArray

_AZIMUTHS = 18
_MIN_EXPLAINED_SHARE = 0.25  # of the residual of an affine field; the best cut explains less of correlated noise
_MIN_PART_SHARE = 0.1  # of the weight, on either side


class Break(NamedTuple):
    """A vertical plane with different displacements of the candidate on its two sides.

    Attributes:
        place: (3,) a point of the plane.
        azimuth: direction of the plane, in degrees from x towards y.
        offset: (3,) displacement of the left side relative to the right side, in observable directions.
    """

    place: FloatArray
    azimuth: float
    offset: FloatArray

    def text(self, origin: FloatArray) -> str:
        """Return a warning that names the line and the offset."""
        x, y = (self.place + origin)[:2]
        return (
            f"two parts are offset against each other by {float(np.linalg.norm(self.offset)):.2g}, on both sides of a"
            f" line through ({x:.1f}, {y:.1f}) at {self.azimuth:.0f} degrees from x: strips or blocks were probably"
            " aligned separately"
        )


def find_offset_parts(view: PairEvidence) -> Break | None:
    """Return the vertical plane that explains the residuals best, if it explains more than the largest smooth model."""
    geometry, scores = view.geometry, view.scores
    affine = geometry.fields("affine")
    coefficients = affine @ (affine.T @ scores.total)
    residual = scores.translations - np.einsum("cik,i->ck", geometry.translations, coefficients)
    energy = float(scores.energy.sum()) - geometry.explained(scores, "affine")
    smooth = geometry.explained(scores, "cubic") - geometry.explained(scores, "affine")
    if energy <= 0:
        return None
    response = np.einsum("cik,ia->cak", geometry.translations, affine)  # (C, 12, 3)
    best = None
    for azimuth in np.arange(_AZIMUTHS) * 180.0 / _AZIMUTHS:
        along = np.array([math.cos(math.radians(azimuth)), math.sin(math.radians(azimuth))])
        across = geometry.means[:, :2] @ np.array([-along[1], along[0]])
        order = np.argsort(across, kind="stable")
        part = np.cumsum(geometry.weights[order]) / geometry.weights.sum()
        inner = np.flatnonzero((part >= _MIN_PART_SHARE) & (part <= 1 - _MIN_PART_SHARE))
        # Sums over the cells below each cut; the cells above contribute with the opposite sign.
        h, g = np.cumsum(residual[order], axis=0)[inner], np.cumsum(geometry.information[order], axis=0)[inner]
        z = np.cumsum(response[order], axis=0)[inner]
        matrix = g - np.einsum("cak,cal->ckl", z, z)
        values, vectors = np.linalg.eigh(matrix)
        modes = np.einsum("ckm,ck->cm", vectors, h)
        is_observable = values > 0.01 * geometry.total
        power = np.where(is_observable, np.square(modes) / np.where(is_observable, values, 1.0), 0.0).sum(axis=1)
        cut = int(np.argmax(power)) if len(power) else 0
        if len(power) and (best is None or power[cut] > best[0]):
            observable = is_observable[cut]
            offset = vectors[cut] @ np.where(observable, modes[cut] / np.where(observable, values[cut], 1.0), 0.0)
            best = float(power[cut]), geometry.means[order[inner[cut]]], float(azimuth), -offset
    if best is None or best[0] < max(_MIN_EXPLAINED_SHARE * energy, smooth):
        return None
    return Break(*best[1:])
