"""Presets of libraries: Chamfer, Hausdorff and F-score as their functions define them, from one-way distances.

The order of the two clouds matters only for values of one direction, and for Kaolin's F-score.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from pcbench.geometry.arrays import FloatArray
from pcbench.measure.metrics import FScore, harmonic_mean

_KAOLIN_EPSILON = 1e-8  # in the denominator of its F-score


class OneWay(NamedTuple):
    """Summary of the distances of one direction: from each point of a cloud to the nearest one of the other cloud."""

    points: int
    mean: float
    mean_square: float
    largest: float
    shares: tuple[float, ...]  # of the distances within each threshold, or equal to it

    @classmethod
    def of(cls, distances: FloatArray, thresholds: Sequence[float]) -> OneWay:
        """Summarise distances (N,)."""
        return cls(
            len(distances),
            float(distances.mean()),
            float(np.mean(np.square(distances))),
            float(distances.max()),
            tuple(float(np.mean(distances <= threshold)) for threshold in thresholds),
        )


@dataclass(frozen=True)
class DirectedValues:
    """Values of both directions: a = reference, b = candidate, as in MPEG's pc_error; `symmetric` is the larger."""

    a_to_b: float | None = None
    b_to_a: float | None = None
    symmetric: float | None = None


@dataclass(frozen=True)
class Open3d:
    """Metrics that Open3D's `t.geometry.PointCloud.compute_metrics` returns.

    Attributes:
        chamfer: sum of both mean distances.
        hausdorff: largest distance of both directions.
        fscore: precision, recall and F-score by threshold; Open3D prints the F-score in per cent.
    """

    chamfer: float
    hausdorff: float
    fscore: tuple[FScore, ...]

    @classmethod
    def of(cls, forth: OneWay, back: OneWay, thresholds: Sequence[float]) -> Open3d:
        """Return the metrics from the distances candidate → reference and reference → candidate."""
        scores = zip(thresholds, forth.shares, back.shares, strict=True)
        return cls(
            chamfer=forth.mean + back.mean,
            hausdorff=max(forth.largest, back.largest),
            fscore=tuple(
                FScore(t, precision, recall, harmonic_mean(precision, recall)) for t, precision, recall in scores
            ),
        )


@dataclass(frozen=True)
class Pdal:
    """Metrics that `pdal chamfer` and `pdal hausdorff` print.

    Attributes:
        chamfer: SUM of the squared distances of both directions.
        hausdorff: largest distance of both directions.
    """

    chamfer: float
    hausdorff: float

    @classmethod
    def of(cls, forth: OneWay, back: OneWay, _: Sequence[float]) -> Pdal:
        """Return the metrics from the distances candidate → reference and reference → candidate."""
        sums = (way.points * way.mean_square for way in (forth, back))
        return cls(chamfer=sum(sums), hausdorff=max(forth.largest, back.largest))


@dataclass(frozen=True)
class Pytorch3d:
    """Metrics that PyTorch3D's `loss.chamfer_distance` returns.

    Attributes:
        chamfer: sum of both mean squared distances.
        single_directional: mean squared distance of one direction, which `single_directional=True` returns.
    """

    chamfer: float
    single_directional: DirectedValues

    @classmethod
    def of(cls, forth: OneWay, back: OneWay, _: Sequence[float]) -> Pytorch3d:
        """Return the metrics from the distances candidate → reference and reference → candidate."""
        squares = back.mean_square, forth.mean_square
        return cls(chamfer=sum(squares), single_directional=DirectedValues(*squares, max(squares)))


@dataclass(frozen=True)
class Kaolin:
    """Metrics that the functions of Kaolin's `metrics.pointcloud` return.

    Attributes:
        chamfer: sum of both mean squared distances.
        chamfer_unsquared: sum of both mean distances, which `squared=False` returns.
        fscore: `f_score` by threshold. Its recall is n / (n + m): n points of the candidate are within the threshold,
            and m points of the reference are not. It is the usual one only for equal numbers of points within it.
    """

    chamfer: float
    chamfer_unsquared: float
    fscore: tuple[FScore, ...]

    @classmethod
    def of(cls, forth: OneWay, back: OneWay, thresholds: Sequence[float]) -> Kaolin:
        """Return the metrics from the distances candidate → reference and reference → candidate."""
        scores = []
        for threshold, within, covered in zip(thresholds, forth.shares, back.shares, strict=True):
            hits, misses = round(forth.points * within), round(back.points * (1 - covered))
            recall = hits / (hits + misses) if hits + misses else 0.0
            fscore = 2 * within * recall / (within + recall + _KAOLIN_EPSILON)
            scores.append(FScore(threshold, within, recall, fscore))
        return cls(forth.mean_square + back.mean_square, forth.mean + back.mean, tuple(scores))


@dataclass(frozen=True)
class PointCloudUtils:
    """Metrics that the functions of point-cloud-utils return.

    Attributes:
        chamfer: sum of both mean distances.
        hausdorff: largest distance of both directions.
        one_sided_hausdorff: largest distance of each direction.
    """

    chamfer: float
    hausdorff: float
    one_sided_hausdorff: DirectedValues

    @classmethod
    def of(cls, forth: OneWay, back: OneWay, _: Sequence[float]) -> PointCloudUtils:
        """Return the metrics from the distances candidate → reference and reference → candidate."""
        largest = max(forth.largest, back.largest)
        return cls(forth.mean + back.mean, largest, DirectedValues(back.largest, forth.largest, largest))


LibraryPreset = Open3d | Pdal | Pytorch3d | Kaolin | PointCloudUtils
LIBRARY_PRESETS: Mapping[str, Callable[[OneWay, OneWay, Sequence[float]], LibraryPreset]] = {
    "open3d": Open3d.of,
    "pdal": Pdal.of,
    "pytorch3d": Pytorch3d.of,
    "kaolin": Kaolin.of,
    "point-cloud-utils": PointCloudUtils.of,
}
