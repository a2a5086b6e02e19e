"""The budget of D2: what the mean squared distance to the surface consists of, in parts that add up.

Each query of a direction is without a counterpart, belongs to a change, or is stable. The distances of the stable ones
are split by least-squares fits of displacement fields u(x), observed along the normals: a rigid motion, an affine field
beyond it, and a cubic field beyond that. The fields of each fit contain those of the one before, and all points weigh
the same: the fits are orthogonal projections, whose squares add up. What they leave is noise as far as the sampling
floor or the white noise explains it, and the rest is unexplained.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from pcbench.changes import STABLE, UNMATCHED
from pcbench.deformation import Deformation
from pcbench.deformation.polynomials import (
    DEGREE,
    EXPONENTS,
    PARAMETERS,
    Planes,
    equal_normal_equations,
    gram_matrix,
    model_columns,
    normal_matrix,
    value_of_digits,
)
from pcbench.deformation.result import NEGLIGIBLE_SHARE
from pcbench.errors import Notice
from pcbench.geometry.arrays import FloatArray, IntArray, bounds

PARTS = ("unmatched", "changed", "motion", "affine", "smooth", "noise", "unexplained")
"""Names of the parts, in the order of the budget."""
CONTRADICTED = "contradicted-by-budget"
"""Code of the warning that most of the squared distance is a smooth field which the test does not confirm."""
MAX_NOISE_RATIO = 1.25  # a distance up to this multiple of its floor mostly reflects point spacing
_MIN_CONTRADICTING_SHARE = 0.5  # of D2, for a smooth field that a verdict cannot leave out
_POINTS_PER_PARAMETER = 20  # noise explains 5 % of the squares by chance at most
_MIN_PLACE_RATIO = 10.0  # of the variation of a polynomial over the points to that by the noise of their positions
_MIN_EIGENVALUE = 1e-9  # relative; far above rounding in float64, far below the share of any visible field
_CHUNK = 65_536  # queries
_ROUNDING = 1e-9  # relative; the sums of a billion squares are more precise

_MODELS = ("affine", "quadratic", "cubic")  # of degree 1, 2 and 3
_DEGREES = EXPONENTS.sum(axis=1)
FIRST = 2
"""Row of the first change in sums by label."""
_UNMATCHED_ROW, _STABLE_ROW = UNMATCHED + FIRST, STABLE + FIRST


@dataclass(frozen=True)
class BudgetPart:
    """A part of the budget.

    Attributes:
        point_share: share of the points that it describes, 0 to 1.
        mean_square: its contribution to D2: the sum of its squares over the number of all points, in squared units.
    """

    point_share: float
    mean_square: float

    @property
    def rms(self) -> float:
        """RMS over the points that it describes, in the clouds' unit."""
        return 0.0 if self.point_share == 0 else float(np.sqrt(self.mean_square / self.point_share))


@dataclass(frozen=True)
class D2Budget:
    """The budget of D2 in one direction: the contributions of the parts add up to `mean_square`.

    Attributes:
        mean_square: D2, the mean squared distance to the reference's tangent planes.
        floor: its sampling floor; None if unknown.
        unmatched: points without a counterpart: the other cloud does not cover or show their place.
        changed: points of changes.
        of_changes: the points of each change.
        motion: rigid motion of the stable points, those of no other part.
        affine: affine deformation beyond that motion.
        smooth: smooth deformation beyond that: a cubic polynomial of position, in small clouds a quadratic one.
        noise: what the sampling floor or the white noise explains of the rest.
        unexplained: what no other part explains.

    Raises:
        ValueError: the contributions do not add up.
    """

    mean_square: float
    floor: float | None
    unmatched: BudgetPart
    changed: BudgetPart
    of_changes: tuple[BudgetPart, ...]
    motion: BudgetPart
    affine: BudgetPart
    smooth: BudgetPart
    noise: BudgetPart
    unexplained: BudgetPart

    def __post_init__(self) -> None:
        contributions = [part.mean_square for part in self.parts.values()]
        total, changed = sum(contributions), sum(part.mean_square for part in self.of_changes)
        pairs = (total, self.mean_square), (changed, self.changed.mean_square)
        if min(contributions) < 0 or not all(math.isclose(*pair, rel_tol=_ROUNDING) for pair in pairs):
            raise ValueError(f"expected parts of D2 that add up to {self.mean_square}, got {contributions}")

    @property
    def parts(self) -> Mapping[str, BudgetPart]:
        """The parts by name, in the order of `PARTS`."""
        return {name: getattr(self, name) for name in PARTS}

    def share(self, *names: str) -> float:
        """Return the share of D2 that parts have together, 0 to 1; 0 if D2 is 0."""
        return 0.0 if self.mean_square == 0 else sum(self.parts[name].mean_square for name in names) / self.mean_square

    @property
    def is_noise(self) -> bool:
        """Return whether noise explains the distances.

        Each of the other parts, and all together, are then small beside D2 or its floor.
        Only then may a text say that the candidate lies as far away as error-free points, or that it is not deformed.
        """
        scale = max(self.mean_square, self.floor or 0.0)
        named = [self.parts[name].mean_square for name in PARTS if name not in ("noise", "unexplained")]
        others = self.mean_square - self.noise.mean_square
        return max(named) <= NEGLIGIBLE_SHARE**2 * scale and others <= (1 - MAX_NOISE_RATIO**-2) * scale


