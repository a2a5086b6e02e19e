"""Triangle meshes: the type, random points on the surface, exact distances, and ray casting."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from pcbench.errors import InputError
from pcbench.extras import require
from pcbench.geometry import pyvista_points
from pcbench.geometry.arrays import FloatArray, IntArray, as_rows, bounds
from pcbench.geometry.closure import Closure, closure_of
from pcbench.geometry.cloud import Cloud
from pcbench.geometry.transform import Affine, Similarity
from pcbench.native import _core

# The kernel's codes for the part of a face: corners 0-2, then the edges 01, 12, 20, then the interior.
_FIRST_EDGE, _INTERIOR = 3, 6


@dataclass(frozen=True, eq=False)
class Mesh:
    """A validated triangle mesh.

    Args:
        vertices: (V, 3) finite coordinates, stored as C-contiguous float64.
        faces: (F, 3) vertex indices, F >= 1, anticlockwise seen from outside, stored as C-contiguous int64. Faces
            without area are allowed if at least one face has an area.
        crs: coordinate reference system as given by the file (WKT or authority code), or None.
        unit: unit of the coordinates ("m", "ft", ...), or None if unknown.

    Raises:
        InputError: a shape or a value is not as described.
    """

    vertices: FloatArray
    faces: IntArray
    crs: str | None = None
    unit: str | None = None

    def __post_init__(self) -> None:
        vertices, faces = as_rows("vertices", self.vertices), np.asarray(self.faces)
        if faces.ndim != 2 or faces.shape[1] != 3 or faces.dtype.kind not in "iu":
            raise InputError(f"expected faces as an (F, 3) array of whole numbers, got {faces.shape} of {faces.dtype}")
        if not len(faces):
            raise InputError("expected a mesh with at least one face, got none")
        if not np.isfinite(vertices).all():
            bad = int(np.count_nonzero(~np.isfinite(vertices).all(axis=1)))
            raise InputError(
                f"expected finite coordinates, got NaN or Inf in {bad} of {len(vertices)} vertices; remove them first"
            )
        low, high = int(faces.min()), int(faces.max())
        if low < 0 or high >= len(vertices):
            wrong = low if low < 0 else high
            raise InputError(f"expected vertex indices from 0 to {len(vertices) - 1} in faces, got {wrong}")
        object.__setattr__(self, "vertices", vertices)
        object.__setattr__(self, "faces", np.ascontiguousarray(faces, dtype=np.int64))
        with np.errstate(over="ignore", invalid="ignore"):
            area = self.area
        if not (0 < area < np.inf):
            raise InputError(f"expected a mesh with an area, got {len(faces)} faces with a total area of {area:g}")

    @classmethod
    def from_pyvista(cls, data: Any) -> Mesh:
        """Copy the faces of a `pyvista.PolyData`; polygons become triangles.

        Raises:
            InputError: `data` is not a PolyData, or its faces are not a valid `Mesh`.
        """
        if not hasattr(data, "regular_faces"):
            raise InputError(
                f"expected a pyvista PolyData, got {type(data).__name__}; call its method extract_surface() first"
            )
        if not data.is_all_triangles:
            data = data.triangulate()
        faces = np.array(data.regular_faces if data.n_cells else np.empty((0, 3)), dtype=np.int64)
        return cls(np.array(data.points, np.float64), faces, **pyvista_points.frame(data))

    def to_pyvista(self) -> Any:
        """Copy to a `pyvista.PolyData` with float64 vertices; the coordinate system and the unit are field data.

        Raises:
            MissingExtra: pyvista is not installed.
        """
        data = require("pyvista").PolyData.from_regular_faces(self.vertices.copy(), self.faces)
        pyvista_points.add_frame(data, crs=self.crs, unit=self.unit)
        return data

    def __len__(self) -> int:
        return len(self.faces)

    def __repr__(self) -> str:
        return f"Mesh({len(self.vertices)} vertices, {len(self)} faces)"

    @property
    def centre(self) -> tuple[float, float]:
        """Middle of the ranges of x and y."""
        low, high = bounds(self.vertices)
        return float(low[0] / 2 + high[0] / 2), float(low[1] / 2 + high[1] / 2)

    @property
    def area(self) -> float:
        """Total area of the faces, in squared units."""
        return float(self.areas().sum())

    def areas(self) -> FloatArray:
        """Return the area of each face (F,), in squared units."""
        areas: FloatArray = np.linalg.norm(self._cross_products(), axis=1) / 2
        return areas

    def normals(self) -> FloatArray:
        """Return the unit normal of each face (F, 3); zero for a face without area."""
        cross_products = self._cross_products()
        lengths = np.linalg.norm(cross_products, axis=1, keepdims=True)
        normals: FloatArray = np.divide(cross_products, lengths, out=np.zeros_like(cross_products), where=lengths > 0)
        return normals

    @cached_property
    def closure(self) -> Closure:
        """How the faces meet: whether they enclose a volume, and which side is outside."""
        return closure_of(self.vertices, self.faces)

    @property
    def is_closed(self) -> bool:
        """Return whether every edge is shared by exactly two faces that traverse it in opposite directions.

        Vertices at one position count as one, see `closure`. Repeated faces are ignored, and so are faces that repeat
        a vertex: their neighbours meet at their only edge.
        """
        return self.closure.open_reason is None

    def sample(self, count: int, seed: int = 0) -> Cloud:
        """Return `count` random points, distributed uniformly by area, with the unit normals of their faces.

        Raises:
            InputError: `count` is less than 1.
        """
        if count < 1:
            raise InputError(f"expected a count of at least 1 point, got {count}")
        rng = np.random.default_rng(seed)
        cumulative_area = np.cumsum(self.areas())
        # With side="right", searchsorted never selects a face without area.
        which = np.searchsorted(cumulative_area, rng.random(count) * cumulative_area[-1], side="right").clip(
            max=len(self) - 1
        )
        s, t = rng.random((2, count, 1))
        outside = s + t > 1  # the other half of the parallelogram is folded back
        s, t = np.where(outside, 1 - s, s), np.where(outside, 1 - t, t)
        a, b, c = (self.vertices[self.faces[which, k]] for k in range(3))
        return Cloud(a + s * (b - a) + t * (c - a), normals=self.normals()[which], crs=self.crs, unit=self.unit)

    def transformed(self, transform: Similarity | Affine) -> Mesh:
        """Return the mesh in another frame. Mirroring reverses the faces, so that normals still point outwards."""
        mirrored = np.linalg.det(transform.linear) < 0
        faces = self.faces[:, ::-1] if mirrored else self.faces
        return replace(self, vertices=transform.apply(self.vertices), faces=faces)

    def shifted(self, origin: ArrayLike) -> Mesh:
        """Return the mesh with `origin` (3,) subtracted from its coordinates."""
        return replace(self, vertices=self.vertices - np.asarray(origin, dtype=np.float64))

    def _cross_products(self) -> FloatArray:
        """Return the face normals (F, 3) with lengths of twice the face areas."""
        a, b, c = (self.vertices[self.faces[:, k]] for k in range(3))
        cross_products: FloatArray = np.cross(b - a, c - a)
        return cross_products


class MeshMatches(NamedTuple):
    """Distance (N,), closest point on the mesh (N, 3) and its face (N,) for each query."""

    distances: FloatArray
    closest: FloatArray
    faces: IntArray


class RayHits(NamedTuple):
    """First intersection of each ray: distance (N,) in lengths of its direction, and face (N,); inf and -1 if none."""

    distances: FloatArray
    faces: IntArray


class MeshIndex:
    """Index of a mesh for exact float64 point-to-triangle distances and for ray casting."""

    def __init__(self, mesh: Mesh) -> None:
        self.mesh = mesh
        self._tree = _core.MeshIndex(mesh.vertices, mesh.faces)

    def __len__(self) -> int:
        return len(self.mesh)

    def __reduce__(self) -> tuple[type[MeshIndex], tuple[Mesh]]:
        """Pickle the mesh: another process builds the same tree."""
        return MeshIndex, (self.mesh,)

    @property
    def supports_signed_distance(self) -> bool:
        """Return whether `query` supports signed distances; otherwise `mesh.closure.unsigned_reason` says why not."""
        return self.mesh.closure.unsigned_reason is None

    def query(self, points: ArrayLike, *, signed: bool = False) -> MeshMatches:
        """Find the closest point of the mesh to each of `points` (N, 3); the lowest face index decides ties.

        Args:
            points: (N, 3) finite coordinates in the mesh's frame.
            signed: whether distances are negative inside the mesh, which must be closed; the orientation of its faces
                does not matter. The sign comes from the angle-weighted pseudo-normal of the nearest corner, edge or
                face: Baerentzen and Aanaes, "Signed distance computation using the angle weighted pseudonormal", 2005.
                It is undefined where the mesh intersects itself.

        Raises:
            InputError: `points` are not finite (N, 3) coordinates; `signed` and inside and outside of the mesh are
                unknown (see `supports_signed_distance`).
        """
        queries = as_rows("points", points)
        if not np.isfinite(queries).all():
            raise InputError("expected points of finite coordinates, got NaN or Inf")
        count = len(queries)
        matches = MeshMatches(np.empty(count), np.empty((count, 3)), np.empty(count, dtype=np.int64))
        features = np.empty(count, dtype=np.uint8)
        self._tree.query(queries, *matches, features)
        if not signed:
            return matches
        side = np.einsum("ni,ni->n", queries - matches.closest, self._pseudo_normals.at(matches.faces, features))
        return matches._replace(distances=np.where(side < 0, -matches.distances, matches.distances))

    def cast(self, origins: ArrayLike, directions: ArrayLike) -> RayHits:
        """Find the first intersection of each ray with the mesh, on either side of its faces.

        The test is watertight (Woop, Benthin and Wald, "Watertight ray/triangle intersection", 2013): no ray passes
        between two faces that share an edge. It is fastest if consecutive rays are close in space.

        Args:
            origins: (N, 3) in the mesh's frame, or (3,) for all rays.
            directions: (N, 3) of any nonzero length. If their component along the viewing axis is 1, the returned
                distances are z-depths.

        Raises:
            InputError: a shape is wrong, a number is not finite, or a direction is zero.
        """
        origins, directions = _as_rays(origins, directions)
        hits = RayHits(np.empty(len(origins)), np.empty(len(origins), dtype=np.int64))
        self._tree.cast(origins, directions, np.inf, *hits)
        return hits

    def is_occluded(self, origins: ArrayLike, directions: ArrayLike, *, limit: float = np.inf) -> NDArray[np.bool_]:
        """Return whether each ray (N,) intersects the mesh before `limit` lengths of its direction.

        To test lines of sight, pass end points minus origins as directions and a limit of 1. The other arguments and
        the errors are those of `cast`.
        """
        origins, directions = _as_rays(origins, directions)
        result = np.empty(len(origins), dtype=np.bool_)
        self._tree.blocked(origins, directions, limit, result)
        return result

    @cached_property
    def _pseudo_normals(self) -> _PseudoNormals:
        return _PseudoNormals(self.mesh)


class _PseudoNormals:
    """Pseudo-normals, pointing outwards, at the corners, edges and faces of a closed mesh.

    Each is the sum of the unit normals of the adjacent faces; at a corner they are weighted by their angles.
    Baerentzen and Aanaes 2005, section 2.
    """

    def __init__(self, mesh: Mesh) -> None:
        closure = mesh.closure
        if closure.unsigned_reason is not None:
            raise InputError(
                f"expected a closed mesh for signed distances, got {closure.unsigned_reason}; repair the mesh first"
            )
        rows = closure.rows
        corners = mesh.vertices[mesh.faces[rows]]  # (P, 3, 3)
        sides = np.roll(corners, -1, axis=1) - corners  # side k runs from corner k to the next
        cross_products = np.cross(sides[:, 0], -sides[:, 2])
        lengths = np.linalg.norm(cross_products, axis=1)
        normals = closure.outward[rows, None] * cross_products / lengths[:, None]
        # Unlike arccos, arctan2 of the sine and the cosine is also accurate for angles near 0 or 180 degrees.
        cosines = -np.einsum("nki,nki->nk", sides, np.roll(sides, 1, axis=1))
        angles = np.arctan2(lengths[:, None], cosines)
        self._ends, self._count = closure.corners, len(mesh.vertices)
        self._faces = closure.outward[:, None] * mesh.normals()
        self._corners = np.column_stack(
            [
                np.bincount(self._ends[rows].ravel(), (angles * normals[:, [axis]]).ravel(), self._count)
                for axis in range(3)
            ]
        )
        keys = (self._ends[rows] * self._count + np.roll(self._ends[rows], -1, axis=1)).ravel()
        order = np.argsort(keys)
        self._keys, self._key_faces = keys[order], rows[order // 3]

    def at(self, faces: IntArray, features: NDArray[np.uint8]) -> FloatArray:
        """Return the pseudo-normals (N, 3), not of unit length, at features (N,) of faces (N,): the kernel's codes."""
        directions = self._faces[faces]
        ends = self._ends[faces]
        rows = np.flatnonzero(features < _INTERIOR)
        starts = features[rows] % _FIRST_EDGE
        first = ends[rows, starts]
        second = np.where(features[rows] < _FIRST_EDGE, first, ends[rows, (starts + 1) % 3])
        is_corner = first == second  # or an edge whose ends were merged
        directions[rows[is_corner]] = self._corners[first[is_corner]]
        rows, first, second = rows[~is_corner], first[~is_corner], second[~is_corner]
        directions[rows] = self._face_normals_at_edges(first, second) + self._face_normals_at_edges(second, first)
        return directions

    def _face_normals_at_edges(self, first: IntArray, second: IntArray) -> FloatArray:
        """Return the normals (M, 3) of the faces with a directed edge from vertex `first` to vertex `second`."""
        positions = np.searchsorted(self._keys, first * self._count + second)
        return self._faces[self._key_faces[positions]]


def _as_rays(origins: ArrayLike, directions: ArrayLike) -> tuple[FloatArray, FloatArray]:
    ray_directions = as_rows("directions", directions)
    starts = np.asarray(origins, dtype=np.float64)
    starts = as_rows("origins", np.broadcast_to(starts, ray_directions.shape) if starts.shape == (3,) else starts)
    if len(starts) != len(ray_directions):
        raise InputError(f"expected an origin for each of the {len(ray_directions)} directions, got {len(starts)}")
    if not (np.isfinite(starts).all() and np.isfinite(ray_directions).all()):
        raise InputError("expected finite origins and directions of rays, got NaN or Inf")
    if not ray_directions.any(axis=1).all():
        raise InputError("expected ray directions of nonzero length, got zero")
    return starts, ray_directions
