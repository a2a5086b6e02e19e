"""Distributions of the distances, as histograms and cumulative curves."""

from __future__ import annotations

from pathlib import Path
from textwrap import shorten

import numpy as np

from pcbench.geometry.arrays import even_rows
from pcbench.report.colors import SERIES
from pcbench.report.figures import Figures, ink
from pcbench.report.plot.panels import new_figure, save
from pcbench.report.plot.rounding import log_ticks
from pcbench.report.read import Report
from pcbench.report.words import printable

_HISTOGRAM_BINS = 80
_MAX_CURVE_POINTS = 1000


def distribution(report: Report, path: Path, look: Figures) -> bool:
    """Draw the histogram and the cumulative curve of each candidate's distances, with the r→c percentiles.

    Args:
        report: the report.
        path: the file to write.
        look: appearance of the picture.

    Returns:
        False if all distances are zero.
    """
    from matplotlib.lines import Line2D
    from matplotlib.ticker import NullFormatter, StrMethodFormatter

    values = [np.sort(c.even_values("distance")) for c in report.candidates]
    positive = [v[v > 0] for v in values if (v > 0).any()]
    if not positive:
        return False
    figure = new_figure(14, 4.8)
    # An automatic layout would take as long as the rest of the picture.
    margins = {"left": 0.045, "right": 0.81, "bottom": 0.12, "top": 0.93, "wspace": 0.14}
    density, cumulative = figure.subplots(1, 2, gridspec_kw=margins)
    low = min(float(np.percentile(v, 0.5)) for v in positive)
    high = max(float(v[-1]) for v in positive)
    bins = np.geomspace(low, max(high, 1.001 * low), _HISTOGRAM_BINS)
    handles = []
    for index, (candidate, distances) in enumerate(zip(report.candidates, values, strict=True)):
        color = SERIES[index % len(SERIES)]
        share, _ = np.histogram(distances, bins)
        density.stairs(100 * share / len(distances), bins, color=color, fill=True, alpha=0.6 / len(values))
        density.stairs(100 * share / len(distances), bins, color=color, linewidth=1.4)
        rows = even_rows(len(distances), _MAX_CURVE_POINTS)
        cumulative.plot(np.maximum(distances[rows], low), 100 * (rows + 1) / len(distances), color=color)
        percentiles = [(float(v), float(rank[1:])) for rank, v in candidate.percentiles_completeness.items() if v > 0]
        if percentiles:
            cumulative.plot(*zip(*percentiles, strict=True), color=color, linestyle="--", marker=".")
        label = shorten(printable(candidate.name), 30, placeholder="…")
        handles.append(Line2D([], [], color=color, linewidth=2.5, label=label))
    dark = ink(look.ground("white"))
    handles += [
        Line2D([], [], color=dark, label="candidate → reference"),
        Line2D([], [], color=dark, linestyle="--", marker=".", label="reference → candidate"),
    ]
    if report.spacing_median > 0:
        handles.append(Line2D([], [], color=dark, linewidth=1.2, linestyle=":", label="spacing of the reference"))
    for axis in (density, cumulative):
        axis.set_xscale("log")
        if report.spacing_median > 0:
            axis.axvline(report.spacing_median, color=dark, linewidth=1.2, linestyle=":")
        axis.set_xticks(log_ticks(*axis.get_xlim()))
        axis.xaxis.set_major_formatter(StrMethodFormatter("{x:g}"))
        axis.xaxis.set_minor_formatter(NullFormatter())  # it labels a narrow axis, and the labels overlap
        axis.set_xlabel(f"distance to the nearest point [{report.unit}]")
        axis.grid(True, which="major", alpha=0.3)
        axis.spines[["top", "right"]].set_visible(False)
    density.set_ylabel("points per bin [%]")
    density.set_ylim(bottom=0)
    density.set_title("candidate to reference", fontsize=11)
    cumulative.set_ylabel("points within that distance [%]")
    cumulative.set_ylim(0, 101)
    cumulative.set_title("accuracy (c→r) and completeness (r→c, percentiles)", fontsize=11)
    figure.legend(handles=handles, loc="upper left", bbox_to_anchor=(0.815, 0.95), frameon=False, fontsize=9.5)
    save(figure, path)
    return True
