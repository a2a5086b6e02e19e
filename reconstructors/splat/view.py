"""The camera of one image as the rasterizers take it: a pinhole."""

from __future__ import annotations

from dataclasses import dataclass

from pcbench.errors import InputError
from pcbench.geometry.arrays import FloatArray
from pcbench.geometry.cameras import Camera

_NEAREST = 0.01  # depth, in the world's unit
_MOST_SIDE = 2**19  # pixels: tiles of 16 are counted in 16 bits
_BEYOND = 0.15  # of the image's width and height


@dataclass(frozen=True, eq=False)
class View:
    """A pinhole: it looks along +z, x to the right, y down, and pixel centres are at +0.5.

    Attributes:
        width, height: pixels.
        rotation: (3, 3) from the world to the camera's frame.
        position: (3,) of the centre of projection in the world.
        fx, fy, cx, cy: focal lengths and principal point in pixels.
        near: depth, in the world's unit, up to which nothing is drawn.
    """

    width: int
    height: int
    rotation: FloatArray
    position: FloatArray
    fx: float
    fy: float
    cx: float
    cy: float
    near: float = _NEAREST

    @classmethod
    def of(cls, camera: Camera, near: float = _NEAREST) -> View:
        """The view of a camera without distortion.

        Raises:
            InputError: the camera has distortion, its motion scales, or its image has more than 2^19 pixels a side.
        """
        k, motion = camera.intrinsics, camera.cam_from_world
        if not k.is_pinhole:
            raise InputError(
                f"expected a pinhole, got a camera with distortion {k.distortion}: undistort its photograph first"
            )
        if motion.scale != 1:
            raise InputError(f"expected a rigid cam_from_world, got one of scale {motion.scale:g}")
        if max(k.width, k.height) > _MOST_SIDE:
            raise InputError(f"expected an image of at most {_MOST_SIDE} pixels a side, got {k.width} x {k.height}")
        return cls(k.width, k.height, motion.rotation, camera.position, k.fx, k.fy, k.cx, k.cy, near)

    @property
    def limits(self) -> tuple[float, float, float, float]:
        """Left, right, top and bottom: x / z and y / z at which the affine approximation of the projection is taken are
        held within these, 0.15 of the image beyond its border (Kerbl et al. 2023: 1.3 times half the field of view).

        Far outside the image the approximation would blow Gaussians up that hardly touch it.
        """
        beyond_x, beyond_y = _BEYOND * self.width / self.fx, _BEYOND * self.height / self.fy
        return (
            -self.cx / self.fx - beyond_x,
            (self.width - self.cx) / self.fx + beyond_x,
            -self.cy / self.fy - beyond_y,
            (self.height - self.cy) / self.fy + beyond_y,
        )
