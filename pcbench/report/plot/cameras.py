"""Pictures of the cameras of a scene: positions, view pyramids, rings and sparse points, or GPS positions."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from pcbench.errors import InputError
from pcbench.extras import require
from pcbench.geometry.arrays import FloatArray
from pcbench.geometry.cameras import Camera
from pcbench.report.colors import BLUE, VERMILION
from pcbench.report.plot.outputs import METADATA, check_picture
from pcbench.report.plot.panels import new_figure
from pcbench.report.viewing import ViewingCameras
from pcbench.scratch import atomic_write

if TYPE_CHECKING:
    from pcbench.scenes import Scene

_CAMERA_COLOR, _PATH_COLOR, _POINT_COLOR = BLUE, VERMILION, "#8a8a8a"
_MAX_POINTS = 20_000


def draw_cameras(scene: Scene, path: Path) -> None:
    """Draw the cameras of a scene from the side and from above as a PNG; without cameras, draw GPS positions.

    If the frame of the cameras has no vertical axis, as in a COLMAP model, the cameras are rotated: for a flight over
    an area they look down, otherwise their images are upright.

    Raises:
        InputError: the scene has neither cameras nor positions, or `path` is a file that pcbench did not draw.
        MissingExtra: matplotlib is not installed.
        OSError: the file cannot be written.
    """
    check_picture(path)
    picture = camera_drawing(scene)
    require("matplotlib.figure")
    from matplotlib.ticker import MaxNLocator

    positions, points, axes = picture.positions, picture.points, picture.axes
    figure = new_figure(14, 6.4, layout="constrained")
    side: Any = figure.add_subplot(1, 2, 1, projection="3d")
    above = figure.add_subplot(1, 2, 2)
    if len(points):
        side.scatter(*points.T, s=1.5, c=_POINT_COLOR, alpha=0.7, linewidths=0)
        above.scatter(points[:, 0], points[:, 1], s=0.8, c=_POINT_COLOR, alpha=0.5, linewidths=0)
    for index, ring in enumerate(rings_of(positions)):
        side.plot(*ring.T, color=_PATH_COLOR, linewidth=1.2)
        above.plot(
            ring[:, 0], ring[:, 1], color=_PATH_COLOR, linewidth=1.2, label=None if index else "order of the images"
        )
    if not picture.outlines:
        side.scatter(*positions.T, s=24, c=_CAMERA_COLOR, linewidths=0, depthshade=False)
        above.scatter(
            positions[:, 0], positions[:, 1], s=24, c=_CAMERA_COLOR, linewidths=0, zorder=3, label="GPS positions"
        )
    for index, outline in enumerate(picture.outlines):
        side.plot(*outline.T, color=_CAMERA_COLOR, linewidth=0.7)
        above.plot(outline[:, 0], outline[:, 1], color=_CAMERA_COLOR, linewidth=0.7, label=None if index else "cameras")
    everything = np.concatenate([*picture.outlines, positions, points])
    middle, extent = everything.min(axis=0) + 0.5 * np.ptp(everything, axis=0), np.ptp(everything, axis=0)
    extent = np.maximum(extent, 0.15 * extent.max() or 1.0)  # a level flight also needs a box with height
    side.set(**{f"{axis}lim": (m - 0.5 * e, m + 0.5 * e) for axis, m, e in zip("xyz", middle, extent, strict=True)})
    side.set_box_aspect(extent, zoom=0.9)
    for axis, label, length in zip((side.xaxis, side.yaxis, side.zaxis), axes, extent, strict=True):
        axis.set_label_text(label)
        axis.set_major_locator(MaxNLocator(2 if length < 0.3 * extent.max() else 5))
    side.set_title("from the side", fontsize=11)
    unit = picture.unit or "units of the cameras"
    above.set_xlabel(f"{axes[0]} [{unit}]")
    above.set_ylabel(f"{axes[1]} [{unit}]")
    above.set_aspect("equal", adjustable="datalim")
    above.grid(True, alpha=0.3)
    above.spines[["top", "right"]].set_visible(False)
    above.set_title("from above", fontsize=11)
    figure.legend(*above.get_legend_handles_labels(), loc="outside lower center", ncols=2, frameon=False)
    figure.suptitle(picture.title, fontsize=12)
    with atomic_write(path) as file:
        figure.savefig(file, format="png", metadata=METADATA["png"])


class CameraDrawing(NamedTuple):
    """Positions (N, 3), view pyramids (11, 3) and points (M, 3) in one frame, its axes and known unit, and a title."""

    positions: FloatArray
    outlines: list[FloatArray]
    points: FloatArray
    axes: tuple[str, str, str]
    unit: str | None
    title: str


def camera_drawing(scene: Scene) -> CameraDrawing:
    """Return what is drawn of a scene, as `draw_cameras` describes it.

    Raises:
        InputError: the scene has neither cameras nor positions.
    """
    return _cameras(scene) if scene.cameras else _gps_positions(scene)


def _cameras(scene: Scene) -> CameraDrawing:
    cameras = [scene.cameras[name] for name in scene.images if name in scene.cameras]
    turn, viewing = ViewingCameras.of(cameras, z_is_up=scene.origin is not None).upright()
    rotation = np.eye(3) if turn is None else turn.rotation
    positions = np.stack([camera.position for camera in cameras]) @ rotation.T
    size = 0.04 * float(np.linalg.norm(np.ptp(positions, axis=0))) or 1.0
    points = (
        _nearby_points(scene.points.points @ rotation.T, positions) if scene.points is not None else np.zeros((0, 3))
    )
    count = f"{len(cameras)} cameras" + (f" of {len(scene)} images" if len(cameras) < len(scene) else "")
    return CameraDrawing(
        positions,
        [_outline(camera, size) @ rotation.T for camera in cameras],
        points,
        ("east", "north", "up") if scene.origin is not None and turn is None else viewing.axis_names,
        "m" if scene.origin is not None else None,
        count + (f", {len(scene.points):,} points" if scene.points is not None else ""),
    )


def _gps_positions(scene: Scene) -> CameraDrawing:
    measured, frame = scene.measured_positions()
    if not measured:
        raise InputError(
            f"{scene.folder}: expected cameras (such as a COLMAP model or transforms.json), or GPS positions in the"
            " images' EXIF or in gps.txt, got neither"
        )
    positions = np.stack([measured[name] for name in scene.images if name in measured])
    axes = ("x", "y", "z") if scene.positions else ("east", "north", "up")
    title = f"no cameras, GPS positions of {len(positions)} of {len(scene)} images, {frame}"
    return CameraDrawing(positions, [], np.zeros((0, 3)), axes, "m", title)


def _outline(camera: Camera, size: float) -> FloatArray:
    """Return the view pyramid of a camera as one line (11, 3) in world coordinates."""
    k = camera.intrinsics
    x, y = np.array([0, k.width]), np.array([0, k.height])
    (left, right), (top, bottom) = (x - k.cx) / k.fx, (y - k.cy) / k.fy
    a, b, c, d, o = [left, top, 1], [right, top, 1], [right, bottom, 1], [left, bottom, 1], [0, 0, 0]
    line = size * np.array([o, a, b, o, c, b, c, d, o, d, a], dtype=np.float64)
    return camera.cam_from_world.inverse().apply(line)


def rings_of(positions: FloatArray) -> list[FloatArray]:
    """Return positions (N, 3) as closed rings about a common vertical axis, or as one line if they form no rings."""
    if len(positions) < 2:
        return []
    # Distance from the axis and height are constant on a ring, so a step that mostly changes them leads to another
    # ring. The mean of the positions is on the axis if the rings are complete.
    radius = np.linalg.norm(positions[:, :2] - positions[:, :2].mean(axis=0), axis=1)
    across = np.linalg.norm(np.diff(np.stack([radius, positions[:, 2]], axis=1), axis=0), axis=1)
    steps = np.linalg.norm(np.diff(positions, axis=0), axis=1)
    rings = np.split(positions, np.flatnonzero(across > 0.5 * steps) + 1)
    if not all(_is_closed(ring) for ring in rings):
        return [positions]
    return [np.concatenate([ring, ring[:1]]) for ring in rings]


def _is_closed(ring: FloatArray) -> bool:
    """Return whether the ends of a line (N, 3) are as close as neighbours."""
    longest = np.linalg.norm(np.diff(ring, axis=0), axis=1).max(initial=0)
    return len(ring) > 3 and bool(np.linalg.norm(ring[0] - ring[-1]) < 1.5 * longest)


def _nearby_points(points: FloatArray, positions: FloatArray) -> FloatArray:
    """Return a sample of points (N, 3) without distant outliers, which would make the cameras small."""
    centre = np.median(points, axis=0)
    distances = np.linalg.norm(points - centre, axis=1)
    reach = max(float(np.quantile(distances, 0.95)), float(np.linalg.norm(positions - centre, axis=1).max()))
    nearby = points[distances <= 1.5 * reach]
    sample: FloatArray = nearby[:: max(1, len(nearby) // _MAX_POINTS)]
    return sample
