"""Cameras: intrinsics and poses in the conventions of COLMAP and OpenCV.

The camera looks along +z, with x to the right and y down. Pixel (0, 0) is the top-left pixel; its centre is (0.5, 0.5).
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike

from pcbench.errors import InputError
from pcbench.geometry.arrays import MAX_COORDINATE, FloatArray
from pcbench.geometry.transform import Similarity


@dataclass(frozen=True)
class Intrinsics:
    """Pinhole intrinsics with Brown's distortion (OpenCV's model, and COLMAP's OPENCV model).

    Args:
        width, height: image size in pixels.
        fx, fy, cx, cy: focal lengths and principal point in pixels.
        distortion: coefficients k1, k2, p1, p2.

    Raises:
        InputError: a size or a focal length is not positive, or a number is not finite.
    """

    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float
    distortion: tuple[float, float, float, float] = (0.0, 0.0, 0.0, 0.0)

    def __post_init__(self) -> None:
        if self.width < 1 or self.height < 1:
            raise InputError(f"expected an image of at least one pixel, got {self.width} x {self.height}")
        if not (np.isfinite([self.fx, self.fy]).all() and self.fx > 0 and self.fy > 0):
            raise InputError(f"expected positive focal lengths, got {self.fx:g} and {self.fy:g}")
        if len(self.distortion) != 4 or not np.isfinite([self.cx, self.cy, *self.distortion]).all():
            raise InputError("expected a finite principal point and four finite distortion coefficients k1 k2 p1 p2")

    @classmethod
    def from_fov(cls, width: int, height: int, vertical_fov_deg: float) -> Intrinsics:
        """Return a pinhole with square pixels and the principal point at the image centre."""
        focal = 0.5 * height / np.tan(0.5 * np.radians(vertical_fov_deg))
        return cls(width, height, focal, focal, 0.5 * width, 0.5 * height)

    @property
    def matrix(self) -> FloatArray:
        """The calibration matrix K (3, 3)."""
        return np.array([[self.fx, 0, self.cx], [0, self.fy, self.cy], [0, 0, 1]])

    @property
    def is_pinhole(self) -> bool:
        """Return whether the lens has no distortion."""
        return not any(self.distortion)

    @property
    def widest(self) -> FloatArray:
        """Largest |x| and |y| (2,) of the rays through the image border, at depth z = 1."""
        u, v = np.linspace(0, self.width, 65), np.linspace(0, self.height, 65)
        upper, lower = (np.column_stack([u, np.full(65, y)]) for y in (0, self.height))
        left, right = (np.column_stack([np.full(65, x), v]) for x in (0, self.width))
        widest: FloatArray = np.abs(self.directions(np.concatenate([upper, lower, left, right]))[:, :2]).max(axis=0)
        return widest

    def directions(self, pixels: FloatArray) -> FloatArray:
        """Return ray directions (N, 3) in the camera frame, with depth z = 1, through pixel coordinates (N, 2).

        Newton's method on Brown's two equations removes the distortion.

        Raises:
            InputError: the distortion folds the image over within its border, so that some pixels have no ray.
        """
        target = (np.asarray(pixels, dtype=np.float64) - [self.cx, self.cy]) / [self.fx, self.fy]
        if self.is_pinhole:
            return np.column_stack([target, np.ones(len(target))])
        k1, k2, p1, p2 = self.distortion
        x, y = target.T.copy()
        for _ in range(20):
            r2 = x * x + y * y
            radial, slope = 1 + r2 * (k1 + r2 * k2), 2 * (k1 + 2 * k2 * r2)
            error_x = x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x) - target[:, 0]
            error_y = y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y - target[:, 1]
            xx = radial + slope * x * x + 2 * p1 * y + 6 * p2 * x
            xy = slope * x * y + 2 * p1 * x + 2 * p2 * y
            yy = radial + slope * y * y + 6 * p1 * y + 2 * p2 * x
            determinant = xx * yy - xy * xy
            if not (determinant > 1e-3).all():
                break
            x, y = x - (yy * error_x - xy * error_y) / determinant, y - (xx * error_y - xy * error_x) / determinant
            if max(np.abs(error_x).max(initial=0), np.abs(error_y).max(initial=0)) < 1e-14:
                return np.column_stack([x, y, np.ones(len(target))])
        if max(np.abs(error_x).max(), np.abs(error_y).max()) < 1e-10 and (determinant > 1e-3).all():
            return np.column_stack([x, y, np.ones(len(target))])
        raise InputError(f"the distortion {self.distortion} folds the image over: some pixels have no ray")

    def scaled(self, factor: float) -> Intrinsics:
        """Return the intrinsics of images resized by `factor`, with the size rounded to pixels."""
        return self.resized(max(1, round(self.width * factor)), max(1, round(self.height * factor)))

    def resized(self, width: int, height: int) -> Intrinsics:
        """Return the intrinsics of images resized to width x height pixels."""
        x, y = width / self.width, height / self.height
        return replace(self, width=width, height=height, fx=self.fx * x, fy=self.fy * y, cx=self.cx * x, cy=self.cy * y)


@dataclass(frozen=True, eq=False)
class Camera:
    """The camera of one photograph: file name, intrinsics, and the rigid motion from world to camera coordinates."""

    name: str
    intrinsics: Intrinsics
    cam_from_world: Similarity

    @property
    def position(self) -> FloatArray:
        """The centre of projection (3,) in world coordinates."""
        position: FloatArray = -self.cam_from_world.rotation.T @ self.cam_from_world.translation
        return position

    @property
    def direction(self) -> FloatArray:
        """The viewing direction (3,) in world coordinates, of unit length."""
        direction: FloatArray = self.cam_from_world.rotation[2]
        return direction

    def turned(self) -> Camera:
        """Return the camera of the photograph turned by 90 degrees counter-clockwise."""
        k = self.intrinsics
        k1, k2, p1, p2 = k.distortion
        # The new x axis points along the old y axis, and the new y axis against the old x axis.
        turned = Intrinsics(k.height, k.width, k.fy, k.fx, k.cy, k.width - k.cx, (k1, k2, -p2, p1))
        turn = Similarity(np.array([[0.0, 1, 0], [-1, 0, 0], [0, 0, 1]]), np.zeros(3))
        return Camera(self.name, turned, turn @ self.cam_from_world)

    def project(self, points: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return pixel coordinates (N, 2) and z-depths (N,) of world points (N, 3); points behind have depth <= 0.

        Brown 1966 in OpenCV's form: x' = x (1 + k1 r^2 + k2 r^4) + 2 p1 x y + p2 (r^2 + 2 x^2), and
        y' = y (1 + k1 r^2 + k2 r^4) + p1 (r^2 + 2 y^2) + 2 p2 x y.
        """
        in_camera = self.cam_from_world.apply(points)
        k1, k2, p1, p2 = self.intrinsics.distortion
        with np.errstate(divide="ignore", invalid="ignore", over="ignore"):  # points beside the camera
            x, y = in_camera[:, 0] / in_camera[:, 2], in_camera[:, 1] / in_camera[:, 2]
            r2 = x * x + y * y
            radial = 1 + r2 * (k1 + r2 * k2)
            u = x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x)
            v = y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y
            k = self.intrinsics
            return np.stack([k.fx * u + k.cx, k.fy * v + k.cy], axis=1), in_camera[:, 2]


