"""M3C2 of a candidate against the prepared reference: choice of core points, normals and cylinders."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from pcbench.errors import InputError, Notice
from pcbench.geometry.arrays import FloatArray
from pcbench.geometry.cloud import Cloud
from pcbench.geometry.neighbors import Index
from pcbench.geometry.normals import Surface, unit
from pcbench.geometry.order_statistics import NORMAL_MAD
from pcbench.geometry.voxels import voxel_downsample_to
from pcbench.measure.deviation import M3C2, m3c2
from pcbench.measure.m3c2_settings import M3C2Settings
from pcbench.measure.reference import Reference
from pcbench.measure.wording import pluralize
from pcbench.registration import Registration

_MAX_CORES = 50_000  # default core points: the reference, voxel-downsampled
_CYLINDER_RADIUS_SPACINGS = 6  # in median spacings of the sparser cloud: about 30 of its points per cylinder
_CYLINDER_HALF_LENGTH_RADII = 1  # half length in radii: longer cylinders reach the opposite wall of a house
_QUARTER_QUANTILE = 0.3186  # distance from zero within which a quarter of a normal distribution lies, in its sigma
_MAX_CLIPPINGS = 20  # iterations of the estimate of the stable area; a handful suffice
_MIN_PLANE_POINTS = 3  # points needed for a normal


def compare_along_normals(
    reference: Reference, candidate: Index, registration: Registration, settings: M3C2Settings
) -> M3C2 | None:
    """Compute M3C2 of an aligned candidate (minus the reference's origin), in the reference's coordinates.

    The result is None if the reference has too few points for normals. Core points outside the region are omitted, and
    those without a normal have no distance.

    Raises:
        InputError: no core point lies in the region.
    """
    if not reference.has_normals:
        return None
    radius = settings.radius
    if radius is None:
        radius = _CYLINDER_RADIUS_SPACINGS * max(reference.spacing, Surface(candidate).spacing)
    if settings.cores is None:
        rows = np.flatnonzero(reference.inside)
        rows = rows[voxel_downsample_to(reference.points[rows], _MAX_CORES, start=radius / 2)]
        cores, normals = reference.points[rows], reference.surface.normals(rows)
    else:
        cores, normals = _custom_cores(reference, settings.cores)
    if settings.normal_radius is not None:
        normals = _fit_normals(reference, cores, settings.normal_radius)
    unknown = np.isnan(normals[:, 0])
    result = m3c2(
        reference.index,
        candidate,
        cores,
        np.where(unknown[:, None], [0.0, 0.0, 1.0], normals),
        radius=radius,
        half_length=_CYLINDER_HALF_LENGTH_RADII * radius if settings.depth is None else settings.depth,
    )
    if unknown.any():
        distances, lod = (np.where(unknown, np.nan, values) for values in (result.distances, result.lod))
        result = result._replace(normals=normals, distances=distances, lod=lod)
    result, error = result.shifted(-reference.origin), settings.registration_error
    return result.with_registration_error(_registration_error(result, registration) if error is None else error)


def _registration_error(result: M3C2, registration: Registration) -> float:
    """Return the standard error of the pose along the normals: 0 for a pose that the user gave.

    Control points determine it by their residuals. A pose that was fitted to the clouds is at least as uncertain as the
    distances of its stable area are larger than their own standard errors.

    Args:
        result: map without a registration error, in the reference's coordinates.
        registration: the registration.
    """
    if registration.is_given:
        return 0.0
    errors = [] if registration.residuals else [_stable_error(result)]
    if registration.covariance is not None:
        has_normal = np.isfinite(result.normals[:, 0])
        sigmas = registration.covariance.sigma_along(result.cores[has_normal], result.normals[has_normal])
        sigmas = sigmas[np.isfinite(sigmas)]
        errors.append(float(np.sqrt(np.mean(np.square(sigmas)))) if len(sigmas) else 0.0)
    return max(errors, default=0.0)


def _stable_error(result: M3C2) -> float:
    """Return the standard deviation about zero that the distances of the stable area have beyond their own errors.

    Where nothing changed, a registered candidate lies on the reference. So the stable area is found around zero, as the
    distances within three of their standard deviations. The first guess includes a quarter of the distances, so that
    up to three quarters may have changed.
    """
    sigma = result.sigma
    tested = np.isfinite(sigma) & np.isfinite(result.distances)
    if not tested.any():
        return 0.0
    offsets, variances = np.abs(result.distances[tested]), np.square(sigma[tested])
    deviation = max(float(np.quantile(offsets, 0.25)) / _QUARTER_QUANTILE, float(np.sqrt(np.median(variances))))
    for _ in range(_MAX_CLIPPINGS):
        stable = offsets <= 3 * deviation
        clipped = NORMAL_MAD * float(np.median(offsets[stable]))
        if clipped == deviation:
            break
        deviation = clipped
    return float(np.sqrt(max(deviation**2 - np.median(variances[stable]), 0.0)))


def m3c2_warnings(result: M3C2) -> Iterator[Notice]:
    """Warn if the map is empty because no cylinder holds enough points."""
    if np.isfinite(result.significant).any():
        return
    measured = int(np.count_nonzero(np.isfinite(result.distances)))
    text = (
        f"M3C2 has no result: cylinders of radius {result.radius:.3g} and half length {result.half_length:.3g} contain"
        f" points of both clouds at {measured} of {pluralize(len(result.cores), 'core point')}, and the five points per"
        " cloud that a level of detection needs at none: enlarge them with --m3c2 radius=... and depth=..., and check"
        " that cores are in the reference's coordinates"
    )
    yield Notice("empty-m3c2", text)


def _custom_cores(reference: Reference, given: Cloud) -> tuple[FloatArray, FloatArray]:
    """Return core points inside the region, minus the reference's origin, with their own or the reference's normals."""
    cores = given.points - reference.origin
    inside = np.ones(len(cores), bool) if reference.region is None else reference.region.contains(cores)
    if not inside.any():
        raise InputError(f"M3C2: no core point lies inside the region ({len(cores)} given): check --crop")
    cores = cores[inside]
    if given.normals is None:
        return cores, reference.surface.normals(reference.index.query(cores).indices)
    normals, has_normal = unit(given.normals[inside])
    return cores, np.where(has_normal[:, None], normals, np.nan)


def _fit_normals(reference: Reference, cores: FloatArray, radius: float) -> FloatArray:
    """Fit normals (K, 3) to the reference's points within a radius of each core; NaN for fewer than three points.

    Signs agree with the reference's normal at the nearest point.
    """
    signs = reference.surface.normals(reference.index.query(cores).indices)
    normals = np.full(cores.shape, np.nan)
    for row, core in enumerate(cores):
        near = reference.points[reference.index.query_radius(core[None], radius).indices]
        if len(near) < _MIN_PLANE_POINTS:
            continue
        centred = near - near.mean(axis=0)
        normal = np.linalg.eigh(centred.T @ centred)[1][:, 0]
        normals[row] = normal if normal @ signs[row] >= 0 else -normal
    return normals
