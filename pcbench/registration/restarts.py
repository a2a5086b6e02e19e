"""Restarts of ICP around a pose: whether registrations that start nearby return to it.

The basin of convergence around the right pose is wide. At a wrong pose, which is a local optimum at best, most starts
that are displaced by several point spacings lead elsewhere. This holds for clouds whose noise or blur hides the
contrast of a pose, such as those of multi-view stereo.
"""

from __future__ import annotations

import numpy as np

from pcbench.errors import RegistrationError
from pcbench.geometry.arrays import FloatArray
from pcbench.geometry.transform import Similarity, rotation_from_vector
from pcbench.registration.icp_settings import IcpSettings
from pcbench.registration.icp_stages import refine
from pcbench.registration.target import Target

MIN_RETURNED_SHARE = 2 / 3  # share of the restarts that return to a right pose
_RESTARTS = 6
_SAMPLE_SIZE = 5_000  # candidate points of a restart
_DISPLACEMENT = 12.0  # of a start, in units of the tolerance
_MAX_EXTENT_SHARE = 0.1  # of the extent: the displacement's upper limit


def returned_share(
    target: Target,
    points: FloatArray,
    T: Similarity,
    *,
    tolerance: float,
    with_scale: bool,
    required: float = MIN_RETURNED_SHARE,
) -> float:
    """Return the share of ICP runs that return to a pose from starts displaced at random; about 1 at the right pose.

    Half of each displacement is a translation and half a rotation. The runs end early when their result is certain.

    Args:
        target: reference.
        points: (N, 3) random sample of the candidate, minus the reference's local origin.
        T: pose between local coordinates.
        tolerance: RMS distance to the pose at which a run has returned, in the reference's unit.
        with_scale: whether the runs solve for the scale.
        required: smallest share at a right pose; the runs end once it is reached or out of reach.
    """
    settings = IcpSettings(with_scale=with_scale, max_sample=_SAMPLE_SIZE)
    moved = T.apply(points)
    center = moved.mean(axis=0)
    radius = float(np.sqrt(np.square(moved - center).sum(axis=1).mean())) or 1.0
    distance = min(_DISPLACEMENT * tolerance, _MAX_EXTENT_SHARE * target.extent) / np.sqrt(2)
    rng = np.random.default_rng(0)
    returned = failed = 0
    enough = int(np.ceil(required * _RESTARTS))
    while returned < enough and failed <= _RESTARTS - enough:
        shift, axis = rng.normal(size=(2, 3))
        rotation = rotation_from_vector(distance / radius * axis / np.linalg.norm(axis))
        start = Similarity(rotation, center - rotation @ center + distance * shift / np.linalg.norm(shift))
        try:
            refined = refine(target, moved, settings, start)
        except RegistrationError:
            failed += 1
            continue
        offsets = refined.apply(moved) - moved
        is_back = float(np.sqrt(np.square(offsets).sum(axis=1).mean())) <= tolerance
        returned, failed = returned + is_back, failed + (not is_back)
    return returned / (returned + failed)
