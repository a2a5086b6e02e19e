"""Tables of the stress study, and all its cells as CSV: safe limits by ladder, outcomes by method, and recall."""

from __future__ import annotations

from dataclasses import fields
from typing import Any

from pcbench.report.markup import csv_text
from pcbench.report.words import UNKNOWN
from pcbench.studies.frame.rates import Rate, percent
from pcbench.studies.frame.tables import text_table
from pcbench.studies.stress.descriptions import LadderInfo, axis_title
from pcbench.studies.stress.limits import (
    SafeRange,
    StressRow,
    Tally,
    ladder_success,
    safe_ranges,
    safe_starts,
    stress_rows,
)
from pcbench.studies.stress.registration import PRESETS, REGISTRATION
from pcbench.studies.stress.results import StressStudy
from pcbench.studies.stress.subject import Group, Subject
from pcbench.studies.stress.subjects import SUBJECTS

_METRE = "m"
LIMITS_LEGEND = (
    "last safe level of each ladder: at least 90 % of the runs succeed and none is wrong with confidence, up to it;"
    " none: not even the first level is safe; all: every level is safe; !n: n runs are wrong with confidence"
)


def stress_table(study: StressStudy) -> str:
    """Return the tables that the command prints: by subject, safe limits by ladder, then outcomes by method."""
    parts = []
    for subject in study.subjects():
        (_, *head), *lines = limits_table(study, subject)
        parts.append(text_table([[f"{subject.name}: safe up to", *head], *lines]))
        (_, *head), *lines = outcome_table(study, subject)
        parts.append(text_table([[f"{subject.name}: outcomes in %", *head], *lines]))
        parts.append(subject.legend)
    return "\n\n".join([*parts, f"safe up to: {LIMITS_LEGEND}"])


def limits_table(study: StressStudy, subject: Subject[Any]) -> list[list[str]]:
    """Return the safe limits of one subject, a header first."""
    rows = stress_rows(study, subject)
    limits = [_limit_cells(study, row) for row in rows]
    table = [["", *(row.name for row in rows)]]
    for ladder in study.ladders_of(subject):
        table.append([_ladder_title(ladder), *(texts.get(ladder.name, "") for texts in limits)])
    return table


def outcome_table(study: StressStudy, subject: Subject[Any]) -> list[list[str]]:
    """Return the outcomes of each row as shares of its runs, with time and memory, a header first."""
    table = [["", "runs", *(outcome.name for outcome in subject.outcomes), "CPU s", "MiB"]]
    for row in stress_rows(study, subject):
        tally = Tally.of(row.cells)
        rates = [(outcome, tally.rate(outcome.name)) for outcome in subject.outcomes]
        shares = [rate.text if outcome.group == Group.CONFIDENT else percent(rate.share) for outcome, rate in rates]
        seconds = UNKNOWN if tally.cpu_s is None else f"{tally.cpu_s:.2g}"
        memory = UNKNOWN if tally.memory_bytes is None else f"{tally.memory_bytes / 2**20:,.0f}"
        table.append([row.name, f"{tally.total:,}", *(text.removesuffix(" %") for text in shares), seconds, memory])
    return table


def preset_table(study: StressStudy) -> list[list[str]]:
    """Return the recall of each registration method by the criteria of benchmarks, a header first.

    Scenes whose unit is not the metre are left out; there are no rows without others.
    """
    metric_scenes = {scene.name for scene in study.scenes if scene.unit == _METRE}
    head = [f"{preset.name}: {preset.offset:g} m, {preset.angle_deg:g} deg" for preset in PRESETS]
    table = [["", "runs", "within tolerance", *head]]
    for row in stress_rows(study, REGISTRATION):
        cells = [cell for cell in row.cells if cell.scene in metric_scenes]
        if cells:
            rates = [Rate(sum(cell.pose_is_right for cell in cells), len(cells))]
            rates += [Rate(sum(cell.meets(preset) for cell in cells), len(cells)) for preset in PRESETS]
            table.append([row.name, f"{len(cells):,}", *(rate.text for rate in rates)])
    return table if len(table) > 1 else []


def stress_csv(study: StressStudy) -> str:
    """Return all cells as CSV, one line each; columns that a subject lacks are empty."""
    names = list(dict.fromkeys(field.name for subject in SUBJECTS.values() for field in fields(subject.cell)))
    rows = []
    for subject in study.subjects():
        for cell in study.cells(subject):
            values = {field.name: _csv_value(getattr(cell, field.name)) for field in fields(cell)}
            rows.append([subject.name, *(values.get(name) for name in names)])
    return csv_text(["subject", *names], rows)


def _limit_cells(study: StressStudy, row: StressRow[Any]) -> dict[str, str]:
    """Return the text of a row's limit by the name of the ladder, with its number of confident errors."""
    texts = {limit.ladder.name: _limit_cell(limit) for limit in safe_ranges(study, row)}
    for start in safe_starts(study, row):
        ladder = start.ladder
        texts[ladder.name] = (
            "none" if start.level is None or start.second is None else f"{start.level:g}, {start.second:g}"
        )
    for name, cells in row.by_ladder.items():
        tally = Tally.of(cells)
        if name not in texts:
            texts[name] = f"{percent(ladder_success(tally, study.ladder(name), row.subject).share)} right or said"
        if (confident := tally.of_groups(row.subject, Group.CONFIDENT)).count:
            texts[name] += f" !{confident.count}"
    return texts


def _limit_cell(limit: SafeRange) -> str:
    if limit.level is None:
        return "none"
    return "all" if limit.is_complete else f"{limit.level:g}"


def _ladder_title(ladder: LadderInfo) -> str:
    """Return the title of a ladder with the units of its levels."""
    first = axis_title(ladder.title, ladder.unit)
    return f"{first}, {axis_title(ladder.second_title, ladder.second_unit)}" if ladder.is_map else first


def _csv_value(value: Any) -> str:
    if value is None:
        return ""
    if isinstance(value, tuple):
        texts = [str(item) for item in value]
        return ("; " if any(" " in text for text in texts) else " ").join(texts)
    return "" if value != value else str(value)
