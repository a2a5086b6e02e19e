"""Command that shows a report, a cloud or a mesh in a window: view."""

from __future__ import annotations

from io import BytesIO
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from pcbench.cli.help import command, option
from pcbench.cli.messages import steps, warn
from pcbench.cli.options import FILE, scene_folder, scene_options
from pcbench.cli.training import PAGE
from pcbench.errors import InputError

if TYPE_CHECKING:
    from pcbench.report.viewing import SceneFolder


@command(short_help="Show a report, a cloud or a mesh in a window.")
@click.argument("path", type=FILE)
@option("--screenshot", type=FILE, metavar="FILE", help="Write a PNG picture instead of opening a window.")
@scene_options
@click.pass_context
def view(context: click.Context, path: Path, screenshot: Path | None, scene: Path | None, cameras: str) -> None:
    """Show PATH in a window: the folder of a report or of `pcbench deform`, or a file with a cloud or a mesh.

    PATH may also be the workspace of a reconstruction with `splat` (OUT.work): the window shows the points of the model
    while it is trained, and how far the training is.

    In a report, the key N shows the next candidate, M its next map, D its displacements, and L switches the lighting. A
    slider sets the end of the colour range or the exaggeration of displacements. A right click on a point prints its
    coordinates, its deviation and statistics of its closest points.

    \b
    Example: pcbench view report/
    """
    from pcbench.io.colmap import model_file
    from pcbench.opengl import NoFiguresError
    from pcbench.report.plot import REPORT
    from pcbench.report.plotters.training import TrainingViewer
    from pcbench.report.plotters.window import check_window
    from pcbench.scenes.previews import find_preview

    if not path.exists():
        raise InputError(f"{path}: no such file or folder: check the name")
    viewed = scene_folder(context, scene, cameras)
    is_folder = REPORT.fits(path)
    training = None if is_folder else find_preview(path)
    if training is None and not is_folder and model_file(path).is_dir():
        raise InputError(
            f"{path}: expected the folder of a report (with comparison.json) or of `pcbench deform` (with"
            " deformation.json), the workspace of a training, or a file"
        )
    if viewed is not None and training is not None:
        raise click.UsageError("--scene is for files and folders of `pcbench deform`, got the workspace of a training")
    if viewed is not None and (path / "comparison.json").is_file():
        raise click.UsageError(
            "--scene is for files and folders of `pcbench deform`, got a report: give --scene to `pcbench compare`"
        )
    if screenshot is not None:
        _check_screenshot(screenshot, [path, *(() if viewed is None else viewed.paths())])
    with steps(quiet=False) as step:
        step("starting OpenGL")
        try:
            check_window(off_screen=screenshot is not None)
        except NoFiguresError as error:
            raise NoFiguresError(f"{error}; {_instead(path, screenshot, is_folder=is_folder)}") from error
        step(f"reading {path}")
        if training is not None:
            plotter = TrainingViewer(training, off_screen=screenshot is not None).plotter
        else:
            plotter = _plotter(path, viewed, off_screen=screenshot is not None)
    if screenshot is None:
        plotter.show()
    else:
        _write(plotter, screenshot)


def _plotter(path: Path, scene: SceneFolder | None, *, off_screen: bool) -> Any:
    from pcbench.report.plotters.viewer import ReportViewer, view_deformation, view_file

    if (path / "comparison.json").is_file():
        return ReportViewer(path, click.echo, off_screen=off_screen).plotter
    if (path / "deformation.json").is_file():
        return view_deformation(path, warn, scene=scene, off_screen=off_screen)
    return view_file(path, click.echo, warn, scene=scene, off_screen=off_screen)


def _write(plotter: Any, screenshot: Path) -> None:
    from pcbench.scratch import atomic_write

    picture = BytesIO()
    plotter.screenshot(picture)
    plotter.close()
    with atomic_write(screenshot) as file:
        file.write(picture.getvalue())


def _check_screenshot(screenshot: Path, inputs: list[Path]) -> None:
    from pcbench.io.outputs import check_output

    if screenshot.suffix.lower() != ".png":
        raise InputError(f"{screenshot}: expected a file name that ends in .png")
    check_output(screenshot, inputs)


def _instead(path: Path, screenshot: Path | None, *, is_folder: bool) -> str:
    """Return what to do where no window can be opened, or nothing rendered."""
    if is_folder and (path / "report.html").is_file():
        return f"open {path / 'report.html'} in a browser"
    if (path / PAGE).is_file():
        return f"open {path / PAGE} in a browser"
    if screenshot is None:
        return f"write a picture with `pcbench view {path} --screenshot FILE.png`"
    drawing = f"`pcbench plot {path}`" if is_folder else "`pcbench compare REFERENCE CANDIDATE --out FOLDER`"
    return f"{drawing} draws pictures without OpenGL"
