"""Scores of a dense cloud of a synthetic city and of its maps: errors against exact depths and normals, and coverage
of the surface that enough images observe, with and without texture.
"""

from pathlib import Path
from typing import NamedTuple

import numpy as np
from exact_maps import mesh_map
from PIL import Image
from scipy.ndimage import maximum_filter, uniform_filter

from pcbench.geometry.cameras import Camera
from pcbench.geometry.mesh import MeshIndex
from pcbench.geometry.neighbors import Index
from pcbench.geometry.visibility import MIN_VISIBLE_VIEWS, sees
from pcbench.io.colmap_model import read_colmap_cameras
from pcbench.scenes import read_scene
from pcbench.studies.bench.truth import Truth, mesh_of, read_truth
from reconstructors.mvs.filter import world_points
from reconstructors.mvs.maps import read_map
from reconstructors.mvs.mvs import MAPS
from reconstructors.mvs.views import IMAGE, VIEWS

WINDOW = 9  # pixels along a side of the patches that matchers compare
MAX_FLAT_STD = 4.0  # maximum standard deviation of grey values in an untextured patch; sensor noise alone causes 1.5
MIN_WRONG_FOOTPRINTS = 5  # footprints from the true surface beyond which a point is wrong
SAMPLES = 200_000  # maximum number of surface samples


class City(NamedTuple):
    """A scene of `pcbench synth city` with its ground truth.

    Args:
        folder: folder of the scene.
        truth: ground truth as in `pcbench bench`.
        index: index of the true mesh.
        observed: points (M, 3) evenly spread over the surface that images observe.
        views: (M,), number of images that observe each point.
        slant: (M,), angle in degrees between normal and line of sight in the worst of the best three of these images.
        has_texture: (M,), True for points in a textured patch in at least three images.
        footprint: size of a pixel: median of depth over focal length over the lines of sight, as in `pcbench bench`.
    """

    folder: Path
    truth: Truth
    index: MeshIndex
    observed: np.ndarray
    views: np.ndarray
    slant: np.ndarray
    has_texture: np.ndarray
    footprint: float

    @property
    def seen(self) -> np.ndarray:
        """The points (N, 3) that at least three images observe."""
        return self.observed[self.views >= MIN_VISIBLE_VIEWS]

    @property
    def textured(self) -> np.ndarray:
        """Mask (N,) of these points: True in a textured patch in at least three images."""
        return self.has_texture[self.views >= MIN_VISIBLE_VIEWS]


def deviations(gray: np.ndarray) -> np.ndarray:
    """Return the standard deviations (H, W) of the grey values in the window around each pixel of an image (H, W)."""
    gray = gray.astype(np.float64)
    mean = uniform_filter(gray, WINDOW)
    return np.sqrt(np.maximum(uniform_filter(gray * gray, WINDOW) - mean * mean, 0))


def read_city(folder: Path) -> City:
    """Read a scene, the surface that its images observe, and where it has texture."""
    scene, reference = read_scene(folder), folder / "truth" / "cloud.ply"
    truth = read_truth(reference, mesh_of(folder, reference), scene.cameras, print)
    index, footprint = MeshIndex(truth.surface), truth.pixel
    samples = truth.surface.sample(min(SAMPLES, int(truth.surface.area / footprint**2)))
    view_counts, textured = (np.zeros(len(samples), dtype=int) for _ in range(2))
    cosines = np.zeros((MIN_VISIBLE_VIEWS, len(samples)))  # the largest, in ascending order
    for name in scene.images:
        camera = scene.cameras[name]
        visible_rows = np.flatnonzero(sees(index, camera, samples.points, samples.normals))
        column, row = camera.project(samples.points[visible_rows])[0].astype(int).T
        sight_lines = camera.position - samples.points[visible_rows]
        cosine = np.einsum("ni,ni->n", sight_lines, samples.normals[visible_rows]) / np.linalg.norm(sight_lines, axis=1)
        cosines[:, visible_rows] = np.sort([*cosines[:, visible_rows], cosine], axis=0)[1:]
        view_counts[visible_rows] += 1
        textured[visible_rows] += (
            deviations(np.asarray(Image.open(scene.folder / name).convert("L")))[row, column] > MAX_FLAT_STD
        )
    is_observed = view_counts > 0
    worst = np.maximum(MIN_VISIBLE_VIEWS - view_counts[is_observed], 0)  # with fewer images, the first rows are empty
    slant = np.degrees(np.arccos(np.clip(cosines[worst, is_observed.nonzero()[0]], 0, 1)))
    return City(
        folder,
        truth,
        index,
        samples.points[is_observed],
        view_counts[is_observed],
        slant,
        textured[is_observed] >= MIN_VISIBLE_VIEWS,
        footprint,
    )


