"""Charts of a bench: what time and memory buy, in both directions, and which runs are worth theirs."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from pcbench.bench.pareto import Configuration, configurations, front_of

_COLORS = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9", "#7f7f7f")  # Okabe and Ito
_SHAPES = ("o", "s", "^", "D", "v", "P", "X")
_BEATEN = "#d9dbde"
_FRONT = "#3c4148"
_SMALLEST, _LARGEST = 40.0, 420.0  # points squared: a marker's area grows with memory between them


class _Quantity(NamedTuple):
    column: str
    title: str
    label: str  # {unit} and {threshold} are filled in
    high: bool  # more is better


_SPEED = (
    _Quantity("fscore", "F-score", "F-score at {threshold}", True),
    _Quantity("chamfer", "Chamfer distance", "sum of the mean distances [{unit}]", False),
)
_SPLIT = (
    _Quantity("precision", "accuracy: how much of the cloud is right", "precision at {threshold}", True),
    _Quantity("recall", "completeness: how much of the reference is there", "recall at {threshold}", True),
    _Quantity("mean_c2r", "accuracy: cloud to reference", "mean distance c→r [{unit}]", False),
    _Quantity("mean_r2c", "completeness: reference to cloud", "mean distance r→c [{unit}]", False),
)


def speed(document: dict[str, Any], path: Path) -> bool:
    """Time against F-score and Chamfer distance."""
    return _draw(document, path, _SPEED, columns=2)


def split(document: dict[str, Any], path: Path) -> bool:
    """Time against both directions of each; the recall also of what the cameras saw."""
    return _draw(document, path, _SPLIT, columns=2)


class _Look(NamedTuple):
    """What all panels share."""

    found: list[Configuration]
    color: dict[str, str]  # by method
    shape: dict[str, str]
    varied: tuple[str, ...]  # settings that have more than one value: the markers' labels
    most_memory: float
    unit: str
    threshold: str
    limits: tuple[float, float]  # of the time

    def area(self, configuration: Configuration) -> float:
        memory = configuration.median("peak_rss_bytes")
        return self.area_of(memory) if memory is not None else _SMALLEST

    def area_of(self, memory: float) -> float:
        return _SMALLEST + (_LARGEST - _SMALLEST) * memory / self.most_memory


def _draw(document: dict[str, Any], path: Path, quantities: Sequence[_Quantity], columns: int) -> bool:
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    found = configurations(document["rows"])
    if not any(c.done for c in found):
        return False
    look = _look(document, found)
    failed = [row for row in document["rows"] if row["status"] != "ok"]
    rows = -(-len(quantities) // columns)
    strip = [0.13] if failed else []
    figure = Figure(figsize=(12.5, 1.1 + 4.4 * rows + (0.6 if failed else 0)), dpi=120, layout="constrained")
    FigureCanvasAgg(figure)
    # A strip for failures below the last row of panels.
    grid = figure.add_gridspec(rows + len(strip), columns, height_ratios=[1.0] * rows + strip)
    for number, quantity in enumerate(quantities):
        _panel(figure.add_subplot(grid[number // columns, number % columns]), look, quantity)
    for column in range(columns if failed else 0):
        _strip(figure.add_subplot(grid[rows, column]), look, failed)
    _legend(figure, look, bool(failed))
    figure.savefig(path)
    return True


def _look(document: dict[str, Any], found: list[Configuration]) -> _Look:
    methods = list(dict.fromkeys(c.method for c in found))
    keys = dict.fromkeys(key for c in found for key in c.choices)
    varied = tuple(key for key in keys if len({c.choices.get(key) for c in found if key in c.choices}) > 1)
    times = np.array([row["wall_s"] for row in document["rows"]])
    threshold = next((row["threshold"] for row in document["rows"] if row.get("threshold")), 0.0)
    unit = document["reference"].get("unit") or "units of the file"
    return _Look(
        found,
        {method: _COLORS[number % len(_COLORS)] for number, method in enumerate(methods)},
        {method: _SHAPES[number % len(_SHAPES)] for number, method in enumerate(methods)},
        varied,
        max((c.median("peak_rss_bytes") or 1.0 for c in found), default=1.0),
        unit,
        f"{threshold:.3g} {unit}",
        (float(times.min()) / 1.5, float(times.max()) * 1.7),
    )


def _panel(axis: Any, look: _Look, quantity: _Quantity) -> None:
    from matplotlib.ticker import StrMethodFormatter

    front = front_of(look.found, quantity.column, high=quantity.high)
    if front:
        x = [_value(c, "wall_s") for c in front]
        y = [_value(c, quantity.column) for c in front]
        # Until the next one is done, the last one is the best there is.
        axis.step([*x, look.limits[1]], [*y, y[-1]], where="post", color=_FRONT, linewidth=1.3, zorder=1)
    for c in look.found:
        if c.median(quantity.column) is not None:
            _marker(axis, look, quantity, c, on_front=any(c is other for other in front))
    axis.set_xscale("log")
    axis.set_xlim(*look.limits)
    axis.xaxis.set_major_formatter(StrMethodFormatter("{x:g}"))
    axis.set_xlabel("wall time [s]")
    axis.set_ylabel(quantity.label.format(unit=look.unit, threshold=look.threshold))
    axis.set_title(f"{quantity.title} ({'higher' if quantity.high else 'lower'} is better)", fontsize=11)
    low, high = axis.get_ylim()
    if quantity.high:
        axis.set_ylim(0, min(1.03, max(high + 0.12 * (high - low), 1.25 * high)))
    else:
        axis.set_ylim(0, high + 0.12 * (high - low))
    axis.grid(True, which="major", alpha=0.3)
    axis.spines[["top", "right"]].set_visible(False)


def _marker(axis: Any, look: _Look, quantity: _Quantity, c: Configuration, *, on_front: bool) -> None:
    x, y = _value(c, "wall_s"), _value(c, quantity.column)
    color, area = look.color[c.method], look.area(c)
    spread = [[[at - min(v)], [max(v) - at]] for at, v in ((x, c.values("wall_s")), (y, c.values(quantity.column)))]
    if len(c.done) > 1:
        axis.errorbar(x, y, yerr=spread[1], xerr=spread[0], color=color, linewidth=1, capsize=3, zorder=2)
    face = color if on_front else _BEATEN
    axis.scatter(x, y, s=area, marker=look.shape[c.method], color=face, edgecolor=color, linewidth=1.2, zorder=3)
    seen = c.median("recall_visible") if quantity.column == "recall" else None
    if seen is not None:
        axis.plot([x, x], [y, seen], color=color, linewidth=1, linestyle=":", zorder=2)
        axis.scatter(x, seen, s=area, marker=look.shape[c.method], facecolor="white", edgecolor=color, zorder=3)
    words = " ".join(c.choices[key] for key in look.varied if key in c.choices)
    if words:
        top = max(y, seen or y)
        reach = 0.5 * area**0.5 + 4
        axis.annotate(
            words, (x, top), (0, reach), textcoords="offset points", ha="center", fontsize=8.5, color=_FRONT, zorder=4
        )


def _strip(axis: Any, look: _Look, failed: Sequence[dict[str, Any]]) -> None:
    """Crosses at the time when they failed, the last of one place on top."""
    for number, row in enumerate(failed):
        place = 0.5 + 0.25 * ((number % 3) - 1)
        axis.plot(row["wall_s"], place, marker="x", markersize=8, markeredgewidth=2, color=look.color[row["method"]])
        axis.annotate(
            row["status"], (row["wall_s"], place), (7, 0), textcoords="offset points", va="center", fontsize=8
        )
    axis.set_xscale("log")
    axis.set_xlim(*look.limits)
    axis.set_ylim(0, 1)
    axis.set_yticks([])
    axis.tick_params(axis="x", which="both", bottom=False, labelbottom=False)
    axis.set_ylabel("failed", rotation=0, ha="right", va="center")
    axis.set_facecolor("#f4f1ee")
    axis.spines[:].set_visible(False)


def _legend(figure: Any, look: _Look, failures: bool) -> None:
    from matplotlib.lines import Line2D

    def dot(shape: str, face: str, edge: str, area: float, label: str) -> Line2D:
        return Line2D(
            [],
            [],
            linestyle="",
            marker=shape,
            markerfacecolor=face,
            markeredgecolor=edge,
            markersize=area**0.5,
            label=label,
        )

    handles = [dot(look.shape[m], look.color[m], look.color[m], 80, m) for m in look.color]
    handles.append(Line2D([], [], color=_FRONT, linewidth=1.3, label="Pareto front"))
    if any(len(front_of(look.found, q.column, high=q.high)) < len(look.found) for q in _SPEED + _SPLIT):
        handles.append(dot("o", _BEATEN, "#8a8f96", 80, "beaten"))
    if any(c.median("recall_visible") is not None for c in look.found):
        handles.append(dot("o", "white", _FRONT, 80, "recall of what cameras saw"))
    if failures:
        handles.append(Line2D([], [], linestyle="", marker="x", markeredgewidth=2, color=_FRONT, label="failed"))
    memory = look.most_memory
    handles += [
        dot("o", "none", "#8a8f96", look.area_of(share * memory), f"{share * memory / 2**20:.3g} MiB")
        for share in (0.25, 1.0)
    ]
    if any(len(c.done) > 1 for c in look.found):
        handles.append(Line2D([], [], color="#8a8f96", marker="|", label="median and range over seeds"))
    title = f"labels: {', '.join(look.varied)}" if look.varied else None
    figure.legend(
        handles=handles, loc="outside lower center", ncols=min(len(handles), 7), frameon=False, fontsize=9, title=title
    )


def _value(c: Configuration, column: str) -> float:
    value = c.median(column)
    assert value is not None
    return value
