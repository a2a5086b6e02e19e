"""The command `pcbench quality`."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from pcbench.cli.conditions import fail_if_any, fail_if_option
from pcbench.cli.help import command, option
from pcbench.cli.json_output import JsonOutput, json_option
from pcbench.cli.messages import name_files, steps, warn, warn_of_missing
from pcbench.cli.options import FILE, background_option, no_figures_option, quiet_option
from pcbench.cli.settings_command import SettingsCommand
from pcbench.options import OptionGroup

if TYPE_CHECKING:
    from pcbench.report.conditions import Condition

_OMITTED_KEYS = ("numbers",)  # that names in conditions may omit


@command(
    short_help="Measure the quality of one cloud without a reference.",
    cls=SettingsCommand,
    settings=("pcbench.measure.quality.settings:QualitySettings",),
    after="out",
)
@click.argument("cloud", type=FILE)
@click.argument("other", type=FILE, required=False)
@option("--out", type=FILE, metavar="FOLDER", help="Folder for the page, the tables and the maps.")
@option(
    "--memory",
    default="4GiB",
    show_default=True,
    metavar="SIZE",
    help="Memory that may be used, such as 4GiB or 500MB: larger clouds are refused.",
    group=OptionGroup.LARGE_DATA,
)
@json_option("quality.json")
@fail_if_option("quality.json", "noise > 0.02")
@no_figures_option()
@background_option
@quiet_option
def quality(
    cloud: Path,
    other: Path | None,
    out: Path | None,
    memory: str,
    json_file: str | None,
    fail_if: tuple[Condition, ...],
    no_figures: bool,
    background: str | None,
    quiet: bool,
    **given: Any,
) -> None:
    """Measure what CLOUD tells about itself, without a reference; with OTHER, both side by side.

    Prints noise across surfaces, double walls, voids, offsets of strips, outliers, copies, mean map entropy and the
    tilt of walls, with 95 % intervals where values are estimated.

    \b
    Example: pcbench quality map.laz --out quality/
    """
    from pcbench.io.json_values import json_example
    from pcbench.io.source import Source
    from pcbench.measure.quality.numbers import number_names
    from pcbench.measure.quality.settings import QualitySettings
    from pcbench.measure.tiled.settings import parse_bytes
    from pcbench.options import from_options
    from pcbench.report.conditions import NamedValues, check_names
    from pcbench.report.figures import Figures
    from pcbench.report.terminal import print_columns
    from pcbench.studies.quality.results import CSV, KIND, QualityStudy
    from pcbench.studies.quality.study import run_quality
    from pcbench.studies.quality.table import terminal_rows

    check_names(fail_if, {**json_example(QualityStudy), "numbers": dict.fromkeys(number_names())}, _OMITTED_KEYS)
    paths = [cloud] if other is None else [cloud, other]
    settings = from_options(QualitySettings, given)
    look = None if no_figures else Figures().with_changes(background, None, None)
    output = JsonOutput(json_file)
    output.check([file for path in paths for file in Source.open(path).files], folder=out)
    with steps(quiet) as step:
        outcome = run_quality(paths, settings, out, memory=parse_bytes(memory), figures=look, step=step)
    study = outcome.study
    values = KIND.values(study)
    output.write(values)
    if not quiet:
        for warning in study.warnings:
            warn(warning)
    if not quiet and not output.on_stdout:
        for sentence in study.sentences:
            click.echo(sentence)
        click.echo()
        print_columns(terminal_rows(study))
        click.echo()
        if other is not None:
            click.echo("* better, and more than the 95 % intervals explain")
        if out is None:
            click.echo(
                "--out FOLDER writes the definitions of all numbers, maps, and tables of voids, walls and strips"
            )
        else:
            click.echo(name_files("report", out, CSV, KIND.document, KIND.markdown, "maps/"))
    warn_of_missing(outcome)
    documents = [values] if other is None else [values, values["other"]]
    names = [""] if other is None else [measured.name for measured in study.clouds]
    fail_if_any(fail_if, [*map(NamedValues, names, documents)], _OMITTED_KEYS)
