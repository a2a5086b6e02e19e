"""Points that represent a mesh in a comparison: as the reference, and as a candidate beside a reference."""

from __future__ import annotations

import math

from pcbench.errors import Notice
from pcbench.geometry.cloud import Cloud
from pcbench.geometry.mesh import Mesh

SAMPLED_MESH = "sampled-mesh"
"""Code of the notice that a candidate is a mesh, measured at points sampled on its surface."""
REFERENCE_SAMPLES = 1_000_000
MAX_SAMPLES = 100_000_000
"""Largest number of samples that a user may ask for."""
# Beside a random reference cloud, ten samples per point give the reference's points a distance below their own spacing
# in 99.9 % of cases.
_SAMPLES_PER_POINT, _MIN_DEFAULT_SAMPLES, _MAX_DEFAULT_SAMPLES = 10, 100_000, 5_000_000
_MAX_SPACING_SHARE = 0.5  # of the reference's spacing; wider samples dominate the distances from the reference


def sample_reference(shape: Cloud | Mesh, seed: int = 0, count: int | None = None) -> Cloud:
    """Return a cloud unchanged, or points sampled on a mesh uniformly by area: `count`, or a million."""
    return shape.sample(REFERENCE_SAMPLES if count is None else count, seed) if isinstance(shape, Mesh) else shape


def sample_candidate(
    candidate: Cloud | Mesh, reference: Cloud | Mesh, seed: int = 0, count: int | None = None
) -> Cloud:
    """Return a cloud unchanged, or `count` points sampled on a mesh uniformly by area.

    If no count is given, there are ten per point of a reference cloud, between 100,000 and 5 million; beside a mesh a
    million.
    """
    if not isinstance(candidate, Mesh):
        return candidate
    if count is None:
        count = REFERENCE_SAMPLES
        if not isinstance(reference, Mesh):
            count = min(max(_SAMPLES_PER_POINT * len(reference), _MIN_DEFAULT_SAMPLES), _MAX_DEFAULT_SAMPLES)
    return candidate.sample(count, seed)


def vertex_cloud(shape: Cloud | Mesh) -> Cloud:
    """Return a cloud unchanged, or the vertices of a mesh."""
    return Cloud(shape.vertices, crs=shape.crs, unit=shape.unit) if isinstance(shape, Mesh) else shape


def sampling_notice(mesh: Mesh, count: int, seed: int, *, scale: float, spacing: float | None = None) -> Notice:
    """Return the notice that a candidate mesh is measured at samples, and whether these are too far apart.

    Args:
        mesh: the candidate.
        count: number of samples.
        seed: their random seed.
        scale: scale from the candidate to the reference.
        spacing: spacing of the reference's points; None: the reference is sampled too.
    """
    text = f"the candidate is a mesh: it is measured at {count:,} points sampled on its faces by area (seed {seed})"
    # The median distance of random points to the nearest one.
    sample_spacing = scale * math.sqrt(math.log(2) * mesh.area / (math.pi * count))
    if spacing is not None and sample_spacing > _MAX_SPACING_SHARE * spacing:
        text += (
            f"; they are {sample_spacing:.2g} apart, and the reference's points {spacing:.2g}, so that their spacing"
            " adds to distances from the reference: compare more samples (pcbench compare --sample N, or pcbench"
            " convert MESH SAMPLES.ply --sample N)"
        )
    return Notice(SAMPLED_MESH, text)
