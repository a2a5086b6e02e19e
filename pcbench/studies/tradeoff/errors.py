"""From runs to rows: errors against the exact answer with their intervals, costs, and Pareto fronts."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from statistics import mean, median, stdev

import numpy as np

from pcbench.studies.bench.pareto import pareto_front
from pcbench.studies.tradeoff.approximations import Approximation, Pair
from pcbench.studies.tradeoff.metrics import CHAMFER, CORRECTABLE, DEFORMATION_RMS
from pcbench.studies.tradeoff.results import ComparisonRun, ErrorEstimate, Exact, Share, TradeoffRow

NON_AFFINE = "non-affine"  # the verdict whose size is compared
_ROUNDING = 1e-12  # relative errors below it are rounding


def exact_answer(pair: Pair, runs: Iterable[ComparisonRun]) -> Exact:
    """Return the exact answer with its median costs."""
    exact = [run for run in runs if not run.approximation]
    first = exact[0]
    values = dict(first.values)
    if first.verdict != NON_AFFINE:
        values[DEFORMATION_RMS] = None  # what remains is noise, whose relative error says nothing
    thresholds = pair.settings.thresholds
    return Exact(
        values=values,
        floors=first.floors,
        verdict=first.verdict,
        cpu_s=median(run.cpu_s for run in exact),
        wall_s=median(run.wall_s for run in exact),
        memory_bytes=_largest(run.memory_bytes for run in exact),
        points=first.points,
        threshold=thresholds[0] if thresholds else None,
        unit=pair.unit,
        cpu_spread=max(run.cpu_s for run in exact) / min(run.cpu_s for run in exact) - 1,
    )


def rows(approximations: Sequence[Approximation], runs: Sequence[ComparisonRun], exact: Exact) -> list[TradeoffRow]:
    """Return the row of each approximation."""
    exact_cpu = {run.seed: run.cpu_s for run in runs if not run.approximation}
    return [_row(a, [run for run in runs if run.approximation == a.name], exact, exact_cpu) for a in approximations]


def _row(
    approximation: Approximation, runs: Sequence[ComparisonRun], exact: Exact, exact_cpu: Mapping[int, float]
) -> TradeoffRow:
    ratios = [run.cpu_s / exact_cpu[run.seed] for run in runs]
    failures = [run.message for run in runs if run.message]
    values = {"values": runs, "corrected": runs if runs[0].corrected else []}
    errors: dict[str, dict[str, ErrorEstimate | None]] = {}
    for kind, its_runs in values.items():
        names = exact.values if kind == "values" else (*CORRECTABLE, CHAMFER)
        errors[kind] = {
            name: None if failures else _error([getattr(run, kind).get(name) for run in its_runs], exact_value)
            for name in names
            if its_runs and (exact_value := exact.values.get(name)) is not None
        }
    return TradeoffRow(
        name=approximation.name,
        family=approximation.family,
        side=approximation.side,
        level=approximation.level,
        instruction=approximation.instruction,
        errors=errors["values"],
        corrected=errors["corrected"],
        same_verdict=Share(sum(run.verdict == exact.verdict for run in runs), len(runs)),
        cpu_s=median(run.cpu_s for run in runs),
        wall_s=median(run.wall_s for run in runs),
        cpu_ratio=median(ratios),
        cpu_ratio_max=max(ratios),
        memory_bytes=_largest(run.memory_bytes for run in runs),
        points=(round(median(run.points[0] for run in runs)), round(median(run.points[1] for run in runs))),
        message=failures[0] if failures else "",
    )


def _error(values: Sequence[float | None], exact: float) -> ErrorEstimate | None:
    """Return the mean relative error, and the 95 % prediction interval for the error of one run.

    The interval assumes normally distributed errors: mean ± t s sqrt(1 + 1/n) (Student's t with n - 1 degrees of
    freedom). Of an exact value of 0, the only relative error is 0.
    """
    measured = [value for value in values if value is not None]
    if len(measured) < len(values) or (exact == 0 and any(measured)):
        return None
    errors = [0.0 if exact == 0 else _without_rounding(value / exact - 1) for value in measured]
    centre = mean(errors)
    if min(errors) == max(errors):
        return ErrorEstimate(centre, centre, centre)
    from scipy.special import stdtrit

    half = float(stdtrit(len(errors) - 1, 0.975)) * stdev(errors) * math.sqrt(1 + 1 / len(errors))
    return ErrorEstimate(centre, centre - half, centre + half)


def _without_rounding(error: float) -> float:
    return 0.0 if abs(error) < _ROUNDING else error


def front(rows: Sequence[TradeoffRow], name: str) -> list[TradeoffRow]:
    """Return the approximations on the Pareto front of CPU ratio and error bound of a metric, the cheapest first."""
    measured = [row for row in rows if row.errors.get(name) is not None]
    return _front(measured, [_bound(row, name) for row in measured])


def group_front(rows: Sequence[TradeoffRow], group: str) -> list[TradeoffRow]:
    """Return the approximations on the Pareto front of CPU ratio and largest error bound of a group of metrics."""
    bounds = {row.name: row.group_bound(group) for row in rows}
    measured = [row for row in rows if bounds[row.name] is not None]
    return _front(measured, [bounds[row.name] or 0.0 for row in measured])


def _bound(row: TradeoffRow, name: str) -> float:
    estimate = row.errors[name]
    assert estimate is not None
    return estimate.bound


def _front(rows: Sequence[TradeoffRow], bounds: Sequence[float]) -> list[TradeoffRow]:
    if not rows:
        return []
    costs = np.array([[row.cpu_ratio, bound] for row, bound in zip(rows, bounds, strict=True)])
    chosen = [row for row, is_on in zip(rows, pareto_front(costs), strict=True) if is_on]
    return sorted(chosen, key=lambda row: row.cpu_ratio)


def _largest(values: Iterable[int | None]) -> int | None:
    return max((value for value in values if value is not None), default=None)
