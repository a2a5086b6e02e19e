"""Commands that measure clouds against a reference and draw the results: compare, deform, plot."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from pcbench.cli.conditions import fail_if_any, fail_if_option
from pcbench.cli.help import command, option
from pcbench.cli.json_output import JsonOutput, json_option
from pcbench.cli.log import LOGGER
from pcbench.cli.messages import EarlyOutput, notice_unless, steps, warn, warn_of_missing, warn_unless
from pcbench.cli.options import (
    FILE,
    background_option,
    crop_option,
    figure_options,
    format_option,
    is_given,
    no_figures_option,
    quiet_option,
    register_option,
    scene_folder,
    scene_options,
    seed_option,
    vertices_option,
)
from pcbench.cli.settings_command import SettingsCommand, limit_openblas
from pcbench.errors import InputError
from pcbench.options import OptionGroup

if TYPE_CHECKING:
    from pcbench.comparison.request import Request
    from pcbench.comparison.result import Comparison
    from pcbench.report.conditions import Condition
    from pcbench.report.figures import Figures
    from pcbench.report.viewing import SceneFolder


@command(
    short_help="Measure candidate clouds against a reference.",
    cls=SettingsCommand,
    settings=("pcbench.measure.settings:Settings", "pcbench.measure.tiled.settings:TilingSettings"),
    after="out",
)
@click.argument("reference", type=FILE, required=False)
@click.argument("candidates", type=FILE, nargs=-1)
@option("--out", type=FILE, metavar="FOLDER", help="Folder for the report; an earlier one is replaced.")
@option(
    "--workspace",
    type=FILE,
    metavar="FOLDER",
    help="Folder for tiles, from which the same command resumes.  [default: hidden, beside --out]",
    group=OptionGroup.LARGE_DATA,
)
@option(
    "--settings",
    "settings_file",
    type=FILE,
    metavar="FILE",
    help="Repeat the comparison of a report's settings.json.",
    group=OptionGroup.INPUT,
)
@json_option("comparison.json")
@fail_if_option("a candidate in comparison.json", "d2_rms.c2r > 0.2")
@option(
    "--table",
    type=click.Choice(["latex", "markdown", "csv"]),
    metavar="KIND",
    help="Print a table instead of the answer: latex (main metrics), markdown or csv (all metrics).",
    group=OptionGroup.OUTPUT,
)
@scene_options
@no_figures_option()
@option("--full", is_flag=True, help="Print all metrics, verdicts and differences.")
@figure_options
@quiet_option
@click.pass_context
def compare(
    context: click.Context,
    /,
    reference: Path | None,
    candidates: tuple[Path, ...],
    out: Path | None,
    workspace: Path | None,
    settings_file: Path | None,
    json_file: str | None,
    fail_if: tuple[Condition, ...],
    table: str | None,
    scene: Path | None,
    cameras: str,
    no_figures: bool,
    full: bool,
    background: str | None,
    color_range: float | None,
    figure_format: str | None,
    quiet: bool,
    **given: Any,
) -> None:
    """Measure the distances between CANDIDATES and REFERENCE in both directions.

    Prints the answer in a few sentences, then warnings and the main metrics. The folder of --out has a page to
    read in a browser, all metrics, maps and pictures.

    \b
    Example: pcbench compare ref.ply a.ply b.ply --out report/
    """
    from pcbench.comparison.request import Request, TilingChoice
    from pcbench.measure.settings import Settings
    from pcbench.measure.tiled.settings import TilingSettings
    from pcbench.options import from_options, options_of, split_names
    from pcbench.report.figures import Figures

    viewed = scene_folder(context, scene, cameras)
    tiling = TilingChoice.of(from_options(TilingSettings, given), workspace, is_auto=given["tile_points"] is not None)
    if settings_file is not None:
        numbers_depend_on = {*options_of(Settings), "max_distance", "skip_bad"} - {"metrics"}
        if reference is not None or any(is_given(context, name) for name in numbers_depend_on):
            raise click.UsageError(
                "--settings already has the files and the settings: give only options for outputs, and no REFERENCE or"
                " CANDIDATES"
            )
        request = Request.repeat(settings_file, split_names(given["metrics"])).with_outputs(tiling, viewed)
        request = replace(request, figures=request.figures.with_changes(background, color_range, figure_format))
    elif reference is None or not candidates:
        raise click.UsageError("expected a reference and at least one candidate: pcbench compare ref.ply a.ply")
    else:
        figures = Figures().with_changes(background, color_range, figure_format)
        settings = from_options(Settings, given)
        request = Request.of(reference, candidates, settings, figures=figures, scene=viewed, tiles=tiling)
    if table is not None and (full or json_file == "-"):
        raise click.UsageError("--table prints only a table: omit --full, and give --json a file")
    compare_and_print(
        request, out, json_file, figures=not no_figures, quiet=quiet, full=full, table=table, fail_if=fail_if
    )


def compare_and_print(
    request: Request,
    out: Path | None,
    json_file: str | None,
    *,
    figures: bool,
    quiet: bool,
    full: bool = False,
    table: str | None = None,
    fail_if: Sequence[Condition] = (),
) -> Comparison:
    """Compare files, write the outputs, print the answer, a table or the JSON document, and test conditions."""
    from pcbench.comparison.run import Outputs, run
    from pcbench.report import document, print_outputs, print_result
    from pcbench.report.conditions import check_names
    from pcbench.report.document import OMITTED_KEYS, candidate_values
    from pcbench.report.exports import TABLES
    from pcbench.report.notes import warnings

    output = JsonOutput(json_file)
    output.check(request.files, folder=out)
    if request.tiles is not None and request.tiles.workspace is not None:
        output.check([], folder=request.tiles.workspace)  # which is removed at the end
    if fail_if:
        from pcbench.comparison.rehearsal import rehearse

        untested = "the comparison does not test for deformation (--no-deformation)"
        absent = {} if request.settings.deformation else {"deformation": untested}
        check_names(fail_if, rehearse(request.settings), OMITTED_KEYS, absent)
    prints = table is None and not output.on_stdout and not quiet
    with steps(quiet) as step:
        early = EarlyOutput(step)

        def show(comparison: Comparison) -> None:
            """Print the answer before pictures are drawn, which takes as long as the comparison of small clouds."""
            if prints:
                early.print(lambda: print_result(comparison, full=full))

        outcome = run(request, Outputs(out, figures), step=step, on_notice=notice_unless(quiet), on_comparison=show)
    for text in warnings(outcome.comparison):
        LOGGER.warning("%s", text)
    if json_file is not None:
        output.write(document(outcome.comparison))
    if table is not None:
        click.echo(TABLES[table](outcome.comparison), nl=False)
        for text in warnings(outcome.comparison):
            warn(text)
    early.check()
    if prints:
        print_outputs(outcome.comparison, full=full, folder=out)
    warn_of_missing(outcome)
    if fail_if:
        fail_if_any(fail_if, candidate_values(document(outcome.comparison)), OMITTED_KEYS)
    return outcome.comparison


@command(short_help="Test whether a cloud is deformed relative to a reference.")
@click.argument("reference", type=FILE)
@click.argument("candidate", type=FILE)
@option("--out", type=FILE, metavar="FOLDER", help="Folder for deformation.json, the displacements and pictures.")
@register_option()
@crop_option
@vertices_option
@no_figures_option()
@seed_option("Random seed for the samples on meshes and the folds of cross-validation.", OptionGroup.METRICS)
@json_option("deformation.json")
@background_option
@format_option
@quiet_option
def deform(
    reference: Path,
    candidate: Path,
    out: Path | None,
    register: str,
    crop: str,
    vertices: bool,
    no_figures: bool,
    seed: int,
    json_file: str | None,
    background: str | None,
    figure_format: str | None,
    quiet: bool,
) -> None:
    """Register CANDIDATE to REFERENCE, and test whether it is deformed, by how much, and where.

    \b
    Example: pcbench deform ref.ply a.ply --out bend/
    """
    limit_openblas()
    from pcbench.comparison.deform import deform_files
    from pcbench.io.source import Source
    from pcbench.measure.settings import Settings
    from pcbench.report.deformed import deformation_lines
    from pcbench.report.document import deformation_values
    from pcbench.report.figures import Figures

    style = Figures().with_changes(background, None, figure_format)
    settings = Settings(register=register, crop=crop, seed=seed).with_files_read()
    clouds = Source.open(reference), Source.open(candidate, vertices=vertices)
    output = JsonOutput(json_file)
    output.check([*(file for source in clouds for file in source.files), *settings.files], folder=out)
    with steps(quiet) as step:
        outcome = deform_files(*clouds, settings, out, figures=None if no_figures else style, step=step)
    result = outcome.deformation
    output.write(deformation_values(result))
    say = warn_unless(quiet)
    for warning in outcome.warnings:
        say(warning)
    for notice in result.further_warnings:
        say(str(notice))
    if not quiet and not output.on_stdout:
        for line in deformation_lines(result, candidate.name, outcome.unit, out):
            click.echo(line)
    if outcome.without_figures:
        warn(outcome.without_figures)


@command(short_help="Draw the pictures of a report again, or a picture of a cloud.")
@click.argument("path", type=FILE)
@click.argument("names", nargs=-1)
@option(
    "--out",
    type=FILE,
    metavar="FILE",
    help="Picture of a cloud: .png, .svg or .pdf.  [default: PATH's name with .png, in the working directory]",
)
@option("--scalar", metavar="NAME", help="Attribute that colours a cloud.")
@scene_options
@figure_options
@quiet_option
@click.pass_context
def plot(
    context: click.Context,
    path: Path,
    names: tuple[str, ...],
    out: Path | None,
    scalar: str | None,
    scene: Path | None,
    cameras: str,
    background: str | None,
    color_range: float | None,
    figure_format: str | None,
    quiet: bool,
) -> None:
    """Draw the pictures of the report in the folder PATH again, or a picture of the cloud or mesh in the file PATH.

    The pictures of a report are written into PATH/figures, all or those of NAMES. NAMES of a report are, for example,
    reference, distribution, and for a candidate a a_distance and a_completeness; of a bench, speed and
    accuracy_completeness; of views, SCENE_METHOD; of `experiment gao`, rings, directions and growth; of `experiment
    bend`, bend; of stress, tradeoff and evaluate, the names of the charts. An extension selects the format, as in
    distribution.svg. Options replace the recorded appearance.

    A cloud is drawn in its own colours, by height if it has none, or by an attribute (--scalar), into a file in the
    working directory (--out selects another). No display is needed.

    \b
    Examples: pcbench plot report/ distribution
              pcbench plot scan.las --scalar intensity
    """
    limit_openblas()
    from pcbench.io.colmap import model_file
    from pcbench.report.figures import Figures

    if not path.exists():
        raise InputError(f"{path}: no such file or folder: check the name")
    viewed = scene_folder(context, scene, cameras)
    if model_file(path).is_dir():
        for option, value, instead in (
            ("--out", out, "name its pictures"),
            ("--scalar", scalar, "name its pictures"),
            ("--scene", scene, "give --scene to `pcbench compare`"),
        ):
            if value is not None:
                raise click.UsageError(f"{option} is for a file with a cloud, got a folder: {instead}")
        _plot_report(path, names, background, color_range, figure_format, quiet=quiet)
        return
    if names:
        raise click.UsageError("NAMES select pictures of a report, got a file: give its picture a name by --out")
    if color_range is not None and scalar is None:
        raise click.UsageError("--range needs --scalar, the attribute that colours the cloud")
    if figure_format is not None and out is not None:
        raise click.UsageError("--format and --out both select the format: give --out the extension and omit --format")
    look = Figures().with_changes(background, color_range, figure_format)
    _plot_cloud(path, out or Path(f"{path.stem or path.name}.{look.format}"), look, scalar, viewed, quiet=quiet)


def _plot_report(
    report: Path,
    names: tuple[str, ...],
    background: str | None,
    color_range: float | None,
    figure_format: str | None,
    *,
    quiet: bool,
) -> None:
    """Draw the pictures of a report into its folder."""
    from pcbench.progress import Step
    from pcbench.report.change.folder import PICTURES as CHANGE
    from pcbench.report.figures import recorded_figures
    from pcbench.report.manifest import complete_replacement
    from pcbench.report.plot import REPORT, draw, drawing_seconds
    from pcbench.scratch import lock_output
    from pcbench.studies.bench.charts import CHARTS
    from pcbench.studies.bend.figure import PICTURES as BEND
    from pcbench.studies.checkpoints.charts import PICTURES as CHECK_POINTS
    from pcbench.studies.evaluate.charts import PICTURES as EVALUATION
    from pcbench.studies.gao.figures import PICTURES as GAO
    from pcbench.studies.quality.charts import PICTURES as QUALITY
    from pcbench.studies.stress.charts import PICTURES as STRESS
    from pcbench.studies.tradeoff.charts import PICTURES as TRADEOFF
    from pcbench.studies.views.pictures import PICTURES as VIEWS

    complete_replacement(report)
    kinds = (REPORT, CHANGE, CHARTS, VIEWS, GAO, BEND, STRESS, TRADEOFF, EVALUATION, CHECK_POINTS, QUALITY)
    drawer = next((drawer for drawer in kinds if drawer.fits(report)), None)
    if drawer is None:
        raise InputError(
            f"{report}: expected a file with a cloud, or the folder of a report (with comparison.json), a change"
            " (change.json), a bench (bench.json), views (scores.json), an experiment (experiment.json), stress"
            " (stress.json), tradeoff (tradeoff.json), evaluate (evaluate.json), check points (checkpoints.json) or"
            " quality (quality.json)"
        )
    click.get_current_context().with_resource(lock_output(report))
    style = recorded_figures(report / "settings.json").with_changes(background, color_range, figure_format)
    with steps(quiet) as step:
        candidates = len(list(report.glob("*_deviation.ply"))) or 1
        step(Step("drawing", 1.0 + 0.5 * len(names) if names else drawing_seconds(candidates)))
        written = draw(report, names, drawer, style)
    if not quiet:
        for path in written:
            click.echo(path)


def _plot_cloud(
    path: Path, out: Path, look: Figures, scalar: str | None, scene: SceneFolder | None, *, quiet: bool
) -> None:
    """Draw the cloud or the mesh in a file."""
    from pcbench.geometry.crs import check_lengths
    from pcbench.io.outputs import check_output
    from pcbench.io.source import Source
    from pcbench.measure.wording import pluralize
    from pcbench.progress import ProgressPlan
    from pcbench.report.colors import has_colors
    from pcbench.report.figures import FORMATS
    from pcbench.report.plot.clouds import draw_cloud
    from pcbench.report.plot.outputs import check_picture
    from pcbench.report.read import MESH_SAMPLES
    from pcbench.report.viewing import viewing_cameras

    source = Source.open(path)
    check_output(out, [*source.files, *(() if scene is None else scene.paths())])
    check_picture(out, FORMATS)
    warn_reader = warn_unless(quiet)
    with steps(quiet) as show:
        step = ProgressPlan(show, [source.reading_seconds, *([0.5] if scene is not None else []), 2.0])
        step(f"reading {path}")
        read_points = source.read_vertices if source.holds_mesh else source.read_cloud
        name, cloud = path.stem, None if source.is_mesh_only else read_points(warn_reader)
        if cloud is None and scalar is not None:
            raise InputError(f"{path}: --scalar needs a cloud with attributes, got a mesh")
        if cloud is None or (source.holds_mesh and scalar is None and not has_colors(cloud.colors)):
            mesh = source.read_mesh(warn_reader)
            name, cloud = f"{name}, {pluralize(len(mesh), 'face')}", mesh.sample(MESH_SAMPLES)
        check_lengths(cloud, str(path))
        viewing = None
        if scene is not None:
            step("reading the cameras")
            viewing = viewing_cameras(scene, cloud, warn_reader)
        step(f"drawing {out}")
        try:
            draw_cloud(name, cloud, out, look, scalar=scalar, cameras=viewing)
        except InputError as error:
            raise InputError(f"{path}: {error}") from error
    if not quiet:
        click.echo(out)
