"""Interactive views of clouds: each function returns a `pyvista.Plotter` that is not yet shown.

`.show()` opens a window or a notebook's viewer, `.screenshot(file)` writes a picture, and `.export_html(file)` writes a
page; all are pyvista's own. Colours, colour ranges and frames are those of a report's pictures. Lengths are in the
clouds' unit. The plotter's coordinates are relative to a local origin of round numbers, which the titles of the axes
name: OpenGL computes in float32, which would round northings of UTM to half a metre.
"""

from __future__ import annotations

import warnings
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from pcbench.errors import InputError
from pcbench.geometry.arrays import FloatArray
from pcbench.geometry.cloud import Cloud
from pcbench.geometry.mesh import Mesh
from pcbench.io import CloudLike, to_cloud
from pcbench.measure.wording import pluralize
from pcbench.report.colors import has_colors, height_range, ranges_of
from pcbench.report.figures import WINDOW_SIZE, Figures
from pcbench.report.plot.cameras import camera_drawing, rings_of
from pcbench.report.plot.clouds import attribute_values
from pcbench.report.plot.maps import frame
from pcbench.report.plot.views import AxisBox, Frame
from pcbench.report.plotters.displacements import Displacements
from pcbench.report.plotters.stage import Stage, Window
from pcbench.report.scalars import scalar_of
from pcbench.report.viewing import SceneFolder, SceneLike, ViewingCameras, as_scene, up_of, viewing_cameras

__all__ = ["cameras", "cloud", "deviation", "displacements"]

_CAMERA_COLOR, _PATH_COLOR = "#56b4e9", "#e69f00"  # Okabe and Ito; readable on dark and light backgrounds


def cloud(
    cloud: Mesh | CloudLike,
    *,
    scene: SceneLike | None = None,
    unit: str | None = None,
    off_screen: bool | None = None,
    window_size: tuple[int, int] = WINDOW_SIZE,
    background: str = "dark",
    lighting: bool = True,
) -> Any:
    """Return a plotter of a cloud in its own colours, or coloured by height; or of a mesh.

    Args:
        cloud: cloud, (N, 3) array, path of a file with a cloud, or mesh. The means of Gaussian splats are a cloud.
        scene: scene with cameras in the cloud's coordinates, or its folder. They show which way is up and select the
            view.
        unit: unit of the coordinates; default: that of the cloud.
        off_screen: whether to render without a window; default: as pyvista is set up.
        window_size: width and height in pixels.
        background: `dark`, `white`, `black` or `#rrggbb`.
        lighting: whether points behind their surroundings are darker (eye-dome lighting), which shows edges and depth.
            It keeps hues.

    Returns:
        A `pyvista.Plotter`.

    Raises:
        InputError: the cloud, the scene or the background is invalid.
        MissingExtra: pyvista is not installed.
        NoFiguresError: there is neither a display nor EGL nor OSMesa.
    """
    shown = cloud if isinstance(cloud, Mesh) else to_cloud(cloud)
    cameras = _cameras_of(scene, shown)
    window = Window(off_screen, window_size, background, lighting)
    stage = Stage(frame(None, {"": _points(shown)}, cameras), unit or shown.unit, window)
    if isinstance(shown, Mesh):
        stage.add_surface(shown, "mesh", color="#c8ccd0")
        stage.write_title(pluralize(len(shown), "face"))
        return stage.plotter
    if has_colors(shown.colors):
        stage.add_points(shown.points, "cloud", lit=True, scalars=shown.colors, rgb=True, pickable=True)
    else:
        heights = shown.points @ up_of(cameras)
        stage.add_bar(stage.add_values(shown.points, heights, height_range(heights)), "height")
    stage.write_title(pluralize(len(shown), "point"))
    return stage.plotter


def deviation(
    reference: Mesh | CloudLike | None,
    cloud: CloudLike,
    values: str | ArrayLike,
    *,
    scene: SceneLike | None = None,
    label: str | None = None,
    range: float | None = None,
    unit: str | None = None,
    off_screen: bool | None = None,
    window_size: tuple[int, int] = WINDOW_SIZE,
    background: str = "dark",
    lighting: bool = True,
) -> Any:
    """Return a plotter of a cloud coloured by distances, with the reference as a pale ghost.

    Signed values have a diverging colour map that is symmetric about 0, unsigned ones a sequential map from 0. The
    range ends at the 95th percentile of the absolute values. Points whose value is NaN are left out.

    Args:
        reference: cloud, (N, 3) array, path of a file with a cloud, or mesh; None: no ghost.
        cloud: cloud, (M, 3) array, or path of a file, in the reference's coordinates.
        values: (M,) distances, or the name of an attribute of the cloud.
        scene: as in `cloud`.
        label: label of the colour bar; default: the description of a scalar of a report, or the name, or `distance`.
        range: distance at which the colour range ends.
        unit: unit of coordinates and distances; default: that of the reference, or of the cloud.
        off_screen: as in `cloud`.
        window_size: as in `cloud`.
        background: as in `cloud`.
        lighting: as in `cloud`.

    Returns:
        A `pyvista.Plotter`.

    Raises:
        InputError: a cloud, the values, the scene or an option is invalid.
        MissingExtra: pyvista is not installed.
        NoFiguresError: there is neither a display nor EGL nor OSMesa.
    """
    shown = to_cloud(cloud)
    known, scalars = _known_values(shown, values)
    scale = ranges_of({"": scalars}, given=Figures(range=range).range)[""]
    ghost = reference if reference is None or isinstance(reference, Mesh) else to_cloud(reference)
    measured = None if ghost is None else _points(ghost)
    unit = unit or (None if ghost is None else ghost.unit) or shown.unit
    shared = frame(measured, {"": known}, _cameras_of(scene, known if ghost is None else ghost))
    stage = Stage(shared, unit, Window(off_screen, window_size, background, lighting))
    if ghost is not None:
        stage.add_ghost(ghost if isinstance(ghost, Mesh) else ghost.points)
    label = label or (scalar_of(values).label if isinstance(values, str) else "distance")
    stage.add_bar(stage.add_values(known.points, scalars, scale), label)
    stage.write_title(pluralize(len(known), "point"))
    return stage.plotter


