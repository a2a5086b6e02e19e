"""Parts that moved, were added or were removed are found, and samples of the same scene have no changes."""

import numpy as np
import pytest
from changed_scenes import NOISE, SIZE, box, disc, ground
from data_folder import data_folder
from scipy.spatial import ConvexHull
from wording import check_text

from pcbench.changes import (
    ADDED,
    MOVED,
    REMOVED,
    STABLE,
    UNMATCHED,
    ClosestPoints,
    details,
    find_changes,
    samples,
)
from pcbench.changes.description import convex_outline
from pcbench.deformation.sides import Side
from pcbench.deformation.stable import separate_changes
from pcbench.geometry.cloud import Cloud
from pcbench.geometry.neighbors import Index
from pcbench.geometry.normals import Surface
from pcbench.io import read_cloud

CAR, HOUSE = (2.0, 4.5, 1.5), (10.0, 10.0, 6.0)
PLACES = [(10.0 * i, 10.0 * j) for i in range(-3, 4) for j in range(-3, 4)]


def search(reference, candidate):
    return find_changes(Surface(Index(reference)), Surface(Index(candidate))).of_clouds(reference, candidate)


def raised(points, radius, offset):
    return points + np.where(disc(points, radius), offset, 0.0)[:, None] * [0, 0, 1]


def test_samples_of_the_same_scene_have_no_changes():
    for seed in range(2):
        found = search(ground(seed), ground(seed + 10))
        assert not found.found
        assert (found.of_reference == STABLE).all()
        assert (found.of_candidate == STABLE).all()


@pytest.mark.parametrize("file", ["samp22.pcd", "mvk.las", "car400.csv"])
def test_halves_of_a_real_scan_have_no_changes(file):
    points = np.unique(read_cloud(data_folder("halves") / file).points, axis=0)
    rows = np.random.default_rng(0).permutation(len(points))
    assert not search(points[np.sort(rows[::2])], points[np.sort(rows[1::2])]).found


@pytest.mark.parametrize("radius", [pytest.param(2.5, marks=pytest.mark.long), 15.0])
def test_a_larger_offset_is_never_reported_less(radius):
    """A disc of 5 or 30 % of the extent, raised by 3 to 1,000 standard deviations of the noise."""
    reference, candidate = ground(1), ground(2)
    inside, sizes = disc(candidate, radius), []
    for factor in (3, 10, 100, 1000):
        offset = factor * NOISE
        found = search(reference, raised(candidate, radius, offset))
        if factor < 10 and not found.found:
            continue
        largest = found.found[0]
        assert largest.kind == MOVED
        assert largest.mean == pytest.approx(offset, rel=0.25)
        assert np.hypot(largest.place[0] - 10, largest.place[1] - 5) < 0.4 * radius
        assert np.mean(found.of_candidate[inside] == 0) > 0.6
        sizes.append(largest.importance)
    assert sizes == sorted(sizes)
    assert largest.area == pytest.approx(np.pi * radius**2, rel=0.35)


def test_a_lowered_disc_has_a_negative_volume():
    found = search(ground(1), raised(ground(2), 6.0, -2.0)).found
    assert [change.kind for change in found] == [MOVED]
    assert found[0].mean == pytest.approx(-2.0, rel=0.05)
    assert found[0].volume == pytest.approx(-2 * np.pi * 36, rel=0.25)


def test_half_of_a_site_that_sank_is_one_change():
    candidate = ground(2)
    candidate[candidate[:, 0] > 0, 2] -= 5 * NOISE
    (change,) = search(ground(1), candidate).found
    assert change.kind == MOVED
    assert change.mean == pytest.approx(-5 * NOISE, rel=0.1)
    assert change.area == pytest.approx(SIZE**2 / 2, rel=0.1)


def test_an_added_and_a_removed_object_are_told_apart():
    car = box((10, 5), CAR, 3)
    for reference, candidate, kind, sign in (
        (ground(1), np.concatenate([ground(2), car]), ADDED, 1),
        (np.concatenate([ground(1), car]), ground(2), REMOVED, -1),
    ):
        (change,) = search(reference, candidate).found
        assert change.kind == kind
        assert change.volume * sign > 0
        assert change.peak == pytest.approx(sign * CAR[2], rel=0.3)
        assert change.place[:2] == pytest.approx((10, 5), abs=1.0)
        assert change.motion is None


