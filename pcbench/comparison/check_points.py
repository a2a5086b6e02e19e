"""The accuracy of compared clouds by check points: of the reference, and of each candidate as given and as aligned."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from pcbench.comparison.request import Input, Request
from pcbench.comparison.result import Comparison
from pcbench.geometry.mesh import Mesh
from pcbench.geometry.mesh_samples import vertex_cloud
from pcbench.geometry.transform import Similarity
from pcbench.io.check_points import CheckPoints, read_check_points
from pcbench.io.source import Source
from pcbench.measure.checkpoints import CheckPointSettings, CloudAccuracy, PlanNeighbors, assess
from pcbench.measure.checkpoints.accuracy import CandidateAccuracy
from pcbench.measure.checkpoints.reading import read_around


def with_check_points(request: Request, comparison: Comparison, step: Callable[[str], None]) -> Comparison:
    """Return a comparison with the accuracy of its clouds by the check points that the settings name, if they do.

    Each cloud from files is read once more, piece by piece, so that this needs no memory beside a comparison in tiles.

    Raises:
        InputError: the file of check points is not usable, or a cloud has heights in another unit than x and y.
    """
    if request.settings.checkpoints is None:
        return comparison
    check_points = read_check_points(Path(request.settings.checkpoints))
    step("testing by check points")
    unit = comparison.reference.unit
    skip_bad = request.tiles is not None and request.tiles.settings.skip_bad
    (reference,) = _accuracies(request.reference, [None], check_points, unit, skip_bad=skip_bad)
    candidates = []
    for candidate in comparison:
        pose = candidate.registration.T_reference_candidate
        poses = [None] if np.array_equal(pose.matrix, np.eye(4)) else [None, pose]
        given = request.candidates[candidate.name]
        as_given, *aligned = _accuracies(given, poses, check_points, unit, skip_bad=skip_bad)
        accuracy = CandidateAccuracy(as_given, aligned[0] if aligned else None)
        candidates.append(replace(candidate, check_points=accuracy))
    summary = replace(comparison.reference, check_points=reference)
    return replace(comparison, reference=summary, candidates=tuple(candidates))


def _accuracies(
    given: Input, poses: Sequence[Similarity | None], check_points: CheckPoints, unit: str | None, *, skip_bad: bool
) -> list[CloudAccuracy]:
    """Return the accuracy of a cloud for each pose; of a mesh, that of its vertices."""
    positions = check_points.points[:, :2]
    if isinstance(given, Source) and not given.is_mesh_only:
        neighbors: Sequence[PlanNeighbors] = read_around(given, positions, poses, skip_bad=skip_bad).neighbors
    else:
        shape = given.read_mesh(lambda _: None) if isinstance(given, Source) else given
        points = (vertex_cloud(shape) if isinstance(shape, Mesh) else shape).points
        neighbors = [PlanNeighbors(positions) for _ in poses]
        for pose, nearest in zip(poses, neighbors, strict=True):
            nearest.add(points if pose is None else pose.apply(points))
    settings = CheckPointSettings()
    return [assess(check_points, nearest, settings, unit) for nearest in neighbors]