class CloudScore(NamedTuple):
    """Precision and recall of a cloud.

    Args:
        points: number of points.
        precision: shares of the points within 1, 2 and 5 footprints of the surface.
        recall: shares of the observed surface with a point within 1, 2 and 5 footprints.
        textured: recall of textured surface.
        plain: recall of untextured surface.
        plain_share: share of the observed surface without texture.
        accuracy: median distance from the points to the surface, in footprints.
        completeness: mean distance from the observed surface to the points, in footprints.
    """

    points: int
    precision: np.ndarray
    recall: np.ndarray
    textured: np.ndarray
    plain: np.ndarray
    plain_share: float
    accuracy: float
    completeness: float

    @property
    def wrong(self) -> float:
        """The share of the points far from the surface."""
        return 1 - self.precision[-1]

    @property
    def empty(self) -> float:
        """The share of the observed surface without a point nearby."""
        return 1 - self.recall[-1]

    @property
    def fscore(self) -> np.ndarray:
        """The F-scores of precision and recall."""
        return 2 * self.precision * self.recall / np.maximum(self.precision + self.recall, 1e-9)


def score_cloud(city: City, points: np.ndarray) -> CloudScore:
    """Score a cloud in the frame of the city's cameras against its surface."""
    limits = city.footprint * np.array([1, 2, MIN_WRONG_FOOTPRINTS])

    def shares(distances: np.ndarray) -> np.ndarray:
        return np.array([np.mean(distances <= limit) if len(distances) else np.nan for limit in limits])

    to_surface, to_cloud = city.index.query(points).distances, Index(points).query(city.seen).distances
    recall = [
        shares(to_cloud[is_selected]) for is_selected in (np.ones(len(to_cloud), bool), city.textured, ~city.textured)
    ]
    return CloudScore(
        len(points),
        shares(to_surface),
        *recall,
        float(np.mean(~city.textured)),
        float(np.median(to_surface) / city.footprint),
        float(np.mean(to_cloud) / city.footprint),
    )


class Recall(NamedTuple):
    """Recall of a part of the surface that images observe.

    Args:
        share: its share of that surface.
        recall: its recall at two footprints.
        missed: its share of all missed surface.
    """

    share: float
    recall: float
    missed: float


def recall_by_cause(city: City, points: np.ndarray) -> dict[str, Recall]:
    """Return where a cloud misses surface: each point of the surface counts for the first cause that applies."""
    is_missed = Index(points).query(city.observed).distances > 2 * city.footprint
    causes = {
        "one image": city.views == 1,
        "two images, above 75 deg": (city.views == 2) & (city.slant >= 75),
        "two images": city.views == 2,
        "above 75 deg": city.slant >= 75,
        "60 to 75 deg": city.slant >= 60,
        "no texture": ~city.has_texture,
        "three to five images": city.views < 6,
        "none of these": city.views >= 6,
    }
    result, rest = {}, np.ones(len(is_missed), bool)
    for name, applies in causes.items():
        part, rest = rest & applies, rest & ~applies
        found = np.mean(~is_missed[part]) if part.any() else np.nan
        result[name] = Recall(np.mean(part), found, np.sum(part & is_missed) / max(1, np.sum(is_missed)))
    return result


