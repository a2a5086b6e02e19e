"""Read the cameras of Agisoft Metashape: the XML file of `File > Export > Export Cameras`.

A chunk has sensors with a calibration, cameras with a matrix from camera to chunk, and a transform from chunk to world.
Camera axes are those of OpenCV. The calibration has f, the offset cx, cy of the principal point from the image centre
in pixels, k1 to k4, p1 and p2 (OpenCV's p2 and p1), and the affinity b1 and skew b2: Metashape manual, appendix C.
"""

from __future__ import annotations

import xml.etree.ElementTree as ET
from collections.abc import Mapping
from pathlib import Path
from typing import NamedTuple

import numpy as np

from pcbench.errors import InputError
from pcbench.geometry.arrays import FloatArray
from pcbench.geometry.cameras import Camera, Intrinsics, nearest_rotation
from pcbench.geometry.geodesy import enu_axes, gps_from_ecef
from pcbench.geometry.transform import Similarity
from pcbench.io.files import Warn, errors_named
from pcbench.regular_files import read_text

_MAX_BYTES, _LOOK_BYTES = 256 << 20, 4096
_COEFFICIENTS = ("f", "cx", "cy", "b1", "b2", "k1", "k2", "k3", "k4", "p1", "p2", "p3", "p4")
_MAX_APPROXIMATION_PX = 1.0  # error at the worst radius, usually the corner, of a lens with k4 without it
_RADII = 200
_MIN_GEOCENTRIC_M = 6.2e6  # distance from the centre of the earth; no local system has such coordinates
_LEAST_SKEW_PX = 1e-6


class _Lens(NamedTuple):
    """Intrinsics of a sensor, and the largest error in pixels of leaving out k4."""

    intrinsics: Intrinsics
    error_px: float


def is_metashape(path: Path) -> bool:
    """Return whether a file may be cameras of Metashape, by its extension."""
    return path.suffix.lower() == ".xml"


def is_metashape_export(path: Path) -> bool:
    """Return whether an XML file starts as an export of Metashape's cameras does."""
    try:
        with path.open("rb") as file:
            start = file.read(_LOOK_BYTES)
    except OSError:
        return False
    return b"<document" in start and b"<chunk" in start


def read_metashape(path: Path, warn: Warn) -> tuple[Camera, ...]:
    """Read the aligned cameras of the first chunk that has some, named by their labels.

    World coordinates are those of the chunk's transform. If these are geocentric, cameras are turned into east, north
    and up in metres around the centre of all cameras, with a warning.

    Raises:
        InputError: the file is not such an export, has no aligned camera, or a lens that is not supported. The message
            starts with the path.
    """
    with errors_named(path):
        text = read_text(path, _MAX_BYTES)
        if "<!DOCTYPE" in text or "<!ENTITY" in text:
            raise InputError("expected cameras of Metashape, got XML with declarations: export the cameras again")
        try:
            root = ET.fromstring(text)
        except (ET.ParseError, RecursionError) as error:
            raise InputError(f"expected XML, got text with an error: {error}: export the cameras again") from None
        chunks = [*root.findall("chunk"), *root.findall("*/chunk")]  # all levels of a hostile file would take hours
        aligned = [chunk for chunk in chunks if _aligned(chunk)]
        if not aligned:
            raise InputError(
                f"expected a chunk with aligned cameras, got none in {len(chunks)} chunks: align the photos, and export"
                " the cameras as Agisoft XML"
            )
        chunk, notes = aligned[0], list[str]()
        if len(aligned) > 1:
            notes.append(
                f"left out {len(aligned) - 1} of {len(aligned)} chunks: read {chunk.get('label', 'the first')!r}"
            )
        try:
            with np.errstate(over="ignore", invalid="ignore"):  # huge numbers become infinite, and are refused
                cameras = _cameras(chunk, notes.append)
        except InputError:  # also a ValueError, but its message is complete
            raise
        except (ValueError, OverflowError) as error:
            raise InputError(f"expected numbers: {str(error)[:80]}: export the cameras again") from None
    for note in notes:
        warn(f"{path}: {note}")
    return cameras


def _aligned(chunk: ET.Element) -> list[ET.Element]:
    return [camera for camera in chunk.iter("camera") if camera.find("transform") is not None]


