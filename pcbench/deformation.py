"""Is one cloud bent against the other, how much, and where? From sums over tiles to a verdict.

Pairs of a candidate point p and the reference's tangent plane (q, n) leave residuals r = n . (p - q), linear in the
coefficients of a polynomial displacement field u of the candidate: r = n . u(x) + noise. Five models are nested:
rigid (6 parameters), similarity (7), affine (12), quadratic (30) and cubic (60) fields. The question is whether what
the larger ones explain is more than noise would have explained. Counting points answers it wrongly: the noise of
reconstructions is correlated over metres, and a million points then hold a few hundred independent facts. So

1. the noise's covariance is estimated from the residuals of the largest model (so that no bend is taken for noise):
   white noise plus a non-negative mixture of Gaussian kernels of fixed lengths (every covariance that is valid in all
   dimensions and isotropic is one, Schoenberg 1938), by matching moments. The expected moments are exact: what
   fitting the model took from the residuals is put back, as in REML (Patterson & Thompson 1971);
2. the statistic of each rung is what it explains beyond a smaller one, in least squares; its null distribution is a
   sum of chi squares whose weights are the eigenvalues of the scores' covariance under that noise;
3. the same statistic is tested by a wild bootstrap over tiles (Cameron, Gelbach & Miller 2008) with three sizes of
   tiles, which assumes nothing about the noise within tiles and independence between them;
4. where both say so it is a verdict; where they contradict each other, or are short of being sure, it is "undecided".

Everything is computed from `TileSums`, which add up: tiles may come from anywhere. Lengths are in the clouds' unit.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import pairwise
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from pcbench.neighbors import FloatArray, IntArray
from pcbench.polynomials import (
    EXPONENTS,
    MODELS,
    PARAMETERS,
    derivative_squares,
    gram,
    mean_and_spread,
    model_columns,
    monomials,
    normal_equations,
    normal_matrix,
    translation_columns,
)
from pcbench.voxels import cells

CELLS_ALONG = 16  # of the scene's extent: the finest tiles
_FACTORS = (1, 2, 3)  # sizes of tiles, in cells
_TILE = 1  # the one of them that is reported
FEWEST_TILES = 40
_REPLICATES = 999
_FOLDS = 10
_SEEN = 0.02  # information of a field against a field seen along its direction everywhere: below is noise of normals
_HARDLY_SEEN = 1e-4
_HELD = 0.01  # half of a field that has so little information is followed while pairs are found
_RIDGE = 1e-12
_PLACE_NOISE = 100 / _SEEN  # a coordinate has to vary by ten standard deviations of the noise
_LENGTHS = (0.08, 0.16, 0.32, 0.53, 0.8, 1.14, 1.6, 2.3)  # of the noise's kernels, in cells: 1/200 to 1/7 of the scene
_LAGS = (-1.0, 0.0, 1.3, 2.1, 3.3, 5.0)  # distances of cells, in cells, between which moments are taken
_DYADIC = 5  # finer levels of moments: halves of cells, quarters, ...
# The covariance is estimated: where it is a third too small, 1e-5 is 1e-3 in truth.
_SURE_NOISE, _SURE_TILES = 1e-5, 5e-3
_DOUBT = 1e-3  # of either test alone
_SMALL = 0.1  # of the noise: a bend that is surely less is not worth a doubt
_FDR = 0.05
_LEAST_TESTED, _SMOOTH_TESTED = 3.0, 0.1  # weight of smooth surface in a cell and a pair: bushes change by themselves


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
        """The sums but those of some cells (C,)."""
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
        order, starts = _groups(cells)
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


class Displacement(NamedTuple):
    """A cubic displacement field (N, 3) at places (N, 3), held constant beyond `radius` from the centre."""

    coefficients: FloatArray  # (20, 3)
    center: FloatArray
    radius: float

    @classmethod
    def nothing(cls, center: FloatArray, radius: float) -> Displacement:
        return cls(np.zeros((len(EXPONENTS), 3)), center, radius)

    def __call__(self, places: FloatArray) -> FloatArray:
        field: FloatArray = np.einsum("an,ak->nk", monomials(self._inside(places)), self.coefficients)
        return field

    def fitted(
        self, places: FloatArray, normals: FloatArray, residuals: FloatArray, weights: FloatArray
    ) -> Displacement:
        """The field that explains (N,) residuals along normals, by weighted least squares.

        What the pairs hardly show is left out, by information against the field's size at all places, whatever they
        weigh: a field that is free where a forest weighs nothing finds pairs there that bear it out.
        """
        x = self._inside(places)
        moments, scores = (sums[0] for sums in normal_equations(x, normals, weights, residuals))
        values = monomials(x)
        squares = np.einsum("an,bn->ab", values, values, optimize=False) / len(x)
        to_orthonormal = np.linalg.inv(np.linalg.cholesky(squares + _RIDGE * np.eye(len(squares))))
        basis = np.kron(to_orthonormal, np.eye(3))
        information, fields = np.linalg.eigh(basis @ normal_matrix(moments) @ basis.T / weights.sum())
        along = fields.T @ (basis @ scores.ravel()) / weights.sum()
        found = fields @ (information / (np.square(information) + _HELD**2) * along)
        return self._replace(coefficients=(basis.T @ found).reshape(-1, 3))

    def _inside(self, places: FloatArray) -> FloatArray:
        inside: FloatArray = np.clip((places - self.center) / self.radius, -1, 1)
        return inside


def share_of(
    places: FloatArray, normals: FloatArray, residuals: FloatArray, weights: FloatArray, bend: FloatArray, gauge: str
) -> tuple[float, float]:
    """How much of a known bend (N,) along the normals is in the residuals beyond a motion of the gauge, and the bend's
    RMS beyond it.
    """
    x = places - np.average(places, axis=0, weights=weights)
    columns = [*normals.T, *np.cross(x, normals).T]
    if gauge == "similarity":
        columns.append(np.einsum("ni,ni->n", x, normals))
    matrix = np.stack(columns, axis=1) * np.sqrt(weights)[:, None]
    known, seen = bend * np.sqrt(weights), residuals * np.sqrt(weights)
    known = known - matrix @ np.linalg.lstsq(matrix, known, rcond=1e-6)[0]
    power = float(known @ known)
    return float(known @ seen) / max(power, 1e-300), math.sqrt(power / float(weights.sum()))


class Noise(NamedTuple):
    """Variances of the residuals: white, and of each kernel's component (lengths in the clouds' unit)."""

    white: float
    components: FloatArray  # (J,)
    lengths: FloatArray  # (J,)

    @property
    def correlated(self) -> float:
        return float(self.components.sum())

    @property
    def correlation_length(self) -> float:
        """The Gaussian kernel exp(-d^2 / 2 l^2) that covers the same area as the mixture: 2 pi l^2."""
        if self.correlated == 0:
            return 0.0
        return math.sqrt(float(self.components @ np.square(self.lengths)) / self.correlated)


class _Step:
    """What a model explains beyond a smaller one: orthonormal modes of the information that the smaller leaves."""

    def __init__(self, geometry: Geometry, smaller: str, larger: str) -> None:
        large, matrix = geometry.columns[larger], geometry.matrix
        self.smaller = geometry.half(smaller)
        taken = matrix @ self.smaller @ self.smaller.T
        values, vectors = geometry.seen(large.T @ (matrix - taken @ matrix) @ large, _SEEN)
        # Scores (60,) to modes (K,): variance sigma^2 each for white noise. Coefficients of a mode: the same columns.
        self.modes = (np.eye(len(matrix)) - taken).T @ large @ (vectors / np.sqrt(values))
        self._geometry = geometry
        self._known: tuple[Noise, FloatArray] | None = None

    def covariance(self, noise: Noise) -> FloatArray:
        """(K, K) of the modes under a noise: sums over pairs of cells of responses times the cells' correlation."""
        if self._known is None or self._known[0] is not noise:
            size = self.modes.shape[1]
            response = np.einsum("ik,cij->cjk", self.modes, self._geometry.translations, optimize=True)  # (C, 3, K)
            spread = self._geometry.mixture(noise) @ response.reshape(len(response), -1)
            correlated = response.reshape(-1, size).T @ spread.reshape(-1, size)
            self._known = noise, noise.white * np.eye(size) + correlated
        return self._known[1]


