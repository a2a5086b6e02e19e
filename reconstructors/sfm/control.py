"""Control points: read from a file, measured in a model, and fixed in a bundle adjustment."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from pcbench.errors import InputError, ReconstructionError
from pcbench.geometry.arrays import FloatArray
from pcbench.geometry.cameras import Camera
from pcbench.io.colmap_model import colmap_camera
from pcbench.registration import SurveyResiduals
from pcbench.registration.control_points import states_z_is_up
from pcbench.regular_files import read_text
from pcbench.scenes.scene import first_names
from reconstructors.sfm.model import Refine

# Points beyond either limit are removed after the adjustment: COLMAP's defaults.
_MAX_ERROR_PX, _MIN_ANGLE_DEG = 4.0, 1.5


class Observation(NamedTuple):
    """Observation of a control point in an image, in pixels; the first pixel's centre is at (0.5, 0.5)."""

    image: str
    x: float
    y: float


class ControlPoint(NamedTuple):
    """Surveyed point with its observations in images. Check points are measured, but not used for the fit."""

    name: str
    position: FloatArray
    observations: tuple[Observation, ...]

    @property
    def is_check(self) -> bool:
        """Return whether the point is a check point, marked by a name that ends in *."""
        return self.name.endswith("*")


class ControlSurvey(NamedTuple):
    """Control and check points, and whether the z of their positions is known to be height."""

    points: tuple[ControlPoint, ...] = ()
    z_is_up: bool = False

    @property
    def control(self) -> list[ControlPoint]:
        """Points that are not check points."""
        return [point for point in self.points if not point.is_check]

    def residuals(self, cameras: Mapping[str, Camera], scale: float) -> SurveyResiduals:
        """Compute residuals of the points that two or more cameras observe, in the frame of the cameras.

        Args:
            cameras: Cameras by image name.
            scale: Size of the working images relative to those in which the points were marked.

        Raises:
            InputError: A mark lies outside its image.
        """
        measured = measure(cameras, self.points, scale)
        names = [m.point.name.rstrip("*") for m in measured]
        describe_differences = np.array([m.estimated_position - m.point.position for m in measured]).reshape(-1, 3)
        is_check = [m.point.is_check for m in measured]
        return SurveyResiduals.of(names, describe_differences, is_check, z_is_up=self.z_is_up)


def read_control(path: Path) -> ControlSurvey:
    """Read control points: lines of name, x y z, image, and the point's pixel in it; one line per observation.

    Lines that start with # are comments; `# z is up` states that z is height. Names that end in * are check points.

    Args:
        path: Text file.

    Raises:
        InputError: A line has another format, or a point has two positions, fewer than two observations, two marks in
            one image, or is both a control and a check point.
    """
    try:
        lines = read_text(path).splitlines()
    except (InputError, OSError) as error:
        what = getattr(error, "strerror", None) or error
        raise InputError(f"{path}: cannot read control points: {what}") from error
    positions: dict[str, FloatArray] = {}
    observations: dict[str, list[Observation]] = {}
    for number, line in enumerate(lines, 1):
        words = line.split("#")[0].split()
        if not words:
            continue
        try:
            name, x, y, z, image, u, v = words
            position, pixel = np.array([float(x), float(y), float(z)]), (float(u), float(v))
        except ValueError:
            raise InputError(
                f"{path}: line {number}: expected name, x y z, image, pixel x y; got {line.strip()[:60]!r}"
            ) from None
        if not (np.isfinite(position).all() and np.isfinite(pixel).all()):
            raise InputError(f"{path}: line {number}: expected finite numbers, got {line.strip()[:60]!r}")
        if not np.array_equal(positions.setdefault(name, position), position):
            raise InputError(f"{path}: line {number}: {name} has a different position than in an earlier line")
        marks = observations.setdefault(name, [])
        if any(mark.image == image for mark in marks):
            raise InputError(f"{path}: line {number}: expected one mark of {name} in {image}, got a second one")
        marks.append(Observation(image, *pixel))
    for name, seen in observations.items():
        if len({o.image for o in seen}) < 2:
            raise InputError(f"{path}: expected marks of {name} in two or more images, got one image")
        if name.endswith("*") and name.rstrip("*") in observations:
            raise InputError(
                f"{path}: {name.rstrip('*')} is both a control point and, with a *, a check point: choose one"
            )
    points = tuple(ControlPoint(name, positions[name], tuple(seen)) for name, seen in observations.items())
    return ControlSurvey(points, any(map(states_z_is_up, lines)))


def check_names(survey: ControlSurvey, images: Collection[str]) -> list[str]:
    """Return a note on marks in images that are not in the scene.

    Args:
        survey: Control and check points.
        images: Names of the scene's images.

    Raises:
        InputError: None of the marked images is in the scene.
    """
    marked = dict.fromkeys(mark.image for point in survey.points for mark in point.observations)
    unknown = [name for name in marked if name not in images]
    if marked and len(unknown) == len(marked):
        raise InputError(
            f"the control points are marked in images such as {unknown[0]}, none of which is in the scene: expected"
            f" names such as {next(iter(images))}"
        )
    return (
        [f"control points: {len(unknown)} images with marks are not in the scene: {first_names(unknown)}"]
        if unknown
        else []
    )


class MeasuredPoint(NamedTuple):
    """Control point and its position (3,) estimated from a model."""

    point: ControlPoint
    estimated_position: FloatArray


