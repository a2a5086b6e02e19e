"""Compiled kernels of pcbench; use the Python modules that wrap them."""

from typing import Annotated, overload

import numpy
from numpy.typing import NDArray


def isa() -> str:
    """The instruction set in use: baseline, avx2 or avx512."""

class PointIndex:
    """A search tree over points. Results are written into the given arrays."""

    @overload
    def __init__(self, points: Annotated[NDArray[numpy.float64], dict(shape=(None, 3), order='C', device='cpu', writable=False)]) -> None: ...

    @overload
    def __init__(self, points: Annotated[NDArray[numpy.float64], dict(shape=(None, 3), order='C', device='cpu', writable=False)], tree: Annotated[NDArray[numpy.float64], dict(shape=(None,), order='C', device='cpu', writable=False)]) -> None:
        """The index of these points whose tree was stored."""

    def store(self, tree: Annotated[NDArray[numpy.float64], dict(shape=(None,), order='C', device='cpu')]) -> None:
        """Write the tree into an array of as many bytes as it has."""

    @property
    def bytes(self) -> int:
        """Memory of the tree in bytes, without the points."""

    def nearest(self, queries: Annotated[NDArray[numpy.float64], dict(shape=(None, 3), order='C', device='cpu', writable=False)], hints: Annotated[NDArray[numpy.int64], dict(shape=(None,), order='C', device='cpu', writable=False)] | None, distances: Annotated[NDArray[numpy.float64], dict(shape=(None,), order='C', device='cpu')], indices: Annotated[NDArray[numpy.int64], dict(shape=(None,), order='C', device='cpu')]) -> None: ...

    def nearest_of(self, queries: PointIndex, distances: Annotated[NDArray[numpy.float64], dict(shape=(None,), order='C', device='cpu')], indices: Annotated[NDArray[numpy.int64], dict(shape=(None,), order='C', device='cpu')], slack: float = 0.0, tied: Annotated[NDArray[numpy.bool_], dict(shape=(None,), order='C', device='cpu')] | None = None) -> None:
        """
        Nearest points to the points of another index, or of this one (no point is then its own neighbour). tied: whether another point than the match has a squared distance below the match's plus slack.
        """

    def nearest_of_moved(self, queries: PointIndex, motion: Annotated[NDArray[numpy.float64], dict(shape=(3, 4), order='C', device='cpu', writable=False)], hints: Annotated[NDArray[numpy.int64], dict(shape=(None,), order='C', device='cpu', writable=False)] | None, moved: Annotated[NDArray[numpy.float64], dict(shape=(None, 3), order='C', device='cpu')], distances: Annotated[NDArray[numpy.float64], dict(shape=(None,), order='C', device='cpu')], indices: Annotated[NDArray[numpy.int64], dict(shape=(None,), order='C', device='cpu')]) -> None:
        """Nearest points to the points of another index after a motion (3, 4)."""

    def follow(self, queries: PointIndex, motion: Annotated[NDArray[numpy.float64], dict(shape=(3, 4), order='C', device='cpu', writable=False)], places: Annotated[NDArray[numpy.float64], dict(shape=(None, 3), order='C', device='cpu')], indices: Annotated[NDArray[numpy.int64], dict(shape=(None,), order='C', device='cpu')], clearances: Annotated[NDArray[numpy.float64], dict(shape=(None,), order='C', device='cpu')], moved: Annotated[NDArray[numpy.float64], dict(shape=(None, 3), order='C', device='cpu')], distances: Annotated[NDArray[numpy.float64], dict(shape=(None,), order='C', device='cpu')]) -> None:
        """
        Nearest points to the points of another index after a motion (3, 4). Places (M, 3) and indices (M,) are those of the last search of each query, and clearances (M,) the distances of its second nearest point then, 0 before any; they are updated in place.
        """

    def knearest(self, queries: Annotated[NDArray[numpy.float64], dict(shape=(None, 3), order='C', device='cpu', writable=False)], distances: Annotated[NDArray[numpy.float64], dict(shape=(None, None), order='C', device='cpu')], indices: Annotated[NDArray[numpy.int64], dict(shape=(None, None), order='C', device='cpu')]) -> None: ...

    def planes(self, k: int, rows: Annotated[NDArray[numpy.int64], dict(shape=(None,), order='C', device='cpu', writable=False)] | None, normals: Annotated[NDArray[numpy.float64], dict(shape=(None, 3), order='C', device='cpu')], variation: Annotated[NDArray[numpy.float64], dict(shape=(None,), order='C', device='cpu')], distances: Annotated[NDArray[numpy.float64], dict(shape=(None,), order='C', device='cpu')], indices: Annotated[NDArray[numpy.int64], dict(shape=(None,), order='C', device='cpu')], reach: Annotated[NDArray[numpy.float64], dict(shape=(None,), order='C', device='cpu')]) -> None:
        """
        Planes through the k nearest points of each point, or of those in rows, the point itself included, with normals oriented upwards, the nearest other point, and the distance of the k-th nearest point.
        """

    def in_balls(self, centres: NDArray[numpy.float64], radius: float) -> tuple[NDArray[numpy.int64], NDArray[numpy.int64]]:
        """Offsets (N + 1,) and the indices of points, ascending for each ball."""

    def count_near(self, queries: PointIndex, limits: Annotated[NDArray[numpy.float64], dict(shape=(None, None), order='C', device='cpu', writable=False)], counts: Annotated[NDArray[numpy.int64], dict(shape=(None, None), order='C', device='cpu')]) -> None:
        """
        Numbers of points (M, S) within distances (M, S) of the points of another index.
        """

    def in_cylinders(self, origins: NDArray[numpy.float64], axes: NDArray[numpy.float64], radius: float, half_length: float) -> tuple[NDArray[numpy.int64], NDArray[numpy.int64]]:
        """
        Offsets (N + 1,) and the indices of points, ascending for each cylinder.
        """

