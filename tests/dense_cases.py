"""What a dense cloud of a synthetic city, and the maps that it was fused of, are held against: exact depths, normals,
and the surface that enough images show, with texture or without.
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
from pcbench.geometry.visibility import SEEN_BY, sees
from pcbench.io.colmap_model import read_colmap_cameras
from pcbench.scenes import read_scene
from pcbench.studies.bench.truth import Truth, mesh_of, read_truth
from reconstructors.mvs.filter import world_points
from reconstructors.mvs.maps import read_map
from reconstructors.mvs.mvs import MAPS
from reconstructors.mvs.views import IMAGE, VIEWS

WINDOW = 9  # pixels along a patch, as matchers compare them
FLAT = 4.0  # standard deviation of its grey values without texture: the sensor's noise makes 1.5
WRONG = 5  # footprints from the true surface
SAMPLES = 200_000  # of the surface, at most


class City(NamedTuple):
    """A scene of `pcbench synth city` and what is known of it.

    Args:
        folder: of the scene.
        truth: as `pcbench bench` has it.
        index: of the true mesh.
        seen: points (N, 3) evenly spread over what at least three images show.
        textured: (N,) which of them are in a patch with texture in at least three of these images.
        views: (N,) how many images show them.
        slant: (N,) angles in degrees between normal and line of sight in the third-best of these images.
        footprint: of a pixel: depth over focal length, the median over lines of sight, as in `pcbench bench`.
    """

    folder: Path
    truth: Truth
    index: MeshIndex
    seen: np.ndarray
    textured: np.ndarray
    views: np.ndarray
    slant: np.ndarray
    footprint: float


def deviations(gray: np.ndarray) -> np.ndarray:
    """Standard deviations (H, W) of the grey values in the window around each pixel of an image (H, W)."""
    gray = gray.astype(np.float64)
    mean = uniform_filter(gray, WINDOW)
    return np.sqrt(np.maximum(uniform_filter(gray * gray, WINDOW) - mean * mean, 0))


def read_city(folder: Path) -> City:
    """A scene, the surface that its images show, and where that has texture."""
    scene, reference = read_scene(folder), folder / "truth" / "cloud.ply"
    truth = read_truth(reference, mesh_of(folder, reference), scene.cameras, print)
    index, footprint = MeshIndex(truth.surface), truth.pixel
    drawn = truth.surface.sample(min(SAMPLES, int(truth.surface.area / footprint**2)))
    shown, textured = (np.zeros(len(drawn), dtype=int) for _ in range(2))
    cosines = np.zeros((SEEN_BY, len(drawn)))  # the largest, in ascending order
    for name in scene.images:
        camera = scene.cameras[name]
        here = np.flatnonzero(sees(index, camera, drawn.points, drawn.normals))
        column, row = camera.project(drawn.points[here])[0].astype(int).T
        lines = camera.position - drawn.points[here]
        cosine = np.einsum("ni,ni->n", lines, drawn.normals[here]) / np.linalg.norm(lines, axis=1)
        cosines[:, here] = np.sort([*cosines[:, here], cosine], axis=0)[1:]
        shown[here] += 1
        textured[here] += deviations(np.asarray(Image.open(scene.folder / name).convert("L")))[row, column] > FLAT
    seen = shown >= SEEN_BY
    slant = np.degrees(np.arccos(np.clip(cosines[0, seen], 0, 1)))
    return City(folder, truth, index, drawn.points[seen], textured[seen] >= SEEN_BY, shown[seen], slant, footprint)


class CloudScore(NamedTuple):
    """Shares of a cloud's points and of the surface.

    Args:
        points: how many there are.
        precision: of the points within 1, 2 and 5 footprints of the surface.
        recall: of the seen surface with a point within 1, 2 and 5 footprints.
        textured, plain: the same of what has texture, and of what has none.
        plain_share: of the seen surface without texture.
    """

    points: int
    precision: np.ndarray
    recall: np.ndarray
    textured: np.ndarray
    plain: np.ndarray
    plain_share: float

    @property
    def wrong(self) -> float:
        """The share of the points that are nowhere near the surface."""
        return 1 - self.precision[-1]

    @property
    def empty(self) -> float:
        """The share of the seen surface without a point anywhere near."""
        return 1 - self.recall[-1]

    @property
    def fscore(self) -> np.ndarray:
        """Of precision and the recall over what was seen."""
        return 2 * self.precision * self.recall / np.maximum(self.precision + self.recall, 1e-9)


def score_cloud(city: City, points: np.ndarray) -> CloudScore:
    """A cloud in the frame of the city's cameras, against its surface."""
    limits = city.footprint * np.array([1, 2, WRONG])

    def shares(distances: np.ndarray) -> np.ndarray:
        return np.array([np.mean(distances <= limit) if len(distances) else np.nan for limit in limits])

    there, back = city.index.query(points).distances, Index(points).query(city.seen).distances
    recall = [shares(back[which]) for which in (np.ones(len(back), bool), city.textured, ~city.textured)]
    return CloudScore(len(points), shares(there), *recall, float(np.mean(~city.textured)))