class Geometry:
    """All that does not depend on the residuals: models, what can be seen, and how noise of each kernel would show."""

    def __init__(self, sums: TileSums) -> None:
        total = sums.moments.sum(axis=0)
        squares = gram(total)
        self.total = float(squares[0, 0])  # weight of all pairs
        # Polynomials that are orthonormal over the pairs, but for those that the noise of the places could make up:
        # their size is held down, so that they count as unseen. A plane's third coordinate is its noise, and noise
        # that is in places and residuals alike looks like a slope.
        squares = squares / self.total
        _, power, weight = sums.dyadic[0]
        doubt = _PLACE_NOISE * power / max(weight, 1e-300) / sums.radius**2 * derivative_squares(squares)
        factor = np.linalg.cholesky(squares + np.diag(doubt + _RIDGE))
        self.to_orthonormal = np.linalg.inv(factor)  # (20, 20)
        self.basis = np.kron(self.to_orthonormal, np.eye(3))
        self.matrix = self.basis @ normal_matrix(total) @ self.basis.T
        coefficients = np.kron(factor.T, np.eye(3))
        self.dome = coefficients @ _dome()
        self.columns = {model: np.linalg.qr(coefficients @ model_columns(model))[0] for model in MODELS}
        self.translations = np.einsum("ij,cjk->cik", self.basis, translation_columns(sums.moments), optimize=True)
        self.information = translation_columns(sums.moments)[:, :3]  # (C, 3, 3) sums of w n n'
        self.side, self.radius, self.center = sums.side, sums.radius, sums.center
        mean, spread = mean_and_spread(sums.moments)
        self.means = mean * sums.radius + sums.center  # (C, 3)
        # Across a surface patch in a cell: two directions, each spread like an interval of at most the cell's edge.
        within = np.minimum(spread * sums.radius**2 / 2, sums.side**2 / 12)
        self._apart = _squared_distances(self.means)
        self._within = within[:, None] + within[None]
        self.lengths = sums.side * np.array(_LENGTHS)
        self.cell_matrices = self.basis @ normal_matrix(sums.moments) @ self.basis.T
        self.tiles = [_merged(sums.cells, factor) for factor in _FACTORS]
        self.tile_matrices = _added(self.cell_matrices, self.tiles[_TILE])  # of the reported size
        self._steps: dict[tuple[str, str], _Step] = {}
        self._halves: dict[str, FloatArray] = {}

    @cached_property
    def kernels(self) -> list[FloatArray]:
        """(C, C) correlation of each kernel between the means of cells: averaged over the patches in them."""
        found = []
        for length in self.lengths:
            squared = length**2 + self._within
            found.append(length**2 / squared * np.exp(-self._apart / (2 * squared)))
        return found

    def mixture(self, noise: Noise) -> FloatArray:
        """(C, C) covariance of the correlated noise between the means of cells."""
        total = np.zeros_like(self._apart)
        for variance, kernel in zip(noise.components, self.kernels, strict=True):
            if variance > 0:
                total += variance * kernel
        return total

    def step(self, smaller: str, larger: str) -> _Step:
        if (smaller, larger) not in self._steps:
            self._steps[smaller, larger] = _Step(self, smaller, larger)
        return self._steps[smaller, larger]

    def seen(self, matrix: FloatArray, least: float) -> tuple[FloatArray, FloatArray]:
        """Eigenvalues and vectors of a part of the normal matrix, of those with at least a share of information."""
        values, vectors = np.linalg.eigh(0.5 * (matrix + matrix.T))
        fixed = values > least * self.total
        return values[fixed], vectors[:, fixed]

    def half(self, model: str) -> FloatArray:
        """(60, K) fields of a model that the geometry fixes, with unit information each and none in common.

        Of an affine field and less, all that is fixed in the least: what is there and not modelled would look bent.
        """
        if model not in self._halves:
            if PARAMETERS[model] > PARAMETERS["affine"]:
                self._halves[model] = np.hstack([self.half("affine"), self.step("affine", model).modes])
            else:
                columns = self.columns[model]
                values, vectors = self.seen(columns.T @ self.matrix @ columns, _HARDLY_SEEN)
                self._halves[model] = columns @ (vectors / np.sqrt(values))
        return self._halves[model]

    def fit(self, model: str, scores: FloatArray) -> FloatArray:
        """(60,) coefficients of a model, of what the geometry fixes, by least squares."""
        half = self.half(model)
        coefficients: FloatArray = half @ (half.T @ scores)
        return coefficients

    @cached_property
    def noise_design(self) -> tuple[FloatArray, list[FloatArray], FloatArray]:
        """Expected moments of the largest model's residuals by white noise and by each kernel.

        A residual vector of a cell is h_c = sum w n r less what the fit explains, M u with M = G - Z' A^+ Z. Its
        expected products over a class D of pairs of cells, sum_D h_c . h_d, are tr (M' D M kernel).

        Returns:
            (lags, 1 + J) expectations for unit variances, the (C, C) masks, and (J,) the share of each kernel's
            power within cells that the fit leaves.
        """
        count = len(self.information)
        inverse = self.half("cubic") @ self.half("cubic").T
        z = self.translations.transpose(0, 2, 1)  # (C, 3, 60)
        q = (z.reshape(-1, z.shape[2]) @ inverse).reshape(z.shape)
        g = self.information
        gg = g.reshape(count, 9) @ g.reshape(count, 9).T
        apart = np.sqrt(self._apart) / self.side
        np.fill_diagonal(apart, 0.0)
        rows, masks = [], []
        kept = np.ones(len(self.lengths))
        for low, high in pairwise(_LAGS):
            mask = ((apart > low) & (apart <= high)).astype(np.float64)
            dz = (mask @ z.reshape(count, -1)).reshape(z.shape)
            inner = z.reshape(-1, z.shape[2]).T @ dz.reshape(-1, z.shape[2])
            half = np.einsum("cij,cje->cie", g, dz) - 0.5 * q @ inner
            taken = half.reshape(count, -1) @ q.reshape(count, -1).T
            product = mask * gg - taken - taken.T
            white = float(np.diag(mask) @ np.trace(g, axis1=1, axis2=2) - 2 * (dz * q).sum() + (inner * inverse).sum())
            rows.append([white, *(float((product * kernel).sum()) for kernel in self.kernels)])
            if low < 0:
                kept = np.array(rows[0][1:]) / [float((mask * gg * kernel).sum()) for kernel in self.kernels]
            masks.append(mask)
        return np.array(rows), masks, kept


