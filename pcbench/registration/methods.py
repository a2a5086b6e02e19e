"""The registration methods: their texts, the objects that these stand for, and `register`, which carries them out.

To add a method: write a module with a frozen dataclass of its settings (`text` and `with_scale` among them) and a
function that returns a `Fit`, and give it a line in `Method`, `_NAMED` (or `parse_method`) and `register` here.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from pcbench.errors import InputError, Notice
from pcbench.geometry.arrays import FloatArray
from pcbench.geometry.cloud import Cloud, as_cloud
from pcbench.geometry.transform import Similarity
from pcbench.geometry.voxels import robust_extent
from pcbench.registration.control_points import ControlPoints, fit_pairs
from pcbench.registration.from_features import FeatureSettings, align_by_features
from pcbench.registration.given import GivenPose, as_similarity
from pcbench.registration.icp import IcpSettings, align
from pcbench.registration.quality import assess_given
from pcbench.registration.result import UNIT_MISMATCH, CheckPoint, Registration
from pcbench.registration.target import Target, local_origin

Method = IcpSettings | FeatureSettings | ControlPoints | GivenPose

_NAMED: dict[str, Method] = {
    "icp": IcpSettings(),
    "icp-point": IcpSettings(residuals="point"),
    "similarity": IcpSettings(with_scale=True),
    "global": FeatureSettings(),
    "global-similarity": FeatureSettings(with_scale=True),
    "none": GivenPose.identity(),
}
METHODS = (*_NAMED, "points:FILE", "matrix:FILE")

_MAX_LOG_RATIO = 0.05  # between the ratio of two extents and a unit's: they agree to some per cent


def register(
    reference: Cloud | ArrayLike,
    candidate: Cloud | ArrayLike,
    method: Method | Similarity | ArrayLike | str = "icp",
    *,
    initial: Similarity | ArrayLike | None = None,
    target: Target | None = None,
) -> Registration:
    """The pose of a candidate on a reference, and how far it can be trusted.

    Args:
        reference, candidate: clouds, or (N, 3) arrays.
        method: `IcpSettings` (refines a pose that is roughly right), `FeatureSettings` (from any pose, then ICP) or
            `ControlPoints` (pairs of points); a `Similarity`, a 4x4 array or a `GivenPose` is taken as it is. Or a
            text, see `parse_method`.
        initial: the pose candidate -> reference that ICP starts from, a `Similarity` or a 4x4 array; the identity if
            not given. Its scale stays unless ICP solves for the scale.
        target: `Target.of(reference)`, if the caller has it already.

    Raises:
        InputError: an argument is not usable, a file cannot be read, or the target is another reference's.
        RegistrationError: the clouds do not overlap, or the scale collapsed.
        MissingExtra: KISS-Matcher is not installed (`FeatureSettings`).
    """
    reference, candidate, method = as_cloud(reference), as_cloud(candidate), as_method(method)
    start = None if initial is None else as_similarity(initial)
    if start is not None and not isinstance(method, IcpSettings):
        raise InputError(f"an initial pose is where ICP starts: `{method.text}` takes none")
    origin = local_origin(reference)
    if target is None:
        target = Target.of(reference, origin)
    elif isinstance(target, Target):
        target.check_belongs_to(reference, origin)
    else:
        raise InputError(f"expected the target as a Target, got {type(target).__name__}")
    points = candidate.points - origin
    check_points: tuple[CheckPoint, ...] = ()

    if isinstance(method, IcpSettings):
        fit = align(target, points, method, None if start is None else start.about(-origin))
        T = fit.T_local.about(origin)
    elif isinstance(method, FeatureSettings):
        fit = align_by_features(target, points, method, origin)
        T = fit.T_local.about(origin)
    elif isinstance(method, ControlPoints):
        T, check_points = fit_pairs(method)
        fit = assess_given(target, points, T.about(-origin), origin, method.text)
    else:
        T = method.T_reference_candidate
        fit = assess_given(target, points, T.about(-origin), origin, method.text)

    quality = fit.quality
    return Registration(
        method=method.text,
        T_reference_candidate=T,
        T_local=fit.T_local,
        rmse=quality.rmse,
        overlap=quality.overlap,
        iterations=fit.iterations,
        converged=fit.converged,
        information_eigenvalues=quality.eigenvalues,
        weakest_sigma=quality.weakest_sigma,
        check_points=check_points,
        warnings=(*quality.warnings, *_unit_warnings(target.extent, points, fit.T_local.scale)),
        solved_scale=method.with_scale,
        contrast=quality.contrast,
    )


def parse_method(text: str) -> Method:
    """The method that a text of the command line stands for.

    Args:
        text: `icp` (point to plane), `icp-point`, `similarity` (point to plane with scale: a refinement), `global` or
            `global-similarity` (from nothing, then `icp` or `similarity`), `points:FILE`, `matrix:FILE` or `none`.

    Returns:
        An object whose `text` is that text.

    Raises:
        InputError: there is no such method, or the file cannot be read.
    """
    kind, colon, path = text.partition(":")
    if kind == "points" and path:
        return ControlPoints.read(path)
    if kind == "matrix" and path:
        return GivenPose.read(path)
    if colon or kind not in _NAMED:
        raise InputError(f"unknown registration {text!r}: expected one of {', '.join(METHODS)}")
    return _NAMED[kind]


def as_method(method: Method | Similarity | ArrayLike | str) -> Method:
    """A method as `register` takes it, as one of the types in `Method`.

    Raises:
        InputError: it is none, or an array that is no similarity.
    """
    if isinstance(method, str):
        return parse_method(method)
    if isinstance(method, Method):
        return method
    if isinstance(method, Similarity | np.ndarray | list | tuple):
        return GivenPose(as_similarity(method))
    raise InputError(
        "expected the registration as a text, IcpSettings, FeatureSettings, ControlPoints, GivenPose, a Similarity or a"
        f" 4x4 array, got {type(method).__name__}"
    )


def _unit_warnings(extent: float, candidate: FloatArray, scale: float) -> tuple[Notice, ...]:
    """A warning where the extents differ by a factor that looks like a unit."""
    ratio = scale * robust_extent(candidate) / (extent or np.inf)
    for factor, what in (
        (1000, "millimetres against metres"),
        (100, "centimetres against metres"),
        (1 / 0.3048, "feet against metres"),
        (1 / 0.0254, "inches against metres"),
    ):
        for expected, text in ((factor, what), (1 / factor, " against ".join(what.split(" against ")[::-1]))):
            # Extents of clouds of one scene agree to some per cent only where both cover all of it.
            if abs(np.log(ratio / expected) if ratio > 0 else np.inf) < _MAX_LOG_RATIO:
                told = f"the candidate's extent is {ratio:.4g} times the reference's: {text}?"
                return (Notice(UNIT_MISMATCH, told),)
    return ()
