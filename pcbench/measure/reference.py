"""The prepared reference, with all that is shared by its candidates."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from pcbench.errors import InputError, Notice
from pcbench.geometry.arrays import FloatArray, IntArray, freeze
from pcbench.geometry.cloud import Cloud
from pcbench.geometry.crop import points_inside
from pcbench.geometry.mesh import Mesh, MeshIndex
from pcbench.geometry.mesh_samples import sample_reference
from pcbench.geometry.neighbors import Index
from pcbench.geometry.normals import Surface
from pcbench.geometry.quantisation import PlacedQuantisation
from pcbench.geometry.region_text import as_region
from pcbench.geometry.regions import Region
from pcbench.geometry.sampling import NeighborRange, spacing_of_all
from pcbench.geometry.transform import Similarity
from pcbench.geometry.voxels import robust_extent, voxel_downsample_to
from pcbench.measure import intervals
from pcbench.measure.floors import FloorSurface
from pcbench.measure.results import ReferenceSummary
from pcbench.measure.settings import Settings
from pcbench.registration import Target, local_origin

ARBITRARY_SIGN = "arbitrary-sign"
"""Code of the warning that signed distances to most of the reference have an arbitrary sign."""
UNSIGNED_MESH = "unsigned-mesh"
"""Code of the warning that distances to the reference mesh have no sign."""
VOXELS_ALONG = 50  # voxels of area weighting along the scene's extent
_MIN_SAMPLED_POINTS = 2_000_000  # a sample of the distances to planes of fewer points saves no time
_MAX_VERTICAL_NZ = math.sin(math.radians(10))  # |z| of the normal of a nearly vertical surface: within 10 degrees
_MIN_VERTICAL_SHARE = 0.5  # of the measured points on nearly vertical surfaces, for a warning
_MAX_POISSON_POINTS = 400_000  # limits the Poisson reconstruction to well under a minute


@dataclass(frozen=True, eq=False)
class Reference:
    """The reference minus its local origin, with all data shared by its candidates, computed once."""

    cloud: Cloud
    origin: FloatArray
    target: Target  # for registrations
    region: Region | None  # in local coordinates: minus `origin`
    inside: NDArray[np.bool_]
    rows: IntArray | None  # rows of the points inside the region; None: all
    neighbors: NeighborRange | None  # distances between neighbours; None for a single point
    spacing: float
    cells: intervals.CorrelationCells
    voxel: float
    meshes: Mapping[str, MeshIndex]  # by the name of the map, in local coordinates
    tolerance: float | None  # of the mean squares of sampled distances to planes; None: all are measured
    seed: int

    @classmethod
    def prepare(cls, given: Cloud | Mesh, settings: Settings) -> Reference:
        """Prepare the reference of a comparison with these settings.

        Raises:
            InputError: the crop cannot be read, or contains no points.
        """
        cloud = sample_reference(given, settings.seed, settings.samples)
        origin = local_origin(cloud)
        points = cloud.points - origin
        region = as_region(settings.crop, cloud)
        region = None if region is None else region.shifted(origin)
        inside = points_inside(points, region, settings.crop, "the reference's", origin)
        surface = Surface(Index(points), settings.normal_neighbors, cloud.normals, is_even=False)
        rows = None if region is None else np.flatnonzero(inside)
        is_sampled = len(surface) >= _MIN_SAMPLED_POINTS and not surface.is_complete
        tolerance = settings.tolerance if is_sampled else None
        if len(surface) >= 3 and tolerance is None:
            surface.compute_normals(rows)  # sufficient for D2; registration estimates further ones as needed
        nearest_other = surface.take_nearest_other() if len(surface) > 1 else None
        return cls(
            cloud=cloud,
            origin=origin,
            target=Target(surface, is_sampled=isinstance(given, Mesh)),
            region=region,
            inside=inside,
            rows=rows,
            neighbors=NeighborRange.of(nearest_other),
            spacing=surface.spacing
            if nearest_other is None
            else spacing_of_all(surface.index, surface.sampling, nearest_other),
            cells=intervals.partition(points),
            voxel=robust_extent(points if rows is None else points[rows]) / VOXELS_ALONG or 1.0,
            meshes={"mesh_distance": MeshIndex(given.shifted(origin))} if isinstance(given, Mesh) else {},
            tolerance=tolerance,
            seed=settings.seed,
        )

    def with_poisson_mesh(self, map_name: str) -> Reference:
        """Add a Poisson mesh of the reference, voxel-downsampled if it is large, to measure distances to.

        Args:
            map_name: name of the map: `poisson` (by Open3D) or `poisson-meshlab` (by pymeshlab).

        Raises:
            InputError: the reference is too small for normals.
            MissingExtra: the library is not installed.
        """
        from pcbench.geometry.poisson import orient_normals, poisson_mesh, poisson_mesh_by_meshlab

        if not self.has_normals:
            raise InputError(f"expected at least 3 reference points for the map `{map_name}`: it needs normals")
        rows = voxel_downsample_to(self.points, _MAX_POISSON_POINTS, start=self.spacing)
        cloud = Cloud(self.points[rows], normals=self.surface.normals(rows))
        oriented = cloud if self.cloud.normals is not None else orient_normals(cloud)
        mesh = poisson_mesh(oriented) if map_name == "poisson" else poisson_mesh_by_meshlab(oriented)
        return replace(self, meshes={**self.meshes, f"{map_name.replace('-', '_')}_distance": MeshIndex(mesh)})

    @property
    def surface(self) -> Surface:
        """Points and normals, in local coordinates."""
        return self.target.surface

    @property
    def index(self) -> Index:
        """Search index over the points, in local coordinates."""
        return self.surface.index

    @property
    def points(self) -> FloatArray:
        """All points (N, 3), in local coordinates."""
        return self.surface.points

    @property
    def measured_points(self) -> FloatArray:
        """Points inside the region (M, 3), in local coordinates."""
        return self.points if self.rows is None else self.points[self.rows]

    @cached_property
    def measured(self) -> tuple[FloatArray, IntArray]:
        """Points inside the region (M, 3) in the original coordinates, and their rows (M,); shared by all maps."""
        points = self.cloud.points
        if self.rows is None:
            return points, freeze(np.arange(len(points)))
        return freeze(points[self.rows]), self.rows

    @property
    def rounding(self) -> PlacedQuantisation:
        """How the points are rounded, in local coordinates."""
        return PlacedQuantisation(self.cloud.quantisation, Similarity(np.eye(3), -self.origin))

    @property
    def for_floors(self) -> FloorSurface:
        """The reference as sampling floors are measured from it."""
        return FloorSurface(self.surface, self.spacing, self.rounding, self.cloud.normals is not None, self.seed)

    @property
    def has_normals(self) -> bool:
        """Return whether the points have normals or there are enough to estimate them."""
        return self.surface.has_normals

    def summary(self) -> ReferenceSummary:
        """Summarise the reference for the result."""
        mesh = self.meshes.get("mesh_distance")
        return ReferenceSummary(
            points=len(self.points),
            points_in_region=int(np.count_nonzero(self.inside)),
            spacing_median=self.spacing,
            extent=robust_extent(self.points),
            crs=self.cloud.crs,
            unit=self.cloud.unit,
            steps=tuple(self.cloud.quantisation.steps.tolist()),
            normals="given" if self.cloud.normals is not None else "estimated" if self.has_normals else None,
            faces=None if mesh is None else len(mesh.mesh.faces),
            block_side=self.cells.side,
            voxel_side=self.voxel,
            warnings=tuple(self._sign_warnings()),
        )

    def _sign_warnings(self) -> Iterator[Notice]:
        """Yield warnings if distances to the mesh have no sign, or those to most planes a random one.

        Estimated normals point upwards, so that the sign at vertical surfaces is random.
        """
        if (index := self.meshes.get("mesh_distance")) is not None:
            reason = index.mesh.closure.unsigned_reason
            if reason is not None:
                yield Notice(UNSIGNED_MESH, f"distances to the reference mesh have no sign: it has {reason}")
        if self.cloud.normals is not None or not self.has_normals:
            return
        # No row is passed, so no further normals are estimated; a sample of them is as good.
        vertical = self.surface.compute_normals(np.empty(0, dtype=np.int64))[:, 2]
        vertical = vertical if self.rows is None else vertical[self.rows]
        has_normal = np.isfinite(vertical)
        if not has_normal.any():
            return
        share = float((np.abs(vertical[has_normal]) < _MAX_VERTICAL_NZ).mean())
        if share >= _MIN_VERTICAL_SHARE:
            yield Notice(
                ARBITRARY_SIGN,
                f"the reference has no normals, and {share:.0%} of it is nearly vertical: signed distances to it have"
                " an arbitrary sign there, so that their mean (bias) and medians say little. Give a reference with"
                " normals that point outwards",
            )
