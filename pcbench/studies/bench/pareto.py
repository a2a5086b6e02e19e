"""Configurations of a bench: the runs that differ in their seeds alone; and which of them nothing else beats."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray


def choice_text(choices: Mapping[str, str]) -> str:
    """The settings that were chosen, as text."""
    return " ".join(f"{key}={value}" for key, value in choices.items())


@dataclass(frozen=True, eq=False)
class Configuration:
    """One method with one choice of settings; a row for each seed."""

    method: str
    choices: Mapping[str, str]
    rows: Sequence[Mapping[str, Any]]

    @property
    def measured_rows(self) -> list[Mapping[str, Any]]:
        """Those that were measured."""
        return [row for row in self.rows if row["status"] == "ok"]

    @property
    def is_reliable(self) -> bool:
        """Whether every seed was measured: what a lucky one of three scores is no choice."""
        return len(self.measured_rows) == len(self.rows)

    def values(self, column: str) -> list[float]:
        """Of the rows that were measured and have one."""
        return [row[column] for row in self.measured_rows if row.get(column) is not None]

    def median(self, column: str) -> float | None:
        values = self.values(column)
        return float(np.median(values)) if values else None


def configurations(rows: Iterable[Mapping[str, Any]]) -> list[Configuration]:
    """Rows of one method and one choice of settings together, in the order of their first."""
    found: dict[tuple[Any, ...], list[Mapping[str, Any]]] = {}
    for row in rows:
        found.setdefault((row["method"], *row["choices"].items()), []).append(row)
    return [Configuration(group[0]["method"], group[0]["choices"], group) for group in found.values()]


def pareto_front(costs: ArrayLike) -> NDArray[np.bool_]:
    """Which of costs (N, K), all of which should be small, are not beaten: no other is as small in all K and smaller in
    one.
    """
    c = np.asarray(costs, dtype=np.float64)
    as_small = np.all(c[None] <= c[:, None], axis=2)
    smaller = np.any(c[None] < c[:, None], axis=2)
    beaten: NDArray[np.bool_] = np.any(as_small & smaller, axis=1)
    return ~beaten


def front_configurations(found: Sequence[Configuration], column: str, *, higher_is_better: bool) -> list[Configuration]:
    """The configurations, measured with every seed, that no other such beats in both median wall time and the median of
    `column` (`higher_is_better`: more is better), by time.
    """
    measured = [c for c in found if c.is_reliable and c.median("wall_s") is not None and c.median(column) is not None]
    if not measured:
        return []
    costs = np.array([[c.median("wall_s"), c.median(column)] for c in measured], dtype=np.float64)
    costs[:, 1] *= -1 if higher_is_better else 1
    on_front = [c for c, on in zip(measured, pareto_front(costs), strict=True) if on]
    return sorted(on_front, key=lambda c: c.median("wall_s") or 0.0)


def mark_front(rows: Sequence[dict[str, Any]]) -> None:
    """Set `pareto` of every row: true where its configuration is on the front of wall time and F-score; None where it
    was not measured.
    """
    found = configurations(rows)
    best = {
        id(row)
        for configuration in front_configurations(found, "fscore", higher_is_better=True)
        for row in configuration.rows
    }
    for row in rows:
        row["pareto"] = (id(row) in best) if row["status"] == "ok" else None
