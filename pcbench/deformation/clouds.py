"""From two clouds to a `Deformation`: register, crop, and test the residuals."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import ArrayLike

from pcbench.deformation.residual import residual_deformation
from pcbench.deformation.result import Deformation
from pcbench.deformation.sides import Side
from pcbench.deformation.stable import separate_changes
from pcbench.errors import InputError
from pcbench.geometry.crop import points_inside
from pcbench.geometry.mesh import Mesh
from pcbench.geometry.mesh_samples import sample_candidate, sample_reference, sampling_notice
from pcbench.geometry.neighbors import Index
from pcbench.geometry.normals import Surface
from pcbench.geometry.region_text import as_region
from pcbench.geometry.regions import Region
from pcbench.geometry.transform import Similarity
from pcbench.io import CloudLike
from pcbench.io.meshes import to_shape
from pcbench.registration import Method, Registration, Target, local_origin, register


def deform(
    reference: Mesh | CloudLike,
    candidate: Mesh | CloudLike,
    method: Method | Similarity | ArrayLike | str = "icp",
    crop: Region | str = "none",
    seed: int = 0,
) -> tuple[Registration, Deformation]:
    """Register a candidate and test whether a deformation remains, how large it is and where.

    Parts that changed are told apart from a deformation of the whole, and left out of the test.

    Without a unit or a coordinate system the scale is unknown, and a difference in scale is not a deformation.

    Args:
        reference: a cloud, an (N, 3) array, a mesh, which is sampled by area, or the path of a file.
        candidate: the same.
        method: registration method, or the pose itself, as for `pcbench.register`.
        crop: region to assess, in the reference's coordinates, or its text, see
            `pcbench.geometry.region_text.parse_region`. Closest points are still searched outside.
        seed: random seed for the folds of the cross-validation, an integer >= 0.

    Raises:
        InputError: a cloud, the seed or the region is not usable, or the region holds no points of either cloud.
        RegistrationError: the clouds do not overlap.
    """
    if not isinstance(seed, int | np.integer) or isinstance(seed, bool) or seed < 0:
        raise InputError(f"expected the seed as a whole number >= 0, got {type(seed).__name__}")
    reference_shape, candidate_shape = to_shape(reference), to_shape(candidate)
    reference = sample_reference(reference_shape, seed)
    candidate = sample_candidate(candidate_shape, reference_shape, seed)
    origin = local_origin(reference)
    target = Target.of(reference, origin, is_sampled=isinstance(reference_shape, Mesh))
    registration = register(reference, candidate, method, target=target)
    if isinstance(candidate_shape, Mesh):
        scale, spacing = registration.T_local.scale, None if target.is_sampled else target.surface.spacing
        notice = sampling_notice(candidate_shape, len(candidate), seed, scale=scale, spacing=spacing)
        registration = replace(registration, warnings=(notice, *registration.warnings))
    aligned = Surface(Index(registration.T_local.apply(candidate.points - origin)), is_even=False)
    region = as_region(crop, reference)
    region = None if region is None else region.shifted(origin)
    sides = []
    for name, points, cloud in (("reference", target.surface, reference), ("candidate", aligned, candidate)):
        sides.append(Side(points, points_inside(points.points, region, crop, f"the {name}'s", origin), cloud))
    ours, theirs = sides
    changes = separate_changes(ours, theirs).of_points(target.surface.points, aligned.points)
    ours, theirs = ours.without(changes.of_reference), theirs.without(changes.of_candidate)
    deformation = residual_deformation(ours, theirs, registration, origin, seed=seed)
    return registration, replace(deformation, changes=changes.shifted(origin).found)