def test_a_house_on_ground_that_it_hides_was_added():
    covered = np.abs(ground(2)[:, :2] - [10, 5]).max(axis=1) < 5
    candidate = np.concatenate([ground(2)[~covered], box((10, 5), HOUSE, 3)])
    (change,) = search(ground(1), candidate).found
    assert change.kind == ADDED
    assert change.volume == pytest.approx(np.prod(HOUSE), rel=0.35)


def test_an_object_elsewhere_moved():
    reference = np.concatenate([ground(1), box((10, 5), CAR, 3)])
    candidate = np.concatenate([ground(2), box((25, 5), CAR, 4)])
    (change,) = search(reference, candidate).found
    assert change.kind == MOVED
    assert change.motion[0] == pytest.approx(15, rel=0.1)


def test_an_object_far_from_one_that_is_gone_did_not_move():
    """Parts of a few voxels have the same shape."""
    reference = np.concatenate([ground(1), box((-15, -15), CAR, 3)])
    candidate = np.concatenate([ground(2), box((25, 5), CAR, 4)])
    assert {change.kind for change in search(reference, candidate).found} == {ADDED, REMOVED}


def test_walls_of_a_house_that_shifted_moved():
    """Normals of walls have arbitrary signs; the ground around the house did not move."""
    reference = np.concatenate([ground(1), box((10, 5), HOUSE, 3)])
    candidate = np.concatenate([ground(2), box((10, 5), HOUSE, 4) + [0.3, 0, 0]])
    found = search(reference, candidate).found
    assert {change.kind for change in found} == {MOVED}
    for change in found:
        assert change.mean == pytest.approx(0.3, rel=0.25)
        assert abs(abs(change.place[0] - 10) - 5) < 1.5


def test_what_one_cloud_does_not_cover_is_no_change():
    reference, candidate = ground(1), ground(2)
    for kept in (candidate[:, 0] > 0, ~disc(candidate, 6.0)):
        found = search(reference, candidate[kept])
        assert not found.found
        assert set(found.of_reference) <= {STABLE, UNMATCHED}


def test_few_or_coincident_points_have_no_changes():
    for points in (ground(1)[:50], np.zeros((200, 3))):
        found = search(points, points)
        assert not found.found
        assert len(found.of_reference) == len(points)


def test_outline_is_the_convex_hull():
    square = np.array([[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0], [0.5, 0.5], [0.5, 0.0]])
    assert convex_outline(square) == ((0, 0), (1, 0), (1, 1), (0, 1))
    assert convex_outline(square[:2]) == ((0, 0), (1, 0))
    assert convex_outline(np.array([[0.0, 0.0], [1.0, 1.0], [2.0, 2.0]])) == ((0, 0), (2, 2))
    assert convex_outline(square[[1, 1, 1]]) == (tuple(square[1]),)
    scattered = np.random.default_rng(0).normal(size=(2_000, 2))
    corners = scattered[ConvexHull(scattered).vertices]  # counter-clockwise
    first = int(np.argmin(corners[:, 0]))
    np.testing.assert_array_equal(convex_outline(scattered), np.roll(corners, -first, axis=0))


@pytest.fixture
def few_samples(monkeypatch):
    """Limit samples to a tenth of the ground's points."""
    for module in (samples, details):
        monkeypatch.setattr(module, "MAX_SAMPLE", 2000)


def small_car(candidate):
    """Return points with a car, of which a sample of the whole scene has few points."""
    beside = (np.abs(candidate[:, :2] - [10, 5]) > np.array(CAR[:2]) / 2).any(axis=1)
    return np.concatenate([candidate[beside], box((10.0, 5.0), CAR, seed=9)])


def test_a_small_object_in_a_large_scene_is_a_change(few_samples):
    candidate = small_car(ground(2))
    found = search(ground(1), candidate)
    (change,) = found.found
    assert change.kind in (ADDED, MOVED)  # its top lies above the ground that the reference shows
    assert np.hypot(change.place[0] - 10, change.place[1] - 5) < 1
    assert change.peak == pytest.approx(CAR[2], rel=0.3)
    assert change.p_value < 1e-6
    labelled = candidate[found.of_candidate == 0]
    assert len(labelled) > 50
    assert (np.abs(labelled[:, :2] - [10, 5]) < 4).all()
    assert not found.warnings


