"""Robust coarse-to-fine ICP that assesses its own result.

Point to plane (Chen & Medioni 1992) or point to point (Besl & McKay 1992), both with Tukey's biweight at the end.
Motions that the geometry does not fix are detected (see `degeneracy`), and no update is made along them.
"""

from __future__ import annotations

import numpy as np

from pcbench.errors import Notice, RegistrationError
from pcbench.geometry.arrays import FloatArray
from pcbench.geometry.transform import Similarity
from pcbench.registration.icp_settings import IcpSettings
from pcbench.registration.icp_stages import FAST_START, SLOW_START, IcpProblem, Start, run_both_stages
from pcbench.registration.quality import MAX_OFF_SURFACE_SHARE, Fit, Quality, assess, with_doubt
from pcbench.registration.result import NO_CONVERGENCE
from pcbench.registration.target import Target


def align(
    target: Target,
    points: FloatArray,
    settings: IcpSettings,
    initial: Similarity | None = None,
) -> Fit:
    """Register points to a target by coarse-to-fine ICP (see `fit_pose`); both are relative to one local origin.

    If the contrast of the pose leaves a doubt, ICP is repeated from starts around it (see `with_doubt`).

    Args:
        target: reference.
        points: (N, 3) candidate points minus the reference's local origin.
        settings: residuals, scale and limits.
        initial: initial pose between local coordinates; its scale stays unless the scale is solved for.

    Raises:
        RegistrationError: there are too few points, the clouds do not overlap, or the scale collapsed.
    """
    if initial is not None:
        # Apply the initial pose first: the points are then in the reference's unit, and the motion is small.
        fit = align(target, initial.apply(points), settings)
        return fit._replace(T_local=fit.T_local @ initial)
    problem = IcpProblem.of(target, points, settings)
    fit = fit_pose(problem)
    quality = with_doubt(target, problem.random_sample, fit.T_local, fit.quality, with_scale=settings.with_scale)
    return fit._replace(quality=quality)


def fit_pose(problem: IcpProblem, *, may_be_far: bool = True) -> Fit:
    """Register by coarse-to-fine ICP and assess the pose, without restarts.

    The maximum correspondence distance narrows first. Then a Tukey kernel is used whose width follows the residuals. A
    robust kernel from the start would use only the pairs that already fit, and shrink the basin of convergence. A slow
    start that uses all pairs finds large motions, but may slide partly overlapping clouds onto each other. It is
    therefore tried only if the fast start leaves points off the reference's surface. If the geometry does not observe
    some motion, the fit is repeated with this motion constrained to zero: noise must not move the pose.

    Args:
        problem: inputs of the fit.
        may_be_far: whether the slow start is tried too.

    Raises:
        RegistrationError: the clouds do not overlap, or the scale collapsed.
    """
    starts = (FAST_START, SLOW_START) if may_be_far else (FAST_START,)
    start, fit = _best_start(problem, starts)
    unobservable = fit.quality.unobservable
    if unobservable.shape[1] and problem.settings.residuals == "plane":
        try:
            constrained = _fit_and_assess(problem, start, unobservable)
        except RegistrationError:
            constrained = fit
        # Use the constrained fit only if it fits as well: a motion that the pairs support is not noise.
        free_quality, constrained_quality = fit.quality, constrained.quality
        fits_as_well = constrained_quality.rmse <= 1.05 * free_quality.rmse
        if fits_as_well and constrained_quality.overlap >= 0.98 * free_quality.overlap:
            fit = constrained
    if not fit.converged:
        text = f"ICP did not converge within {fit.iterations} iterations: check the aligned clouds"
        warnings = (*fit.quality.warnings, Notice(NO_CONVERGENCE, text))
        fit = fit._replace(quality=fit.quality._replace(warnings=warnings))
    return fit


def _best_start(problem: IcpProblem, starts: tuple[Start, ...]) -> tuple[Start, Fit]:
    """Return the best fit and its start; later starts run only if the first leaves points off the surface."""
    free = np.zeros((7 if problem.settings.with_scale else 6, 0))
    fits: list[tuple[Start, Fit]] = []
    failures: list[RegistrationError] = []
    for start in starts:
        try:
            fits.append((start, _fit_and_assess(problem, start, free)))
        except RegistrationError as failure:
            failures.append(failure)
        else:
            if fits[-1][1].quality.off_surface <= MAX_OFF_SURFACE_SHARE:
                break
    if not fits:
        raise failures[0]
    return max(fits, key=lambda start_and_fit: _merit(start_and_fit[1].quality))


def _merit(quality: Quality) -> float:
    return quality.overlap - quality.off_surface


def _fit_and_assess(problem: IcpProblem, start: Start, constrained: FloatArray) -> Fit:
    """Run both stages from the identity and assess the result.

    Args:
        problem: shared inputs.
        start: how the coarse stage narrows.
        constrained: (6 or 7, C) orthonormal motions that are constrained to zero.
    """
    target, plane = problem.target, problem.settings.residuals == "plane"
    icp_result = run_both_stages(problem, start, constrained)
    with_scale = problem.settings.with_scale
    quality = assess(
        target,
        problem.sample,
        problem.random_sample,
        icp_result.T,
        plane=plane,
        with_scale=with_scale,
        hint=icp_result.hint,
    )
    return Fit(icp_result.T, quality, icp_result.iterations, icp_result.converged)
