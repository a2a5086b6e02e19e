"""Sums over the pairs in cells of a grid, from which everything else is computed."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from pcbench.deformation.polynomials import normal_equations
from pcbench.geometry.arrays import FloatArray, IntArray
from pcbench.geometry.order_statistics import NORMAL_MAD, robust_sigma

_DYADIC_LEVELS = 5  # levels of sub-cells for moments: halves of cells, quarters, ...
KERNEL_LENGTHS = (0.08, 0.16, 0.32, 0.53, 0.8, 1.14, 1.6, 2.3)  # kernel lengths in cells: 1/200 to 1/7 of the scene
_CELL_PARTNERS, _SUBCELL_PARTNERS = 4, 1  # sampled partners of each pair, in cells and in sub-cells


@dataclass(frozen=True, eq=False)
class TileSums:
    """Sums over the pairs in each cell (cubes of edge `side`), additive over pairs.

    A pair has a weight w in fits and a relative scale s of its noise. Noise is s times a stationary process, which is
    white or correlated as exp(-d^2 / 2 l^2), with each l of `KERNEL_LENGTHS` times the cells' edge.

    Attributes:
        center, radius: positions are scaled as (x - center) / radius in all sums, to about -1 to 1.
        side: edge of the cells, in the clouds' unit.
        cells: (C, 3) integer coordinates of the cells.
        moments: (C, 84, 6), see `polynomials.normal_equations`.
        white: moments with weights (w s)^2: the covariance of the scores under white noise.
        loads: moments with weights w s: the response of the scores to noise that is constant in the cell.
        near: (C, J) sums over all pairs of pairs in a cell of w s w' s' (n . n')^2 times each kernel of their distance.
        scores: (C, 20, 3) sums of w phi n r.
        energy: (C,) sums of w r^2.
        counts: (C,) number of pairs.
        dyadic: (levels, 1 + J), expectations as in `near`, over sub-cells of each size, for white noise and each
            kernel. The first row is for single pairs.
        powers: (levels,) sums over sub-cells of |sum w n r'|^2 with r' the residual from the largest model.
        local: (C, 3) sums of v n r', with r' clamped at three standard deviations: for tests of local change.
        local_sizes: (C, 3) the same, clamped about the median of each cell: for the size of local changes.
        spread: (C, 3, 3) sums of v n n'.
        surface: (84, 6) moments of all pairs weighted by area, including rough surface.
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
    local_sizes: FloatArray
    spread: FloatArray
    surface: FloatArray

    def without(self, cells: NDArray[np.bool_]) -> TileSums:
        """Return the sums without some cells (C,); values that are not per cell remain those of all pairs."""
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
            "local_sizes",
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
        remainders: FloatArray,
        raw_remainders: FloatArray,
        quality: FloatArray,
        areas: FloatArray,
        lower: FloatArray,
        side: float,
        center: FloatArray,
        radius: float,
    ) -> TileSums:
        """Sum pairs over cells.

        Args:
            places: (N, 3) positions.
            normals: (N, 3) unit normals.
            residuals: (N,) n . (p - q), or pseudo-values of a robust fit.
            weights: (N,) from 0 to 1.
            scales: (N,) relative scale of the noise, about 1.
            remainders: (N,) residuals from the largest model, of the same pairs.
            raw_remainders: (N,) residuals n . (p - q) from the largest model, as measured.
            quality: (N,) weights v, from 0 to 1, that do not depend on the residuals.
            areas: (N,) surface area that each pair represents, in any unit.
            lower: (3,) the corner that cells are counted from.
            side: edge of the cells.
            center: (3,) centre of the scene.
            radius: slightly more than half the extent of the scene.
        """
        cells = np.floor((places - lower) / side).astype(np.int64)
        order, starts = group_rows(cells)
        x, n, r, w, s = (v[order] for v in ((places - center) / radius, normals, residuals, weights, scales))
        moments, scores = normal_equations(x, n, w, r, starts)
        white, _ = normal_equations(x, n, np.square(w * s), r, starts)
        loads, _ = normal_equations(x, n, w * s, r, starts)
        surface, _ = normal_equations(x, n, areas[order], r)
        lengths = side * np.array(KERNEL_LENGTHS)
        v, measured = quality[order], raw_remainders[order]
        sigma = robust_sigma(measured[v >= np.median(v)])
        changed = (v * np.clip(measured, -3 * sigma, 3 * sigma))[:, None] * n
        far = (v * _clipped_within(measured, starts, sigma))[:, None] * n
        expected, powers = dyadic_moments(places, normals, remainders, weights, scales, lower, side)
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
            local_sizes=np.add.reduceat(far, starts),
            spread=np.add.reduceat(v[:, None, None] * n[:, :, None] * n[:, None, :], starts),
            surface=surface[0],
        )


