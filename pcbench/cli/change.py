"""The command `pcbench change`."""

from __future__ import annotations

from dataclasses import replace
from datetime import date
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from pcbench.cli.conditions import check_names_of, fail_if_any, fail_if_option
from pcbench.cli.help import command, option
from pcbench.cli.json_output import JsonOutput, json_option
from pcbench.cli.log import LOGGER
from pcbench.cli.messages import name_files, steps, warn_of_missing
from pcbench.cli.options import FILE, background_option, format_option, no_figures_option, quiet_option
from pcbench.cli.settings_command import SettingsCommand
from pcbench.errors import InputError
from pcbench.options import OptionGroup

if TYPE_CHECKING:
    from pcbench.report.conditions import Condition


@command(
    short_help="Measure how much material moved between epochs.",
    cls=SettingsCommand,
    settings=("pcbench.measure.dem.settings:ChangeSettings",),
    after="out",
)
@click.argument("epochs", type=FILE, nargs=-1, metavar="BEFORE AFTER...")
@option("--out", type=FILE, metavar="FOLDER", help="Folder for the report; an earlier report in it is replaced.")
@option(
    "--dates",
    metavar="D,D,...",
    help="Date of each epoch, such as 2023-05-17.  [default: from the names of the files, such as site_2023.laz]",
)
@option(
    "--profile",
    "profiles",
    multiple=True,
    metavar="X0,Y0,X1,Y1",
    help="Line along which the heights of all epochs are drawn; may be repeated.",
    group=OptionGroup.METRICS,
)
@option(
    "--point",
    "points",
    multiple=True,
    metavar="X,Y",
    help="Place whose change is listed for each epoch; may be repeated.",
    group=OptionGroup.METRICS,
)
@option(
    "--memory",
    default="4GiB",
    show_default=True,
    metavar="SIZE",
    help="Memory that may be used, such as 4GiB or 500MB: cells become larger if they do not fit.",
    group=OptionGroup.LARGE_DATA,
)
@json_option("change.json")
@fail_if_option("a change in change.json", "whole.volumes.net[0] > 50")
@no_figures_option("pictures and sheets")
@background_option
@format_option
@quiet_option
def change(
    epochs: tuple[Path, ...],
    out: Path | None,
    dates: str | None,
    profiles: tuple[str, ...],
    points: tuple[str, ...],
    memory: str,
    json_file: str | None,
    fail_if: tuple[Condition, ...],
    no_figures: bool,
    background: str | None,
    figure_format: str | None,
    quiet: bool,
    **given: Any,
) -> None:
    """Measure the change of height and the volumes between the epoch BEFORE and each later one AFTER.

    Prints the net volume, fill and cut with their 95 % intervals, the changed parts and zones, and what the intervals
    assume. The folder of --out has a page to read, a PDF to hand in, and maps for a GIS. Epochs have to be in one
    coordinate system: nothing is registered.

    \b
    Example: pcbench change site_2019.laz site_2023.laz --zones zones.geojson --out change/
    """
    from pcbench.comparison.change import change_files, open_epochs
    from pcbench.measure.dem.settings import ChangeSettings, parse_line, parse_place
    from pcbench.measure.tiled.settings import parse_bytes
    from pcbench.options import from_options
    from pcbench.report.change.document import ChangeRecord
    from pcbench.report.conditions import NamedValues
    from pcbench.report.figures import Figures

    if len(epochs) < 2:
        raise click.UsageError(f"expected at least two epochs, got {len(epochs)}: pcbench change before.laz after.laz")
    check_names_of(ChangeRecord, fail_if)
    settings = replace(
        from_options(ChangeSettings, given),
        profiles=tuple(parse_line("--profile", text) for text in profiles),
        points=tuple(parse_place("--point", text) for text in points),
    )
    style = Figures().with_changes(background, None, figure_format)
    surveys = open_epochs(epochs, settings, None if dates is None else [_date(text) for text in dates.split(",")])
    output = JsonOutput(json_file)
    output.check([*(file for source, _, _ in surveys for file in source.files), *settings.files], folder=out)
    with steps(quiet) as step:
        outcome = change_files(
            surveys, settings, out, memory=parse_bytes(memory), figures=None if no_figures else style, step=step
        )
    document = outcome.document
    for text in document.warnings:
        LOGGER.warning("%s", text)
    if json_file is not None:
        output.write(document.values())
    if not quiet and not output.on_stdout:
        from pcbench.report.change.terminal import change_lines

        for line in change_lines(document):
            click.echo(line)
        if out is not None:
            click.echo()
            click.echo(name_files("report", out, *(["change.pdf"] if (out / "change.pdf").is_file() else []), "maps/"))
    warn_of_missing(outcome)
    if fail_if:
        fail_if_any(fail_if, [NamedValues(each["epoch"], each) for each in document.values()["changes"]])


def _date(text: str) -> date:
    """Return a date; the first day of a year or month that is given alone, as in names of files."""
    from pcbench.measure.dem.epochs import date_of

    day = date_of(text.strip())
    if day is None or not set(text) <= set("0123456789-_. "):
        raise InputError(f"expected --dates as days, months or years such as 2019-05-17,2023, got {text!r}")
    return day
