"""Planes at plain pixels: exact where the surface is one plane, and none where the images contradict them."""

import numpy as np
import pytest
from textured_planes import plane_scene

from reconstructors.mvs.maps import DepthMap
from reconstructors.mvs.planar import fill_plain_surface

NORMAL = np.array([0.35, -0.2, -1.0]) / np.linalg.norm([0.35, -0.2, -1.0])
HOLE = (slice(60, 100), slice(90, 150))


@pytest.fixture(scope="module")
def plain():
    """Return plain photographs of a slanted plane, and an exact map with a hole of unreliable depths."""
    scene = plane_scene(NORMAL, contrast=0)
    depth, confidence = scene.depths[0].copy(), np.full(scene.depths[0].shape, 0.9, np.float32)
    depth[HOLE], confidence[HOLE] = 6.0, 0.1
    normals = np.broadcast_to(NORMAL.astype(np.float32), (*depth.shape, 3)).copy()
    for values in (depth, normals, confidence):
        values.flags.writeable = False  # tests share them
    return scene, DepthMap(depth, normals, confidence)


def test_hole_gets_the_plane_around_it(plain):
    scene, depth_map = plain
    filled = fill_plain_surface(scene.views[0], scene.views[1:], depth_map)
    np.testing.assert_allclose(filled.depth, scene.depths[0], rtol=1e-5)
    np.testing.assert_allclose(filled.normal[HOLE] @ NORMAL, 1, atol=1e-5)
    assert (filled.confidence == np.float32(0.9)).all()


def test_other_depths_are_unchanged(plain):
    scene, depth_map = plain
    confident_map = DepthMap(depth_map.depth, depth_map.normal, np.maximum(depth_map.confidence, np.float32(0.4)))
    assert_unchanged(scene.views[0], scene.views[1:], confident_map)


def test_texture_is_not_filled(plain):
    _, depth_map = plain
    textured = plane_scene(NORMAL)
    filled = fill_plain_surface(textured.views[0], textured.views[1:], depth_map)
    assert np.mean(filled.depth[HOLE] != depth_map.depth[HOLE]) < 0.02


def test_sources_of_other_brightness_contradict(plain):
    scene, depth_map = plain
    bright_views = [view._replace(gray=view.gray + np.uint8(20)) for view in scene.views[1:]]
    assert_unchanged(scene.views[0], bright_views, depth_map)
    # One similar source is not enough; two are.
    assert_unchanged(scene.views[0], [scene.views[1], *bright_views[1:]], depth_map)
    filled = fill_plain_surface(scene.views[0], [*scene.views[1:3], *bright_views[2:]], depth_map)
    np.testing.assert_allclose(filled.depth, scene.depths[0], rtol=1e-5)


def test_triangles_must_agree_with_normals_at_their_vertices(plain):
    scene, depth_map = plain
    facing = np.broadcast_to(np.array([0.9, 0.0, -0.436], np.float32), depth_map.normal.shape)
    assert_unchanged(scene.views[0], scene.views[1:], DepthMap(depth_map.depth, facing, depth_map.confidence))


def test_masks_are_respected(plain):
    scene, depth_map = plain
    nothing = np.zeros(depth_map.depth.shape, bool)
    assert_unchanged(scene.views[0]._replace(valid=nothing), scene.views[1:], depth_map)
    assert_unchanged(scene.views[0], [view._replace(valid=nothing) for view in scene.views[1:]], depth_map)


def test_map_without_reliable_depths_is_unchanged(plain):
    scene, depth_map = plain
    assert_unchanged(scene.views[0], scene.views[1:], depth_map.where(np.zeros(depth_map.depth.shape, bool)))


def test_a_map_smaller_than_a_cell_is_unchanged(plain):
    scene, depth_map = plain
    part = (slice(0, 3), slice(0, 1))
    reference = scene.views[0]._replace(gray=scene.views[0].gray[part])
    small = DepthMap(depth_map.depth[part], depth_map.normal[part], depth_map.confidence[part])
    assert_unchanged(reference, [reference], small)


def assert_unchanged(reference, sources, depth_map):
    filled = fill_plain_surface(reference, sources, depth_map)
    np.testing.assert_array_equal(filled.depth, depth_map.depth)
    np.testing.assert_array_equal(filled.normal, depth_map.normal)
    np.testing.assert_array_equal(filled.confidence, depth_map.confidence)
