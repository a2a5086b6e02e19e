"""Camera rigs: concentric circles, a nadir grid, an oblique grid, a realistic drone flight, and one orbit."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from pcbench.errors import InputError, did_you_mean
from pcbench.geometry.arrays import FloatArray
from pcbench.geometry.cameras import Camera, Intrinsics, look_at
from pcbench.geometry.transform import Similarity

# Gao et al.: seven circles about a landmark; radii and altitudes of the smallest and the largest in metres. Those
# between are spaced evenly here, because the paper only states the ends.
_PAPER_RADII = np.linspace(500, 7250, 7)
_PAPER_ALTITUDES = np.linspace(475, 3690, 7)
_TILT_SIGMA_DEG = 1.5  # standard deviation of a drone's tilt about either axis
_MIN_CLEARANCE = 20.0  # m between the highest roof and the lowest flight


@dataclass(frozen=True)
class Site:
    """Photographed square about the origin: its side, its ground height and its highest roof, in metres."""

    extent: float
    ground: float
    top: float


def rig(name: str, count: int, site: Site, intrinsics: Intrinsics) -> list[Camera]:
    """Place `count` cameras named 0001.png, 0002.png, ... over a site.

    Args:
        name: circles (seven, as in Gao et al., scaled to the site), grid (a nadir survey with at least 75 % overlap),
            oblique (the same, tilted by 40 degrees to four sides in turn), drone (a grid with standard deviations of
            1.5 degrees in tilt and 2 % in height; the last sixth of the images is tilted by 25 degrees) or orbit (one
            circle).
        count: number of cameras.
        site: photographed square.
        intrinsics: intrinsics of all cameras.

    Raises:
        InputError: there is no such rig, or the count is less than 1.
    """
    if name not in RIGS:
        raise InputError(f"unknown rig {name!r}: choose one of {', '.join(RIGS)}{did_you_mean(name, RIGS)}")
    if count < 1:
        raise InputError(f"expected at least 1 image, got {count}")
    poses = RIGS[name](count, site, intrinsics)
    return [Camera(f"{k:04d}.png", intrinsics, pose) for k, pose in enumerate(poses, start=1)]


def circles(
    count: int, radii: Sequence[float] | FloatArray, altitudes: Sequence[float] | FloatArray, target: ArrayLike
) -> list[Similarity]:
    """Return poses spread evenly over circles about the vertical through `target` (3,), all looking at `target`.

    Args:
        count: number of poses.
        radii: radius of each circle, in the frame's unit.
        altitudes: z coordinate of each circle; the tilt follows from both.
        target: (3,) point that all cameras look at.
    """
    centre = np.asarray(target, dtype=np.float64)
    poses = []
    for k, part in enumerate(np.array_split(np.arange(count), len(radii))):
        # Each circle is rotated by a fraction of a step relative to the next smaller one. Together they view the scene
        # from all sides, and each image has neighbours in nearly the same direction on the adjacent circles.
        step = 2 * np.pi / max(1, len(part))
        for angle in step * (np.arange(len(part)) + k / len(radii)):
            x, y = centre[:2] + radii[k] * np.array([np.cos(angle), np.sin(angle)])
            poses.append(look_at([x, y, altitudes[k]], centre))
    return poses


def perturbed_positions(cameras: Sequence[Camera], sigma: float, seed: int = 0) -> FloatArray:
    """Return positions (N, 3) with errors like those of a GPS receiver.

    The errors are Gaussian. Their standard deviation is `sigma` metres along each horizontal axis and twice that
    vertically.

    Args:
        cameras: cameras at their true positions.
        sigma: horizontal standard deviation in metres.
        seed: random seed.
    """
    rng = np.random.default_rng([seed, 11])
    positions = np.array([camera.position for camera in cameras])
    noisy: FloatArray = positions + rng.normal(0, sigma, positions.shape) * [1, 1, 2]
    return noisy


def _gao_circles(count: int, site: Site, intrinsics: Intrinsics) -> list[Similarity]:
    # The radius of the largest circle is slightly larger than the city's side. Altitudes count from the tallest roof,
    # so that no camera of a small circle is inside a tower.
    scale = 1.1 * site.extent / _PAPER_RADII[-1]
    altitudes = site.top + scale * _PAPER_ALTITUDES
    return circles(count, scale * _PAPER_RADII, altitudes, [0, 0, (site.ground + site.top) / 2])


def _orbit(count: int, site: Site, intrinsics: Intrinsics) -> list[Similarity]:
    target = [0, 0, (site.ground + site.top) / 2]
    return circles(count, [0.8 * site.extent], [site.top + 0.4 * site.extent], target)


def _grid(count: int, site: Site, intrinsics: Intrinsics) -> list[Similarity]:
    return _survey(count, site, intrinsics, tilt_deg=0.0)


def _oblique(count: int, site: Site, intrinsics: Intrinsics) -> list[Similarity]:
    return _survey(count, site, intrinsics, tilt_deg=40.0)


def _drone(count: int, site: Site, intrinsics: Intrinsics) -> list[Similarity]:
    """Return a realistic nadir survey: unsteady, turned round after each strip, followed by oblique images."""
    rng = np.random.default_rng(0)  # the same flight for all cities
    steady = _survey(count - count // 6, site, intrinsics, tilt_deg=0.0)
    positions = np.array([-pose.rotation.T @ pose.translation for pose in steady])
    height = float(positions[0, 2]) - site.ground
    strip = np.cumsum(np.diff(positions[:, 1], prepend=positions[0, 1]) != 0)
    nadir = []
    for position, heading in zip(positions, np.where(strip % 2, 180.0, 0.0), strict=True):
        tilt, yaw = np.tan(np.radians(rng.normal(0, _TILT_SIGMA_DEG, 2))), np.radians(heading + rng.normal(0, 3))
        eye = position + [0, 0, 0.02 * height * rng.normal()]
        nadir.append(look_at(eye, eye + [*tilt, -1], up=[np.sin(yaw), np.cos(yaw), 0]))
    return [*nadir, *_survey(count // 6, site, intrinsics, tilt_deg=25.0, height=height)]


def _survey(
    count: int, site: Site, intrinsics: Intrinsics, tilt_deg: float, height: float | None = None
) -> list[Similarity]:
    """Return strips that alternate between west to east and east to west.

    By default the height gives at least 75 % overlap on the ground in both directions, and clears the roofs.
    """
    shape = intrinsics.width / intrinsics.height
    columns = max(1, round(np.sqrt(count / shape)))
    rows = -(-count // columns)
    lanes = [np.linspace(-0.5, 0.5, n + 2)[1:-1] * site.extent * (n + 1) / (n + 0.5) for n in (columns, rows)]
    step = site.extent / np.array([columns, rows])
    height = height or max(
        4 * step[0] * intrinsics.fx / intrinsics.width,
        4 * step[1] * intrinsics.fy / intrinsics.height,
        site.top - site.ground + _MIN_CLEARANCE,
    )
    reach = height * np.tan(np.radians(tilt_deg))
    poses = []
    for k in range(count):
        row, index_in_row = divmod(k, columns)
        column = index_in_row if row % 2 == 0 else columns - 1 - index_in_row
        ground = np.array([lanes[0][column], lanes[1][row], site.ground])
        side = np.array([(0, 1), (1, 0), (0, -1), (-1, 0)][k % 4])
        position = ground + [*(-side * reach), height]
        # The image's upper side points in the viewing direction, or north in a nadir image.
        poses.append(look_at(position, ground, up=[*side, 0.0] if tilt_deg else [0.0, 1.0, 0.0]))
    return poses


RIGS = {"circles": _gao_circles, "grid": _grid, "oblique": _oblique, "drone": _drone, "orbit": _orbit}
