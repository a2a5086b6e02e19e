"""Closed meshes: find out whether a triangle mesh encloses a volume, and which side of each face is outside.

Many formats store vertices per face, and some round them. So edges are compared by the positions of their ends: first
as the faces index them, then with equal positions merged, then with ends of open edges merged within a tolerance.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np

from pcbench.geometry.arrays import FloatArray, IntArray

_MERGE_TOLERANCE = 1e-5  # of the diagonal of the mesh: wider than rounding to float32, narrower than any real gap
_MAX_LOST_AREA = 1e-3  # of the mesh, in slivers whose corners are merged
_DEGENERATE_SIN2 = 1e-28  # squared sine of a face's angle up to which its area is rounding error; the kernel's limit
_MIN_WINDING = 0.75  # of a shell around a point inside it; a point on its surface has one half


class Closure(NamedTuple):
    """How the faces of a mesh meet.

    Attributes:
        corners: (F, 3) vertices of the faces, where merged vertices have one index.
        rows: faces without repeated vertices and without repetitions of other faces.
        tolerance: length within which ends of open edges were merged; 0 if none were.
        open_reason: why the surface is not closed; None if each edge has two faces that traverse it in opposite
            directions.
        unsigned_reason: why inside and outside are unknown; None if they are known.
        outward: (F,) 1 where the normal of a face points outwards, -1 where it points inwards, if that is known.
    """

    corners: IntArray
    rows: IntArray
    tolerance: float
    open_reason: str | None
    unsigned_reason: str | None
    outward: FloatArray

    def describe(self, unit: str | None) -> str:
        """Return whether the mesh is closed and, if there are no signed distances to it, why."""
        if self.open_reason is not None:
            return f"not closed ({self.open_reason})"
        merged = f" after merging vertices within {self.tolerance:.2g}{f' {unit}' if unit else ''}"
        unsigned = f", but inside and outside are unknown ({self.unsigned_reason})" if self.unsigned_reason else ""
        return f"closed{merged if self.tolerance else ''}{unsigned}"


def closure_of(vertices: FloatArray, faces: IntArray) -> Closure:
    """Return how the faces (F, 3) of a mesh with vertices (V, 3) meet."""
    corners, tolerance = faces, 0.0
    rows, edges = _meet(corners)
    if edges.problem is not None:
        corners = merged_positions(vertices)[faces]
        rows, edges = _meet(corners)
    if len(edges.open_ends):
        length = _MERGE_TOLERANCE * float(np.linalg.norm(np.ptp(vertices[faces].reshape(-1, 3), axis=0)))
        merged = _merge_near(vertices, edges.open_ends, length)[corners]
        merged_rows, merged_edges = _meet(merged)
        lost = _areas(vertices[faces[np.setdiff1d(rows, merged_rows)]]).sum()
        if merged_edges.problem is None and lost <= _MAX_LOST_AREA * _areas(vertices[faces[rows]]).sum():
            corners, rows, edges, tolerance = merged, merged_rows, merged_edges, length
    outward, shell_problem = np.ones(len(faces)), None
    if edges.problem is None:
        outward, shell_problem = _outward(vertices, faces, corners, rows)
    unsigned = edges.problem or _flat_problem(vertices[faces[rows]], len(faces)) or shell_problem
    return Closure(corners, rows, tolerance, edges.problem, unsigned, outward)


def merged_positions(vertices: FloatArray) -> IntArray:
    """Return for each vertex (V,) the first vertex at exactly the same position."""
    order = np.lexsort(vertices.T)
    ordered = vertices[order]
    starts = np.ones(len(order), dtype=bool)
    starts[1:] = (ordered[1:] != ordered[:-1]).any(axis=1)
    first = np.empty(len(order), dtype=np.int64)
    first[order] = order[starts][np.cumsum(starts) - 1]  # lexsort is stable: the first of equal ones comes first
    return first


class _Edges:
    """The edges of faces (P, 3), and what keeps the faces from being closed."""

    def __init__(self, faces: IntArray) -> None:
        starts, ends = faces.ravel(), np.roll(faces, -1, axis=1).ravel()
        width = int(faces.max(initial=0)) + 1
        keys = np.minimum(starts, ends) * width + np.maximum(starts, ends)
        keys, which, counts = np.unique(keys, return_inverse=True, return_counts=True)
        upwards = np.bincount(which[starts < ends], minlength=len(keys))
        is_open = counts == 1
        self.open_ends: IntArray = np.unique(np.concatenate([keys[is_open] // width, keys[is_open] % width]))
        self.is_branched = bool((counts > 2).any())
        self.problem = ", ".join(_edge_texts(int(is_open.sum()), counts, upwards)) or None


def _meet(corners: IntArray) -> tuple[IntArray, _Edges]:
    """Return the rows of the faces with three distinct vertices, each face once, and their edges."""
    a, b, c = corners.T
    rows = np.flatnonzero((a != b) & (b != c) & (c != a))
    edges = _Edges(corners[rows])
    if not edges.is_branched:
        return rows, edges
    start = corners[rows].argmin(axis=1)
    rotated = np.take_along_axis(corners[rows], (start[:, None] + np.arange(3)) % 3, axis=1)
    rows = rows[np.sort(np.unique(rotated, axis=0, return_index=True)[1])]
    return rows, _Edges(corners[rows])


def _edge_texts(open_edges: int, counts: IntArray, upwards: IntArray) -> Iterator[str]:
    branched = int(np.count_nonzero(counts > 2))
    turned = int(np.count_nonzero((counts == 2) & (upwards != 1)))
    if open_edges:
        yield f"{open_edges:,} open edge{'s' * (open_edges > 1)}"
    if branched:
        yield f"{branched:,} edge{'s' * (branched > 1)} of more than two faces"
    if turned:
        yield f"{turned:,} edge{'s' * (turned > 1)} between faces of opposite orientation"


def _merge_near(vertices: FloatArray, ends: IntArray, tolerance: float) -> IntArray:
    """Return a vertex for each vertex (V,): one for all ends (M,) of open edges within a tolerance of each other."""
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components
    from scipy.spatial import cKDTree

    pairs = cKDTree(vertices[ends]).query_pairs(tolerance, output_type="ndarray")
    links = coo_array((np.ones(len(pairs)), pairs.T), shape=(len(ends),) * 2)
    groups = connected_components(links, directed=False)[1]
    first = np.unique(groups, return_index=True)[1]
    merged = np.arange(len(vertices))
    merged[ends] = ends[first[groups]]
    return merged


def _areas(corners: FloatArray) -> FloatArray:
    """Return the areas (P,) of triangles (P, 3, 3)."""
    areas: FloatArray = (
        np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1) / 2
    )
    return areas


def _flat_problem(corners: FloatArray, face_count: int) -> str | None:
    """Return that faces with corners (P, 3, 3) have no area, if any."""
    first, last = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    squares, limits = (np.square(v).sum(axis=1) for v in (np.cross(first, last), first))
    flat = int(np.count_nonzero(squares <= _DEGENERATE_SIN2 * limits * np.square(last).sum(axis=1)))
    return f"{flat:,} of {face_count:,} faces with their three vertices on one line" if flat else None


def _outward(vertices: FloatArray, faces: IntArray, corners: IntArray, rows: IntArray) -> tuple[FloatArray, str | None]:
    """Return the orientation of each face (F,), and why it is unknown, from the shells of a closed surface.

    A shell that no other contains bounds a solid, whichever way its faces point. A shell inside bounds a cavity, and a
    shell inside the cavity another solid, so that their orientations must alternate.
    """
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components

    edges = corners[rows].ravel(), np.roll(corners[rows], -1, axis=1).ravel()
    links = coo_array((np.ones(len(edges[0]), dtype=np.int8), edges), shape=(len(vertices),) * 2)
    labels = connected_components(links, directed=False)[1]  # (V,)
    used, of_face = np.unique(labels[corners[rows, 0]], return_inverse=True)
    by_shell = np.split(rows[np.argsort(of_face, kind="stable")], np.cumsum(np.bincount(of_face))[:-1])
    shells = [vertices[faces[shell]] for shell in by_shell]  # (P, 3, 3) each
    low = np.array([shell.min(axis=(0, 1)) for shell in shells])
    high = np.array([shell.max(axis=(0, 1)) for shell in shells])
    signs = np.array([_volume_sign(shell) for shell in shells])
    outward = np.ones(int(labels.max()) + 1)
    ambiguous = 0
    for k, shell in enumerate(shells):
        point = shell[0, 0]
        around = np.flatnonzero((low < point).all(axis=1) & (point < high).all(axis=1))
        containers = [j for j in around if j != k and abs(_winding(shells[j], point)) > _MIN_WINDING]
        outermost = max(containers, key=lambda j: float(np.prod(high[j] - low[j])), default=k)
        ambiguous += int(signs[k] != signs[outermost] * (-1) ** len(containers))
        outward[used[k]] = signs[outermost]
    problem = f"{ambiguous:,} of {len(shells):,} shells inside another with the same orientation" if ambiguous else None
    return outward[labels[corners[:, 0]]], problem


def _volume_sign(triangles: FloatArray) -> float:
    """Return 1 if the faces (P, 3, 3) of a closed shell point outwards, -1 if they point inwards."""
    a, b, c = np.moveaxis(triangles - triangles[0, 0], 1, 0)
    return 1.0 if float(np.einsum("ni,ni->", a, np.cross(b, c))) >= 0 else -1.0


def _winding(triangles: FloatArray, point: FloatArray) -> float:
    """Return how often a closed shell (P, 3, 3) winds around a point (3,): van Oosterom and Strackee 1983, eq. 8."""
    a, b, c = np.moveaxis(triangles - point, 1, 0)
    la, lb, lc = (np.linalg.norm(side, axis=1) for side in (a, b, c))
    numerator = np.einsum("ni,ni->n", a, np.cross(b, c))
    dots = [np.einsum("ni,ni->n", *sides) for sides in ((a, b), (a, c), (b, c))]
    denominator = la * lb * lc + dots[0] * lc + dots[1] * lb + dots[2] * la
    return float(np.arctan2(numerator, denominator).sum() / (2 * np.pi))