class Scores:
    """The residuals' part of the sums, in the geometry's coordinates."""

    def __init__(self, geometry: Geometry, scores: FloatArray, energy: FloatArray, dyadic: FloatArray) -> None:
        rows = np.einsum("ab,cbk->cak", geometry.to_orthonormal, scores)
        self.cells: FloatArray = rows.reshape(len(scores), -1)  # (C, 60)
        self.total: FloatArray = self.cells.sum(axis=0)
        self.translations: FloatArray = scores[:, 0]  # (C, 3) sums of w n r
        self.energy = energy  # (C,)
        self.dyadic = dyadic


def estimate_noise(geometry: Geometry, scores: Scores) -> Noise:
    """Variances of white noise and of the kernels, by least squares on moments of the largest model's residuals."""
    expected, masks, kept = geometry.noise_design
    coefficients = geometry.fit("cubic", scores.total)
    left = scores.translations - np.einsum("cik,i->ck", geometry.translations, coefficients)
    products = left @ left.T
    power = np.square(left).sum(axis=1)
    rows, values, sigmas = [], [], []
    for row, mask in zip(expected, masks, strict=True):
        rows.append(row)
        values.append(float((mask * products).sum()))
        # Products of independent vectors scatter by the product of their lengths.
        sigmas.append(math.sqrt(2 * float(power @ mask @ power) / 3))
    _, _, squares = scores.dyadic[0]
    for edge, moment, information in scores.dyadic:
        if edge == 0:
            rows.append(np.array([squares, *(squares * kept)]))
        else:
            # Like the kernels between cells, for two places in one square patch; a pair is at no distance from itself.
            shape = np.square(geometry.lengths) / (np.square(geometry.lengths) + edge**2 / 6)
            rows.append(np.array([squares, *((squares + (information - squares) * shape) * kept)]))
        values.append(moment)
        sigmas.append(0.05 * moment)  # thousands of sub-cells, but noise of long range is the same in many of them
    scale = 1 / np.maximum(sigmas, 1e-300)
    found = _nonnegative_least_squares(np.array(rows) * scale[:, None], np.array(values) * scale)
    return Noise(float(found[0]), found[1:], geometry.lengths)


