"""Distributions of the distances: how many points lie how far away."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from pcbench.report.read import Report

_COLORS = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9", "#999999")  # Okabe and Ito


def distribution(report: Report, path: Path) -> bool:
    """Histogram and cumulative curve of every candidate's distances, and the r→c percentiles beside them."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure
    from matplotlib.ticker import StrMethodFormatter

    figure = Figure(figsize=(12, 4.8), dpi=120, layout="constrained")
    FigureCanvasAgg(figure)
    density, cumulative = figure.subplots(1, 2)
    values = [np.sort(np.asarray(c.deviation.attributes["distance"], dtype=np.float64)) for c in report.candidates]
    positive = [v[v > 0] for v in values if (v > 0).any()]
    low = min((float(np.percentile(v, 0.5)) for v in positive), default=1e-3)
    high = max((float(v[-1]) for v in positive), default=1.0)
    bins = np.geomspace(low, max(high, 1.001 * low), 80)
    for number, (candidate, distances) in enumerate(zip(report.candidates, values, strict=True)):
        name, ranks = candidate.name, candidate.percentiles_completeness
        color = _COLORS[number % len(_COLORS)]
        share, _ = np.histogram(distances, bins)
        density.stairs(100 * share / len(distances), bins, color=color, fill=True, alpha=0.25)
        density.stairs(100 * share / len(distances), bins, color=color, label=name, linewidth=1.4)
        # A curve of a million steps is drawn as well from a thousand of them.
        which = np.unique(np.linspace(0, len(distances) - 1, 2000).astype(int))
        cumulative.plot(
            np.maximum(distances[which], low), 100 * (which + 1) / len(distances), color=color, label=f"{name} c→r"
        )
        back = [(float(v), float(rank[1:])) for rank, v in ranks.items() if v > 0]
        if back:
            cumulative.plot(*zip(*back, strict=True), color=color, linestyle="--", marker=".", label=f"{name} r→c")
    for axis in (density, cumulative):
        axis.set_xscale("log")
        axis.xaxis.set_major_formatter(StrMethodFormatter("{x:g}"))
        axis.set_xlabel(f"distance to the nearest point [{report.unit}]")
        axis.grid(True, which="major", alpha=0.3)
        axis.spines[["top", "right"]].set_visible(False)
    for axis in (density, cumulative):
        if report.spacing_median > 0:
            axis.axvline(
                report.spacing_median, color="#555555", linewidth=1.2, linestyle=":", label="spacing of the reference"
            )
    density.set_ylabel("points per bin [%]")
    density.set_title("candidate to reference", fontsize=11)
    density.legend(framealpha=0.9, edgecolor="none", loc="upper right")
    cumulative.set_ylabel("points within that distance [%]")
    cumulative.set_ylim(0, 100)
    cumulative.set_title("accuracy (c→r) and completeness (r→c, percentiles)", fontsize=11)
    cumulative.legend(framealpha=0.9, edgecolor="none", loc="upper left")
    figure.savefig(path)
    return True
