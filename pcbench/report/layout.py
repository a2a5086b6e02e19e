"""The layout of tables: which quantities have a line, its label and its level, and what is left out first.

All tables show the quantities in the order of `pcbench.measure.quantities`. One without a label is only in
comparison.json and metrics.csv.
"""

from __future__ import annotations

from collections.abc import Callable, Hashable, Iterable, Sequence
from typing import NamedTuple

from pcbench.measure.quantities import quantities
from pcbench.measure.quantity import Quantity
from pcbench.measure.results import ARROWS, REFERENCE_TO_CANDIDATE, Candidate
from pcbench.report.scalars import SCALARS
from pcbench.report.words import UNKNOWN


class Label(NamedTuple):
    """Label of a line in the complete table.

    Attributes:
        text: the label; `{0}` stands for the quantity, `{title}` for the title of a map.
        level: 0 for a separate line, 1 for a detail of the line above.
    """

    text: str
    level: int = 0


class Headline(NamedTuple):
    """Presentation of a quantity in the summary.

    Attributes:
        text: label of its line when candidates are shown side by side; `{0}` stands for the quantity.
        level: as in `Label`.
        is_optional: whether the line is omitted if there are enough others.
        column: heading of its column when each candidate is a row.
        below: second line of that heading; empty: the direction or the threshold.
        ranks: priority of that column for c→r (or without a direction) and for r→c: the highest ranks are omitted
            first, 0 never; None: no such column.
    """

    text: str
    level: int = 0
    is_optional: bool = False
    column: str = ""
    below: str = ""
    ranks: tuple[int | None, int | None] = (None, None)