class Evidence(NamedTuple):
    """How much a model explains beyond a smaller one, and how often noise would have explained as much."""

    explained: float  # sum of w (n . u)^2
    modes: int
    p_noise: float  # under the estimated noise
    p_tiles: tuple[float, ...]  # wild bootstrap, a size of tiles each
    long_noise: bool  # whether noise reaches across tiles, which the bootstrap does not know

    @property
    def sure(self) -> bool:
        return self.p_noise <= _SURE_NOISE and max(self.p_tiles) <= _SURE_TILES

    @property
    def doubtful(self) -> bool:
        return not self.sure and (self.p_noise <= _DOUBT or (self.long_noise and max(self.p_tiles) <= _DOUBT))


def weigh_evidence(
    geometry: Geometry, scores: Scores, noise: Noise, smaller: str, larger: str, signs: Sequence[FloatArray]
) -> Evidence:
    """Test that a smaller model suffices against a larger one. `signs` (R, T) of the bootstrap for each tile size."""
    step = geometry.step(smaller, larger)
    modes = step.modes.T @ scores.total
    explained = float(modes @ modes)
    if not len(modes):
        return Evidence(0.0, 0, 1.0, (1.0,) * len(signs), False)
    weights: FloatArray = np.linalg.eigvalsh(step.covariance(noise)).astype(np.float64)
    coefficients = step.smaller @ (step.smaller.T @ scores.total)
    left = (scores.cells - geometry.cell_matrices @ coefficients) @ step.modes  # (C, K) of the smaller model
    p_tiles = []
    for tile, flips in zip(geometry.tiles, signs, strict=True):
        replicates = np.square(flips @ _added(left, tile)).sum(axis=1)
        p_tiles.append((1 + int(np.count_nonzero(replicates >= explained))) / (1 + len(replicates)))
    long_noise = noise.correlation_length > _FACTORS[_TILE] * geometry.side / 3
    return Evidence(explained, len(modes), chi_squares_tail(explained, weights), tuple(p_tiles), long_noise)


def bootstrap_signs(geometry: Geometry, seed: int) -> list[FloatArray]:
    """Rademacher weights (R, T) for each size of tiles."""
    rng = np.random.default_rng(seed)
    return [rng.choice([-1.0, 1.0], size=(_REPLICATES, int(tile.max()) + 1)) for tile in geometry.tiles]


def chi_squares_tail(value: float, weights: FloatArray) -> float:
    """P(sum of weights chi^2_1 > value): a scaled chi square of the same two moments (Satterthwaite 1946), by Wilson &
    Hilferty's cube root (1931).
    """
    if value <= 0:
        return 1.0
    mean, freedom = _scaled_chi_square(weights)
    if mean <= 1e-12 * value:
        return 0.0
    z = ((value / mean) ** (1 / 3) - (1 - 2 / (9 * freedom))) / math.sqrt(2 / (9 * freedom))
    return 0.5 * math.erfc(z / math.sqrt(2))


def chi_squares_point(z: float, weights: FloatArray) -> float:
    """The value that `chi_squares_tail` gives the tail of a normal deviate z."""
    mean, freedom = _scaled_chi_square(weights)
    return mean * (1 - 2 / (9 * freedom) + z * math.sqrt(2 / (9 * freedom))) ** 3


def _scaled_chi_square(weights: FloatArray) -> tuple[float, float]:
    """Mean and degrees of freedom."""
    largest = float(np.max(weights, initial=0.0))
    if largest <= 0:
        return 0.0, 1.0
    relative = weights / largest  # squares of tiny weights would be zero
    return float(weights.sum()), float(relative.sum() ** 2 / np.square(relative).sum())


@dataclass(frozen=True, eq=False)
class Field:
    """The deformation on the cells, one row each (M,): what the table `NAME_deformation.csv` holds.

    Attributes:
        places: (M, 3) mean places of the pairs.
        displacements: (M, 3) of the candidate against the reference by the chosen model, beyond the rigid motion; only
            along directions that the surface in the cell shows.
        vertical: measured mean vertical displacement beyond the rigid motion, from all pairs in the cell; NaN where no
            surface there shows it.
        sigma: standard deviation of `vertical` under the noise.
        local: length of what the largest model leaves of the cell's displacement.
        changed: whether that is more than noise, at a false discovery rate of 5 %.
        counts: pairs.
    """

    places: FloatArray
    displacements: FloatArray
    vertical: FloatArray
    sigma: FloatArray
    local: FloatArray
    changed: NDArray[np.bool_]
    counts: IntArray