Equations = Callable[[Planes, FloatArray, IntArray], tuple[NDArray[Any], NDArray[Any]]]
"""Accumulates moments and scores of some of the distances (M,) to planes, given by their rows (N,)."""


class FitFrame(NamedTuple):
    """Coordinates in which positions lie between -1 and 1: their centre (3,) and their radius."""

    center: FloatArray
    radius: float

    @classmethod
    def of(cls, places: FloatArray) -> FitFrame:
        """Return the frame of positions (N, 3)."""
        low, high = bounds(places)
        return cls((low + high) / 2, float((high - low).max()) / 2 or 1.0)


@dataclass(frozen=True, eq=False)
class BudgetSums:
    """Sums over queries, from which the budget follows. Those of pieces of a cloud in one frame add up.

    Moments and scores are digits, see `whole_normal_equations`, so that the order of pieces has no effect.

    Attributes:
        counts: (2 + C,) number of queries without a counterpart, of stable ones, and of those of each change.
        squares: (2 + C,) sums of their squared distances.
        moments: (84, 6) moments of the stable queries, or (4, 84, 6) in whole numbers.
        scores: (20, 3) their scores, or (5, 20, 3) in whole numbers.
    """

    counts: IntArray
    squares: FloatArray
    moments: NDArray[Any]
    scores: NDArray[Any]

    def __add__(self, other: BudgetSums) -> BudgetSums:
        return BudgetSums(
            self.counts + other.counts,
            self.squares + other.squares,
            self.moments + other.moments,
            self.scores + other.scores,
        )


def sum_queries(
    distances: FloatArray,
    places: FloatArray,
    normals: FloatArray,
    rows: IntArray | None,
    labels: NDArray[np.int32],
    changes: int,
    frame: FitFrame,
    equations: Equations = equal_normal_equations,
) -> BudgetSums:
    """Return the sums over the queries of one direction.

    Args:
        distances: (M,) signed distances to the reference's planes.
        places: (M, 3) points of the reference through which the planes go, or any number with `rows`. They have the
            reference's noise alone, which its sampling floor measures.
        normals: (M, 3) unit normals of the planes, or any number with `rows`.
        rows: (M,) rows into places and normals; None: all in order.
        labels: (M,) number of the change of each query, `STABLE` or `UNMATCHED`.
        changes: number of changes.
        frame: frame of the places.
        equations: function that accumulates the normal equations; the sums of `whole_normal_equations` do not depend
            on the order of queries and pieces.
    """
    size = FIRST + changes
    counts, squares = np.zeros(size, np.int64), np.zeros(size)
    for start in range(0, len(labels), _CHUNK):
        groups = labels[start : start + _CHUNK] + FIRST
        counts += np.bincount(groups, minlength=size)
        np.add.at(squares, groups, np.square(distances[start : start + _CHUNK]))  # added up in the order of queries
    planes = Planes(places, normals, rows, frame.center, frame.radius)
    return BudgetSums(counts, squares, *equations(planes, distances, np.flatnonzero(labels == STABLE)))


def budget(sums: BudgetSums, frame: FitFrame, *, floor: float | None, white: float | None = None) -> D2Budget:
    """Return the budget that follows from the sums over all queries of a direction.

    Args:
        sums: the sums.
        frame: their frame.
        floor: sampling floor of D2; None if unknown.
        white: standard deviation of the white noise along the normals; None if unknown.
    """
    count, stable = max(int(sums.counts.sum()), 1), int(sums.counts[_STABLE_ROW])
    groups = [BudgetPart(int(n) / count, float(s) / count) for n, s in zip(sums.counts, sums.squares, strict=True)]
    left, share = groups[_STABLE_ROW].mean_square, stable / count
    fields = []
    for explained in _explained_squares(sums, frame, floor or 0.0):
        fields.append(BudgetPart(share, min(explained / count, left)))
        left -= fields[-1].mean_square
    motion, affine, smooth = fields
    level = max(floor or 0.0, (white or 0.0) ** 2)
    noise = min(left, share * level)
    changed = groups[FIRST:]
    return D2Budget(
        float(sums.squares.sum()) / count,
        floor,
        groups[_UNMATCHED_ROW],
        BudgetPart(sum(part.point_share for part in changed), sum(part.mean_square for part in changed)),
        tuple(changed),
        motion,
        affine,
        smooth,
        BudgetPart(share, noise),
        BudgetPart(share, left - noise),
    )


