"""Halos of depths around objects in front of plain background are found, and plain surface stays."""

import numpy as np
import pytest
from scipy.ndimage import binary_dilation

from reconstructors.mvs.filter import FilteredMap
from reconstructors.mvs.halos import find_halos, remove_halos
from reconstructors.mvs.maps import DepthMap

SHAPE = (80, 120)
HALO_PX = 5
ROWS, COLUMNS = np.indices(SHAPE)
IS_HOUSE = (ROWS >= 40) & (COLUMNS >= 30) & (COLUMNS < 90)


def photograph(noise, seed=0):
    """Return a textured house before plain sky."""
    rng = np.random.default_rng(seed)
    gray = np.where(IS_HOUSE, rng.uniform(40, 140, SHAPE), 200 - 0.1 * ROWS)
    return np.clip(gray + rng.normal(0, noise, SHAPE), 0, 255).round().astype(np.uint8)


def around_house(pixels):
    """Return the mask of the house and its surroundings."""
    return binary_dilation(IS_HOUSE, np.ones((3, 3), bool), iterations=pixels)


@pytest.mark.parametrize("noise", [0.3, 1.5, 5.0])
def test_fringe_in_front_of_the_sky_is_found(noise):
    known = around_house(HALO_PX)
    halo = find_halos(known, photograph(noise))
    fringe = known & ~around_house(1)
    assert halo[fringe].mean() > 0.99
    # Of the house only its outline may be lost.
    inner = (ROWS >= 42) & (COLUMNS >= 32) & (COLUMNS < 88)
    assert not halo[inner].any()


def test_plain_surface_with_depths_stays():
    """The background is a plain wall, which has depths in most places."""
    known = np.random.default_rng(1).random(SHAPE) < 0.6
    assert not find_halos(known | IS_HOUSE, photograph(1.5)).any()


def test_textured_surface_stays_however_few_depths_it_has():
    rng = np.random.default_rng(2)
    gray = (120 + 40 * ((ROWS // 8 + COLUMNS // 8) % 2) + rng.normal(0, 1.5, SHAPE)).astype(np.uint8)
    assert not find_halos(rng.random(SHAPE) < 0.05, gray).any()


def test_halos_are_removed_from_the_map_and_its_agreement():
    known = around_house(HALO_PX)
    depth = np.where(known, 7.0, 0.0).astype(np.float32)
    filtered = FilteredMap(
        DepthMap(depth, np.where(known[..., None], np.ones(3, np.float32), 0), known.astype(np.float32)),
        np.stack([known] * 2),
    )
    gray = photograph(1.5)
    depth_map, agreement = remove_halos(filtered, gray)
    expected = known & ~find_halos(known, gray)
    assert expected.sum() < known.sum()
    np.testing.assert_array_equal(depth_map.known, expected)
    np.testing.assert_array_equal(agreement, np.stack([expected] * 2))
    assert not depth_map.normal[~expected].any()
