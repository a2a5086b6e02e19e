"""Results of `pcbench checkpoints`, and the files of its folder."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from pcbench.geometry.arrays import FloatArray
from pcbench.measure.checkpoints import CheckPointSettings, CloudAccuracy
from pcbench.studies.frame.folder import StudyKind

CSV = "checkpoints.csv"
PLAN = "plan.npy"  # heights of the cloud in plan view, for the map
_PLAN_CELLS = 160  # along the longer side
_MIN_CELL_POINTS = 8.0  # on average, so that few cells stay empty


@dataclass(frozen=True)
class CheckPointStudy:
    """The accuracy of a cloud by check points.

    Attributes:
        cloud: path of the cloud, as given.
        check_points: path of the file of check points, as given.
        count: number of points of the cloud after filters.
        crs: coordinate system of the cloud, if known; that of the check points is taken to be the same.
        settings: the settings.
        accuracy: the errors and their statistics.
        sentences: the answer, the most important sentence first.
        statements: the statements of the standard, or why there is none.
        notes: sentences on what was assumed.
        warnings: warnings of the reader, and of points that should perhaps not be used.
        extent: smallest x and y, and largest x and y, of the map.
        provenance: how the results were made, see `pcbench.report.document.provenance`.
    """

    cloud: str
    check_points: str
    count: int
    crs: str | None
    settings: CheckPointSettings
    accuracy: CloudAccuracy
    sentences: tuple[str, ...]
    statements: tuple[str, ...]
    notes: tuple[str, ...]
    warnings: tuple[str, ...]
    extent: tuple[float, float, float, float]
    provenance: Mapping[str, Any]


KIND = StudyKind("checkpoints", "checkpoints.json", "pcbench.checkpoints/1", CheckPointStudy, markdown="checkpoints.md")


def plan_extent(sample: FloatArray) -> tuple[float, float, float, float]:
    """Return the extent of a cloud in plan view from a sample (N, 3): smallest x and y, largest x and y."""
    low, high = sample[:, :2].min(axis=0), sample[:, :2].max(axis=0)
    return float(low[0]), float(low[1]), float(high[0]), float(high[1])


def plan_heights(sample: FloatArray) -> FloatArray:
    """Return mean heights (rows, columns) of a cloud in plan view from a sample (N, 3); NaN where it has no points."""
    low, high = sample[:, :2].min(axis=0), sample[:, :2].max(axis=0)
    size = np.maximum(high - low, 1e-9 * max(float(np.abs(high).max()), 1.0))
    by_density = np.sqrt(_MIN_CELL_POINTS * size.prod() / len(sample))
    cell = max(float(size.max()) / _PLAN_CELLS, float(by_density), float(size.max()) * 1e-6)
    columns, rows = np.maximum(np.ceil(size / cell).astype(int), 1).tolist()
    column, row = np.minimum(((sample[:, :2] - low) / cell).astype(int), [columns - 1, rows - 1]).T
    index = row * columns + column
    counts = np.bincount(index, minlength=rows * columns)
    sums = np.bincount(index, sample[:, 2] - sample[0, 2], minlength=rows * columns)
    with np.errstate(invalid="ignore"):
        heights: FloatArray = (sums / counts + sample[0, 2]).reshape(rows, columns)
    return heights
