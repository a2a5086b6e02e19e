"""M3C2 of a candidate against the prepared reference: which core points and normals, and which cylinders."""

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
from pcbench.measure.wording import counted
from pcbench.registration import Registration

_MAX_CORES = 50_000  # where none are given: the reference, voxel-downsampled
_CYLINDER_RADIUS = 6  # median spacings of the sparser cloud: about 30 of its points a cylinder
_CYLINDER_REACH = 1  # radii to either side: farther ones meet the other side of a house
_MIN_PLANE = 3  # points that a normal is estimated from


def compare_along_normals(
    reference: Reference, candidate: Index, registration: Registration, settings: M3C2Settings
) -> M3C2 | None:
    """M3C2 of an aligned candidate (minus the reference's origin), in the reference's coordinates.

    None where the reference has too few points for normals. Core points outside the region are left out, and those
    without a normal have no distance.

    Raises:
        InputError: no core point lies in the region.
    """
    if not reference.has_normals:
        return None
    radius = settings.radius
    if radius is None:
        radius = _CYLINDER_RADIUS * max(reference.spacing, Surface(candidate).spacing)
    if settings.cores is None:
        rows = np.flatnonzero(reference.inside)
        rows = rows[voxel_downsample_to(reference.points[rows], _MAX_CORES, start=radius / 2)]
        cores, normals = reference.points[rows], reference.surface.normals(rows)
    else:
        cores, normals = _given(reference, settings.cores)
    if settings.normal_radius is not None:
        normals = _fitted(reference, cores, settings.normal_radius)
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
        half_length=_CYLINDER_REACH * radius if settings.depth is None else settings.depth,
        registration_error=error,
    )
    if unknown.any():
        distances, lod = (np.where(unknown, np.nan, values) for values in (found.distances, found.lod))
        found = found._replace(normals=normals, distances=distances, lod=lod)
    return found.shifted(-reference.origin)


def m3c2_warnings(found: M3C2) -> Iterator[Notice]:
    """Whether there is anything to compare: with cylinders that hold nothing, the map is empty."""
    if np.isfinite(found.significant).any():
        return
    measured = int(np.count_nonzero(np.isfinite(found.distances)))
    text = (
        f"M3C2 says nothing: a cylinder of radius {found.radius:.3g} and depth {found.half_length:.3g} holds points of"
        f" both clouds at {measured} of {counted(len(found.cores), 'core point')}, and five of each, which a level of"
        " detection needs, at none: --m3c2 radius=... and depth=... make it larger, and cores are in the"
        " reference's coordinates"
    )
    yield Notice("empty-m3c2", text)


def _given(reference: Reference, given: Cloud) -> tuple[FloatArray, FloatArray]:
    """Core points inside the region, minus the reference's origin, with their own normals or the reference's."""
    cores = given.points - reference.origin
    inside = np.ones(len(cores), bool) if reference.region is None else reference.region.contains(cores)
    if not inside.any():
        raise InputError(f"M3C2: no core point lies inside the region ({len(cores)} given): check --crop")
    cores = cores[inside]
    if given.normals is None:
        return cores, reference.surface.normals(reference.index.query(cores).indices)
    normals, known = unit(given.normals[inside])
    return cores, np.where(known[:, None], normals, np.nan)


def _fitted(reference: Reference, cores: FloatArray, radius: float) -> FloatArray:
    """Normals (K, 3) of planes through the reference's points within a radius of each core; NaN for less than three.

    Signs agree with the reference's normal at the nearest point.
    """
    signs = reference.surface.normals(reference.index.query(cores).indices)
    normals = np.full(cores.shape, np.nan)
    for row, core in enumerate(cores):
        near = reference.points[reference.index.query_radius(core[None], radius).indices]
        if len(near) < _MIN_PLANE:
            continue
        centred = near - near.mean(axis=0)
        normal = np.linalg.eigh(centred.T @ centred)[1][:, 0]
        normals[row] = normal if normal @ signs[row] >= 0 else -normal
    return normals
