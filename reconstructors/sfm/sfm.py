"""Sparse structure from motion by COLMAP, through pycolmap (Schonberger and Frahm 2016; Pan et al. 2024, global).

The same input gives the same cloud: images get their numbers in the order of their names, pairs are listed, every
random choice has a seed, and what is not associative in floating point, or not safe in COLMAP, runs on one thread.
"""

from __future__ import annotations

import shutil
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

from pcbench.errors import InputError, ReconstructionError
from pcbench.extras import unavailable
from pcbench.plugins import Reconstruction
from pcbench.scenes import Scene
from reconstructors.sfm.alignment import Align, Aligned, align, levelled
from reconstructors.sfm.control import ControlSurvey, check_names, read_control
from reconstructors.sfm.epipolar import check_cameras, repeated, write_pairs
from reconstructors.sfm.features import (
    DATABASE,
    MIN_FEATURES,
    check_features,
    count_features,
    extract_features,
    some,
    working_images,
)
from reconstructors.sfm.images import readable
from reconstructors.sfm.mapping import Mapper, triangulate
from reconstructors.sfm.matches import check_verified, match_pairs, verify_matches
from reconstructors.sfm.model import Refine, cameras_of, check_written, cloud_of, largest_angle_deg, quality
from reconstructors.sfm.pairs import Matching, choose_pairs
from reconstructors.sfm.solve import solve

PAIRS = "pairs.csv"  # in the workspace
_MAX_PARALLEL_DEG = 12.0  # of a survey's images from their mean direction: a flight is unsteady by a few


