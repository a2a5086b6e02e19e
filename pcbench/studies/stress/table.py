"""Tables of the stress study: safe limits by ladder, outcomes by method, and recall by the criteria of benchmarks."""

from __future__ import annotations

from collections.abc import Sequence

from pcbench.report.words import columns, pad
from pcbench.studies.stress.limits import (
    CONFIDENT,
    SafeRange,
    StressRow,
    ladder_success,
    safe_ranges,
    safe_starts,
    stress_rows,
)
from pcbench.studies.stress.results import (
    ALL_SUBJECTS,
    CHANGES,
    METRICS,
    OUTCOMES,
    PRESETS,
    RECONSTRUCTION,
    REGISTRATION,
    VERDICTS,
    LadderInfo,
    Rate,
    RegistrationCell,
    StressStudy,
    Tally,
)
from pcbench.studies.stress.words import axis_title, percent, rate_text

_DASH = "–"
_METRE = "m"
LIMITS_LEGEND = (
    "last safe level of each ladder: at least 90 % of the runs succeed and none is wrong with confidence, up to it;"
    " none: not even the first level is safe; all: every level is safe; !n: n runs are wrong with confidence"
)
_COST_LEGEND = "CPU s: median; MiB: largest peak beyond the loaded clouds"
OUTCOMES_LEGENDS = {
    REGISTRATION: "false-alarm: right, but doubted; refused: no pose, although another method found one; said: wrong"
    f" and doubted; silent: wrong but not doubted; {_COST_LEGEND}",
    METRICS: "said: wrong, but explained by the floor or the interval; silent: wrong and not explained;"
    f" {_COST_LEGEND}",
    VERDICTS: f"withheld: no verdict; wrong: contradicts the truth; {_COST_LEGEND}, each for all rules together",
    CHANGES: "unnamed: no change is reported at its place; wrong: of another kind, or reported elsewhere;"
    f" {_COST_LEGEND}",
    RECONSTRUCTION: "right: at least half of the F-score of the unperturbed run; warned: less, with a warning;"
    " refused: an error instead of a cloud; degraded: less, without a warning;"
    " CPU s: median; MiB: largest peak of the process",
}


def stress_table(study: StressStudy) -> str:
    """Return the tables that the command prints: by subject, safe limits by ladder, then outcomes by method."""
    parts = []
    for subject in ALL_SUBJECTS:
        if study.cells(subject):
            (_, *head), *lines = limits_table(study, subject)
            parts.append(text_table([[f"{subject}: safe up to", *head], *lines]))
            (_, *head), *lines = outcome_table(study, subject)
            parts.append(text_table([[f"{subject}: outcomes in %", *head], *lines]))
            parts.append(OUTCOMES_LEGENDS[subject])
    return "\n\n".join([*parts, f"safe up to: {LIMITS_LEGEND}"])


def limits_table(study: StressStudy, subject: str) -> list[list[str]]:
    """Return the safe limits of one subject, a header first."""
    rows = stress_rows(study, subject)
    limits = [_limit_cells(study, row) for row in rows]
    table = [["", *(row.name for row in rows)]]
    for ladder in study.ladders_of(subject):
        table.append([_ladder_title(ladder), *(texts.get(ladder.name, "") for texts in limits)])
    return table


def outcome_table(study: StressStudy, subject: str) -> list[list[str]]:
    """Return the outcomes of each row as shares of its runs, with time and memory, a header first."""
    table = [["", "runs", *OUTCOMES[subject], "CPU s", "MiB"]]
    for row in stress_rows(study, subject):
        tally = Tally.of(row.cells)
        confident = CONFIDENT[subject]
        shares = [
            rate_text(tally.rate(outcome)) if outcome in confident else percent(tally.rate(outcome).share)
            for outcome in OUTCOMES[subject]
        ]
        seconds = _DASH if tally.cpu_s is None else f"{tally.cpu_s:.2g}"
        memory = _DASH if tally.memory_bytes is None else f"{tally.memory_bytes / 2**20:,.0f}"
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
        cells = [c for c in row.cells if isinstance(c, RegistrationCell) and c.scene in metric_scenes]
        if cells:
            rates = [Rate(sum(cell.pose_is_right for cell in cells), len(cells))]
            rates += [Rate(sum(cell.meets(preset) for cell in cells), len(cells)) for preset in PRESETS]
            table.append([row.name, f"{len(cells):,}", *map(rate_text, rates)])
    return table if len(table) > 1 else []


def text_table(rows: Sequence[Sequence[str]]) -> str:
    """Return a table as aligned text: the first column to the left, the others to the right."""
    widths = [max(map(columns, cells)) for cells in zip(*rows, strict=True)]
    lines = (
        "  ".join(
            pad(cell, width, right=number > 0) for number, (cell, width) in enumerate(zip(row, widths, strict=True))
        )
        for row in rows
    )
    return "\n".join(line.rstrip() for line in lines)


def _limit_cells(study: StressStudy, row: StressRow) -> dict[str, str]:
    """Return the text of a row's limit by the name of the ladder, with its number of confident errors."""
    texts = {found.ladder.name: _limit_cell(found) for found in safe_ranges(study, row)}
    for start in safe_starts(study, row):
        ladder = start.ladder
        texts[ladder.name] = (
            "none" if start.level is None or start.second is None else f"{start.level:g}, {start.second:g}"
        )
    for name, cells in row.by_ladder.items():
        tally = Tally.of(cells)
        if name not in texts:
            texts[name] = f"{percent(ladder_success(tally, study.ladder(name), row.subject).share)} right or said"
        if (confident := tally.rate(*CONFIDENT[row.subject])).count:
            texts[name] += f" !{confident.count}"
    return texts


def _limit_cell(found: SafeRange) -> str:
    if found.level is None:
        return "none"
    return "all" if found.is_complete else f"{found.level:g}"


def _ladder_title(ladder: LadderInfo) -> str:
    """Return the title of a ladder with the units of its levels."""
    first = axis_title(ladder.title, ladder.unit)
    return f"{first}, {axis_title(ladder.second_title, ladder.second_unit)}" if ladder.is_map else first
