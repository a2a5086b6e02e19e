"""The pinhole camera of one image, and the limits of what is drawn, as the rasterizers read them."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from pcbench.errors import InputError
from pcbench.geometry.arrays import FloatArray
from pcbench.geometry.cameras import Camera

_NEAR = 0.01  # depth, in the world's unit
_MIN_ALPHA = 1 / 255  # Kerbl et al. 2023, like the next
_MIN_TRANSMITTANCE = 1e-4
_MAX_SIDE_PX = 2**19  # pixels: tiles of 16 are counted in 16 bits
_MARGIN_SHARE = 0.15  # of the image's width and height


@dataclass(frozen=True, eq=False)
class View:
    """A pinhole that looks along +z, x to the right, y down, with pixel centres at +0.5.

    Attributes:
        width, height: size of the image in pixels.
        rotation: (3, 3) from the world to the camera's frame.
        position: (3,) centre of projection in the world.
        fx, fy, cx, cy: focal lengths and principal point in pixels.
        near: depth, in the world's unit, up to which nothing is drawn.
        min_alpha: lower alphas at a pixel are skipped.
        min_transmittance: a ray ends before its transmittance falls below.
    """

    width: int
    height: int
    rotation: FloatArray
    position: FloatArray
    fx: float
    fy: float
    cx: float
    cy: float
    near: float = _NEAR
    min_alpha: float = _MIN_ALPHA
    min_transmittance: float = _MIN_TRANSMITTANCE

    @classmethod
    def of(cls, camera: Camera, near: float = _NEAR) -> View:
        """Return the view of a camera without distortion.

        Raises:
            InputError: the camera has distortion, its pose has a scale, or a side of its image exceeds 2^19 pixels.
        """
        k, motion = camera.intrinsics, camera.cam_from_world
        if not k.is_pinhole:
            raise InputError(
                f"expected a pinhole, got a camera with distortion {k.distortion}: undistort its photograph first"
            )
        if motion.scale != 1:
            raise InputError(f"expected a rigid cam_from_world, got one of scale {motion.scale:g}")
        if max(k.width, k.height) > _MAX_SIDE_PX:
            raise InputError(f"expected an image of at most {_MAX_SIDE_PX} pixels per side, got {k.width} x {k.height}")
        return cls(k.width, k.height, motion.rotation, camera.position, k.fx, k.fy, k.cx, k.cy, near)

    @property
    def limits(self) -> tuple[float, float, float, float]:
        """Left, right, top and bottom bound of x / z and y / z for the centre of the affine approximation.

        The centre is clamped to them. They lie 0.15 of the image beyond its border (Kerbl et al. 2023: 1.3 times half
        the field of view). Far outside the image the approximation would enlarge Gaussians that hardly touch it.
        """
        margin_x, margin_y = _MARGIN_SHARE * self.width / self.fx, _MARGIN_SHARE * self.height / self.fy
        return (
            -self.cx / self.fx - margin_x,
            (self.width - self.cx) / self.fx + margin_x,
            -self.cy / self.fy - margin_y,
            (self.height - self.cy) / self.fy + margin_y,
        )

    @property
    def cutoffs(self) -> tuple[float, float, float]:
        """Minimum alpha, its logarithm to base 2, and minimum transmittance, rounded to float32 for all devices.

        Two Gaussians clamped at 0.99 leave almost exactly 1e-4 of a ray: the side of the threshold must not depend on
        the type.
        """
        min_alpha, min_transmittance = float(np.float32(self.min_alpha)), float(np.float32(self.min_transmittance))
        return min_alpha, math.log2(min_alpha), min_transmittance
