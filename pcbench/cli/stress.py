"""The command `pcbench stress`."""

from __future__ import annotations

from pathlib import Path

import click

from pcbench.cli.help import command, option
from pcbench.cli.messages import name_files, steps, warn_of_missing
from pcbench.cli.options import (
    FILE,
    is_given,
    no_figures_option,
    quiet_option,
    register_option,
    seed_option,
)
from pcbench.cli.pairs import read_pair
from pcbench.cli.workers import workers_options
from pcbench.options import OptionGroup, split_names


@command(short_help="Find where registration, metrics and verdicts break.")
@click.argument("reference", type=FILE, required=False)
@click.argument("candidate", type=FILE, required=False)
@option("--out", type=FILE, metavar="FOLDER", required=True, help="Folder for results; a later run resumes from it.")
@option(
    "--reconstructors",
    is_flag=True,
    help="Stress reconstructors (sfm, mvs, splat) on perturbed photographs of a city instead: fewer and cropped images,"
    " blur, exposure, errors of the cameras, and surfaces without texture, with repeated facades or water.",
)
@option(
    "--quick",
    is_flag=True,
    help="Run a few ladders with up to three levels on one scene: one to three minutes.",
)
@option(
    "--only",
    metavar="TEXT",
    help="Run only ladders whose name, kind or subject contains TEXT; several texts with commas.",
)
@option(
    "--methods",
    multiple=True,
    metavar="NAME,NAME,...",
    help="Methods to run, such as icp,global, or with --reconstructors sfm,mvs; may be repeated.  [default: all that"
    " are installed]",
)
@option(
    "--seeds",
    default=1,
    show_default=True,
    type=click.IntRange(1, 1000),
    help="Number of seeds: each gives other samples, noise and starts.",
    group=OptionGroup.LARGE_DATA,
)
@register_option(
    help="Method that finds the true pose of REFERENCE and CANDIDATE, as in `register`. The study ends with an error if"
    " that pose is doubtful.",
    group=OptionGroup.REGISTRATION,
)
@option(
    "--time-limit",
    default=120.0,
    show_default=True,
    type=click.FloatRange(0, 1e6, min_open=True),
    metavar="SECONDS",
    help="Time limit of each run; a run that exceeds it counts as a time-out.",
    group=OptionGroup.LARGE_DATA,
)
@workers_options("as many runs as CPUs; with --reconstructors one run after another, each with all CPUs")
@no_figures_option("charts")
@seed_option("First random seed.", OptionGroup.LARGE_DATA)
@quiet_option
@click.pass_context
def stress(
    context: click.Context,
    reference: Path | None,
    candidate: Path | None,
    out: Path,
    reconstructors: bool,
    quick: bool,
    only: str | None,
    methods: tuple[str, ...],
    seeds: int,
    register: str,
    time_limit: float,
    workers: int | None,
    cluster: str | None,
    no_figures: bool,
    seed: int,
    quiet: bool,
) -> None:
    """Perturb pairs of clouds step by step, and find where each method breaks and whether it says so.

    Registration methods of pcbench and of other installed libraries run on ladders of starts, noise, outliers, overlap,
    density and degenerate shapes; metrics and verdicts on deformation run on noise, density and known deformations; and
    the search for changes on parts and objects that moved, were added or removed.
    The built-in scenes have exact truth. With REFERENCE and CANDIDATE, registrations of this pair are stressed instead.
    With --reconstructors, reconstructors run on perturbed photographs of a city.

    \b
    Example: pcbench stress --quick --out stress/
             pcbench stress ref.ply cloud.ply --only start,overlap --out stress/
             pcbench stress --reconstructors --quick --out photos/
    """
    from pcbench.errors import InputError
    from pcbench.geometry.mesh_samples import sample_reference
    from pcbench.studies.stress.reconstructors.study import run_reconstructor_stress
    from pcbench.studies.stress.results import StressSettings
    from pcbench.studies.stress.study import GivenClouds, run_stress
    from pcbench.studies.stress.table import stress_table

    clouds = None
    if reconstructors and reference is not None:
        raise click.UsageError(
            "expected no clouds with --reconstructors, which makes its own scene: leave out REFERENCE and CANDIDATE, or"
            " --reconstructors"
        )
    if reference is not None:
        if candidate is None:
            raise click.UsageError("expected REFERENCE and CANDIDATE, or neither: got one cloud")
        for path in (reference, candidate):
            if path.resolve().is_relative_to(out.resolve()):
                raise InputError(f"{path}: the study replaces files in {out}: choose another --out")
        first, second = read_pair(reference, candidate, seed, quiet=quiet)
        clouds = GivenClouds(sample_reference(first, seed), second)
    elif is_given(context, "register"):
        raise click.UsageError("--register applies only to a given pair: REFERENCE and CANDIDATE")
    settings = StressSettings(
        quick=quick,
        seeds=seeds,
        seed=seed,
        only=only,
        methods=split_names(methods),
        register=register,
        time_limit_s=time_limit,
        reconstructors=reconstructors,
        workers=workers,
        cluster=cluster,
    )
    with steps(quiet) as step:
        if reconstructors:
            outcome = run_reconstructor_stress(out, settings, figures=not no_figures, step=step)
        else:
            outcome = run_stress(out, settings, clouds, figures=not no_figures, step=step)
    if not quiet:
        for sentence in outcome.study.sentences:
            click.echo(sentence)
        click.echo()
        click.echo(stress_table(outcome.study))
        click.echo()
        click.echo(name_files("report", out, "stress.md", "stress.csv", "stress.json"))
    warn_of_missing(outcome)