def bounds(points: Annotated[NDArray[numpy.float64], dict(shape=(None, 3), order='C', device='cpu', writable=False)], lower: Annotated[NDArray[numpy.float64], dict(shape=(3), order='C', device='cpu')], upper: Annotated[NDArray[numpy.float64], dict(shape=(3), order='C', device='cpu')]) -> None:
    """Lowest and highest coordinates (3,) of points, written in place."""

def group_by_cell(points: NDArray[numpy.float64], side: float, lower: NDArray[numpy.float64], cells: NDArray[numpy.int64]) -> tuple[NDArray[numpy.int64], NDArray[numpy.int64]]:
    """
    Number the occupied cubic cells in the order of their first points. The cells (N,) of the points are written
    in place; the indices of the first points (M,) and the point counts (M,) of the cells are returned.
    """

def first_in_cells(points: NDArray[numpy.float64], rows: NDArray[numpy.int64] | None, side: float, lower: NDArray[numpy.float64]) -> NDArray[numpy.int64]:
    """
    Indices (M,) of the first points in the occupied cubic cells, of all points or of those in rows.
    """

def plane_fits(points: Annotated[NDArray[numpy.float64], dict(shape=(None, 3), order='C', device='cpu', writable=False)], neighbors: Annotated[NDArray[numpy.int64], dict(shape=(None, None), order='C', device='cpu', writable=False)], normals: Annotated[NDArray[numpy.float64], dict(shape=(None, 3), order='C', device='cpu')], variation: Annotated[NDArray[numpy.float64], dict(shape=(None,), order='C', device='cpu')]) -> None:
    """
    Fit a plane to each row of neighbours. Unit normals (M, 3) and surface variation (M,) are written in place.
    """

