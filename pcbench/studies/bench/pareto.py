"""Configurations of a bench, the runs that differ only in their seeds, and the Pareto front of configurations."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from pcbench.studies.bench.results import BenchRow


@dataclass(frozen=True, eq=False)
class Configuration:
    """One method with one choice of settings, with one row per seed."""

    method: str
    choices: Mapping[str, str]
    rows: Sequence[BenchRow]

    @property
    def name(self) -> str:
        """Method and settings as text."""
        return self.rows[0].name

    @property
    def measured_rows(self) -> list[BenchRow]:
        """Rows with a measured cloud."""
        return [row for row in self.rows if row.score is not None]

    @property
    def is_reliable(self) -> bool:
        """Return whether all seeds were measured: one lucky seed of three does not make a reliable method."""
        return len(self.measured_rows) == len(self.rows)

    def values(self, column: str) -> list[float]:
        """Finite values of a column in the measured rows that have one."""
        values = (row.value(column) for row in self.measured_rows)
        return [value for value in values if value is not None and np.isfinite(value)]

    def median(self, column: str) -> float | None:
        """Return the median of a column over the measured rows, or None."""
        values = self.values(column)
        return float(np.median(values)) if values else None


def configurations(rows: Iterable[BenchRow]) -> list[Configuration]:
    """Group rows by method and settings, in the order of their first row."""
    groups: dict[tuple[object, ...], list[BenchRow]] = {}
    for row in rows:
        groups.setdefault((row.method, *row.choices.items()), []).append(row)
    return [Configuration(group[0].method, group[0].choices, group) for group in groups.values()]


def pareto_front(costs: ArrayLike) -> NDArray[np.bool_]:
    """Mark the costs (N, K) on the Pareto front: no other row is at most as large in all K and smaller in one."""
    c = np.asarray(costs, dtype=np.float64)
    as_small = np.all(c[None] <= c[:, None], axis=2)
    smaller = np.any(c[None] < c[:, None], axis=2)
    beaten: NDArray[np.bool_] = np.any(as_small & smaller, axis=1)
    return ~beaten


def front_configurations(
    groups: Sequence[Configuration], column: str, *, higher_is_better: bool
) -> list[Configuration]:
    """Return the configurations on the Pareto front of median wall time and the median of a column, sorted by time.

    Only configurations that were measured with every seed take part.

    Args:
        groups: all configurations.
        column: name of the column.
        higher_is_better: whether larger values of the column are better.
    """
    measured = [c for c in groups if c.is_reliable and c.median("wall_s") is not None and c.median(column) is not None]
    if not measured:
        return []
    costs = np.array([[c.median("wall_s"), c.median(column)] for c in measured], dtype=np.float64)
    costs[:, 1] *= -1 if higher_is_better else 1
    on_front = [c for c, on in zip(measured, pareto_front(costs), strict=True) if on]
    return sorted(on_front, key=lambda c: c.median("wall_s") or 0.0)


def fscore_column(rows: Iterable[BenchRow]) -> str:
    """Return the column of the F-score by which configurations are compared.

    It is `fscore_visible`, over what the cameras saw, if that is known: otherwise invented surface where no camera
    looked would count as recall.
    """
    scores = [row.score for row in rows if row.score is not None]
    return "fscore_visible" if scores and all(s.fscore_visible is not None for s in scores) else "fscore"


def with_front(rows: Sequence[BenchRow]) -> tuple[BenchRow, ...]:
    """Return the rows with `pareto`: whether their configuration is on the front of wall time and F-score."""
    front = front_configurations(configurations(rows), fscore_column(rows), higher_is_better=True)
    best = {id(row) for configuration in front for row in configuration.rows}
    return tuple(replace(row, pareto=None if row.score is None else id(row) in best) for row in rows)