def measure(cameras: Mapping[str, Camera], control: Sequence[ControlPoint], scale: float) -> list[MeasuredPoint]:
    """Triangulate the control points that two or more cameras observe.

    Args:
        cameras: Cameras by image name.
        control: Control points.
        scale: Size of the working images relative to those in which the points were marked.

    Raises:
        InputError: A mark lies outside its image.
    """
    measured = []
    for point in control:
        seen = [o for o in point.observations if o.image in cameras]
        for o in seen:
            k = cameras[o.image].intrinsics
            if not (0 <= scale * o.x <= k.width and 0 <= scale * o.y <= k.height):
                size = f"{k.width / scale:.0f} x {k.height / scale:.0f}"
                raise InputError(
                    f"control point {point.name}: ({o.x:g}, {o.y:g}) lies outside {o.image} of {size} pixels"
                )
        if len({o.image for o in seen}) >= 2:
            rays = [_ray(cameras[o.image], scale * o.x, scale * o.y) for o in seen]
            centres = [cameras[o.image].position for o in seen]
            measured.append(MeasuredPoint(point, triangulate(np.stack(rays), np.stack(centres))))
    return measured


def triangulate(rays: FloatArray, centres: FloatArray) -> FloatArray:
    """Return the point (3,) closest to lines through centres (N, 3) along unit rays (N, 3), in least squares."""
    planes = np.eye(3) - np.einsum("ni,nj->nij", rays, rays)
    point: FloatArray = np.linalg.solve(planes.sum(axis=0), np.einsum("nij,nj->i", planes, centres))
    return point


def adjust(model: Any, control: Sequence[ControlPoint], scale: float, refine: Refine) -> Any:
    """Return the model after a bundle adjustment with fixed control points.

    A mark in an image has the weight of a feature. The adjustment can remove deformation, which an alignment alone
    cannot.

    Args:
        model: pycolmap.Reconstruction in the control points' frame, which three control points define.
        control: Control points.
        scale: Size of the working images relative to those in which the points were marked.
        refine: Intrinsics to solve for.

    Raises:
        ReconstructionError: The adjustment fails.
    """
    import pycolmap

    # Map coordinates are large: centre them to keep precision.
    center = np.mean([point.position for point in control], axis=0)
    model.transform(pycolmap.Sim3d(1.0, pycolmap.Rotation3d(), -center))
    marked, fixed = _add_control_points(model, control, scale, center)
    config = pycolmap.BundleAdjustmentConfig()
    for image in marked.images.values():
        config.add_image(image.image_id)
    for point in fixed:
        config.add_constant_point(point)
    options = pycolmap.BundleAdjustmentOptions()
    options.print_summary = False
    options.refine_focal_length = refine in ("all", "focal")
    options.refine_extra_params = refine in ("all", "distortion")
    options.ceres.solver_options.num_threads = 1  # reproducible order of summation
    summary = pycolmap.create_default_bundle_adjuster(options, config, marked).solve()
    if not summary.is_solution_usable():
        raise ReconstructionError(f"the adjustment to control points fails: {summary.brief_report()}")
    for point in fixed:
        marked.delete_point3D(point)
    pycolmap.ObservationManager(marked).filter_all_points3D(_MAX_ERROR_PX, _MIN_ANGLE_DEG)
    marked.update_point_3d_errors()
    marked.transform(pycolmap.Sim3d(1.0, pycolmap.Rotation3d(), center))
    return marked


def _add_control_points(
    model: Any, control: Sequence[ControlPoint], scale: float, origin: FloatArray
) -> tuple[Any, list[int]]:
    """Return a copy of a model with the control points and their marks, and the control points' ids.

    pycolmap cannot change an image's features in place.
    """
    import pycolmap

    images = sorted((image for image in model.images.values() if image.has_pose), key=lambda image: int(image.image_id))
    features = {str(image.name): [point.xy for point in image.points2D] for image in images}
    image_ids = {str(image.name): int(image.image_id) for image in images}
    tracks = []
    for point in control:
        track = pycolmap.Track()
        for mark in point.observations:
            if mark.image in image_ids:
                track.add_element(image_ids[mark.image], len(features[mark.image]))
                features[mark.image].append(scale * np.array([mark.x, mark.y]))
        tracks.append(track)
    copy = pycolmap.Reconstruction()
    for camera in model.cameras.values():
        copy.add_camera_with_trivial_rig(camera)
    for image in images:
        same = pycolmap.Image(name=image.name, camera_id=image.camera_id, image_id=image.image_id)
        same.points2D = pycolmap.Point2DList([pycolmap.Point2D(xy) for xy in features[str(image.name)]])
        copy.add_image_with_trivial_frame(same, image.cam_from_world())
    for _, point in sorted(model.points3D.items()):
        copy.add_point3D(point.xyz, point.track, point.color)
    fixed = [
        int(copy.add_point3D(point.position - origin, track))
        for point, track in zip(control, tracks, strict=True)
        if track.length() >= 2
    ]
    return copy, fixed


def _ray(camera: Camera, x: float, y: float) -> FloatArray:
    """Return the undistorted unit direction (3,) of a pixel in world coordinates."""
    import pycolmap

    k = camera.intrinsics
    model, parameters = colmap_camera(k)
    colmap = pycolmap.Camera(model=model, width=k.width, height=k.height, params=parameters)
    direction: FloatArray = camera.cam_from_world.rotation.T @ [*colmap.cam_from_img(np.array([x, y])), 1.0]
    return direction / np.linalg.norm(direction)
