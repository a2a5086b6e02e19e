"""What a bench measures against: the reference, its true surface where there is a mesh, what the cameras saw of it, and
how large their pixels are there.
"""

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
from pcbench.geometry.mesh import Mesh, MeshIndex
from pcbench.geometry.neighbors import Index, median_spacing
from pcbench.geometry.regions import Region
from pcbench.geometry.visibility import SEEN_BY, pixel_sizes, sees, views
from pcbench.io import read_cloud
from pcbench.io.files import Warn
from pcbench.io.meshes import holds_mesh, read_mesh
from pcbench.registration import local_origin

_MESH_SAMPLE_COUNT = 1_000_000  # points that stand for a mesh as the reference
_PIXEL_SIZE_POINTS = 20_000  # whose median pixel is that of the scene to a fraction of a percent
_MAX_VISIBLE_SAMPLES = 1_000_000  # of what was seen: shares of them are right to 0.1 %


@dataclass(frozen=True, eq=False)
class Truth:
    """What clouds are measured against.

    Args:
        cloud: the reference.
        cameras: the true ones by image name, in its frame.
        visible: which of its points (N,) the cameras saw; None where that cannot be said.
        visibility: where that is from, or why it cannot be said.
        surface: the true one, in the reference's frame; None where it is not known.
    """

    cloud: Cloud
    cameras: Mapping[str, Camera]
    visible: NDArray[np.bool_] | None
    visibility: str
    surface: Mesh | None = None

    @cached_property
    def origin(self) -> FloatArray:
        """(3,) subtracted before distances are measured: survey coordinates have too many digits."""
        return local_origin(self.cloud)

    @cached_property
    def local_surface(self) -> MeshIndex | None:
        """The true surface, minus `origin`."""
        return None if self.surface is None else MeshIndex(self.surface.shifted(self.origin))

    @cached_property
    def local_index(self) -> Index:
        """The reference's points, minus `origin`."""
        return Index(self.cloud.points - self.origin)

    @cached_property
    def spacing(self) -> float:
        """The median distance of the reference's points to their nearest others."""
        return median_spacing(self.local_index)

    @cached_property
    def pixel(self) -> float | None:
        """How large a pixel is on what was seen: depth over focal length, the median over lines of sight from points
        that are evenly spread over what the cameras saw. Without the surface, nothing is taken to hide anything. None
        without cameras, or where they saw nothing.
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
            found = pixel_sizes(camera, points)
            seen = np.isfinite(found)
            if index is not None and normals is not None:
                seen = sees(index, camera, points, normals)
            sizes.append(found[seen])
        together = np.concatenate(sizes) if sizes else np.empty(0)
        return float(np.median(together)) if len(together) else None

    def sample_visible(self, spacing: float, region: Region | None) -> tuple[FloatArray, float] | None:
        """Points (M, 3) evenly spread over what the cameras saw inside the region, and how far apart they are: as
        asked, or as close as a million of them can be. None where that cannot be said.

        They are the reference's where these are close enough, otherwise drawn from the true surface.
        """
        if self.visible is None:
            return None
        own = self.cloud.points[self.visible & (True if region is None else region.contains(self.cloud.points))]
        apart = 2 * self.spacing  # where places are random the nearest is half a cell away
        if apart <= spacing or self.surface is None or not self.cameras:
            return (own, apart) if len(own) else None
        area = self.surface.area * len(own) / len(self.cloud)  # about what the cameras saw
        spacing = max(spacing, float(np.sqrt(area / _MAX_VISIBLE_SAMPLES)))
        drawn = self.surface.sample(int(self.surface.area / spacing**2) + 1)
        assert drawn.normals is not None
        inside = np.flatnonzero(np.ones(len(drawn), bool) if region is None else region.contains(drawn.points))
        points, normals = drawn.points[inside], drawn.normals[inside]
        counts = views(MeshIndex(self.surface), list(self.cameras.values()), points, normals, enough=SEEN_BY)
        points = points[counts >= SEEN_BY]
        return (points, spacing) if len(points) else None


def read_truth(reference: Path, mesh: Path | None, cameras: Mapping[str, Camera], warn: Warn) -> Truth:
    """The reference and what the cameras saw of it: by its attribute `visible`, else by rays against a mesh.

    Args:
        reference: a cloud or a mesh, which is sampled by area.
        mesh: of the same surface, its faces anticlockwise seen from outside.
        cameras: the true ones by image name.
        warn: called with one line for each thing left out.

    Raises:
        InputError: a file is not usable.
    """
    surface = read_mesh(mesh, on_warning=warn) if mesh is not None else None
    if holds_mesh(reference):
        whole = read_mesh(reference, on_warning=warn)
        surface = whole if surface is None else surface
        cloud = whole.sample(_MESH_SAMPLE_COUNT)
    else:
        cloud = read_cloud(reference, on_warning=warn)
    if "visible" in cloud.attributes:
        seen = np.asarray(cloud.attributes["visible"]) != 0
        return Truth(cloud, cameras, *_visibility_if_any(seen, "the reference's attribute `visible`"), surface)
    if surface is None:
        return Truth(cloud, cameras, None, "the reference has no attribute `visible`, and no mesh is given")
    if not cameras:
        return Truth(cloud, cameras, None, "the scene has no cameras", surface)
    how = f"seen by {SEEN_BY} of the scene's {len(cameras)} cameras: rays against {mesh or reference}"
    return Truth(cloud, cameras, *_visibility_if_any(visible_mask(cloud, surface, cameras), how), surface)


def mesh_of(scene: Path, reference: Path) -> Path | None:
    """The true mesh of a scene as `pcbench synth city` writes it, where the reference is of that truth too."""
    mesh = scene / "truth" / "mesh.ply"
    if mesh.is_file() and reference.resolve().parent == mesh.resolve().parent and not holds_mesh(reference):
        return mesh
    return None


def _visibility_if_any(seen: NDArray[np.bool_], how: str) -> tuple[NDArray[np.bool_] | None, str]:
    return (seen, how) if seen.any() else (None, f"none of its points is visible ({how})")


def visible_mask(cloud: Cloud, mesh: Mesh, cameras: Mapping[str, Camera]) -> NDArray[np.bool_]:
    """Which points (N,) of a cloud of the mesh's surface at least three cameras see: from the place on the mesh that is
    nearest to them, which takes a scanner's noise out.
    """
    index = MeshIndex(mesh)
    _, closest, faces = index.query(cloud.points)
    counts = views(index, list(cameras.values()), closest, mesh.normals()[faces], enough=SEEN_BY)
    seen: NDArray[np.bool_] = counts >= SEEN_BY
    return seen