def _cameras(chunk: ET.Element, warn: Warn) -> tuple[Camera, ...]:
    elements = _aligned(chunk)
    if missing := sum(1 for _ in chunk.iter("camera")) - len(elements):
        warn(f"left out {missing} of {missing + len(elements)} cameras, which are not aligned")
    sensors = {sensor.get("id"): sensor for sensor in chunk.iter("sensor")}
    lenses: dict[str | None, _Lens] = {}
    for element in elements:
        key = element.get("sensor_id")
        if key not in sensors:
            raise InputError(
                f"expected a sensor of camera {element.get('label')!r}, got none: export the cameras again"
            )
        if key not in lenses:
            with errors_named(f"sensor {sensors[key].get('label', key)!r}"):
                lenses[key] = _lens(sensors[key])
    if worst := max(lens.error_px for lens in lenses.values()):
        warn(f"lenses are read without k4: other coefficients take its place, with errors up to {worst:.2g} px")
    world_from_chunk = _chunk_transform(chunk)
    poses = [(world_from_chunk @ _matrix(element, element.get("label"))) for element in elements]
    centers = np.array([pose[:3, 3] for pose in poses])
    rotations = np.array([_rotation(pose, element) for pose, element in zip(poses, elements, strict=True)])
    center = centers.mean(axis=0)
    if np.linalg.norm(center) > _MIN_GEOCENTRIC_M:
        origin = gps_from_ecef(center)
        axes = enu_axes(origin)
        centers, rotations = (centers - center) @ axes.T, axes @ rotations
        warn(
            "the chunk is geocentric: cameras are in east, north and up in metres around latitude"
            f" {origin.latitude_deg:.7f}, longitude {origin.longitude_deg:.7f}, height {origin.altitude:.3f} m"
        )
    return tuple(
        Camera(
            element.get("label") or str(element.get("id")),
            lenses[element.get("sensor_id")].intrinsics,
            Similarity(rotation.T, -rotation.T @ position),
        )
        for element, rotation, position in zip(elements, rotations, centers, strict=True)
    )


# ---- poses --------------------------------------------------------------------------------------------------------


def _chunk_transform(chunk: ET.Element) -> FloatArray:
    """Return the matrix (4, 4) from chunk to world; that of the only component if the chunk has none."""
    element = chunk.find("transform")
    if element is None:
        transforms = [t for component in chunk.iter("component") if (t := component.find("transform")) is not None]
        element = transforms[0] if len(transforms) == 1 else None
    matrix = np.eye(4)
    if element is None:
        return matrix
    rotation, translation, scale = (_numbers(element.findtext(name)) for name in ("rotation", "translation", "scale"))
    if len(rotation):
        if len(rotation) != 9:
            raise InputError(f"expected a chunk rotation of 9 numbers, got {len(rotation)}: export the cameras again")
        matrix[:3, :3] = nearest_rotation(rotation.reshape(3, 3))
    if len(scale):
        matrix[:3, :3] *= scale[0]
    if len(translation):
        matrix[:3, 3] = translation
    return matrix


def _matrix(element: ET.Element, label: str | None) -> FloatArray:
    numbers = _numbers(element.findtext("transform"))
    if len(numbers) != 16:
        raise InputError(f"camera {label!r}: expected a transform of 16 numbers, got {len(numbers)}: export it again")
    return numbers.reshape(4, 4)


def _rotation(pose: FloatArray, element: ET.Element) -> FloatArray:
    """Return the rotation of a pose, whose scale is that of the chunk."""
    with errors_named(f"camera {element.get('label')!r}"):
        scale = np.cbrt(abs(np.linalg.det(pose[:3, :3])))
        if not (np.isfinite(pose).all() and scale > 0):
            raise InputError("expected a finite transform that is no projection, got another one: export it again")
        return nearest_rotation(pose[:3, :3] / scale)


def _numbers(text: str | None) -> FloatArray:
    return np.array([float(word) for word in (text or "").split()])


# ---- lenses -------------------------------------------------------------------------------------------------------


