"""Do two clouds speak of the same unit and coordinate system? What the files state, and what sizes let suspect."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from pcbench.errors import Notice
from pcbench.geometry.cloud import Cloud
from pcbench.geometry.crs import crs_name, same_crs
from pcbench.registration.advice import find_any_scale
from pcbench.registration.result import UNIT_MISMATCH

_METRES = {  # a unit's length by its names
    **dict.fromkeys(("m", "metre", "meter", "metres", "meters"), 1.0),
    **dict.fromkeys(("mm", "millimetre", "millimeter", "millimetres", "millimeters"), 1e-3),
    **dict.fromkeys(("cm", "centimetre", "centimeter", "centimetres", "centimeters"), 1e-2),
    **dict.fromkeys(("km", "kilometre", "kilometer", "kilometres", "kilometers"), 1e3),
    **dict.fromkeys(("ft", "foot", "feet"), 0.3048),
    **dict.fromkeys(("us-ft", "us survey foot", "foot_us", "ftus"), 1200 / 3937),
    **dict.fromkeys(("in", "inch", "inches"), 0.0254),
}


class _Ratio(NamedTuple):
    factor: float
    smaller: str  # the unit that gives the larger numbers
    larger: str
    question: str
    tolerance: float  # of the ratio's logarithm: what two clouds of one scene differ by in size


_RATIOS = (
    _Ratio(1000, "millimetres", "metres", "is one in millimetres?", 0.2),
    _Ratio(304.8, "millimetres", "feet", "is one in millimetres, and one in feet?", 0.2),
    _Ratio(100, "centimetres", "metres", "is one in centimetres?", 0.2),
    _Ratio(1 / 0.0254, "inches", "metres", "is one in inches?", 0.2),
    _Ratio(1 / 0.3048, "feet", "metres", "is one in feet?", 0.05),  # sizes differ by as much for other reasons
)
_MAX_LOG_RATIO = 0.05  # in a warning, where the clouds do meet


def before_failure(reference: Cloud, candidate: Cloud, ratio: float, *, any_scale: bool) -> str:
    """Why a registration may have failed, and what helps, to stand before what failed; empty where nothing is known.

    Args:
        ratio: of the candidate's size by the reference's.
        any_scale: whether the method finds any pose with any scale already.
    """
    first, second = reference.unit, candidate.unit
    said = []
    if first and second and _name(first) != _name(second):
        said.append(f"the files state different units (reference {first}, candidate {second})")
    if reference.crs and candidate.crs and not same_crs(reference.crs, candidate.crs):
        names = f"(reference {crs_name(reference.crs)}, candidate {crs_name(candidate.crs)})"
        said.append(f"the files state different coordinate systems {names}")
    if not said and not (first and second) and (found := _suspected(ratio)) is not None:
        said.append(f"sizes differ by a factor of about {found.factor:.4g}: {found.question}")
    if not said:
        return ""
    cure = "" if any_scale else f", or {find_any_scale()}"
    return f"{' and '.join(said)}{'' if said[-1].endswith('?') else '.'} Convert one of them{cure}: "


def unit_warnings(reference: Cloud, candidate: Cloud, ratio: float, scale: float) -> tuple[Notice, ...]:
    """A warning where the clouds' sizes differ by a factor that looks like a unit, or their files state other units.

    Args:
        ratio: of the registered candidate's size by the reference's.
        scale: of the registration.
    """
    first, second = (_length(cloud.unit) for cloud in (reference, candidate))
    if first and second and abs(np.log(scale * first / second)) > _MAX_LOG_RATIO:
        told = f"the reference is in {reference.unit}, the candidate in {candidate.unit}: nothing was converted"
        return (Notice(UNIT_MISMATCH, told),)
    found = _suspected(ratio)
    if found is None or abs(abs(np.log(ratio)) - np.log(found.factor)) > _MAX_LOG_RATIO:
        return ()
    units = (found.smaller, found.larger)[:: 1 if ratio > 1 else -1]
    told = f"the candidate's extent is {ratio:.4g} times the reference's: {' against '.join(units)}?"
    return (Notice(UNIT_MISMATCH, told),)


def _suspected(ratio: float) -> _Ratio | None:
    """The units that a ratio of sizes looks like."""
    if not 0 < ratio < np.inf:
        return None
    log = abs(np.log(ratio))
    return next((known for known in _RATIOS if abs(log - np.log(known.factor)) < known.tolerance), None)


def _name(unit: str) -> float | str:
    """What two names of one unit have in common."""
    return _length(unit) or unit.strip().lower()


def _length(unit: str | None) -> float | None:
    """Metres; None where the unit is not known."""
    return _METRES.get((unit or "").strip().lower())
