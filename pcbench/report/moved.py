"""Sentences on where a candidate lies as a whole: the motion that registration removed, and its signed offset."""

from __future__ import annotations

import numpy as np

from pcbench.measure.reference import ARBITRARY_SIGN, UNSIGNED_MESH
from pcbench.measure.results import Candidate
from pcbench.measure.wording import with_unit
from pcbench.registration import Registration, RemovedMotion
from pcbench.report.inputs import FinishedComparison
from pcbench.report.words import interval_text, length, length_number, rounding_limit

MIN_VERTICAL_SHARE = 0.9
"""Share of a motion that is vertical, from which it is called up or down."""
_ROUNDING_SHARE = 1e-12  # of a motion, up to which a component and the half width of its interval are rounding


def is_offset(comparison: FinishedComparison, candidate: Candidate) -> bool:
    """Return whether a candidate whose pose ICP did not fit lies significantly above or below the reference."""
    offset, is_fitted = candidate.offset, candidate.registration.converged is not None
    if offset is None or is_fitted or not offset.is_significant or abs(offset.median) <= rounding_limit(comparison):
        return False
    return all(notice.code not in (ARBITRARY_SIGN, UNSIGNED_MESH) for notice in comparison.reference.warnings)


def place_sentence(comparison: FinishedComparison, candidate: Candidate, name: str) -> str:
    """Return where a candidate lies as a whole; empty if it lies on the reference in its given coordinates.

    If both clouds have the same frame, the sentence states the motion that registration removed, and where the given
    coordinates lie: a settlement and a wrong pose look the same. Without a registration it states the signed offset.
    """
    unit, registration = comparison.reference.unit, candidate.registration
    if (offset := candidate.offset) is not None and is_offset(comparison, candidate):
        side = _side(offset.median, is_up=comparison.reference.normals != "given")
        interval = interval_text(sorted(map(abs, offset.interval)))
        return (
            f"{name} lies {length(abs(offset.median), unit)} {interval} {side} the reference (median signed"
            " distance to its surface)."
        )
    motion = registration.motion
    if motion is None or not registration.keeps_frame or motion.size <= rounding_limit(comparison):
        return ""
    return f"{motion_clause(registration, motion, name, unit)}; {_given_clause(registration, motion, unit)}."


def motion_clause(registration: Registration, motion: RemovedMotion, name: str, unit: str | None) -> str:
    """Return how far registration moved a candidate, with 95 % confidence intervals of each component."""
    parts = ", ".join(
        f"{axis} {_beyond_rounding(shift, motion):+.3g}"
        + ("" if np.isinf(sigma) else f" ± {_beyond_rounding(1.96 * sigma, motion):.2g}")
        for axis, shift, sigma in zip("xyz", motion.shift, motion.shift_sigma, strict=True)
    )
    turn = ""
    if not motion.is_shift:
        turn = f" and turned it by {motion.angle_deg:.3g}"
        turn += " degrees" if np.isinf(motion.angle_sigma_deg) else f" ± {1.96 * motion.angle_sigma_deg:.2g} degrees"
    subject = "Registration" if registration.converged is not None else "The pose"
    if motion.size == 0:
        return f"{subject} did not shift {name} significantly ({parts}){turn}"
    size = with_unit(f"{length_number(motion.size)} ± {_beyond_rounding(motion.half_width, motion):.2g}", unit)
    return f"{subject} moved {name} by {size} ({parts}){turn}"


def _beyond_rounding(value: float, motion: RemovedMotion) -> float:
    """Return a component of a motion, or the half width of its interval; 0 if it is rounding."""
    return value if abs(value) > _ROUNDING_SHARE * motion.size else 0.0


def _given_clause(registration: Registration, motion: RemovedMotion, unit: str | None) -> str:
    """Return where the candidate lies in its given coordinates, and how to measure it there."""
    frame = "in the coordinate system of both files" if registration.shares_crs else "in its given coordinates"
    z = float(motion.significant_shift[2])
    is_vertical = abs(z) >= MIN_VERTICAL_SHARE * motion.size
    place = (
        f"{length(abs(z), unit)} {_side(-z, is_up=True)} the reference"
        if is_vertical
        else f"{length(motion.size, unit)} away"
    )
    rms = registration.rms_as_given  # of a sample: no third digit that could contradict the RMS of all points
    off_surface = "" if rms is None else f", about {with_unit(f'{rms:.2g}', unit)} RMS off its surface"
    return f"{frame} it lies {place}{off_surface} (--register none measures this)"


def _side(signed: float, *, is_up: bool) -> str:
    """Return the side of the reference on which a positive or negative distance lies."""
    if is_up:
        return "above" if signed > 0 else "below"
    return "in front of" if signed > 0 else "behind"
