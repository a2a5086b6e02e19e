"""Choice of source images for known arrangements of cameras over a plane of points."""

import numpy as np
import pytest
from scipy.sparse import csc_matrix
from wording import check_error

from pcbench.errors import ReconstructionError
from pcbench.geometry.cameras import Camera, Intrinsics, look_at
from pcbench.geometry.transform import Similarity
from pcbench.geometry.visibility import in_frame
from reconstructors.mvs.sources import choose_references
from reconstructors.mvs.sparse import SparseModel

K = Intrinsics.from_fov(640, 480, 60.0)


def nadir_camera(name, x, y=0.0, z=10.0):
    return Camera(name, K, look_at([x, y, z], [x, y, 0]))


def model_over_plane(cameras, extent=30.0, count=4000):
    points = np.random.default_rng(0).uniform(-extent, extent, (count, 3)) * [1, 1, 0]
    visibility = np.stack([in_frame(camera, points) for camera in cameras], axis=1)
    return SparseModel({c.name: c for c in cameras}, points, csc_matrix(visibility.astype(np.int8)))


def test_sources_have_good_angles_on_both_sides():
    # Steps of 2 at height 10: 11 degrees from one to the next.
    cameras = [nadir_camera(f"{k:02}", 2.0 * k - 10) for k in range(11)]
    references, isolated = choose_references(model_over_plane(cameras), 4)
    assert not isolated
    middle = references[5]
    assert middle.name == "05"
    assert set(middle.sources) <= {"03", "04", "06", "07", "02", "08"}
    sides = [name < "05" for name in middle.sources]
    assert sides.count(True) == sides.count(False) == 2
    assert middle.depths == pytest.approx((7.5, 12.5))
    assert middle.median_depth == pytest.approx(10)
    assert 8 < middle.angle_deg < 35


def test_images_without_good_angles_are_no_sources():
    cameras = [
        nadir_camera("a", 0),
        nadir_camera("b", 2),
        nadir_camera("c", -2),
        nadir_camera("beside a", 0.05),
        nadir_camera("far", 200),
    ]
    references, isolated = choose_references(model_over_plane(cameras), 8)
    assert isolated == ["far"]
    sources_by_name = {r.name: r.sources for r in references}
    assert set(sources_by_name["a"]) == {"b", "c"}
    assert set(sources_by_name["b"]) == {"a", "c", "beside a"}


def test_sharper_of_two_similar_views_is_chosen():
    far_camera = Camera("far", K, look_at([3, 0, 30], [0, 0, 0]))
    references, _ = choose_references(model_over_plane([nadir_camera("a", 0), nadir_camera("near", 2), far_camera]), 1)
    assert references[0].sources == ("near",)


def test_frames_replace_missing_features():
    """An image with few features gets its sources and depths from the other images' points in its frame."""
    cameras = [nadir_camera("a", 0), nadir_camera("b", 2), nadir_camera("c", -2)]
    sparse = model_over_plane(cameras)
    visibility = sparse.visibility.toarray()
    visibility[10:, 0] = 0
    references, isolated = choose_references(SparseModel(sparse.cameras, sparse.points, csc_matrix(visibility)), 4)
    assert not isolated
    assert set(references[0].sources) == {"b", "c"}
    assert references[0].depths == pytest.approx((7.5, 12.5))


def test_outliers_do_not_widen_the_depth_range():
    sparse = model_over_plane([nadir_camera("a", 0), nadir_camera("b", 2)])
    points = sparse.points.copy()
    points[np.flatnonzero(sparse.visibility.toarray()[:, 0])[0]] = [0, 0, -1000]
    references, _ = choose_references(SparseModel(sparse.cameras, points, sparse.visibility), 4)
    assert references[0].depths == pytest.approx((7.5, 12.5))


def test_missing_sources_are_explained():
    with check_error(ReconstructionError):
        choose_references(model_over_plane([nadir_camera("a", 0), nadir_camera("b", 0.02)]), 4)
    with check_error(ReconstructionError):
        choose_references(model_over_plane([nadir_camera("a", -15), nadir_camera("b", 15)]), 4)


def test_recentering_changes_only_the_frame():
    cameras = [
        Camera("a", K, Similarity(look_at([5, 2, 9], [1, 0, 0]).rotation, np.array([1.0, 2, 3]))),
        nadir_camera("b", 2),
    ]
    sparse = model_over_plane(cameras)
    origin = np.array([4e5, 5e6, 300.0])
    shifted_model = sparse.recenter(-origin)
    np.testing.assert_allclose(shifted_model.cameras["a"].position, cameras[0].position + origin, rtol=1e-12)
    restored_model = shifted_model.recenter(origin)
    np.testing.assert_allclose(restored_model.points, sparse.points, atol=1e-8)
    np.testing.assert_allclose(restored_model.cameras["a"].cam_from_world.translation, [1, 2, 3], atol=1e-8)


def test_images_with_shared_features_come_first():
    """Only adjacent images share features; the frames of the others contain the same points."""
    cameras = [nadir_camera(f"{k}", 2.0 * k - 6) for k in range(7)]
    sparse = model_over_plane(cameras)
    visibility = sparse.visibility.toarray()
    middle_points = np.flatnonzero(visibility[:, 3])
    visibility[np.ix_(middle_points, [0, 1, 5, 6])] = 0
    references, _ = choose_references(SparseModel(sparse.cameras, sparse.points, csc_matrix(visibility)), 4)
    (sources,) = [r.sources for r in references if r.name == "3"]
    assert set(sources[:2]) == {"2", "4"}
    assert set(sources[2:]) == {"1", "5"}
