"""The truth of a bench: the reference, its surface, the part that the cameras saw, and their pixel size on it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from pcbench.geometry.arrays import FloatArray
from pcbench.geometry.cameras import Camera
from pcbench.geometry.cloud import Cloud
from pcbench.geometry.crs import check_lengths
from pcbench.geometry.mesh import Mesh, MeshIndex
from pcbench.geometry.mesh_samples import sample_reference
from pcbench.geometry.neighbors import Index
from pcbench.geometry.regions import Region
from pcbench.geometry.sampling import median_spacing
from pcbench.geometry.visibility import MIN_VISIBLE_VIEWS, pixel_sizes, sees, views
from pcbench.io.files import Warn
from pcbench.io.meshes import read_mesh
from pcbench.io.source import Source
from pcbench.registration import local_origin

_PIXEL_SIZE_POINTS = 20_000  # enough for a median pixel size within a fraction of a percent
_MAX_VISIBLE_SAMPLES = 1_000_000  # enough for shares within 0.1 %


@dataclass(frozen=True, eq=False)
class Truth:
    """Truth that clouds are evaluated against.

    Args:
        cloud: reference cloud.
        cameras: true cameras by image name, in the frame of the reference.
        visible: (N,) whether the cameras saw each of its points; None if unknown.
        visibility: source of `visible`, or the reason why it is unknown.
        surface: true surface in the frame of the reference; None if unknown.
    """

    cloud: Cloud
    cameras: Mapping[str, Camera]
    visible: NDArray[np.bool_] | None
    visibility: str
    surface: Mesh | None = None

    @cached_property
    def origin(self) -> FloatArray:
        """Origin (3,) that is subtracted before distances are measured, because survey coordinates have many digits."""
        return local_origin(self.cloud)

    @cached_property
    def local_surface(self) -> MeshIndex | None:
        """True surface, minus `origin`."""
        return None if self.surface is None else MeshIndex(self.surface.shifted(self.origin))

    @cached_property
    def local_index(self) -> Index:
        """Index of the reference's points, minus `origin`."""
        return Index(self.cloud.points - self.origin)

    @cached_property
    def spacing(self) -> float:
        """Median distance between neighbouring points of the reference, in its unit."""
        return median_spacing(self.local_index)

    @cached_property
    def pixel(self) -> float | None:
        """Median size of a pixel on the surface that the cameras saw, in the reference's unit.

        The size is depth over focal length. The median is over the lines of sight to points that are evenly spread over
        the visible part. Without a surface, occlusion is ignored. None without cameras, or if they saw nothing.
        """
        rows = np.arange(len(self.cloud)) if self.visible is None else np.flatnonzero(self.visible)
        rng = np.random.default_rng(0)
        points = self.cloud.points[rng.permutation(rows)[:_PIXEL_SIZE_POINTS]]
        normals: FloatArray | None = None
        index = None
        if self.surface is not None:
            index = MeshIndex(self.surface)
            _, points, faces = index.query(points)
            normals = self.surface.normals()[faces]
        sizes = []
        for camera in self.cameras.values():
            camera_sizes = pixel_sizes(camera, points)
            seen = np.isfinite(camera_sizes)
            if index is not None and normals is not None:
                seen = sees(index, camera, points, normals)
            sizes.append(camera_sizes[seen])
        all_sizes = np.concatenate(sizes) if sizes else np.empty(0)
        return float(np.median(all_sizes)) if len(all_sizes) else None

    def sample_visible(self, spacing: float, region: Region | None) -> tuple[FloatArray, float] | None:
        """Sample the part of the region that the cameras saw.

        Returns the points of the reference if they are dense enough, otherwise samples of the true surface.

        Args:
            spacing: requested spacing, in the reference's unit.
            region: region to sample; None for everything.

        Returns:
            Points (M, 3) and their spacing, which is larger than requested if more than a million points were needed.
            None if visibility is unknown.
        """
        if self.visible is None:
            return None
        own = self.cloud.points[self.visible & (True if region is None else region.contains(self.cloud.points))]
        own_spacing = 2 * self.spacing  # the nearest of randomly placed points is about half a cell away
        if own_spacing <= spacing or self.surface is None or not self.cameras:
            return (own, own_spacing) if len(own) else None
        area = self.surface.area * len(own) / len(self.cloud)  # approximate visible area
        spacing = max(spacing, float(np.sqrt(area / _MAX_VISIBLE_SAMPLES)))
        drawn = self.surface.sample(int(self.surface.area / spacing**2) + 1)
        assert drawn.normals is not None
        inside = np.flatnonzero(np.ones(len(drawn), bool) if region is None else region.contains(drawn.points))
        points, normals = drawn.points[inside], drawn.normals[inside]
        counts = views(MeshIndex(self.surface), list(self.cameras.values()), points, normals, enough=MIN_VISIBLE_VIEWS)
        points = points[counts >= MIN_VISIBLE_VIEWS]
        return (points, spacing) if len(points) else None


