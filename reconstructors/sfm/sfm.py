"""Sparse structure from motion by COLMAP, through pycolmap (Schonberger and Frahm 2016; Pan et al. 2024, global).

The same input gives the same cloud: images get ids in the order of their names, pairs are listed explicitly, all random
choices are seeded, and code that is not associative in floating point, or not thread-safe in COLMAP, uses one thread.
"""

from __future__ import annotations

import shutil
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

from pcbench.errors import InputError, ReconstructionError
from pcbench.extras import import_problem
from pcbench.plugins import Reconstruction
from pcbench.scenes import Scene
from pcbench.scenes.scene import first_names
from reconstructors.sfm.alignment import Align, AlignedModel, align, level_model
from reconstructors.sfm.control import ControlSurvey, check_names, read_control
from reconstructors.sfm.epipolar import ambiguity_warning, check_cameras, write_pairs
from reconstructors.sfm.features import (
    DATABASE,
    MIN_FEATURES,
    check_features,
    count_features,
    describe_stretched,
    extract_features,
    working_images,
)
from reconstructors.sfm.images import drop_unreadable
from reconstructors.sfm.log import log_without_files
from reconstructors.sfm.mapping import Mapper, triangulate
from reconstructors.sfm.matches import check_verified, match_pairs, verify_matches
from reconstructors.sfm.model import Refine, cameras_of, check_written, cloud_of, largest_angle_deg, quality
from reconstructors.sfm.pairs import Matching, choose_pairs
from reconstructors.sfm.solve import solve

PAIRS_FILE = "pairs.csv"  # in the workspace
_MAX_PARALLEL_DEG = 12.0  # angle of a survey's views to their mean direction: flights deviate by a few degrees


@dataclass(frozen=True)
class ColmapSfm:
    """Sparse points and cameras by COLMAP: SIFT, verified matches, incremental or global mapping.

    If the cameras are given, points are only triangulated.

    poses: `given` uses the scene's cameras unchanged, `solve` solves for them; `auto` is `given` if there are cameras.
    mapping: method for solved poses. Up to 30 images are solved by both methods, and differences are reported. If
    strong pairs contradict the cameras, places that look alike were confused: the cameras are solved again without such
    pairs. If several pairs still contradict them, this is reported, and the gauge is arbitrary.
    matching: image pairs to match; `auto` decides by the number of images and their known positions.
    features: maximum number of SIFT features per image.
    upsample: detect features at twice the image size too: finer and more features, in three times the time.
    refine: intrinsics to solve for: `all`, `focal` length, `distortion`, or `none`. The others stay as in the scene's
    cameras, or as guessed (1.2 image widths, no distortion) if EXIF has no focal length.
    align: what solved poses are aligned to: control points, the scene's cameras or GPS; `auto` uses the first that is
    available. A model aligned to none is levelled: +z is up if the cameras show the up direction; origin and scale stay
    arbitrary.
    control: a file with lines of name, x y z, image, pixel x y; control points are fixed in a last adjustment. Points
    whose names end in * are check points: they are measured in the result and never used for it. The RMSE of both kinds
    is reported.
    min_views: minimum number of images per point; a point of two images may lie anywhere along their common plane.
    undistort: write undistorted images and model to the workspace.
    """

    poses: Literal["auto", "given", "solve"] = "auto"
    mapping: Mapper = "incremental"
    matching: Matching = "auto"
    features: int = 8192
    upsample: bool = True
    refine: Refine = "all"
    align: Align = "auto"
    control: Path | None = None
    min_views: int = 3
    undistort: bool = False
    seed: int = 0

    def __post_init__(self) -> None:
        if self.features < MIN_FEATURES:
            raise ValueError(f"expected at least {MIN_FEATURES} features per image, got {self.features}")
        if self.min_views < 2:
            raise ValueError(f"expected min_views of at least 2 images per point, got min_views={self.min_views}")
        if not 0 <= self.seed < 2**31:
            raise ValueError(f"expected a seed from 0 to 2^31 - 1, got {self.seed}")
        if self.align == "control" and self.control is None:
            raise ValueError("expected control=FILE with align=control")

    @classmethod
    def missing(cls) -> str | None:
        """Return what keeps the plugin from running on this machine, if anything."""
        return import_problem("pycolmap", "PIL")

    def reconstruct(self, scene: Scene, workspace: Path) -> Reconstruction:
        """Reconstruct sparse points and cameras from a scene.

        Args:
            scene: Images with known cameras, positions and masks, if any.
            workspace: Folder for stages and the model.
        """
        log_without_files()
        survey = read_control(self.control) if self.control is not None else ControlSurvey()
        keeps_cameras = self.poses == "given" or (self.poses == "auto" and bool(scene.cameras))
        unknown_marks = check_names(survey, scene.images)
        scene, notes = _usable_images(scene, keeps_cameras, survey)
        notes += unknown_marks
        scene, unreadable = drop_unreadable(scene, workspace)
        notes += unreadable

        features = extract_features(scene, workspace, self.features, upsample=self.upsample)
        counts = count_features(features)
        notes += [*describe_stretched(features), *check_features(counts, scene)]

        matching, pairs = choose_pairs(scene, self.matching)
        notes.append(f"{matching} matching, {len(pairs)} pairs")
        if scene.with_alpha:
            notes.append(
                f"{len(scene.with_alpha)} of {len(scene)} images have an alpha channel: transparent pixels have no"
                " features"
            )
        matches = match_pairs(features, pairs, workspace)
        verified = verify_matches(matches, scene, workspace, self.seed)
        check_verified(verified, counts)

        if keeps_cameras:
            aligned = self._triangulate_given(verified, scene, workspace, survey)
        else:
            aligned = self._solve_cameras(verified, scene, workspace, survey)
        _write_model(aligned.model, workspace / "model")
        if self.undistort:
            _undistort(workspace, working_images(scene, workspace))
        cloud, left_out = cloud_of(aligned.model, self.min_views, "m" if aligned.in_metres else None)
        cameras, notes_of_run = cameras_of(aligned.model), [*notes, *aligned.notes, *left_out]
        return Reconstruction(cloud, aligned.gauge, cameras, notes_of_run, aligned.residuals, aligned.origin)

    def _triangulate_given(self, verified: Path, scene: Scene, workspace: Path, survey: ControlSurvey) -> AlignedModel:
        """Triangulate points from the given cameras, in their frame."""
        import pycolmap

        epipolar_agreement = check_cameras(verified / DATABASE, scene.cameras)
        write_pairs(workspace / PAIRS_FILE, epipolar_agreement)
        model = pycolmap.Reconstruction(triangulate(verified, scene, workspace, self.seed) / "0")
        notes = [
            f"{epipolar_agreement.describe('given')}; {quality(model)}",
            *ambiguity_warning(epipolar_agreement, "given"),
        ]
        residuals = survey.residuals(scene.cameras, scene.image_scale)
        return AlignedModel(model, "georeferenced", scene.origin is not None, notes, residuals, scene.origin)

    def _solve_cameras(self, verified: Path, scene: Scene, workspace: Path, survey: ControlSurvey) -> AlignedModel:
        """Solve for cameras and points of the largest component, and align them to the world if possible."""
        solution = solve(verified, scene, workspace, self.mapping, self.refine, self.seed)
        write_pairs(workspace / PAIRS_FILE, solution.agreement)
        model, notes = solution.model, [*solution.notes, quality(solution.model)]
        if self.refine != "none":
            notes += _parallel_views_note(largest_angle_deg(solution.cameras))
        if not solution.agreement.is_sound:
            return level_model(model, [*notes, *self._unaligned_note()])
        aligned = align(model, scene, survey, self.align, self.refine)
        return aligned._replace(notes=[*notes, *aligned.notes])

    def _unaligned_note(self) -> list[str]:
        """Return a note on a solution that is not reliable.

        Raises:
            ReconstructionError: An alignment was requested.
        """
        if self.align in ("auto", "none"):
            return [] if self.align == "none" else ["not aligned to the world: its gauge is arbitrary"]
        raise ReconstructionError(
            f"cannot be aligned to {self.align}: places that look alike were confused (inspect it with align=none)"
        )


