"""Results of `pcbench quality`, and the files of its folder."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from pcbench.measure.quality.numbers import QualityNumber
from pcbench.measure.quality.settings import QualitySettings
from pcbench.measure.quality.sheets import DoubleWall
from pcbench.measure.quality.strips import StripPair
from pcbench.measure.quality.voids import Void
from pcbench.studies.frame.folder import StudyKind

CSV = "quality.csv"
MAPS = "maps"
"""Folder of the GeoTIFF maps and of the arrays that the pictures are drawn from."""


@dataclass(frozen=True)
class MeasuredCloud:
    """One cloud with its numbers.

    Attributes:
        cloud: path of the cloud, as given.
        name: its name in tables.
        crs: coordinate system, if known.
        unit: unit of its coordinates, if known.
        numbers: all numbers by their names, see `pcbench.measure.quality.numbers`.
        voids: the voids that are not at water, the largest first, at most 100.
        water_voids: number of voids at water.
        double_walls: the double walls, the largest first, at most 100.
        strips: pairs of overlapping strips, at most 100.
        strip_field: what tells the strips apart; `none`: nothing does.
        reasons: why parts are missing, by their names.
        missing_data: what stands for missing data; empty if nothing does.
        warnings: warnings of the reader.
    """

    cloud: str
    name: str
    crs: str | None
    unit: str | None
    numbers: Mapping[str, QualityNumber]
    voids: tuple[Void, ...]
    water_voids: int
    double_walls: tuple[DoubleWall, ...]
    strips: tuple[StripPair, ...]
    strip_field: str
    reasons: Mapping[str, str]
    missing_data: str
    warnings: tuple[str, ...]

    def value(self, name: str) -> float | None:
        """Return the value of a number; None if it does not exist."""
        return self.numbers[name].value


@dataclass(frozen=True)
class QualityStudy:
    """The quality of a cloud, and of another one beside it.

    Attributes:
        measured: the cloud; its keys are at the top of quality.json.
        other: the other cloud; None: there is one.
        better: which cloud is better by each number, 1 or 2; 0: within the intervals, null: not comparable.
        sentences: the answer, the most important sentence first.
        settings: the settings.
        provenance: how the results were made, see `pcbench.report.document.provenance`.
    """

    measured: MeasuredCloud = field(metadata={"flat": True})
    other: MeasuredCloud | None
    better: Mapping[str, int | None]
    sentences: tuple[str, ...]
    settings: QualitySettings
    provenance: Mapping[str, Any]

    @property
    def clouds(self) -> tuple[MeasuredCloud, ...]:
        """The measured clouds, one or two."""
        return (self.measured,) if self.other is None else (self.measured, self.other)

    @property
    def warnings(self) -> tuple[str, ...]:
        """Warnings about all clouds."""
        return tuple(warning for cloud in self.clouds for warning in cloud.warnings)


KIND = StudyKind("quality", "quality.json", "pcbench.quality/1", QualityStudy, markdown="quality.md")
