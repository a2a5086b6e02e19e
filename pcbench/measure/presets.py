"""Presets: the fixed definitions of other tools and papers, applied to the same aligned pair.

All of them compare complete clouds after a hard crop: both clouds lose the points outside the region.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from pcbench.geometry.arrays import FloatArray, IntArray
from pcbench.geometry.neighbors import Index, Matches, match_both_directions
from pcbench.geometry.sampling import NeighborRange
from pcbench.geometry.voxels import open3d_voxel_means
from pcbench.measure import metrics
from pcbench.measure.library_presets import LIBRARY_PRESETS, DirectedValues, LibraryPreset, OneWay
from pcbench.native import _core

_TIE_TOLERANCE = 1e-8  # pc_error treats squared distances this close as equal
_MAX_TIES = 30


@dataclass(frozen=True)
class Gao2025:
    """Definitions of Gao et al. 2025.

    Attributes:
        d1_mse: mean squared distance from the candidate to the reference's points.
        d2_mse: mean squared distance from the candidate to the reference's tangent planes; None without normals.
        d2_poisson_mse: mean squared distance to the reference's Poisson mesh; None if it was not requested.
        hausdorff: symmetric Hausdorff distance.
        chamfer: `d1_mse` plus `d1_back_mse`.
        d1_back_mse: mean squared distance from the reference to the candidate's points, which the paper's D1 omits.
            None in files of versions that did not write it.
    """

    d1_mse: float
    d2_mse: float | None
    d2_poisson_mse: float | None
    hausdorff: float
    chamfer: float
    d1_back_mse: float | None = None


@dataclass(frozen=True)
class Mpeg:
    """Metrics that MPEG's pc_error prints; peak in the clouds' unit, PSNR in dB."""

    d1_mse: DirectedValues
    d2_mse: DirectedValues
    d1_psnr: float | None
    d2_psnr: float | None
    hausdorff_squared_d1: float
    hausdorff_squared_d2: float | None
    peak: float


@dataclass(frozen=True)
class Tnt:
    """F-scores of Tanks and Temples."""

    fscore: tuple[metrics.FScore, ...]


Preset = Gao2025 | Mpeg | Tnt | LibraryPreset


class CroppedPair(NamedTuple):
    """Reference and candidate after a hard crop, and the nearest points in both directions."""

    reference: Index
    candidate: Index
    to_reference: Matches  # nearest reference points of the candidate's points
    to_candidate: Matches  # nearest candidate points of the reference's points
    tied_to_reference: NDArray[np.bool_]  # whether a second point is as near as the nearest one
    tied_to_candidate: NDArray[np.bool_]
    neighbors: NeighborRange | None  # distances between neighbours in the reference; None for a single point
    normals: FloatArray | None  # (N, 3) unit normals of the reference
    raw_normals: FloatArray | None  # the same as they were read; None if they were estimated


def measure_preset(
    name: str,
    pair: CroppedPair,
    thresholds: tuple[float, ...],
    *,
    to_poisson: FloatArray | None = None,
    mpeg_peak: float | None = None,
) -> Preset:
    """Compute the preset of that name.

    Args:
        name: one of `NAMES`.
        pair: the clouds.
        thresholds: thresholds of F-scores.
        to_poisson: distances (M,) to the reference's Poisson mesh, if there is one.
        mpeg_peak: peak of MPEG's PSNR; None: see `mpeg`.
    """
    if name == "gao2025":
        return gao2025(pair, to_poisson)
    if name == "mpeg":
        return mpeg(pair, mpeg_peak)
    if name == "tnt":
        return tnt(pair, thresholds)
    forth, back = (OneWay.of(matches.distances, thresholds) for matches in (pair.to_reference, pair.to_candidate))
    return LIBRARY_PRESETS[name](forth, back, thresholds)


def match(
    reference: Index,
    candidate: Index,
    neighbors: NeighborRange | None,
    normals: FloatArray | None,
    raw_normals: FloatArray | None,
) -> CroppedPair:
    """Match a cropped pair in both directions, with the ties that presets need."""
    to_reference, tied_to_reference = reference.query_index_with_ties(candidate, _TIE_TOLERANCE)
    to_candidate, tied_to_candidate = candidate.query_index_with_ties(reference, _TIE_TOLERANCE)
    matches = (to_reference, to_candidate, tied_to_reference, tied_to_candidate)
    return CroppedPair(reference, candidate, *matches, neighbors, normals, raw_normals)


def gao2025(pair: CroppedPair, to_poisson: FloatArray | None = None) -> Gao2025:
    """Compute the metrics of Gao et al. 2025, table 2, under one consistent reading of its definitions.

    D1 and D2 are mean squares from the candidate to the reference. The Hausdorff distance is symmetric and unsquared.
    Chamfer is the sum of both mean squares. The paper's "point to surface" has two readings, both reported: `d2_mse` to
    tangent planes of the reference and `d2_poisson_mse` to its Poisson mesh (None if it was not requested).
    """
    a, closest = pair.to_reference
    b = pair.to_candidate.distances
    d2 = None
    if pair.normals is not None:
        d2 = metrics.mean_square(
            metrics.plane_distances(
                pair.candidate.points, pair.reference.points, pair.normals, closest_rows=closest, normal_rows=closest
            )
        )
    return Gao2025(
        d1_mse=metrics.mean_square(a),
        d2_mse=d2,
        d2_poisson_mse=None if to_poisson is None else metrics.mean_square(to_poisson),
        hausdorff=metrics.hausdorff(a, b),
        chamfer=metrics.chamfer_squared(a, b),
        d1_back_mse=metrics.mean_square(b),
    )


def tnt(pair: CroppedPair, thresholds: tuple[float, ...]) -> Tnt:
    """Compute F-scores as in Tanks and Temples; use the selection volume as the crop. See `tnt_fscore`."""
    return Tnt(tuple(tnt_fscore(pair.reference.points, pair.candidate.points, each)[0] for each in thresholds))


def tnt_fscore(
    reference: FloatArray, candidate: FloatArray, threshold: float
) -> tuple[metrics.FScore, tuple[int, int]]:
    """Compute the F-score of Tanks and Temples (Knapitsch et al. 2017) of cropped points (N, 3), N >= 1.

    Both clouds are downsampled to the mean point of each voxel, with voxels of half the threshold. Distances below the
    threshold count; one that equals it does not.

    Returns:
        The F-score, and the numbers of points of the reference and the candidate after downsampling.
    """
    indices = [Index(open3d_voxel_means(points, threshold / 2)) for points in (reference, candidate)]
    to_reference, to_candidate = match_both_directions(*indices)
    below = float(np.nextafter(threshold, 0))  # the largest distance that counts
    scores = metrics.fscore(to_reference.distances, to_candidate.distances, below)
    return scores._replace(threshold=threshold), (len(indices[0]), len(indices[1]))


def mpeg(pair: CroppedPair, peak: float | None = None) -> Mpeg:
    """Compute the metrics of MPEG's pc_error (mpeg-pcc-dmetric 0.14.2), a = reference, b = candidate.

    Hausdorff distances are SQUARED. Duplicate points are merged first. D2 uses the target's normals; the candidate's
    are averages of the reference's, neither oriented nor normalised again. Ties are averaged. Coordinate differences
    are rounded to float32 as in pc_error, to match its printed digits. The coordinates themselves are not rounded: at
    UTM offsets, its float32 has errors of up to several per cent.

    Args:
        pair: the clouds.
        peak: peak p of the PSNR 10 log10(3 p^2 / mse), in the clouds' unit: pc_error's `--resolution`, such as 1023 for
            coordinates of ten bits. None: the largest distance from a reference point to its nearest neighbour.
    """
    pair = _merge_duplicates(pair)
    a, b = pair.reference.points, pair.candidate.points
    d1 = [
        _MeanAndMaximum.of(_float32_squares(a, b, pair.to_candidate.indices)),
        _MeanAndMaximum.of(_float32_squares(b, a, pair.to_reference.indices)),
    ]
    d2: list[_MeanAndMaximum] = []
    normals = pair.normals if pair.raw_normals is None else np.nan_to_num(pair.raw_normals, posinf=0, neginf=0)
    if normals is not None:
        ab = _all_nearest(pair.reference, pair.candidate, pair.to_candidate, pair.tied_to_candidate)
        ba = _all_nearest(pair.candidate, pair.reference, pair.to_reference, pair.tied_to_reference)
        normals_b = _averaged_normals(normals, ab, ba, len(b))
        d2 = [
            _MeanAndMaximum.of(_plane_squares(a, b, normals_b, ab)),
            _MeanAndMaximum.of(_plane_squares(b, a, normals, ba)),
        ]
    if peak is None:
        peak = 0.0 if pair.neighbors is None else pair.neighbors.largest

    def both_ways(squares: list[_MeanAndMaximum]) -> DirectedValues:
        if not squares:
            return DirectedValues()
        forth, back = (each.mean for each in squares)
        return DirectedValues(forth, back, max(forth, back))

    d1_mse, d2_mse = both_ways(d1), both_ways(d2)
    return Mpeg(
        d1_mse=d1_mse,
        d2_mse=d2_mse,
        d1_psnr=metrics.psnr(d1_mse.symmetric or 0.0, peak),
        d2_psnr=metrics.psnr(d2_mse.symmetric or 0.0, peak),
        hausdorff_squared_d1=max(each.maximum for each in d1),
        hausdorff_squared_d2=max((each.maximum for each in d2), default=None),
        peak=peak,
    )


class _MeanAndMaximum(NamedTuple):
    mean: float
    maximum: float

    @classmethod
    def of(cls, values: FloatArray) -> _MeanAndMaximum:
        return cls(float(np.mean(values)), float(values.max()))


def _float32_squares(queries: FloatArray, others: FloatArray, nearest: IntArray) -> FloatArray:
    """Return squared distances (N,) from differences rounded to float32."""
    squares = np.empty(len(queries))
    _core.rounded_squares(queries, others, nearest, squares)
    return squares


class _NearestPoints(NamedTuple):
    """All nearest points of each of N queries.

    Attributes:
        nearest: (N,) a nearest point of each query.
        tied: (T,) queries that have several, ascending.
        which: (P,) number of one of these in `tied`, for each of its nearest points.
        indices: (P,) these nearest points.
    """

    nearest: IntArray
    tied: IntArray
    which: IntArray
    indices: IntArray

    def means_of_tied(self, values: FloatArray) -> FloatArray:
        """Return the mean (T,) over the nearest points of each tied query of values (P,)."""
        means: FloatArray = np.bincount(self.which, values, len(self.tied)) / np.bincount(self.which)
        return means


def _all_nearest(queries: Index, others: Index, nearest: Matches, several: NDArray[np.bool_]) -> _NearestPoints:
    tied = np.flatnonzero(several)
    if not len(tied):
        return _NearestPoints(nearest.indices, tied, tied, tied)
    candidates = others.query(queries.points[tied], k=min(_MAX_TIES, len(others)))
    near = np.square(candidates.distances.reshape(len(tied), -1))
    which, column = np.nonzero(near - near[:, :1] < _TIE_TOLERANCE)
    return _NearestPoints(nearest.indices, tied, which, candidates.indices.reshape(len(tied), -1)[which, column])


def _averaged_normals(normals_a: FloatArray, ab: _NearestPoints, ba: _NearestPoints, count: int) -> FloatArray:
    """Average the normals of the a points matched to each b point; if there are none, of its nearest a points."""
    numbers = np.bincount(ab.nearest, minlength=count) + np.bincount(ab.indices, minlength=count)
    numbers -= np.bincount(ab.nearest[ab.tied], minlength=count)
    lonely = np.flatnonzero(numbers == 0)
    averages = np.empty((count, 3))
    for axis in range(3):  # one at a time, to limit memory
        normals = normals_a[:, axis].copy()
        normals[ab.tied] = 0.0
        sums = np.bincount(ab.nearest, normals, count)
        np.add.at(sums, ab.indices, normals_a[ab.tied[ab.which], axis])
        averages[:, axis] = sums / np.maximum(numbers, 1)
        normals_b = normals_a[ba.nearest, axis]
        normals_b[ba.tied] = ba.means_of_tied(normals_a[ba.indices, axis])
        averages[lonely, axis] = normals_b[lonely]
    return averages


def _plane_squares(queries: FloatArray, others: FloatArray, normals: FloatArray, choices: _NearestPoints) -> FloatArray:
    def squares_of(rows: IntArray | None, closest: IntArray) -> FloatArray:
        distances = metrics.plane_distances(
            queries, others, normals, query_rows=rows, closest_rows=closest, normal_rows=closest
        )
        return np.square(distances, out=distances)

    squares = squares_of(None, choices.nearest)
    squares[choices.tied] = choices.means_of_tied(squares_of(choices.tied[choices.which], choices.indices))
    return squares


def _merge_duplicates(pair: CroppedPair) -> CroppedPair:
    doubled = pair.neighbors is not None and pair.neighbors.smallest == 0
    if not doubled and not _has_duplicates(pair.candidate.points):
        return pair
    reference, first = np.unique(pair.reference.points, axis=0, return_index=True)
    candidate = np.unique(pair.candidate.points, axis=0)
    normals, raw = (None if n is None else n[first] for n in (pair.normals, pair.raw_normals))
    index = Index(reference)
    return match(index, Index(candidate), NeighborRange.within(index), normals, raw)


def _has_duplicates(points: FloatArray) -> bool:
    """Return whether two points are bitwise equal; false positives are rare (a 64-bit hash per point)."""
    bits = (points + 0.0).view(np.uint64)  # + 0.0: the two zeros become one
    key = bits[:, 0] * np.uint64(0x9E3779B97F4A7C15)
    key ^= (bits[:, 1] + np.uint64(0x7F4A7C15)) * np.uint64(0xC2B2AE3D27D4EB4F)
    key ^= key >> np.uint64(29)
    key ^= bits[:, 2] * np.uint64(0x165667B19E3779F9)
    key.sort()
    return bool((key[1:] == key[:-1]).any())


NAMES = ("gao2025", "mpeg", "tnt", *LIBRARY_PRESETS)
ALWAYS = ("gao2025", "mpeg")  # reported with every comparison