def look_at(position: ArrayLike, target: ArrayLike, up: ArrayLike = (0.0, 0.0, 1.0)) -> Similarity:
    """Return cam_from_world of a camera at `position` (3,) that looks at `target` (3,), with `up` upwards in the image.

    If the camera looks along `up`, the upper side of the image is north (+y).

    Raises:
        InputError: position and target are the same point.
    """
    eye = np.asarray(position, dtype=np.float64)
    forward = np.asarray(target, dtype=np.float64) - eye
    length = float(np.linalg.norm(forward))
    if not length > 0:
        raise InputError("expected a camera and a target at different points")
    forward /= length
    right = np.cross(forward, np.asarray(up, dtype=np.float64))
    if np.linalg.norm(right) < 1e-9:
        right = np.cross(forward, [0.0, 1.0, 0.0])
    right /= np.linalg.norm(right)
    rotation = np.stack([right, np.cross(forward, right), forward])
    return Similarity(rotation, -rotation @ eye)


def nearest_rotation(matrix: ArrayLike) -> FloatArray:
    """Return the rotation (3, 3) nearest to the matrix of a camera file, which is rounded to few digits.

    The nearest rotation is the orthogonal factor of the polar decomposition.

    Raises:
        InputError: the matrix is not 3x3 and finite, or differs by over 1e-3 from a rotation.
    """
    m = np.asarray(matrix, dtype=np.float64)
    if m.shape != (3, 3) or not (np.abs(m) < MAX_COORDINATE).all():
        raise InputError(f"expected a 3x3 rotation matrix of finite numbers, got {m.shape} with {m.ravel()[:3]}")
    error = float(np.abs(m @ m.T - np.eye(3)).max())
    determinant = float(np.linalg.det(m))
    if error <= 1e-3 and determinant < 0:
        raise InputError(
            f"expected a rotation (determinant +1), got a reflection (determinant {determinant:.6g}): the cameras are"
            " mirrored; export them in a right-handed frame"
        )
    if error > 1e-3:
        raise InputError(
            f"expected a rotation (orthonormal rows, determinant +1), got determinant {determinant:.6g} and rows that"
            f" are {error:.2g} from orthonormal: remove scale, shear and reflection"
        )
    u, _, vt = np.linalg.svd(m)
    rotation: FloatArray = u @ vt
    return rotation