@dataclass(frozen=True, eq=False)
class Deformation:
    """The answer: `values` as the README describes them (`deformation` in comparison.json), and the field."""

    values: dict[str, Any]
    field: Field | None

    @classmethod
    def unanswered(cls, reason: str) -> Deformation:
        """Undecided, for want of anything to decide on."""
        nothing = dict.fromkeys(("parameters", "p_value", "p_value_noise", "amplitude", "remaining_rms", "noise"))
        rest = dict.fromkeys(("tiles", "pairs", "growth", "observable", "local", "minimum_detectable_rms"))
        values = {"verdict": "undecided", "model": "rigid", **nothing, "rungs": [], **rest, "warnings": [reason]}
        return cls(values, None)

    def shifted(self, origin: FloatArray) -> Deformation:
        """The same in coordinates that still carry `origin` (3,)."""
        return (
            self if self.field is None else replace(self, field=replace(self.field, places=self.field.places + origin))
        )

    def with_warnings(self, notes: Sequence[str]) -> Deformation:
        return replace(self, values={**self.values, "warnings": [*self.values["warnings"], *notes]})

    @property
    def changed(self) -> NDArray[np.bool_]:
        """(C,) which cells changed by themselves."""
        return np.zeros(0, dtype=bool) if self.field is None else self.field.changed

    @property
    def changed_share(self) -> float:
        return float(np.mean(self.changed)) if len(self.changed) else 0.0

    def with_changes(self, earlier: Deformation) -> Deformation:
        """This answer, which left out cells that an earlier one found changed, with these in its field and counts."""
        if self.field is None or earlier.field is None:
            return self
        left_out = earlier.field.changed
        parts = {
            name: np.concatenate([getattr(self.field, name), getattr(earlier.field, name)[left_out]])
            for name in Field.__annotations__
        }
        return Deformation({**self.values, "local": earlier.values["local"]}, Field(**parts))

    @property
    def verdict(self) -> str:
        return str(self.values["verdict"])

    @property
    def model(self) -> str:
        return str(self.values["model"])


def judge(sums: TileSums, *, metric: bool = True, resolution: float = 0.0, seed: int = 0) -> Deformation:
    """The verdict on a pair of clouds.

    Args:
        sums: over their pairs.
        metric: whether both clouds' scale is known; otherwise a scale is no deformation.
        resolution: a bend that is surely smaller is none: tangent planes through points that lie apart do not show it.
        seed: of the bootstrap and of the folds.
    """
    geometry = Geometry(sums)
    scores = Scores(geometry, sums.scores, sums.energy, sums.dyadic)
    noise = estimate_noise(geometry, scores)
    finding = decide(geometry, scores, noise, bootstrap_signs(geometry, seed), metric=metric, resolution=resolution)
    rungs = climb(geometry, scores, noise, seed)
    beyond = geometry.step("affine", finding.model if PARAMETERS[finding.model] > 12 else "quadratic")
    measured = _Measured(geometry, scores, noise, sums)
    changed, tested, local = measured.changes(sums, resolution)
    remaining = sums.energy.sum() - _explained(geometry, scores, finding.model)
    tiles = geometry.tiles[_TILE]
    values = {
        "verdict": finding.verdict,
        "model": finding.model,
        "parameters": PARAMETERS[finding.model],
        "p_value": finding.evidence.p_tiles[_TILE],
        "p_value_noise": finding.evidence.p_noise,
        "rungs": rungs,
        "amplitude": amplitude(geometry, scores, noise, beyond),
        "remaining_rms": math.sqrt(max(0.0, float(remaining)) / geometry.total),
        "noise": {
            "sigma_white": math.sqrt(noise.white),
            "sigma_correlated": math.sqrt(noise.correlated),
            "correlation_length": noise.correlation_length,
            "n_eff": effective_count(geometry, noise),
        },
        "tiles": {
            "count": int(tiles.max()) + 1,
            "side": _FACTORS[_TILE] * sums.side,
            "agreement": finding.agreement,
        },
        "pairs": int(sums.counts.sum()),
        "growth": {
            "with_distance": measured.growth(measured.distance),
            "with_height": measured.growth(measured.height),
        },
        "observable": observable(sums, tiles),
        "local": {"tiles_tested": int(tested.sum()), "tiles_changed": int(changed.sum()), "fdr": _FDR},
        "minimum_detectable_rms": minimum_detectable_rms(geometry, noise),
        "warnings": list(finding.warnings),
    }
    field = Field(
        places=geometry.means,
        displacements=measured.displacements(finding.model),
        vertical=measured.vertical,
        sigma=measured.sigma,
        local=local,
        changed=changed,
        counts=sums.counts,
    )
    return Deformation(_rounded(values), field)


class Finding(NamedTuple):
    verdict: str  # none, similarity, affine, non-affine or undecided
    model: str
    evidence: Evidence  # that there is a non-affine part
    agreement: float  # share of the tile sizes at which the bootstrap says the same as in the middle one
    warnings: tuple[str, ...]


