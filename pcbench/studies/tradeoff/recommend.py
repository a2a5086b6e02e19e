"""The recommended approximation for a tolerance: the cheapest whose errors stay within it."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

from pcbench.studies.tradeoff.approximations import FLOAT32
from pcbench.studies.tradeoff.metrics import DEFORMATION, GROUP_OF, GROUPS
from pcbench.studies.tradeoff.results import Tradeoff, TradeoffRow

# An approximation is cheaper if its median ratio of CPU time is at most this, and if it saves more in each round than
# equal runs of the exact comparison differ.
MAX_CPU_RATIO = 0.95
_STORAGE_ONLY = (FLOAT32,)  # a comparison computes in float64 whatever its input: no time is saved


@dataclass(frozen=True)
class Recommendation:
    """The cheapest approximation for some groups of metrics.

    Attributes:
        groups: groups of metrics whose errors stay within the tolerance.
        row: approximation; None if nothing cheaper does.
        corrected: whether mean distances have to be corrected by the floor.
    """

    groups: tuple[str, ...]
    row: TradeoffRow | None
    corrected: bool = False


def recommend(study: Tradeoff, groups: Iterable[str]) -> Recommendation:
    """Return the cheapest approximation that keeps all metrics of some groups within the tolerance.

    The error of one run lies within the tolerance with a probability of 95 %. The verdict on deformation counts as kept
    if all runs have the exact one.
    """
    asked = tuple(groups)
    choices = [
        (row.cpu_ratio, corrected, row)
        for row in study.rows
        for corrected in (False, True)
        if _is_cheaper(row, study)
        and (row.corrected or not corrected)
        and all(_is_kept(row, group, study.settings.tolerance, corrected=corrected) for group in asked)
    ]
    if not choices:
        return Recommendation(asked, None)
    _, corrected, row = min(choices, key=lambda item: item[:2])
    return Recommendation(asked, row, corrected)


def recommendations(study: Tradeoff) -> list[Recommendation]:
    """Return the recommendation for each group that has values; groups with the same approximation are merged."""
    merged: dict[tuple[str, bool], list[str]] = {}
    chosen: dict[tuple[str, bool], Recommendation] = {}
    for group in known_groups(study):
        one = recommend(study, [group])
        key = ("" if one.row is None else one.row.name, one.corrected)
        merged.setdefault(key, []).append(group)
        chosen[key] = one
    return [Recommendation(tuple(merged[key]), one.row, one.corrected) for key, one in chosen.items()]


def known_groups(study: Tradeoff) -> list[str]:
    """Return the groups with a value in the exact answer; the verdict always exists."""
    present = {GROUP_OF[name] for name, value in study.exact.values.items() if value is not None}
    return [group for group in GROUPS if group in present or group == DEFORMATION]


def _is_cheaper(row: TradeoffRow, study: Tradeoff) -> bool:
    is_faster = row.cpu_ratio <= MAX_CPU_RATIO and row.cpu_ratio_max < 1 / (1 + study.exact.cpu_spread)
    return is_faster and row.family not in _STORAGE_ONLY and not row.message


def _is_kept(row: TradeoffRow, group: str, tolerance: float, *, corrected: bool) -> bool:
    if group == DEFORMATION:
        return row.same_verdict.kept == row.same_verdict.total
    bound = row.group_bound(group, corrected=corrected)
    return bound is not None and bound <= tolerance
