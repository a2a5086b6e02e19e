"""Registration as the evaluation of Tanks and Temples does it (Knapitsch et al. 2017): by trajectories, then by ICP.

1. RANSAC over camera centres of the same images finds the similarity from the candidate's reconstruction to the scan.
2. Three runs of point-to-point ICP with scale refine it, on clouds that are cropped to the scene's volume: voxel means
   of side tau with correspondences up to 80 tau, of side tau / 2 up to 20 tau, and all points up to 2 tau. tau is the
   distance threshold of the scene.

The numbers are those of the official program, which runs them with Open3D. Its random samples differ from run to run;
these are seeded.
"""

from __future__ import annotations

import math
import warnings
from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar, NamedTuple

import numpy as np
from numpy.typing import NDArray

from pcbench.errors import InputError, RegistrationError
from pcbench.geometry.arrays import FloatArray, IntArray
from pcbench.geometry.neighbors import Index
from pcbench.geometry.regions import Region
from pcbench.geometry.transform import Similarity, fit_similarity
from pcbench.geometry.voxels import open3d_voxel_means
from pcbench.io.files import Warn
from pcbench.io.tanks_and_temples import TntScene
from pcbench.io.trajectory import Trajectory, read_trajectory
from pcbench.registration.given import absolute_text, method_files

_SAMPLE_SIZE = 6  # camera centres per sample of RANSAC
_INLIER_DISTANCE = 0.2  # metres, between aligned camera centres
_MAX_SAMPLES, _CONFIDENCE = 100_000, 0.999
_BATCH_SIZE, _BATCH_PAIRS = 512, 1 << 20  # samples evaluated at a time, and these times camera centres
_MIN_SINGULAR_RATIO = 1e-9  # of the covariance of samples that determine a rotation
_VIDEO_LENGTH = 1600  # poses above which a trajectory has one for each frame of the video
# Runs of ICP: the side of voxels (None: no voxels) and the largest distance of correspondences, in thresholds.
_REFINEMENTS = ((1.0, 80.0), (0.5, 20.0), (None, 2.0))
_MAX_POINTS = 4_000_000  # without voxels, every n-th point of larger clouds is used
# The official program asks for 20 iterations, but passes this number as the bound of the change of the RMSE. Open3D's
# default of 30 iterations therefore applies, and ICP stops when the share of correspondences changes by less than this.
_MAX_ITERATIONS, _MIN_CHANGE = 30, 1e-6


