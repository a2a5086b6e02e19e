"""M3C2 of a candidate against the prepared reference: choice of core points, normals and cylinders."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from pcbench.errors import InputError, Notice
from pcbench.geometry.arrays import FloatArray
from pcbench.geometry.cloud import Cloud
from pcbench.geometry.neighbors import Index
from pcbench.geometry.normals import Surface, unit
from pcbench.geometry.voxels import voxel_downsample_to
from pcbench.measure.deviation import M3C2, m3c2
from pcbench.measure.m3c2_settings import M3C2Settings
from pcbench.measure.reference import Reference
from pcbench.measure.wording import pluralize
from pcbench.registration import Registration

_MAX_CORES = 50_000  # default core points: the reference, voxel-downsampled
_CYLINDER_RADIUS_SPACINGS = 6  # in median spacings of the sparser cloud: about 30 of its points per cylinder
_CYLINDER_HALF_LENGTH_RADII = 1  # half length in radii: longer cylinders reach the opposite wall of a house
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
    error = settings.registration_error
    if error is None:
        error = registration.rmse if registration.weakest_sigma is None else registration.weakest_sigma
    unknown = np.isnan(normals[:, 0])
    found = m3c2(
        reference.index,
        candidate,
        cores,
        np.where(unknown[:, None], [0.0, 0.0, 1.0], normals),
        radius=radius,
        half_length=_CYLINDER_HALF_LENGTH_RADII * radius if settings.depth is None else settings.depth,
        registration_error=error,
    )
    if unknown.any():
        distances, lod = (np.where(unknown, np.nan, values) for values in (found.distances, found.lod))
        found = found._replace(normals=normals, distances=distances, lod=lod)
    return found.shifted(-reference.origin)


def m3c2_warnings(found: M3C2) -> Iterator[Notice]:
    """Warn if the map is empty because no cylinder holds enough points."""
    if np.isfinite(found.significant).any():
        return
    measured = int(np.count_nonzero(np.isfinite(found.distances)))
    text = (
        f"M3C2 has no result: cylinders of radius {found.radius:.3g} and half length {found.half_length:.3g} contain"
        f" points of both clouds at {measured} of {pluralize(len(found.cores), 'core point')}, and the five points per"
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
    normals, known = unit(given.normals[inside])
    return cores, np.where(known[:, None], normals, np.nan)


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