@dataclass(frozen=True)
class ColmapSfm:
    """Sparse points and cameras by COLMAP: SIFT, verified matches, incremental or global mapping; triangulation alone
    where the cameras are given.

    poses: `given` takes the scene's cameras as they are, `solve` finds them; `auto` is given where there are some.
    mapping: of solved poses; up to 30 images are solved in both ways, and it is said where these differ. Where strong
    pairs contradict the cameras, places that look alike were taken for one: they are solved again without such pairs,
    and if several still contradict it is said, and the gauge is arbitrary.
    matching: which pairs; `auto` by the number of images and what is known of them.
    features: SIFT features an image, at most. upsample: find them at twice the size too: finer and more, three times
    the time. refine: which intrinsics are solved for: `all`, `focal` length, `distortion`, or `none`; the rest stays as
    the scene's cameras say, or as guessed (1.2 image widths, no distortion) where EXIF has no focal length.
    align: solved poses onto control points, the scene's cameras or GPS; `auto` takes the first there is. What is
    aligned to none of these is levelled: +z is up by the cameras, where they tell it, and origin and scale stay.
    control: a file with lines of name, x y z, image, pixel x y; control points are held fast in a last adjustment.
    Points whose names end in * are check points: they are measured in the result and never used for it, and the RMSE of
    both kinds is given. min_views: points that fewer images show are left out; one of two images may be anywhere along
    their common plane. undistort: leave undistorted images and model in the workspace.
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
            raise ValueError(f"expected at least {MIN_FEATURES} features an image, got {self.features}")
        if self.min_views < 2:
            raise ValueError(f"expected points of at least 2 images, got min_views={self.min_views}")
        if not 0 <= self.seed < 2**31:
            raise ValueError(f"expected a seed from 0 to 2^31 - 1, got {self.seed}")
        if self.align == "control" and self.control is None:
            raise ValueError("align=control needs control=FILE")

    @classmethod
    def missing(cls) -> str | None:
        return unavailable("pycolmap", "PIL")

    def reconstruct(self, scene: Scene, workspace: Path) -> Reconstruction:
        import pycolmap

        pycolmap.logging.minloglevel = pycolmap.logging.Level.WARNING.value
        survey = read_control(self.control) if self.control is not None else ControlSurvey()
        given = self.poses == "given" or (self.poses == "auto" and bool(scene.cameras))
        unknown = check_names(survey, scene.images)
        scene, notes = _usable(scene, given, survey)
        notes += unknown
        scene, unreadable = readable(scene, workspace)
        notes += unreadable

        features = extract_features(scene, workspace, self.features, upsample=self.upsample)
        counts = count_features(features)
        notes += check_features(counts, scene)

        how, pairs = choose_pairs(scene, self.matching)
        notes.append(f"{how} matching, {len(pairs)} pairs")
        matches = match_pairs(features, pairs, workspace)
        verified = verify_matches(matches, scene, workspace, self.seed)
        check_verified(verified, counts)

        if given:
            made = self._triangulated(verified, scene, workspace, survey)
        else:
            made = self._solved(verified, scene, workspace, survey)
        _write(made.model, workspace / "model")
        if self.undistort:
            _undistort(workspace, working_images(scene, workspace))
        cloud, left_out = cloud_of(made.model, self.min_views, "m" if made.in_metres else None)
        cameras, said = cameras_of(made.model), [*notes, *made.notes, *left_out]
        return Reconstruction(cloud, made.gauge, cameras, said, made.residuals)

    def _triangulated(self, verified: Path, scene: Scene, workspace: Path, survey: ControlSurvey) -> Aligned:
        """The points of the given cameras, in their frame."""
        import pycolmap

        found = check_cameras(verified / DATABASE, scene.cameras)
        write_pairs(workspace / PAIRS, found)
        model = pycolmap.Reconstruction(triangulate(verified, scene, workspace, self.seed) / "0")
        notes = [f"{found.describe('given')}; {quality(model)}", *repeated(found, "given")]
        residuals = survey.residuals(scene.cameras, scene.image_scale)
        return Aligned(model, "georeferenced", scene.origin is not None, notes, residuals)

    def _solved(self, verified: Path, scene: Scene, workspace: Path, survey: ControlSurvey) -> Aligned:
        """Cameras and points of the largest component, in the world where one is known."""
        solution = solve(verified, scene, workspace, self.mapping, self.refine, self.seed)
        write_pairs(workspace / PAIRS, solution.agreement)
        model, notes = solution.model, [*solution.notes, quality(solution.model)]
        if self.refine != "none":
            notes += _parallel(largest_angle_deg(solution.cameras))
        if not solution.agreement.is_sound:
            return levelled(model, [*notes, *self._not_aligned()])
        aligned = align(model, scene, survey, self.align, self.refine)
        return aligned._replace(notes=[*notes, *aligned.notes])

    def _not_aligned(self) -> list[str]:
        """What is said of a solution that cannot be believed.

        Raises:
            ReconstructionError: it was to be aligned to something.
        """
        if self.align in ("auto", "none"):
            return [] if self.align == "none" else ["not aligned to the world: its gauge is arbitrary"]
        raise ReconstructionError(
            f"cannot be aligned to {self.align}: places that look alike are taken for one (align=none shows it)"
        )


def _usable(scene: Scene, given: bool, survey: ControlSurvey) -> tuple[Scene, list[str]]:
    """The images that can take part, and a note on those that cannot.

    Raises:
        InputError: they are fewer than two, or `given` asks for cameras where there are none, or where control points
            are to be used: given cameras can only be scored by check points.
    """
    if given and survey.control:
        raise InputError("the scene gives the cameras: control points are used where they are solved for (poses=solve)")
    notes = []
    if given:
        if not scene.cameras:
            raise InputError("poses=given needs cameras in the scene: a COLMAP model, transforms.json or the like")
        if bare := [name for name in scene.images if name not in scene.cameras]:
            notes.append(f"{len(bare)} of {len(scene)} images without a camera are left out: {some(bare)}")
            scene = scene.select(set(scene.cameras))
    if len(scene) < 2:
        raise InputError(f"expected at least two images, got {len(scene)}")
    return scene, notes


def _parallel(angle_deg: float) -> Iterator[str]:
    """A note where the images all look the same way: focal length and heights can then change together (James and
    Robson 2014).
    """
    if angle_deg < _MAX_PARALLEL_DEG:
        yield (
            f"all images look the same way within {angle_deg:.0f} degrees: they hardly constrain the intrinsics, and"
            " with wrong ones the cloud is stretched or bent; add oblique images or control points, or give the"
            " intrinsics (--set refine=none)"
        )


def _write(model: Any, folder: Path) -> None:
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir()
    model.write(folder)
    check_written(folder)


def _undistort(workspace: Path, images: Path) -> None:
    """`undistorted/images` and `undistorted/sparse`: pinholes, as dense methods want them."""
    import pycolmap

    shutil.rmtree(workspace / "undistorted", ignore_errors=True)
    pycolmap.undistort_images(workspace / "undistorted", workspace / "model", images)
