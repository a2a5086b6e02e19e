"""The command `pcbench evaluate`."""

from __future__ import annotations

import sys
from collections import Counter
from pathlib import Path
from typing import TYPE_CHECKING

import click

from pcbench.cli.completion import metric_names, protocol_names
from pcbench.cli.conditions import fail_if_any, fail_if_option
from pcbench.cli.help import command, option
from pcbench.cli.json_output import JsonOutput, json_option
from pcbench.cli.messages import name_files, steps, warn, warn_of_missing
from pcbench.cli.options import FILE, no_figures_option, quiet_option, register_option, seed_option
from pcbench.cli.workers import workers_options
from pcbench.options import CROP_HELP, METRIC_HELP, REGIONS, REGISTER_HELP, OptionGroup, split_names

if TYPE_CHECKING:
    from pcbench.report.article import TableCell
    from pcbench.report.conditions import Condition
    from pcbench.studies.evaluate.results import MethodComparison

INCOMPLETE = 4
"""Exit code if a pair has no scores, or a user-defined metric failed."""


@command(short_help="Evaluate methods on scenes by a benchmark's protocol, in one table.")
@click.argument("reference", required=False)
@click.argument("candidates", nargs=-1)
@option(
    "--pairs",
    type=FILE,
    metavar="FILE.csv",
    help="Pairs instead of patterns: columns reference, candidate, and optionally scene, method, pose (a text file with"
    " a 4x4 matrix), crop and seconds (time of the method). Paths are relative to the folder of the file.",
)
@option(
    "--protocol",
    default="pcbench",
    show_default=True,
    metavar="NAME[:SETTING=VALUE,...]",
    help="Protocol, with settings that differ from its defaults: the benchmarks dtu, eth3d, tnt and mesh (rooms); the"
    " definitions of gao2025, mpeg, open3d, pdal, pytorch3d, kaolin and point-cloud-utils; or pcbench (its own"
    " metrics). Defaults are the official settings, but tnt samples meshes (officially tnt:mesh=vertices).",
    values=protocol_names,
)
@option(
    "--protocol-data",
    type=FILE,
    metavar="FOLDER",
    help="Folder with files of the benchmark, such as masks.",
    group=OptionGroup.INPUT,
)
@option("--out", type=FILE, metavar="FOLDER", help="Folder for tables, page and results; a later run resumes from it.")
@option(
    "--columns",
    multiple=True,
    metavar="NAME,NAME,...",
    help="Scores in the tables and in the answer, in this order.  [default: all]",
)
@option(
    "--metric",
    "metrics",
    multiple=True,
    metavar="WHICH",
    help=METRIC_HELP,
    group=OptionGroup.METRICS,
    values=metric_names,
)
@register_option("none", f"{REGISTER_HELP} {{scene}} and {{method}} are replaced.", OptionGroup.REGISTRATION)
@option(
    "--crop",
    default="none",
    show_default=True,
    metavar="REGION",
    help=f"{CROP_HELP} {{scene}} and {{method}} are replaced.",
    group=OptionGroup.METRICS,
    values=REGIONS,
)
@workers_options("as many pairs as CPUs")
@json_option("evaluate.json")
@fail_if_option("a pair", "chamfer > 0.2")
@no_figures_option("chart")
@seed_option("Random seed of samples, orders and the bootstrap.", OptionGroup.METRICS)
@quiet_option
def evaluate(
    reference: str | None,
    candidates: tuple[str, ...],
    pairs: Path | None,
    protocol: str,
    protocol_data: Path | None,
    out: Path | None,
    columns: tuple[str, ...],
    metrics: tuple[str, ...],
    register: str,
    crop: str,
    workers: int | None,
    cluster: str | None,
    json_file: str | None,
    fail_if: tuple[Condition, ...],
    no_figures: bool,
    seed: int,
    quiet: bool,
) -> None:
    """Evaluate CANDIDATES against REFERENCE by the protocol of a benchmark, for many scenes and methods at once.

    Both are paths with the placeholder {scene}; CANDIDATES also have {method}, or there is one path for each method, as
    PATH or NAME=PATH. Without placeholders, one pair is evaluated. The result says which method is best in which score,
    by how much, and whether the difference is told from chance over the scenes. Exit code 4: a pair has no scores, or a
    metric failed.

    \b
    Example: pcbench evaluate 'gt/{scene}.ply' '{method}/{scene}/mesh.ply' --out table/
             pcbench evaluate 'gt/{scene}.ply' ours='a/{scene}.ply' theirs='b/{scene}.ply'
             pcbench evaluate --pairs pairs.csv --protocol pcbench:thresholds=0.01/0.02
    """
    from pcbench.io.json_values import json_values
    from pcbench.report.conditions import NamedValues
    from pcbench.studies.evaluate.results import KIND, EvaluateSettings
    from pcbench.studies.evaluate.study import CSV, LATEX, input_files, make_plan, run_evaluation

    plan = make_plan(reference, candidates, pairs, register=register, crop=crop)
    data = None if protocol_data is None else str(protocol_data)
    settings = EvaluateSettings(protocol, data, split_names(columns), seed, workers, cluster, split_names(metrics))
    output = JsonOutput(json_file)
    output.check([*input_files(plan.pairs, settings), *([] if pairs is None else [Path(pairs)])], folder=out)
    with steps(quiet) as step:
        outcome = run_evaluation(plan, settings, out=out, figures=not no_figures, step=step)
    study = outcome.study
    if json_file is not None:
        output.write(KIND.values(study))
    if not output.on_stdout and not quiet:
        _print_study(study)
        if out is not None:
            click.echo()
            click.echo(name_files("report", out, KIND.markdown, LATEX, CSV, KIND.document))
    warn_of_missing(outcome)
    with_scores = [pair for pair in study.pairs if pair.scores]
    names = [f"{pair.scene}, {pair.method}" if len(study.pairs) > 1 else "" for pair in with_scores]
    fail_if_any(fail_if, [*map(NamedValues, names, map(json_values, with_scores))], ("scores",))
    total = len(study.pairs)
    if not study.is_complete and (quiet or output.on_stdout):
        count = sum(not pair.scores for pair in study.pairs)
        warn(f"{count} of {total} pairs have no scores: see their messages in the table or in the JSON")
    failures = Counter(metric for pair in study.pairs for metric in pair.failed_metrics)
    for metric, count in failures.items():
        warn(f"the metric {metric} failed for {count} of {total} pairs: see their notes in the JSON or pages")
    if failures or not study.is_complete:
        sys.exit(INCOMPLETE)


