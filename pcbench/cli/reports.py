"""Commands that measure clouds against a reference, and draw what was found: compare, deform, plot."""

from __future__ import annotations

import os
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import click

from pcbench.cli.json_output import JsonOutput, json_option
from pcbench.cli.log import LOGGER
from pcbench.cli.messages import steps, warn, warn_unless
from pcbench.cli.options import (
    FILE,
    background_option,
    crop_option,
    figure_options,
    format_option,
    given,
    las_options,
    las_returns,
    no_figures_option,
    numbers,
    quiet_option,
    register_option,
    seed_option,
    splat_options,
    words,
)
from pcbench.errors import InputError

if TYPE_CHECKING:
    from pcbench.report.compare_files import ComparisonJob
    from pcbench.report.comparison import Comparison


@click.command(short_help="Measure candidate clouds against a reference.")
@click.argument("reference", type=FILE, required=False)
@click.argument("candidates", type=FILE, nargs=-1)
@click.option("--out", type=FILE, help="Folder for the report.")
@register_option()
@crop_option
@click.option("--thresholds", metavar="T,T,...", help="Of the F-score.  [default: 1, 2, 5 x the reference's spacing]")
@click.option(
    "--preset", "presets", multiple=True, metavar="NAME", help="open3d, pdal or tnt; gao2025 and mpeg always."
)
@click.option("--map", "maps", multiple=True, metavar="NAME", help="Deviation maps to add: poisson or m3c2.")
@click.option(
    "--m3c2", metavar="NAME=VALUE,...", help="M3C2 with radius, depth, normal_radius, cores=FILE of your own."
)
@las_options("LAS files")
@splat_options
@seed_option("Random seed: points sampled from a mesh and for floors, folds of the cross-validation.")
@click.option("--settings", "settings_file", type=FILE, help="Repeat the comparison of a report's settings.json.")
@json_option("comparison.json")
@no_figures_option()
@click.option("--full", is_flag=True, help="Print every metric, and every sentence.")
@figure_options
@quiet_option
@click.pass_context
def compare(
    context: click.Context,
    reference: Path | None,
    candidates: tuple[Path, ...],
    out: Path | None,
    register: str,
    crop: str,
    thresholds: str | None,
    presets: tuple[str, ...],
    maps: tuple[str, ...],
    m3c2: str | None,
    classes: str | None,
    returns: str | None,
    min_opacity: float | None,
    max_axis: float | None,
    seed: int,
    settings_file: Path | None,
    json_file: str | None,
    no_figures: bool,
    full: bool,
    background: str | None,
    color_range: float | None,
    figure_format: str | None,
    quiet: bool,
) -> None:
    """Measure how far CANDIDATES are from REFERENCE, both ways. Prints the answer in words, what has to be known before
    it is trusted, and the main numbers; the folder of --out holds all of them.

    \b
    Example: pcbench compare ref.ply a.ply b.ply --out report/
    """
    _multiply_on_one_thread()
    from pcbench.measure.settings import Settings
    from pcbench.report.compare_files import ComparisonJob
    from pcbench.report.figures import Figures

    if settings_file is not None:
        options = [
            *("register", "crop", "thresholds", "presets", "maps", "m3c2", "classes", "returns", "min_opacity"),
            *("max_axis", "seed"),
        ]
        if reference is not None or any(given(context, name) for name in options):
            raise click.UsageError("--settings already names the files and the settings: give nothing else but outputs")
        job = ComparisonJob.recorded(settings_file)
        job = replace(job, figures=job.figures.changed(background, color_range, figure_format))
    else:
        if reference is None or not candidates:
            raise click.UsageError("expected a reference and at least one candidate: pcbench compare ref.ply a.ply")
        settings = Settings(
            register=register,
            crop=crop,
            thresholds=numbers("--thresholds", thresholds, float),
            presets=words(presets),
            maps=words(maps),
            seed=seed,
            classes=numbers("--classes", classes, int),
            returns=las_returns(returns),
            min_opacity=min_opacity,
            max_axis=max_axis,
            m3c2=m3c2,
        )
        figures = Figures().changed(background, color_range, figure_format)
        job = ComparisonJob.of(reference, candidates, settings, figures)
    compare_and_print(job, out, json_file, figures=not no_figures, quiet=quiet, full=full)


def compare_and_print(
    job: ComparisonJob, out: Path | None, json_file: str | None, *, figures: bool, quiet: bool, full: bool = False
) -> Comparison:
    """Compare files, write what is asked for, and print the answer or the JSON document."""
    from pcbench.report import document, print_comparison
    from pcbench.report.compare_files import Outputs, compare_files
    from pcbench.report.notes import warnings

    output = JsonOutput(json_file)
    output.check(job.inputs, folder=out)
    with steps(quiet) as step:
        outcome = compare_files(job, Outputs(out, figures), step)
    for text in warnings(outcome.comparison):
        LOGGER.warning("%s", text)
    if json_file is not None:
        output.write(document(outcome.comparison))
    if not output.on_stdout and not quiet:
        print_comparison(outcome.comparison, full=full, folder=out)
    if outcome.without_figures:
        warn(outcome.without_figures)
    return outcome.comparison


