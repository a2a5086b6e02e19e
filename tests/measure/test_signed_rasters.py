"""The rasters of a comparison in memory: distances with signs, seen from above."""

import numpy as np
import pytest

from pcbench import Cloud, compare
from pcbench.comparison import in_memory
from pcbench.errors import InputError
from pcbench.measure.tiled.overview import OverviewSums, PixelGrid, PixelSums

LEVELS = (-0.2, 0.5)  # heights of the western and the eastern half of the candidate above the reference


def grid(west, count, spacing):
    return west + spacing * (np.arange(count) + 0.5)


def terraces(normals=None):
    """Return a plane of 10 x 10 with its normals, and a candidate whose halves are below and above it."""
    x, y = (values.ravel() for values in np.meshgrid(grid(0, 40, 0.25), grid(0, 40, 0.25)))
    flat = np.column_stack([x, y, np.zeros_like(x)])
    lifted = flat + [0.0, 0.0, 1.0] * np.where(x < 5, *LEVELS)[:, None]
    return Cloud(flat, normals=None if normals is None else np.tile(normals, (len(flat), 1))), Cloud(lifted)


@pytest.mark.parametrize("normals", [None, [0, 0, 1.0], [0, 0, -1.0]], ids=["estimated", "up", "down"])
def test_the_candidate_is_above_where_the_raster_is_positive(normals):
    reference, lifted = terraces(normals)
    (candidate,) = compare(reference, lifted, register="none")
    for map_ in (candidate.deviation, candidate.completeness):
        raster = map_.overview
        assert raster.count.sum() == 1600
        assert np.isfinite(raster.signed).all()
        middle = raster.signed.shape[1] // 2
        west, east = raster.signed[:, : middle - 2], raster.signed[:, middle + 2 :]
        # Estimated normals are vertical within the rounding of an eigenvector, relative to 0.5.
        np.testing.assert_allclose(west, LEVELS[0], rtol=1e-6)
        np.testing.assert_allclose(east, LEVELS[1], rtol=1e-6)
        np.testing.assert_allclose(raster.mean[:, middle + 2 :], LEVELS[1], rtol=1e-12)  # rounding of one sum


@pytest.mark.parametrize("front", [-1.0, 1.0])
def test_given_normals_say_which_side_of_a_wall_is_its_front(front):
    y, z = (values.ravel() for values in np.meshgrid(grid(0, 40, 0.25), grid(0, 40, 0.25)))
    tilt = -0.01  # downwards, but nearly horizontal
    wall = Cloud(np.column_stack([0 * y, y, z]), normals=np.tile([front, 0.0, tilt] / np.hypot(1, tilt), (1600, 1)))
    (candidate,) = compare(wall, Cloud(wall.points + [0.1, 0, 0]), register="none")
    signed = candidate.deviation.overview.signed
    # The cosine of the tilt differs from 1 by 5e-5.
    np.testing.assert_allclose(signed[np.isfinite(signed)], 0.1 * front, rtol=1e-4)


def test_without_planes_the_sign_is_unknown():
    (candidate,) = compare(np.eye(3)[:2], np.eye(3), register="none")
    raster = candidate.deviation.overview
    assert np.isnan(raster.signed).all()
    assert raster.count.sum() == 3


def test_blocks_do_not_change_a_raster(monkeypatch):
    reference, lifted = terraces()
    (whole,) = compare(reference, lifted, register="none")
    monkeypatch.setattr(in_memory, "_BLOCK_QUERIES", 100)
    (blocks,) = compare(reference, lifted, register="none")
    for name in ("deviation", "completeness"):
        first, second = (getattr(candidate, name).overview for candidate in (whole, blocks))
        for field in ("signed", "mean", "largest", "count"):
            np.testing.assert_array_equal(getattr(first, field), getattr(second, field))


def test_points_are_added_as_the_sums_of_parts_are():
    rng, pixels = np.random.default_rng(0), PixelGrid(-1.0, 2.0, 0.5, 4, 3)
    points = rng.uniform([-2, 1, 0], [2, 4, 1], (500, 3))  # some are outside
    distances = rng.random(500) * 10.0 ** rng.integers(-30, 20, 500)
    signed = np.where(rng.random(500) < 0.2, np.nan, rng.choice([-1, 1], 500) * distances)
    direct, in_parts = OverviewSums(pixels), OverviewSums(pixels)
    for rows in np.split(np.arange(500), [3, 200]):
        direct.add_points(points[rows], distances[rows], signed[rows])
        in_parts.add(PixelSums.of(pixels, points[rows], distances[rows], signed[rows]))
    first, second = (raster.overview(np.zeros(3)) for raster in (direct, in_parts))
    assert 0 < first.count.sum() < 500
    for name in ("signed", "mean", "largest", "count"):
        np.testing.assert_array_equal(getattr(first, name), getattr(second, name))


@pytest.mark.parametrize("bad", [np.nan, np.inf, 1e30])
def test_distances_that_cannot_be_added_are_refused(bad):
    total = OverviewSums(PixelGrid(0.0, 0.0, 1.0, 1, 1))
    with pytest.raises(InputError, match=r"^expected finite values below 8e28 to sum \(distance\), got"):
        total.add_points(np.zeros((2, 3)), np.array([1.0, bad]), np.full(2, np.nan))
