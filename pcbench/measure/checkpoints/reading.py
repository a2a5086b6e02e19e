"""Read the points of a cloud around check points, piece by piece, in memory that does not depend on the cloud."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from pcbench.errors import InputError
from pcbench.geometry.arrays import FloatArray
from pcbench.geometry.cloud import Cloud
from pcbench.geometry.crs import axis_units, check_heights, check_lengths, is_in_degrees
from pcbench.geometry.transform import Similarity
from pcbench.io.pieces.reading import read_piece, reading_warnings
from pcbench.io.source import Source
from pcbench.measure.checkpoints.neighbors import PlanNeighbors

_SAMPLE_POINTS = 200_000  # for the map
_GROUND = 2  # class in LAS files


@dataclass(frozen=True, eq=False)
class CloudAround:
    """The points of a cloud around check points.

    Attributes:
        neighbors: the nearest points in plan view, one for each pose.
        sample: (N, 3) even sample of all points as given.
        count: number of points.
        crs: coordinate system, if known.
        unit: unit of the coordinates, if known.
        mixes_ground: whether points that are classified as ground lie beside others.
        warnings: warnings of the reader.
    """

    neighbors: tuple[PlanNeighbors, ...]
    sample: FloatArray
    count: int
    crs: str | None
    unit: str | None
    mixes_ground: bool
    warnings: tuple[str, ...]


def read_around(
    source: Source,
    positions: FloatArray,
    poses: Sequence[Similarity | None] = (None,),
    step: Callable[[str], None] = lambda _: None,
    *,
    skip_bad: bool = False,
) -> CloudAround:
    """Read a cloud once, and keep the points around check points for each pose.

    Args:
        source: the cloud; of a mesh, the vertices are read.
        positions: (M, 2) x and y of the check points.
        poses: transforms of the cloud to the coordinates of the check points; None: as given.
        step: called with a short text before each piece.
        skip_bad: whether damaged and missing files are left out.

    Raises:
        InputError: the cloud cannot be read, or its coordinates are degrees, geocentric or in mixed units.
    """
    if source.is_mesh_only:
        raise InputError(
            f"{source.path}: expected a cloud, got a mesh: sample it with pcbench convert {source.path} OUT --sample N"
        )
    disk = source.pieces(skip_bad=skip_bad)
    check_heights(disk.crs, str(source.path))
    _check_units(disk.crs, disk.unit, str(source.path))
    neighbors, every = tuple(PlanNeighbors(positions) for _ in poses), max(1, disk.count // _SAMPLE_POINTS)
    sample, notes, ground, others = [], [], 0, 0
    for piece in disk.pieces:
        step(f"reading {piece.file}{f', {piece.label}' if piece.label else ''}")
        read = read_piece(disk, piece)
        if is_in_degrees(disk.crs, disk.unit) and len(read.points):
            check_lengths(Cloud(read.points, crs=disk.crs, unit=disk.unit), str(source.path))
        for pose, nearest in zip(poses, neighbors, strict=True):
            nearest.add(read.points if pose is None else pose.apply(read.points))
        sample.append(read.points[::every].copy())  # a view would keep the piece in memory
        notes.append((piece, read.notes))
        if read.classification is not None:
            is_ground = int((read.classification == _GROUND).sum())
            ground, others = ground + is_ground, others + len(read.points) - is_ground
    count = neighbors[0].total
    if not count:
        raise InputError(f"{source.path}: expected at least one point, got none: check --classes and --returns")
    warnings = (*disk.warnings, *reading_warnings(disk, notes))
    points = np.concatenate(sample)
    return CloudAround(neighbors, points, count, disk.crs, disk.unit, min(ground, others) > 0, warnings)


def _check_units(crs: str | None, unit: str | None, name: str) -> None:
    """Check that heights have the unit of x and y.

    Raises:
        InputError: they have another. The message names a command that converts the cloud.
    """
    units = axis_units(crs)
    if unit is None and units is not None and units.are_mixed:
        raise InputError(
            f"{name}: expected one unit of x, y and z, got {units.horizontal} and {units.height}: convert the cloud"
            f" with pcbench convert {name} OUT --to-unit {units.horizontal}, and the heights of the check points"
            " likewise"
        )
