"""Sums over cells, and what follows from them, equal direct sums over the pairs."""

from types import SimpleNamespace

import numpy as np
import pytest

from pcbench.deformation.field import CellDisplacements
from pcbench.deformation.model import Geometry, Noise, Scores, estimate_noise
from pcbench.deformation.polynomials import monomials, normal_matrix
from pcbench.deformation.sums import KERNEL_LENGTHS, TileSums

COUNT, RADIUS, SIDE = 600, 8.0, 4.0


@pytest.fixture(scope="module")
def pairs():
    """Return pairs in a cube from -8 to 8, and a residual of each that is mostly a rigid motion's."""
    rng = np.random.default_rng(0)
    places, normals = rng.uniform(-RADIUS, RADIUS, (COUNT, 3)), rng.normal(size=(COUNT, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    motion = np.array([0.3, -0.2, 0.5]) + np.cross([0.01, 0.03, -0.02], places)
    residuals = (motion * normals).sum(axis=1) + rng.normal(0, 0.1, COUNT)
    return SimpleNamespace(
        places=places,
        normals=normals,
        residuals=residuals,
        weights=rng.uniform(0.2, 1, COUNT),
        scales=rng.uniform(0.5, 2, COUNT),
        cells=np.floor((places + RADIUS) / SIDE).astype(int),
    )


@pytest.fixture(scope="module")
def sums(pairs):
    ones = np.ones(COUNT)
    return TileSums.of(
        pairs.places,
        pairs.normals,
        pairs.residuals,
        pairs.weights,
        scales=pairs.scales,
        remainders=pairs.residuals,
        raw_remainders=pairs.residuals,
        quality=ones,
        areas=ones,
        lower=np.full(3, -RADIUS),
        side=SIDE,
        center=np.zeros(3),
        radius=RADIUS,
    )


def test_moments_of_cells_have_the_weights_of_their_use(pairs, sums):
    design = np.einsum("an,nk->nak", monomials(pairs.places / RADIUS), pairs.normals).reshape(COUNT, 60)
    loads = pairs.weights * pairs.scales
    for cell in range(0, len(sums.cells), 9):
        rows = (pairs.cells == sums.cells[cell]).all(axis=1)
        for moments, weights in ((sums.moments, pairs.weights), (sums.loads, loads), (sums.white, loads**2)):
            expected = design[rows].T @ (weights[rows, None] * design[rows])
            np.testing.assert_allclose(normal_matrix(moments[cell]), expected, atol=1e-12)  # some ten terms of size one


def test_displacements_of_cells_are_what_a_rigid_motion_leaves(pairs, sums):
    geometry = Geometry(sums)
    scores = Scores(geometry, sums.scores, sums.energy, sums.powers)
    noise = Noise(0.01, np.zeros(len(KERNEL_LENGTHS)), geometry.lengths)
    cells = CellDisplacements(geometry, scores, noise, sums)
    rigid = np.hstack([pairs.normals, np.cross(pairs.places, pairs.normals)])
    root = np.sqrt(pairs.weights)
    left = pairs.residuals - rigid @ np.linalg.lstsq(rigid * root[:, None], pairs.residuals * root, rcond=None)[0]
    seen = np.flatnonzero(np.isfinite(cells.vertical))
    assert len(seen) > 30
    for cell in seen:
        rows = (pairs.cells == sums.cells[cell]).all(axis=1)
        weighted = (pairs.weights * pairs.normals[:, 2])[rows]
        expected = weighted @ left[rows] / (weighted @ pairs.normals[rows, 2])
        assert cells.vertical[cell] == pytest.approx(expected, abs=1e-9)  # two solutions of well-posed equations


def test_moments_of_noise_weigh_as_their_errors():
    """Without kernels the white variance is a weighted mean of the two moments over their expectations."""
    vectors, count = np.random.default_rng(1).normal(size=(7, 3)), 7
    distant = ~np.eye(count, dtype=bool)
    expectations, power = (4.0, 30.0), 25.0
    geometry = SimpleNamespace(
        noise_design=(np.array([[expectations[0], 0.0]]), [distant], np.ones(1)),
        dyadic=np.array([[expectations[1], 0.0]]),
        translations=np.zeros((count, 60, 3)),
        lengths=np.ones(1),
        fit=lambda model, scores: np.zeros(60),
    )
    scores = SimpleNamespace(total=np.zeros(60), translations=vectors, powers=np.array([power]))
    products, variance = 0.0, 0.0
    for first in range(count):
        for second in range(first):
            products += 2 * float(vectors[first] @ vectors[second])
            # Independent components of variances a and b: their three products have the variance 3 a b.
            a, b = (float(vectors[k] @ vectors[k]) / 3 for k in (first, second))
            variance += 2**2 * 3 * a * b
    weights = np.array([1 / variance, 1 / (0.05 * power) ** 2])
    expected = weights * expectations @ [products, power] / (weights @ np.square(expectations))
    assert expected > 0
    assert estimate_noise(geometry, scores).white == pytest.approx(expected, rel=1e-9)