class MapScore(NamedTuple):
    """Errors of all depths and normals in the maps of a workspace.

    Args:
        known: share of the pixels on the city that have a depth.
        depth: percentiles 50, 90, 95 and 99 of the depth errors along the rays, in footprints.
        normal: median angle in degrees between the normals and those of the true faces.
        plain: share of the pixels on the city that are in an untextured patch.
        plain_known: share of these untextured pixels that have a depth.
        plain_wrong: share of these depths that are far from the surface.
        sky_known: share of the pixels in patches of sky that have a depth.
    """

    known: float
    depth: np.ndarray
    normal: float
    plain: float
    plain_known: float
    plain_wrong: float
    sky_known: float


class Pixels(NamedTuple):
    """Values of a map's pixels, (H, W) each.

    Args:
        city: True for pixels on the city.
        sky: True for pixels whose patch contains only sky.
        known: True for pixels with a depth.
        plain: True for pixels in an untextured patch.
        errors: depth errors in footprints; infinite for depths beside the city.
        far: True for depths far from the surface.
        angles: angles between the normals and the true ones, in degrees.
    """

    city: np.ndarray
    sky: np.ndarray
    known: np.ndarray
    plain: np.ndarray
    errors: np.ndarray
    far: np.ndarray
    angles: np.ndarray


def score_maps(city: City, workspace: Path) -> MapScore:
    """Score the maps in the workspace of `mvs`, at any image size, against rays through the mesh."""
    cameras = read_colmap_cameras(workspace / MAPS)
    pixels_by_camera = [_pixels(city, camera, workspace) for camera in cameras]
    pixels = Pixels(
        *(np.concatenate([values.ravel() for values in column]) for column in zip(*pixels_by_camera, strict=True))
    )
    is_plain = pixels.plain & pixels.city
    return MapScore(
        known=float(np.mean(pixels.known[pixels.city])),
        depth=np.percentile(pixels.errors[pixels.known], [50, 90, 95, 99], method="lower"),
        # A depth far from all faces has no true normal.
        normal=float(np.median(pixels.angles[pixels.known & pixels.city & ~pixels.far])),
        plain=_share(pixels.plain, pixels.city),
        plain_known=_share(pixels.known, is_plain),
        plain_wrong=_share(pixels.far, is_plain & pixels.known),
        sky_known=_share(pixels.known, pixels.sky),
    )


def _share(condition: np.ndarray, selection: np.ndarray) -> float:
    return float(np.mean(condition[selection])) if selection.any() else float("nan")


def _pixels(city: City, camera: Camera, workspace: Path) -> Pixels:
    depth_map, true_map, k = read_map(workspace / MAPS / camera.name), mesh_map(camera, city.index), camera.intrinsics
    with Image.open(workspace / VIEWS / camera.name / IMAGE) as image:
        is_plain = deviations(np.asarray(image.convert("L"))) <= MAX_FLAT_STD
    row, column = np.nonzero(depth_map.known)
    depth = depth_map.depth[row, column].astype(float)
    points = world_points(camera, np.stack([column + 0.5, row + 0.5], axis=1), depth)
    is_far = np.zeros(depth_map.depth.shape, dtype=bool)
    is_far[row, column] = city.index.query(points).distances > MIN_WRONG_FOOTPRINTS * depth / k.fx
    on_city = true_map.depth > 0
    errors = np.full(on_city.shape, np.inf)
    errors[on_city] = np.abs(depth_map.depth - true_map.depth)[on_city] / (true_map.depth[on_city] / k.fx)
    angles = np.degrees(np.arccos(np.clip(np.einsum("hwi,hwi->hw", depth_map.normal, true_map.normal), -1, 1)))
    return Pixels(on_city, ~maximum_filter(on_city, WINDOW), depth_map.known, is_plain, errors, is_far, angles)
