"""Reconstructors on real photographs with measured cameras: python benchmarks/photographs.py

fountain-P11 (Strecha et al. 2008): 11 photographs, cameras measured by laser scan. The first table solves for cameras
and compares them with the measured ones after the best similarity. The second gives the measured cameras and compares
the clouds with sparse points that five or more of the photographs show at their full size: the share of these with a
point of the cloud within one and two pixels (the median pixel of the images at the scale of the run), and the median
distance to the plane of the nearest points. `before` are points of the cloud that would hide a sparse point from a
photograph that shows it: the share, of all points in the pixel of such a sparse point, that lie more than four pixels
before it. Nothing tells which points are wrong where no sparse points are.
"""

import argparse
import os
import sys
import tempfile
from collections.abc import Mapping
from pathlib import Path
from typing import NamedTuple

import numpy as np
from measure import setting
from methods import MISSING, PEERS, Budget, reconstruct, runnable
from numpy.typing import NDArray
from real_data import data_root
from scipy.spatial import cKDTree

from pcbench.geometry.arrays import FloatArray
from pcbench.geometry.cameras import Camera
from pcbench.geometry.neighbors import Index
from pcbench.geometry.transform import fit_similarity
from pcbench.geometry.visibility import in_frame
from pcbench.plugins.run import PLUGIN, ReconstructionJob, run
from pcbench.scenes import read_scene

SOLVERS = (
    Budget("sfm", "incremental (default)", {"poses": "solve", "align": "none"}),
    Budget("sfm", "global", {"poses": "solve", "align": "none", "mapping": "global"}),
    Budget("COLMAP", "incremental, default", {"poses": "solve"}),
)
CLOUDS = (
    Budget("sfm", "default", {}),
    Budget("COLMAP", "sparse, default", {}),
    Budget("OpenCV", "SGBM of pairs", {}),
    Budget("mvs", "default", {}),
    Budget("splat", "50,000, 3,000 steps", {"density": "fixed"}),
    Budget("field", "default", {}),
)
_REFERENCE_VIEWS = 5
_PLANE_NEIGHBORS = 8
_SAME_PIXEL, _LEAST_GAP_PX = 0.7, 4.0  # a slope of 75 degrees has 2.6 pixels of depth within 0.7 pixels


class CameraErrors(NamedTuple):
    """Errors of solved cameras after the best similarity: median and largest, of positions and of rotations."""

    registered: int
    median: float
    largest: float
    median_deg: float
    largest_deg: float


def camera_errors(solved: dict[str, Camera], measured: dict[str, Camera]) -> CameraErrors:
    """Compare solved with measured cameras; positions in the unit of the measured ones."""
    names = sorted(solved)
    positions = [np.stack([cameras[name].position for name in names]) for cameras in (solved, measured)]
    similarity = fit_similarity(*positions)
    distances = np.linalg.norm(similarity.apply(positions[0]) - positions[1], axis=1)
    angles = [
        _angle_deg(solved[name].cam_from_world.rotation @ similarity.rotation.T, measured[name].cam_from_world.rotation)
        for name in names
    ]
    return CameraErrors(
        len(names), float(np.median(distances)), float(distances.max()), float(np.median(angles)), max(angles)
    )


def _angle_deg(first: FloatArray, second: FloatArray) -> float:
    """Return the angle between two rotations."""
    sine = np.linalg.norm(first - second) / np.sqrt(8)  # Frobenius norm: sqrt(8) sin(angle / 2)
    return float(np.degrees(2 * np.arcsin(min(sine, 1))))


class Reference(NamedTuple):
    """Sparse points (N, 3) that at least five full-size photographs show, and the rows that each photograph shows."""

    points: FloatArray
    shown: dict[str, NDArray[np.int64]]


def read_reference(folder: Path, workspace: Path) -> Reference:
    """Return the sparse points of the photographs at their full size, with the measured cameras."""
    import pycolmap

    job = ReconstructionJob("sfm", folder, {"poses": "given"})
    run(job, workspace).require_reconstruction()
    model = pycolmap.Reconstruction(workspace / PLUGIN / "model")
    shown: dict[str, list[int]] = {str(image.name): [] for image in model.images.values()}
    points = []
    for point in model.points3D.values():
        names = {str(model.images[element.image_id].name) for element in point.track.elements}
        if len(names) >= _REFERENCE_VIEWS:
            for name in names:
                shown[name].append(len(points))
            points.append(point.xyz)
    return Reference(np.array(points), {name: np.array(rows, np.int64) for name, rows in shown.items()})