def consistent_with(budget: D2Budget, deformation: Deformation) -> Deformation:
    """Return a deformation whose verdict does not leave out most of the squared distance.

    Robust weights can take a deformation for outliers. If a smooth field explains most of D2 and the verdict denies it,
    the result is undecided.
    """
    denied = {"none": ("affine", "smooth"), "similarity": ("smooth",), "affine": ("smooth",)}
    names = denied.get(deformation.conditional_verdict or deformation.verdict, ())
    explained = sum(budget.parts[name].mean_square for name in names)
    if not names or explained < _MIN_CONTRADICTING_SHARE * max(budget.mean_square, budget.floor or 0.0):
        return deformation
    reason = Notice(
        CONTRADICTED,
        f"a smooth field explains {budget.share(*names):.0%} of the mean squared distance to the surface"
        f" ({explained**0.5:.3g} RMS), but the test took it for noise or outliers",
    )
    return replace(deformation, verdict="undecided", conditional_verdict=None, warnings=(*deformation.warnings, reason))


def _explained_squares(sums: BudgetSums, frame: FitFrame, power: float) -> tuple[float, float, float]:
    """Return the sums of squares that a rigid motion, an affine field beyond it and a smooth field beyond explain.

    Args:
        sums: sums over the queries.
        frame: their frame.
        power: mean squared noise of the places along the normals.
    """
    count = int(sums.counts[_STABLE_ROW])
    affordable = count / _POINTS_PER_PARAMETER
    if affordable < PARAMETERS["rigid"]:
        return 0.0, 0.0, 0.0
    moments, scores = sums.moments, sums.scores
    if moments.ndim == 3:  # in whole numbers
        moments, scores = value_of_digits(moments), value_of_digits(scores)
    scores = frame.radius * scores.ravel() / count
    matrix = normal_matrix(moments) / count
    polynomials = _visible_polynomials(gram_matrix(moments) / count, matrix, power / frame.radius**2)
    degree = sum(PARAMETERS[model] <= affordable for model in _MODELS)
    steps = [
        model_columns("rigid"),
        _fields(polynomials[min(degree, 1)]),
        _fields(polynomials[degree]),
    ]
    fields, explained = np.zeros((len(scores), 0)), []
    for columns in steps:
        beyond = _orthonormal(columns, matrix, fields)
        explained.append(count * float(np.square(beyond.T @ scores).sum()))
        fields = np.hstack([fields, beyond])
    motion, affine, smooth = explained
    return motion, affine, smooth


def _visible_polynomials(gram: FloatArray, matrix: FloatArray, power: float) -> list[FloatArray]:
    """Return coefficients (20, K) of the scalar polynomials of each degree, 0 to 3, that the places show.

    Noise that places and distances share looks like a field: on a plane, the height of the points is nothing but noise.
    A polynomial counts if it varies ten times as much over the points as noise along the normals makes it vary.

    Args:
        gram: (20, 20) mean products of the monomials.
        matrix: (60, 60) mean products of the monomials times the normals.
        power: mean squared noise along the normals, in the frame's unit.
    """
    noise = power * _GRADIENTS @ matrix @ _GRADIENTS.T
    basis, by_degree = np.zeros((len(gram), 0)), []
    for degree in range(DEGREE + 1):
        new = _orthonormal(np.eye(len(gram))[:, degree == _DEGREES], gram, basis)
        values, vectors = np.linalg.eigh(new.T @ noise @ new)
        basis = np.hstack([basis, new @ vectors[:, values <= _MIN_PLACE_RATIO**-2]])
        by_degree.append(basis)
    return by_degree


def _fields(polynomials: FloatArray) -> FloatArray:
    """Return coefficients (60, 3 K) of displacement fields whose components are multiples of polynomials (20, K)."""
    fields: FloatArray = np.einsum("ak,ij->aikj", polynomials, np.eye(3)).reshape(3 * len(polynomials), -1)
    return fields


def _orthonormal(columns: FloatArray, form: FloatArray, earlier: FloatArray) -> FloatArray:
    """Return an orthonormal basis (N, K) of columns (N, P) beyond known ones, in a quadratic form (N, N)."""
    beyond = columns - earlier @ (earlier.T @ form @ columns)
    values, vectors = np.linalg.eigh(beyond.T @ form @ beyond)
    enough = values > _MIN_EIGENVALUE
    basis: FloatArray = beyond @ (vectors[:, enough] / np.sqrt(values[enough]))
    return basis


def _gradients() -> FloatArray:
    """Return (20, 60) coefficients of the gradients of the monomials as displacement fields."""
    row = {tuple(powers): number for number, powers in enumerate(EXPONENTS.tolist())}
    gradients = np.zeros((len(EXPONENTS), 3 * len(EXPONENTS)))
    for number, powers in enumerate(EXPONENTS.tolist()):
        for axis in range(3):
            if powers[axis]:
                lower = tuple(power - (k == axis) for k, power in enumerate(powers))
                gradients[number, 3 * row[lower] + axis] = powers[axis]
    return gradients


_GRADIENTS = _gradients()