def plane_distances(queries: Annotated[NDArray[numpy.float64], dict(shape=(None, 3), order='C', device='cpu', writable=False)], query_rows: Annotated[NDArray[numpy.int64], dict(shape=(None,), order='C', device='cpu', writable=False)] | None, closest: Annotated[NDArray[numpy.float64], dict(shape=(None, 3), order='C', device='cpu', writable=False)], closest_rows: Annotated[NDArray[numpy.int64], dict(shape=(None,), order='C', device='cpu', writable=False)] | None, normals: Annotated[NDArray[numpy.float64], dict(shape=(None, 3), order='C', device='cpu', writable=False)], normal_rows: Annotated[NDArray[numpy.int64], dict(shape=(None,), order='C', device='cpu', writable=False)] | None, distances: Annotated[NDArray[numpy.float64], dict(shape=(None,), order='C', device='cpu')]) -> None:
    """
    Signed distances (M,) along normals, written in place; each array is used in order or by its row indices.
    """

def rounded_squares(queries: Annotated[NDArray[numpy.float64], dict(shape=(None, 3), order='C', device='cpu', writable=False)], closest: Annotated[NDArray[numpy.float64], dict(shape=(None, 3), order='C', device='cpu', writable=False)], closest_rows: Annotated[NDArray[numpy.int64], dict(shape=(None,), order='C', device='cpu', writable=False)], squares: Annotated[NDArray[numpy.float64], dict(shape=(None,), order='C', device='cpu')]) -> None:
    """
    Squared distances (M,), written in place, from coordinate differences rounded to float32.
    """

def order_statistics(values: Annotated[NDArray[numpy.float64], dict(shape=(None,), order='C', device='cpu', writable=False)], center: float | None, ranks: Annotated[NDArray[numpy.int64], dict(shape=(None,), order='C', device='cpu', writable=False)], found: Annotated[NDArray[numpy.float64], dict(shape=(None,), order='C', device='cpu')]) -> bool:
    """
    Values of the ascending ranks (M,), 0 the smallest, among values (N,), or among their distances from center;
    written in place. Returned is False, and nothing is written, if a value is NaN.
    """

def box_sums(values: Annotated[NDArray[numpy.float64], dict(shape=(None, None, None, None), order='C', device='cpu', writable=False)], reach: int, sums: Annotated[NDArray[numpy.float64], dict(shape=(None, None, None, None), order='C', device='cpu')]) -> None:
    """
    Sums (Q, X, Y, Z), written in place, of values (Q, X, Y, Z) over the cells up to `reach` cells away along the
    last three axes.
    """

def medians_of_rows(values: Annotated[NDArray[numpy.float64], dict(shape=(None,), order='C', device='cpu', writable=False)], rows: Annotated[NDArray[numpy.int64], dict(shape=(None, None), order='C', device='cpu', writable=False)], medians: Annotated[NDArray[numpy.float64], dict(shape=(None,), order='C', device='cpu')]) -> None:
    """
    Median (M,) of the values (N,) at each row of indices (M, K), written in place.
    """

def add_exactly(values: Annotated[NDArray[numpy.float64], dict(shape=(None,), order='C', device='cpu', writable=False)], groups: Annotated[NDArray[numpy.int64], dict(shape=(None,), order='C', device='cpu', writable=False)], limbs: Annotated[NDArray[numpy.uint32], dict(shape=(None, 8), order='C', device='cpu')]) -> bool:
    """
    Add values (N,) to the fixed-point sums of their groups (N,), in place: limb k of a row (G, 8) counts
    2^(32 k - 128), in two's complement. Returned is False if a value is not finite or not below 2^96 in
    magnitude.
    """

