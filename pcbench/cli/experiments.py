"""Experiments: `pcbench experiment bend`, `pcbench experiment gao`."""

from __future__ import annotations

from pathlib import Path
from typing import Literal

import click

from pcbench.cli.messages import steps, warn
from pcbench.cli.options import (
    FILE,
    POSITIVE,
    given,
    image_scale_option,
    image_size,
    key_value,
    no_figures_option,
    quiet_option,
    seed_option,
    size_option,
)
from pcbench.errors import ReconstructionError


@click.group(short_help="Questions answered on scenes whose truth is known.")
def experiment() -> None:
    """Answer a question on a scene whose truth is known."""


@experiment.command(short_help="Solve the same images in several ways: what bends the cloud?")
@click.argument("scene", type=FILE, required=False)
@click.option("--out", type=FILE, required=True, help="Folder for results; a later run goes on from what is there.")
@click.option(
    "--images", default=42, show_default=True, type=click.IntRange(12, 9999), help="Of the scene that is made."
)
@size_option("800x600")
@no_figures_option("picture")
@seed_option("Of everything.")
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
    """Solve the same images with the reconstructor sfm and different settings (which images; focal length and
    distortion known, solved for or ignored; control points), and measure how the clouds are bent against the truth
    and against each other. SCENE is a folder as pcbench synth city makes it; without one, a drone's survey of a city
    is made.

    \b
    Example: pcbench experiment bend --out bend/
    """
    from pcbench.report import print_columns
    from pcbench.studies.bend.bend import Experiment, run_bend
    from pcbench.studies.bend.findings import table

    if scene is not None and any(given(context, name) for name in ("images", "size")):
        raise click.UsageError("--images and --size are those of the scene that is made where none is given")
    settings = Experiment(images, *image_size(size), seed)
    with steps(quiet) as step:
        study, without_figures = run_bend(out, scene, settings, figures=not no_figures, step=step)
    if not quiet:
        print_columns(table(study))
        for sentence in study.sentences:
            click.echo(sentence)
        click.echo(f"report: {out}")
    if without_figures:
        warn(without_figures)
    if not study.is_judged:
        raise ReconstructionError(f"{out}: none of {len(study.rows)} solutions could be judged: see the table there")


@experiment.command(short_help="The paper, reproduced: sparse, dense and splatted clouds against mvs and the truth.")
@click.argument("scenes", nargs=-1, type=FILE, metavar="[SCENE]...")
@click.option("--out", type=FILE, required=True, help="Folder for results; a later run goes on from what is there.")
@click.option("--cities", default=3, show_default=True, type=click.IntRange(1, 99), help="Where no SCENE is given.")
@click.option("--images", default=48, show_default=True, type=click.IntRange(9, 9999), help="Of each city.")
@size_option("320x180")
@click.option("--extent", default=120.0, show_default=True, type=POSITIVE, help="Side of each city in metres.")
@click.option(
    "--poses",
    default="solve",
    show_default=True,
    type=click.Choice(["solve", "given"]),
    help="Cameras: solved once for all clouds, as in the paper, or those of the scene.",
)
@click.option("--set", "settings", multiple=True, metavar="KEY=VALUE", help="A setting of splat.")
@click.option(
    "--crop",
    metavar="REGION",
    help="What is measured, as for `compare`.  [default: a sphere about the place that cameras look at]",
)
@image_scale_option
@click.option("--time-limit", type=POSITIVE, metavar="SECONDS", help="Stop the work on a cloud after this.")
@no_figures_option()
@seed_option("Of everything.")
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
    no_figures: bool,
    seed: int,
    quiet: bool,
) -> None:
    """Everything that Gao et al. 2025 show: from images on concentric circles a sparse cloud, a dense one and the
    centres of Gaussian splats, cropped, registered and measured by their definitions against the dense one; and beside
    it what they could not: the truth, both directions, and the surface that the same splats show. SCENE is a folder of
    photographs, with cameras for --poses given, and perhaps truth/ as pcbench synth city makes it; without one, cities
    are made.

    \b
    Example: pcbench experiment gao --out gao/
             pcbench experiment gao photos/ --set steps=7000 --set gaussians=200000 --out gao/
    """
    from pcbench.report import print_columns
    from pcbench.studies.gao.gao import run_gao
    from pcbench.studies.gao.plan import Cities, GaoJob
    from pcbench.studies.gao.table import console_tables

    if not scenes and image_scale != 1:
        raise click.UsageError("--image-scale is that of given scenes: cities are photographed at --size")
    if scenes and any(given(context, name) for name in ("cities", "images", "size", "extent")):
        raise click.UsageError(
            "--cities, --images, --size and --extent are those of cities, made where no SCENE is given"
        )
    made = Cities(cities, images, *image_size(size), extent)
    job = GaoJob(scenes, made, poses, dict(map(key_value, settings)), crop, image_scale, time_limit, seed)
    with steps(quiet) as step:
        outcome = run_gao(job, out, figures=not no_figures, step=step)
    if not quiet:
        for table in console_tables(outcome.study, outcome.views):
            print_columns(table)
            click.echo()
        for sentence in outcome.study.sentences:
            click.echo(sentence)
        click.echo(f"report: {out}")
    if outcome.without_figures:
        warn(outcome.without_figures)