def decide(
    geometry: Geometry,
    scores: Scores,
    noise: Noise,
    signs: Sequence[FloatArray],
    *,
    metric: bool = True,
    resolution: float = 0.0,
) -> Finding:
    """The smallest model that explains the pair, from the largest question down; see `judge`."""

    def weigh(smaller: str, larger: str) -> Evidence:
        return weigh_evidence(geometry, scores, noise, smaller, larger, signs)

    def largest(smaller: str, larger: str) -> float:
        step = geometry.step(smaller, larger)
        return float(amplitude(geometry, scores, noise, step)["ci"][1]) if step.modes.shape[1] else 0.0

    def is_needed(smaller: str, larger: str) -> bool:
        return weigh(smaller, larger).sure and largest(smaller, larger) > resolution

    bent = weigh("affine", "cubic")
    same = [(p <= _SURE_TILES) == (bent.p_tiles[_TILE] <= _SURE_TILES) for p in bent.p_tiles]
    tiles = len(geometry.tile_matrices)
    warnings = []
    if bent.modes == 0:
        warnings.append("no bend can be seen here: the surfaces show no direction well enough")
    if tiles < FEWEST_TILES:
        warnings.append(
            f"only {tiles} tiles of {_FACTORS[_TILE] * geometry.side:.3g} hold points (expected {FEWEST_TILES}): a"
            " larger or better covered scene would settle it"
        )
    bend = largest("affine", "cubic")
    shown = bend > resolution
    if bent.sure and shown and not warnings:
        # The cubic part needs less evidence: that there is a bend is settled.
        model = "cubic" if weigh("quadratic", "cubic").p_noise <= _DOUBT else "quadratic"
        return Finding("non-affine", model, bent, float(np.mean(same)), ())
    if is_needed("similarity", "affine"):
        verdict, model = "affine", "affine"
    elif is_needed("rigid", "similarity"):
        verdict, model = ("similarity" if metric else "none"), "similarity"
        if not metric:
            warnings.append("the scales differ; that counts as deformation only where both clouds' unit is known")
    else:
        verdict, model = "none", "rigid"
    matters = shown and bend > _SMALL * math.sqrt(noise.white + noise.correlated)
    if bent.doubtful and matters:
        side = geometry.side * _FACTORS[_TILE]
        warnings.append(
            "what remains looks bent, but noise may have done it: "
            + (
                f"it is correlated over {noise.correlation_length:.3g}, with tiles of {side:.3g}; a scene of more than"
                f" {40 * noise.correlation_length:.3g} would settle it"
                if noise.correlation_length > side / 6
                else "more points, or a larger scene, would settle it"
            )
        )
    if (bent.doubtful and matters) or bent.modes == 0 or tiles < FEWEST_TILES:
        verdict = "undecided"
    return Finding(verdict, model, bent, float(np.mean(same)), tuple(warnings))


def climb(geometry: Geometry, scores: Scores, noise: Noise, seed: int) -> list[dict[str, Any]]:
    """Each model's cross-validated mean square residual (whole tiles are left out) and its BIC with n_eff."""
    tile = geometry.tiles[_TILE]
    matrices, rows = geometry.tile_matrices, _added(scores.cells, tile)
    energy, weight = _added(scores.energy, tile), np.maximum(_added(_traces(geometry), tile), 1e-300)
    fold = np.random.default_rng(seed).permutation(len(matrices)) % _FOLDS
    effective = effective_count(geometry, noise)
    found = []
    rigid = _explained(geometry, scores, "rigid")
    for model in MODELS:
        half, loss = geometry.half(model), np.empty(len(matrices))
        for number in range(_FOLDS):
            out = fold == number
            # In fields of unit information: what remains of it when a fold is left out is near the identity.
            kept = (1 + 1e-6) * np.eye(half.shape[1]) - half.T @ matrices[out].sum(axis=0) @ half
            c = half @ np.linalg.solve(kept, half.T @ (scores.total - rows[out].sum(axis=0)))
            loss[out] = energy[out] - 2 * rows[out] @ c + np.einsum("i,tij,j->t", c, matrices[out], c, optimize=True)
        score = float(loss.sum() / weight.sum())
        explained = _explained(geometry, scores, model)
        left = max(float(scores.energy.sum()) - explained, 1e-300) / geometry.total
        found.append(
            {
                "model": model,
                "parameters": PARAMETERS[model],
                "cv_score": score,
                "cv_se": float(np.std(loss - score * weight) * math.sqrt(len(loss)) / weight.sum()),
                "bic_eff": effective * math.log(left) + PARAMETERS[model] * math.log(max(effective, 2.0)),
                "rms_explained": math.sqrt(max(0.0, explained - rigid) / geometry.total),
            }
        )
    return found


def amplitude(geometry: Geometry, scores: Scores, noise: Noise, step: _Step) -> dict[str, Any]:
    """Size of the displacement along the normals beyond an affine one; what noise adds to its square is taken off.

    `rms` with its 95 % interval over all pairs; `p95` and `max` of the RMS in a cell.
    """
    modes = step.modes.T @ scores.total
    covariance = step.covariance(noise)
    power, bias = float(modes @ modes), float(np.trace(covariance))
    size = max(0.0, power - bias)
    # |m + e|^2 has the variance 2 tr V^2 + 4 m' V m; m' V m is estimated from the modes likewise.
    spread = math.sqrt(
        2 * float((covariance**2).sum())
        + 4 * max(0.0, float(modes @ covariance @ modes) - float((covariance**2).sum()))
    )
    coefficients = step.modes @ modes
    per_cell = np.einsum("i,cij,j->c", coefficients, geometry.cell_matrices, coefficients, optimize=True)
    weight = _traces(geometry)
    shrink = math.sqrt(size / power) if power > 0 else 0.0
    held = weight >= 0.1 * np.median(weight)
    rms = shrink * np.sqrt(np.maximum(per_cell[held], 0) / weight[held])
    order = np.argsort(rms)
    below = np.cumsum(weight[held][order]) / weight[held].sum()
    return {
        "rms": math.sqrt(size / geometry.total),
        "p95": float(rms[order][np.searchsorted(below, 0.95)]),
        "max": float(rms.max()),
        "ci": [math.sqrt(max(0.0, power - bias + sign * 1.96 * spread) / geometry.total) for sign in (-1, 1)],
    }