@dataclass(frozen=True, eq=False)
class TrajectorySettings:
    """Registration method: the trajectory of the candidate's cameras, then ICP, as in Tanks and Temples.

    Attributes:
        candidate_centers: (N, 3) camera centres in candidate coordinates.
        reference_centers: (N, 3) centres of the same cameras in reference coordinates.
        threshold: distance threshold of the scene, in the reference's unit (metres).
        volume: region of the reference to which both clouds are cropped; None: all points.
        seed: seed of the random samples.
        text: method text for reports, with absolute paths.

    Raises:
        InputError: the arrays are not pairs of finite points, there are fewer than six, or the threshold is not
            positive.
    """

    candidate_centers: FloatArray
    reference_centers: FloatArray
    threshold: float
    volume: Region | None = None
    seed: int = 0
    text: str = "tnt"

    with_scale: ClassVar[bool] = True

    def __post_init__(self) -> None:
        pairs = [np.asarray(centers, np.float64) for centers in (self.candidate_centers, self.reference_centers)]
        if pairs[0].shape != pairs[1].shape or pairs[0].ndim != 2 or pairs[0].shape[1] != 3:
            raise InputError(f"expected pairs of camera centres (N, 3), got {pairs[0].shape} and {pairs[1].shape}")
        if not all(np.isfinite(centers).all() for centers in pairs):
            raise InputError("expected finite camera centres, got NaN or Inf")
        if len(pairs[0]) < _SAMPLE_SIZE:
            raise InputError(
                f"expected at least {_SAMPLE_SIZE} images with a pose in both trajectories, got {len(pairs[0])}"
            )
        if not 0 < self.threshold < np.inf:
            raise InputError(f"expected a positive threshold, got {self.threshold:g}")
        object.__setattr__(self, "candidate_centers", pairs[0])
        object.__setattr__(self, "reference_centers", pairs[1])

    @property
    def files(self) -> tuple[Path, ...]:
        """Trajectory and folder of the scene from the command line."""
        return method_files(self.text)

    @classmethod
    def read(cls, names: str) -> TrajectorySettings:
        """Read the files of the method `tnt:TRAJECTORY,SCENE` or `tnt:TRAJECTORY,SCENE,THRESHOLD`.

        Args:
            names: the candidate's trajectory (a `.log` file, or the folder of a COLMAP model), the folder of the scene,
                and its threshold, if it is none of the official scenes.

        Raises:
            InputError: the text has another form, or a file is missing or unusable.
        """
        parts = [part.strip() for part in names.split(",")]
        if len(parts) not in (2, 3) or not all(parts):
            raise InputError(f"expected tnt:TRAJECTORY,SCENE or tnt:TRAJECTORY,SCENE,THRESHOLD, got 'tnt:{names}'")
        path, scene = Path(parts[0]), TntScene.of_folder(Path(parts[1]))
        try:
            threshold = float(parts[2]) if len(parts) == 3 else scene.threshold
        except ValueError as error:
            if isinstance(error, InputError):
                raise InputError(f"{error} (tnt:TRAJECTORY,SCENE,THRESHOLD)") from None
            raise InputError(f"expected the threshold as a number of metres, got {parts[2]!r}") from None
        return cls.of_scene(path, scene, threshold, warnings.warn, text=absolute_text(f"tnt:{names}"))

    @classmethod
    def of_scene(
        cls,
        trajectory: Path,
        scene: TntScene,
        threshold: float,
        on_warning: Warn,
        *,
        volume: Region | None = None,
        seed: int = 0,
        text: str = "tnt",
    ) -> TrajectorySettings:
        """Pair the images of a trajectory with those of a scene's reference reconstruction.

        Args:
            trajectory: the candidate's: a `.log` file, or the folder of a COLMAP model.
            scene: files of the scene.
            threshold: its distance threshold.
            on_warning: callback, called with one line per warning.
            volume: region for cropping; None: that of the scene.
            seed: seed of the random samples.
            text: method text for reports.

        Raises:
            InputError: a file is missing or unusable, or fewer than six images are in both trajectories.
        """
        estimated, reference = read_trajectory(trajectory, on_warning), scene.trajectory(on_warning)
        frames = scene.video_frames() if estimated.length > _VIDEO_LENGTH else None
        rows, columns = _pair(estimated, reference, frames)
        if len(rows) < _SAMPLE_SIZE:
            raise InputError(
                f"{trajectory}: expected at least {_SAMPLE_SIZE} images that also have a pose in"
                f" {scene.path('_COLMAP_SfM.log').name}, got {len(rows)}: images are paired by their numbers"
            )
        return cls(
            estimated.centers[rows],
            scene.scan_from_sfm().apply(reference.centers[columns]),
            threshold,
            scene.crop_volume() if volume is None else volume,
            seed,
            text,
        )


class TrajectoryFit(NamedTuple):
    """Pose of a candidate, and how it was computed.

    Attributes:
        T_reference_candidate: the pose.
        inliers: number of camera centres that agree on the first pose.
        images: number of camera centres.
        iterations: number of iterations of the three runs of ICP.
        converged: whether the last run ended before its largest number of iterations.
    """

    T_reference_candidate: Similarity
    inliers: int
    images: int
    iterations: int
    converged: bool


class _Refinement(NamedTuple):
    pose: Similarity
    iterations: int
    converged: bool


