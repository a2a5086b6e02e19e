"""Filtering of exact maps of a plane and of a corner, some with known errors."""

import numpy as np
import pytest
import textured_corner as corner
from exact_maps import corner_map, plane_map, rays

from pcbench.geometry.cameras import Camera, Intrinsics, look_at
from pcbench.geometry.visibility import in_frame
from reconstructors.mvs.filter import Criteria, confirm, depths_on_planes, filter_map, world_points
from reconstructors.mvs.maps import DepthMap

K = Intrinsics(160, 120, 150.0, 155.0, 81.0, 58.5)
TILTED_NORMAL = np.array([0.3, -0.2, 0.932]) / np.linalg.norm([0.3, -0.2, 0.932])


def make_cameras(count=4, step=0.6):
    return [Camera(f"{k}", K, look_at([step * k, 0.3 * (k % 2), 5], [step * k, 0, 0])) for k in range(count)]


def filter_first(views, maps, criteria=None, valid=None):
    sources = list(zip(views[1:], maps[1:], strict=True))
    return filter_map(views[0], maps[0], sources, criteria or Criteria(views=3), valid)


def in_source_frames(views, depth_map):
    """Return (sources, H, W): whether a pixel's point lies in the frame of a source."""
    points = (views[0].position + depth_map.depth[..., None] * rays(views[0])).reshape(-1, 3)
    return np.stack([in_frame(camera, points).reshape(depth_map.depth.shape) for camera in views[1:]])


@pytest.mark.parametrize("normal", [(0.0, 0.0, 1.0), TILTED_NORMAL])
def test_depths_in_other_frames_are_confirmed(normal):
    views = make_cameras()
    maps = [plane_map(camera, normal, 0.2) for camera in views]
    filtered_map, agreement = filter_first(views, maps)
    in_frames = in_source_frames(views, maps[0])
    # Rounding decides whether points on the border of a frame lie in it.
    assert (agreement == (in_frames & (in_frames.sum(axis=0) >= 2))).mean() > 0.999
    assert (filtered_map.known == (in_frames.sum(axis=0) >= 2)).mean() > 0.999
    # Each map rounds its depths to float32.
    np.testing.assert_allclose(filtered_map.depth[filtered_map.known], maps[0].depth[filtered_map.known], rtol=1e-6)
    assert not filtered_map.normal[~filtered_map.known].any()
    assert not filtered_map.confidence[~filtered_map.known].any()


def distort_left_half(depth_map, depth=1.0, turn_deg=0.0):
    """Scale the depths, or turn the normals about y, in the left half of a map."""
    left = np.arange(depth_map.depth.shape[1]) < depth_map.depth.shape[1] // 2
    c, s = np.cos(np.radians(turn_deg)), np.sin(np.radians(turn_deg))
    normals = depth_map.normal @ np.array([[c, 0, s], [0, 1, 0], [-s, 0, c]], np.float32).T
    return DepthMap(
        np.where(left, np.float32(depth) * depth_map.depth, depth_map.depth),
        np.where(left[:, None], normals, depth_map.normal).astype(np.float32),
        depth_map.confidence,
    )


