"""Points without counterparts: the other cloud has fewer points around them than its density explains."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from pcbench.changes.samples import BALL_POINTS, NEIGHBORS, Sample
from pcbench.geometry.arrays import FloatArray, IntArray
from pcbench.geometry.neighbors import Index
from pcbench.geometry.order_statistics import median, medians_of_rows

_REGION_POINTS = 400  # nearest points whose median density ratio is expected at a point
_POINTS_PER_REGION = 50
_MIN_DENSITY_SHARE = 0.5  # of the scene's median ratio: a missing object must not hide itself


class Ball(NamedTuple):
    """A size of the ball around a point, in which counterparts are counted.

    Attributes:
        points: number of other points of the sample in it.
        max_p: p-value of the number of counterparts below which they are absent.
        min_part: number of such points that makes a connected part significant. In 188 pairs of random halves, the
            largest chance cluster had 13, 7 and 3 points.
    """

    points: int
    max_p: float
    min_part: int


# Small balls show thin and small objects, which stand on a surface that has not changed.
BALLS = tuple(map(Ball, BALL_POINTS, (5e-3, 1e-3, 1e-4), (16, 9, 6)))


class Absence(NamedTuple):
    """Test for counterparts at each point of a sample, N points.

    Attributes:
        p: (N,) p-value of the number of counterparts in the smallest ball.
        in_balls: (B, N) whether too few counterparts are in each ball of `BALLS`.
    """

    p: FloatArray
    in_balls: NDArray[np.bool_]

    @property
    def is_absent(self) -> NDArray[np.bool_]:
        """(N,) whether too few counterparts are in any of the balls."""
        absent: NDArray[np.bool_] = np.logical_or.reduce(self.in_balls)
        return absent

    def is_significant(self, rows: IntArray) -> bool:
        """Return whether a connected part, given by rows, has more such points than chance produces."""
        counts = np.count_nonzero(self.in_balls[:, rows], axis=1)
        return any(count >= ball.min_part for count, ball in zip(counts, BALLS, strict=True))


def find_absence(sample: Sample, other: Index) -> Absence:
    """Count the points of another cloud around each point of a sample.

    If both clouds show the same surface, of the n points in a ball that are not the sample's k, n is distributed as
    Binomial(k + n, rho / (1 + rho)) with the ratio rho of the densities. It is the regional median of n / k, and at
    least half of the scene's, so that a part that is missing completely does not hide itself.

    Args:
        sample: sample of one cloud.
        other: sample of the other cloud, without a displacement of the scene.
    """
    in_balls = _counterparts(sample, other)
    densities, region = _density_ratios(sample, in_balls[-1] / BALLS[-1].points)
    shares = densities / (1 + densities)
    p = np.stack([_at_most(counts, ball.points, shares, region) for counts, ball in zip(in_balls, BALLS, strict=True)])
    return Absence(p[0], p < np.array([[ball.max_p] for ball in BALLS]))


def _counterparts(sample: Sample, other: Index) -> IntArray:
    """Return the numbers (B, N) of the other cloud's points in each of `BALLS`, at most those in the largest ball."""
    counts: IntArray = np.minimum(other.count_near(sample.index, sample.near.distances), NEIGHBORS).T.copy()
    return counts


def _density_ratios(sample: Sample, ratios: FloatArray) -> tuple[FloatArray, IntArray]:
    """Return ratios (R,) of the density of the other cloud to that of the sample, and the region (N,) of each point.

    Args:
        sample: the sample.
        ratios: (N,) ratios in the largest ball around each point.
    """
    anchors = np.arange(0, len(sample), _POINTS_PER_REGION)
    regions = sample.index.query(sample.points[anchors], min(_REGION_POINTS, len(sample))).indices
    typical = medians_of_rows(ratios, regions.reshape(len(anchors), -1))
    region = Index(sample.points[anchors]).query_index(sample.index).indices
    return np.maximum(typical, _MIN_DENSITY_SHARE * median(ratios)), region


def _at_most(counts: IntArray, points: int, shares: FloatArray, region: IntArray) -> FloatArray:
    """Return the probabilities (N,) that of k + n points at most n (N,) are the other cloud's.

    It is the probability that k points of the sample are drawn before n + 1 of the other cloud: the sum over j up to n
    of C(k - 1 + j, j) (1 - share)^k share^j.

    Args:
        counts: (N,) the numbers n.
        points: the number k.
        shares: (R,) share of the other cloud's points in each region.
        region: (N,) region of each n.
    """
    terms = [(1 - shares) ** points]
    for j in range(1, int(counts.max(initial=0)) + 1):
        terms.append(terms[-1] * (shares * (points - 1 + j) / j))
    probabilities: FloatArray = np.cumsum(terms, axis=0)[counts, region]
    return probabilities