class Missed(NamedTuple):
    """Of a part of the seen surface with texture: its share of that, its recall at two footprints, and its share of all
    that is missed.
    """

    share: float
    recall: float
    missed: float


def missed(city: City, points: np.ndarray) -> dict[str, Missed]:
    """Where a cloud misses surface with texture: by how many images show it, and by how slanted it is in them."""
    away = Index(points).query(city.seen).distances > 2 * city.footprint
    parts = {
        "3 images": city.views == 3,
        "4 or 5": (city.views > 3) & (city.views < 6),
        "6 or more": city.views > 5,
        "below 60 deg": city.slant < 60,
        "60 to 75": (city.slant >= 60) & (city.slant < 75),
        "above 75": city.slant >= 75,
    }
    total, lost = np.count_nonzero(city.textured), np.count_nonzero(away & city.textured)
    found = {}
    for name, part in parts.items():
        whole, here = (np.count_nonzero(part & city.textured & which) for which in (True, away))
        found[name] = Missed(whole / total, 1 - here / max(1, whole), here / max(1, lost))
    return found


class MapScore(NamedTuple):
    """Errors of all depths and normals that the maps of a workspace hold.

    Args:
        known: share of the pixels with a depth, of those that show the city.
        depth: percentiles 50, 90, 95 and 99 of the errors along the pixels' rays, in their footprints.
        normal: median angle between normals and those of the true faces in degrees.
        plain: share of the pixels that show the city in a patch without texture, of those that show it.
        plain_known: share of the pixels with a depth, of those that show the city in a patch without texture.
        plain_wrong: share of these depths that lie nowhere near the surface.
        sky_known: share of the pixels with a depth, of those whose patch shows nothing but sky.
    """

    known: float
    depth: np.ndarray
    normal: float
    plain: float
    plain_known: float
    plain_wrong: float
    sky_known: float


class Pixels(NamedTuple):
    """Of a map, each (H, W).

    Args:
        city, sky: what shows the city, and what shows nothing but sky in the window around it.
        known: what has a depth.
        plain: what has no texture around it.
        errors: of the depths, in footprints; infinite where they are beside the city.
        far: where the depth lies nowhere near the surface.
        angles: between normal and the true one, in degrees.
    """

    city: np.ndarray
    sky: np.ndarray
    known: np.ndarray
    plain: np.ndarray
    errors: np.ndarray
    far: np.ndarray
    angles: np.ndarray


def score_maps(city: City, workspace: Path) -> MapScore:
    """The maps that `mvs` leaves in its workspace, of undistorted photographs at any size, against rays through the
    mesh.
    """
    cameras = read_colmap_cameras(workspace / MAPS)
    each = [_pixels(city, camera, workspace) for camera in cameras]
    of = Pixels(*(np.concatenate([values.ravel() for values in column]) for column in zip(*each, strict=True)))
    plain = of.plain & of.city
    return MapScore(
        known=float(np.mean(of.known[of.city])),
        depth=np.percentile(of.errors[of.known], [50, 90, 95, 99], method="lower"),
        # What is nowhere near a face has no normal to be held against.
        normal=float(np.median(of.angles[of.known & of.city & ~of.far])),
        plain=_share(of.plain, of.city),
        plain_known=_share(of.known, plain),
        plain_wrong=_share(of.far, plain & of.known),
        sky_known=_share(of.known, of.sky),
    )


def _share(which: np.ndarray, among: np.ndarray) -> float:
    return float(np.mean(which[among])) if among.any() else float("nan")


def _pixels(city: City, camera: Camera, workspace: Path) -> Pixels:
    made, true, k = read_map(workspace / MAPS / camera.name), mesh_map(camera, city.index), camera.intrinsics
    with Image.open(workspace / VIEWS / camera.name / IMAGE) as image:
        plain = deviations(np.asarray(image.convert("L"))) <= FLAT
    row, column = np.nonzero(made.known)
    depth = made.depth[row, column].astype(float)
    points = world_points(camera, np.stack([column + 0.5, row + 0.5], axis=1), depth)
    far = np.zeros(made.depth.shape, dtype=bool)
    far[row, column] = city.index.query(points).distances > WRONG * depth / k.fx
    shown = true.depth > 0
    errors = np.full(shown.shape, np.inf)
    errors[shown] = np.abs(made.depth - true.depth)[shown] / (true.depth[shown] / k.fx)
    angles = np.degrees(np.arccos(np.clip(np.einsum("hwi,hwi->hw", made.normal, true.normal), -1, 1)))
    return Pixels(shown, ~maximum_filter(shown, WINDOW), made.known, plain, errors, far, angles)
