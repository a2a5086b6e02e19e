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

MAX_FISHEYE_DEG = 85.0
"""Largest angle between a ray of a fisheye lens and the optical axis: rays near 90 degrees have no depth z = 1."""


@dataclass(frozen=True)
class Intrinsics:
    """Pinhole intrinsics with the distortion of a lens, in OpenCV's models.

    Args:
        width: width of the image in pixels.
        height: height of the image in pixels.
        fx, fy: focal length along x or y, in pixels.
        cx, cy: coordinate of the principal point along x or y, in pixels.
        distortion: coefficients k1, k2, p1, p2 (Brown 1966; COLMAP's OPENCV), or these and k3, k4, k5, k6 (the rational
            model; COLMAP's FULL_OPENCV); of a fisheye lens k1, k2, k3, k4 (Kannala and Brandt 2006; COLMAP's
            OPENCV_FISHEYE).
        fisheye: whether the lens is a fisheye.

    Raises:
        InputError: a size or a focal length is not positive, or a number is not finite.
    """

    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float
    distortion: tuple[float, ...] = (0.0, 0.0, 0.0, 0.0)
    fisheye: bool = False

    def __post_init__(self) -> None:
        if self.width < 1 or self.height < 1:
            raise InputError(f"expected an image of at least one pixel, got {self.width} x {self.height}")
        if not (np.isfinite([self.fx, self.fy]).all() and self.fx > 0 and self.fy > 0):
            raise InputError(f"expected positive focal lengths, got {self.fx:g} and {self.fy:g}")
        counts = (4,) if self.fisheye else (4, 8)
        if len(self.distortion) not in counts or not np.isfinite([self.cx, self.cy, *self.distortion]).all():
            coefficients = "k1 k2 k3 k4" if self.fisheye else "k1 k2 p1 p2, or eight with k3 to k6"
            raise InputError(
                f"expected a finite principal point and four finite distortion coefficients {coefficients}"
            )

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
        return not (self.fisheye or any(self.distortion))

    @property
    def border(self) -> FloatArray:
        """Rays x, y (260, 2) through the image border, at depth z = 1; infinite beyond `MAX_FISHEYE_DEG`."""
        u, v = np.linspace(0, self.width, 65), np.linspace(0, self.height, 65)
        upper, lower = (np.column_stack([u, np.full(65, y)]) for y in (0, self.height))
        left, right = (np.column_stack([np.full(65, x), v]) for x in (0, self.width))
        pixels = np.concatenate([upper, lower, left, right])
        rays = self.directions(pixels)[:, :2]
        offsets = pixels - [self.cx, self.cy]
        beyond = np.where(offsets == 0, 0.0, np.copysign(np.inf, offsets))
        return np.where(np.isnan(rays), beyond, rays)

    @property
    def widest(self) -> FloatArray:
        """Largest |x| and |y| (2,) of the rays through the image border, at depth z = 1."""
        widest: FloatArray = np.abs(self.border).max(axis=0)
        return widest

    def directions(self, pixels: FloatArray) -> FloatArray:
        """Return ray directions (N, 3) in the camera frame, with depth z = 1, through pixel coordinates (N, 2).

        Newton's method inverts `distort`. Pixels of a fisheye lens more than `MAX_FISHEYE_DEG` from the optical axis
        have NaN.

        Raises:
            InputError: the distortion folds the image over within its border, so that some pixels have no ray.
        """
        target = (np.asarray(pixels, dtype=np.float64) - [self.cx, self.cy]) / [self.fx, self.fy]
        if self.is_pinhole:
            return np.column_stack([target, np.ones(len(target))])
        xy = _remove_fisheye(target, self.distortion) if self.fisheye else _remove_brown(target, self.distortion)
        if xy is None:
            raise InputError(
                f"the distortion {self.distortion} folds the image over: some pixels have no ray; undistort the"
                " photographs first"
            )
        return np.column_stack([xy, np.ones(len(target))])

    def distort(self, xy: FloatArray) -> FloatArray:
        """Return pixel coordinates (N, 2) of rays x, y (N, 2) at depth z = 1.

        With r^2 = x^2 + y^2, OpenCV's form of Brown 1966 is x' = x s + 2 p1 x y + p2 (r^2 + 2 x^2) and
        y' = y s + p1 (r^2 + 2 y^2) + 2 p2 x y, where s = 1 + k1 r^2 + k2 r^4 + k3 r^6, divided by
        1 + k4 r^2 + k5 r^4 + k6 r^6. A fisheye lens scales x and y by t (1 + k1 t^2 + k2 t^4 + k3 t^6 + k4 t^8) / r,
        where t is the angle between the ray and the optical axis (Kannala and Brandt 2006).
        """
        x, y = xy.T
        r2 = x * x + y * y
        if self.fisheye:
            r = np.sqrt(r2)
            scale = np.divide(_fisheye_radius(np.arctan(r), self.distortion)[0], r, out=np.ones_like(r), where=r > 0)
            x, y = x * scale, y * scale
        elif any(self.distortion):
            _, _, p1, p2 = self.distortion[:4]
            scale = _brown_scale(r2, self.distortion)[0]
            x, y = (
                x * scale + 2 * p1 * x * y + p2 * (r2 + 2 * x * x),
                y * scale + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y,
            )
        return np.stack([self.fx * x + self.cx, self.fy * y + self.cy], axis=1)

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
        distortion = k.distortion
        if not k.fisheye:
            k1, k2, p1, p2, *higher = distortion
            distortion = (k1, k2, -p2, p1, *higher)
        # The new x axis points along the old y axis, and the new y axis against the old x axis.
        turned = Intrinsics(k.height, k.width, k.fy, k.fx, k.cy, k.width - k.cx, distortion, k.fisheye)
        turn = Similarity(np.array([[0.0, 1, 0], [-1, 0, 0], [0, 0, 1]]), np.zeros(3))
        return Camera(self.name, turned, turn @ self.cam_from_world)

    def project(self, points: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return pixel coordinates (N, 2) and z-depths (N,) of world points (N, 3); points behind have depth <= 0."""
        in_camera = self.cam_from_world.apply(points)
        with np.errstate(divide="ignore", invalid="ignore", over="ignore"):  # points beside the camera
            return self.intrinsics.distort(in_camera[:, :2] / in_camera[:, 2:]), in_camera[:, 2]


def _brown_scale(r2: FloatArray, distortion: tuple[float, ...]) -> tuple[FloatArray, FloatArray]:
    """Return the radial scale (N,) at squared radii (N,), and its derivative with respect to them."""
    k1, k2, _, _, k3, k4, k5, k6 = (*distortion, 0.0, 0.0, 0.0, 0.0)[:8]
    upper, lower = 1 + r2 * (k1 + r2 * (k2 + r2 * k3)), 1 + r2 * (k4 + r2 * (k5 + r2 * k6))
    upper_slope, lower_slope = k1 + r2 * (2 * k2 + r2 * 3 * k3), k4 + r2 * (2 * k5 + r2 * 3 * k6)
    scale = upper / lower
    return scale, (upper_slope - scale * lower_slope) / lower


def _remove_brown(target: FloatArray, distortion: tuple[float, ...]) -> FloatArray | None:
    """Return the undistorted x, y (N, 2) by Newton's method on both equations; None if the distortion folds over."""
    _, _, p1, p2 = distortion[:4]
    x, y = target.T.copy()
    for _ in range(20):
        r2 = x * x + y * y
        radial, derivative = _brown_scale(r2, distortion)
        slope = 2 * derivative
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
            return np.column_stack([x, y])
    if max(np.abs(error_x).max(), np.abs(error_y).max()) < 1e-10 and (determinant > 1e-3).all():
        return np.column_stack([x, y])
    return None


def _fisheye_radius(angle: FloatArray, distortion: tuple[float, ...]) -> tuple[FloatArray, FloatArray]:
    """Return the distorted radius (N,) at angles from the optical axis (N,), and its gradient with respect to them."""
    k1, k2, k3, k4 = distortion
    t2 = angle * angle
    radius = angle * (1 + t2 * (k1 + t2 * (k2 + t2 * (k3 + t2 * k4))))
    return radius, 1 + t2 * (3 * k1 + t2 * (5 * k2 + t2 * (7 * k3 + t2 * 9 * k4)))


def _remove_fisheye(target: FloatArray, distortion: tuple[float, ...]) -> FloatArray | None:
    """Return the undistorted x, y (N, 2), NaN beyond `MAX_FISHEYE_DEG`; None if the distortion folds over before it."""
    largest = np.radians(MAX_FISHEYE_DEG)
    samples, slopes = _fisheye_radius(np.linspace(0, largest, 256), distortion)
    radius = np.hypot(*target.T)
    within = radius <= samples.max()
    reached = len(samples) - 1  # pixels beyond the largest radius have no ray only if the radius grows up to there
    if within.all():
        reached = int(np.searchsorted(np.maximum.accumulate(samples), radius.max(initial=0)))
    if not (slopes[: reached + 1] > 1e-3).all():
        return None
    angle = np.interp(radius[within], samples[: reached + 1], np.linspace(0, largest, 256)[: reached + 1])
    for _ in range(4):  # quadratic convergence from an error below 1e-4 rad
        value, slope = _fisheye_radius(angle, distortion)
        angle = angle - (value - radius[within]) / slope
    result = np.full(target.shape, np.nan)
    scale = np.divide(np.tan(angle), radius[within], out=np.ones_like(angle), where=radius[within] > 0)
    result[within] = target[within] * scale[:, None]
    return result


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
