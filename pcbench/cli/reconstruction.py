"""Commands for reconstructors: plugins, reconstruct."""

from __future__ import annotations

import textwrap
from pathlib import Path
from typing import TYPE_CHECKING

import click

from pcbench.cli.completion import reconstructor_names
from pcbench.cli.help import argument, command, option
from pcbench.cli.messages import notice_unless, steps, warn, warn_unless
from pcbench.cli.options import (
    FILE,
    POSITIVE,
    accuracy_option,
    cameras_option,
    image_scale_option,
    key_value,
    masks_option,
    quiet_option,
    wgs84_option,
    write_cameras_option,
)
from pcbench.cli.training import TrainingPage
from pcbench.errors import InputError
from pcbench.options import OptionGroup

if TYPE_CHECKING:
    from pcbench.geometry.cloud import Cloud
    from pcbench.io.check_points import CheckPoints


@command(short_help="List the reconstructors, or describe some.")
@argument("specs", values=reconstructor_names, nargs=-1, metavar="[NAME | MODULE:CLASS | FILE.py:CLASS]...")
@option(
    "--time-limit",
    type=POSITIVE,
    default=60.0,
    show_default=True,
    metavar="SECONDS",
    help="Time limit for importing each reconstructor.",
)
def plugins(specs: tuple[str, ...], time_limit: float) -> None:
    """List the installed reconstructors, or describe the given ones.

    A description gives the origin, the purpose, whether the reconstructor can run here, and its settings with types and
    defaults.
    """
    from pcbench.plugins import installed_reconstructors
    from pcbench.plugins.run import describe

    for spec in specs or installed_reconstructors():
        with steps(quiet=False) as step:
            step(f"describing {spec}")
            plugin = describe(spec, time_limit)
        if plugin.problem is not None:
            problem = (
                plugin.problem if plugin.problem.startswith(spec.rpartition(":")[0]) else f"{spec}: {plugin.problem}"
            )
            if specs:
                raise InputError(problem)
            click.echo(problem)  # the list continues after a broken reconstructor
            continue
        click.echo(f"{spec} ({plugin.origin}): {plugin.help or 'no description'}")
        if specs and plugin.more:
            click.echo(textwrap.indent(f"\n{plugin.more}\n", "  "))
        click.echo(f"  {'can run here' if plugin.missing is None else f'cannot run here: {plugin.missing}'}")
        for setting, kind, default in zip(plugin.settings, plugin.types, plugin.defaults, strict=True):
            click.echo(f"  --set {setting}={kind}  ({'must be given' if default is None else f'default {default}'})")


