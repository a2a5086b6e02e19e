"""Sentences on whether the pose of a candidate can be trusted."""

from __future__ import annotations

from pcbench.registration import Registration
from pcbench.registration.result import UNOBSERVABLE
from pcbench.report.words import length

_GIVEN_POSES = {"none": "Not registered", "matrix": "In the given pose"}  # by method


def doubt_clause(registration: Registration, name: str) -> str:
    """Return why the pose of a candidate, whose registration is doubtful, may be wrong."""
    reason = registration.doubts[0].text.partition("; ")[0]  # what follows is a remedy
    return f"The registration of {name} is doubtful: {reason}. Its numbers describe a pose that may be wrong"


def open_clause(names: str) -> str:
    """Return that the geometry leaves a motion of candidates unconstrained."""
    return (
        f"The geometry does not determine the pose of {names} (see the warnings): distances along unconstrained"
        " directions are meaningless"
    )


def fit_sentence(registration: Registration, unit: str | None, least: float, *, states_overlap: bool = True) -> str:
    """Return how a candidate was registered, and how well its pose is determined.

    Args:
        registration: its registration.
        unit: unit of lengths, if known.
        least: largest length that counts as rounding.
        states_overlap: whether the share of the candidate that lies on the reference is stated.
    """
    method = registration.method.partition(":")[0]
    pose = _GIVEN_POSES.get(method, f"Registered by {'control points' if method == 'points' else method}")
    parts = [f"{registration.overlap:.1%} of the candidate lies on the reference"] if states_overlap else []
    sigma = registration.weakest_sigma
    if sigma is not None and sigma > least and method not in _GIVEN_POSES:
        parts.append(f"the standard error of the pose is {length(sigma, unit)} in its weakest direction")
    return f"{pose}: {', and '.join(parts)}." if parts else f"{pose}."


def pose_sentence(registration: Registration, name: str, unit: str | None) -> str:
    """Return whether the pose of a candidate can be trusted, in the words of the answer of a comparison."""
    if not registration.is_ranked:
        return f"{doubt_clause(registration, name)}."
    if has_open_motion(registration):
        return f"{open_clause(name)}."
    return fit_sentence(registration, unit, 0.0)


def has_open_motion(registration: Registration) -> bool:
    """Return whether the geometry, from which a pose was found, leaves a motion unconstrained."""
    return not registration.keeps_pose and any(notice.code == UNOBSERVABLE for notice in registration.warnings)
