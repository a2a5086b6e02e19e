"""Alignment of a model to the world: to control points, known cameras or GPS positions; otherwise it is levelled."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any, Literal, NamedTuple

import numpy as np

from pcbench.errors import InputError, ReconstructionError
from pcbench.geometry.arrays import FloatArray
from pcbench.geometry.cameras import Camera
from pcbench.geometry.geodesy import Gps
from pcbench.geometry.transform import Similarity, fit_similarity, robust_similarity
from pcbench.plugins import Gauge
from pcbench.registration import SurveyResiduals
from pcbench.scenes import Scene
from reconstructors.sfm.control import ControlSurvey, adjust, measure
from reconstructors.sfm.level import leveling_rotation
from reconstructors.sfm.model import Refine, cameras_of, quality

Align = Literal["auto", "cameras", "control", "gps", "none"]

# Largest median position error as a share of the cameras' spread. GPS of hand-held cameras exceeds it, and is then
# useless for pose and scale.
_MAX_MISFIT_SHARE = 0.1


class AlignedModel(NamedTuple):
    """Model with the meaning of its frame, whether its unit is metres, notes, and residuals of survey points.

    `origin` is the geographic position of (0, 0, 0) of an east-north-up frame; None if the frame is another.
    """

    model: Any
    gauge: Gauge
    in_metres: bool
    notes: list[str]
    residuals: SurveyResiduals = SurveyResiduals()
    origin: Gps | None = None


def align(model: Any, scene: Scene, survey: ControlSurvey, requested: Align, refine: Refine) -> AlignedModel:
    """Align the model to control points, cameras or GPS: the first available, or as requested.

    With control points, a bundle adjustment follows in which these are fixed. A model that is aligned to none is
    levelled.

    Check points are not used for the alignment: the model is aligned to something else, and they are measured in the
    result. They are not scored after an alignment to EXIF GPS, whose frame starts at the first image.

    Raises:
        InputError: The requested data are not in the scene, or a control point lies outside its image.
        ReconstructionError: The model does not fit the requested data.
    """
    registered = cameras_of(model)
    methods: dict[str, Callable[[], tuple[Similarity, str]]] = {
        "control": lambda: _onto_control(registered, survey, scene.image_scale),
        "cameras": lambda: _onto_cameras(registered, scene.cameras),
        "gps": lambda: _onto_gps(registered, scene),
    }
    available = {
        "control": bool(survey.control),
        "cameras": bool(scene.cameras),
        "gps": len(scene.measured_positions()[0]) >= 3,
    }
    target = next((name for name in methods if available[name]), "none") if requested == "auto" else requested
    if target == "none":
        return level_model(model, _unscored_note(survey))
    if not available[target]:
        requirement = {"gps": "three positions", "control": "control points besides check points"}.get(target, target)
        raise InputError(f"align={target} needs {requirement} in the scene")
    try:
        transform, note = methods[target]()
    except InputError as error:
        if requested != "auto":
            raise ReconstructionError(f"cannot be aligned to {target}: {error}") from error
        return level_model(model, [f"warning: not aligned to {target}: {error}", *_unscored_note(survey)])
    _transform(model, transform)
    notes = [note]
    if target == "control":
        model = adjust(model, survey.control, scene.image_scale, refine)
        notes.append(f"adjusted with fixed control points; {quality(model)}")
    origin = {"gps": scene.gps_origin, "cameras": scene.origin}.get(target)
    in_metres = target == "gps" or origin is not None
    if target == "gps" and not scene.positions:
        notes += _unscored_note(survey)
        return AlignedModel(model, "georeferenced", in_metres, notes, origin=origin)
    residuals = survey.residuals(cameras_of(model), scene.image_scale)
    return AlignedModel(model, "georeferenced", in_metres, notes, residuals, origin)


def level_model(model: Any, notes: Sequence[str]) -> AlignedModel:
    """Rotate a model in an arbitrary gauge so that +z is up, if its cameras show the up direction."""
    rotation, note = leveling_rotation(cameras_of(model))
    if rotation is not None:
        _transform(model, rotation)
    return AlignedModel(model, "arbitrary", False, [*notes, note])


def _unscored_note(survey: ControlSurvey) -> list[str]:
    """Return a note on control and check points if the cloud is not in their frame."""
    if not survey.points:
        return []
    return ["control and check points are not scored: the cloud is not in their frame"]


def transform_camera(camera: Camera, transform: Similarity) -> Camera:
    """Return the same camera after `transform` of the world."""
    rotation = camera.cam_from_world.rotation @ transform.rotation.T
    position = transform.apply(camera.position[None])[0]
    return Camera(camera.name, camera.intrinsics, Similarity(rotation, -rotation @ position))


def camera_errors(cameras: Mapping[str, Camera], truth: Mapping[str, Camera]) -> tuple[FloatArray, FloatArray]:
    """Compute camera errors for the images in both sets, in the order of their names.

    Returns:
        Distances between the centres, in the unit of the truth, and angles between the orientations, in degrees.
    """
    positions, angles = [], []
    for name in sorted(set(cameras) & set(truth)):
        a, b = cameras[name], truth[name]
        positions.append(float(np.linalg.norm(a.position - b.position)))
        relative_rotation = a.cam_from_world.rotation @ b.cam_from_world.rotation.T
        # The sine is exact for small angles, where the cosine is flat.
        sine = (
            np.linalg.norm(
                [
                    relative_rotation[2, 1] - relative_rotation[1, 2],
                    relative_rotation[0, 2] - relative_rotation[2, 0],
                    relative_rotation[1, 0] - relative_rotation[0, 1],
                ]
            )
            / 2
        )
        angles.append(float(np.degrees(np.arctan2(sine, (np.trace(relative_rotation) - 1) / 2))))
    return np.array(positions), np.array(angles)


def _onto_control(solved_cameras: Mapping[str, Camera], survey: ControlSurvey, scale: float) -> tuple[Similarity, str]:
    """Align to the control points that two or more registered images observe, without check points."""
    measured_points = measure(solved_cameras, survey.control, scale)
    if len(measured_points) < 3:
        raise InputError(
            "expected three control points, check points excluded, each in two registered images, got"
            f" {len(measured_points)}"
        )
    surveyed = np.stack([m.point.position for m in measured_points])
    fit = fit_similarity(np.stack([m.estimated_position for m in measured_points]), surveyed)
    errors = fit.apply(np.stack([m.estimated_position for m in measured_points])) - surveyed
    rmse = float(np.sqrt(np.square(errors).sum(axis=1).mean()))
    return fit, f"aligned to {len(measured_points)} control points: RMSE 3D {rmse:.3g} before the adjustment"


def _onto_cameras(solved_cameras: Mapping[str, Camera], given_cameras: Mapping[str, Camera]) -> tuple[Similarity, str]:
    names = sorted(set(solved_cameras) & set(given_cameras))
    candidate = np.array([solved_cameras[name].position for name in names]).reshape(-1, 3)
    reference = np.array([given_cameras[name].position for name in names]).reshape(-1, 3)
    fit = robust_similarity(candidate, reference)
    positions, angles = camera_errors(
        {name: transform_camera(camera, fit) for name, camera in solved_cameras.items()}, given_cameras
    )
    _check_fit(positions, reference)
    return fit, (
        f"aligned to {len(names)} cameras: position errors {np.median(positions):.3g} (median), {positions.max():.3g}"
        f" (largest); rotation errors {np.median(angles):.3g} and {angles.max():.3g} degrees"
    )


def _onto_gps(solved_cameras: Mapping[str, Camera], scene: Scene) -> tuple[Similarity, str]:
    measured, frame = scene.measured_positions()
    names = sorted(set(solved_cameras) & set(measured))
    candidate = np.array([solved_cameras[name].position for name in names]).reshape(-1, 3)
    reference = np.array([measured[name] for name in names]).reshape(-1, 3)
    fit = robust_similarity(candidate, reference)
    errors = fit.apply(candidate) - reference
    _check_fit(np.linalg.norm(errors, axis=1), reference)
    across, up = np.median(np.linalg.norm(errors[:, :2], axis=1)), np.median(np.abs(errors[:, 2]))
    return fit, (
        f"aligned to the GPS of {len(names)} images, {frame}: median error {across:.2f} m across, {up:.2f} m in height"
    )


def _check_fit(errors: FloatArray, positions: FloatArray) -> None:
    """Raise InputError if solved cameras are so far from known positions (N, 3) that either must be wrong."""
    spread = float(np.sqrt(np.square(positions - positions.mean(axis=0)).sum(axis=1).mean()))
    error = float(np.median(errors))
    if error > _MAX_MISFIT_SHARE * spread:
        raise InputError(
            f"the median error of the solved positions is {error:.3g}, the known positions spread over {spread:.3g}:"
            " the solution or the known positions are wrong"
        )


def _transform(model: Any, transform: Similarity) -> None:
    import pycolmap

    rotation = pycolmap.Rotation3d(transform.rotation)
    model.transform(pycolmap.Sim3d(transform.scale, rotation, transform.translation))