def align_by_trajectory(reference: FloatArray, candidate: FloatArray, settings: TrajectorySettings) -> TrajectoryFit:
    """Register candidate points (N, 3) to reference points (M, 3).

    Raises:
        RegistrationError: the trajectories do not agree, or a cloud has no points in the volume near the other.
    """
    pose, inliers = align_trajectories(settings.candidate_centers, settings.reference_centers, settings.seed)
    refined = refine_pose(pose, reference, candidate, settings.threshold, settings.volume)
    return TrajectoryFit(refined.pose, inliers, len(settings.candidate_centers), refined.iterations, refined.converged)


def align_trajectories(candidate: FloatArray, reference: FloatArray, seed: int = 0) -> tuple[Similarity, int]:
    """Fit the similarity between paired camera centres (N, 3) by RANSAC (Fischler & Bolles 1981), N >= 6.

    Returns:
        The similarity of the sample on which most centres agree within 0.2 m, and their number.

    Raises:
        RegistrationError: no sample has six centres that agree.
    """
    rng, count = np.random.default_rng(seed), len(candidate)
    best, inliers, smallest_error = np.empty(0, np.int64), 0, np.inf
    batch, drawn, needed = min(_BATCH_SIZE, 1 + _BATCH_PAIRS // count), 0, _MAX_SAMPLES
    while drawn < needed:
        samples = rng.integers(0, count, (min(batch, _MAX_SAMPLES - drawn), _SAMPLE_SIZE))
        drawn += len(samples)
        linear, shifts, is_determined = _fit_samples(candidate[samples], reference[samples])
        moved = np.einsum("sij,nj->sni", linear, candidate) + shifts[:, None]
        squares = np.square(moved - reference).sum(axis=2)
        near = (squares < _INLIER_DISTANCE**2) & is_determined[:, None]
        counts = near.sum(axis=1)
        errors = np.where(near, squares, 0).sum(axis=1) / np.maximum(counts, 1)
        first = int(np.lexsort((errors, -counts))[0])
        if (counts[first], -errors[first]) > (inliers, -smallest_error):
            best, inliers, smallest_error = samples[first], int(counts[first]), float(errors[first])
            needed = min(_MAX_SAMPLES, _samples_needed(inliers / count))
    if inliers < _SAMPLE_SIZE:
        raise RegistrationError(
            f"the trajectories do not agree: at most {inliers} of {count} camera centres are within"
            f" {_INLIER_DISTANCE:g} m after a similarity; check that both have the same images in the same order, and"
            " that the centres do not lie on one line"
        )
    return fit_similarity(candidate[best], reference[best]), inliers


def refine_pose(
    pose: Similarity, reference: FloatArray, candidate: FloatArray, threshold: float, volume: Region | None
) -> _Refinement:
    """Refine a pose candidate -> reference by the three runs of ICP.

    Args:
        pose: initial pose.
        reference: (M, 3) points.
        candidate: (N, 3) points in their own coordinates.
        threshold: distance threshold of the scene.
        volume: region to which both clouds are cropped before each run; None: all points.

    Raises:
        RegistrationError: a cloud has no points in the volume, or too few are near the other cloud.
    """
    target, total, converged = _crop(reference, volume, "reference"), 0, False
    for side, reach in _REFINEMENTS:
        source = _crop(pose.apply(candidate), volume, "candidate")
        cell = None if side is None else side * threshold
        run = _icp(Index(_downsample(target, cell)), Index(_downsample(source, cell)), reach * threshold)
        pose, total, converged = run.pose @ pose, total + run.iterations, run.converged
    return _Refinement(pose, total, converged)


def _icp(target: Index, source: Index, max_distance: float) -> _Refinement:
    """Run point-to-point ICP with scale from the identity, as Open3D's `registration_icp`."""
    pose, share, hint = Similarity.identity(), -1.0, None
    for iteration in range(_MAX_ITERATIONS + 1):
        moved, matches = target.nearest_of_moved(source, pose.matrix, hint)
        near, hint = matches.distances < max_distance, matches.indices
        share, before = float(near.mean()), share
        if abs(share - before) < _MIN_CHANGE:
            return _Refinement(pose, iteration, True)
        if iteration < _MAX_ITERATIONS:
            try:
                pose = fit_similarity(moved[near], target.points[matches.indices[near]]) @ pose
            except InputError:
                raise RegistrationError(
                    f"the candidate is not near the reference: only {np.count_nonzero(near)} of {len(source):,} points"
                    f" have a correspondence within {max_distance:g}; check the trajectory, the scene and the threshold"
                ) from None
    return _Refinement(pose, _MAX_ITERATIONS, False)


def _crop(points: FloatArray, volume: Region | None, name: str) -> FloatArray:
    inside = points if volume is None else points[volume.contains(points)]
    if not len(inside):
        raise RegistrationError(
            f"no point of the {name} is in the crop volume when the candidate is in its initial pose: check the"
            " trajectory, the scene and its files"
        )
    return inside


def _downsample(points: FloatArray, side: float | None) -> FloatArray:
    if side is not None:
        return open3d_voxel_means(points, side)
    return points[:: max(1, round(len(points) / _MAX_POINTS))]


def _samples_needed(share: float) -> int:
    """Return the number of samples of which one has only inliers with the confidence."""
    all_inliers = share**_SAMPLE_SIZE
    if all_inliers >= 1:
        return 1
    return math.ceil(math.log(1 - _CONFIDENCE) / math.log1p(-all_inliers)) if all_inliers > 1e-12 else _MAX_SAMPLES


def _fit_samples(candidate: FloatArray, reference: FloatArray) -> tuple[FloatArray, FloatArray, NDArray[np.bool_]]:
    """Fit similarities to S samples (S, K, 3) at once (Umeyama 1991, see `fit_similarity`).

    Returns:
        Linear parts (S, 3, 3), translations (S, 3), and whether a sample determines the rotation (S,): one on a line,
        or with two distinct points, does not.
    """
    mean_c, mean_r = candidate.mean(axis=1), reference.mean(axis=1)
    c, r = candidate - mean_c[:, None], reference - mean_r[:, None]
    u, singular, vt = np.linalg.svd(np.einsum("ski,skj->sij", r, c))
    signs = np.ones_like(singular)
    signs[:, 2] = np.sign(np.linalg.det(u @ vt))
    spread = np.maximum(np.square(c).sum(axis=(1, 2)), np.finfo(float).tiny)
    scale = (singular * signs).sum(axis=1) / spread
    linear: FloatArray = scale[:, None, None] * ((u * signs[:, None]) @ vt)
    shifts: FloatArray = mean_r - np.einsum("sij,sj->si", linear, mean_c)
    return linear, shifts, singular[:, 1] > _MIN_SINGULAR_RATIO * singular[:, 0]


def _pair(estimated: Trajectory, reference: Trajectory, frames: IntArray | None) -> tuple[IntArray, IntArray]:
    """Return the rows of the images that are in both trajectories.

    Args:
        estimated: trajectory of the candidate. With as many images as the reference's, both are in the same order.
            Otherwise the numbers of the images decide.
        reference: trajectory of the reference reconstruction.
        frames: places of its images in the estimated trajectory, if that has one for each frame of a video.

    Raises:
        InputError: an image is in a trajectory twice.
    """
    if frames is not None:
        inside = np.flatnonzero(reference.places < len(frames))
        _, rows, columns = np.intersect1d(estimated.places, frames[reference.places[inside]], return_indices=True)
        return rows, inside[columns]
    by_place = estimated.length == reference.length
    keys = [each.places if by_place else each.numbers for each in (estimated, reference)]
    for key in keys:
        numbers, counts = np.unique(key, return_counts=True)
        if (counts > 1).any():
            raise InputError(f"expected each image once in a trajectory, got image {numbers[counts > 1][0]} twice")
    _, rows, columns = np.intersect1d(keys[0], keys[1], return_indices=True)
    return rows, columns