def add_to_pixels(points: Annotated[NDArray[numpy.float64], dict(shape=(None, 3), order='C', device='cpu', writable=False)], distances: Annotated[NDArray[numpy.float64], dict(shape=(None,), order='C', device='cpu', writable=False)], signed_distances: Annotated[NDArray[numpy.float64], dict(shape=(None,), order='C', device='cpu', writable=False)], west: float, south: float, pixel: float, width: int, height: int, counts: Annotated[NDArray[numpy.int64], dict(shape=(None,), order='C', device='cpu')], limbs: Annotated[NDArray[numpy.uint32], dict(shape=(None, 8), order='C', device='cpu')], largest: Annotated[NDArray[numpy.float64], dict(shape=(None,), order='C', device='cpu')], signed_counts: Annotated[NDArray[numpy.int64], dict(shape=(None,), order='C', device='cpu')], signed_limbs: Annotated[NDArray[numpy.uint32], dict(shape=(None, 8), order='C', device='cpu')]) -> bool:
    """
    Add distances (N,), and signed ones (N,) where they are finite, to the pixels of a raster over x and y, in
    place: counts (P,), sums (P, 8) as in `add_exactly`, and largest distances (P,), row by row from the south.
    Returned is False if a distance is not finite or not below 2^96.
    """

def round_exactly(limbs: Annotated[NDArray[numpy.uint32], dict(shape=(None, 8), order='C', device='cpu', writable=False)], sums: Annotated[NDArray[numpy.float64], dict(shape=(None,), order='C', device='cpu')]) -> None:
    """
    Nearest doubles (G,), written in place, of fixed-point sums (G, 8) whose limbs are digits in two's
    complement.
    """

def weigh(moved: NDArray[numpy.float64], distances: NDArray[numpy.float64], closest: NDArray[numpy.float64], rows: NDArray[numpy.int64], normals: NDArray[numpy.float64], max_distance: float, robust: bool, kept_share: float, residuals: NDArray[numpy.float64], weights: NDArray[numpy.float64]) -> tuple[int, float]:
    """
    Residuals and weights (M,) of pairs, written in place. Returned are the number of pairs within the maximum
    correspondence distance and their sigma.
    """

def plane_system(moved: NDArray[numpy.float64], normals: NDArray[numpy.float64], rows: NDArray[numpy.int64], residuals: NDArray[numpy.float64], weights: NDArray[numpy.float64], hessian: NDArray[numpy.float64], gradient: NDArray[numpy.float64], center: NDArray[numpy.float64]) -> float:
    """
    Normal equations of one point-to-plane iteration, written in place. Returned is the RMS radius of the pairs.
    """

def normal_equations(positions: Annotated[NDArray[numpy.float64], dict(shape=(None, 3), order='C', device='cpu', writable=False)], normals: Annotated[NDArray[numpy.float64], dict(shape=(None, 3), order='C', device='cpu', writable=False)], weights: Annotated[NDArray[numpy.float64], dict(shape=(None,), order='C', device='cpu', writable=False)], residuals: Annotated[NDArray[numpy.float64], dict(shape=(None,), order='C', device='cpu', writable=False)], starts: Annotated[NDArray[numpy.int64], dict(shape=(None,), order='C', device='cpu', writable=False)], steps: Annotated[NDArray[numpy.int64], dict(shape=(83, 2), order='C', device='cpu', writable=False)], moments: Annotated[NDArray[numpy.float64], dict(shape=(None, 84, 6), order='C', device='cpu')], scores: Annotated[NDArray[numpy.float64], dict(shape=(None, 20, 3), order='C', device='cpu')]) -> None:
    """
    Add pairs to the sums of their groups, in place: moments (G, 84, 6) of w phi n n' and scores (G, 20, 3) of
    w phi n r. Each monomial phi but the first is an earlier one times a coordinate, as given by steps (83, 2).
    """

def equal_normal_equations(places: Annotated[NDArray[numpy.float64], dict(shape=(None, 3), order='C', device='cpu', writable=False)], normals: Annotated[NDArray[numpy.float64], dict(shape=(None, 3), order='C', device='cpu', writable=False)], rows: Annotated[NDArray[numpy.int64], dict(shape=(None,), order='C', device='cpu', writable=False)] | None, distances: Annotated[NDArray[numpy.float64], dict(shape=(None,), order='C', device='cpu', writable=False)], queries: Annotated[NDArray[numpy.int64], dict(shape=(None,), order='C', device='cpu', writable=False)], center: Annotated[NDArray[numpy.float64], dict(shape=(3), order='C', device='cpu', writable=False)], radius: float, group_size: int, steps: Annotated[NDArray[numpy.int64], dict(shape=(83, 2), order='C', device='cpu', writable=False)], moments: Annotated[NDArray[numpy.float64], dict(shape=(None, 84, 6), order='C', device='cpu')], scores: Annotated[NDArray[numpy.float64], dict(shape=(None, 20, 3), order='C', device='cpu')]) -> None:
    """
    Add some queries, in groups of a fixed size, to sums as in `normal_equations` with equal weights. Query i has
    the place and the normal of row i, or of rows[i]; places are taken relative to a centre, and places and
    distances in units of a radius.
    """

