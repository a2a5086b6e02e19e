"""Detects that two clouds differ in unit or coordinate system, from their files' metadata and their sizes."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from pcbench.errors import Notice
from pcbench.geometry.cloud import Cloud
from pcbench.geometry.crs import crs_argument, crs_name, same_crs
from pcbench.geometry.units import metres, unit_key
from pcbench.registration.advice import find_any_scale
from pcbench.registration.result import UNIT_MISMATCH


class _UnitRatio(NamedTuple):
    factor: float
    smaller: str  # the smaller unit, which gives larger coordinates
    larger: str
    tolerance: float  # tolerance of the log-ratio: two clouds of the same scene may differ in size by this much


_UNIT_RATIOS = (
    _UnitRatio(1000, "millimetres", "metres", 0.2),
    _UnitRatio(304.8, "millimetres", "feet", 0.2),
    _UnitRatio(100, "centimetres", "metres", 0.2),
    _UnitRatio(1 / 0.0254, "inches", "metres", 0.2),
    _UnitRatio(1 / 0.3048, "feet", "metres", 0.05),  # sizes differ this much for other reasons too
)
_MAX_LOG_RATIO = 0.05  # for a warning about clouds that do overlap


def explain_failure(reference: Cloud, candidate: Cloud, ratio: float, *, any_scale: bool) -> str:
    """Return why a registration failed and what to do, for the end of its error; "" if units and systems agree.

    Args:
        reference: reference cloud.
        candidate: candidate cloud.
        ratio: candidate's size over the reference's.
        any_scale: whether the method already solves for any pose and scale.
    """
    first, second = reference.unit, candidate.unit
    reasons, command = [], ""
    if first and second and unit_key(first) != unit_key(second):
        reasons.append(f"the files state different units (reference {first}, candidate {second})")
        command = f" --to-unit {first}"
    if reference.crs and candidate.crs and not same_crs(reference.crs, candidate.crs):
        names = f"(reference {crs_name(reference.crs)}, candidate {crs_name(candidate.crs)})"
        reasons.append(f"the files state different coordinate systems {names}")
        command = f" --to-crs {crs_argument(reference.crs)}"
    if not reasons and not (first and second) and (suspected := _suspected_units(ratio)) is not None:
        larger, other = ("candidate", "reference")[:: 1 if ratio > 1 else -1]
        reasons.append(
            f"the {larger} is about {suspected.factor:.4g} times as large as the {other}: is it in {suspected.smaller},"
            f" and the other in {suspected.larger}?"
        )
        command = f" --unit {suspected.smaller} --to-unit {suspected.larger}"
    if not reasons:
        return ""
    conversion = "" if any_scale else f", or {find_any_scale()}"
    is_question = reasons[-1].endswith("?")
    remedy = f"{' Convert it' if is_question else ': convert the candidate'} with pcbench convert FILE OUT{command}"
    return f"{' and '.join(reasons)}{remedy}{conversion}"


def unit_warnings(reference: Cloud, candidate: Cloud, ratio: float, scale: float) -> tuple[Notice, ...]:
    """Warn if the clouds' sizes differ by a ratio of units, or their files state different units.

    Args:
        reference: reference cloud.
        candidate: candidate cloud.
        ratio: registered candidate's size over the reference's.
        scale: scale of the registration.
    """
    first, second = (metres(cloud.unit) for cloud in (reference, candidate))
    if first and second and abs(np.log(scale * first / second)) > _MAX_LOG_RATIO:
        text = f"the reference is in {reference.unit}, the candidate in {candidate.unit}: convert it with"
        text += f" pcbench convert FILE OUT --to-unit {reference.unit}"
        return (Notice(UNIT_MISMATCH, text),)
    stated = {unit_key(unit) for unit in (reference.unit, candidate.unit) if unit}
    if len(stated) == 2 and not (first and second):
        unknown = candidate.unit if first else reference.unit
        text = f"the reference is in {reference.unit}, the candidate in {candidate.unit}, and the length of one"
        text += f" {unknown} is unknown: state it with pcbench convert FILE OUT --unit UNIT"
        return (Notice(UNIT_MISMATCH, text),)
    suspected = _suspected_units(ratio)
    if suspected is None or abs(abs(np.log(ratio)) - np.log(suspected.factor)) > _MAX_LOG_RATIO:
        return ()
    units = (suspected.smaller, suspected.larger)[:: 1 if ratio > 1 else -1]
    text = f"the candidate's extent is {ratio:.4g} times the reference's, which suggests {' against '.join(units)}"
    return (Notice(UNIT_MISMATCH, text),)


def _suspected_units(ratio: float) -> _UnitRatio | None:
    """Return the units that a ratio of sizes suggests."""
    if not 0 < ratio < np.inf:
        return None
    log = abs(np.log(ratio))
    return next((pair for pair in _UNIT_RATIOS if abs(log - np.log(pair.factor)) < pair.tolerance), None)