def _usable_images(scene: Scene, keeps_cameras: bool, survey: ControlSurvey) -> tuple[Scene, list[str]]:
    """Select the images that can be used, with a note on the others.

    Args:
        scene: Images with known cameras, if any.
        keeps_cameras: Whether to use the given cameras.
        survey: Control and check points.

    Raises:
        InputError: Fewer than two images can be used, or `keeps_cameras` is set without cameras or with control
            points: given cameras can only be evaluated by check points.
    """
    if keeps_cameras and survey.control:
        raise InputError("control points need solved cameras, but the scene gives them: use poses=solve")
    notes = []
    if keeps_cameras:
        if not scene.cameras:
            raise InputError("poses=given needs cameras in the scene: a COLMAP model, transforms.json or the like")
        if without_camera := [name for name in scene.images if name not in scene.cameras]:
            names = first_names(without_camera)
            notes.append(f"{len(without_camera)} of {len(scene)} images without a camera are left out: {names}")
            scene = scene.select(set(scene.cameras))
    if len(scene) < 2:
        raise InputError(f"expected at least two images, got {len(scene)}")
    return scene, notes


def _parallel_views_note(angle_deg: float) -> Iterator[str]:
    """Yield a note if all images look in the same direction.

    Focal length and heights can then change together (James and Robson 2014).
    """
    if angle_deg < _MAX_PARALLEL_DEG:
        yield (
            f"all images look in the same direction within {angle_deg:.0f} degrees: they hardly constrain the"
            " intrinsics, and wrong intrinsics stretch or bend the cloud; add oblique images or control points, or give"
            " the intrinsics (--set refine=none)"
        )


def _write_model(model: Any, folder: Path) -> None:
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir()
    model.write(folder)
    check_written(folder)


def _undistort(workspace: Path, images: Path) -> None:
    """Write `undistorted/images` and `undistorted/sparse`: pinhole cameras, as dense methods need them."""
    import pycolmap

    shutil.rmtree(workspace / "undistorted", ignore_errors=True)
    pycolmap.undistort_images(workspace / "undistorted", workspace / "model", images)