def whole_normal_equations(positions: Annotated[NDArray[numpy.float64], dict(shape=(None, 3), order='C', device='cpu', writable=False)], normals: Annotated[NDArray[numpy.float64], dict(shape=(None, 3), order='C', device='cpu', writable=False)], residuals: Annotated[NDArray[numpy.float64], dict(shape=(None,), order='C', device='cpu', writable=False)], steps: Annotated[NDArray[numpy.int64], dict(shape=(83, 2), order='C', device='cpu', writable=False)], moments: Annotated[NDArray[numpy.int64], dict(shape=(3, 84, 6), order='C', device='cpu')], scores: Annotated[NDArray[numpy.int64], dict(shape=(4, 20, 3), order='C', device='cpu')]) -> None:
    """
    The sums of normal_equations over pairs of weight 1 in whole numbers, added to moments (3, 84, 6) and scores
    (4, 20, 3): digits of base 2^20 in units of 2^-80, the lowest one first. Factors are rounded to 2^-40.
    """

class MeshIndex:
    """A box tree over triangles. The caller checks that vertices are finite."""

    def __init__(self, vertices: Annotated[NDArray[numpy.float64], dict(shape=(None, 3), order='C', device='cpu', writable=False)], faces: Annotated[NDArray[numpy.int64], dict(shape=(None, 3), order='C', device='cpu', writable=False)]) -> None: ...

    def __len__(self) -> int: ...

    def query(self, points: Annotated[NDArray[numpy.float64], dict(shape=(None, 3), order='C', device='cpu', writable=False)], distances: Annotated[NDArray[numpy.float64], dict(shape=(None,), order='C', device='cpu')], closest: Annotated[NDArray[numpy.float64], dict(shape=(None, 3), order='C', device='cpu')], faces: Annotated[NDArray[numpy.int64], dict(shape=(None,), order='C', device='cpu')], features: Annotated[NDArray[numpy.uint8], dict(shape=(None,), order='C', device='cpu')]) -> None:
        """
        Closest points on the mesh, written in place: distances (N,), closest (N, 3), faces (N,), and features (N,):
        0-2 for the corners of the face, 3-5 for its edges 01, 12, 20, 6 for its interior.
        """

    def cast(self, origins: Annotated[NDArray[numpy.float64], dict(shape=(None, 3), order='C', device='cpu', writable=False)], directions: Annotated[NDArray[numpy.float64], dict(shape=(None, 3), order='C', device='cpu', writable=False)], limit: float, distances: Annotated[NDArray[numpy.float64], dict(shape=(None,), order='C', device='cpu')], faces: Annotated[NDArray[numpy.int64], dict(shape=(None,), order='C', device='cpu')]) -> None:
        """
        First intersections of rays with the mesh, written in place: distances (N,) in lengths of the
        directions, infinity without an intersection before `limit`, and faces (N,), -1 without one.
        """

    def blocked(self, origins: Annotated[NDArray[numpy.float64], dict(shape=(None, 3), order='C', device='cpu', writable=False)], directions: Annotated[NDArray[numpy.float64], dict(shape=(None, 3), order='C', device='cpu', writable=False)], limit: float, blocked: Annotated[NDArray[numpy.bool_], dict(shape=(None,), order='C', device='cpu')]) -> None:
        """Whether rays intersect the mesh before `limit`, written in place (N,)."""
