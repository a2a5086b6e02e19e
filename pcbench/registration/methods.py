"""Registration methods: their texts, their settings objects, and `register`, which runs them.

To add a method: write a module with a frozen dataclass of its settings (including `text`, `with_scale` and `files`) and
a function that returns a `Fit`. Then add it to `Method`, `_NAMED` (or `parse_method`) and `register` here.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import ArrayLike

from pcbench.errors import InputError, Notice, RegistrationError, did_you_mean
from pcbench.geometry.crs import check_lengths, is_projected_crs, same_crs
from pcbench.geometry.mesh import Mesh
from pcbench.geometry.mesh_samples import sample_candidate, sample_reference, sampling_notice
from pcbench.geometry.reflections import REFLECTIONS
from pcbench.geometry.transform import Similarity
from pcbench.geometry.voxels import robust_extent
from pcbench.io import CloudLike
from pcbench.io.meshes import to_shape
from pcbench.io.nodata import nodata_reason
from pcbench.registration.control_points import ControlPoints, fit_pairs, pose_covariance
from pcbench.registration.from_features import FeatureSettings, align_by_features
from pcbench.registration.given import GivenPose, as_similarity
from pcbench.registration.icp import align
from pcbench.registration.icp_settings import IcpSettings
from pcbench.registration.mirrored import (
    find_reflection,
    fits_mirrored_from_any_pose,
    may_be_mirrored,
    mirrored_notice,
)
from pcbench.registration.mismatch import explain_failure, unit_warnings
from pcbench.registration.quality import PoseSource, assess_given, plane_rms
from pcbench.registration.residuals import SurveyResiduals
from pcbench.registration.result import Registration
from pcbench.registration.rounding import step_warnings
from pcbench.registration.sample_matches import MAX_SPACINGS_ON_SURFACE
from pcbench.registration.target import Target, local_origin
from pcbench.registration.trajectories import TrajectorySettings, align_by_trajectory

Method = IcpSettings | FeatureSettings | ControlPoints | TrajectorySettings | GivenPose

_NAMED: dict[str, Method] = {
    "icp": IcpSettings(),
    "icp-point": IcpSettings(residuals="point"),
    "similarity": IcpSettings(with_scale=True),
    "global": FeatureSettings(),
    "global-similarity": FeatureSettings(with_scale=True),
    "none": GivenPose.identity(),
}
METHODS = (*_NAMED, "points:FILE", "matrix:FILE", "tnt:TRAJECTORY,SCENE")


def register(
    reference: Mesh | CloudLike,
    candidate: Mesh | CloudLike,
    method: Method | Similarity | ArrayLike | str = "icp",
    *,
    initial: Similarity | ArrayLike | None = None,
    target: Target | None = None,
) -> Registration:
    """Register a candidate to a reference, and assess how far the pose can be trusted.

    Args:
        reference: a cloud, an (N, 3) array, a mesh, which is sampled by area, or the path of a file.
        candidate: the same.
        method: `IcpSettings` (refines a pose that is roughly right), `FeatureSettings` (any pose, then ICP),
            `ControlPoints` (pairs of points) or `TrajectorySettings` (camera centres, then ICP). A `Similarity`, a 4x4
            array or a `GivenPose` is used unchanged. A string is parsed by `parse_method`.
        initial: initial pose candidate -> reference for ICP, a `Similarity` or a 4x4 array; the identity if not given.
            Its scale stays unless ICP solves for the scale.
        target: `Target.of(reference)`, if already computed.

    Returns:
        The pose with its quality and warnings.

    Raises:
        InputError: an argument is not usable, a file cannot be read, or the target belongs to another reference.
        RegistrationError: the clouds do not overlap, or the scale collapsed. Different units or coordinate systems,
            stated or suspected from the sizes, are named.
        MissingExtra: KISS-Matcher is not installed (`FeatureSettings`).
    """
    method = as_method(method)
    reference_shape, candidate_shape = to_shape(reference), to_shape(candidate)
    for name, shape in (("the reference", reference_shape), ("the candidate", candidate_shape)):
        check_lengths(shape, name)
    reference, candidate = sample_reference(reference_shape), sample_candidate(candidate_shape, reference_shape)
    start = None if initial is None else as_similarity(initial)
    if start is not None and not isinstance(method, IcpSettings):
        raise InputError(
            f"expected no initial pose with `{method.text}`, got one: only ICP starts from an initial pose"
        )
    origin = local_origin(reference)
    if target is None:
        target = Target.of(reference, origin, is_sampled=isinstance(reference_shape, Mesh))
    elif isinstance(target, Target):
        target.check_belongs_to(reference, origin)
    else:
        raise InputError(f"expected the target as a Target, got {type(target).__name__}")
    points = candidate.points - origin
    residuals = SurveyResiduals()
    ratio = robust_extent(points) / (target.extent or np.inf)
    shares_crs = bool(reference.crs and candidate.crs) and same_crs(str(reference.crs), str(candidate.crs))
    target = target.for_candidate(points, _approximate_scale(method, start, ratio))

    try:
        if isinstance(method, IcpSettings):
            fit = align(target, points, method, None if start is None else start.about(-origin))
            T = fit.T_local.about(origin)
        elif isinstance(method, FeatureSettings):
            fit = align_by_features(target, points, method, origin)
            T = fit.T_local.about(origin)
        elif isinstance(method, ControlPoints):
            T, residuals = fit_pairs(method)
            residuals = replace(residuals, z_is_up=method.z_is_up or is_projected_crs(reference.crs))
            fit = assess_given(target, points, T.about(-origin), origin, method.text)
            fit = fit.with_covariance(pose_covariance(method, T, origin))
        elif isinstance(method, TrajectorySettings):
            aligned = align_by_trajectory(reference.points, candidate.points, method)
            T = aligned.T_reference_candidate
            fit = assess_given(target, points, T.about(-origin), origin, method.text)
            fit = fit._replace(iterations=aligned.iterations, converged=aligned.converged)
        else:
            T = method.T_reference_candidate
            source: PoseSource = "stated" if shares_crs and np.array_equal(T.matrix, np.eye(4)) else "given"
            fit = assess_given(target, points, T.about(-origin), origin, method.text, source=source)
            fit = fit.with_covariance(None)
    except RegistrationError as error:
        any_scale = isinstance(method, FeatureSettings) and method.with_scale
        nodata = nodata_reason({"reference": reference, "candidate": candidate})
        explanation = explain_failure(reference, candidate, ratio, any_scale=any_scale)
        if not nodata and not explanation:
            axes = find_reflection(target, points, origin, with_scale=method.with_scale)
            if axes is None and isinstance(method, FeatureSettings):
                axes = REFLECTIONS[0] if fits_mirrored_from_any_pose(target, points, origin, method) else None
            if axes is not None:
                raise RegistrationError(str(mirrored_notice(axes))) from error
        what = str(error)
        if explanation:  # its remedies take the place of those of the error
            what = f"{what.partition(': ')[0]}; {explanation}"
        raise RegistrationError(f"{nodata}{what}") from error

    quality, scale, sampling = fit.quality, fit.T_local.scale, list[Notice]()
    if isinstance(candidate_shape, Mesh):
        spacing = None if target.is_sampled else target.surface.spacing
        sampling = [sampling_notice(candidate_shape, len(candidate), 0, scale=scale, spacing=spacing)]
    steps = step_warnings(
        reference,
        candidate,
        scale=scale,
        spacing=target.surface.spacing,
        noise=quality.rmse,
        extent=target.extent,
        unit=reference.unit,
    )
    registration = Registration(
        method=method.text,
        T_reference_candidate=T,
        T_local=fit.T_local,
        rmse=quality.rmse,
        overlap=quality.overlap,
        overlap_distance=MAX_SPACINGS_ON_SURFACE * target.spacing,
        iterations=fit.iterations,
        converged=fit.converged,
        information_eigenvalues=quality.eigenvalues,
        weakest_sigma=quality.weakest_sigma,
        covariance=None if quality.covariance is None else quality.covariance.shifted(origin),
        shares_crs=shares_crs,
        residuals=residuals,
        warnings=(*sampling, *quality.warnings, *unit_warnings(reference, candidate, scale * ratio, scale), *steps),
        solved_scale=method.with_scale,
        contrast=quality.contrast,
        returned_share=quality.returned,
    )
    if registration.covariance is not None and registration.keeps_frame:
        registration = replace(registration, rms_as_given=plane_rms(target.surface, points))
    if may_be_mirrored(registration):
        axes = find_reflection(target, points, origin, with_scale=method.with_scale, off_surface=quality.off_surface)
        if axes is not None:
            return replace(registration, warnings=(mirrored_notice(axes), *registration.warnings))
    return registration


def _approximate_scale(method: Method, start: Similarity | None, extent_ratio: float) -> float:
    """Return the scale from candidate to reference before the registration, from a pose or the extents."""
    if isinstance(method, GivenPose):
        return method.T_reference_candidate.scale
    if start is not None:
        return start.scale
    is_unknown = isinstance(method, ControlPoints | TrajectorySettings) or (
        isinstance(method, FeatureSettings) and method.with_scale
    )
    return 1 / extent_ratio if is_unknown and 0 < extent_ratio < np.inf else 1.0


def parse_method(text: str) -> Method:
    """Return the method for a command-line text.

    Args:
        text: `icp` (point to plane), `icp-point`, `similarity` (point to plane with scale: a refinement), `global` or
            `global-similarity` (from any pose, then `icp` or `similarity`), `points:FILE`, `matrix:FILE`,
            `tnt:TRAJECTORY,SCENE` (see `TrajectorySettings.read`) or `none`.

    Returns:
        A method object whose `text` is the given text, and whose `files` are those that it names.

    Raises:
        InputError: there is no such method, or the file cannot be read.
    """
    kind, colon, path = text.partition(":")
    if kind == "points" and path:
        return ControlPoints.read(path)
    if kind == "matrix" and path:
        return GivenPose.read(path)
    if kind == "tnt" and path:
        return TrajectorySettings.read(path)
    if colon or kind not in _NAMED:
        hint = did_you_mean(text, METHODS)
        raise InputError(f"unknown registration {text!r}: expected one of {', '.join(METHODS)}{hint}")
    return _NAMED[kind]


def as_method(method: Method | Similarity | ArrayLike | str) -> Method:
    """Convert a method in any form that `register` accepts to one of the types in `Method`.

    Args:
        method: settings object, pose or text.

    Raises:
        InputError: the value is none of these, or an array that is not a similarity.
    """
    if isinstance(method, str):
        return parse_method(method)
    if isinstance(method, Method):
        return method
    if isinstance(method, Similarity | np.ndarray | list | tuple):
        return GivenPose(as_similarity(method))
    raise InputError(
        "expected the registration as a text, IcpSettings, FeatureSettings, ControlPoints, TrajectorySettings,"
        f" GivenPose, a Similarity or a 4x4 array, got {type(method).__name__}"
    )