def effective_count(geometry: Geometry, noise: Noise) -> float:
    """Independent pairs that would fix the non-affine fields as well as these do: fewer where noise is correlated."""
    covariance = geometry.step("affine", "cubic").covariance(noise)
    if not len(covariance):
        return 0.0
    variance = noise.white + noise.correlated
    return min(geometry.total, geometry.total * variance * len(covariance) / max(float(np.trace(covariance)), 1e-300))


def minimum_detectable_rms(geometry: Geometry, noise: Noise) -> float | None:
    """RMS of a dome that the test under the estimated noise finds in 80 % of all cases, at 1 % false alarms."""
    step = geometry.step("affine", "cubic")
    modes = step.modes.T @ (geometry.matrix @ geometry.dome)
    power = float(modes @ modes)
    if power <= _SEEN * geometry.total * float(geometry.dome @ geometry.dome):
        return None
    covariance = step.covariance(noise)
    limit = chi_squares_point(2.326, np.linalg.eigvalsh(covariance).astype(np.float64))
    base, scatter = float(np.trace(covariance)), 2 * float((covariance**2).sum())
    along = float(modes @ covariance @ modes)
    low, high = 0.0, 1.0
    while base + high * power - 0.842 * math.sqrt(scatter + 4 * high * along) < limit:
        high *= 2
        if high > 1e300:
            return None
    for _ in range(100):
        middle = (low + high) / 2
        found = base + middle * power - 0.842 * math.sqrt(scatter + 4 * middle * along) >= limit
        low, high = (low, middle) if found else (middle, high)
    return math.sqrt(high * power / geometry.total)


def observable(sums: TileSums, tile: IntArray) -> dict[str, float]:
    """Share of the tiles whose surfaces fix a displacement along each axis, whatever it is along the others."""
    spread = _added(sums.spread, tile)
    mean = spread / np.maximum(np.trace(spread, axis1=1, axis2=2), 1e-300)[:, None, None]
    fixed = 1 / np.diagonal(np.linalg.inv(mean + 1e-9 * np.eye(3)), axis1=1, axis2=2) >= _SEEN
    return {name: float(share) for name, share in zip("xyz", fixed.mean(axis=0), strict=True)}


class _Measured:
    """What single cells say: vertical displacements, their noise, and where something changed."""

    def __init__(self, geometry: Geometry, scores: Scores, noise: Noise, sums: TileSums) -> None:
        self._geometry, self._scores, self._noise = geometry, scores, noise
        rigid = geometry.fit("rigid", scores.total)
        left = scores.translations - np.einsum("cik,i->ck", geometry.translations, rigid)
        information = geometry.information[:, 2, 2]
        seen = (information > 0.1 * _traces(geometry)) & (sums.counts >= 5)
        with np.errstate(invalid="ignore", divide="ignore"):
            self.vertical = np.where(seen, left[:, 2] / information, np.nan)
        self._seen = np.flatnonzero(seen)
        self._weights = information[seen]
        covariance = geometry.mixture(noise)[np.ix_(self._seen, self._seen)]
        self._covariance = covariance + np.diag(noise.white / self._weights)
        self.sigma = np.full(len(seen), np.nan)
        self.sigma[self._seen] = np.sqrt(np.diag(self._covariance))
        middle = np.average(geometry.means, axis=0, weights=_traces(geometry))
        self.distance = np.hypot(*(geometry.means - middle)[:, :2].T)
        self.height = geometry.means[:, 2] - geometry.means[:, 2].min()

    def growth(self, along: FloatArray) -> dict[str, Any] | None:
        """Slope of the vertical displacement, its 95 % interval, and a profile in up to eight bins of equal weight."""
        x, y, w = along[self._seen], self.vertical[self._seen], self._weights
        if len(x) < 3 or np.ptp(x) == 0:
            return None
        centred = x - np.average(x, weights=w)
        a = w * centred / float(w @ np.square(centred))
        slope, sigma = float(a @ y), math.sqrt(float(a @ self._covariance @ a))
        rank = np.argsort(x, kind="stable")
        bins = np.empty(len(x), dtype=np.int64)
        share = (np.cumsum(w[rank]) - 0.5 * w[rank]) / w.sum()
        bins[rank] = np.minimum((8 * share).astype(np.int64), 7)
        profile = []
        for number in np.unique(bins):
            within = np.where(bins == number, w, 0.0) / w[bins == number].sum()
            mean = float(within @ y)
            error = math.sqrt(float(np.square(within) @ np.square(y - mean)))
            profile.append(
                {
                    "at": float(within @ x),
                    "mean": mean,
                    "ci": [mean - 1.96 * error, mean + 1.96 * error],
                    "null": 1.96 * math.sqrt(float(within @ self._covariance @ within)),
                }
            )
        return {"slope": slope, "ci": [slope - 1.96 * sigma, slope + 1.96 * sigma], "profile": profile}

    def displacements(self, model: str) -> FloatArray:
        """(C, 3) of a model beyond the rigid motion, along the directions that the cells' surfaces show."""
        geometry = self._geometry
        coefficients = geometry.fit(model, self._scores.total) - geometry.fit("rigid", self._scores.total)
        values = geometry.to_orthonormal @ monomials((geometry.means - geometry.center) / geometry.radius)  # (20, C)
        fields = values.T @ coefficients.reshape(-1, 3)
        share, directions = np.linalg.eigh(geometry.information / np.maximum(_traces(geometry), 1e-300)[:, None, None])
        along = np.einsum("cik,ci->ck", directions, fields) * (share >= _SEEN)
        seen: FloatArray = np.einsum("cik,ck->ci", directions, along)
        return seen

    def changes(self, sums: TileSums, resolution: float) -> tuple[NDArray[np.bool_], NDArray[np.bool_], FloatArray]:
        """Cells that changed by more than the resolution, those tested, and the length left in them, (C,) each.

        The noise's scale is taken from the cells themselves, by their median (Efron 2004's empirical null); false
        discoveries are limited as in Benjamini & Hochberg 1995.
        """
        weight = np.trace(sums.spread, axis1=1, axis2=2)
        tested = (weight >= _LEAST_TESTED) & (weight >= _SMOOTH_TESTED * sums.counts)
        correlated = np.diag(self._geometry.mixture(self._noise))
        values, vectors = np.linalg.eigh(sums.spread)
        fixed = values >= np.maximum(0.05 * values.sum(axis=1, keepdims=True), 1.0)
        along = np.einsum("cik,ci->ck", vectors, sums.local)
        safe = np.where(fixed, values, 1.0)
        squares = np.where(fixed, along**2 / (self._noise.white * safe + correlated[:, None] * safe**2 + 1e-300), 0.0)
        statistic, freedom = squares.sum(axis=1), np.maximum(fixed.sum(axis=1), 1)
        ratio = statistic / (freedom * (1 - 2 / (9 * freedom)) ** 3)
        scale = max(float(np.median(ratio[tested])), 0.25) if tested.any() else 1.0
        p = np.array(
            [
                chi_squares_tail(float(s) / scale, np.ones(k)) if t else 1.0
                for s, k, t in zip(statistic, freedom, tested, strict=True)
            ]
        )
        order = np.argsort(p, kind="stable")
        limits = _FDR * np.arange(1, len(p) + 1) / max(1, int(tested.sum()))
        passed = np.flatnonzero(p[order] <= limits)
        changed = np.zeros(len(p), dtype=bool)
        if len(passed):
            changed[order[: passed[-1] + 1]] = True
        length = np.sqrt((np.where(fixed, along / safe, 0.0) ** 2).sum(axis=1))
        return changed & tested & (length > resolution), tested, length


