"""Sentences on where a candidate lies as a whole: the motion that registration removed, and its signed offset."""

from __future__ import annotations

import numpy as np

from pcbench.measure.reference import ARBITRARY_SIGN, UNSIGNED_MESH
from pcbench.measure.results import Candidate
from pcbench.registration import Registration, RemovedMotion
from pcbench.report.inputs import SourcedComparison
from pcbench.report.words import length, rounding_limit

_MIN_VERTICAL_SHARE = 0.9  # of a shift, to call it up or down


def is_offset(comparison: SourcedComparison, candidate: Candidate) -> bool:
    """Return whether a candidate whose pose ICP did not fit lies significantly above or below the reference."""
    found, registration = candidate.offset, candidate.registration
    fitted = registration.converged is not None
    if found is None or fitted or not found.is_significant or abs(found.median) <= rounding_limit(comparison):
        return False
    return all(notice.code not in (ARBITRARY_SIGN, UNSIGNED_MESH) for notice in comparison.reference.warnings)


def place_sentence(comparison: SourcedComparison, candidate: Candidate, name: str) -> str:
    """Return where a candidate lies as a whole; empty if it lies on the reference in its given coordinates.

    If both clouds have the same frame, the sentence states the motion that registration removed, and where the given
    coordinates lie: a settlement and a wrong pose look the same. Without a registration it states the signed offset.
    """
    unit = comparison.reference.unit
    if is_offset(comparison, candidate):
        assert candidate.offset is not None
        found = candidate.offset
        low, high = sorted(abs(end) for end in found.interval)
        side = _side(found.median, is_up=comparison.reference.normals != "given")
        return (
            f"{name} lies {length(abs(found.median), unit)} [{low:.3g}, {high:.3g}] {side} the reference (median signed"
            " distance to its surface)."
        )
    registration = candidate.registration
    motion = registration.motion
    if motion is None or not registration.keeps_frame:
        return ""
    if motion.size <= rounding_limit(comparison):
        return ""
    return f"{motion_clause(registration, motion, name, unit)}; {_given_clause(registration, motion, unit)}."


def motion_clause(registration: Registration, motion: RemovedMotion, name: str, unit: str | None) -> str:
    """Return how far registration moved a candidate, with 95 % confidence intervals of each component."""
    parts = ", ".join(
        f"{axis} {shift:+.3g}{'' if np.isinf(sigma) else f' ± {1.96 * sigma:.2g}'}"
        for axis, shift, sigma in zip("xyz", motion.shift, motion.shift_sigma, strict=True)
    )
    turn = ""
    if not motion.is_shift:
        turn = f" and turned it by {motion.angle_deg:.3g}"
        turn += " degrees" if np.isinf(motion.angle_sigma_deg) else f" ± {1.96 * motion.angle_sigma_deg:.2g} degrees"
    how = "Registration" if registration.converged is not None else "The pose"
    if motion.size == 0:
        return f"{how} did not shift {name} significantly ({parts}){turn}"
    return f"{how} moved {name} by {_with_half_width(motion, unit)} ({parts}){turn}"


def _with_half_width(motion: RemovedMotion, unit: str | None) -> str:
    """Return the length of a motion with its 95 % confidence interval and its unit."""
    number, _, of_unit = length(motion.size, unit).partition(" ")
    return f"{number} ± {motion.half_width:.2g}{f' {of_unit}' if of_unit else ''}"


def _given_clause(registration: Registration, motion: RemovedMotion, unit: str | None) -> str:
    """Return where the candidate lies in its given coordinates, and how to measure it there."""
    frame = "in the coordinate system of both files" if registration.shares_crs else "in its given coordinates"
    z = float(motion.significant_shift[2])
    is_vertical = abs(z) >= _MIN_VERTICAL_SHARE * motion.size
    place = (
        f"{length(abs(z), unit)} {_side(-z, is_up=True)} the reference"
        if is_vertical
        else f"{length(motion.size, unit)} away"
    )
    given = registration.rms_as_given
    rms = "" if given is None else f", {length(given, unit)} RMS off its surface"
    return f"{frame} it lies {place}{rms} (--register none measures this)"


def _side(signed: float, *, is_up: bool) -> str:
    """Return the side of the reference on which a positive or negative distance lies."""
    if is_up:
        return "above" if signed > 0 else "below"
    return "in front of" if signed > 0 else "behind"
