"""Maps, bars and matrices of the stress study."""

from __future__ import annotations

from typing import Any

import numpy as np

from pcbench.studies.frame.canvas import canvas
from pcbench.studies.stress.canvas import level_labels
from pcbench.studies.stress.descriptions import LadderInfo, axis_title
from pcbench.studies.stress.limits import Tally, grouped, ladder_success, stress_rows
from pcbench.studies.stress.registration import REGISTRATION
from pcbench.studies.stress.results import StressStudy
from pcbench.studies.stress.subject import Group, Subject

_MAX_MAP_COLUMNS = 4
_MIN_LABEL_SHARE = 0.04  # of a bar's length, for a number inside it
_DARK_SHARE = 0.55  # failures beyond which the text of a cell is white


def basin_chart(study: StressStudy, ladder: LadderInfo) -> Any | None:
    """Return the share of right poses over both coordinates of a map: one panel per method."""
    rows = [row for row in stress_rows(study, REGISTRATION) if ladder.name in row.by_ladder]
    if not rows:
        return None
    columns = min(len(rows), _MAX_MAP_COLUMNS)
    lines = -(-len(rows) // columns)
    figure, axes = canvas(lines, columns, (3.9, 3.5), extra=0.7)
    drawn = None
    for axis, row in zip(axes.ravel(), rows, strict=False):
        groups = grouped(row.by_ladder[ladder.name], lambda cell: (cell.level, cell.second))
        shares = np.full((len(ladder.second_levels), len(ladder.levels)), np.nan)
        for (level, second), cells in groups.items():
            if second is None:
                continue
            place = (ladder.second_levels.index(second), ladder.levels.index(level))
            tally = Tally.of(cells)
            shares[place] = 100 * tally.of_groups(REGISTRATION, Group.SUCCESS).share
            silent = tally.of_groups(REGISTRATION, Group.CONFIDENT).count
            text = f"{shares[place]:.0f}" + (f"\n!{silent}" if silent else "")
            color = "black" if shares[place] > 50 else "white"
            axis.text(place[1], place[0], text, ha="center", va="center", fontsize=8, color=color)
        drawn = axis.imshow(shares, cmap="viridis", vmin=0, vmax=100, origin="lower", aspect="auto")
        axis.set_xticks(range(len(ladder.levels)), level_labels(ladder))
        axis.set_yticks(range(len(ladder.second_levels)), [f"{value:g}" for value in ladder.second_levels])
        axis.set_title(row.name, fontsize=10)
    for axis in axes.ravel()[len(rows) :]:
        axis.axis("off")
    figure.supxlabel(axis_title(ladder.title, ladder.unit), fontsize=10)
    figure.supylabel(axis_title(ladder.second_title, ladder.second_unit), fontsize=10)
    figure.suptitle("Right poses by start (!n: n runs are silently wrong)", fontsize=11)
    figure.colorbar(drawn, ax=list(axes.ravel()), label="right poses [% of runs]", aspect=30)
    return figure


def outcome_chart(study: StressStudy, subject: Subject[Any]) -> Any | None:
    """Return the outcomes of each row as bars: right, said, silent and the others."""
    from matplotlib.patches import Patch

    rows = stress_rows(study, subject)
    if not rows:
        return None
    figure, axes = canvas(1, 1, (11.0, 0.9 + 0.42 * len(rows)), extra=0.8)
    axis = axes[0, 0]
    used = {cell.outcome for row in rows for cell in row.cells}
    for line, row in enumerate(rows):
        tally = Tally.of(row.cells)
        left = 0.0
        for outcome in subject.outcomes:
            share = tally.rate(outcome.name).share
            axis.barh(line, 100 * share, left=100 * left, height=0.7, color=outcome.color)
            if share >= _MIN_LABEL_SHARE:
                place = 100 * (left + 0.5 * share)
                axis.text(
                    place, line, f"{100 * share:.0f}", ha="center", va="center", fontsize=8, color=outcome.text_color
                )
            left += share
    labels = [f"{row.name} ({len(row.cells):,} runs)" for row in rows]
    axis.set_yticks(range(len(rows)), labels, fontsize=9)
    axis.set_ylim(len(rows) - 0.5, -0.5)
    axis.set_xlim(0, 100)
    axis.set_xlabel("share of the runs [%]")
    axis.set_title(f"Outcomes: {subject.name}", fontsize=11, loc="left")
    handles = [Patch(color=outcome.color, label=outcome.label) for outcome in subject.outcomes if outcome.name in used]
    figure.legend(handles=handles, loc="outside lower center", ncols=4, frameon=False, fontsize=9)
    return figure


def matrix_chart(study: StressStudy, subject: Subject[Any]) -> Any | None:
    """Return the failure matrix: the share of failed runs by ladder and row, and how many are wrong with confidence.

    Ladders, which have long titles, are lines, and the methods are columns. On degenerate surfaces a run that says so
    has not failed.
    """
    rows, ladders = stress_rows(study, subject), study.ladders_of(subject)
    if not rows or not ladders:
        return None
    figure, axes = canvas(1, 1, (4.8 + 0.62 * len(rows), 0.9 + 0.34 * len(ladders)), extra=0.9)
    axis = axes[0, 0]
    failed = np.full((len(ladders), len(rows)), np.nan)
    for column, row in enumerate(rows):
        groups = row.by_ladder
        for line, ladder in enumerate(ladders):
            if ladder.name not in groups:
                continue
            tally = Tally.of(groups[ladder.name])
            share = 1 - ladder_success(tally, ladder, subject).share
            failed[line, column] = 100 * share
            confident = tally.of_groups(subject, Group.CONFIDENT)
            text = f"{100 * share:.0f}" + (f"  !{100 * confident.share:.0f}" if confident.count else "")
            color = "white" if share > _DARK_SHARE else "black"
            axis.text(column, line, text, ha="center", va="center", fontsize=9, color=color)
    drawn = axis.imshow(failed, cmap="YlOrRd", vmin=0, vmax=100, aspect="auto")
    titles = [f"{ladder.title}, {ladder.second_title}" if ladder.is_map else ladder.title for ladder in ladders]
    axis.set_yticks(range(len(ladders)), titles, fontsize=10)
    names = [row.name for row in rows]
    axis.set_xticks(range(len(rows)), names, rotation=40, ha="left", rotation_mode="anchor", fontsize=10)
    axis.xaxis.tick_top()
    axis.tick_params(top=False, left=False)
    figure.suptitle(f"Failures: {subject.name} (!n: n % are wrong with confidence)", fontsize=11)
    figure.colorbar(drawn, ax=axis, label="failed runs [%]", aspect=30, pad=0.02)
    return figure