@pytest.mark.parametrize("copies", [0, 3000])
def test_known_closest_points_and_blocks_of_cells_change_no_label(few_samples, monkeypatch, copies):
    clouds = ground(1), small_car(ground(2))
    indices = [Index(np.concatenate([cloud, cloud[:copies]])) for cloud in clouds]
    expected = find_changes(*map(Surface, indices))
    assert len(expected.found) == 1
    for module, name in ((samples, "_BLOCK_POINTS"), (details, "_BLOCK_CELLS")):
        monkeypatch.setattr(module, name, 97)
    back, forth = indices[1].query_index(indices[0]), indices[0].query_index(indices[1])
    found = find_changes(*map(Surface, indices), ClosestPoints(back, forth, has_duplicates=copies > 0))
    assert found.noise == expected.noise
    for labels, expected_labels in zip(found.labels, expected.labels, strict=True):
        np.testing.assert_array_equal(labels, expected_labels)


def test_places_that_were_not_searched_are_named(few_samples):
    cars = [box(at, CAR, seed=k) for k, at in enumerate(PLACES)]
    found = search(ground(1), np.concatenate([ground(2), *cars]))
    assert 0 < len(found.found) < len(PLACES)
    assert found.left_out > 10
    check_text(found.warnings[0].text)


def test_no_small_place_of_an_unchanged_scene_changed(few_samples):
    assert not search(ground(1), ground(2)).found


@pytest.mark.parametrize(("bend", "count"), [(0.0, 1), (2.0, 0)])
def test_small_changes_of_a_bent_scene_do_not_count(few_samples, bend, count):
    candidate = small_car(ground(2))
    candidate[:, 2] += bend * np.square(candidate[:, 0] / SIZE * 2)
    sides = (
        Side(Surface(Index(points)), np.ones(len(points), bool), Cloud(points)) for points in (ground(1), candidate)
    )
    assert len(separate_changes(*sides).sampled.found) == count


def test_places_hold_the_points_of_their_cells():
    places = details.Places(np.array([[0, 0, 0], [2, -1, 0]]), 0.5, np.array([1.0, 1, 1]))
    points = np.array([[1.2, 1.2, 1.2], [2.1, 0.7, 1.4], [1.6, 1.2, 1.2], [2.1, 1.2, 1.2], [-9, 0, 0]])
    assert places.contains(points).tolist() == [True, True, False, False, False]
    assert places.shifted(np.ones(3)).contains(points - 1).tolist() == [True, True, False, False, False]


def test_gaps_of_one_cloud_are_no_changes(few_samples):
    """Holes around objects, which a small place shows as objects that rise above their surroundings."""
    rng, trees = np.random.default_rng(5), [box(at, (1.0, 1.0, 3.0), seed=k) for k, at in enumerate(PLACES)]
    reference = np.concatenate([ground(1), *trees])
    candidate = np.concatenate([ground(2), *(tree + rng.normal(0, NOISE, tree.shape) for tree in trees)])
    for at, radius in zip(PLACES, rng.uniform(3.5, 4.5, len(PLACES)), strict=True):
        candidate = candidate[~disc(candidate, radius, at)]
    assert not search(reference, candidate).found


def test_places_far_apart_are_told_apart():
    places = details.Places(np.array([[0, 0, 0], [2**31 - 1, 5, 2**22]]), 1.0, np.zeros(3))
    points = np.array([[0.5, 0.5, 0.5], [1e8, 0, 0], [1e99, 5.5, 2.0**22]])
    assert places.contains(points).tolist() == [True, False, True]


def test_no_place_is_cut_off():
    """Places that exceed the largest sample are left out as a whole: the others keep their surroundings."""
    numbers = np.stack(np.meshgrid(np.arange(60), np.arange(60), [0], indexing="ij"), -1).reshape(-1, 3)
    order = np.flatnonzero((numbers[:, :2] % 10 == 5).all(axis=1))
    places = details._largest(order, numbers, np.full(len(numbers), details.MAX_SAMPLE / 100), 1.0, np.zeros(3))
    assert len(places.cells) == 4 * 21  # a place has 21 cells within two and a half
    assert places.left_out == 32
