"""Dense clouds of real photographs compared with independent sparse points."""

import numpy as np
import pytest
import textured_box as box
import textured_corner as corner
from data_folder import data_folder
from optional import import_or_skip
from scipy.spatial import cKDTree

from pcbench.geometry.visibility import in_frame
from pcbench.scenes import read_scene
from reconstructors.mvs.mvs import DenseMvs
from reconstructors.sfm.sfm import ColmapSfm

import_or_skip("pycolmap")


def plane_distances_px(dense, sparse, cameras):
    """Return the distances (N,) of sparse points to the planes of the nearest dense points, in pixels.

    The pixel is the median over the images with the point in their frames.
    """
    points = sparse.points
    depths = np.stack([camera.cam_from_world.apply(points)[:, 2] / camera.intrinsics.fx for camera in cameras])
    visible = np.stack([in_frame(camera, points) for camera in cameras])
    pixel = np.nanmedian(np.where(visible, depths, np.nan), axis=0)
    _, nearest = cKDTree(dense.points).query(points)
    return np.abs(np.einsum("ni,ni->n", points - dense.points[nearest], dense.normals[nearest])) / pixel


@pytest.mark.slow
def test_fountain(tmp_path):
    """At a third of the image size, the dense cloud agrees with sparse points of the full-size photographs."""
    for part in ("dense", "sparse"):
        (tmp_path / part).mkdir()
    reconstruction = DenseMvs().reconstruct(read_scene(data_folder("fountain"), image_scale=0.35), tmp_path / "dense")
    sparse = ColmapSfm().reconstruct(read_scene(data_folder("fountain")), tmp_path / "sparse").cloud
    distances_px = plane_distances_px(reconstruction.cloud, sparse, list(reconstruction.cameras.values()))
    assert len(reconstruction.cloud) > 400_000
    assert len(sparse) > 10_000
    assert np.median(distances_px) < 0.3
    assert np.quantile(distances_px, 0.9) < 0.9


@pytest.mark.slow
def test_object_before_an_empty_background(tmp_path):
    """Cameras all around a box: its faces are complete, and the background stays empty."""
    scene = read_scene(box.write_scene(tmp_path, box.cameras(16, corner.standard_intrinsics(320, 240))))
    (tmp_path / "work").mkdir()
    cloud = DenseMvs(backend="bundled").reconstruct(scene, tmp_path / "work").cloud
    pixel = 3.5 / 288  # at the box, 3.5 from the cameras
    errors = box.distances(cloud.points)
    assert len(cloud) > 80_000
    assert np.mean(errors < 2 * pixel) > 0.95
    assert np.mean(errors > 5 * pixel) < 0.02
    # The cameras see all faces but the lowest.
    samples = np.random.default_rng(0).uniform(-1, 1, (2000, 3)) * box.HALF
    for axis, side in ((0, -1), (0, 1), (1, -1), (1, 1), (2, 1)):
        face = samples.copy()
        face[:, axis] = side * box.HALF[axis]
        near, _ = cKDTree(cloud.points).query(face)
        assert np.mean(near < 3 * pixel) > 0.9