_FLOOR, _AREA_WEIGHTED = Label("sampling floor", 1), Label("area-weighted", 1)
_MEDIAN, _STD, _NMAD = Label("median", 1), Label("standard deviation", 1), Label("NMAD", 1)
LABELS = {  # by metric, or metric/variant
    "d1_mse": Label("D1 MSE"),
    "d1_mse_floor": _FLOOR,
    "d1_mse_area_weighted": _AREA_WEIGHTED,
    "d1_rms": Label("D1 RMS"),
    "d2_mse": Label("D2 MSE"),
    "d2_mse_floor": _FLOOR,
    "d2_mse_area_weighted": _AREA_WEIGHTED,
    "d2_rms": Label("D2 RMS"),
    "plane_distance_median": Label("median, signed", 1),
    "plane_distance_std": _STD,
    "offset": Label("offset from the surface", 1),
    "plane_distance_nmad": _NMAD,
    "mean_distance": Label("mean distance"),
    "mean_distance_floor": _FLOOR,
    "distance_median": _MEDIAN,
    "distance_std": _STD,
    "distance_nmad": _NMAD,
    "hausdorff_p95": Label("95th percentile"),
    "hausdorff_p99": Label("99th percentile"),
    "hausdorff": Label("Hausdorff (maximum)"),
    "budget_share/unmatched": Label("budget of D2: no counterpart"),
    "budget_share/changed": Label("changed", 1),
    "budget_share/motion": Label("motion", 1),
    "budget_share/affine": Label("stretch, shear", 1),
    "budget_share/smooth": Label("smooth beyond affine", 1),
    "budget_share/noise": Label("noise", 1),
    "budget_share/unexplained": Label("unexplained", 1),
    "m3c2_bias": Label("map m3c2: bias"),
    "m3c2_rms": Label("rms", 1),
    "m3c2_median": _MEDIAN,
    "m3c2_std": _STD,
    "m3c2_nmad": _NMAD,
    "m3c2_lod95_median": Label("median LoD95", 1),
    "m3c2_significant_share": Label("significant share", 1),
    "chamfer/sum_unsquared": Label("Chamfer, sum of means"),
    "chamfer/sum_squared": Label("Chamfer, sum of mean squares"),
    "fscore": Label("F-score at {0.threshold:.4g}"),
    "precision": Label("precision, recall", 1),
    "recall": Label("precision, recall", 1),
    "deformation_rms": Label("RMS", 1),
    "detectable_rms": Label("detectable RMS", 1),
}
_MAP_LABELS = {  # by statistic
    "bias": Label("{title}: bias"),
    "mean": Label("{title}: mean"),
    "rms": Label("rms", 1),
    "median": _MEDIAN,
    "std": _STD,
    "nmad": _NMAD,
}
_LABELLED_BEFORE = "plane_distance"  # map whose distribution has lines below D2
_PRESET_LABEL, _PRESET_FSCORE = Label("{0.variant}: {0.metric}"), Label("{0.variant}: F-score at {0.threshold:.4g}")
_OWN_LABEL, _OWN_VALUE_LABEL = Label("{0.metric}"), Label("{0.metric}.{0.variant}")
HEADLINES = {  # by metric
    "d2_rms": Headline("RMS off the surface (D2)", column="D2 RMS", ranks=(0, None)),
    "d2_rms_floor": Headline("sampling floor", 1, column="floor", ranks=(1, None)),
    "mean_distance": Headline("mean distance", column="mean", ranks=(5, 0)),
    "mean_distance_floor": Headline("sampling floor", 1, column="floor", ranks=(5, 1)),
    "hausdorff_p95": Headline("95% lie within", column="95%", ranks=(6, 6)),
    "hausdorff": Headline("all lie within (Hausdorff)", column="largest", ranks=(9, 9)),
    "m3c2_bias": Headline("map m3c2: bias", is_optional=True),
    "m3c2_rms": Headline("map m3c2: rms", is_optional=True),
    "m3c2_lod95_median": Headline("median LoD95", 1, is_optional=True),
    "m3c2_significant_share": Headline("significant share", 1, is_optional=True),
    "fscore": Headline("F-score at {0.threshold:.4g}", is_optional=True, column="F-score", ranks=(3, None)),
    "precision": Headline("precision, recall", 1, is_optional=True),
    "recall": Headline("precision, recall", 1, is_optional=True),
}
_MAP_HEADLINES = {key: Headline(f"{{title}}: {key}", is_optional=True) for key in ("bias", "mean", "rms")}
# Ranks of columns that are no quantities: on the terminal by priority, on the page by their place among the others.
TERMINAL_RANKS = {"pose": 0, "deformation": 2, "overlap": 4, "deformed RMS": 7, "points": 8}
PAGE_RANKS = {"deformation": 3, "points measured": 20, "registration RMSE": 21, "overlap": 22}
_ASKED_RANKS = (3, 3)  # of presets and metrics that were asked for, like the F-score
_SECOND_COLUMN = (REFERENCE_TO_CANDIDATE, "a_to_b")  # directions in the column r→c; the a of a preset is the reference
_LARGER_OF_BOTH = ("symmetric_max", "symmetric")  # directions without a line
_SAME_LINE = {"recall": "precision"}  # metrics in the line of another one


class LineCell(NamedTuple):
    """A cell of a table.

    Attributes:
        text: its text.
        interval: lower and upper end of the 95 % confidence interval, if known.
        is_best: whether the value is among the best.
    """

    text: str = ""
    interval: tuple[str, str] | None = None
    is_best: bool = False

    @property
    def with_interval(self) -> str:
        """The text, followed by the interval in brackets."""
        return f"{self.text} [{', '.join(self.interval)}]" if self.interval else self.text


class Line(NamedTuple):
    """A line of a table: a label, and two cells for each candidate.

    Attributes:
        label: name of the metric.
        cells: (c→r, r→c) for each candidate; the second is empty if a number has no direction.
        level: as in `Label`.
        rank: place among the columns if each candidate has a row; None: no column.
    """

    label: str
    cells: list[tuple[LineCell, LineCell]]
    level: int = 0
    rank: int | None = None

    @classmethod
    def of_texts(
        cls, label: str, texts: Iterable[str], level: int = 0, *, second: str = "", rank: int | None = None
    ) -> Line:
        """Return a line with a text for each candidate, and the same text in the second column of all."""
        return cls(label, [(LineCell(text), LineCell(second)) for text in texts], level, rank)

    @property
    def with_intervals(self) -> Line:
        """The line with the interval of each cell in its text."""
        cells = [(LineCell(first.with_interval), LineCell(second.with_interval)) for first, second in self.cells]
        return self._replace(cells=cells)

    @property
    def texts(self) -> list[str]:
        """The texts of all cells, without intervals."""
        return [cell.text for pair in self.cells for cell in pair]