def test_kept_depths_are_means_over_the_maps_that_agree():
    views = make_cameras()
    maps = [plane_map(camera, (0, 0, 1), 0.0) for camera in views]
    filtered_map, agreement = filter_first(views, [distort_left_half(maps[0], depth=1.01), *maps[1:]])
    confirmations = agreement.sum(axis=0)
    left = filtered_map.known & (np.arange(filtered_map.depth.shape[1]) < filtered_map.depth.shape[1] // 2)
    # The wrong depth meets the other maps beside its pixel: at the same depth, on a plane that the camera faces.
    expected = maps[0].depth * (1.01 + confirmations) / (1 + confirmations)
    np.testing.assert_allclose(filtered_map.depth[left], expected[left], rtol=1e-6)
    assert left.any() and {2, 3} <= set(confirmations[left].tolist())


@pytest.mark.parametrize(
    ("change", "criteria", "is_kept"),
    [
        ({"depth": 1.01}, {}, True),
        ({"depth": 1.03}, {}, False),
        ({"depth": 1.03}, {"depth": 0.04, "pixels": 9.0}, True),
        # 0.6 from one camera to the next at a distance of 5: 0.5 % of the depth are 0.09 pixels of 150.
        ({"depth": 1.005}, {"pixels": 0.05}, False),
        ({"turn_deg": 50.0}, {}, True),
        ({"turn_deg": 70.0}, {}, False),
        ({"turn_deg": 50.0}, {"normal_deg": 30.0}, False),
    ],
)
def test_contradicted_depths_are_removed(change, criteria, is_kept):
    views = make_cameras()
    maps = [plane_map(camera, (0, 0, 1), 0.0) for camera in views]
    true_map, _ = filter_first(views, maps)
    distorted_map = distort_left_half(maps[0], **change)
    filtered_map, _ = filter_first(views, [distorted_map, *maps[1:]], Criteria(views=3, **criteria))
    left = np.arange(160) < 80
    # Points that move along their rays also move in the other frames.
    assert (filtered_map.known & left).sum() == (
        pytest.approx((true_map.known & left).sum(), rel=0.04) if is_kept else 0
    )
    assert (filtered_map.known & ~left).sum() == (true_map.known & ~left).sum()


def test_minimum_number_of_views():
    views = make_cameras(5, step=0.9)
    maps = [plane_map(camera, (0, 0, 1), 0.0) for camera in views]
    view_counts = 1 + in_source_frames(views, maps[0]).sum(axis=0)
    for min_views in (2, 3, 4, 5):
        filtered_map, _ = filter_first(views, maps, Criteria(views=min_views))
        assert filtered_map.known.sum() == pytest.approx((view_counts >= min_views).sum(), abs=10)
    assert (view_counts == 5).any()
    assert (view_counts == 2).any()


@pytest.mark.parametrize(
    ("confirming", "seeing_through", "confidence", "is_kept"),
    [(1, 0, 1.0, True), (1, 1, 1.0, False), (2, 1, 1.0, True), (2, 2, 1.0, False), (1, 3, 0.4, True)],
)
def test_depths_that_other_images_see_through_are_removed(confirming, seeing_through, confidence, is_kept):
    """In some images a plate floats above the ground; others see the ground there, with some confidence."""
    views = make_cameras(1 + confirming + seeing_through, step=0.1)
    ground_maps = [plane_map(camera, (0, 0, 1), 0.0) for camera in views]
    plate_maps = [plane_map(camera, (0, 0, 1), 0.5) for camera in views[: 1 + confirming]]
    seen = ground_maps[1 + confirming :]
    seen_maps = [DepthMap(m.depth, m.normal, np.full_like(m.confidence, confidence)) for m in seen]
    filtered_map, agreement = filter_first(views, [*plate_maps, *seen_maps], Criteria(views=2))
    inner = np.s_[40:80, 60:100]
    assert filtered_map.known[inner].all() == filtered_map.known[inner].any() == is_kept
    assert agreement[:, *inner].all(axis=(1, 2)).tolist() == [is_kept] * confirming + [False] * seeing_through


def test_hidden_depths_are_not_contradicted():
    """Two images show the ground; three others show a plate in front of it."""
    views = make_cameras(5, step=0.1)
    maps = [plane_map(camera, (0, 0, 1), 0.0 if k < 2 else 0.5) for k, camera in enumerate(views)]
    filtered_map, _ = filter_first(views, maps, Criteria(views=2))
    assert filtered_map.known[40:80, 60:100].all()


def test_low_confidence_and_masked_pixels_are_removed_and_confirm_nothing():
    views = make_cameras(3)
    maps = [plane_map(camera, (0, 0, 1), 0.0) for camera in views]
    known = filter_first(views, maps)[0].known
    low_confidence = maps[0].confidence.copy()
    low_confidence[:40] = 0.05
    filtered_map, _ = filter_first(views, [DepthMap(maps[0].depth, maps[0].normal, low_confidence), *maps[1:]])
    assert not filtered_map.known[:40].any()
    np.testing.assert_array_equal(filtered_map.known[40:], known[40:])
    unconfident_map = DepthMap(maps[2].depth, maps[2].normal, np.full_like(maps[2].confidence, 0.05))
    assert not filter_first(views, [*maps[:2], unconfident_map])[0].known.any()
    valid = np.ones((120, 160), bool)
    valid[:, 100:] = False
    np.testing.assert_array_equal(filter_first(views, maps, valid=valid)[0].known, known & valid)


def test_only_exact_depths_remain_at_edges():
    """At the corner's edges and at occlusions all remaining depths are exact."""
    views = corner.cameras(6, corner.standard_intrinsics(240, 180))
    maps = [corner_map(camera) for camera in views]
    filtered_map, agreement = filter_first(views, maps)
    indices = np.nonzero(filtered_map.known)
    points = world_points(views[0], np.stack([indices[1] + 0.5, indices[0] + 0.5], axis=1), filtered_map.depth[indices])
    assert corner.distances(points).max() < 1e-5
    assert filtered_map.known.mean() > 0.9 * maps[0].known.mean()
    assert agreement.shape == (5, 180, 240)
    assert (agreement.sum(axis=0)[filtered_map.known] >= 2).all()


def test_world_points_project_to_their_pixels():
    camera = make_cameras()[1]
    pixels = np.random.default_rng(0).uniform(0, 120, (50, 2))
    true_depths = np.random.default_rng(1).uniform(1, 9, 50)
    projections, depths = camera.project(world_points(camera, pixels, true_depths))
    np.testing.assert_allclose(projections, pixels, atol=1e-9)
    np.testing.assert_allclose(depths, true_depths, atol=1e-12)


def reference_confirmation(camera, depth_map, other, other_map, criteria):
    """Return depths (H, W), NaN if not confirmed, and whether the other image sees through each pixel, by numpy."""
    row, column = np.indices(depth_map.depth.shape)
    u, v = column + 0.5, row + 0.5
    points = world_points(camera, np.stack([u, v], axis=-1).reshape(-1, 2), depth_map.depth.ravel())
    (x, y), z = (part.T for part in other.project(points))
    inside = (z > 0) & (x >= 0) & (x < K.width) & (y >= 0) & (y < K.height)
    x, y = (np.where(inside, coordinate, 0) for coordinate in (x, y))
    there = y.astype(int), x.astype(int)
    inside &= (other_map.depth[there] > 0) & (other_map.confidence[there] >= criteria.confidence)
    depths = depths_on_planes(other, other_map, *there, x, y)
    beyond = depths - z
    sees_through = inside & (beyond > criteria.depth * z) & (other_map.confidence[there] >= 0.5)
    on_surface = world_points(other, np.stack([x, y], axis=-1), depths)
    (back_u, back_v), back_z = (part.T for part in camera.project(on_surface))
    is_back = (back_z > 0) & (np.hypot(back_u - u.ravel(), back_v - v.ravel()) <= criteria.pixels)
    turn = camera.cam_from_world.rotation @ other.cam_from_world.rotation.T
    cosines = np.einsum("ni,ni->n", depth_map.normal.reshape(-1, 3), other_map.normal[there] @ turn.T)
    is_close = (np.abs(beyond) <= criteria.depth * z) & (cosines >= np.cos(np.radians(criteria.normal_deg)))
    return np.where(inside & is_back & is_close, back_z, np.nan), sees_through


def test_compiled_confirmation_equals_that_of_numpy():
    """Rounding decides for few pixels whether they meet a criterion."""
    rng = np.random.default_rng(3)
    views = make_cameras(3)
    maps = [plane_map(camera, TILTED_NORMAL, 0.2) for camera in views]
    noisy_maps = []
    for map_ in maps:
        normals = map_.normal + rng.normal(0, 0.35, map_.normal.shape)
        normals /= np.linalg.norm(normals, axis=2, keepdims=True)
        depths = map_.depth * rng.normal(1, 0.015, map_.depth.shape) * (rng.random(map_.depth.shape) > 0.1)
        confidences = rng.random(map_.depth.shape)
        noisy_maps.append(DepthMap(*(part.astype(np.float32) for part in (depths, normals, confidences))))
    pixels = tuple(part.ravel() for part in np.indices(maps[0].depth.shape))
    for other, other_map in zip(views[1:], noisy_maps[1:], strict=True):
        depths, sees_through = confirm(views[0], noisy_maps[0], pixels, other, other_map, Criteria())
        expected_depths, expected_sees_through = reference_confirmation(
            views[0], noisy_maps[0], other, other_map, Criteria()
        )
        assert (np.isfinite(depths) == np.isfinite(expected_depths)).mean() > 0.9995
        assert (sees_through == expected_sees_through).mean() > 0.9995
        both = np.isfinite(depths) & np.isfinite(expected_depths)
        assert 0.1 < both.mean() < 0.9 and 0.02 < sees_through.mean() < 0.9
        np.testing.assert_allclose(depths[both], expected_depths[both], rtol=1e-9)
