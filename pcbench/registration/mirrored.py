"""Tells a mirrored candidate from one that shows another scene: no rotation aligns it, but its reflection fits.

Programs with left-handed axes negate one axis or exchange two.
"""

from __future__ import annotations

import numpy as np

from pcbench.errors import Notice, RegistrationError
from pcbench.geometry.arrays import FloatArray, random_rows
from pcbench.geometry.reflections import REFLECTIONS, reflection
from pcbench.geometry.transform import Similarity
from pcbench.registration.from_features import FeatureSettings, align_by_features
from pcbench.registration.icp import align
from pcbench.registration.icp_settings import IcpSettings
from pcbench.registration.icp_stages import refine_coarsely
from pcbench.registration.quality import Quality
from pcbench.registration.result import BLURRED, MIRRORED, OFF_SURFACE, WEAKLY_OBSERVABLE, Registration
from pcbench.registration.target import MIN_EXTENT, Target

_SAMPLE_SIZE = 1_000  # candidate points of the coarse registrations
_MAX_ITERATIONS = 20
_MIN_OVERLAP = 0.5  # of the reflected candidate with the reference
_MAX_OFF_SURFACE_RATIO = 0.3  # off-surface share of the reflected candidate over that of the candidate
_MAX_DISTANCE_RATIO = 0.85  # coarse distance of the reflected candidate over that of the candidate
_HARMLESS = frozenset((BLURRED, WEAKLY_OBSERVABLE))  # warnings of a reflected candidate that fits


def may_be_mirrored(registration: Registration) -> bool:
    """Return whether a pose is so poor that a reflection is worth trying."""
    return registration.doubtful or any(notice.code == OFF_SURFACE for notice in registration.warnings)


def mirrored_notice(axes: str) -> Notice:
    """Return the warning that a candidate is mirrored.

    Args:
        axes: its reflection, one of `REFLECTIONS`.
    """
    change = f"{axes} negated" if len(axes) == 1 else f"{axes[0]} and {axes[1]} exchanged"
    return Notice(
        MIRRORED,
        f"the candidate is mirrored: with {change} it fits the reference; undo the reflection (`pcbench convert"
        f" CANDIDATE unmirrored.ply --mirror {axes}`) and compare the result",
    )


def find_reflection(
    target: Target, points: FloatArray, origin: FloatArray, *, with_scale: bool, off_surface: float = 1.0
) -> str | None:
    """Return the reflection with which ICP aligns the candidate, one of `REFLECTIONS`; None if there is none.

    Args:
        target: reference.
        points: (N, 3) candidate points minus the reference's local origin.
        origin: (3,) local origin.
        with_scale: whether the scale is solved for.
        off_surface: share of the candidate's points near the reference that do not lie on it, at its own pose.
    """
    if target.extent <= MIN_EXTENT or len(target.coarse) < 3:  # a reference without an extent, or without a surface
        return None
    settings = IcpSettings(with_scale=with_scale, max_sample=_SAMPLE_SIZE, max_iterations=_MAX_ITERATIONS)
    sample = random_rows(points, _SAMPLE_SIZE)
    fits = [(*_coarse_fit(target, _reflect(sample, axes, origin), settings), axes) for axes in REFLECTIONS]
    distance, pose, axes = min(fits, key=lambda fit: fit[0])
    # A symmetric scene fits its mirror image as well as itself.
    if not distance <= _MAX_DISTANCE_RATIO * _coarse_fit(target, sample, settings)[0]:
        return None
    try:
        quality = align(target, _reflect(points, axes, origin), IcpSettings(with_scale=with_scale), pose).quality
    except RegistrationError:
        return None
    return axes if _fits(quality, off_surface) else None


def _coarse_fit(target: Target, points: FloatArray, settings: IcpSettings) -> tuple[float, Similarity]:
    """Return the mean distance (at most the coarse side) that ICP leaves, and its pose; inf if nothing overlaps."""
    fits = [(np.inf, Similarity.identity())]
    # A frame is mirrored about its origin, or a cloud about its own centre.
    for shift in (np.zeros(3), target.surface.points.mean(axis=0) - points.mean(axis=0)):
        try:
            pose = refine_coarsely(target, points + shift, settings, Similarity.identity())
        except RegistrationError:
            continue
        pose = pose @ Similarity(np.eye(3), shift)
        distances = target.coarse.index.query(pose.apply(points)).distances
        fits.append((float(np.minimum(distances, target.coarse_side).mean()), pose))
    return min(fits, key=lambda fit: fit[0])


def fits_mirrored_from_any_pose(
    target: Target, points: FloatArray, origin: FloatArray, settings: FeatureSettings
) -> bool:
    """Return whether registration from any pose aligns the reflected candidate. It failed for the candidate itself."""
    try:
        align_by_features(target, _reflect(points, REFLECTIONS[0], origin), settings, origin)
    except RegistrationError:
        return False
    return True


def _reflect(points: FloatArray, axes: str, origin: FloatArray) -> FloatArray:
    return reflection(axes).apply(points + origin) - origin


def _fits(quality: Quality, off_surface: float) -> bool:
    """Return whether a reflected candidate fits well, and far better than the candidate itself."""
    return (
        not {notice.code for notice in quality.warnings} - _HARMLESS
        and quality.overlap >= _MIN_OVERLAP
        and quality.off_surface <= _MAX_OFF_SURFACE_RATIO * off_surface
    )
