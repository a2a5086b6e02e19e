"""Maps: a cloud coloured by its distances, and the reference as it is; all of them in one frame."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pcbench.geometry.arrays import FloatArray
from pcbench.geometry.cloud import Cloud
from pcbench.measure.wording import counted
from pcbench.report.colors import Range
from pcbench.report.figures import Figures
from pcbench.report.plot.panels import Image, compose, titled
from pcbench.report.plot.splats import splat
from pcbench.report.plot.views import AxisBox, Frame

LABELS = {
    "distance": "distance to the nearest reference point",
    "completeness": "distance to the nearest point of the candidate",
    "plane_distance": "signed distance to the reference's tangent plane",
    "mesh_distance": "distance to the reference mesh",
    "poisson_distance": "distance to the reference's Poisson mesh",
    "m3c2_distance": "M3C2 distance along the reference's normal",
}
_GROUND = "dark"  # where the user chose none: large distances are light, and stand out
_MOST_OUTSIDE = 0.5  # of a cloud's points: else it is framed for itself
_WORTH_SAYING = 0.001  # of its points outside of the picture


def frame(measured: Cloud | None, clouds: Mapping[str, Cloud]) -> Frame:
    """What all pictures show: the measured region of the reference, and somewhat beyond it where candidates lie there.
    One that is far off does not decide.

    Args:
        measured: the reference's measured points; None in reports that do not hold them.
        clouds: the candidates' measured points.
    """
    if measured is None:
        boxes = [AxisBox.around(cloud.points) for cloud in clouds.values()]
        box = AxisBox(np.min([box.low for box in boxes], axis=0), np.max([box.high for box in boxes], axis=0))
        return Frame.of(box, [cloud.points for cloud in clouds.values()])
    box = AxisBox.around(measured.points)
    near = [cloud.points for cloud in clouds.values() if box.grown().share(cloud.points) > 1 - _MOST_OUTSIDE]
    return Frame.of(box.widened(map(AxisBox.around, near)), [measured.points, *near])


def coloured(
    cloud: Cloud, values: FloatArray, title: str, scale: Range, label: str, unit: str, shared: Frame, path: Path,
    look: Figures,
) -> bool:  # fmt: skip
    """A cloud by one scalar, NaN where it has none; framed for itself where most of it is outside the shared frame."""
    known = np.isfinite(values)
    points, values = cloud.points[known], values[known]
    outside = 1 - shared.box.share(points)
    note = ""
    if outside > _MOST_OUTSIDE:
        shared = Frame.of(AxisBox.around(points), [points])
        note = f"in a frame of its own, {outside:.0%} are outside the others' frame"
    elif outside > _WORTH_SAYING:
        note = f"{outside:.1%} of them outside the picture"
    image = _image(points, scale.colors(values), shared, look)
    compose(image, shared, titled(title, note), unit, path, look, scale=scale, label=label)
    return True


def reference(cloud: Cloud | None, unit: str, shared: Frame, path: Path, look: Figures) -> bool:
    """The reference in its own colours, or by height; False where its file has gone."""
    if cloud is None:
        return False
    colors, note = cloud.colors, ""
    if colors is None:
        height, inside = cloud.points[:, 2], shared.box.holds(cloud.points)
        low, high = np.percentile(height[inside] if inside.any() else height, [0.5, 99.5])
        colors, note = Range(float(low), max(float(high), float(low) + 1e-12)).colors(height), ", coloured by height"
    image = _image(cloud.points, colors, shared, look, shaded=True)
    compose(image, shared, f"reference ({counted(len(cloud), 'point')}{note})", unit, path, look)
    return True


def _image(
    points: FloatArray, colors: NDArray[np.uint8], shared: Frame, look: Figures, *, shaded: bool = False
) -> Image:
    ground = look.ground(_GROUND)
    about = points - shared.box.center
    behind = np.array([int(ground[k : k + 2], 16) for k in (1, 3, 5)], dtype=np.uint8)

    def image(view: Any, window: FloatArray, pixels: tuple[int, int]) -> NDArray[np.uint8]:
        return splat(about, colors, view, window, pixels, behind, shaded=shaded)

    return image
