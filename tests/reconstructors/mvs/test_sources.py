"""Which images a reference is matched with: known arrangements of cameras over a plane of points."""

import numpy as np
import pytest
from scipy.sparse import csc_matrix
from wording import refused

from pcbench.errors import ReconstructionError
from pcbench.geometry.cameras import Camera, Intrinsics, look_at
from pcbench.geometry.transform import Similarity
from pcbench.geometry.visibility import in_frame
from reconstructors.mvs.sources import angle_weights, angles_deg, choose_references
from reconstructors.mvs.sparse import Sparse

K = Intrinsics.from_fov(640, 480, 60.0)


def down(name, x, y=0.0, z=10.0):
    return Camera(name, K, look_at([x, y, z], [x, y, 0]))


def over_a_plane(cameras, extent=30.0, count=4000, seen=None):
    points = np.random.default_rng(0).uniform(-extent, extent, (count, 3)) * [1, 1, 0]
    shows = np.stack([in_frame(camera, points) if seen is None else seen(points) for camera in cameras], axis=1)
    return Sparse({c.name: c for c in cameras}, points, csc_matrix(shows.astype(np.int8)))


def test_angles_are_those_of_trigonometry():
    a, b = down("a", 0.0), down("b", 10.0)
    np.testing.assert_allclose(
        angles_deg(a, b, np.array([[0.0, 0, 0], [5.0, 0, 0]])), [45, 2 * np.degrees(np.arctan(0.5))]
    )
    weights = angle_weights(np.array([0.5, 1, 5, 10, 30, 45, 90]))
    assert weights[0] == 0
    assert (np.diff(weights[:4]) > 0).all()
    assert weights[3] == weights[4] == 1
    assert (np.diff(weights[4:]) < 0).all()


def test_neighbours_at_good_angles_come_first_and_from_both_sides():
    # Steps of 2 at height 10: 11 degrees from one to the next.
    cameras = [down(f"{k:02}", 2.0 * k - 10) for k in range(11)]
    references, alone = choose_references(over_a_plane(cameras), 4)
    assert not alone
    middle = references[5]
    assert middle.name == "05"
    assert set(middle.sources) <= {"03", "04", "06", "07", "02", "08"}
    sides = [name < "05" for name in middle.sources]
    assert sides.count(True) == sides.count(False) == 2
    assert middle.depths == pytest.approx((7.5, 12.5))
    assert middle.median_depth == pytest.approx(10)
    assert 8 < middle.angle_deg < 35


def test_what_shows_nothing_at_a_good_angle_is_no_source():
    cameras = [down("a", 0), down("b", 2), down("c", -2), down("beside a", 0.05), down("far", 200)]
    references, alone = choose_references(over_a_plane(cameras), 8)
    assert alone == ["far"]
    chosen = {r.name: r.sources for r in references}
    assert set(chosen["a"]) == {"b", "c"}
    assert set(chosen["b"]) == {"a", "c", "beside a"}


def test_of_two_alike_the_sharper_is_better():
    far = Camera("far", K, look_at([3, 0, 30], [0, 0, 0]))
    references, _ = choose_references(over_a_plane([down("a", 0), down("near", 2), far]), 1)
    assert references[0].sources == ("near",)


def test_few_features_are_helped_by_the_frames():
    """One image shows hardly a feature; what the others show in its frame tells its sources and depths."""
    cameras = [down("a", 0), down("b", 2), down("c", -2)]
    sparse = over_a_plane(cameras)
    shows = sparse.shows.toarray()
    shows[10:, 0] = 0
    references, alone = choose_references(Sparse(sparse.cameras, sparse.points, csc_matrix(shows)), 4)
    assert not alone
    assert set(references[0].sources) == {"b", "c"}
    assert references[0].depths == pytest.approx((7.5, 12.5))


def test_wrong_points_do_not_widen_the_depths():
    sparse = over_a_plane([down("a", 0), down("b", 2)])
    points = sparse.points.copy()
    points[np.flatnonzero(sparse.shows.toarray()[:, 0])[0]] = [0, 0, -1000]
    references, _ = choose_references(Sparse(sparse.cameras, points, sparse.shows), 4)
    assert references[0].depths == pytest.approx((7.5, 12.5))


def test_why_there_is_none():
    with refused(ReconstructionError):
        choose_references(over_a_plane([down("a", 0), down("b", 0.02)]), 4)
    with refused(ReconstructionError):
        choose_references(over_a_plane([down("a", -15), down("b", 15)]), 4)
    empty = over_a_plane([down("a", 0), down("b", 2)], count=0)
    with refused(ReconstructionError):
        choose_references(empty, 4)


def test_a_shifted_origin_changes_nothing_but_the_frame():
    cameras = [Camera("a", K, Similarity(look_at([5, 2, 9], [1, 0, 0]).rotation, np.array([1.0, 2, 3]))), down("b", 2)]
    sparse = over_a_plane(cameras)
    origin = np.array([4e5, 5e6, 300.0])
    far = sparse.about(-origin)
    np.testing.assert_allclose(far.cameras["a"].position, cameras[0].position + origin, rtol=1e-12)
    back = far.about(origin)
    np.testing.assert_allclose(back.points, sparse.points, atol=1e-8)
    np.testing.assert_allclose(back.cameras["a"].cam_from_world.translation, [1, 2, 3], atol=1e-8)


def test_those_that_share_features_come_first():
    """Features are shared by next neighbours alone; the frames of others have the same points."""
    cameras = [down(f"{k}", 2.0 * k - 6) for k in range(7)]
    sparse = over_a_plane(cameras)
    shows = sparse.shows.toarray()
    middle = np.flatnonzero(shows[:, 3])
    shows[np.ix_(middle, [0, 1, 5, 6])] = 0
    references, _ = choose_references(Sparse(sparse.cameras, sparse.points, csc_matrix(shows)), 4)
    (chosen,) = [r.sources for r in references if r.name == "3"]
    assert set(chosen[:2]) == {"2", "4"}
    assert set(chosen[2:]) == {"1", "5"}
