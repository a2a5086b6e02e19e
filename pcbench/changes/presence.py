"""Points without counterparts: the other cloud has fewer points around them than its density explains."""

from __future__ import annotations

import numpy as np

from pcbench.changes.samples import Sample
from pcbench.geometry.arrays import FloatArray
from pcbench.geometry.neighbors import Index

_REGION_POINTS = 400  # nearest points whose median density ratio is expected at a point
_POINTS_PER_REGION = 50
_MIN_DENSITY_SHARE = 0.5  # of the scene's median ratio: a missing object must not hide itself


def absence(sample: Sample, other: Index) -> FloatArray:
    """Return (N,) p-values of the points of a sample: the probability of as few points of another cloud around them.

    If both clouds show the same surface, of the n points in a ball that are not the sample's k, n is distributed as
    Binomial(k + n, rho / (1 + rho)) with the ratio rho of the densities. It is the regional median of n / k, and at
    least half of the scene's, so that a part that is missing completely does not hide itself.

    Args:
        sample: sample of one cloud.
        other: sample of the other cloud, without a displacement of the scene.
    """
    from scipy.special import bdtr

    own = sample.near.distances.shape[1]
    most = min(2 * own, len(other))
    distances = other.query(sample.points, most).distances.reshape(len(sample), most)
    counts = np.count_nonzero(distances <= sample.reach[:, None], axis=1)
    ratios = counts / own
    anchors = np.arange(0, len(sample), _POINTS_PER_REGION)
    regions = sample.index.query(sample.points[anchors], min(_REGION_POINTS, len(sample))).indices
    typical = np.median(ratios[regions.reshape(len(anchors), -1)], axis=1)
    region = Index(sample.points[anchors]).query(sample.points).indices
    density = np.maximum(typical[region], _MIN_DENSITY_SHARE * float(np.median(ratios)))
    found: FloatArray = bdtr(counts, own + counts, density / (1 + density))
    return found