def kernel_sums(
    places: FloatArray,
    normals: FloatArray,
    loads: FloatArray,
    starts: IntArray,
    lengths: FloatArray,
    partners: int = _CELL_PARTNERS,
) -> FloatArray:
    """Sum load load' (n . n')^2 times each kernel of the distance, for each pair over all pairs in its group; (N, J).

    The term of the pair itself is exact; the sum over the others is estimated from a few sampled partners.

    Args:
        places: (N, 3) positions, sorted by group.
        normals: (N, 3) unit normals.
        loads: (N,) factor of each pair.
        starts: (G,) first row of each group.
        lengths: (J,) kernel lengths.
        partners: number of sampled partners.
    """
    counts = np.diff([*starts, len(places)])
    size, first = np.repeat(counts, counts), np.repeat(starts, counts)
    mine = np.arange(len(places)) - first
    sums: FloatArray = np.repeat(np.square(loads)[:, None], len(lengths), axis=1)
    terms = np.empty_like(sums)
    others = np.maximum(size - 1, 1)
    partners = min(partners, int(counts.max()) - 1)
    for number in range(partners):
        # Multiples of the golden ratio spread the partners evenly over the group, in any order.
        step = 1 + ((number + 0.5) * 0.6180339887 % 1 * others).astype(np.int64)
        partner = first + (mine + step) % size
        counted = loads * loads[partner] * np.square(np.einsum("ni,ni->n", normals, normals[partner]))
        counted *= (size - 1) / partners
        squared = np.square(places - places[partner]).sum(axis=1)
        np.divide(-0.5 * squared[:, None], np.square(lengths), out=terms)
        np.exp(terms, out=terms)
        terms *= counted[:, None]
        sums += terms
    return sums


def dyadic_moments(
    places: FloatArray,
    normals: FloatArray,
    remainders: FloatArray,
    weights: FloatArray,
    scales: FloatArray,
    lower: FloatArray,
    side: float,
) -> tuple[FloatArray, FloatArray]:
    """Moments over sub-cells of each size: expectations for unit noise (levels, 1 + J), and measured values (levels,).

    The moment is the sum of |sum w n r|^2 over sub-cells; see `TileSums`.
    """
    lengths = side * np.array(KERNEL_LENGTHS)
    loads = weights * scales
    single = float(np.square(loads).sum())
    expected, powers = [np.full(1 + len(lengths), single)], [float(np.square(weights * remainders).sum())]
    for level in range(_DYADIC_LEVELS, 0, -1):
        order, starts = group_rows(np.floor((places - lower) / (side / 2**level)).astype(np.int64))
        vectors = np.add.reduceat((weights * remainders)[order, None] * normals[order], starts)
        powers.append(float(np.square(vectors).sum()))
        sums = kernel_sums(places[order], normals[order], loads[order], starts, lengths, _SUBCELL_PARTNERS).sum(axis=0)
        expected.append(np.concatenate([[single], sums]))
    return np.array(expected), np.array(powers)


def _clipped_within(values: FloatArray, starts: IntArray, sigma: float) -> FloatArray:
    """Clamp values (N,) about the median of their group, at three robust standard deviations of the group."""
    counts = np.diff([*starts, len(values)])
    group = np.repeat(np.arange(len(starts)), counts)

    def medians(samples: FloatArray) -> FloatArray:
        ordered = samples[np.lexsort((samples, group))]
        middle: FloatArray = 0.5 * (ordered[starts + (counts - 1) // 2] + ordered[starts + counts // 2])
        return middle[group]

    middle = medians(values)
    reach = 3 * np.maximum(sigma, NORMAL_MAD * medians(np.abs(values - middle)))
    return np.clip(values, middle - reach, middle + reach)


def group_rows(cells: IntArray) -> tuple[IntArray, IntArray]:
    """Return an order (N,) that sorts equal rows together, and the start of each group."""
    order = np.lexsort(cells.T[::-1])
    changed = (np.diff(cells[order], axis=0) != 0).any(axis=1)
    return order, np.flatnonzero(np.concatenate([[True], changed]))


def tile_of_cells(cells: IntArray, factor: int) -> IntArray:
    """Return (C,) the index of the tile of `factor` cells along each axis that contains each cell."""
    _, tile = np.unique(cells // factor, axis=0, return_inverse=True)
    return np.asarray(tile, dtype=np.int64).ravel()


def sum_over_tiles(values: FloatArray, tile: IntArray) -> FloatArray:
    """Sum rows (C, ...) over tiles; return (T, ...)."""
    order = np.argsort(tile, kind="stable")
    starts = np.flatnonzero(np.diff(tile[order], prepend=-1))
    sums: FloatArray = np.add.reduceat(values[order], starts, axis=0)
    return sums
