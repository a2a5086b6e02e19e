"""Sums over the pairs in cells of a grid, from which everything else is computed."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from pcbench.deformation.polynomials import normal_equations
from pcbench.geometry.arrays import FloatArray, IntArray

_DYADIC = 5  # finer levels of moments: halves of cells, quarters, ...
LENGTHS = (0.08, 0.16, 0.32, 0.53, 0.8, 1.14, 1.6, 2.3)  # of the noise's kernels, in cells: 1/200 to 1/7 of the scene
_PARTNERS, _FEW_PARTNERS = 4, 1  # other pairs in its cell that a pair is compared with, and in a sub-cell


@dataclass(frozen=True, eq=False)
class TileSums:
    """Sums over the pairs in each cell (cubes of edge `side`); they add up over pairs.

    A pair has a weight w by which it counts in fits, and a size s of its noise. Noise is s times a stationary part,
    which is white or correlated as exp(-d^2 / 2 l^2) with each l of `LENGTHS` times the cells' edge.

    Attributes:
        center, radius: places are (x - center) / radius in all sums: about -1 to 1.
        side: of the cells, in the clouds' unit.
        cells: (C, 3) integer coordinates of the cells.
        moments: (C, 84, 6), see `polynomials.normal_equations`.
        white: the same of weights (w s)^2: what white noise adds to scores.
        loads: the same of weights w s: what noise adds that is the same in the whole cell.
        near: (C, J) sums over all two pairs in a cell of w s w' s' (n . n')^2 times each kernel of their distance.
        scores: (C, 20, 3) sums of w phi n r.
        energy: (C,) sums of w r^2.
        counts: (C,) pairs.
        dyadic: (levels, 1 + J), the same as `near` over sub-cells of each edge, for white noise and each kernel. The
            first row is that of single pairs.
        powers: (levels,) sums over sub-cells of |sum w n r'|^2 with r' the residual of the largest model.
        local: (C, 3) sums of v n r', r' clipped at three standard deviations: for whether something changed.
        apart: (C, 3) the same clipped about each cell's own median: for how far it is.
        spread: (C, 3, 3) sums of v n n'.
        surface: (84, 6) moments of all pairs by area: of the surface, however rough.
    """

    center: FloatArray
    radius: float
    side: float
    cells: IntArray
    moments: FloatArray
    white: FloatArray
    loads: FloatArray
    near: FloatArray
    scores: FloatArray
    energy: FloatArray
    counts: IntArray
    dyadic: FloatArray
    powers: FloatArray
    local: FloatArray
    apart: FloatArray
    spread: FloatArray
    surface: FloatArray

    def without(self, cells: NDArray[np.bool_]) -> TileSums:
        """The sums but those of some cells (C,). What is not kept by cells is that of all pairs together."""
        per_cell = (
            "cells",
            "moments",
            "white",
            "loads",
            "near",
            "scores",
            "energy",
            "counts",
            "local",
            "apart",
            "spread",
        )
        return replace(self, **{name: getattr(self, name)[~cells] for name in per_cell})

    @classmethod
    def of(
        cls,
        places: FloatArray,
        normals: FloatArray,
        residuals: FloatArray,
        weights: FloatArray,
        *,
        scales: FloatArray,
        left: FloatArray,
        apart: FloatArray,
        quality: FloatArray,
        areas: FloatArray,
        lower: FloatArray,
        side: float,
        center: FloatArray,
        radius: float,
    ) -> TileSums:
        """The sums of pairs.

        Args:
            places: (N, 3) where displacement is asked for.
            normals: (N, 3) unit normals.
            residuals: (N,) n . (p - q), or what a robust fit makes of them.
            weights: (N,) from 0 to 1.
            scales: (N,) sizes of the noise, about 1.
            left: (N,) residuals of the largest model, of the same pairs.
            apart: (N,) n . (p - q) less the largest model, as measured.
            quality: (N,) weights v, from 0 to 1, that do not depend on the residuals.
            areas: (N,) of surface that the pairs stand for, in any unit.
            lower: (3,) the corner that cells are counted from.
            side: of the cells.
            center, radius: of the scene; (3,) and about half its extent.
        """
        cells = np.floor((places - lower) / side).astype(np.int64)
        order, starts = groups(cells)
        x, n, r, w, s = (v[order] for v in ((places - center) / radius, normals, residuals, weights, scales))
        moments, scores = normal_equations(x, n, w, r, starts)
        white, _ = normal_equations(x, n, np.square(w * s), r, starts)
        loads, _ = normal_equations(x, n, w * s, r, starts)
        surface, _ = normal_equations(x, n, areas[order], r)
        lengths = side * np.array(LENGTHS)
        v, measured = quality[order], apart[order]
        sigma = 1.4826 * float(np.median(np.abs(measured[v >= np.median(v)])))
        changed = (v * np.clip(measured, -3 * sigma, 3 * sigma))[:, None] * n
        far = (v * _clipped_within(measured, starts, sigma))[:, None] * n
        expected, powers = dyadic_moments(places, normals, left, weights, scales, lower, side)
        return cls(
            center=center,
            radius=radius,
            side=side,
            cells=cells[order[starts]],
            moments=moments,
            white=white,
            loads=loads,
            near=np.add.reduceat(kernel_sums(places[order], n, w * s, starts, lengths), starts),
            scores=scores,
            energy=np.add.reduceat(w * r * r, starts),
            counts=np.diff([*starts, len(order)]),
            dyadic=expected,
            powers=powers,
            local=np.add.reduceat(changed, starts),
            apart=np.add.reduceat(far, starts),
            spread=np.add.reduceat(v[:, None, None] * n[:, :, None] * n[:, None, :], starts),
            surface=surface[0],
        )


def kernel_sums(
    places: FloatArray,
    normals: FloatArray,
    loads: FloatArray,
    starts: IntArray,
    lengths: FloatArray,
    partners: int = _PARTNERS,
) -> FloatArray:
    """(N, J) for each pair, the sum over all pairs in its group of load load' (n . n')^2 times each kernel of their
    distance: exact for itself, and for the others from a few that stand for all.

    Args:
        places, normals: (N, 3), in groups that begin at `starts` (G,).
        loads: (N,) what the pairs count.
        lengths: (J,) of the kernels.
        partners: how many stand for all.
    """
    counts = np.diff([*starts, len(places)])
    size, first = np.repeat(counts, counts), np.repeat(starts, counts)
    mine = np.arange(len(places)) - first
    sums: FloatArray = np.repeat(np.square(loads)[:, None], len(lengths), axis=1)
    others = np.maximum(size - 1, 1)
    partners = min(partners, int(counts.max()) - 1)
    for number in range(partners):
        # Spread evenly over the group, whatever order it is in: multiples of the golden ratio.
        step = 1 + ((number + 0.5) * 0.6180339887 % 1 * others).astype(np.int64)
        partner = first + (mine + step) % size
        counted = loads * loads[partner] * np.square(np.einsum("ni,ni->n", normals, normals[partner]))
        counted *= (size - 1) / partners
        squared = np.square(places - places[partner]).sum(axis=1)
        sums += counted[:, None] * np.exp(-0.5 * squared[:, None] / np.square(lengths))
    return sums


def dyadic_moments(
    places: FloatArray,
    normals: FloatArray,
    left: FloatArray,
    weights: FloatArray,
    scales: FloatArray,
    lower: FloatArray,
    side: float,
) -> tuple[FloatArray, FloatArray]:
    """Over sub-cells of each edge, what noise of unit size adds to the sum of |sum w n r|^2, (levels, 1 + J), and that
    sum, (levels,); see `TileSums`.
    """
    lengths = side * np.array(LENGTHS)
    loads = weights * scales
    single = float(np.square(loads).sum())
    expected, powers = [np.full(1 + len(lengths), single)], [float(np.square(weights * left).sum())]
    for level in range(_DYADIC, 0, -1):
        order, starts = groups(np.floor((places - lower) / (side / 2**level)).astype(np.int64))
        vectors = np.add.reduceat((weights * left)[order, None] * normals[order], starts)
        powers.append(float(np.square(vectors).sum()))
        sums = kernel_sums(places[order], normals[order], loads[order], starts, lengths, _FEW_PARTNERS).sum(axis=0)
        expected.append(np.concatenate([[single], sums]))
    return np.array(expected), np.array(powers)


def _clipped_within(values: FloatArray, starts: IntArray, sigma: float) -> FloatArray:
    """(N,) values clipped about the median of their group, at three of its standard deviations, by its median too."""
    counts = np.diff([*starts, len(values)])
    group = np.repeat(np.arange(len(starts)), counts)

    def medians(of: FloatArray) -> FloatArray:
        ordered = of[np.lexsort((of, group))]
        middle: FloatArray = 0.5 * (ordered[starts + (counts - 1) // 2] + ordered[starts + counts // 2])
        return middle[group]

    middle = medians(values)
    reach = 3 * np.maximum(sigma, 1.4826 * medians(np.abs(values - middle)))
    return np.clip(values, middle - reach, middle + reach)


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
