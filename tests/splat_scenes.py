"""Small scenes of Gaussians with difficult cases; values are float32, so that all types represent them exactly."""

from typing import NamedTuple

import numpy as np

from pcbench.geometry.cameras import Camera, Intrinsics, look_at


class SplatScene(NamedTuple):
    """Arrays of the shapes that `rasterize` takes, in float32."""

    means: np.ndarray
    quats: np.ndarray
    scales: np.ndarray
    opacities: np.ndarray
    sh: np.ndarray
    camera: Camera
    background: np.ndarray

    @property
    def arrays(self):
        return self[:5]


def camera(width, height, position=(0.3, -4.0, 0.7), target=(0.0, 0.0, 0.0), focal=None):
    focal = focal or 0.9 * max(width, height, 8)
    k = Intrinsics(width, height, focal, 1.05 * focal, 0.48 * width, 0.53 * height)
    return Camera("view.png", k, look_at(position, target))


def scattered_cloud(rng, count=60, width=37, height=22, degree=3, size=0.15, **camera_options):
    """A cloud about the origin, seen from outside, with sizes over a factor of twenty and all opacities."""
    means = rng.normal(size=(count, 3))
    quats = rng.normal(size=(count, 4)) * rng.uniform(0.2, 5, size=(count, 1))
    scales = size * np.exp(rng.uniform(-1.5, 1.5, size=(count, 3)))
    opacities = rng.uniform(0.02, 1, size=count)
    sh = rng.normal(size=(count, (degree + 1) ** 2, 3)) * np.r_[0.8, np.full((degree + 1) ** 2 - 1, 0.25)][:, None]
    arrays = [a.astype(np.float32) for a in (means, quats, scales, opacities, sh)]
    return SplatScene(*arrays, camera(width, height, **camera_options), np.array([0.2, 0.5, 0.9], np.float32))


def camera_inside(rng):
    """The camera is inside the cloud: Gaussians behind it, around it, and nearer than the near plane."""
    scene = scattered_cloud(rng, 90, position=(0.1, -0.2, 0.1), target=(0.0, 3.0, 0.3), size=0.1)
    scene.means[:6] = scene.camera.position + np.outer([-1, -0.02, 0, 0.005, 0.011, 0.03], scene.camera.direction)
    scene.scales[:6] *= np.float32(0.02)
    return scene


def means_at_border(rng):
    """Means on the image's border, outside it, and beyond the bounds of the affine approximation."""
    scene = scattered_cloud(rng, 80)
    k, motion = scene.camera.intrinsics, scene.camera.cam_from_world
    relative_position = rng.uniform(-0.3, 1.3, size=(80, 2))
    relative_position[:40] = np.where(rng.random((40, 2)) < 0.5, 0, 1)  # the four corners
    relative_position[20:40, 0] = rng.random(20)
    depth = rng.uniform(1, 6, size=(80, 1))
    x = (relative_position * [k.width, k.height] - [k.cx, k.cy]) / [k.fx, k.fy] * depth
    scene.means[:] = motion.inverse().apply(np.hstack([x, depth]))
    scene.scales[60:] *= 5
    return scene


def needles(rng):
    """Gaussians with ratios of axes up to a million."""
    scene = scattered_cloud(rng, 60)
    scene.scales[:] = 10 ** rng.uniform(-6, 0, size=(60, 3))
    scene.scales[np.arange(60), rng.integers(0, 3, 60)] = 10 ** rng.uniform(-1, 0.5, size=60)
    return scene


def discs(rng):
    """Surfels: one axis of length zero; for a few two or three axes."""
    scene = scattered_cloud(rng, 60)
    scene.scales[np.arange(60), rng.integers(0, 3, 60)] = 0
    scene.scales[50:, 1] = 0
    scene.scales[58:] = 0
    return scene


def huge_gaussians(rng):
    """Gaussians that cover the image, some of low opacity, between small ones; three are too large for any image."""
    scene = scattered_cloud(rng, 60)
    scene.scales[:20] *= 30
    scene.opacities[:20] *= np.float32(0.2)
    scene.scales[20:23] = [[1e9, 1e9, 1e9], [1e12, 1, 1e12], [1e18, 1e18, 1e18]]
    return scene


def faint_gaussians(rng):
    """Opacities of 0, below 1/255 and just above it."""
    scene = scattered_cloud(rng, 80)
    scene.opacities[:70] = np.repeat([0, 0.002, 0.0039, 0.00393, 0.004, 0.005, 0.01], 10)
    return scene


def opaque_gaussians(rng):
    """Opacities of 1, clamped to 0.99, so that rays end after a few; some share a position, some all parameters."""
    scene = scattered_cloud(rng, 120, size=0.4)
    scene.opacities[:] = 1
    scene.means[:6] = scene.means[0]
    scene.means[6:12], scene.scales[6:12], scene.quats[6:12] = scene.means[6], 0.7, scene.quats[6]
    return scene


def odd_quaternions(rng):
    """Quaternions of zero, nearly zero and very large norm."""
    scene = scattered_cloud(rng, 60)
    scene.quats[:10] = 0
    scene.quats[10:20] *= np.float32(1e-14)
    scene.quats[20:30] *= np.float32(1e-9)
    scene.quats[30:40] *= np.float32(1e9)
    return scene


def crowd(rng):
    """Two thousand Gaussians at one pixel."""
    scene = scattered_cloud(rng, 2000, width=18, height=17, degree=1, size=0.02)
    scene.means[:] *= np.float32(0.02)
    scene.opacities[:] = rng.uniform(0, 0.03, size=2000)
    return scene


def no_gaussians(rng):
    return scattered_cloud(rng, 0)


def one_pixel_image(rng):
    return scattered_cloud(rng, 50, width=1, height=1, degree=2)


def whole_tile_image(rng):
    return scattered_cloud(rng, 60, width=32, height=16, degree=0)


def tall_image(rng):
    return scattered_cloud(rng, 60, width=5, height=49, degree=2)


SCENES = [
    scattered_cloud, camera_inside, means_at_border, needles, discs, huge_gaussians, faint_gaussians, opaque_gaussians,
    odd_quaternions, crowd, no_gaussians, one_pixel_image, whole_tile_image, tall_image,
]  # fmt: skip


def make_scene(kind, seed=0):
    return kind(np.random.default_rng([seed, SCENES.index(kind)]))