@command(short_help="Make a cloud from photographs with a reconstructor.")
@argument("name", metavar="NAME", values=reconstructor_names)
@click.argument("scene", type=FILE)
@option("-o", "--out", type=FILE, metavar="FILE", required=True, help="File for the cloud.")
@option(
    "--set",
    "settings",
    multiple=True,
    metavar="KEY=VALUE",
    help="Setting of the reconstructor; may be repeated.",
)
@cameras_option()
@masks_option
@image_scale_option
@option(
    "--workspace",
    type=FILE,
    metavar="FOLDER",
    help="Folder for intermediate files, from which the next run resumes.  [default: OUT.work]",
    group=OptionGroup.LARGE_DATA,
)
@option(
    "--time-limit",
    type=POSITIVE,
    metavar="SECONDS",
    help="Time after which the reconstructor is stopped.",
    group=OptionGroup.LARGE_DATA,
)
@option(
    "--crs",
    metavar="CRS",
    help="Write cloud and cameras in this projected coordinate system, such as EPSG:32617, by GPS in EXIF or by cameras"
    " with a known origin.",
    group=OptionGroup.COORDINATES,
)
@accuracy_option("--crs")
@wgs84_option("cloud and cameras")
@write_cameras_option
@option(
    "--checkpoints",
    type=FILE,
    metavar="FILE",
    help="Also test the cloud by the check points in this file, as `pcbench checkpoints` does.",
    group=OptionGroup.METRICS,
)
@quiet_option
def reconstruct(
    name: str,
    scene: Path,
    out: Path,
    settings: tuple[str, ...],
    cameras: str,
    masks: Path | None,
    image_scale: float,
    workspace: Path | None,
    time_limit: float | None,
    crs: str | None,
    accuracy: float | None,
    wgs84: bool,
    write_cameras: Path | None,
    checkpoints: Path | None,
    quiet: bool,
) -> None:
    """Make a cloud from the photographs in SCENE with the reconstructor NAME.

    NAME is an installed reconstructor (`pcbench plugins`), MODULE:CLASS or FILE.py:CLASS. It runs in a child process.

    \b
    Example: pcbench reconstruct sfm photos/ -o cloud.ply --set mapping=global
    """
    from pcbench.io import check_cloud_output, write_cloud
    from pcbench.io.check_points import read_check_points
    from pcbench.io.outputs import check_output
    from pcbench.plugins.projected import check_georeferencing, in_crs
    from pcbench.plugins.run import ReconstructionJob, check_workspace, is_recorded_output, record_output, run
    from pcbench.plugins.wgs84 import in_wgs84
    from pcbench.regular_files import is_regular_file
    from pcbench.scenes import read_scene
    from pcbench.scenes.folders import find_images
    from pcbench.scenes.write import camera_output_files, check_cameras_output
    from pcbench.scenes.write import write_cameras as write
    from pcbench.scratch import lock_output

    values = dict(key_value(text) for text in settings)
    named = [Path(text) for text in (name.rpartition(":")[0], *values.values()) if is_regular_file(text)]
    work = workspace or out.with_suffix(".work")
    check_points = None if checkpoints is None else read_check_points(checkpoints)
    named = [*named, *filter(None, [checkpoints])]
    inputs = [scene, *named, *filter(None, [masks]), *([] if cameras in ("auto", "none") else [Path(cameras)])]
    others = [] if write_cameras is None else camera_output_files(write_cameras)
    check_cloud_output(out, inputs if not is_recorded_output(work, out) else named, others)
    if write_cameras is not None:
        check_cameras_output(write_cameras, scene)
    for file in filter(Path.exists, others):
        check_output(file, inputs)
    if accuracy is not None and crs is None:
        raise click.UsageError("--accuracy needs --crs, the coordinate system of the cloud")
    sphere = None
    if wgs84 or crs is not None:
        photographs = read_scene(scene, cameras=cameras, on_warning=lambda _: None)
        if crs is not None:
            check_georeferencing(photographs, crs, accuracy)
        if wgs84 or photographs.on_sphere:
            sphere = photographs.sphere_origin()
    job = ReconstructionJob(name, scene, values, cameras=cameras, masks=masks, image_scale=image_scale)
    click.get_current_context().with_resource(lock_output(out))
    with steps(quiet) as step:
        step(f"reconstructing with {name}")
        check_workspace(work)
        page = TrainingPage(work, notice_unless(quiet))

        def show(text: str) -> None:
            step(f"reconstructing with {name}: {text}")
            page.update()

        result = run(job, work, time_limit, show)
    page.update(running=False)
    for warning in result.warnings:
        if not (sphere is not None and "--wgs84" in warning):
            warn_unless(quiet)(warning)
    reconstruction = result.require_reconstruction()
    if sphere is not None and reconstruction.gauge == "georeferenced":
        reconstruction = in_wgs84(reconstruction, sphere)
    elif sphere is not None:
        warn(f"not converted to WGS84: the cloud has the gauge {reconstruction.gauge}, not the frame of the cameras")
    if crs is not None:
        reconstruction = in_crs(reconstruction, crs, accuracy=accuracy)
    write_cloud(out, reconstruction.cloud, on_warning=warn_unless(quiet))
    record_output(work, out)
    if write_cameras is not None and not reconstruction.cameras:
        warn(f"{write_cameras}: not written, because {name} returned no cameras")
    elif write_cameras is not None:
        write(write_cameras, reconstruction.cameras, find_images(scene).folder, reconstruction.cloud)
    for note in reconstruction.notes:
        if note.startswith("warning: "):
            warn_unless(quiet)(note.removeprefix("warning: "))
        elif not quiet:
            click.echo(f"note: {note}")
    if not quiet:
        for line in (
            *reconstruction.residuals.point_lines(reconstruction.cloud.unit),
            *reconstruction.residuals.rmse_lines(reconstruction.cloud.unit),
        ):
            click.echo(line)
        memory = "" if result.peak_rss_bytes is None else f", {result.peak_rss_bytes / 2**20:.0f} MiB"
        points, cameras_count = len(reconstruction.cloud), len(reconstruction.cameras)
        click.echo(f"{out}: {points:,} points, {reconstruction.gauge}, {cameras_count} cameras")
        click.echo(f"{result.wall_s:.1f} s, {result.cpu_s:.1f} CPU s{memory}")
    if check_points is not None and reconstruction.gauge != "georeferenced":
        warn(
            f"{checkpoints}: not used, because the cloud has the gauge {reconstruction.gauge}, not the frame of the"
            " check points: give cameras in it"
        )
    elif check_points is not None and not quiet:
        for line in _accuracy_lines(check_points, reconstruction.cloud, out.name):
            click.echo(line)


def _accuracy_lines(check_points: CheckPoints, cloud: Cloud, name: str) -> list[str]:
    """Return the accuracy of a cloud by check points in sentences."""
    from pcbench.measure.checkpoints import CheckPointSettings, PlanNeighbors, assess
    from pcbench.measure.checkpoints.statement import statements
    from pcbench.report.checkpoints import accuracy_sentences, method_sentence

    neighbors, settings = PlanNeighbors(check_points.points[:, :2]), CheckPointSettings()
    neighbors.add(cloud.points)
    accuracy = assess(check_points, neighbors, settings, cloud.unit)
    lines = [*accuracy_sentences(accuracy, name), method_sentence(accuracy), *statements(accuracy, settings)]
    return [*lines, *check_points.notes]
