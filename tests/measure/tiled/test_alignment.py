"""Poses of thinned clouds, from which tiles are registered, and the part of a cloud that did not change."""

import numpy as np
import shapes

from pcbench.changes import STABLE
from pcbench.geometry.cloud import Cloud
from pcbench.geometry.regions import Box
from pcbench.geometry.transform import Similarity
from pcbench.measure.settings import Settings
from pcbench.measure.tiled.alignment import find_pose
from pcbench.measure.tiled.labels import PointLabels, StableRegion


def test_the_pose_maps_the_candidate_to_the_reference():
    points = shapes.city(3000, seed=1)[0]
    T_reference_candidate = Similarity(shapes.rotation([0, 0, 1], 1), np.array([0.3, -0.2, 0.1]), 1.0)
    candidate = T_reference_candidate.inverse().apply(points)
    pose = find_pose(Cloud(points), Cloud(candidate), "a", Settings(register="icp"))
    np.testing.assert_allclose(pose.apply(candidate), points, atol=1e-3)


def test_the_stable_region_is_limited_to_another_one():
    labels = PointLabels(np.array([[0.0, 0, 0], [4, 0, 0]]), np.array([STABLE, 1], np.int32), None, 1)
    region, origin = StableRegion(Box([-1.0, -1, -1], [1, 1, 1]), labels), np.array([5.0, 0, 0])
    points = np.array([[0.0, 0, 0], [1.5, 0, 0], [4, 0, 0]])  # inside, only stable, changed
    assert region.contains(points).tolist() == [True, False, False]
    assert region.shifted(origin).contains(points - origin).tolist() == [True, False, False]
