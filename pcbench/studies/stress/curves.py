"""Curves of the stress study: recall, success by severity, performance profiles, time, and coverage of intervals."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np

from pcbench.studies.frame.canvas import GREY, canvas, legend, percent_axis, plain_log_ticks
from pcbench.studies.frame.rates import Rate, percent
from pcbench.studies.stress.canvas import RowStyle, draw_rate, level_labels, panel_legend, row_styles
from pcbench.studies.stress.descriptions import LadderInfo, axis_title
from pcbench.studies.stress.limits import StressRow, Tally, coverage, grouped, stress_rows
from pcbench.studies.stress.metrics import METRICS
from pcbench.studies.stress.registration import PRESETS, REGISTRATION, RegistrationCell
from pcbench.studies.stress.results import StressStudy
from pcbench.studies.stress.subject import GLOBAL, LOCAL, Group, Subject
from pcbench.studies.stress.subjects import SUBJECTS
from pcbench.studies.stress.verdicts import NON_AFFINE, VERDICTS

_SCOPE_TITLES = {LOCAL: "from a given start", GLOBAL: "without a start"}
_MAX_PANEL_COLUMNS = 3
_MAX_BARRED_ROWS = 4  # rows of a panel with intervals of all of them; otherwise of ours alone
_MAX_PROFILE_FACTOR = 1000.0
_NOMINAL = 95.0  # coverage of intervals, in percent
_DODGE = 0.5  # width over which the markers of a level are spread, in levels


def recall_chart(study: StressStudy) -> Any | None:
    """Return the recall against the error: one row of panels for local and one for global methods."""
    rows = stress_rows(study, REGISTRATION)
    scopes = [scope for scope in (LOCAL, GLOBAL) if any(row.method.scope == scope for row in rows)]
    if not scopes:
        return None
    styles = row_styles(rows)
    in_metres = any(scene.unit == "m" for scene in study.scenes)
    unit = "m" if in_metres else next((scene.unit for scene in study.scenes), "")
    columns = (
        ("error", "mean of |p − p'| / |p − centroid|", ""),
        ("offset_error", "translation error", unit),
        ("angle_error_deg", "rotation error", "deg"),
    )
    figure, axes = canvas(len(scopes), len(columns), (4.8, 3.6), extra=1.0)
    for line, scope in zip(axes, scopes, strict=True):
        for axis, (name, title, axis_unit) in zip(line, columns, strict=True):
            axis.set_xscale("log")
            axis.set_xlim(*_error_limits(study, name))
            plain_log_ticks(axis.xaxis)
            for row in rows:
                if row.method.scope == scope:
                    _draw_recall(axis, row, name, styles[row.name])
            axis.set_xlabel(axis_title(title, axis_unit))
            axis.set_title(f"{_SCOPE_TITLES[scope]}: {title if name != 'error' else 'relative error'}", fontsize=10)
            percent_axis(axis)
        line[0].set_ylabel("recall: runs with at most this error [%]")
        if in_metres:
            _draw_preset_ticks(line[1], {preset.offset for preset in PRESETS})
        _draw_preset_ticks(line[2], {preset.angle_deg for preset in PRESETS})
    presets = "; ".join(f"{p.name} {p.offset:g} m, {p.angle_deg:g} deg" for p in PRESETS)
    legend(figure, axes.ravel(), note=f"vertical lines: success criteria of benchmarks ({presets})")
    return figure


def severity_charts(study: StressStudy, subject: Subject[Any]) -> Iterator[tuple[str, Any]]:
    """Yield success against severity for each kind of ladder: the name of the kind and the figure."""
    rows = stress_rows(study, subject)
    styles = row_styles(rows)
    ladders = [ladder for ladder in study.ladders_of(subject) if not ladder.is_map and not ladder.is_list]
    for kind in dict.fromkeys(ladder.kind for ladder in ladders):
        panels = [panel for ladder in ladders if ladder.kind == kind for panel in _panels(ladder, rows)]
        scopes = {scope for _, scope, _ in panels}
        columns = min(len(panels), len(scopes) if len(scopes) > 1 else _MAX_PANEL_COLUMNS)
        lines = -(-len(panels) // columns)
        figure, axes = canvas(lines, columns, (5.4 if columns > len(scopes) else 7.0, 3.5), extra=0.9)
        for axis, (ladder, scope, group) in zip(axes.ravel(), panels, strict=False):
            _draw_ladder(axis, ladder, group, styles)
            if len(scopes) > 1:
                axis.set_title(_SCOPE_TITLES[scope], fontsize=10, loc="left")
            percent_axis(axis)
        for axis in axes.ravel()[len(panels) :]:
            axis.axis("off")
        figure.supylabel(subject.success, fontsize=10)
        crowded = any(len(group) > _MAX_BARRED_ROWS for _, _, group in panels)
        bars = "bars: 95 % Wilson intervals" + (" of pcbench's methods" if crowded else "")
        legend(figure, axes.ravel(), note=f"{bars}; hollow: some runs of the level are wrong with confidence")
        yield kind, figure


def profile_chart(study: StressStudy) -> Any | None:
    """Return performance profiles (Dolan & Moré 2002): runs solved within a factor of the fastest right method."""
    rows = stress_rows(study, REGISTRATION)
    styles = row_styles(rows)
    panels = []
    for scope in (LOCAL, GLOBAL):
        group = [row for row in rows if row.method.scope == scope]
        times = _solved_times(group)
        if len(group) > 1 and len(times):
            panels.append((scope, group, times))
    if not panels:
        return None
    figure, axes = canvas(1, len(panels), (6.2, 4.2), extra=0.8)
    for axis, (scope, group, times) in zip(axes[0], panels, strict=True):
        best = times.min(axis=1, keepdims=True)
        with np.errstate(invalid="ignore"):
            ratios = np.where(np.isfinite(times), times / best, np.inf)
        finite = ratios[np.isfinite(ratios)]
        top = min(_MAX_PROFILE_FACTOR, 1.5 * max(2.0, float(finite.max(initial=2.0))))
        for row, row_ratios in zip(group, ratios.T, strict=True):
            sorted_ratios = np.sort(row_ratios[np.isfinite(row_ratios)])
            shares = 100 * np.arange(1, len(sorted_ratios) + 1) / len(ratios)
            end = float(shares[-1]) if len(shares) else 0.0
            first = np.concatenate([[1.0], sorted_ratios, [top]])
            axis.step(first, np.concatenate([[0.0], shares, [end]]), where="post", label=row.name,
                      **styles[row.name].line_style())  # fmt: skip
        axis.set_xscale("log")
        axis.set_xlim(1, top)
        plain_log_ticks(axis.xaxis)
        axis.set_xlabel("CPU time over that of the fastest right method")
        title = f"{_SCOPE_TITLES[scope]}: {len(ratios):,} problems that all methods ran and one solved"
        axis.set_title(title, fontsize=10)
        percent_axis(axis)
    axes[0, 0].set_ylabel("problems solved within that factor [%]")
    legend(figure, axes.ravel(), note="performance profiles: left, how often fastest; right, how often right at all")
    return figure


def speed_chart(study: StressStudy) -> Any | None:
    """Return success, CPU seconds and errors with confidence side by side: one panel per subject."""
    panels = []
    subjects: tuple[Subject[Any], ...] = (REGISTRATION, METRICS)
    for subject in subjects:
        rows = [row for row in stress_rows(study, subject) if Tally.of(row.cells).cpu_s is not None]
        if rows:
            panels.append((subject, rows))
    if not panels:
        return None
    figure, axes = canvas(len(panels), 1, (10.0, 3.8), extra=0.2)
    for axis, (subject, rows) in zip(axes[:, 0], panels, strict=True):
        styles = row_styles(rows)
        for row in rows:
            tally = Tally.of(row.cells)
            confident = tally.of_groups(subject, Group.CONFIDENT)
            seconds = max(tally.cpu_s or 0.0, 1e-3)
            draw_rate(axis, seconds, tally.of_groups(subject, Group.SUCCESS), styles[row.name], size=8)
            scope = f" ({row.method.scope})" if row.method.scope == GLOBAL and row.name != GLOBAL else ""
            label = f"{row.name}{scope}: {percent(confident.share)} silently wrong"
            style = styles[row.name]
            axis.plot([], [], color=style.color, marker=style.marker, linestyle="none", label=label)
        axis.set_xscale("log")
        axis.margins(x=0.15)
        plain_log_ticks(axis.xaxis)
        axis.set_xlabel("median CPU time of a run [s]")
        axis.set_ylabel(subject.success)
        axis.set_title(
            f"{subject.name}: speed, success and stability; bars: 95 % Wilson intervals", fontsize=10, loc="left"
        )
        percent_axis(axis)
        panel_legend(axis)
    return figure


def coverage_chart(study: StressStudy) -> Any | None:
    """Return the coverage of the 95 % intervals of metrics and verdicts by ladder."""
    panels = []
    for subject in SUBJECTS.values():
        rows = [row for row in stress_rows(study, subject) if coverage(row.cells).total]
        if rows:
            panels.append((subject, rows))
    if not panels:
        return None
    ladders = {
        subject: [
            ladder
            for ladder in study.ladders_of(subject)
            if any(coverage(row.by_ladder.get(ladder.name, ())).total for row in rows)
        ]
        for subject, rows in panels
    }
    height = 1.2 + 0.34 * max(len(names) for names in ladders.values())
    figure, axes = canvas(1, len(panels), (7.2, height), extra=0.9)
    styles = row_styles([row for _, rows in panels for row in rows])
    for axis, (subject, rows) in zip(axes[0], panels, strict=True):
        for number, row in enumerate(rows):
            groups = row.by_ladder
            shift = _DODGE * ((number + 0.5) / len(rows) - 0.5)
            style = styles[row.name]
            for position, ladder in enumerate(ladders[subject]):
                rate = coverage(groups.get(ladder.name, ()))
                if rate.total:
                    low, high = rate.interval
                    y = 100 * rate.share
                    axis.errorbar(y, position + shift, xerr=[[max(0, y - 100 * low)], [max(0, 100 * high - y)]],
                                  color=style.color, marker=style.marker, markersize=5, capsize=2)  # fmt: skip
            axis.plot([], [], color=style.color, marker=style.marker, label=row.name)
        axis.axvline(_NOMINAL, color=GREY, linewidth=1, linestyle=":")
        axis.set_yticks(range(len(ladders[subject])), [ladder.title for ladder in ladders[subject]], fontsize=9)
        axis.set_ylim(len(ladders[subject]) - 0.5, -0.5)
        axis.set_xlim(-3, 103)
        axis.set_xlabel("intervals that contain the exact value [%]")
        axis.set_title(f"{subject.name}; dotted: 95 %, as stated; bars: 95 % Wilson intervals", fontsize=10, loc="left")
        axis.grid(axis="x", alpha=0.3)
    legend(figure, axes.ravel())
    return figure


def size_chart(study: StressStudy) -> Any | None:
    """Return verdicts by the true size: shares of non-affine verdicts, and measured over true sizes."""
    rows = stress_rows(study, VERDICTS)
    bent = [row for row in rows if any(cell.true_rms > 0 for cell in row.cells)]
    if not bent:
        return None
    styles = row_styles(bent)
    figure, axes = canvas(1, 2, (6.4, 4.2), extra=0.8)
    share, ratio = axes[0]
    true = [cell.size_in_noise for row in bent for cell in row.cells if cell.true_rms > 0]
    for number, row in enumerate(bent):
        cells = [cell for cell in row.cells if cell.verdict]
        shift = 1 + 0.06 * (number - 0.5 * (len(bent) - 1))
        style = styles[row.name]
        by_size = grouped([c for c in cells if c.true_rms > 0], lambda c: float(f"{c.size_in_noise:.2g}"))
        sizes = sorted(by_size)
        rates = [Rate(sum(c.verdict == NON_AFFINE for c in by_size[size]), len(by_size[size])) for size in sizes]
        if not sizes:
            continue
        share.plot([size * shift for size in sizes], [100 * rate.share for rate in rates], **style.line_style())
        for size, rate in zip(sizes, rates, strict=True):
            draw_rate(share, size * shift, rate, style)
        share.plot([], [], marker=style.marker, label=row.name, **style.line_style())
        for size in sizes:
            ratios = [c.ratio for c in by_size[size] if c.ratio is not None]
            if ratios:
                low, middle, high = np.percentile(ratios, [5, 50, 95])
                ratio.errorbar(size * shift, middle, [[middle - low], [high - middle]], color=style.color,
                               marker=style.marker, markersize=5, capsize=2)  # fmt: skip
    for axis in (share, ratio):
        axis.set_xscale("log")
        axis.set_xlim(0.7 * min(true), 1.4 * max(true))
        plain_log_ticks(axis.xaxis)
        axis.set_xlabel("true RMS of the deformation over the noise")
    share.set_ylabel("verdict non-affine [% of runs]")
    percent_axis(share)
    ratio.axhline(1, color=GREY, linewidth=1, linestyle=":")
    ratio.set_ylabel("measured over true RMS (median, middle 90 %)")
    ratio.set_yscale("log")
    low, high = ratio.get_ylim()
    ratio.set_ylim(min(0.5, low), max(2.0, high))
    plain_log_ticks(ratio.yaxis)
    ratio.grid(axis="y", alpha=0.3)
    legend(figure, axes.ravel(), note="left: share of deformed clouds whose deformation is found")
    return figure


def _draw_recall(axis: Any, row: StressRow[RegistrationCell], name: str, style: RowStyle) -> None:
    values = [getattr(cell, name) for cell in row.cells]
    measured = np.sort([value for value in values if value is not None])
    shares = 100 * np.arange(len(measured) + 1) / max(len(values), 1)
    low, high = axis.get_xlim()
    steps = np.concatenate([[low], np.maximum(measured, low), [high]])
    axis.step(steps, np.append(shares, shares[-1]), where="post", label=row.name, **style.line_style())


def _error_limits(study: StressStudy, name: str) -> tuple[float, float]:
    """Return the range of an error over all methods: its inner 99 %, at most five decades."""
    values = [getattr(cell, name) for cell in study.registrations]
    measured = [value for value in values if value]
    if not measured:
        return 0.1, 10.0
    low, high = np.percentile(measured, [0.5, 99.5])
    return max(0.5 * float(low), 1e-5 * float(high)), 2.0 * float(high)


def _draw_preset_ticks(axis: Any, values: set[float]) -> None:
    """Mark the criteria of benchmarks within the range of the x axis; text beyond it would shrink all panels."""
    low, high = axis.get_xlim()
    for value in sorted(value for value in values if low <= value <= high):
        axis.axvline(value, color=GREY, linewidth=1, linestyle=":")
        axis.text(value, 103, f"{value:g}", color=GREY, fontsize=8, ha="center", va="bottom")
    axis.title.set_position((0.5, 1.06))
    axis.set_title(axis.get_title(), fontsize=10, pad=14)


def _panels(
    ladder: LadderInfo, rows: Sequence[StressRow[Any]]
) -> Iterator[tuple[LadderInfo, str, list[StressRow[Any]]]]:
    """Yield the panels of a ladder, one per scope: the ladder, the scope and the rows that ran it."""
    present = [row for row in rows if ladder.name in row.by_ladder]
    for scope in (LOCAL, GLOBAL, ""):
        group = [row for row in present if row.method.scope == scope]
        if group:
            yield ladder, scope, group


def _draw_ladder(axis: Any, ladder: LadderInfo, rows: Sequence[StressRow[Any]], styles: dict[str, RowStyle]) -> None:
    """Draw success by level; levels are equally spaced, and methods spread within a level."""
    for number, row in enumerate(rows):
        style = styles[row.name]
        bars = row.method.is_ours or len(rows) <= _MAX_BARRED_ROWS
        by_level = grouped(row.by_ladder[ladder.name], lambda cell: cell.level)
        shift = _DODGE * ((number + 0.5) / len(rows) - 0.5)
        places = [
            (place + shift, Tally.of(by_level[level])) for place, level in enumerate(ladder.levels) if level in by_level
        ]
        shares = [100 * tally.of_groups(row.subject, Group.SUCCESS).share for _, tally in places]
        axis.plot([place for place, _ in places], shares, **style.line_style())
        for place, tally in places:
            solid = not tally.of_groups(row.subject, Group.CONFIDENT).count
            draw_rate(axis, place, tally.of_groups(row.subject, Group.SUCCESS), style, filled=solid, bars=bars)
        axis.plot([], [], marker=style.marker, label=row.name, **style.line_style())
    axis.set_xticks(range(len(ladder.levels)), level_labels(ladder))
    axis.set_xlabel(axis_title(ladder.title, ladder.unit))


def _solved_times(rows: Sequence[StressRow[RegistrationCell]]) -> Any:
    """Return CPU seconds (P, M) of the places that all rows ran and one solved; infinite if the pose is not right."""
    by_place = [{cell.place: cell for cell in row.cells} for row in rows]
    if not by_place:
        return np.empty((0, 0))
    common = [place for place in by_place[0] if all(place in cells for cells in by_place)]
    times = np.array([[_solved_time(cells[place]) for cells in by_place] for place in common], dtype=np.float64)
    times = times.reshape(len(common), len(rows))
    return times[np.isfinite(times).any(axis=1)]


def _solved_time(cell: RegistrationCell) -> float:
    return max(cell.cpu_s, 1e-3) if cell.pose_is_right and cell.cpu_s is not None else np.inf
