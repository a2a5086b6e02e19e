"""Maps: a cloud coloured by its distances, and the reference in its own colours, in one frame."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from pcbench.geometry.arrays import FloatArray
from pcbench.geometry.cloud import Cloud
from pcbench.measure.wording import pluralize
from pcbench.report.colors import Classes, Range, has_colors, height_range
from pcbench.report.figures import Figures, rgb
from pcbench.report.plot.panels import Image, compose, join_title
from pcbench.report.plot.splats import Backdrop, splat
from pcbench.report.plot.views import AxisBox, Frame, Viewpoint
from pcbench.report.viewing import ViewingCameras

_DEFAULT_BACKGROUND = "dark"  # large distances are light and have a high contrast
_MAX_OUTSIDE_SHARE = 0.5  # of a cloud's points outside the common frame; beyond it the cloud has a separate frame
_MIN_REPORTED_SHARE = 0.001  # of points outside the frame, for a note in the title


def frame(measured: Cloud | None, clouds: Mapping[str, Cloud], cameras: ViewingCameras | None = None) -> Frame:
    """Return the common frame: the measured region of the reference, enlarged for candidates that extend beyond it.

    Candidates that are far off are ignored.

    Args:
        measured: the measured points of the reference; None in reports without them.
        clouds: the measured points of the candidates.
        cameras: the cameras that photographed the scene, in the same coordinates.
    """
    if measured is None:
        boxes = [AxisBox.around(cloud.points) for cloud in clouds.values()]
        box = AxisBox(np.min([box.low for box in boxes], axis=0), np.max([box.high for box in boxes], axis=0))
        has_north = all(cloud.crs is not None for cloud in clouds.values())
        return Frame.of(box, [cloud.points for cloud in clouds.values()], has_north=has_north, cameras=cameras)
    box = AxisBox.around(measured.points)
    near = [cloud.points for cloud in clouds.values() if box.grown().share(cloud.points) > 1 - _MAX_OUTSIDE_SHARE]
    box = box.widen(map(AxisBox.around, near))
    return Frame.of(box, [measured.points, *near], has_north=measured.crs is not None, cameras=cameras)


class Framing(NamedTuple):
    """The frame, the unit of lengths and the appearance that the pictures of a scene have in common."""

    frame: Frame
    unit: str
    look: Figures

    @property
    def ground(self) -> NDArray[np.uint8]:
        """Background colour (3,) of clouds."""
        return rgb(self.look.ground(_DEFAULT_BACKGROUND))


class Scenery:
    """The measured points of the reference, rendered once per view as the backdrop of all maps.

    Args:
        points: (N, 3) points.
        framing: frame and appearance of the pictures.
    """

    def __init__(self, points: FloatArray, framing: Framing) -> None:
        self.points, self.framing = points, framing
        self._backdrops: dict[tuple[str, tuple[int, int]], Backdrop] = {}

    def in_frame(self, other: Frame) -> Scenery:
        """Return the same points in another frame."""
        return Scenery(self.points, self.framing._replace(frame=other))

    def backdrop(self, view: Viewpoint, window: FloatArray, pixels: tuple[int, int]) -> Backdrop:
        """Return the rendered points of a view."""
        key = view.title, pixels
        if key not in self._backdrops:
            points = self.points - self.framing.frame.box.center
            self._backdrops[key] = Backdrop.of(points, view, window, pixels, self.framing.ground)
        return self._backdrops[key]


def draw_coloured_cloud(
    cloud: Cloud, values: FloatArray, title: str, scale: Range | Classes, label: str, scenery: Scenery, path: Path
) -> bool:
    """Draw a cloud coloured by a scalar; it has a separate frame if most of it is outside the shared one.

    Args:
        cloud: the cloud.
        values: (N,) the scalar, NaN if unknown.
        title: title of the picture.
        scale: the colour range, or the colours of few values.
        label: label of the colour bar or the legend.
        scenery: the reference behind the cloud, in the common frame.
        path: the file to write.
    """
    is_known = np.isfinite(values)
    points, values = cloud.points[is_known], values[is_known]
    frame, note = frame_of(points, scenery.framing.frame, has_north=cloud.crs is not None)
    if frame is not scenery.framing.frame:
        scenery = scenery.in_frame(frame)
    image = _image(points, scale.colors(values), scenery.framing, scenery)
    _, unit, look = scenery.framing
    compose(image, frame, join_title(title, note), unit, path, look, scale=scale, label=label)
    return True


def frame_of(points: FloatArray, shared: Frame, *, has_north: bool = False) -> tuple[Frame, str]:
    """Return the common frame, or a separate one if it lacks most of the points (N, 3), and a note for the title."""
    outside = 1 - shared.box.share(points)
    if outside > _MAX_OUTSIDE_SHARE:
        note = f"separate frame: {100 * outside:.0f} % of the points are outside the common one"
        separate = Frame.of(AxisBox.around(points), [points], has_north=has_north, cameras=shared.cameras)
        return separate, note
    note = f"{100 * outside:.1f} % of points outside the frame" if outside > _MIN_REPORTED_SHARE else ""
    return shared, note


def draw_own_colors(name: str, cloud: Cloud | None, framing: Framing, path: Path) -> bool:
    """Draw a cloud in its own colours, or coloured by height; return false if there is no cloud.

    Args:
        name: name of the cloud, for the title.
        cloud: the cloud.
        framing: the common frame, unit and appearance of the picture.
        path: the file to write.
    """
    if cloud is None:
        return False
    colors, scale = cloud.colors, None
    if colors is None or not has_colors(colors):
        heights, is_inside = cloud.points[:, 2], framing.frame.box.holds(cloud.points)
        scale = height_range(heights[is_inside] if is_inside.any() else heights)
        colors = scale.colors(heights)
    frame, unit, look = framing
    title = f"{name} ({pluralize(len(cloud), 'point')})"
    image = _image(cloud.points, colors, framing)
    compose(image, frame, title, unit, path, look, scale=scale, label=f"height [{unit}]")
    return True


def _image(points: FloatArray, colors: NDArray[np.uint8], framing: Framing, scenery: Scenery | None = None) -> Image:
    centered, ground = points - framing.frame.box.center, framing.ground

    def image(view: Viewpoint, window: FloatArray, pixels: tuple[int, int]) -> NDArray[np.uint8]:
        backdrop = None if scenery is None else scenery.backdrop(view, window, pixels)
        return splat(centered, colors, view, window, pixels, ground, backdrop=backdrop)

    return image
