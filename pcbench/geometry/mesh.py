"""Triangle meshes: the type, points drawn from one, and exact distances to one."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from pcbench.errors import InputError
from pcbench.geometry.arrays import FloatArray, IntArray, as_rows
from pcbench.geometry.cloud import Cloud
from pcbench.geometry.transform import Affine, Similarity
from pcbench.native import _core

# What the kernel calls the places of a face: corners 0-2, then the edges 01, 12, 20, then the inside.
_EDGE, _INSIDE = 3, 6
_FLAT = 1e-28  # square of a face's height by its sides, below which it is rounding: the kernel's limit


@dataclass(frozen=True, eq=False)
class Mesh:
    """A triangle mesh, checked once at birth.

    Args:
        vertices: (V, 3) finite coordinates, kept as C-contiguous float64.
        faces: (F, 3) indices of vertices, F >= 1, anticlockwise seen from outside, kept as C-contiguous int64. Faces
            without area are allowed as long as one has some.
        crs: coordinate reference system as given by the file (WKT or authority code), if any.
        unit: unit of the coordinates ("m", "ft", ...), if known.

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
            raise InputError(f"expected finite coordinates, got NaN or Inf in {bad} of {len(vertices)} vertices")
        low, high = int(faces.min()), int(faces.max())
        if low < 0 or high >= len(vertices):
            wrong = low if low < 0 else high
            raise InputError(f"expected faces of the {len(vertices)} vertices 0 to {len(vertices) - 1}, got {wrong}")
        object.__setattr__(self, "vertices", vertices)
        object.__setattr__(self, "faces", np.ascontiguousarray(faces, dtype=np.int64))
        with np.errstate(over="ignore", invalid="ignore"):
            area = self.area
        if not (0 < area < np.inf):
            raise InputError(f"expected a mesh with an area, got {len(faces)} faces of area {area:g} together")

    def __len__(self) -> int:
        return len(self.faces)

    def __repr__(self) -> str:
        return f"Mesh({len(self.vertices)} vertices, {len(self)} faces)"

    @property
    def area(self) -> float:
        """Sum of the faces' areas, in the unit squared."""
        return float(self.areas().sum())

    def areas(self) -> FloatArray:
        """Area of each face (F,), in the unit squared."""
        areas: FloatArray = np.linalg.norm(self._crosses(), axis=1) / 2
        return areas

    def normals(self) -> FloatArray:
        """Unit normal of each face (F, 3); zero where it has no area."""
        crosses = self._crosses()
        lengths = np.linalg.norm(crosses, axis=1, keepdims=True)
        normals: FloatArray = np.divide(crosses, lengths, out=np.zeros_like(crosses), where=lengths > 0)
        return normals

    @cached_property
    def is_closed(self) -> bool:
        """Whether every edge is shared by exactly two faces that run along it in opposite directions.

        A face that names a vertex twice has no inside and is passed over: its neighbours meet at its one edge.
        """
        proper = self.faces[_is_proper(self.faces)]
        keys = np.sort(_edge_keys(proper, len(self.vertices)), axis=None)
        backwards = np.sort(_edge_keys(proper[:, ::-1], len(self.vertices)), axis=None)
        return bool((np.diff(keys) > 0).all() and np.array_equal(keys, backwards))

    def sample(self, count: int, seed: int = 0) -> Cloud:
        """`count` random points, uniform by area, with their faces' unit normals.

        Raises:
            InputError: `count` is less than 1.
        """
        if count < 1:
            raise InputError(f"expected a count of at least 1 point, got {count}")
        rng = np.random.default_rng(seed)
        upto = np.cumsum(self.areas())
        # searchsorted on the right never picks a face without area.
        which = np.searchsorted(upto, rng.random(count) * upto[-1], side="right").clip(max=len(self) - 1)
        s, t = rng.random((2, count, 1))
        beyond = s + t > 1  # the other half of the parallelogram is folded back
        s, t = np.where(beyond, 1 - s, s), np.where(beyond, 1 - t, t)
        a, b, c = (self.vertices[self.faces[which, k]] for k in range(3))
        return Cloud(a + s * (b - a) + t * (c - a), normals=self.normals()[which], crs=self.crs, unit=self.unit)

    def transformed(self, transform: Similarity | Affine) -> Mesh:
        """The mesh in another frame. A reflection turns the faces round, so that they still look outwards."""
        mirrored = np.linalg.det(transform.linear) < 0
        faces = self.faces[:, ::-1] if mirrored else self.faces
        return replace(self, vertices=transform.apply(self.vertices), faces=faces)

    def shifted(self, origin: ArrayLike) -> Mesh:
        """The mesh with `origin` (3,) subtracted."""
        return replace(self, vertices=self.vertices - np.asarray(origin, dtype=np.float64))

    def _crosses(self) -> FloatArray:
        """Normals (F, 3) as long as twice the faces' areas."""
        a, b, c = (self.vertices[self.faces[:, k]] for k in range(3))
        crosses: FloatArray = np.cross(b - a, c - a)
        return crosses


