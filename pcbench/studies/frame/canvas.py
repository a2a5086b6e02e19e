"""Figures of charts: their panels, axes and legends, and how they are saved."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from pathlib import Path
from textwrap import fill
from typing import Any

import numpy as np

from pcbench.deformation import Trend
from pcbench.report.figures import Figures
from pcbench.report.plot import Picture
from pcbench.report.plot.panels import drawing_style, save
from pcbench.scratch import atomic_write

FIGURES = "figures"  # folder of a study's pictures
DPI = 110
GREY = "#777777"
_LETTERS_PER_INCH = 13.0  # at the size of legends
_LEGEND_KEY_LETTERS = 8  # width of a legend's symbol with its margins
_MAX_SUBDIVIDED_RATIO = 500.0


def blank_figure(size: tuple[float, float] | None = None, dpi: float = DPI) -> Any:
    """Return an empty figure of a width and a height in inches, whose panels share it without overlaps."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=size, dpi=dpi, layout="constrained")
    FigureCanvasAgg(figure)
    return figure


def canvas(
    rows: int, columns: int, size: tuple[float, float], *, extra: float = 0.6, dpi: float = DPI, share: bool = False
) -> tuple[Any, Any]:
    """Return a figure and its axes (rows, columns).

    Args:
        rows: number of rows.
        columns: number of columns.
        size: width and height of each panel, in inches.
        extra: height beyond the panels, for titles and legends, in inches.
        dpi: pixels per inch.
        share: whether all panels have the same limits.
    """
    figure = blank_figure((columns * size[0], rows * size[1] + extra), dpi)
    axes = figure.subplots(rows, columns, squeeze=False, sharex=share, sharey=share)
    for axis in axes.ravel():
        open_frame(axis)
    return figure, axes


def open_frame(axis: Any) -> None:
    """Leave out the upper and the right line around a panel."""
    axis.spines[["top", "right"]].set_visible(False)


def handles_by_label(axes: Iterable[Any]) -> dict[str, Any]:
    """Return one handle per label of all panels."""
    named: dict[str, Any] = {}
    for axis in axes:
        handles, labels = axis.get_legend_handles_labels()
        named |= dict(zip(labels, handles, strict=True))
    return named


def legend(figure: Any, axes: Iterable[Any], *, note: str = "") -> None:
    """Draw one entry per label below all panels, with a note as its title."""
    named = handles_by_label(axes)
    if named:
        letters = int(figure.get_figwidth() * _LETTERS_PER_INCH)
        title = {"title": fill(note, letters), "title_fontsize": 9} if note else {}
        columns = max(1, min(len(named), letters // (max(map(len, named)) + _LEGEND_KEY_LETTERS)))
        style = {"ncols": columns, "frameon": False, "fontsize": 9}
        figure.legend(named.values(), named.keys(), loc="outside lower center", **style, **title)


def plain_log_ticks(scale: Any) -> None:
    """Write plain numbers on a logarithmic axis, such as `axes.xaxis`.

    They are at 1, 2 and 5 times powers of ten, or at powers alone if the axis covers many.
    """
    from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter

    low, high = scale.get_view_interval()
    subs = (1.0, 2.0, 5.0) if high / low < _MAX_SUBDIVIDED_RATIO else (1.0,)
    scale.set_major_locator(LogLocator(subs=subs, numticks=20))
    scale.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    scale.set_minor_formatter(NullFormatter())


def draw_profile(axis: Any, trend: Trend, color: str, label: str) -> None:
    """Draw the means of a trend's bins, and the band that contains 95 % of the means under noise alone."""
    places, mean, null = np.array([(place.at, place.mean, place.null) for place in trend.profile]).T
    axis.fill_between(places, -null, null, color=color, alpha=0.12, linewidth=0)
    axis.plot(places, mean, color=color, marker="o", markersize=3.5, linewidth=1.6, label=label)


def percent_axis(axis: Any) -> None:
    """Set the y axis of shares: 0 to 100 %, with a grid."""
    axis.set_ylim(-4, 104)
    axis.set_yticks(range(0, 101, 20))
    axis.grid(axis="y", alpha=0.3)


def save_charts(out: Path, charts: Iterable[tuple[str, Any]]) -> list[Path]:
    """Save matplotlib figures by name as PNG files in `figures/` of a study's folder, and return the files.

    Raises:
        OSError: a file cannot be written.
    """
    figures = out / FIGURES
    figures.mkdir(exist_ok=True)
    files = []
    for name, figure in charts:
        files.append(figures / f"{name}.png")
        with atomic_write(files[-1]) as file:
            figure.savefig(file, format="png")
    return files


def delete_former_charts(out: Path, files: Iterable[Path]) -> None:
    """Delete the PNG files in `figures/` of a study's folder that are not among `files`.

    Raises:
        OSError: a file cannot be deleted.
    """
    for former in set((out / FIGURES).glob("*.png")) - set(files):
        former.unlink()


def chart_pictures(charts: Callable[[], Iterable[tuple[str, Any]]], look: Figures) -> dict[str, Picture]:
    """Return matplotlib figures by name as pictures for `pcbench plot`.

    Args:
        charts: function that creates the figures, in the appearance `look`.
        look: appearance of the pictures.
    """

    def picture(figure: Any) -> Picture:
        def draw(path: Path) -> bool:
            save(figure, path)
            return True

        return Picture(draw)

    with drawing_style(look):
        return {name: picture(figure) for name, figure in charts()}
