"""Do cameras fit the matches of their images? By epipolar lines: no point needs to be known."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np

from pcbench.errors import ReconstructionError
from pcbench.geometry.arrays import FloatArray
from pcbench.geometry.cameras import Camera

_MAX_DISTANCE_PX = 4.0  # of a match from its epipolar line: COLMAP's for verified matches
# With true cameras nearly all verified matches agree; with those of other images a few do by chance.
_MIN_AGREEING = 0.2


def check_cameras(database_file: Path, cameras: Mapping[str, Camera]) -> float:
    """The share of a database's verified matches that agree with the cameras.

    Raises:
        ReconstructionError: so few agree that the cameras are those of other images.
    """
    share = share_on_epipolar_lines(database_file, cameras)
    if share < _MIN_AGREEING:
        raise ReconstructionError(
            f"the given cameras do not fit the images: {share:.1%} of the verified matches agree with them;"
            " check them (pcbench scene SCENE --figure cameras.png), or solve them (--set poses=solve)"
        )
    return share


def share_on_epipolar_lines(database_file: Path, cameras: Mapping[str, Camera]) -> float:
    """The share of a database's verified matches whose rays pass each other within 4 pixels of the second image.

    Counting the matches that triangulated points explain would say less: COLMAP leaves out tracks of two images and
    rays that are nearly parallel, right as their matches may be.
    """
    import pycolmap

    database = pycolmap.Database.open(database_file)
    names = {int(image.image_id): str(image.name) for image in database.read_all_images()}
    rays = {
        number: cameras[name].intrinsics.directions(np.asarray(database.read_keypoints(number), np.float64)[:, :2])
        for number, name in names.items()
        if database.num_keypoints_for_image(number)
    }
    pairs, geometries = database.read_two_view_geometries()
    database.close()
    near = total = 0
    for pair, geometry in zip(pairs, geometries, strict=True):
        a, b = (int(number) for number in pycolmap.pair_id_to_image_pair(pair))
        matches = np.asarray(geometry.inlier_matches).reshape(-1, 2)
        if len(matches):
            distances = _off_lines(rays[a][matches[:, 0]], rays[b][matches[:, 1]], cameras[names[a]], cameras[names[b]])
            near += int((distances <= _MAX_DISTANCE_PX).sum())
            total += len(distances)
    return near / total if total else 0.0


def _off_lines(a: FloatArray, b: FloatArray, camera_a: Camera, camera_b: Camera) -> FloatArray:
    """Pixels (N,) between rays b (N, 3) of depth 1 in the second camera and the epipolar lines of rays a (N, 3)."""
    turned = a @ (camera_b.cam_from_world.rotation @ camera_a.cam_from_world.rotation.T).T
    baseline = camera_b.cam_from_world.apply(camera_a.position[None])[0]
    planes = np.cross(baseline, turned)
    lengths = np.hypot(planes[:, 0], planes[:, 1])
    off = np.abs(np.einsum("ni,ni->n", planes, b))
    # Cameras at one place have no lines.
    distances: FloatArray = camera_b.intrinsics.fx * np.divide(
        off, lengths, out=np.full(len(a), np.inf), where=lengths > 0
    )
    return distances
