"""Triangulation angles, and sources and depth ranges from the viewing volumes alone."""

import numpy as np
import pytest
from wording import check_error

from pcbench.errors import ReconstructionError
from pcbench.geometry.cameras import Camera, Intrinsics, look_at
from pcbench.geometry.visibility import in_frame
from reconstructors.mvs.frusta import angle_weights, angles_deg, sample_common_volume
from reconstructors.mvs.sources import choose_references
from reconstructors.mvs.sparse import without_points

K = Intrinsics.from_fov(640, 480, 45.0)


def nadir_camera(name, x, y=0.0, z=10.0):
    return Camera(name, K, look_at([x, y, z], [x, y, 0]))


def flight(steps, spacing):
    """A grid of vertical images 10 above the ground."""
    places = [(spacing * x, spacing * y) for x in range(steps) for y in range(steps)]
    return [nadir_camera(f"{k:02}", *place) for k, place in enumerate(places)]


def ring(count):
    """Cameras 10.8 from an object at the origin, all around it."""
    angles = 2 * np.pi * np.arange(count) / count
    return [Camera(f"{k:02}", K, look_at([10 * np.cos(a), 10 * np.sin(a), 4], [0, 0, 0])) for k, a in enumerate(angles)]


def references_of(cameras):
    return choose_references(without_points({camera.name: camera for camera in cameras}), 4)


def test_angles_match_trigonometry():
    a, b = nadir_camera("a", 0.0), nadir_camera("b", 10.0)
    np.testing.assert_allclose(
        angles_deg(a, b, np.array([[0.0, 0, 0], [5.0, 0, 0]])), [45, 2 * np.degrees(np.arctan(0.5))]
    )
    weights = angle_weights(np.array([0.5, 1, 5, 10, 30, 45, 90]))
    assert weights[0] == 0
    assert (np.diff(weights[:4]) > 0).all()
    assert weights[3] == weights[4] == 1
    assert (np.diff(weights[4:]) < 0).all()


@pytest.mark.parametrize(
    ("cameras", "nearest", "farthest"),
    [(flight(5, 2.0), 8, 12), (flight(4, 1.0), 8, 12), (ring(8), 8, 14), (ring(16), 8, 14)],
    ids=["flight", "dense flight", "ring", "dense ring"],
)
def test_depth_range_without_points_contains_the_scene(cameras, nearest, farthest):
    references, isolated = references_of(cameras)
    assert not isolated
    for reference in references:
        near, far = reference.depths
        assert nearest / 10 < near < nearest
        assert farthest < far < 20 * farthest
        assert len(reference.sources) == 4


def test_sources_without_points_are_neighbours():
    references, _ = references_of(ring(16))
    for k, reference in enumerate(references):
        steps = {(int(name) - k + 8) % 16 - 8 for name in reference.sources}
        assert steps <= {-3, -2, -1, 1, 2, 3}
        assert min(steps) < 0 < max(steps)


def test_common_volume_is_seen_by_the_neighbours():
    a, b = nadir_camera("a", 0), nadir_camera("b", 2)
    points = sample_common_volume(a, [b])
    assert len(points) > 100
    for camera in (a, b):
        assert in_frame(camera, points).all()
    angles = angles_deg(a, b, points)
    assert angles.min() >= 1
    assert angles.max() < 75


def test_cameras_whose_volumes_do_not_meet_are_refused():
    panorama = [Camera(f"{k}", K, look_at([1, 2, 3], [1 + np.cos(k), 2 + np.sin(k), 3])) for k in range(4)]
    with check_error(ReconstructionError):
        references_of(panorama)
    assert len(sample_common_volume(panorama[0], panorama[1:])) == 0
    turns = np.radians([0, 90, 180, 270])
    outward = [
        Camera(f"{k}", K, look_at([np.cos(a), np.sin(a), 0], [2 * np.cos(a), 2 * np.sin(a), 0]))
        for k, a in enumerate(turns)
    ]
    with check_error(ReconstructionError):
        references_of(outward)