def _lens(sensor: ET.Element) -> _Lens:
    """Return the intrinsics of a sensor from its adjusted calibration, or from the initial one."""
    kind = sensor.get("type", "frame")
    if kind not in ("frame", "fisheye"):
        raise InputError(f"expected a frame or fisheye camera, got type {kind!r}: undistort the photos first")
    calibrations = sensor.findall("calibration")
    calibration = next((c for c in calibrations if c.get("class") == "adjusted"), next(iter(calibrations), None))
    if calibration is None:
        raise InputError("expected a calibration, got none: export the cameras again")
    resolution = calibration.find("resolution")
    resolution = sensor.find("resolution") if resolution is None else resolution
    if resolution is None:
        raise InputError("expected a resolution, got none: export the cameras again")
    width, height = int(resolution.get("width", 0)), int(resolution.get("height", 0))
    values = {name: float(calibration.findtext(name) or 0) for name in _COEFFICIENTS}
    if not np.isfinite(list(values.values())).all() or values["f"] <= 0:
        raise InputError(
            f"expected finite coefficients and a focal length above 0, got f {values['f']:g}: export it again"
        )
    if abs(values["b2"]) > _LEAST_SKEW_PX or values["p3"] or values["p4"]:
        raise InputError("expected a lens without skew (b2), p3 and p4, got some: undistort the photos first")
    stretch = 1 + values["b1"] / values["f"]
    center = width / 2 + values["cx"], height / 2 + values["cy"]
    k1, k2, k3, k4, p1, p2 = (values[name] for name in ("k1", "k2", "k3", "k4", "p1", "p2"))
    if kind == "fisheye":
        if p1 or p2:
            raise InputError("expected a fisheye lens without p1 and p2, got some: undistort the photos first")
        focal = values["f"] * stretch, values["f"]
        fisheye = Intrinsics(width, height, *focal, *center, (k1, k2, k3, k4), fisheye=True)
        _check_corners(fisheye)
        return _Lens(fisheye, 0.0)
    f, error = values["f"], 0.0
    if k4:
        corner = float(np.hypot(width / 2 + abs(values["cx"]), height / 2 + abs(values["cy"]))) / f
        (f, k1, k2, k3), error = _without_k4(values, corner)
    distortion = (k1, k2, p2, p1, k3, 0.0, 0.0, 0.0) if k3 else (k1, k2, p2, p1)
    intrinsics = Intrinsics(width, height, f * stretch, f, *center, distortion)
    _check_corners(intrinsics)
    return _Lens(intrinsics, error)


def _check_corners(lens: Intrinsics) -> None:
    """Raise an `InputError` if the distortion folds the image over before its corners."""
    lens.directions(np.array([[0.0, 0.0], [lens.width, 0], [0, lens.height], [lens.width, lens.height]]))


def _without_k4(values: Mapping[str, float], corner: float) -> tuple[tuple[float, float, float, float], float]:
    """Return f, k1, k2 and k3 that are nearest to a lens with k4 up to its corner, and the largest error in pixels.

    Args:
        values: the coefficients.
        corner: distance of the farthest corner from the principal point, over f.

    Raises:
        InputError: the error is too large, or the lens folds the image over.
    """
    # Radii of rays up to the one that the lens maps to the corner.
    radii = np.linspace(0, 4 * corner, 8 * _RADII)
    mapped = radii * (1 + sum(values[f"k{k}"] * radii ** (2 * k) for k in (1, 2, 3, 4)))
    reached = np.flatnonzero(mapped >= corner)
    if not len(reached) or (np.diff(mapped[: reached[0] + 1]) <= 0).any():
        raise InputError(
            "expected a lens that maps rays to the whole image, got one that folds it: undistort the photos"
        )
    radii, mapped = radii[: reached[0] + 1], mapped[: reached[0] + 1]
    powers = np.stack([radii, radii**3, radii**5, radii**7], axis=1)
    solution = np.linalg.lstsq(powers, mapped, rcond=None)[0]
    error = values["f"] * float(np.abs(powers @ solution - mapped).max())
    if not error <= _MAX_APPROXIMATION_PX or solution[0] <= 0:
        raise InputError(
            f"expected a lens that k1, k2 and k3 describe within {_MAX_APPROXIMATION_PX} px, got a k4 that needs"
            f" {error:.2g} px: undistort the photos first"
        )
    scale, k1, k2, k3 = (float(number) for number in solution)
    return (values["f"] * scale, k1 / scale, k2 / scale, k3 / scale), error
