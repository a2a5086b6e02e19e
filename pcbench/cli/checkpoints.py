"""The command `pcbench checkpoints`."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from pcbench.cli.conditions import check_names_of, fail_if_any, fail_if_option
from pcbench.cli.help import command, option
from pcbench.cli.json_output import JsonOutput, json_option
from pcbench.cli.messages import name_files, steps, warn, warn_of_missing
from pcbench.cli.options import FILE, background_option, no_figures_option, quiet_option
from pcbench.cli.settings_command import SettingsCommand

if TYPE_CHECKING:
    from pcbench.report.conditions import Condition

_OMITTED_KEYS = ("accuracy",)  # that names in conditions may omit


@command(
    short_help="Test the accuracy of a cloud by check points.",
    cls=SettingsCommand,
    settings=("pcbench.measure.checkpoints.settings:CheckPointSettings",),
    after="out",
)
@click.argument("cloud", type=FILE)
@click.argument("points", type=FILE)
@option("--out", type=FILE, metavar="FOLDER", help="Folder for the page, the table, the map and the charts.")
@json_option("checkpoints.json")
@fail_if_option("checkpoints.json", "every.errors.rmse > 0.1")
@no_figures_option()
@background_option
@quiet_option
def checkpoints(
    cloud: Path,
    points: Path,
    out: Path | None,
    json_file: str | None,
    fail_if: tuple[Condition, ...],
    no_figures: bool,
    background: str | None,
    quiet: bool,
    **given: Any,
) -> None:
    """Test CLOUD by the check points in POINTS: RMSE, bias, percentiles, outliers and the statement of a standard.

    POINTS is a text file with the columns name, x, y, z (or easting, northing, height), in the coordinate system and
    the unit of CLOUD. Further columns: class (nva or vva), sigma_xy and sigma_z (standard errors of the survey), and
    measured_x, measured_y, measured_z (position of a target in CLOUD, for horizontal errors).

    \b
    Example: pcbench checkpoints scan.laz checkpoints.csv --classes 2 --out accuracy/
    """
    from pcbench.io.source import Source
    from pcbench.measure.checkpoints.settings import CheckPointSettings
    from pcbench.options import from_options
    from pcbench.report.checkpoints import statistics_rows
    from pcbench.report.conditions import NamedValues
    from pcbench.report.figures import Figures
    from pcbench.report.terminal import print_columns
    from pcbench.studies.checkpoints.results import CSV, KIND, CheckPointStudy
    from pcbench.studies.checkpoints.study import run_checkpoints

    check_names_of(CheckPointStudy, fail_if, _OMITTED_KEYS)
    settings = from_options(CheckPointSettings, given)
    look = None if no_figures else Figures().with_changes(background, None, None)
    output = JsonOutput(json_file)
    output.check([*Source.open(cloud).files, points], folder=out)
    with steps(quiet) as step:
        outcome = run_checkpoints(cloud, points, settings, out, figures=look, step=step)
    study = outcome.study
    values = KIND.values(study)
    output.write(values)
    if not quiet:
        for warning in study.warnings:
            warn(warning)
    if not quiet and not output.on_stdout:
        for sentence in (*study.sentences, *study.statements, *study.notes):
            click.echo(sentence)
        click.echo()
        print_columns(statistics_rows(study.accuracy))
        click.echo()
        if out is None:
            click.echo("--out FOLDER writes the errors at each check point, a map and charts")
        else:
            click.echo(name_files("report", out, CSV, KIND.document, KIND.markdown))
    warn_of_missing(outcome)
    fail_if_any(fail_if, [NamedValues("", values)], _OMITTED_KEYS)
