"""
Compiled kernels of pcbench; call them through the modules that own them.
"""

from typing import Annotated

import numpy
from numpy.typing import NDArray


def isa() -> str:
    """The instruction set in use: baseline, avx2 or avx512."""

class PointIndex:
    """A tree over points; results are written into the arrays given."""

    def __init__(self, points: Annotated[NDArray[numpy.float64], dict(shape=(None, 3), order='C', device='cpu', writable=False)]) -> None: ...

    @property
    def bytes(self) -> int:
        """Memory held beyond the points."""

    def nearest(self, queries: Annotated[NDArray[numpy.float64], dict(shape=(None, 3), order='C', device='cpu', writable=False)], distances: Annotated[NDArray[numpy.float64], dict(shape=(None,), order='C', device='cpu')], indices: Annotated[NDArray[numpy.int64], dict(shape=(None,), order='C', device='cpu')]) -> None: ...

    def nearest_of(self, queries: PointIndex, distances: Annotated[NDArray[numpy.float64], dict(shape=(None,), order='C', device='cpu')], indices: Annotated[NDArray[numpy.int64], dict(shape=(None,), order='C', device='cpu')], slack: float = 0.0, tied: Annotated[NDArray[numpy.bool_], dict(shape=(None,), order='C', device='cpu')] | None = None) -> None:
        """
        Queries are another index's points, or its own: then no point is its own neighbour. tied: whether another point than the match has a squared distance below the match's plus slack.
        """

    def nearest_of_moved(self, queries: PointIndex, motion: Annotated[NDArray[numpy.float64], dict(shape=(3, 4), order='C', device='cpu', writable=False)], hints: Annotated[NDArray[numpy.int64], dict(shape=(None,), order='C', device='cpu', writable=False)] | None, moved: Annotated[NDArray[numpy.float64], dict(shape=(None, 3), order='C', device='cpu')], distances: Annotated[NDArray[numpy.float64], dict(shape=(None,), order='C', device='cpu')], indices: Annotated[NDArray[numpy.int64], dict(shape=(None,), order='C', device='cpu')]) -> None:
        """Queries are another index's points after a motion (3, 4)."""

    def knearest(self, queries: Annotated[NDArray[numpy.float64], dict(shape=(None, 3), order='C', device='cpu', writable=False)], distances: Annotated[NDArray[numpy.float64], dict(shape=(None, None), order='C', device='cpu')], indices: Annotated[NDArray[numpy.int64], dict(shape=(None, None), order='C', device='cpu')]) -> None: ...

    def planes(self, k: int, rows: Annotated[NDArray[numpy.int64], dict(shape=(None,), order='C', device='cpu', writable=False)] | None, normals: Annotated[NDArray[numpy.float64], dict(shape=(None, 3), order='C', device='cpu')], variation: Annotated[NDArray[numpy.float64], dict(shape=(None,), order='C', device='cpu')], distances: Annotated[NDArray[numpy.float64], dict(shape=(None,), order='C', device='cpu')], indices: Annotated[NDArray[numpy.int64], dict(shape=(None,), order='C', device='cpu')]) -> None:
        """
        Planes through the k nearest points of each point, or of those in rows, itself included, with normals that look up, and its nearest other point.
        """

    def in_balls(self, centres: NDArray[numpy.float64], radius: float) -> tuple[NDArray[numpy.int64], NDArray[numpy.int64]]:
        """Offsets (N + 1,) and the rows found, ascending for each ball."""

    def in_cylinders(self, origins: NDArray[numpy.float64], axes: NDArray[numpy.float64], radius: float, half_length: float) -> tuple[NDArray[numpy.int64], NDArray[numpy.int64]]:
        """Offsets (N + 1,) and the rows found, ascending for each cylinder."""

def group_by_cell(points: NDArray[numpy.float64], side: float, lower: NDArray[numpy.float64], cells: NDArray[numpy.int64]) -> tuple[NDArray[numpy.int64], NDArray[numpy.int64]]:
    """
    Number the occupied cubic cells in the order of their first points: cells (N,) are written in place; the
    rows of their first points (M,) and their numbers of points (M,) are returned.
    """

def plane_fits(points: Annotated[NDArray[numpy.float64], dict(shape=(None, 3), order='C', device='cpu', writable=False)], neighbors: Annotated[NDArray[numpy.int64], dict(shape=(None, None), order='C', device='cpu', writable=False)], normals: Annotated[NDArray[numpy.float64], dict(shape=(None, 3), order='C', device='cpu')], variation: Annotated[NDArray[numpy.float64], dict(shape=(None,), order='C', device='cpu')]) -> None:
    """
    Fit a plane to each row of neighbours: unit normals (M, 3) and surface variation (M,) are written in place.
    """

def plane_distances(queries: Annotated[NDArray[numpy.float64], dict(shape=(None, 3), order='C', device='cpu', writable=False)], query_rows: Annotated[NDArray[numpy.int64], dict(shape=(None,), order='C', device='cpu', writable=False)] | None, closest: Annotated[NDArray[numpy.float64], dict(shape=(None, 3), order='C', device='cpu', writable=False)], closest_rows: Annotated[NDArray[numpy.int64], dict(shape=(None,), order='C', device='cpu', writable=False)] | None, normals: Annotated[NDArray[numpy.float64], dict(shape=(None, 3), order='C', device='cpu', writable=False)], normal_rows: Annotated[NDArray[numpy.int64], dict(shape=(None,), order='C', device='cpu', writable=False)] | None, distances: Annotated[NDArray[numpy.float64], dict(shape=(None,), order='C', device='cpu')]) -> None:
    """
    Signed distances (M,) along normals, written in place; each array is taken in order or by its rows.
    """

