"""Charts of reconstructors: F-score, error and CPU seconds against severity."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from statistics import median
from typing import Any

from pcbench.studies.frame.canvas import canvas, legend, plain_log_ticks
from pcbench.studies.stress.canvas import RowStyle, row_styles
from pcbench.studies.stress.descriptions import LadderInfo, axis_title
from pcbench.studies.stress.limits import StressRow, grouped, stress_rows
from pcbench.studies.stress.reconstructors.ladders import PHOTO_LADDERS
from pcbench.studies.stress.reconstructors.reconstruction import (
    MIN_SCORE_SHARE,
    RECONSTRUCTION,
    UNPERTURBED,
    ReconstructionCell,
)
from pcbench.studies.stress.results import StressStudy
from pcbench.studies.stress.subject import DEGRADED

_DODGE = 0.08  # shift between methods, in levels
_LABEL_ANGLE_DEG = 20  # of the names of cases


def score_charts(study: StressStudy) -> Iterator[tuple[str, Any]]:
    """Yield the kind and the figure of F-score, RMS error and CPU seconds, one row of panels per ladder."""
    rows = stress_rows(study, RECONSTRUCTION)
    styles = row_styles(rows)
    ladders = [ladder for ladder in study.ladders_of(RECONSTRUCTION) if ladder.name != UNPERTURBED]
    for kind in dict.fromkeys(ladder.kind for ladder in ladders):
        group = [ladder for ladder in ladders if ladder.kind == kind]
        figure, axes = canvas(len(group), len(_QUANTITIES), (4.6, 2.9), extra=0.9)
        for line, ladder in zip(axes, group, strict=True):
            for number, row in enumerate(rows):
                shift = _DODGE * (number - 0.5 * (len(rows) - 1))
                _draw_row(line, ladder, row, styles[row.name], shift)
            _finish(line, ladder, study)
        note = (
            "medians over seeds; dotted: half of the unperturbed F-score; hollow: poor clouds without a warning;"
            " crosses: no measured cloud"
        )
        legend(figure, axes.ravel(), note=note)
        yield kind, figure


def _draw_row(
    axes: Sequence[Any], ladder: LadderInfo, row: StressRow[ReconstructionCell], style: RowStyle, shift: float
) -> None:
    groups = grouped(row.cells, lambda cell: (cell.ladder, cell.level))
    places = [groups.get((UNPERTURBED, 0.0), [])] + [groups.get((ladder.name, level), []) for level in ladder.levels]
    for axis, quantity in zip(axes, _QUANTITIES, strict=True):
        values = [_median([quantity(cell) for cell in cells]) for cells in places]
        measured = [(position + shift, value) for position, value in enumerate(values) if value is not None]
        line = {**style.line_style(), "linestyle": "none"} if ladder.is_list else style.line_style()
        axis.plot([position for position, _ in measured], [value for _, value in measured], **line)
        for position, (cells, value) in enumerate(zip(places, values, strict=True)):
            if value is not None:
                delivered = any(cell.fscore is not None for cell in cells)
                hollow = any(cell.outcome == DEGRADED for cell in cells)
                axis.plot(
                    position + shift, value, color=style.color, linestyle="none", markersize=6 if delivered else 8,
                    marker=style.marker if delivered else "x", markerfacecolor="white" if hollow else style.color,
                    clip_on=False, zorder=3,
                )  # fmt: skip
    standard = _median([cell.fscore for cell in places[0]])
    if standard is not None:
        axes[0].axhline(MIN_SCORE_SHARE * standard, color=style.color, linewidth=1, linestyle=":")
    axes[0].plot([], [], marker=style.marker, label=row.name, **style.line_style())


def _score(cell: ReconstructionCell) -> float | None:
    """Return the F-score; 0 without a cloud."""
    return cell.fscore or 0.0


def _error(cell: ReconstructionCell) -> float | None:
    return cell.rms


def _seconds(cell: ReconstructionCell) -> float | None:
    return cell.cpu_s


_QUANTITIES = (_score, _error, _seconds)  # of the columns of panels


def _finish(axes: Sequence[Any], ladder: LadderInfo, study: StressStudy) -> None:
    names = [_start_label(ladder), *(ladder.level_names or [f"{level:g}" for level in ladder.levels])]
    info = study.photographs
    titles = ("F-score" if info is None else f"F-score at {info.threshold:.3g} m", "RMS error [m]", "CPU time [s]")
    for axis, title in zip(axes, titles, strict=True):
        if ladder.is_list:
            axis.set_xticks(range(len(names)), names, rotation=_LABEL_ANGLE_DEG, ha="right", fontsize=9)
        else:
            axis.set_xticks(range(len(names)), names)
            axis.set_xlabel(axis_title(ladder.title, ladder.unit))
        axis.set_xlim(-0.4, len(names) - 0.6)
        axis.grid(axis="y", alpha=0.3)
        axis.set_ylabel(title)
    axes[0].set_ylim(0, 1)
    axes[0].set_title(ladder.title, fontsize=10, loc="left")
    for axis in axes[1:]:
        axis.set_yscale("log")
        low, high = axis.get_ylim()
        axis.set_ylim(0.8 * low, 1.25 * high)
        plain_log_ticks(axis.yaxis)


def _start_label(ladder: LadderInfo) -> str:
    """Return the label of the unperturbed run on the axis of a ladder."""
    ladder_of_photos = PHOTO_LADDERS.get(ladder.name)
    return UNPERTURBED if ladder.is_list or ladder_of_photos is None else f"{ladder_of_photos.start:g}"


def _median(values: Sequence[float | None]) -> float | None:
    measured = [value for value in values if value is not None]
    return median(measured) if measured else None