@click.command(short_help="Say whether a cloud is deformed against a reference.")
@click.argument("reference", type=FILE)
@click.argument("candidate", type=FILE)
@click.option("--out", type=FILE, help="Folder for deformation.json, the displacement field and pictures.")
@register_option()
@crop_option
@no_figures_option()
@seed_option("Random seed: folds of the cross-validation.")
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
    no_figures: bool,
    seed: int,
    json_file: str | None,
    background: str | None,
    figure_format: str | None,
    quiet: bool,
) -> None:
    """Register CANDIDATE to REFERENCE and say whether it is bent beyond that, by how much, and where.

    \b
    Example: pcbench deform ref.ply a.ply --out bend/
    """
    _multiply_on_one_thread()
    from pcbench.io.files import named_file
    from pcbench.report.deform_files import deform_files
    from pcbench.report.figures import Figures

    look = Figures().changed(background, None, figure_format)
    output = JsonOutput(json_file)
    output.check([reference, candidate, *filter(None, map(named_file, (register, crop)))], folder=out)
    with steps(quiet) as step:
        outcome = deform_files(
            reference, candidate, register, crop, seed, out, figures=None if no_figures else look, step=step
        )
    found = outcome.deformation
    output.write(found)
    say = warn_unless(quiet)
    for warning in outcome.warnings:
        say(warning)
    for notice in found.further_warnings:
        say(str(notice))
    if not quiet and not output.on_stdout:
        click.echo(found.sentence(candidate.name, outcome.unit or ""))
        for rung in found.rungs:
            mark = "*" if rung.model == found.model else " "
            score, error = rung.cv_score**0.5, rung.cv_se / (2 * rung.cv_score**0.5 or 1.0)
            click.echo(f" {mark} {rung.model:10} cross-validated residual {score:.4g} ± {error:.2g}")
        if noise := found.noise:
            click.echo(
                f"noise: white {noise.sigma_white:.3g}, correlated {noise.sigma_correlated:.3g} over"
                f" {noise.correlation_length:.3g}; {found.pairs:,} pairs are worth {noise.n_eff:,.0f}"
            )
        if local := found.local:
            click.echo(f"local changes: {local.tiles_changed} of {local.tiles_tested} tiles")
        if out is not None:
            click.echo(f"report: {out}")
    if outcome.without_figures:
        warn(outcome.without_figures)


@click.command(short_help="Draw a report's pictures again.")
@click.argument("report", type=FILE)
@click.argument("names", nargs=-1)
@figure_options
@quiet_option
def plot(
    report: Path,
    names: tuple[str, ...],
    background: str | None,
    color_range: float | None,
    figure_format: str | None,
    quiet: bool,
) -> None:
    """Draw the pictures of the folder REPORT into REPORT/figures, or those of NAMES (such as reference, distribution,
    a_distance, a_completeness; of a bench speed, accuracy_completeness; of views SCENE_METHOD; of `experiment gao`
    rings, directions, growth), as PNG or as their endings say: distribution.svg. They look as the report was made with,
    but for what is given here. Needs no display.
    """
    from pcbench.progress import Step
    from pcbench.report.figures import recorded_figures
    from pcbench.report.manifest import complete_replacement
    from pcbench.report.plot import REPORT, draw, drawing_seconds
    from pcbench.scratch import claim
    from pcbench.studies.bench.charts import CHARTS
    from pcbench.studies.gao.figures import PICTURES as GAO
    from pcbench.studies.views.pictures import PICTURES

    complete_replacement(report)
    drawer = next((drawer for drawer in (REPORT, CHARTS, PICTURES, GAO) if drawer.fits(report)), None)
    if drawer is None:
        raise InputError(
            f"{report}: expected a report folder (with comparison.json), a bench's (with bench.json), that of views"
            " (with scores.json) or of `experiment gao` (with gao.md)"
        )
    click.get_current_context().with_resource(claim(report))
    look = recorded_figures(report / "settings.json").changed(background, color_range, figure_format)
    with steps(quiet) as step:
        candidates = len(list(report.glob("*_deviation.ply"))) or 1
        step(Step("drawing", 1.0 + 0.5 * len(names) if names else drawing_seconds(candidates)))
        written = draw(report, names, drawer, look)
    if not quiet:
        for path in written:
            click.echo(path)


def _multiply_on_one_thread() -> None:
    """Before numpy is imported: matrices here are small, and waking threads for them costs more than it saves."""
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
