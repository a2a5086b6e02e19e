"""Tables of the quality of a cloud: all numbers, double walls, voids and strips."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from itertools import groupby

from pcbench.measure.quality.bootstrap import BlockEstimate
from pcbench.report.article import TableCell
from pcbench.report.markup import csv_text
from pcbench.report.words import UNKNOWN, length_number, percentage
from pcbench.studies.quality.results import MeasuredCloud, QualityStudy
from pcbench.studies.quality.words import interval_text, value_text

MOST_ROWS = 20
"""Rows of the tables of double walls, voids and strips."""


def number_rows(study: QualityStudy) -> list[list[str | TableCell]]:
    """Return all numbers: a header, a title for each group, and a column for each cloud; the better one is marked."""
    rows: list[list[str | TableCell]] = [["", *(cloud.name for cloud in study.clouds)]]
    items = study.measured.numbers.items()
    for group, numbers in groupby(items, key=lambda item: item[1].group):
        lines = [
            [number.label, *_cells(name, study)]
            for name, number in numbers
            if any(cloud.value(name) is not None for cloud in study.clouds)
        ]
        if lines:
            rows += [[group, *("" for _ in study.clouds)], *lines]
    return rows


def _cells(name: str, study: QualityStudy) -> Iterator[str | TableCell]:
    for place, cloud in enumerate(study.clouds, 1):
        text = value_text(cloud.numbers[name])
        yield TableCell(text, "best") if study.better.get(name) == place else text


def definition_rows(study: QualityStudy) -> list[list[str]]:
    """Return the definition and the source of each number."""
    return [
        ["number", "name in quality.json", "definition", "source"],
        *(
            [number.label, name, number.definition, number.source or "pcbench"]
            for name, number in study.measured.numbers.items()
        ),
    ]


def wall_rows(cloud: MeasuredCloud) -> list[list[str]]:
    """Return the largest double walls."""
    unit = f" [{cloud.unit}]" if cloud.unit else ""
    header = [
        "double wall",
        f"x{unit}",
        f"y{unit}",
        f"z{unit}",
        f"distance{unit}",
        f"area{unit and f' [{cloud.unit}²]'}",
    ]
    return [
        header,
        *(
            [str(k), *(f"{x:,.2f}" for x in wall.centre), length_number(wall.separation), length_number(wall.area)]
            for k, wall in enumerate(cloud.double_walls[:MOST_ROWS], 1)
        ),
    ]


def void_rows(cloud: MeasuredCloud) -> list[list[str]]:
    """Return the largest voids."""
    unit = f" [{cloud.unit}]" if cloud.unit else ""
    return [
        ["void", f"x{unit}", f"y{unit}", f"area{unit and f' [{cloud.unit}²]'}"],
        *(
            [str(k), f"{void.x:,.2f}", f"{void.y:,.2f}", length_number(void.area)]
            for k, void in enumerate(cloud.voids[:MOST_ROWS], 1)
        ),
    ]


def strip_rows(cloud: MeasuredCloud) -> list[list[str]]:
    """Return the pairs of strips with the largest differences."""
    unit = f" [{cloud.unit}]" if cloud.unit else ""
    header = ["strips", "places", f"dz{unit}", f"RMSDz{unit}", f"RMS along the normal{unit}", "left out"]
    return [
        header,
        *(
            [
                f"{pair.first} and {pair.second}",
                f"{pair.places:,}",
                _estimate(pair.dz),
                _estimate(pair.rms_dz),
                _estimate(pair.rms_normal),
                percentage(pair.left_out),
            ]
            for pair in cloud.strips[:MOST_ROWS]
        ),
    ]


def numbers_csv(study: QualityStudy) -> str:
    """Return all numbers of all clouds as CSV."""
    header = ("cloud", "name", "label", "value", "low", "high", "unit", "better", "definition", "source")
    return csv_text(
        header,
        (
            (cloud.name, name, n.label, n.value, n.low, n.high, n.unit, n.better, n.definition, n.source)
            for cloud in study.clouds
            for name, n in cloud.numbers.items()
        ),
    )


def terminal_rows(study: QualityStudy) -> list[Sequence[str]]:
    """Return all numbers as texts, with a mark after the better one of two."""
    return [[cell if isinstance(cell, str) else f"{cell.text} *" for cell in row] for row in number_rows(study)]


def _estimate(value: BlockEstimate | None) -> str:
    if value is None:
        return UNKNOWN
    text = length_number(value.value)
    return f"{text} {interval_text(value.low, value.high)}" if value.has_interval else text
