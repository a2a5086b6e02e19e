"""Local deviation maps: where a candidate deviates from the reference, and by how much."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from pcbench.errors import InputError
from pcbench.geometry.arrays import FloatArray, IntArray
from pcbench.geometry.neighbors import Index
from pcbench.geometry.order_statistics import NORMAL_MAD
from pcbench.io.map_tiles import MapOverview
from pcbench.measure.metrics import nmad, percentiles
from pcbench.measure.plane_sample import PlaneSample

LOD_Z = 1.96  # normal quantile of a two-sided 95 % level of detection
_CORES_PER_BLOCK = 512
_MIN_LOD_POINTS = 5  # points needed to estimate a standard deviation, as in CloudCompare


@dataclass(frozen=True)
class Spread:
    """Summary statistics of distances, signed or not, in the clouds' unit; all None if there are no distances.

    A sample of distances to planes has only the median, the root mean square and the NMAD.

    Attributes:
        percentiles: percentiles by name, as {"p50": ...}.
        rms: root mean square.
        bias: mean; of unsigned values it is no bias, and outputs call it mean.
        median: median of the (signed) values.
        std: standard deviation about the mean, with ddof 0 (rms^2 = bias^2 + std^2).
        nmad: normalised median absolute deviation (Höhle & Höhle 2009), see `pcbench.metrics.nmad`.
    """

    percentiles: Mapping[str, float] | None = None
    rms: float | None = None
    bias: float | None = None
    median: float | None = None
    std: float | None = None
    nmad: float | None = None

    @classmethod
    def of(cls, values: FloatArray | PlaneSample) -> Spread:
        """Summarise values (N,), or estimate the summary of all values from a sample."""
        if isinstance(values, PlaneSample):
            return cls._of_sample(values)
        if not len(values):
            return cls()
        ranks = percentiles(values)
        rms, mean = float(np.sqrt(np.mean(np.square(values)))), float(np.mean(values))
        return cls(ranks, rms, mean, ranks["p50"], float(np.std(values)), nmad(values))

    @classmethod
    def _of_sample(cls, sample: PlaneSample) -> Spread:
        def median(values: FloatArray) -> float:
            return float(np.percentile(values, 50, method="inverted_cdf", weights=sample.weights))

        middle = median(sample.distances)
        spread = NORMAL_MAD * median(np.abs(sample.distances - middle))
        return cls(rms=math.sqrt(sample.mean_square), median=middle, nmad=spread)


@dataclass(frozen=True, eq=False)
class DeviationMap:
    """Deviations at a cloud's points inside the region, in reference coordinates.

    Attributes:
        points: (M, 3) points; those of a candidate are aligned.
        rows: (M,) row of each point in its cloud.
        scalars: (M,) values by name, in the clouds' unit: `distance` to the nearest reference point; `plane_distance`,
            signed, to the tangent plane there (positive above it); `mesh_distance` to a surface (signed if the surface
            is closed, negative inside).
        m3c2: M3C2 map, if requested; it has its own core points.
        unsigned: names of the scalars that are never negative.
        sampled_from: number of points that were measured, if these are a sample of them; None: these are all.
        known_spreads: summary statistics of all measured values, if these are a sample of them.
        sample_step: points whose rows are multiples of it are an even sample, and the others were added because they
            deviate most. None: no points were added.
        overview: raster of the distances as seen from above; None: a comparison in tiles has it in its files.
    """

    points: FloatArray
    rows: IntArray
    scalars: Mapping[str, FloatArray]
    m3c2: M3C2 | None = None
    unsigned: frozenset[str] = frozenset({"distance"})
    sampled_from: int | None = None
    known_spreads: Mapping[str, Spread] | None = None
    sample_step: int | None = None
    overview: MapOverview | None = None

    @cached_property
    def is_even(self) -> NDArray[np.bool_]:
        """(M,) whether a point belongs to the even sample, which represents all points in statistics."""
        return np.ones(len(self.rows), np.bool_) if self.sample_step is None else self.rows % self.sample_step == 0

    def even_values(self, name: str) -> FloatArray:
        """Return the values of a scalar at the points of the even sample."""
        return self.scalars[name] if self.sample_step is None else self.scalars[name][self.is_even]

    @cached_property
    def spreads(self) -> dict[str, Spread]:
        """Summary statistics of each scalar, over all measured points."""
        if self.known_spreads is not None:
            return dict(self.known_spreads)
        return {name: Spread.of(values) for name, values in self.scalars.items()}

    @property
    def maps(self) -> dict[str, FloatArray]:
        """The scalars except the distances to the nearest points."""
        return {name: values for name, values in self.scalars.items() if name != "distance"}


class M3C2(NamedTuple):
    """M3C2 distances between two clouds along the reference's normals, one per core point (K,).

    Lague et al. 2013, section 3.2: `distances` are the mean position of the candidate minus that of the reference
    within a cylinder along the normal. They are positive if the candidate lies on the side that the normal points to,
    and NaN if either cloud has no points in the cylinder. `lod` is the level of detection at 95 %, eq. 1:
    1.96 (sqrt(s1^2 / n1 + s2^2 / n2) + registration error), with standard deviations s of ddof 0 as in CloudCompare.
    It is NaN if either cloud has fewer than five points.
    """

    cores: FloatArray  # (K, 3)
    normals: FloatArray  # (K, 3)
    distances: FloatArray
    lod: FloatArray
    counts_reference: IntArray
    counts_candidate: IntArray
    std_reference: FloatArray
    std_candidate: FloatArray
    radius: float
    half_length: float
    registration_error: float

    def shifted(self, origin: FloatArray) -> M3C2:
        """Return the same map in coordinates from which `origin` (3,) was subtracted."""
        return self._replace(cores=self.cores - origin)

    def with_registration_error(self, error: float) -> M3C2:
        """Return the same map with another registration error in its levels of detection."""
        lod = self.lod + LOD_Z * (error - self.registration_error)
        return self._replace(lod=lod, registration_error=error)

    @property
    def sigma(self) -> FloatArray:
        """(K,) standard errors of the distances without the registration error; NaN without a level of detection."""
        return self.lod / LOD_Z - self.registration_error

    @property
    def significant(self) -> FloatArray:
        """(K,) 1 if |distance| exceeds the level of detection, 0 if it does not, NaN if it cannot be tested."""
        has_level = np.isfinite(self.distances) & np.isfinite(self.lod)
        return np.where(has_level, np.abs(self.distances) > self.lod, np.nan)

    @property
    def spread(self) -> Spread:
        """Summary statistics of the finite distances."""
        return Spread.of(self.distances[np.isfinite(self.distances)])

    @property
    def median_lod(self) -> float | None:
        """Median level of detection of the tested core points; None if none was tested."""
        tested = np.isfinite(self.significant)
        return float(np.median(self.lod[tested])) if tested.any() else None

    @property
    def significant_share(self) -> float | None:
        """Share of the tested distances that exceed their level of detection; None if none was tested."""
        significant = self.significant[np.isfinite(self.significant)]
        return float(significant.mean()) if len(significant) else None


def m3c2(
    reference: Index,
    candidate: Index,
    cores: FloatArray,
    normals: FloatArray,
    *,
    radius: float,
    half_length: float,
    registration_error: float = 0.0,
) -> M3C2:
    """Compute M3C2 at core points (K, 3) along unit normals (K, 3).

    Args:
        reference: search index of the reference.
        candidate: search index of the candidate.
        cores: (K, 3) core points.
        normals: (K, 3) unit normals.
        radius: radius of the cylinders (half of CloudCompare's projection *scale*, which is a diameter).
        half_length: length of the cylinders to either side of a core point.
        registration_error: addend of the level of detection, in the clouds' unit.

    Raises:
        InputError: a length is not positive, or the arrays do not match.
    """
    if not (radius > 0 and half_length > 0 and registration_error >= 0):
        raise InputError(
            f"expected positive lengths for M3C2, got radius {radius}, half length {half_length},"
            f" registration error {registration_error}"
        )
    mean_r, std_r, count_r = _positions_along(reference, cores, normals, radius, half_length)
    mean_c, std_c, count_c = _positions_along(candidate, cores, normals, radius, half_length)
    with np.errstate(divide="ignore", invalid="ignore"):
        variance = std_r**2 / count_r + std_c**2 / count_c
    enough = np.minimum(count_r, count_c) >= _MIN_LOD_POINTS
    lod = np.where(enough, LOD_Z * (np.sqrt(variance) + registration_error), np.nan)
    return M3C2(
        cores,
        normals,
        mean_c - mean_r,
        lod,
        count_r,
        count_c,
        std_r,
        std_c,
        radius,
        half_length,
        registration_error,
    )


def _positions_along(
    index: Index, cores: FloatArray, normals: FloatArray, radius: float, half_length: float
) -> tuple[FloatArray, FloatArray, IntArray]:
    """Return mean, standard deviation and count of the positions along each normal; NaN if there are none."""
    # Blocks of cores limit the memory: wide cylinders hold thousands of points each.
    starts = range(0, max(len(cores), 1), _CORES_PER_BLOCK)
    parts = [
        _positions_along_block(
            index, cores[s : s + _CORES_PER_BLOCK], normals[s : s + _CORES_PER_BLOCK], radius, half_length
        )
        for s in starts
    ]
    mean, std, count = (np.concatenate(column) for column in zip(*parts, strict=True))
    return mean, std, count


def _positions_along_block(
    index: Index, cores: FloatArray, normals: FloatArray, radius: float, half_length: float
) -> tuple[FloatArray, FloatArray, IntArray]:
    points = index.query_cylinder(cores, normals, radius, half_length)
    core = np.repeat(np.arange(len(cores)), points.counts)
    position = np.einsum("ni,ni->n", index.points[points.indices] - cores[core], normals[core])
    count = points.counts
    with np.errstate(divide="ignore", invalid="ignore"):
        mean = np.bincount(core, position, minlength=len(cores)) / count
        variance = np.bincount(core, np.square(position - mean[core]), minlength=len(cores)) / count
    return mean, np.sqrt(variance), count
