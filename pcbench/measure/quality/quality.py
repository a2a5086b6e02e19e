"""Measure the quality of one cloud: the steps in their order, and their results as one type."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from pcbench.geometry.arrays import FloatArray, IntArray
from pcbench.geometry.neighbors import Index
from pcbench.geometry.sampling import Sampling, sampling_of
from pcbench.measure.intervals import partition
from pcbench.measure.quality.bootstrap import BlockEstimate, mean_estimate, median_estimate
from pcbench.measure.quality.coordinates import CoordinateFaults, coordinate_faults
from pcbench.measure.quality.density import CloudDensity, PlanMap, measure_density, plan_counts
from pcbench.measure.quality.entropy import MapEntropy, map_entropy
from pcbench.measure.quality.outliers import Outliers, find_outliers
from pcbench.measure.quality.patches import (
    MIN_FLAT_PATCHES,
    RADIUS_SPACINGS,
    SurfacePatches,
    choose_radius,
    fit_patches,
    seeds_of,
)
from pcbench.measure.quality.settings import QualitySettings
from pcbench.measure.quality.sheets import DoubleWalls, double_walls
from pcbench.measure.quality.strips import StripAgreement, strip_agreement, strip_names
from pcbench.measure.quality.upright import Uprightness, wall_tilt
from pcbench.measure.quality.voids import WATER_CLASS, Voids, find_voids

_MIN_POINTS = 3


class SurfaceNoise(NamedTuple):
    """The spread of the points about local surfaces, as medians over flat patches.

    Attributes:
        noise: robust standard deviation about surfaces of second order.
        thickness: width along the normal that holds 90 % of the points.
        roughness: standard deviation about planes.
        flat_share: share of the patches that are flat.
        patches: number of patches.
        radius: radius of the patches.
    """

    noise: BlockEstimate
    thickness: BlockEstimate
    roughness: BlockEstimate
    flat_share: BlockEstimate
    patches: int
    radius: float


@dataclass(frozen=True)
class CloudQuality:
    """All results about one cloud; parts that do not exist for it are None.

    Attributes:
        coordinates: missing data, copies and rounding.
        density: density and spacing; None if the points cover no area.
        voids: areas without returns; None if the cloud is not one that is seen from above.
        outliers: isolated points.
        surface: noise about local surfaces; None if too few patches are flat.
        double_walls: surfaces that appear twice; None if there are too few points.
        entropy: mean map entropy and mean plane variance; None likewise.
        strips: agreement of overlapping strips; None likewise.
        upright: rotation of walls against the vertical; None likewise.
    """

    coordinates: CoordinateFaults
    density: CloudDensity | None = None
    voids: Voids | None = None
    outliers: Outliers | None = None
    surface: SurfaceNoise | None = None
    double_walls: DoubleWalls | None = None
    entropy: MapEntropy | None = None
    strips: StripAgreement | None = None
    upright: Uprightness | None = None


class QualityMaps(NamedTuple):
    """Maps in plan view, in the coordinates of the cloud: density, thickness and voids; None where there is none."""

    density: PlanMap | None = None
    thickness: PlanMap | None = None
    voids: PlanMap | None = None


@dataclass(frozen=True, eq=False)
class CloudData:
    """The points of a cloud and what tells them apart.

    Attributes:
        points: (N, 3) points.
        attributes: attributes by name, each (N,).
        normals: (N, 3) normals of the file, or None.
        files: (N,) number of the file of each point; None: one file, or not known.
    """

    points: FloatArray
    attributes: Mapping[str, NDArray[Any]]
    normals: FloatArray | None = None
    files: IntArray | None = None

    def select(self, mask: NDArray[np.bool_]) -> CloudData:
        """Return the points of a mask (N,)."""
        return CloudData(
            self.points[mask],
            {name: values[mask] for name, values in self.attributes.items()},
            None if self.normals is None else self.normals[mask],
            None if self.files is None else self.files[mask],
        )


def default_radius(data: CloudData, settings: QualitySettings) -> float:
    """Return the radius of neighbourhoods that `measure_quality` chooses for a cloud; 0 if it is too small."""
    _, missing = coordinate_faults(data.points)
    points = data.points[~missing]
    if len(points) < _MIN_POINTS:
        return 0.0
    index = Index(points - points.mean(axis=0))
    sampling = sampling_of(index)
    return _radius(index, sampling, settings) if sampling.spacing > 0 else 0.0


def measure_quality(
    data: CloudData, settings: QualitySettings, step: Callable[[str], None] = lambda _: None
) -> tuple[CloudQuality, QualityMaps]:
    """Measure the quality of a cloud.

    Args:
        data: the points, in one unit of length.
        settings: the settings.
        step: called with a short text before each step that takes time.

    Raises:
        InputError: an attribute that should tell strips apart does not exist.
    """
    step("looking for missing data and copies")
    faults, missing = coordinate_faults(data.points)
    field, strips, names = strip_names(data.attributes, data.files, settings.strips)
    if missing.any():
        data = data.select(~missing)
        strips = strips[~missing] if len(strips) else strips
    if len(data.points) < _MIN_POINTS:
        return CloudQuality(faults), QualityMaps()
    origin = data.points.mean(axis=0).round()  # small coordinates lose less to rounding
    index = Index(data.points - origin)
    sampling = sampling_of(index)
    if not sampling.spacing > 0:  # all points coincide
        return CloudQuality(faults), QualityMaps()
    step("measuring the density")
    is_first = _are_first(data.attributes)
    density, density_map = measure_density(index, sampling, is_first, settings.seed)
    voids, void_map = None, None
    if density is not None and density.is_seen_from_above:
        pulses = is_first if is_first is not None else np.ones(len(index), dtype=bool)
        classes = data.attributes.get("classification")
        water = None if classes is None else classes[pulses] == WATER_CLASS
        voids, void_map = find_voids(index.points[pulses], density.pulse_spacing, water)
        moved = tuple(void._replace(x=void.x + float(origin[0]), y=void.y + float(origin[1])) for void in voids.voids)
        voids = voids._replace(voids=moved)
    step("looking for outliers")
    outliers, is_outlier = find_outliers(index, sampling.copies)
    if is_outlier.any():
        index = Index(index.points[~is_outlier])
        strips = strips[~is_outlier] if len(strips) else strips
        data = data.select(~is_outlier)
    step("measuring the noise")
    radius = _radius(index, sampling, settings)
    patches = fit_patches(
        index, seeds_of(index.points, radius, settings.seed), radius, settings.min_neighbors, settings.seed
    )
    step("looking for double walls")
    walls = double_walls(
        index, sampling.spacing, max(faults.steps), settings.max_separation, settings.seed, data.normals
    )
    step("measuring entropy, strips and walls")
    return CloudQuality(
        coordinates=faults,
        density=density,
        voids=voids,
        outliers=outliers,
        surface=_surface_noise(patches, walls, settings.seed),
        double_walls=_moved(walls, origin),
        entropy=map_entropy(index, radius, settings.min_neighbors, settings.seed),
        strips=strip_agreement(index, strips, names, field, radius, settings.seed),
        upright=wall_tilt(patches, settings.seed),
    ), QualityMaps(*(_placed(each, origin) for each in (density_map, _thickness_map(patches), void_map)))


def _radius(index: Index, sampling: Sampling, settings: QualitySettings) -> float:
    if settings.radius is not None:
        return settings.radius
    extent = float(np.linalg.norm(np.ptp(index.points, axis=0)))
    if len(index) < 10 * settings.min_neighbors:
        return RADIUS_SPACINGS * sampling.spacing
    return choose_radius(index, sampling.spacing, extent, settings.min_neighbors, settings.seed)


def _are_first(attributes: Mapping[str, NDArray[Any]]) -> NDArray[np.bool_] | None:
    """Return which points (N,) are first returns; None if that is not known, or if all or few of them are."""
    numbers = attributes.get("return_number")
    if numbers is None:
        return None
    is_first: NDArray[np.bool_] = np.asarray(numbers == 1)
    return is_first if is_first.mean() > 0.1 else None


def _surface_noise(patches: SurfacePatches, walls: DoubleWalls, seed: int) -> SurfaceNoise | None:
    """Return the noise over flat patches that are not at double walls, whose distance is no noise."""
    if not len(patches.counts):
        return None
    is_single = np.ones(len(patches.counts), dtype=bool)
    if len(walls.places):
        nearest = Index(walls.places).query(patches.centres)
        is_single = nearest.distances > walls.radius[nearest.indices]
    flat = patches.select(patches.is_flat & is_single)
    if len(flat.counts) < MIN_FLAT_PATCHES:
        return None
    blocks = partition(flat.centres).of_point
    noise, thickness, roughness = (
        median_estimate(values, blocks, seed) for values in (flat.noise, flat.thickness, flat.relief)
    )
    share = mean_estimate(patches.is_flat.astype(float), partition(patches.centres).of_point, seed)
    assert noise is not None and thickness is not None and roughness is not None and share is not None
    return SurfaceNoise(noise, thickness, roughness, share, len(patches.counts), patches.radius)


def _thickness_map(patches: SurfacePatches) -> PlanMap | None:
    """Return the mean thickness of flat patches in square cells that have three of them on average."""
    flat = patches.select(patches.is_flat)
    if len(flat.counts) < MIN_FLAT_PATCHES or not np.ptp(flat.centres[:, :2], axis=0).all():
        return None
    grid = plan_counts(flat.centres, 3.0)
    rows, columns = grid.values.shape
    column = np.floor((flat.centres[:, 0] - grid.west) / grid.cell).astype(np.int64).clip(0, columns - 1)
    row = rows - 1 - np.floor((flat.centres[:, 1] - (grid.north - rows * grid.cell)) / grid.cell).astype(np.int64)
    sums = np.bincount(row.clip(0, rows - 1) * columns + column, flat.thickness, rows * columns)
    with np.errstate(invalid="ignore", divide="ignore"):
        return grid._replace(values=np.where(grid.values > 0, sums.reshape(rows, columns) / grid.values, np.nan))


def _placed(grid: PlanMap | None, origin: FloatArray) -> PlanMap | None:
    if grid is None:
        return None
    return grid._replace(west=grid.west + float(origin[0]), north=grid.north + float(origin[1]))


def _moved(walls: DoubleWalls, origin: FloatArray) -> DoubleWalls:
    moved = tuple(wall._replace(centre=tuple((np.array(wall.centre) + origin).tolist())) for wall in walls.walls)
    return walls._replace(walls=moved)