def rounded_squares(queries: Annotated[NDArray[numpy.float64], dict(shape=(None, 3), order='C', device='cpu', writable=False)], closest: Annotated[NDArray[numpy.float64], dict(shape=(None, 3), order='C', device='cpu', writable=False)], closest_rows: Annotated[NDArray[numpy.int64], dict(shape=(None,), order='C', device='cpu', writable=False)], squares: Annotated[NDArray[numpy.float64], dict(shape=(None,), order='C', device='cpu')]) -> None:
    """
    Squared distances (M,), written in place, from differences that were rounded to float32.
    """

def weigh(moved: NDArray[numpy.float64], distances: NDArray[numpy.float64], closest: NDArray[numpy.float64], rows: NDArray[numpy.int64], normals: NDArray[numpy.float64], max_distance: float, robust: bool, kept: float, residuals: NDArray[numpy.float64], weights: NDArray[numpy.float64]) -> tuple[int, float]:
    """
    Residuals and weights (M,) of pairs, written in place; the number of pairs within the maximum correspondence
    distance and their sigma.
    """

def plane_system(moved: NDArray[numpy.float64], normals: NDArray[numpy.float64], rows: NDArray[numpy.int64], residuals: NDArray[numpy.float64], weights: NDArray[numpy.float64], hessian: NDArray[numpy.float64], gradient: NDArray[numpy.float64], center: NDArray[numpy.float64]) -> float:
    """
    Normal equations of one point-to-plane step, written in place; returns the pairs' RMS radius.
    """

def normal_equations(places: Annotated[NDArray[numpy.float64], dict(shape=(None, 3), order='C', device='cpu', writable=False)], normals: Annotated[NDArray[numpy.float64], dict(shape=(None, 3), order='C', device='cpu', writable=False)], weights: Annotated[NDArray[numpy.float64], dict(shape=(None,), order='C', device='cpu', writable=False)], residuals: Annotated[NDArray[numpy.float64], dict(shape=(None,), order='C', device='cpu', writable=False)], starts: Annotated[NDArray[numpy.int64], dict(shape=(None,), order='C', device='cpu', writable=False)], steps: Annotated[NDArray[numpy.int64], dict(shape=(83, 2), order='C', device='cpu', writable=False)], moments: Annotated[NDArray[numpy.float64], dict(shape=(None, 84, 6), order='C', device='cpu')], scores: Annotated[NDArray[numpy.float64], dict(shape=(None, 20, 3), order='C', device='cpu')]) -> None:
    """
    Sums over groups of pairs, written in place: moments (G, 84, 6) of w phi n n' and scores (G, 20, 3) of
    w phi n r, for the monomials that the steps (83, 2) build: an earlier one and the coordinate it is multiplied by.
    """

class MeshIndex:
    """
    A box tree over triangles; the caller has checked that vertices are finite.
    """

    def __init__(self, vertices: Annotated[NDArray[numpy.float64], dict(shape=(None, 3), order='C', device='cpu', writable=False)], faces: Annotated[NDArray[numpy.int64], dict(shape=(None, 3), order='C', device='cpu', writable=False)]) -> None: ...

    def __len__(self) -> int: ...

    def query(self, points: Annotated[NDArray[numpy.float64], dict(shape=(None, 3), order='C', device='cpu', writable=False)], distances: Annotated[NDArray[numpy.float64], dict(shape=(None,), order='C', device='cpu')], closest: Annotated[NDArray[numpy.float64], dict(shape=(None, 3), order='C', device='cpu')], faces: Annotated[NDArray[numpy.int64], dict(shape=(None,), order='C', device='cpu')], features: Annotated[NDArray[numpy.uint8], dict(shape=(None,), order='C', device='cpu')]) -> None:
        """
        Nearest points of the mesh, written in place: distances (N,), closest (N, 3), faces (N,), and features (N,):
        0-2 the face's corners, 3-5 its edges 01, 12, 20, 6 its inside.
        """

    def cast(self, origins: Annotated[NDArray[numpy.float64], dict(shape=(None, 3), order='C', device='cpu', writable=False)], directions: Annotated[NDArray[numpy.float64], dict(shape=(None, 3), order='C', device='cpu', writable=False)], limit: float, distances: Annotated[NDArray[numpy.float64], dict(shape=(None,), order='C', device='cpu')], faces: Annotated[NDArray[numpy.int64], dict(shape=(None,), order='C', device='cpu')]) -> None:
        """
        Where rays first meet the mesh, written in place: distances (N,) in units of the directions' lengths,
        infinity where there is nothing below `limit`, and faces (N,), -1 there.
        """

    def blocked(self, origins: Annotated[NDArray[numpy.float64], dict(shape=(None, 3), order='C', device='cpu', writable=False)], directions: Annotated[NDArray[numpy.float64], dict(shape=(None, 3), order='C', device='cpu', writable=False)], limit: float, blocked: Annotated[NDArray[numpy.bool_], dict(shape=(None,), order='C', device='cpu')]) -> None:
        """Whether rays meet the mesh before `limit`, written in place (N,)."""
