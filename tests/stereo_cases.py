"""Rectified pairs of photographs with disparities from structured light: as scenes, and for the bundled matcher.

Data: Middlebury 2005 (Scharstein and Pal 2007), the folders `stereo/Art`, `Books` and `Laundry`, a third of full size.
"""

import shutil
from pathlib import Path
from typing import NamedTuple

import numpy as np
from PIL import Image

from pcbench.geometry.cameras import Camera, Intrinsics
from pcbench.geometry.transform import Similarity
from pcbench.io.colmap_model import write_colmap_model
from reconstructors.mvs.filter import Criteria, filter_map
from reconstructors.mvs.patchmatch import GrayView, match, refine

PAIRS = ("Art", "Books", "Laundry")
MIN_DISPARITY_PX, DISPARITIES = 5, 80  # of the search; true disparities are between 11 and 78 pixels
_SHRINKING = 3  # full size divided by the size of the images
_FOCAL_PX, _BASELINE_MM = 3740 / _SHRINKING, 160.0


class Pair(NamedTuple):
    """A rectified pair.

    Args:
        left, right: the photographs; their cameras have the names of the files, and lengths are in millimetres.
        disparity: (H, W), true disparity of the left image in pixels, 0 where it is unknown.
        offset: column of the right principal point minus that of the left one, in pixels.
    """

    left: GrayView
    right: GrayView
    disparity: np.ndarray
    offset: float

    @property
    def depth_range(self) -> tuple[float, float]:
        """Smallest and largest searched depth."""
        limits = np.array([MIN_DISPARITY_PX + DISPARITIES, MIN_DISPARITY_PX]) + self.offset
        near, far = _FOCAL_PX * _BASELINE_MM / limits
        return float(near), float(far)

    def disparities(self, depth: np.ndarray) -> np.ndarray:
        """Return the disparities of depths (H, W) in pixels; NaN where there is no depth."""
        return np.where(depth > 0, _FOCAL_PX * _BASELINE_MM / np.where(depth > 0, depth, 1) - self.offset, np.nan)


def read_pair(folder: Path) -> Pair:
    """Read a pair from its folder."""
    left, right = (np.asarray(Image.open(folder / name).convert("L")) for name in ("view1.png", "view5.png"))
    disparity = np.asarray(Image.open(folder / "disp1.png")).astype(np.float32) / _SHRINKING
    offset = float((folder / "dmin.txt").read_text()) / _SHRINKING
    height, width = left.shape

    def view(name: str, gray: np.ndarray, cx: float, x: float) -> GrayView:
        intrinsics = Intrinsics(width, height, _FOCAL_PX, _FOCAL_PX, cx, height / 2)
        return GrayView(gray, Camera(name, intrinsics, Similarity(np.eye(3), np.array([-x, 0.0, 0.0]))))

    left_view = view("view1.png", left, width / 2, 0.0)
    return Pair(left_view, view("view5.png", right, width / 2 + offset, _BASELINE_MM), disparity, offset)


def write_pair_scene(pair: Pair, photographs: Path, folder: Path) -> None:
    """Write the scene of a pair with its cameras into an existing folder.

    Args:
        pair: the pair.
        photographs: folder of its photographs.
        folder: folder of the scene.
    """
    cameras = [pair.left.camera, pair.right.camera]
    for part in ("images", "sparse"):
        (folder / part).mkdir()
    for camera in cameras:
        shutil.copyfile(photographs / camera.name, folder / "images" / camera.name)
    write_colmap_model(folder / "sparse", cameras)


def point_errors(pair: Pair, points: np.ndarray) -> np.ndarray:
    """Return disparity errors in pixels of points (N, 3) that project to known disparities of the left image."""
    pixels, depths = pair.left.camera.project(points)
    inside = ((pixels >= 0) & (pixels < pair.disparity.shape[::-1])).all(axis=1)
    column, row = pixels[inside].astype(int).T
    truth = pair.disparity[row, column]
    return (pair.disparities(depths[inside]) - truth)[truth > 0]


def match_pair(pair: Pair) -> np.ndarray:
    """Return the disparities (H, W) of the left image that the right one confirms, as `mvs` computes them; NaN without.

    Both images are matched photometrically and then geometrically.
    """
    views = (pair.left, pair.right)
    both = [match(view, [other], pair.depth_range) for view, other in (views, views[::-1])]
    left, right = (
        refine(view, [other], [other_map.depth], own_map, pair.depth_range)
        for (view, own_map), (other, other_map) in zip(
            zip(views, both, strict=True), zip(views[::-1], both[::-1], strict=True), strict=True
        )
    )
    kept = filter_map(pair.left.camera, left, [(pair.right.camera, right)], Criteria(views=2)).depth_map
    return pair.disparities(kept.depth)


class PairScore(NamedTuple):
    """Shares of the pixels with a true disparity, occluded ones included.

    Args:
        known: share with a disparity.
        one, two: share with an error of at most 1 and 2 pixels.
        wrong: share of the known ones with an error above 2 pixels.
    """

    known: float
    one: float
    two: float
    wrong: float


def score_pair(pair: Pair, disparity: np.ndarray) -> PairScore:
    """Score disparities (H, W) of the left image in pixels, NaN where they are unknown."""
    has_truth = pair.disparity > 0
    errors = np.abs(disparity - pair.disparity)[has_truth]
    known, one, two = (float(np.mean(flags)) for flags in (np.isfinite(errors), errors <= 1, errors <= 2))
    return PairScore(known, one, two, 1 - two / max(known, 1e-9))
