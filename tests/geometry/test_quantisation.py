"""Steps of stored coordinates: measured for the ways in which files round, and not seen where nothing is rounded."""

import numpy as np
import pytest

from pcbench import Similarity, read_cloud, write_cloud
from pcbench.geometry.quantisation import PlacedQuantisation, Quantisation

FAR = np.array([5e5, 5.6e6, 100])
POINTS = np.random.default_rng(0).uniform(0, [100, 100, 30], (20_000, 3))
GRID = np.stack(np.meshgrid(np.arange(200) * 0.5, np.arange(150) * 0.5), axis=-1).reshape(-1, 2)
FEET = 0.3048


def rounded(points, step):
    return np.round(points / step) * step


def single(points):
    return points.astype(np.float32).astype(np.float64)


@pytest.mark.parametrize(
    ("points", "steps"),
    [
        *((rounded(POINTS + FAR, step), [step] * 3) for step in (2, 1, 0.5, 0.1, 0.01, 0.001, FEET / 100, 0.02)),
        (rounded(POINTS, 0.00037) + FAR, [0.00037] * 3),  # a LAS scale, with an offset
        (np.round(POINTS + FAR, 2) + 0.1234567, [0.01] * 3),
        (single(np.round(POINTS, 2)), [0.01] * 3),
        (np.column_stack([np.round(POINTS[:, 0], 2), POINTS[:, 1], np.round(POINTS[:, 2])]), [0.01, 0, 1]),
        (np.vstack([np.round(POINTS, 2), POINTS[:20], [0, 0, -9999]]), [0.01] * 3),
        (np.round(POINTS[:20], 2), [0.01] * 3),
        (rounded(POINTS * [1, 1, 0.05] + FAR, 0.5), [0.5] * 3),  # three levels of z
        (POINTS + FAR, [0, 0, 0]),
        (POINTS[:20], [0, 0, 0]),
        (np.column_stack([GRID + FAR[:2], np.sin(GRID[:, 0])]), [0, 0, 0]),
        (np.column_stack([GRID, np.round(10 * np.sin(GRID[:, 0]), 2)]), [0, 0, 0.01]),
        (np.column_stack([POINTS[:, :2], 10 * (POINTS[:, 0] // 25)]), [0, 0, 0]),  # flat roofs
        (np.zeros((30, 3)), [0, 0, 0]),
    ],
)
def test_steps_of_rounded_points(points, steps):
    np.testing.assert_allclose(Quantisation.of(points).steps, steps, rtol=1e-6)


def test_float32_has_the_steps_of_its_magnitude():
    steps = Quantisation.of(single(POINTS + FAR)).steps
    assert steps[:2].tolist() == [2.0**-5, 0.5]
    assert 2**-17 < steps[2] < 2**-16  # z is below and above 128
    lattice = Quantisation.of(single(POINTS))
    assert 0 < lattice.coarsest < 2**-17
    assert lattice.is_negligible(extent=144)  # the diagonal of the points


@pytest.mark.parametrize("suffix", ["ply", "las", "pcd", "xyz", "npy"])
def test_files_keep_their_steps(tmp_path, suffix):
    write_cloud(tmp_path / f"a.{suffix}", np.round(POINTS + FAR, 2))
    np.testing.assert_allclose(read_cloud(tmp_path / f"a.{suffix}").quantisation.steps, 0.01, rtol=1e-6)


def test_a_motion_turns_the_lattice():
    quarter = Similarity(np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]]), np.array([3.0, 4, 5]), 2.0)
    lattice = Quantisation(np.array([0.6, 0, 0]), np.zeros(3))
    placed = PlacedQuantisation(lattice, quarter)
    np.testing.assert_allclose(placed.normal_variances(np.eye(3)), [0, 1.2**2 / 12, 0], atol=1e-15)
    np.testing.assert_allclose(placed.rounded(quarter.apply(np.array([[0.7, 0.7, 0.7]]))), [[1.6, 5.2, 6.4]])
    cells = placed.moved_in_cells(np.zeros((20_000, 3)), None, seed=0)
    # The relative standard error of the variance of 20,000 uniform values is 0.6 %.
    np.testing.assert_allclose(cells.var(axis=0), [0, 0.12, 0], rtol=0.03, atol=1e-15)
