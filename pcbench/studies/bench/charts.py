"""Charts of a bench: accuracy and completeness against wall time and memory, with the Pareto front."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import pairwise
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from pcbench.report.colors import SERIES
from pcbench.report.figures import Figures
from pcbench.report.plot import Drawer, Picture
from pcbench.report.plot.panels import save
from pcbench.studies.bench.pareto import Configuration, configurations, front_configurations, fscore_column
from pcbench.studies.bench.plan import IMAGE_SCALE
from pcbench.studies.bench.results import KIND, Bench, BenchRow
from pcbench.studies.frame.canvas import blank_figure, open_frame, plain_log_ticks

_MARKERS = ("o", "s", "^", "D", "v", "P", "X")
_DOMINATED_COLOR = "#d9dbde"
_FRONT_COLOR = "#6b717b"  # legible on light and dark backgrounds
_MIN_AREA, _MAX_AREA = 40.0, 380.0  # of a marker, in square points; grows with peak memory
_MIN_LOG_RATIO = 10  # largest to smallest length from which the axis is logarithmic


class _Quantity(NamedTuple):
    column: str
    title: str
    label: str  # a format string with {unit} and {threshold}
    higher_is_better: bool


_SPEED_QUANTITIES = (
    _Quantity("fscore", "F-score", "F-score at {threshold}", True),
    _Quantity("chamfer", "Chamfer distance", "sum of the mean distances [{unit}]", False),
)
_ACCURACY_COMPLETENESS = (
    _Quantity("precision", "accuracy: share of the cloud near the reference", "precision at {threshold}", True),
    _Quantity("recall", "completeness: share of the reference near the cloud", "recall at {threshold}", True),
    _Quantity("mean_c2r", "accuracy: cloud to reference", "mean distance c→r [{unit}]", False),
    _Quantity("mean_r2c", "completeness: reference to cloud", "mean distance r→c [{unit}]", False),
)


# Draws the charts of a bench folder.
CHARTS = Drawer(f"{__name__}:pictures", (KIND.document,))


def pictures(folder: Path, look: Figures) -> dict[str, Picture]:
    """Return the charts of a folder that `pcbench bench` wrote."""
    study = KIND.read(folder)
    why_not = "no run was measured"
    return {
        "speed": Picture(lambda path: draw_speed(study, path), why_not),
        "accuracy_completeness": Picture(lambda path: draw_accuracy_completeness(study, path), why_not),
    }


def draw_speed(study: Bench, path: Path) -> bool:
    """Draw F-score (over what the cameras saw, if known) and Chamfer distance against wall time.

    Returns:
        False if there is nothing to draw.
    """
    fscore, *others = _SPEED_QUANTITIES
    if fscore_column(study.rows) == "fscore_visible":
        fscore = _Quantity("fscore_visible", "F-score over what the cameras saw", "F of seen at {threshold}", True)
    return _draw(study, path, [fscore, *others])


def draw_accuracy_completeness(study: Bench, path: Path) -> bool:
    """Draw accuracy and completeness against wall time; recall also over the part that the cameras saw."""
    return _draw(study, path, _ACCURACY_COMPLETENESS)


class _ChartLook(NamedTuple):
    """Settings that all panels share.

    A series is a method with its non-numeric settings. Numeric settings label its markers.
    """

    configurations: list[Configuration]
    numeric_settings: frozenset[str]  # names of the varying settings whose values are all numbers
    text_settings: frozenset[str]  # names of the other varying settings
    color: dict[str, str]  # by series, as the markers
    shape: dict[str, str]
    max_memory: float
    unit: str
    threshold: str
    time_limits: tuple[float, float]  # of the time axis, in seconds

    def area(self, configuration: Configuration) -> float:
        return self.area_of_memory(configuration.median("peak_rss_bytes") or 0.0)

    def area_of_memory(self, memory: float) -> float:
        return _MIN_AREA + (_MAX_AREA - _MIN_AREA) * memory / self.max_memory

    def series(self, method: str, choices: Mapping[str, str]) -> str:
        return _series(method, choices, self.text_settings)

    def label(self, c: Configuration) -> str:
        """Numeric settings that vary among the configurations of this method, as text."""
        others = [other.choices for other in self.configurations if other.method == c.method]
        varied = [key for key in c.choices if key in self.numeric_settings and len({o.get(key) for o in others}) > 1]
        return " ".join(f"×{c.choices[key]}" if key == IMAGE_SCALE else f"{key}={c.choices[key]}" for key in varied)


def _series(method: str, choices: Mapping[str, str], text_settings: frozenset[str]) -> str:
    return " ".join((method, *(f"{key}={value}" for key, value in choices.items() if key in text_settings)))


def _draw(study: Bench, path: Path, quantities: Sequence[_Quantity]) -> bool:
    groups = configurations(study.rows)
    quantities = [quantity for quantity in quantities if any(c.median(quantity.column) is not None for c in groups)]
    if not quantities:
        return False
    look = _chart_look(study, groups)
    failed = [row for row in study.rows if row.score is None]
    rows = -(-len(quantities) // 2)
    figure = blank_figure(dpi=120)
    failure_marks = _failure_marks(figure, look, failed)
    height = 0.12 + 0.16 * (1 + max((failure.line for failure in failure_marks), default=0))  # of the strip, in inches
    strip = [height / 4.2] if failed else []
    figure.set_size_inches(12.5, 0.8 + 4.5 * rows + (height + 0.1 if failed else 0))
    # Failures are drawn in a strip below the last row of panels.
    grid = figure.add_gridspec(rows + len(strip), 2, height_ratios=[1.0] * rows + strip)
    panels = [figure.add_subplot(grid[number // 2, number % 2]) for number in range(len(quantities))]
    for axis, quantity in zip(panels, quantities, strict=True):
        _draw_panel(axis, look, quantity)
    for column in range(2 if failed else 0):
        _draw_failures(figure.add_subplot(grid[rows, column]), look, failure_marks)
    _draw_legend(figure, look, quantities, bool(failed))
    figure.draw_without_rendering()  # fixes the marker positions, which the labels depend on
    figure.set_layout_engine("none")
    for axis, quantity in zip(panels, quantities, strict=True):
        _draw_labels(axis, look, quantity)
    save(figure, path)
    return True


def _chart_look(study: Bench, groups: list[Configuration]) -> _ChartLook:
    values: dict[str, dict[str, None]] = {}
    for c in groups:
        for key, value in c.choices.items():
            values.setdefault(key, {})[value] = None
    varied = {key for key, settings in values.items() if len(settings) > 1}
    numeric_settings = frozenset(key for key in varied if all(map(_is_number, values[key])))
    text_settings = frozenset(varied - numeric_settings)
    series = list(dict.fromkeys(_series(c.method, c.choices, text_settings) for c in groups))
    times = np.array([row.run.wall_s for row in study.rows])
    threshold = study.scores[0].threshold if study.scores else 0.0
    unit = study.reference.unit or "units of the file"
    return _ChartLook(
        groups,
        numeric_settings,
        text_settings,
        {name: SERIES[number % len(SERIES)] for number, name in enumerate(series)},
        {name: _MARKERS[number % len(_MARKERS)] for number, name in enumerate(series)},
        max((c.median("peak_rss_bytes") or 1.0 for c in groups), default=1.0),
        unit,
        f"{threshold:.3g} {unit}",
        (float(times.min()) / 1.6, float(times.max()) * 1.9),
    )


def _is_number(text: str) -> bool:
    try:
        float(text)
    except ValueError:
        return False
    return True


def _draw_panel(axis: Any, look: _ChartLook, quantity: _Quantity) -> None:
    front = front_configurations(look.configurations, quantity.column, higher_is_better=quantity.higher_is_better)
    measured = [c for c in look.configurations if c.median(quantity.column) is not None]
    if front:
        x = [_median(c, "wall_s") for c in front]
        y = [_median(c, quantity.column) for c in front]
        # A step function: each front member is the best result until the next one finishes.
        axis.step([*x, look.time_limits[1]], [*y, y[-1]], where="post", color=_FRONT_COLOR, linewidth=1.3, zorder=1)
    for name, color in look.color.items():  # connect the markers of a series by time
        places = [
            (_median(c, "wall_s"), _median(c, quantity.column))
            for c in measured
            if name == look.series(c.method, c.choices)
        ]
        axis.plot(*np.array(sorted(places)).reshape(-1, 2).T, color=color, linewidth=1, alpha=0.4, zorder=1)
    for c in measured:
        _draw_marker(axis, look, quantity, c, on_front=any(c is other for other in front))
    axis.set_xscale("log")
    axis.set_xlim(*look.time_limits)
    plain_log_ticks(axis.xaxis)
    axis.set_xlabel("wall time [s]")
    axis.set_ylabel(quantity.label.format(unit=look.unit, threshold=look.threshold))
    axis.set_title(f"{quantity.title} ({'higher' if quantity.higher_is_better else 'lower'} is better)", fontsize=11)
    values = [value for c in measured for value in c.values(quantity.column)]
    values += [value for c in measured for value in c.values("recall_visible") if quantity.column == "recall"]
    if quantity.higher_is_better:
        axis.set_ylim(0, min(1.09, 1.25 * max(values, default=1.0) or 1.0))
    elif min(values, default=1.0) > 0 and max(values, default=1.0) > _MIN_LOG_RATIO * min(values, default=1.0):
        axis.set_yscale("log")
        axis.set_ylim(min(values) / 1.5, max(values) * 1.5)
        plain_log_ticks(axis.yaxis)
    else:
        axis.set_ylim(0, 1.2 * max(values, default=1.0) or 1.0)
    axis.grid(True, which="major", alpha=0.3)
    open_frame(axis)


def _draw_marker(axis: Any, look: _ChartLook, quantity: _Quantity, c: Configuration, *, on_front: bool) -> None:
    x, y = _median(c, "wall_s"), _median(c, quantity.column)
    series = look.series(c.method, c.choices)
    color, area, shape = look.color[series], look.area(c), look.shape[series]
    for side, center, values in (("xerr", x, c.values("wall_s")), ("yerr", y, c.values(quantity.column))):
        if max(values) > min(values):
            spread = [[center - min(values)], [max(values) - center]]
            axis.errorbar(x, y, **{side: spread}, color=_FRONT_COLOR, linewidth=0.9, capsize=2, zorder=4)
    seen = c.median("recall_visible") if quantity.column == "recall" else None
    if seen is not None:
        axis.plot([x, x], [y, seen], color=color, linewidth=1, zorder=2)
        axis.scatter(x, seen, s=0.15 * area + 6, marker=shape, facecolor="white", edgecolor=color, zorder=3.5)
    face = color if on_front else _DOMINATED_COLOR
    axis.scatter(x, y, s=area, marker=shape, color=face, edgecolor=color, linewidth=1.2, zorder=3, clip_on=False)


def _draw_labels(axis: Any, look: _ChartLook, quantity: _Quantity) -> None:
    """Label each marker with its settings where that overlaps nothing; omit the label if no such position exists."""
    from matplotlib.transforms import Bbox

    scale = axis.figure.dpi / 72
    labels: list[tuple[Configuration, Any, Any]] = []
    steps = [
        (_median(c, "wall_s"), _median(c, quantity.column))
        for c in front_configurations(look.configurations, quantity.column, higher_is_better=quantity.higher_is_better)
    ]
    corners = [axis.transData.transform(place) for place in steps]
    corners.append(np.array([axis.bbox.x1, corners[-1][1]]))
    occupied = [Bbox([[a[0], a[1] - 1], [b[0], a[1] + 1]]) for a, b in pairwise(corners)]
    occupied += [Bbox([[b[0] - 1, min(a[1], b[1])], [b[0] + 1, max(a[1], b[1])]]) for a, b in pairwise(corners)]
    for c in look.configurations:
        if c.median(quantity.column) is None:
            continue
        heights = [_median(c, quantity.column)]
        if quantity.column == "recall" and c.median("recall_visible") is not None:
            heights.append(_median(c, "recall_visible"))
        places = [axis.transData.transform((_median(c, "wall_s"), y)) for y in heights]
        half = 0.5 * scale * look.area(c) ** 0.5
        low, high = np.min(places, axis=0) - half, np.max(places, axis=0) + half
        occupied.append(Bbox([low, high]))
        labels.append((c, low, high))
    for c, low, high in labels:
        (x, y), gap = 0.5 * (low + high), 3 * scale
        above, below = (x, high[1] + gap, "center", "bottom"), (x, low[1] - gap, "center", "top")
        candidates = (
            *((above, below) if quantity.higher_is_better else (below, above)),  # away from the front
            (high[0] + gap, y, "left", "center"),
            (low[0] - gap, y, "right", "center"),
            (high[0] + 1, high[1] + 1, "left", "bottom"),
            (low[0] - 1, low[1] - 1, "right", "top"),
            (high[0] + 1, low[1] - 1, "left", "top"),
            (low[0] - 1, high[1] + 1, "right", "bottom"),
        )
        style = {"fontsize": 9, "color": look.color[look.series(c.method, c.choices)], "zorder": 5}
        for at_x, at_y, across, up in candidates:
            text = axis.text(at_x, at_y, look.label(c), ha=across, va=up, transform=None, **style)
            box = text.get_window_extent()
            inside = axis.bbox.x0 <= box.x0 and box.x1 <= axis.bbox.x1 and axis.bbox.y0 <= box.y0 < axis.bbox.y1
            if inside and not any(box.overlaps(other) for other in occupied):
                occupied.append(box)
                break
            text.remove()


class _FailureMark(NamedTuple):
    """Failures of one series and status at nearly the same time, drawn as one cross in the strip."""

    time: float
    line: int
    color: str
    text: str
    left: bool  # whether the text is left of the cross


def _failure_marks(figure: Any, look: _ChartLook, failed: Sequence[BenchRow]) -> list[_FailureMark]:
    """Group failures and place each label on the first line where it overlaps no other."""
    width = 4.6 * figure.dpi  # minimum width of a strip, in pixels
    low, high = np.log(look.time_limits)
    groups: dict[tuple[str, str, int], list[float]] = {}  # failures of a series within one marker's width
    for row in sorted(failed, key=lambda row: row.run.wall_s):
        position = (np.log(row.run.wall_s) - low) / (high - low) * width
        series = look.series(row.method, row.choices)
        groups.setdefault((series, row.run.status, int(position // 8)), []).append(row.run.wall_s)
    lines: list[list[tuple[float, float]]] = []
    marks = []
    for (series, status, _), times in groups.items():
        text = status if len(times) == 1 else f"{status} ×{len(times)}"
        time = float(np.median(times))
        word = figure.text(0, 0, text, fontsize=8)
        length = word.get_window_extent().width
        word.remove()
        column, gap = float((np.log(time) - low) / (high - low) * width), 8 * figure.dpi / 72
        right = (column - gap, column + gap + length), False
        leftward = (column - gap - length, column + gap), True
        # Place the label left of its cross if it would leave the strip on the right or overlap another label there.
        options = [option for option in (right, leftward) if option[0][0] >= 0 and option[0][1] <= width] or [right]
        lines.append([])
        line, (ends, left) = next(
            (line, option)
            for line, occupied in enumerate(lines)
            for option in options
            if all(option[0][1] < a or b < option[0][0] for a, b in occupied)
        )
        lines[line].append(ends)
        lines = [occupied for occupied in lines if occupied]
        marks.append(_FailureMark(time, line, look.color[series], text, left))
    return marks


def _draw_failures(axis: Any, look: _ChartLook, failure_marks: Sequence[_FailureMark]) -> None:
    """Draw crosses at the times of failed runs."""
    lines = 1 + max(failure.line for failure in failure_marks)
    for failure in failure_marks:
        place = failure.time, 1 - (failure.line + 0.5) / lines
        axis.plot(*place, marker="x", markersize=7, markeredgewidth=2, color=failure.color)
        axis.annotate(
            failure.text,
            place,
            (-7 if failure.left else 7, 0),
            textcoords="offset points",
            ha="right" if failure.left else "left",
            va="center",
            fontsize=8,
        )
    axis.set_xscale("log")
    axis.set_xlim(*look.time_limits)
    axis.set_ylim(0, 1)
    axis.set_yticks([])
    axis.tick_params(axis="x", which="both", bottom=False, labelbottom=False)
    axis.set_ylabel("failed", rotation=0, ha="right", va="center")
    axis.set_facecolor("#8a8f9626")
    axis.spines[:].set_visible(False)


def _draw_legend(figure: Any, look: _ChartLook, quantities: Sequence[_Quantity], failures: bool) -> None:
    from matplotlib.lines import Line2D

    def dot(shape: str, face: str, edge: str, area: float, label: str) -> Line2D:
        style = {"markerfacecolor": face, "markeredgecolor": edge, "markersize": area**0.5}
        return Line2D([], [], linestyle="", marker=shape, label=label, **style)

    handles = [dot(look.shape[name], look.color[name], look.color[name], 80, name) for name in look.color]
    handles.append(Line2D([], [], color=_FRONT_COLOR, linewidth=1.3, label="Pareto front"))
    if any(
        len(front_configurations(look.configurations, q.column, higher_is_better=q.higher_is_better))
        < len(look.configurations)
        for q in quantities
    ):
        handles.append(dot("o", _DOMINATED_COLOR, "#8a8f96", 80, "dominated in time and score"))
    shows_recall = any(q.column == "recall" for q in quantities)
    if shows_recall and any(c.median("recall_visible") is not None for c in look.configurations):
        handles.append(dot("o", "white", _FRONT_COLOR, 25, "recall of the part that cameras saw"))
    if failures:
        handles.append(Line2D([], [], linestyle="", marker="x", markeredgewidth=2, color=_FRONT_COLOR, label="failed"))
    for memory in (_round_memory(0.25 * look.max_memory), _round_memory(look.max_memory)):
        handles.append(dot("o", "none", "#8a8f96", look.area_of_memory(memory), f"{memory / 2**20:g} MiB peak"))
    if any(len(c.measured_rows) > 1 for c in look.configurations):
        handles.append(Line2D([], [], color=_FRONT_COLOR, linewidth=0.9, marker="|", label="median, range over seeds"))
    if IMAGE_SCALE in look.numeric_settings:
        handles.append(Line2D([], [], linestyle="", label="×: image scale"))
    columns = min(len(handles), 7 if max(map(len, look.color)) < 12 else 5)
    figure.legend(handles=handles, loc="outside lower center", ncols=columns, frameon=False, fontsize=9)


def _round_memory(memory: float) -> float:
    """Largest 1, 2 or 5 times a power of ten MiB that is at most `memory`, in bytes."""
    mib = memory / 2**20
    power = 10.0 ** np.floor(np.log10(mib))
    return float(max(step * power for step in (1, 2, 5) if step * power <= mib) * 2**20)


def _median(c: Configuration, column: str) -> float:
    value = c.median(column)
    assert value is not None
    return value