def _print_study(study: MethodComparison) -> None:
    """Print the answer, what not to trust, and the tables; of a single pair its scores."""
    from pcbench.studies.evaluate.page import protocol_text, score_text
    from pcbench.studies.evaluate.table import MAX_PRINTED_COLUMNS, heading, scene_rows, shown_mean_rows, summary_rows
    from pcbench.studies.frame.tables import text_table

    if len(study.pairs) == 1:
        (pair,) = study.pairs
        counts = [[name, "" if value is None else f"{value:,.15g}"] for name, value in pair.counts.items()]
        click.echo(text_table([[c.name, score_text(pair.scores[c.name], c.unit)] for c in study.chosen_columns]))
        click.echo(f"\n{text_table(counts)}" if counts else "")
        click.echo(protocol_text(study))
        for line in study.warnings:
            click.echo(f"note: {line}")
        return
    for sentence in study.sentences:
        click.echo(sentence)
    for line in study.warnings:
        click.echo(f"warning: {line}")
    average = "means over scenes" if len(study.scenes) > 1 else f"scores on {study.scenes[0]}"
    click.echo(f"\n{average} (¹ best, ² second)")
    _print_cells(shown_mean_rows(study))
    if len(study.scenes) < 2:
        return
    if len(study.chosen_columns) > MAX_PRINTED_COLUMNS:
        click.echo("\nThe files have the scores of each scene; --columns NAME,NAME prints those of up to three scores.")
        return
    for column in study.chosen_columns:
        click.echo(f"\n{heading(column)}")
        _print_cells([*scene_rows(study, column), *summary_rows(study, column)])


def _print_cells(rows: list[list[TableCell]]) -> None:
    from rich.text import Text

    from pcbench.report.terminal import print_table

    signs, styles = {"": " ", "best": "¹", "second": "²"}, {"": "", "best": "bold green", "second": "underline"}
    header, *body = rows
    texts = [[Text(row[0].text), *(Text(f"{c.text}{signs[c.mark]}", styles[c.mark]) for c in row[1:])] for row in body]
    print_table([header[0].text, *(f"{cell.text} " for cell in header[1:])], texts, left={0})
