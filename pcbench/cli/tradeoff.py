"""The command `pcbench tradeoff`."""

from __future__ import annotations

from pathlib import Path

import click

from pcbench.cli.help import command, option
from pcbench.cli.json_output import JsonOutput, json_option
from pcbench.cli.messages import name_files, steps, warn_of_missing
from pcbench.cli.options import FILE, no_figures_option, quiet_option, register_option, seed_option
from pcbench.cli.pairs import read_pair
from pcbench.options import OptionGroup, parse_share, split_names


@command(short_help="Find a cheaper comparison that is accurate enough.")
@click.argument("reference", type=FILE)
@click.argument("candidate", type=FILE)
@option("--out", type=FILE, metavar="FOLDER", help="Folder for results; a later run resumes from it.")
@option(
    "--tolerance",
    default="1%",
    show_default=True,
    metavar="PERCENT",
    help="Largest relative error of the recommended settings.",
)
@option(
    "--levels",
    metavar="PERCENT,...",
    help="Shares of points or faces to keep.  [default: 50%,25%,10%,5%; with --quick 50%,10%]",
)
@option(
    "--seeds",
    type=click.IntRange(3, 100),
    metavar="N",
    help="Rounds, each with another random seed.  [default: 5; with --quick 3]",
    group=OptionGroup.LARGE_DATA,
)
@option(
    "--only",
    metavar="TEXT",
    help="Run only approximations whose name contains TEXT, such as random or ICP; several texts with commas.",
)
@option("--quick", is_flag=True, help="Run few approximations.")
@register_option(group=OptionGroup.REGISTRATION)
@json_option("tradeoff.json")
@no_figures_option("charts")
@seed_option("First random seed.", OptionGroup.LARGE_DATA)
@quiet_option
def tradeoff(
    reference: Path,
    candidate: Path,
    out: Path | None,
    tolerance: str,
    levels: str | None,
    seeds: int | None,
    only: str | None,
    quick: bool,
    register: str,
    json_file: str | None,
    no_figures: bool,
    seed: int,
    quiet: bool,
) -> None:
    """Measure what cheaper comparisons of CANDIDATE with REFERENCE cost in accuracy, and recommend one.

    Approximations run beside the exact comparison: subsampling of either cloud, float32, approximate search, normals
    from fewer neighbours, a cheaper ICP, and decimation if REFERENCE is a mesh (extra meshlab). Each has the error of
    each metric with its interval, CPU seconds and memory.

    \b
    Example: pcbench tradeoff ref.ply cloud.ply --tolerance 1% --out tradeoff/
    """
    from pcbench.errors import InputError
    from pcbench.studies.tradeoff.results import KIND, TradeoffSettings
    from pcbench.studies.tradeoff.study import run_tradeoff
    from pcbench.studies.tradeoff.table import tradeoff_table
    from pcbench.studies.tradeoff.words import warnings

    changes = {
        "tolerance": parse_share("--tolerance", tolerance),
        "seed": seed,
        "register": register,
        "only": split_names((only,)) if only else (),
        **({} if levels is None else {"levels": tuple(parse_share("--levels", text) for text in levels.split(","))}),
        **({} if seeds is None else {"seeds": seeds}),
    }
    settings = TradeoffSettings.quick_plan(**changes) if quick else TradeoffSettings(**changes)  # type: ignore[arg-type]
    output = JsonOutput(json_file)
    output.check([reference, candidate], folder=out)
    for path in (reference, candidate):
        if out is not None and path.resolve().is_relative_to(out.resolve()):
            raise InputError(f"{path}: the study replaces files in {out}: choose another --out")
    with steps(quiet) as step:
        step(f"reading {reference} and {candidate}")
        first, second = read_pair(reference, candidate, seed, quiet=quiet)
        outcome = run_tradeoff(first, second, settings, out=out, figures=not no_figures, step=step)
    if json_file is not None:
        output.write(KIND.values(outcome.study))
    if not quiet and not output.on_stdout:
        for line in (*outcome.study.sentences, *warnings(outcome.study)):
            click.echo(line)
        click.echo()
        click.echo(tradeoff_table(outcome.study))
        if out is not None:
            click.echo()
            click.echo(name_files("report", out, "tradeoff.md", "tradeoff.csv", "tradeoff.json"))
    warn_of_missing(outcome)