def read_truth(reference: Path, mesh: Path | None, cameras: Mapping[str, Camera], warn: Warn) -> Truth:
    """Read the reference and determine which part the cameras saw.

    Visibility is the attribute `visible` of the reference, otherwise it is computed by ray casting against the mesh.

    Args:
        reference: a cloud, or a mesh, which is sampled by area.
        mesh: mesh of the same surface, its faces counter-clockwise seen from outside.
        cameras: true cameras by image name.
        warn: called with one line for each warning.

    Raises:
        InputError: a file is not usable.
    """
    surface = read_mesh(mesh, on_warning=warn) if mesh is not None else None
    shape = Source.open(reference).read(warn)
    check_lengths(shape, str(reference))
    if isinstance(shape, Mesh) and surface is None:
        surface = shape
    cloud = sample_reference(shape)
    if "visible" in cloud.attributes:
        seen = np.asarray(cloud.attributes["visible"]) != 0
        return Truth(cloud, cameras, *_visibility_if_any(seen, "the reference's attribute 'visible'"), surface)
    if surface is None:
        return Truth(cloud, cameras, None, "the reference has no attribute 'visible', and there is no mesh")
    if not cameras:
        return Truth(cloud, cameras, None, "the scene has no cameras", surface)
    how = f"seen by at least {MIN_VISIBLE_VIEWS} of {len(cameras)} cameras, by ray casting against {mesh or reference}"
    return Truth(cloud, cameras, *_visibility_if_any(visible_mask(cloud, surface, cameras), how), surface)


def mesh_of(scene: Path, reference: Path) -> Path | None:
    """Return the true mesh of a scene of `pcbench synth city` if the reference is in the same folder, else None."""
    mesh = scene / "truth" / "mesh.ply"
    is_beside = mesh.is_file() and reference.resolve().parent == mesh.resolve().parent
    return mesh if is_beside and not Source.open(reference).holds_mesh else None


def _visibility_if_any(seen: NDArray[np.bool_], how: str) -> tuple[NDArray[np.bool_] | None, str]:
    return (seen, how) if seen.any() else (None, f"no point of the reference is visible ({how})")


def visible_mask(cloud: Cloud, mesh: Mesh, cameras: Mapping[str, Camera]) -> NDArray[np.bool_]:
    """Mark the points (N,) of a cloud on the mesh's surface that at least three cameras see.

    Each point is moved to the closest point of the mesh first, which removes a scanner's noise.
    """
    index = MeshIndex(mesh)
    _, closest, faces = index.query(cloud.points)
    counts = views(index, list(cameras.values()), closest, mesh.normals()[faces], enough=MIN_VISIBLE_VIEWS)
    seen: NDArray[np.bool_] = counts >= MIN_VISIBLE_VIEWS
    return seen
