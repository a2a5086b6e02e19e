"""Command that shows a report, a cloud or a mesh in a window: view."""

from __future__ import annotations

from io import BytesIO
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from pcbench.cli.messages import steps, warn
from pcbench.cli.options import FILE, scene_folder, scene_options
from pcbench.errors import InputError

if TYPE_CHECKING:
    from pcbench.report.inputs import SceneFolder


@click.command(short_help="Show a report, a cloud or a mesh in a window.")
@click.argument("path", type=FILE)
@click.option("--screenshot", type=FILE, metavar="FILE", help="Write a PNG picture instead of opening a window.")
@scene_options
@click.pass_context
def view(context: click.Context, path: Path, screenshot: Path | None, scene: Path | None, cameras: str) -> None:
    """Show PATH in a window: the folder of a report, or a file with a cloud or a mesh.

    In a report, the key N shows the next candidate and M the next map, and a slider sets the end of the colour range. A
    right click on a point prints its coordinates, its deviation and statistics of its closest points.

    \b
    Example: pcbench view report/
    """
    from pcbench.io.colmap import model_file
    from pcbench.opengl import NoFiguresError
    from pcbench.report.plotters.window import check_window

    if not path.exists():
        raise InputError(f"{path}: no such file or folder: check the name")
    viewed = scene_folder(context, scene, cameras)
    is_report = (path / "comparison.json").is_file()
    if not is_report and model_file(path).is_dir():
        raise InputError(f"{path}: expected the folder of a report (with comparison.json), or a file")
    if is_report and viewed is not None:
        raise click.UsageError("--scene is for a file with a cloud, got a report: give --scene to `pcbench compare`")
    if screenshot is not None:
        _check_screenshot(screenshot, [path, *(() if viewed is None else viewed.paths())])
    with steps(quiet=False) as step:
        step("starting OpenGL")
        try:
            check_window(off_screen=screenshot is not None)
        except NoFiguresError as error:
            raise NoFiguresError(f"{error}; {_instead(path, screenshot, is_report=is_report)}") from error
        step(f"reading {path}")
        plotter = _plotter(path, viewed, off_screen=screenshot is not None, is_report=is_report)
    if screenshot is None:
        plotter.show()
    else:
        _write(plotter, screenshot)


def _plotter(path: Path, scene: SceneFolder | None, *, off_screen: bool, is_report: bool) -> Any:
    from pcbench.report.plotters.viewer import ReportViewer, view_file

    if is_report:
        return ReportViewer(path, click.echo, off_screen=off_screen).plotter
    return view_file(path, click.echo, warn, scene=scene, off_screen=off_screen)


def _write(plotter: Any, screenshot: Path) -> None:
    from pcbench.io.files import atomic_write

    picture = BytesIO()
    plotter.screenshot(picture)
    plotter.close()
    with atomic_write(screenshot) as file:
        file.write(picture.getvalue())


def _check_screenshot(screenshot: Path, inputs: list[Path]) -> None:
    from pcbench.io.files import check_output

    if screenshot.suffix.lower() != ".png":
        raise InputError(f"{screenshot}: expected a file name that ends in .png")
    check_output(screenshot, inputs)


def _instead(path: Path, screenshot: Path | None, *, is_report: bool) -> str:
    """Return what to do where no window can be opened, or nothing rendered."""
    if is_report and (path / "report.html").is_file():
        return f"open {path / 'report.html'} in a browser"
    if screenshot is None:
        return f"write a picture with `pcbench view {path} --screenshot FILE.png`"
    drawing = f"`pcbench plot {path}`" if is_report else "`pcbench compare REFERENCE CANDIDATE --out FOLDER`"
    return f"{drawing} draws pictures without OpenGL"
