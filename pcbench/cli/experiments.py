"""Commands for experiments: `pcbench experiment bend` and `gao`."""

from __future__ import annotations

from pathlib import Path
from typing import Literal

import click

from pcbench.cli.help import GroupOfCommands, option
from pcbench.cli.messages import name_files, steps, warn_of_missing
from pcbench.cli.options import (
    FILE,
    POSITIVE,
    image_scale_option,
    image_size,
    is_given,
    key_value,
    no_figures_option,
    quiet_option,
    seed_option,
    size_option,
)
from pcbench.cli.workers import chosen_workers, workers_options
from pcbench.errors import ReconstructionError
from pcbench.options import REGIONS, OptionGroup


@click.group(cls=GroupOfCommands, short_help="Experiments on scenes with exact truth.")
def experiment() -> None:
    """Run an experiment on scenes with exact truth."""


@experiment.command(short_help="Find which reconstruction setting deforms a cloud.")
@click.argument("scene", type=FILE, required=False)
@option("--out", type=FILE, metavar="FOLDER", required=True, help="Folder for results; a later run resumes from it.")
@option(
    "--images",
    default=42,
    show_default=True,
    type=click.IntRange(12, 9999),
    help="Number of images of the synthetic scene.",
)
@size_option("800x600")
@no_figures_option()
@seed_option()
@quiet_option
@click.pass_context
def bend(
    context: click.Context,
    scene: Path | None,
    out: Path,
    images: int,
    size: str,
    no_figures: bool,
    seed: int,
    quiet: bool,
) -> None:
    """Solve the same images with different settings of sfm, and measure the deformation of each cloud.

    The settings vary the choice of images, the focal length and distortion (known, solved or ignored) and control
    points. Clouds are compared with the truth and with each other. SCENE is a folder from pcbench synth city; without
    one, a drone survey of a city is rendered.

    \b
    Example: pcbench experiment bend --out bend/
    """
    from pcbench.report import print_columns
    from pcbench.studies.bend.bend import SurveySettings, run_bend
    from pcbench.studies.bend.findings import failures, table

    if scene is not None and any(is_given(context, name) for name in ("images", "size")):
        raise click.UsageError("--images and --size apply only to a synthetic scene, without SCENE")
    settings = SurveySettings(images, *image_size(size), seed)
    with steps(quiet) as step:
        outcome = run_bend(out, scene, settings, figures=not no_figures, step=step)
    study = outcome.study
    if not quiet:
        print_columns(table(study))
        for line in (*study.sentences, *failures(study)):
            click.echo(line)
        click.echo(name_files("report", out, "experiment.csv", "experiment.json"))
    warn_of_missing(outcome)
    if not study.has_measured_bends:
        raise ReconstructionError(f"{out}: none of {len(study.rows)} solutions could be evaluated: see the table there")


@experiment.command(short_help="Reproduce Gao et al. 2025: sparse, dense, splat and radiance field clouds.")
@click.argument("scenes", nargs=-1, type=FILE, metavar="[SCENE]...")
@option("--out", type=FILE, metavar="FOLDER", required=True, help="Folder for results; a later run resumes from it.")
@option(
    "--cities",
    default=3,
    show_default=True,
    type=click.IntRange(1, 99),
    help="Number of cities.",
    group=OptionGroup.CITY,
)
@option("--images", default=48, show_default=True, type=click.IntRange(9, 9999), help="Number of images of each city.")
@size_option("320x180")
@option(
    "--extent",
    default=120.0,
    show_default=True,
    type=POSITIVE,
    help="Side of each city in metres.",
    group=OptionGroup.CITY,
)
@option(
    "--poses",
    default="solve",
    show_default=True,
    type=click.Choice(["solve", "given"]),
    help="Cameras of all clouds: solved once, as in the paper, or given by the scene.",
)
@option("--set", "settings", multiple=True, metavar="KEY=VALUE", help="Setting of splat; may be repeated.")
@option(
    "--crop",
    metavar="REGION",
    help="Region to measure, as in `compare`.  [default: a sphere around the point at which the cameras look]",
    group=OptionGroup.METRICS,
    values=REGIONS,
)
@image_scale_option
@option(
    "--time-limit", type=POSITIVE, metavar="SECONDS", help="Time limit for each cloud.", group=OptionGroup.LARGE_DATA
)
@workers_options("one scene after another, each with all CPUs")
@no_figures_option()
@seed_option()
@quiet_option
@click.pass_context
def gao(
    context: click.Context,
    scenes: tuple[Path, ...],
    out: Path,
    cities: int,
    images: int,
    size: str,
    extent: float,
    poses: Literal["solve", "given"],
    settings: tuple[str, ...],
    crop: str | None,
    image_scale: float,
    time_limit: float | None,
    workers: int | None,
    cluster: str | None,
    no_figures: bool,
    seed: int,
    quiet: bool,
) -> None:
    """Reproduce the experiment of Gao et al. 2025.

    Images on concentric circles give a sparse cloud, a dense cloud and the centres of Gaussian splats. The clouds are
    cropped, registered, and measured against the dense one by the paper's definitions; in addition in both directions,
    against the truth, and with the surfaces of the same splats and of a radiance field. SCENE is a folder of
    photographs, with cameras for --poses given, and optionally truth/ as written by pcbench synth city. Without SCENE,
    cities are rendered.

    \b
    Example: pcbench experiment gao --out gao/
             pcbench experiment gao photos/ --set steps=7000 --set gaussians=200000 --out gao/
    """
    from pcbench.report import print_columns
    from pcbench.studies.gao.gao import run_gao
    from pcbench.studies.gao.plan import Cities, GaoJob
    from pcbench.studies.gao.table import console_tables

    if not scenes and image_scale != 1:
        raise click.UsageError("--image-scale applies only to given scenes: cities are rendered at --size")
    if scenes and any(is_given(context, name) for name in ("cities", "images", "size", "extent")):
        raise click.UsageError("--cities, --images, --size and --extent apply only to synthetic cities, without SCENE")
    synthetic = Cities(cities, images, *image_size(size), extent)
    job = GaoJob(scenes, synthetic, poses, dict(map(key_value, settings)), crop, image_scale, time_limit, seed)
    with steps(quiet) as step:
        outcome = run_gao(job, out, workers=chosen_workers(workers, cluster), figures=not no_figures, step=step)
    if not quiet:
        for table in console_tables(outcome.study, outcome.views):
            print_columns(table)
            click.echo()
        for sentence in outcome.study.sentences:
            click.echo(sentence)
        click.echo(name_files("report", out, "gao.md", "experiment.csv", "experiment.json"))
    warn_of_missing(outcome)
