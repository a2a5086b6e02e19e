"""Sums over the pairs in cells of a grid, from which everything else is computed."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from pcbench.deformation.polynomials import normal_equations
from pcbench.geometry.arrays import FloatArray, IntArray
from pcbench.geometry.voxels import cells

_DYADIC = 5  # finer levels of moments: halves of cells, quarters, ...


@dataclass(frozen=True, eq=False)
class TileSums:
    """Sums over the pairs in each cell (cubes of edge `side`); they add up over pairs.

    Attributes:
        center, radius: places are (x - center) / radius in all sums: about -1 to 1.
        side: of the cells, in the clouds' unit.
        cells: (C, 3) integer coordinates of the cells.
        moments: (C, 84, 6), see `polynomials.normal_equations`.
        scores: (C, 20, 3) sums of w phi n r.
        energy: (C,) sums of w r^2.
        counts: (C,) pairs.
        dyadic: (levels, 3) over sub-cells of each edge: the edge, the sum over sub-cells of |sum w n r'|^2 with r' the
            residual of the largest model, and of tr (sum w n n')^2. The first row is that of single pairs.
        local: (C, 3) sums of v n r', r' clipped at three standard deviations: what changed is no outlier.
        spread: (C, 3, 3) sums of v n n'.
    """

    center: FloatArray
    radius: float
    side: float
    cells: IntArray
    moments: FloatArray
    scores: FloatArray
    energy: FloatArray
    counts: IntArray
    dyadic: FloatArray
    local: FloatArray
    spread: FloatArray

    def without(self, cells: NDArray[np.bool_]) -> TileSums:
        """The sums but those of some cells (C,). `dyadic` is kept whole: it is known for all pairs together."""
        per_cell = ("cells", "moments", "scores", "energy", "counts", "local", "spread")
        return replace(self, **{name: getattr(self, name)[~cells] for name in per_cell})

    @classmethod
    def of(
        cls,
        places: FloatArray,
        normals: FloatArray,
        residuals: FloatArray,
        weights: FloatArray,
        *,
        left: FloatArray,
        quality: FloatArray,
        lower: FloatArray,
        side: float,
        center: FloatArray,
        radius: float,
    ) -> TileSums:
        """The sums of pairs.

        Args:
            places: (N, 3) where displacement is asked for.
            normals: (N, 3) unit normals.
            residuals: (N,) n . (p - q).
            weights: (N,) from 0 to 1.
            left: (N,) residuals of the largest model, of the same pairs.
            quality: (N,) weights v, from 0 to 1, that do not depend on the residuals.
            lower: (3,) the corner that cells are counted from.
            side: of the cells.
            center, radius: of the scene; (3,) and about half its extent.
        """
        cells = np.floor((places - lower) / side).astype(np.int64)
        order, starts = groups(cells)
        x, n, r, w = (values[order] for values in ((places - center) / radius, normals, residuals, weights))
        clipped, v = left[order], quality[order, None]
        sure = clipped[v[:, 0] >= np.median(v)]
        sigma = 1.4826 * float(np.median(np.abs(sure)))
        clipped = np.clip(clipped, -3 * sigma, 3 * sigma)
        moments, scores = normal_equations(x, n, w, r, starts)
        return cls(
            center=center,
            radius=radius,
            side=side,
            cells=cells[order[starts]],
            moments=moments,
            scores=scores,
            energy=np.add.reduceat(w * r * r, starts),
            counts=np.diff([*starts, len(order)]),
            dyadic=dyadic_moments(places, normals, left, weights, lower, side),
            local=np.add.reduceat(v * n * clipped[:, None], starts),
            spread=np.add.reduceat(v[:, :, None] * n[:, :, None] * n[:, None, :], starts),
        )


def dyadic_moments(
    places: FloatArray, normals: FloatArray, left: FloatArray, weights: FloatArray, lower: FloatArray, side: float
) -> FloatArray:
    """(levels, 3): edge, sum of |sum w n r|^2, sum of tr (sum w n n')^2 over sub-cells of each edge; see `TileSums`."""
    rows = [[0.0, float(np.square(weights * left).sum()), float(np.square(weights).sum())]]
    for level in range(_DYADIC, 0, -1):
        edge = side / 2**level
        cell = cells(places, edge, lower).of_point
        power = sum(float(np.square(np.bincount(cell, weights * left * normals[:, i])).sum()) for i in range(3))
        information = sum(
            (1 if i == j else 2) * float(np.square(np.bincount(cell, weights * normals[:, i] * normals[:, j])).sum())
            for i in range(3)
            for j in range(i, 3)
        )
        rows.append([edge, power, information])
    return np.array(rows)


def groups(cells: IntArray) -> tuple[IntArray, IntArray]:
    """An order (N,) that brings equal rows together, and where each of the groups starts."""
    order = np.lexsort(cells.T[::-1])
    changed = (np.diff(cells[order], axis=0) != 0).any(axis=1)
    return order, np.flatnonzero(np.concatenate([[True], changed]))


def merged(cells: IntArray, factor: int) -> IntArray:
    """(C,) the tile of `factor` cells along each axis that every cell lies in."""
    _, tile = np.unique(cells // factor, axis=0, return_inverse=True)
    return np.asarray(tile, dtype=np.int64).ravel()


def added(values: FloatArray, tile: IntArray) -> FloatArray:
    """Sums of rows (C, ...) over tiles: (T, ...)."""
    order = np.argsort(tile, kind="stable")
    starts = np.flatnonzero(np.diff(tile[order], prepend=-1))
    sums: FloatArray = np.add.reduceat(values[order], starts, axis=0)
    return sums
