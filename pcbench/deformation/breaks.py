"""Detection of two parts of a scene that are offset against each other, such as strips that were aligned separately.

No smooth model describes such a break.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from pcbench.deformation.verdict import PairEvidence
from pcbench.geometry.arrays import FloatArray

_AZIMUTH_COUNT = 18
# Share of the energy that an affine field leaves; noise correlated over a tenth of a scene gives less.
_MIN_ENERGY_SHARE = 0.25
_MIN_WEIGHT_SHARE = 0.1  # share of the weight on either side
_MIN_OFFSET_INFORMATION = 0.01  # share of the weight that determines an offset along a direction


class Break(NamedTuple):
    """A vertical plane across which the displacement of the candidate jumps.

    Attributes:
        place: (3,) point on the plane.
        azimuth: azimuth of the plane's horizontal direction, in degrees from x towards y.
        offset: (3,) displacement of the part to the left of that direction relative to the other, as far as the
            surfaces determine it.
    """

    place: FloatArray
    azimuth: float
    offset: FloatArray

    def text(self, origin: FloatArray, unit: str) -> str:
        """Return a warning that names the line and the offset; `unit` is its unit after a space, or empty."""
        x, y = (self.place + origin)[:2]
        offset = f"{float(np.linalg.norm(self.offset)):.2g}{unit}"
        return (
            f"two parts displaced by {offset} against each other, across a line through ({x:.1f}, {y:.1f}) at"
            f" {self.azimuth:.0f} degrees from x, explain the differences better than a cubic deformation: look there"
            " for the border of strips or blocks that were aligned separately, or for a bend with more turns than a"
            " cubic model has"
        )


def find_break(evidence: PairEvidence) -> Break | None:
    """Return the best vertical cut if it explains a large share of the energy, and more than the cubic model does."""
    geometry, scores = evidence.geometry, evidence.scores
    affine = geometry.half("affine")
    coefficients = affine @ (affine.T @ scores.total)
    remainders = scores.translations - np.einsum("cik,i->ck", geometry.translations, coefficients)
    energy = float(scores.energy.sum()) - geometry.explained_sum(scores, "affine")
    smooth = geometry.explained_sum(scores, "cubic") - geometry.explained_sum(scores, "affine")
    if energy <= 0:
        return None
    required = max(_MIN_ENERGY_SHARE * energy, smooth)
    seen = affine.T @ geometry.translations  # (C, 12, 3)
    best = None
    for azimuth in np.arange(_AZIMUTH_COUNT) * 180.0 / _AZIMUTH_COUNT:
        along = np.array([math.cos(math.radians(azimuth)), math.sin(math.radians(azimuth))])
        across = geometry.means[:, :2] @ np.array([-along[1], along[0]])
        order = np.argsort(across, kind="stable")
        part = np.cumsum(geometry.weights[order]) / geometry.weights.sum()
        inner = np.flatnonzero((part >= _MIN_WEIGHT_SHARE) & (part <= 1 - _MIN_WEIGHT_SHARE))
        # Sums over the cells below each cut; the cells above contribute the same with the opposite sign.
        h = np.cumsum(remainders[order], axis=0)
        # An offset cannot explain more than this: at most cuts, that is too little.
        inner = inner[np.square(h[inner]).sum(axis=1) >= required * _MIN_OFFSET_INFORMATION * geometry.total]
        h, g = h[inner], np.cumsum(geometry.information[order], axis=0)[inner]
        z = np.cumsum(seen[order], axis=0)[inner]
        values, vectors = np.linalg.eigh(g - z.transpose(0, 2, 1) @ z)
        modes = np.einsum("ckm,ck->cm", vectors, h)
        shown = values > _MIN_OFFSET_INFORMATION * geometry.total
        power = np.where(shown, np.square(modes) / np.where(shown, values, 1.0), 0.0).sum(axis=1)
        cut = int(np.argmax(power)) if len(power) else 0
        if len(power) and (best is None or power[cut] > best[0]):
            offset = vectors[cut] @ np.where(shown[cut], modes[cut] / np.where(shown[cut], values[cut], 1.0), 0.0)
            best = float(power[cut]), geometry.means[order[inner[cut]]], float(azimuth), -offset
    if best is None or best[0] < required:
        return None
    return Break(*best[1:])
