"""Brings an arbitrary gauge into the world: onto control points, known cameras or GPS positions, else level."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any, Literal, NamedTuple

import numpy as np

from pcbench.errors import InputError, ReconstructionError
from pcbench.geometry.arrays import FloatArray
from pcbench.geometry.cameras import Camera
from pcbench.geometry.transform import Similarity, fit_similarity, robust_similarity
from pcbench.plugins import Gauge
from pcbench.registration import SurveyResiduals
from pcbench.scenes import Scene
from reconstructors.sfm.control import ControlSurvey, adjust, measure
from reconstructors.sfm.level import level
from reconstructors.sfm.model import Refine, cameras_of, quality

Align = Literal["auto", "cameras", "control", "gps", "none"]

_MAX_MISFIT = (
    0.1  # of the cameras' spread: GPS of hand-held cameras is as bad, and then says nothing about pose or scale
)


class Aligned(NamedTuple):
    """A model, what its coordinates mean, whether they are metres, notes on how it was brought there, and the residuals
    of control and check points in its frame.
    """

    model: Any
    gauge: Gauge
    in_metres: bool
    notes: list[str]
    residuals: SurveyResiduals = SurveyResiduals()


def align(model: Any, scene: Scene, survey: ControlSurvey, how: Align, refine: Refine) -> Aligned:
    """The model in the world of control points, cameras or GPS, in this order or as asked for. Control points are held
    fast while everything is adjusted once more. A model that is brought to none of these is levelled.

    Check points alone are no control points: the model is aligned to something else, and they are measured there. Not
    with the GPS of EXIF, whose frame begins at the first image and is no survey's.

    Raises:
        InputError: what was asked for is not in the scene, or a control point lies outside its image.
        ReconstructionError: the model does not fit what was asked for.
    """
    registered = cameras_of(model)
    ways: dict[str, Callable[[], tuple[Similarity, str]]] = {
        "control": lambda: _onto_control(registered, survey, scene.image_scale),
        "cameras": lambda: _onto_cameras(registered, scene.cameras),
        "gps": lambda: _onto_gps(registered, scene),
    }
    there = {
        "control": bool(survey.control),
        "cameras": bool(scene.cameras),
        "gps": len(scene.measured_positions()[0]) >= 3,
    }
    chosen = next((way for way in ways if there[way]), "none") if how == "auto" else how
    if chosen == "none":
        return levelled(model, _unscored(survey))
    if not there[chosen]:
        needed = {"gps": "three positions", "control": "control points that are no check points"}.get(chosen, chosen)
        raise InputError(f"align={chosen} needs {needed} in the scene")
    try:
        transform, note = ways[chosen]()
    except InputError as error:
        if how != "auto":
            raise ReconstructionError(f"cannot be aligned to {chosen}: {error}") from error
        return levelled(model, [f"not aligned to {chosen}: {error}", *_unscored(survey)])
    _transform(model, transform)
    notes = [note]
    if chosen == "control":
        model = adjust(model, survey.control, scene.image_scale, refine)
        notes.append(f"adjusted with the control points held fast; {quality(model)}")
    in_metres = chosen == "gps" or (chosen == "cameras" and scene.origin is not None)
    if chosen == "gps" and not scene.positions:
        return Aligned(model, "georeferenced", in_metres, [*notes, *_unscored(survey)])
    residuals = survey.residuals(cameras_of(model), scene.image_scale)
    return Aligned(model, "georeferenced", in_metres, notes, residuals)


def levelled(model: Any, notes: Sequence[str]) -> Aligned:
    """The model in an arbitrary gauge, turned so that +z is up where its cameras tell what is up."""
    turn, note = level(cameras_of(model))
    if turn is not None:
        _transform(model, turn)
    return Aligned(model, "arbitrary", False, [*notes, note])


def _unscored(survey: ControlSurvey) -> list[str]:
    """A note on control and check points whose frame is not that of the cloud."""
    if not survey.points:
        return []
    return ["control and check points are not scored: the cloud is not in their frame"]


def moved(camera: Camera, transform: Similarity) -> Camera:
    """The same camera in the world that `transform` leads to."""
    rotation = camera.cam_from_world.rotation @ transform.rotation.T
    position = transform.apply(camera.position[None])[0]
    return Camera(camera.name, camera.intrinsics, Similarity(rotation, -rotation @ position))


def camera_errors(cameras: Mapping[str, Camera], truth: Mapping[str, Camera]) -> tuple[FloatArray, FloatArray]:
    """Distances of the centres in the unit of the truth, and angles in degrees between the orientations, for the images
    that are in both, in the order of their names.
    """
    positions, angles = [], []
    for name in sorted(set(cameras) & set(truth)):
        a, b = cameras[name], truth[name]
        positions.append(float(np.linalg.norm(a.position - b.position)))
        turn = a.cam_from_world.rotation @ b.cam_from_world.rotation.T
        # The sine is exact for small angles, where the cosine is flat.
        sine = np.linalg.norm([turn[2, 1] - turn[1, 2], turn[0, 2] - turn[2, 0], turn[1, 0] - turn[0, 1]]) / 2
        angles.append(float(np.degrees(np.arctan2(sine, (np.trace(turn) - 1) / 2))))
    return np.array(positions), np.array(angles)


def _onto_control(found: Mapping[str, Camera], survey: ControlSurvey, scale: float) -> tuple[Similarity, str]:
    """By the control points that two or more registered images show; check points take no part."""
    used = measure(found, survey.control, scale)
    if len(used) < 3:
        raise InputError(
            f"expected three control points in two registered images each, check points aside, got {len(used)}"
        )
    surveyed = np.stack([m.point.position for m in used])
    fit = fit_similarity(np.stack([m.at for m in used]), surveyed)
    errors = fit.apply(np.stack([m.at for m in used])) - surveyed
    rmse = float(np.sqrt(np.square(errors).sum(axis=1).mean()))
    return fit, f"aligned to {len(used)} control points: RMSE 3D {rmse:.3g} before the adjustment"


def _onto_cameras(found: Mapping[str, Camera], given: Mapping[str, Camera]) -> tuple[Similarity, str]:
    names = sorted(set(found) & set(given))
    candidate = np.array([found[name].position for name in names]).reshape(-1, 3)
    reference = np.array([given[name].position for name in names]).reshape(-1, 3)
    fit = robust_similarity(candidate, reference)
    positions, angles = camera_errors({name: moved(camera, fit) for name, camera in found.items()}, given)
    _check_fit(positions, reference)
    return fit, (
        f"aligned to {len(names)} cameras: position errors {np.median(positions):.3g} (median), {positions.max():.3g}"
        f" (largest); rotation errors {np.median(angles):.3g} and {angles.max():.3g} degrees"
    )


def _onto_gps(found: Mapping[str, Camera], scene: Scene) -> tuple[Similarity, str]:
    measured, frame = scene.measured_positions()
    names = sorted(set(found) & set(measured))
    candidate = np.array([found[name].position for name in names]).reshape(-1, 3)
    reference = np.array([measured[name] for name in names]).reshape(-1, 3)
    fit = robust_similarity(candidate, reference)
    errors = fit.apply(candidate) - reference
    _check_fit(np.linalg.norm(errors, axis=1), reference)
    across, up = np.median(np.linalg.norm(errors[:, :2], axis=1)), np.median(np.abs(errors[:, 2]))
    return fit, (
        f"aligned to the GPS of {len(names)} images, {frame}: median error {across:.2f} m across, {up:.2f} m in height"
    )


def _check_fit(errors: FloatArray, positions: FloatArray) -> None:
    """Raise an InputError where solved cameras are so far from the known positions (N, 3) that one of both is wrong."""
    spread = float(np.sqrt(np.square(positions - positions.mean(axis=0)).sum(axis=1).mean()))
    error = float(np.median(errors))
    if error > _MAX_MISFIT * spread:
        raise InputError(
            f"solved positions are off by {error:.3g} (median) where the known ones spread over {spread:.3g}: the"
            " solution is wrong, or they are"
        )


def _transform(model: Any, transform: Similarity) -> None:
    import pycolmap

    rotation = pycolmap.Rotation3d(transform.rotation)
    model.transform(pycolmap.Sim3d(transform.scale, rotation, transform.translation))