class LineQuantities(NamedTuple):
    """The quantities of one line: two columns per candidate."""

    pairs: list[list[Quantity | None]]

    @property
    def first(self) -> Quantity:
        """The first quantity; all have the same label."""
        return next(quantity for pair in self.pairs for quantity in pair if quantity is not None)

    def cells(self, cell: Callable[[Quantity], LineCell]) -> list[tuple[LineCell, LineCell]]:
        """Return the cells of both columns for each candidate; a column without any quantity is empty."""
        empty = [LineCell("" if all(pair[k] is None for pair in self.pairs) else UNKNOWN) for k in (0, 1)]
        columns = ([empty[k] if (q := pair[k]) is None else cell(q) for pair in self.pairs] for k in (0, 1))
        return list(zip(*columns, strict=True))


def label_of(quantity: Quantity) -> Label | None:
    """Return the label of a quantity in the complete table; None: it is not in the table."""
    label: Label | None
    if quantity.group.startswith("preset"):
        label = _PRESET_LABEL if quantity.threshold is None else _PRESET_FSCORE
        if quantity.metric in ("precision", "recall"):
            return None
    elif quantity.group == "own":
        label = _OWN_VALUE_LABEL if quantity.variant else _OWN_LABEL
    elif quantity.metric in SCALARS:
        label = _MAP_LABELS[quantity.variant]
        if quantity.metric == _LABELLED_BEFORE and label in (_MEDIAN, _STD, _NMAD):
            return None
    else:
        label = LABELS.get(f"{quantity.metric}/{quantity.variant}" if quantity.variant else quantity.metric)
    if label is None or quantity.direction in _LARGER_OF_BOTH:
        return None
    return label._replace(text=_filled(label.text, quantity))


def headline_of(quantity: Quantity) -> Headline | None:
    """Return the presentation of a quantity in the summary; None: it is not in the summary."""
    if quantity.metric in SCALARS and quantity.metric != _LABELLED_BEFORE:
        headline = _MAP_HEADLINES.get(quantity.variant)
    else:
        headline = HEADLINES.get(quantity.metric)
    if headline is None or quantity.direction in _LARGER_OF_BOTH or quantity.group.startswith("preset"):
        return None
    return headline._replace(text=_filled(headline.text, quantity))


def asked_headline_of(quantity: Quantity) -> Headline | None:
    """Return the presentation in the summary of a value that was asked for: of a preset, or a user-defined metric."""
    label = label_of(quantity)
    if label is None:
        return None
    if quantity.group == "own":
        column, below = quantity.metric.partition(".")[::2]
        below = f"{below} {ARROWS[quantity.direction]}" if quantity.direction else below
        below = f"{below}.{quantity.variant}" if quantity.variant else below
    else:
        column, below = quantity.variant, quantity.metric if quantity.threshold is None else ""
    return Headline(label.text, column=column, below=below, ranks=_ASKED_RANKS)


def column_of(quantity: Quantity) -> int:
    """Return the column of a quantity in its line: 1 for r→c, 0 for all others."""
    return int(quantity.direction in _SECOND_COLUMN)


def line_key(quantity: Quantity) -> Hashable:
    """Return what the quantities of one line have in common."""
    return _SAME_LINE.get(quantity.metric, quantity.metric), quantity.variant, quantity.threshold


def arrange(candidates: Sequence[Candidate], is_shown: Callable[[Quantity], bool]) -> list[LineQuantities]:
    """Return the lines of the quantities that are shown, with several candidates side by side."""
    arranged: dict[Hashable, LineQuantities] = {}
    for k, candidate in enumerate(candidates):
        for quantity in filter(is_shown, quantities(candidate)):
            line = arranged.setdefault(line_key(quantity), LineQuantities([[None, None] for _ in candidates]))
            line.pairs[k][column_of(quantity)] = quantity
    return list(arranged.values())


def _filled(text: str, quantity: Quantity) -> str:
    scalar = SCALARS.get(quantity.metric)
    return text.format(quantity, title="" if scalar is None else scalar.title)