def displacements(
    cloud: CloudLike,
    places: ArrayLike,
    vectors: ArrayLike,
    *,
    exaggeration: float | None = None,
    scene: SceneLike | None = None,
    unit: str | None = None,
    off_screen: bool | None = None,
    window_size: tuple[int, int] = WINDOW_SIZE,
    background: str = "dark",
) -> Any:
    """Return a plotter of displacements as exaggerated arrows over a pale cloud, coloured by their vertical part.

    Args:
        cloud: cloud, (N, 3) array, or path of a file with a cloud.
        places: (M, 3) places, such as `deformation.field.places`.
        vectors: (M, 3) displacements there, such as `deformation.field.displacements`.
        exaggeration: factor of the arrows' lengths; default: a round number that makes long arrows 3 to 7 % of the
            scene's diagonal.
        scene: as in `cloud`.
        unit: unit of coordinates and displacements; default: that of the cloud.
        off_screen: as in `cloud`.
        window_size: as in `cloud`.
        background: as in `cloud`.

    Returns:
        A `pyvista.Plotter`.

    Raises:
        InputError: an argument is invalid, or all displacements are zero.
        MissingExtra: pyvista is not installed.
        NoFiguresError: there is neither a display nor EGL nor OSMesa.
    """
    if exaggeration is not None and not (exaggeration > 0 and np.isfinite(exaggeration)):
        raise InputError(f"expected the exaggeration as a positive number, got {exaggeration!r}")
    shown = to_cloud(cloud)
    moved = Displacements.of("", shown.points, places, vectors)
    shared = frame(None, {"": shown}, _cameras_of(scene, shown))
    stage = Stage(shared, unit or shown.unit, Window(off_screen, window_size, background))
    moved.show(stage, exaggeration)
    return stage.plotter


def cameras(
    scene: SceneLike,
    *,
    off_screen: bool | None = None,
    window_size: tuple[int, int] = WINDOW_SIZE,
    background: str = "dark",
) -> Any:
    """Return a plotter of a scene's cameras as pyramids, with their order as a line or rings, and its sparse points.

    Frames without a vertical axis are rotated as in the picture of `pcbench scene --figure`. A scene without cameras is
    shown by its GPS positions.

    Args:
        scene: scene, or folder of one.
        off_screen: as in `cloud`.
        window_size: as in `cloud`.
        background: as in `cloud`.

    Returns:
        A `pyvista.Plotter`.

    Raises:
        InputError: the scene cannot be read, or has neither cameras nor positions.
        MissingExtra: pyvista is not installed.
        NoFiguresError: there is neither a display nor EGL nor OSMesa.
    """
    from pcbench.scenes import read_scene

    given = as_scene(scene)
    drawing = camera_drawing(read_scene(given.path) if isinstance(given, SceneFolder) else given)
    everything = np.concatenate([drawing.positions, drawing.points, *drawing.outlines])
    box = AxisBox(everything.min(axis=0), everything.max(axis=0))
    window = Window(off_screen, window_size, background)
    stage = Stage(Frame.of(box, [everything]), drawing.unit, window, drawing.axes)
    if len(drawing.points):
        stage.add_ghost(drawing.points)
    if rings := rings_of(drawing.positions):
        stage.add_lines(rings, "order", _PATH_COLOR)
    if drawing.outlines:
        stage.add_lines(drawing.outlines, "cameras", _CAMERA_COLOR)
    else:
        stage.add_points(drawing.positions, "cameras", color=_CAMERA_COLOR)
    stage.write_title(drawing.title)
    return stage.plotter


def _cameras_of(scene: SceneLike | None, shown: Cloud | Mesh) -> ViewingCameras | None:
    """Return the cameras of a scene that see a cloud or a mesh, if a scene is given."""
    if scene is None:
        return None
    return viewing_cameras(as_scene(scene), shown, lambda text: warnings.warn(text, stacklevel=4))


def _points(shown: Cloud | Mesh) -> Cloud:
    """Return a cloud, or the vertices of a mesh."""
    return Cloud(shown.vertices) if isinstance(shown, Mesh) else shown


def _known_values(cloud: Cloud, values: str | ArrayLike) -> tuple[Cloud, FloatArray]:
    """Return the points whose value is finite, with their values.

    Raises:
        InputError: the cloud has no such attribute, or not as many points as values; or no value is finite.
    """
    if isinstance(values, str):
        values = attribute_values(cloud, values)
    scalars = np.asarray(values, np.float64)
    if scalars.shape != (len(cloud),):
        raise InputError(f"expected values of shape ({len(cloud)},), one per point, got {scalars.shape}")
    known = np.isfinite(scalars)
    if not known.any():
        raise InputError("expected at least one finite value, got none")
    return (cloud, scalars) if known.all() else (cloud.select(known), scalars[known])
