"""Curves of the page as inline SVG: a histogram of the distances, and the F-score against its threshold."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from pcbench.geometry.arrays import FloatArray
from pcbench.report.colors import SERIES
from pcbench.report.inputs import FinishedComparison
from pcbench.report.plot.rounding import log_ticks

WIDTH, HEIGHT = 520, 260  # of a chart, in SVG units
_LEFT, _RIGHT, _TOP, _BOTTOM = 36, 12, 26, 40
_BINS = 48
_THRESHOLDS = 81
_RANGE_SAMPLE = 100_000  # distances from which the range of the axis is chosen
_MAX_SERIES = 7  # further candidates would repeat colours


class Tick:
    """A mark on an axis of a chart: its position in SVG units, and its text."""

    def __init__(self, position: float, text: str) -> None:
        self.position, self.text = round(position, 1), text


@dataclass(frozen=True)
class Series:
    """A curve: the candidate, its colour, and the `d` of an SVG path."""

    name: str
    color: str
    path: str


@dataclass(frozen=True)
class CurveChart:
    """A chart with curves."""

    title: str
    x_label: str
    y_label: str
    series: list[Series]
    x_ticks: list[Tick]
    y_ticks: list[Tick]
    marks: list[Tick]
    omitted: int = 0

    left, right, top, bottom = _LEFT, WIDTH - _RIGHT, _TOP, HEIGHT - _BOTTOM
    width, height = WIDTH, HEIGHT


def charts(comparison: FinishedComparison) -> list[CurveChart]:
    """Return the charts of a comparison; none if all distances are zero."""
    shown = comparison.candidates[:_MAX_SERIES]
    forth = [c.deviation.even_values("distance") for c in shown]
    back = [c.completeness.even_values("distance") for c in shown]
    positive = [part for values in (*forth, *back) if len(part := values[values > 0])]
    if not positive:
        return []
    samples = [part[:: max(1, len(part) // _RANGE_SAMPLE)] for part in positive]
    low = min(float(np.percentile(part, 1)) for part in samples)
    high = max(float(np.percentile(part, 99.9)) for part in samples)
    axis = _LogAxis(low, max(high, 1.01 * low))
    names = [c.name for c in shown]
    omitted = len(comparison) - len(shown)
    unit = f" [{comparison.reference.unit}]" if comparison.reference.unit else ""
    spacing = comparison.reference.spacing_median
    marks = [Tick(axis.position(spacing), "reference spacing")] if axis.low < spacing < axis.high else []
    return [
        _histogram(names, forth, axis, unit, marks, omitted),
        _fscores(names, forth, back, axis, unit, marks, omitted),
    ]


@dataclass(frozen=True)
class _LogAxis:
    low: float
    high: float

    def position(self, value: float) -> float:
        share = math.log(value / self.low) / math.log(self.high / self.low)
        return _LEFT + (WIDTH - _LEFT - _RIGHT) * share

    def ticks(self) -> list[Tick]:
        """Return marks at round values."""
        return [Tick(self.position(value), f"{value:g}") for value in log_ticks(self.low, self.high)]


def _histogram(
    names: Sequence[str], forth: Sequence[FloatArray], axis: _LogAxis, unit: str, marks: list[Tick], omitted: int
) -> CurveChart:
    bins = np.geomspace(axis.low, axis.high, _BINS + 1)
    ends = math.log(axis.low), math.log(axis.high)
    shares = []
    for values in forth:
        # Values beyond the axis count in its first and last bin, so that no share is lost.
        counts, _ = np.histogram(np.log(np.clip(values, axis.low, axis.high)).clip(*ends), _BINS, ends)
        shares.append(100 * counts / max(len(values), 1))
    top = max(float(share.max()) for share in shares) or 1.0
    series = []
    for name, color, share in zip(names, SERIES, shares, strict=False):
        xs = [axis.position(float(edge)) for edge in bins]
        ys = [_y(float(value) / top) for value in share]
        steps = " ".join(f"V{y:.1f}H{x:.1f}" for y, x in zip(ys, xs[1:], strict=True))
        series.append(Series(name, color, f"M{xs[0]:.1f} {_y(0):.1f}{steps}V{_y(0):.1f}"))
    label = f"distance to the nearest reference point{unit}"
    ticks = _even_ticks(top)
    return CurveChart(
        "Distances to the reference", label, "% of points per bin", series, axis.ticks(), ticks, marks, omitted
    )


def _fscores(
    names: Sequence[str],
    forth: Sequence[FloatArray],
    back: Sequence[FloatArray],
    axis: _LogAxis,
    unit: str,
    marks: list[Tick],
    omitted: int,
) -> CurveChart:
    thresholds = np.geomspace(axis.low, axis.high, _THRESHOLDS)
    series = []
    for name, color, there, here in zip(names, SERIES, forth, back, strict=False):
        precision, recall = (_shares_within(values, thresholds) for values in (there, here))
        total = precision + recall
        scores = np.divide(2 * precision * recall, total, out=np.zeros_like(total), where=total > 0)
        points = [f"{axis.position(float(t)):.1f} {_y(float(s)):.1f}" for t, s in zip(thresholds, scores, strict=True)]
        series.append(Series(name, color, f"M{'L'.join(points)}"))
    ticks = [Tick(_y(k / 4), f"{k / 4:g}") for k in range(5)]
    return CurveChart("F-score against its threshold", f"threshold{unit}", "0 to 1", series, axis.ticks(), ticks, marks,
                 omitted)  # fmt: skip


def _shares_within(values: FloatArray, thresholds: FloatArray) -> FloatArray:
    """Return the share of the values (N,) that are at most each threshold (K,), ascending."""
    counts = np.bincount(np.searchsorted(thresholds, values), minlength=len(thresholds) + 1)
    shares: FloatArray = np.cumsum(counts)[: len(thresholds)] / max(len(values), 1)
    return shares


def _y(share: float) -> float:
    return HEIGHT - _BOTTOM - (HEIGHT - _TOP - _BOTTOM) * share


def _even_ticks(top: float) -> list[Tick]:
    """Return three to six marks at round values from 0 to `top`."""
    power = 10.0 ** math.floor(math.log10(top))
    step = next(s * power for s in (0.2, 0.5, 1.0, 2.0) if top / (s * power) <= 5.5)
    return [Tick(_y(k * step / top), f"{k * step:.3g}") for k in range(int(top / step) + 1)]