def _dome() -> FloatArray:
    """(60,) coefficients of the vertical displacement x^2 + y^2."""
    coefficients = np.zeros((len(EXPONENTS), 3))
    for powers in ([2, 0, 0], [0, 2, 0]):
        coefficients[EXPONENTS.tolist().index(powers), 2] = 1.0
    return coefficients.ravel()


def _traces(geometry: Geometry) -> FloatArray:
    """(C,) weight of the pairs in each cell."""
    traces: FloatArray = np.trace(geometry.information, axis1=1, axis2=2)
    return traces


def _explained(geometry: Geometry, scores: Scores, model: str) -> float:
    return float(scores.total @ geometry.fit(model, scores.total))


def _rounded(value: Any) -> Any:
    """Six digits: what a statistic is worth, and the same at any number of threads of the linear algebra."""
    if isinstance(value, dict):
        return {key: _rounded(item) for key, item in value.items()}
    if isinstance(value, list):
        return [_rounded(item) for item in value]
    return float(f"{value:.6g}") if isinstance(value, float) else value


def _nonnegative_least_squares(matrix: FloatArray, values: FloatArray) -> FloatArray:
    """argmin |matrix x - values| over x >= 0 (Lawson & Hanson 1974, chapter 23)."""
    size = matrix.shape[1]
    x = np.zeros(size)
    free = np.zeros(size, dtype=bool)
    scale = np.abs(matrix.T @ values).max() or 1.0
    for _ in range(3 * size):
        gradient = matrix.T @ (values - matrix @ x)
        gradient[free] = -np.inf
        best = int(np.argmax(gradient))
        if free.all() or gradient[best] <= 1e-10 * scale:
            break
        free[best] = True
        while True:
            trial = np.zeros(size)
            trial[free] = np.linalg.lstsq(matrix[:, free], values, rcond=None)[0]
            if (trial[free] > 0).all():
                break
            falling = free & (trial <= 0)
            ratio = float(np.min(x[falling] / np.maximum(x[falling] - trial[falling], 1e-300)))
            x += ratio * (trial - x)
            free &= x > 1e-12 * np.abs(x).max()
            x[~free] = 0.0
            if not free.any():
                return x
        x = trial
    return x


def _groups(cells: IntArray) -> tuple[IntArray, IntArray]:
    """An order (N,) that brings equal rows together, and where each of the groups starts."""
    order = np.lexsort(cells.T[::-1])
    changed = (np.diff(cells[order], axis=0) != 0).any(axis=1)
    return order, np.flatnonzero(np.concatenate([[True], changed]))


def _merged(cells: IntArray, factor: int) -> IntArray:
    """(C,) the tile of `factor` cells along each axis that every cell lies in."""
    _, tile = np.unique(cells // factor, axis=0, return_inverse=True)
    return np.asarray(tile, dtype=np.int64).ravel()


def _added(values: FloatArray, tile: IntArray) -> FloatArray:
    """Sums of rows (C, ...) over tiles: (T, ...)."""
    order = np.argsort(tile, kind="stable")
    starts = np.flatnonzero(np.diff(tile[order], prepend=-1))
    sums: FloatArray = np.add.reduceat(values[order], starts, axis=0)
    return sums


def _squared_distances(points: FloatArray) -> FloatArray:
    total = np.zeros((len(points), len(points)))
    for axis in range(3):
        total += np.square(points[:, axis, None] - points[None, :, axis])
    return total