def share_before(cloud: FloatArray, reference: Reference, cameras: Mapping[str, Camera]) -> float:
    """Return the share of the points, of those in the pixel of a sparse point, that lie before it."""
    tested = before = 0
    for name, rows in reference.shown.items():
        camera, points = cameras[name], reference.points[rows]
        rows_in_frame = np.flatnonzero(in_frame(camera, cloud))
        pixels = camera.project(cloud[rows_in_frame])[0]
        distance, nearest = cKDTree(camera.project(points)[0]).query(pixels, distance_upper_bound=_SAME_PIXEL)
        is_near = np.isfinite(distance)
        depth = camera.cam_from_world.apply(points)[nearest[is_near], 2]
        gap = depth - camera.cam_from_world.apply(cloud[rows_in_frame[is_near]])[:, 2]
        tested += len(depth)
        before += int(np.count_nonzero(gap > _LEAST_GAP_PX * depth / camera.intrinsics.fx))
    return before / tested if tested else float("nan")


def pixels_at(points: FloatArray, cameras: list[Camera]) -> FloatArray:
    """Return the size (N,) of a pixel at points: the median over the images with the point in their frames."""
    depths = np.stack([camera.cam_from_world.apply(points)[:, 2] / camera.intrinsics.fx for camera in cameras])
    visible = np.stack([in_frame(camera, points) for camera in cameras])
    return np.nanmedian(np.where(visible, depths, np.nan), axis=0)


def plane_distances(points: FloatArray, cloud: FloatArray) -> FloatArray:
    """Return the distances (N,) of points to the planes through the nearest points of a cloud."""
    nearest = cloud[Index(cloud).query(points, k=min(_PLANE_NEIGHBORS, len(cloud))).indices]
    centers = nearest.mean(axis=1)
    _, _, axes = np.linalg.svd(nearest - centers[:, None], full_matrices=False)
    return np.abs(np.einsum("ni,ni->n", points - centers, axes[:, 2]))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--image-scale", type=float, default=0.35)
    parser.add_argument("--only", choices=("cameras", "clouds"), help="one of the two tables")
    options = parser.parse_args()
    root = data_root()
    if root is None or not (root / "fountain").is_dir():
        sys.exit("missing: the folder PCBENCH_DATA with fountain")
    os.environ["OMP_NUM_THREADS"] = "1"
    folder = root / "fountain"
    measured = dict(read_scene(folder).cameras)
    print(f"{setting()}{MISSING}; fountain-P11, {len(measured)} photographs, one thread\n")
    with tempfile.TemporaryDirectory() as temporary:
        if options.only != "clouds":
            print_cameras(folder, measured, Path(temporary))
        if options.only != "cameras":
            print_clouds(folder, options.image_scale, Path(temporary))


def print_cameras(folder: Path, measured: dict[str, Camera], temporary: Path) -> None:
    """Print the errors of cameras that are solved from the photographs at their full size."""
    print(
        f"{'cameras solved':30}{'CPU s':>7}{'images':>8}{'points':>9}"
        f"{'median mm':>11}{'largest':>9}{'median deg':>12}{'largest':>9}"
    )
    for number, budget in enumerate(SOLVERS):
        plugin = PEERS.get(budget.method, budget.method)
        outcome = run(ReconstructionJob(plugin, folder, budget.settings, cameras="none"), temporary / f"solve{number}")
        result = outcome.require_reconstruction()
        errors = camera_errors(dict(result.cameras), measured)
        print(
            f"{budget.method:8}{budget.label:22}{outcome.cpu_s:7.1f}{errors.registered:8}{len(result.cloud):9,}"
            f"{1e3 * errors.median:11.2f}{1e3 * errors.largest:9.2f}{errors.median_deg:12.4f}{errors.largest_deg:9.4f}",
            flush=True,
        )
    print()


def print_clouds(folder: Path, scale: float, temporary: Path) -> None:
    """Print how well clouds with the measured cameras agree with sparse points of the full-size photographs."""
    reference = read_reference(folder, temporary / "reference")
    points = reference.points
    cameras = read_scene(folder, image_scale=scale).cameras
    pixels = pixels_at(points, list(cameras.values()))
    size = next(iter(cameras.values())).intrinsics
    print(f"{len(points):,} reference points, images of {size.width}x{size.height}")
    print(f"{'clouds':30}{'CPU s':>7}{'MiB':>7}{'points':>11}{'< 1 px':>8}{'< 2 px':>8}{'plane px':>10}{'before':>8}")
    for number, budget in enumerate(runnable(CLOUDS)):
        outcome = reconstruct(budget._replace(image_scale=scale), folder, temporary / f"cloud{number}")
        cloud = outcome.require_reconstruction().cloud.points
        distances = Index(cloud).query(points).distances / pixels
        to_planes = plane_distances(points, cloud) / pixels
        print(
            f"{budget.method:8}{budget.label:22}{outcome.cpu_s:7.1f}{(outcome.peak_rss_bytes or 0) / 2**20:7.0f}"
            f"{len(cloud):11,}{np.mean(distances < 1):8.3f}{np.mean(distances < 2):8.3f}{np.median(to_planes):10.3f}"
            f"{share_before(cloud, reference, cameras):8.3f}",
            flush=True,
        )


if __name__ == "__main__":
    main()
