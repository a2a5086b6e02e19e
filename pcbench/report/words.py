"""Numbers, names and labels as tables and sentences show them."""

from __future__ import annotations

from collections.abc import Sequence

from pcbench.measure.directions import MEAN_METRICS
from pcbench.measure.intervals import Interval
from pcbench.report.comparison import Comparison

UNKNOWN = "–"
LABELS = {
    "sum_unsquared": "Chamfer, sum of means",
    "sum_squared": "Chamfer, sum of mean squares",
    **{metric.name: metric.label for metric in MEAN_METRICS},
}
_ROUNDING = 1e-9  # of the scene's extent
_CELLS_ALONG = 28  # the extent, of the cells of the intervals


def number(value: float | None, ci: Interval | None = None) -> str:
    """Four digits, with its interval; a dash where there is none."""
    if value is None:
        return UNKNOWN
    text = f"{value:.4g}"
    return f"{text} [{ci.low:.4g}, {ci.high:.4g}]" if ci else text


def length(value: float | None, unit: str | None) -> str:
    """A length in a sentence: three digits and the unit, where that is known."""
    if value is None:
        return UNKNOWN
    text = f"{value:,.0f}" if 1000 <= abs(value) < 1e6 else f"{value:.3g}"
    return f"{text} {unit}" if unit else text


def joined(names: Sequence[str], most: int = 8) -> str:
    """a, b and c; of more than `most` the rest as their number."""
    if len(names) > most:
        names = [*names[: most - 1], f"{len(names) - most + 1} others"]
    return names[0] if len(names) == 1 else f"{', '.join(names[:-1])} and {names[-1]}"


def shortened(name: str, width: int) -> str:
    """A name in one line of at most `width` letters: its ends, which tell files apart, are kept."""
    name = "".join(letter if letter.isprintable() else "?" for letter in name)
    if len(name) <= width:
        return name
    tail = (width - 1) // 2
    return f"{name[: width - 1 - tail]}…{name[len(name) - tail :]}"


def rounding(comparison: Comparison) -> float:
    """Distances up to this are no distances, in the clouds' unit."""
    return _ROUNDING * _CELLS_ALONG * comparison.reference.block_side


def title(comparison: Comparison) -> str:
    """The reference, in one line."""
    reference = comparison.reference
    unit = f" {reference.unit}" if reference.unit else ""
    name = "reference" if comparison.inputs is None else comparison.inputs.reference.path
    return f"{name}: {reference.points:,} points, spacing {reference.spacing_median:.3g}{unit}"
