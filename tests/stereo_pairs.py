"""Middlebury's stereo pairs as scenes of two images with given cameras, and their structured-light depths."""

import numpy as np
from data_folder import data_root
from PIL import Image

from pcbench.geometry.cameras import Camera, Intrinsics
from pcbench.geometry.transform import Similarity
from pcbench.io.colmap_model import write_colmap_model

NAMES = ("Art", "Books", "Laundry")
REDUCTION = 3  # the images are a third of full size
FOCAL_PX = 3740.0 / REDUCTION
BASELINE_MM = 160.0


def read_disparity(path):
    """Return disparities (H, W) in pixels; 0 where unknown."""
    return np.asarray(Image.open(path), dtype=float) / REDUCTION


def write_stereo_scene(name, folder):
    """Write the scene of a pair into an existing folder, in millimetres; return the cameras.

    Args:
        name: One of `NAMES`.
        folder: Folder of the scene.
    """
    pair = data_root() / "stereo" / name
    # The disparity is measured between images whose principal points differ by dmin.
    shift = float((pair / "dmin.txt").read_text()) / REDUCTION
    cameras = []
    (folder / "images").mkdir()
    for number, view in enumerate(("view1", "view5")):
        image = Image.open(pair / f"{view}.png")
        image.save(folder / "images" / f"{view}.png")
        k = Intrinsics(*image.size, FOCAL_PX, FOCAL_PX, image.width / 2 + number * shift, image.height / 2)
        pose = Similarity(np.eye(3), np.array([-number * BASELINE_MM, 0.0, 0.0]))
        cameras.append(Camera(f"{view}.png", k, pose))
    (folder / "sparse").mkdir()
    write_colmap_model(folder / "sparse", cameras)
    return cameras


def true_depths(name):
    """Return the depths (H, W) in millimetres of the left image; 0 where unknown."""
    pair = data_root() / "stereo" / name
    shift = float((pair / "dmin.txt").read_text()) / REDUCTION
    disparity = read_disparity(pair / "disp1.png")
    return np.where(disparity > 0, FOCAL_PX * BASELINE_MM / (disparity + shift), 0.0)


def stereo_errors(name, cameras, points):
    """Return disparity errors in pixels of points (N, 3) that project to known depths of the left image.

    Args:
        name: One of `NAMES`.
        cameras: Cameras of the pair.
        points: World points.
    """
    depths = true_depths(name)
    pixels, z = cameras[0].project(points)[0], cameras[0].cam_from_world.apply(points)[:, 2]
    inside = ((pixels >= 0) & (pixels < depths.shape[::-1])).all(axis=1)
    column, row = pixels[inside].astype(int).T
    truth = depths[row, column]
    known = truth > 0
    return FOCAL_PX * BASELINE_MM * (1 / z[inside][known] - 1 / truth[known])