class MeshMatches(NamedTuple):
    """For each query its distance (N,), the nearest point of the mesh (N, 3), and the face (N,) that it lies on."""

    distances: FloatArray
    closest: FloatArray
    faces: IntArray


class RayHits(NamedTuple):
    """For each ray where it first meets the mesh (N,), in lengths of its direction, and the face (N,); inf and -1 where
    it does not."""

    distances: FloatArray
    faces: IntArray


class MeshIndex:
    """Exact point-to-triangle distances in float64 to a fixed mesh, and where rays meet it."""

    def __init__(self, mesh: Mesh) -> None:
        self.mesh = mesh
        self._tree = _core.MeshIndex(mesh.vertices, mesh.faces)

    def __len__(self) -> int:
        return len(self.mesh)

    @cached_property
    def has_inside(self) -> bool:
        """Whether `signed` distances can be had: the mesh is closed, and its faces of three vertices have an area."""
        try:
            return bool(self._pseudo_normals)
        except InputError:
            return False

    def query(self, points: ArrayLike, *, signed: bool = False) -> MeshMatches:
        """The nearest point of the mesh to each of `points` (N, 3); among equals that of the lowest face.

        Args:
            points: finite coordinates in the mesh's frame.
            signed: distances are negative inside a closed mesh, whichever way its faces look. The sign is that of the
                angle-weighted pseudo-normal of the nearest corner, edge or face: Baerentzen and Aanaes, "Signed
                distance computation using the angle weighted pseudonormal", 2005. It means nothing where the mesh
                passes through itself.

        Raises:
            InputError: `points` are not finite (N, 3) coordinates; `signed` and the mesh is not closed, or has faces
                whose three different vertices lie on one line (`has_inside` tells beforehand).
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
        """Where rays first meet the mesh, from either side of its faces.

        Watertight (Woop, Benthin and Wald, "Watertight ray/triangle intersection", 2013): no ray slips through between
        two faces with a common edge. Rays that are neighbours in the arrays should be neighbours in space.

        Args:
            origins: (N, 3) in the mesh's frame, or (3,) for all rays.
            directions: (N, 3), of any length but 0. With a depth of 1 along the viewing axis, distances are z-depths.

        Raises:
            InputError: a shape is wrong, a number is not finite, or a direction is zero.
        """
        origins, directions = _rays(origins, directions)
        hits = RayHits(np.empty(len(origins)), np.empty(len(origins), dtype=np.int64))
        self._tree.cast(origins, directions, np.inf, *hits)
        return hits

    def blocked(self, origins: ArrayLike, directions: ArrayLike, *, limit: float = np.inf) -> NDArray[np.bool_]:
        """Whether rays (N,) meet the mesh closer than `limit` lengths of their directions: with ends minus origins and
        a limit of 1 whether something stands between. Arguments and errors are those of `cast`.
        """
        origins, directions = _rays(origins, directions)
        result = np.empty(len(origins), dtype=np.bool_)
        self._tree.blocked(origins, directions, limit, result)
        return result

    @cached_property
    def _pseudo_normals(self) -> _PseudoNormals:
        return _PseudoNormals(self.mesh)


class _PseudoNormals:
    """Outward directions at the corners, edges and faces of a closed mesh.

    Each is the sum of the unit normals of the faces that meet there; at a corner they are weighted by their angles.
    """

    def __init__(self, mesh: Mesh) -> None:
        if not mesh.is_closed:
            raise InputError("expected a closed mesh to tell inside from outside, got one with open or shared edges")
        own = np.flatnonzero(_is_proper(mesh.faces))
        corners = mesh.vertices[mesh.faces[own]]  # (P, 3, 3)
        sides = np.roll(corners, -1, axis=1) - corners  # side k runs from corner k to the next
        crosses = np.cross(sides[:, 0], -sides[:, 2])
        lengths = np.linalg.norm(crosses, axis=1)
        squares = np.square(sides).sum(axis=2)
        if flat := int(np.count_nonzero(lengths**2 <= _FLAT * squares[:, 0] * squares[:, 2])):
            raise InputError(
                f"expected faces with an area to tell inside from outside, got {flat} of {len(mesh)} whose three"
                " vertices lie on one line: repair the mesh first"
            )
        volume = np.einsum("ni,ni->", corners[:, 0] - mesh.vertices.mean(axis=0), crosses)
        normals = np.sign(volume) * crosses / lengths[:, None]
        # The angle between two sides from its sine and cosine: exact also where it is nearly 0 or 180 degrees.
        cosines = -np.einsum("nki,nki->nk", sides, np.roll(sides, 1, axis=1))
        angles = np.arctan2(lengths[:, None], cosines)
        self._mesh = mesh
        self._faces = np.zeros((len(mesh), 3))
        self._faces[own] = normals
        self._corners = np.column_stack(
            [
                np.bincount(mesh.faces[own].ravel(), (angles * normals[:, [axis]]).ravel(), len(mesh.vertices))
                for axis in range(3)
            ]
        )
        keys = _edge_keys(mesh.faces[own], len(mesh.vertices)).ravel()
        order = np.argsort(keys)
        self._keys, self._owners = keys[order], own[order // 3]

    def at(self, faces: IntArray, features: NDArray[np.uint8]) -> FloatArray:
        """The direction (N, 3) at a feature (N,) of a face (N,), not of unit length."""
        directions = self._faces[faces]
        ends = self._mesh.faces[faces]
        rows = np.flatnonzero(features < _EDGE)
        directions[rows] = self._corners[ends[rows, features[rows]]]
        rows = np.flatnonzero((features >= _EDGE) & (features < _INSIDE))
        first, second = ends[rows, features[rows] - _EDGE], ends[rows, (features[rows] - _EDGE + 1) % 3]
        directions[rows] = self._along(first, second) + self._along(second, first)
        return directions

    def _along(self, first: IntArray, second: IntArray) -> FloatArray:
        """Normals (M, 3) of the faces that run from vertex `first` to vertex `second`."""
        places = np.searchsorted(self._keys, first * len(self._mesh.vertices) + second)
        return self._faces[self._owners[places]]


def _is_proper(faces: IntArray) -> NDArray[np.bool_]:
    """Which faces (F,) have three different vertices."""
    a, b, c = faces.T
    proper: NDArray[np.bool_] = (a != b) & (b != c) & (c != a)
    return proper


def _edge_keys(faces: IntArray, vertices: int) -> IntArray:
    """One number for each directed edge (F, 3) of the faces: from corner k to the next."""
    return faces * vertices + np.roll(faces, -1, axis=1)


def _rays(origins: ArrayLike, directions: ArrayLike) -> tuple[FloatArray, FloatArray]:
    towards = as_rows("directions", directions)
    starts = np.asarray(origins, dtype=np.float64)
    starts = as_rows("origins", np.broadcast_to(starts, towards.shape) if starts.shape == (3,) else starts)
    if len(starts) != len(towards):
        raise InputError(f"expected an origin for each of the {len(towards)} directions, got {len(starts)}")
    if not (np.isfinite(starts).all() and np.isfinite(towards).all()):
        raise InputError("expected rays of finite numbers, got NaN or Inf")
    if not towards.any(axis=1).all():
        raise InputError("expected directions of some length, got zero")
    return starts, towards
