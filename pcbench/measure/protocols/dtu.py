"""The evaluation of the DTU multi-view stereo data set: accuracy and completeness in millimetres.

Jensen et al. 2014 define it. Two programs are in use. The Python one prints the numbers of most papers on neural
surfaces and on splats, the MATLAB one those of papers on multi-view stereo. Both

1. thin the candidate to points at least 0.2 mm apart, in random order (a mesh is sampled first, see `mesh_grid`),
2. keep the candidate's points in the observation mask, and the reference's points above the ground plane,
3. average the distances to the other cloud that are below 20 mm; the others do not count.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar, NamedTuple

import numpy as np
from numpy.typing import NDArray

from pcbench.errors import InputError
from pcbench.geometry.arrays import FloatArray
from pcbench.geometry.cloud import Cloud
from pcbench.geometry.mesh import Mesh
from pcbench.geometry.mesh_samples import vertex_cloud
from pcbench.geometry.neighbors import Index
from pcbench.geometry.thinning import thin_by_disks
from pcbench.geometry.units import check_same_unit
from pcbench.io.meshes import to_shape
from pcbench.measure.protocols.dtu_data import (
    ObservationMask,
    mask_file,
    plane_file,
    read_mask,
    read_plane,
    reference_file,
    scan_number,
)
from pcbench.measure.protocols.mesh_grid import grid_points
from pcbench.measure.protocols.protocol import Evaluation, EvaluationInputs, ProtocolScore, Shape, protocol_text

_UNIT = "mm"
_VARIANTS = ("python", "matlab")


@dataclass(frozen=True)
class Dtu:
    """Settings of the evaluation of DTU; lengths in mm.

    Attributes:
        variant: `python`: the program that papers on surfaces use. Distances from the reference are to the candidate's
            points in the scan's box, extended by `patch` below and twice as much above; all reference points above the
            plane count. `matlab`: the original program. Distances are to all points of the candidate, but only points
            in the blocks of side `patch` that cover the box count.
        thinning: smallest distance between points of the thinned candidate.
        patch: margin of the box, or side of the blocks, see `variant`.
        max_distance: distances from this one on are excluded.
        orders: number of random orders of the thinning. With several, scores are means over them, and the counts have
            their standard deviations.
    """

    name: ClassVar[str] = "dtu"
    title: ClassVar[str] = "DTU"
    citation: ClassVar[str] = "Jensen et al. 2014, Large scale multi-view stereopsis evaluation, CVPR"
    version: ClassVar[str] = "DTUeval-python of 2021, and the MATLAB code of the data set (variant=matlab)"

    variant: str = "python"
    thinning: float = 0.2
    patch: float = 60.0
    max_distance: float = 20.0
    orders: int = 1

    def __post_init__(self) -> None:
        if self.variant not in _VARIANTS:
            raise InputError(f"dtu: expected variant as one of {', '.join(_VARIANTS)}; got {self.variant!r}")
        for name in ("thinning", "patch", "max_distance"):
            if not 0 < getattr(self, name) < np.inf:
                raise InputError(f"dtu: expected {name} as a length above 0 mm, got {getattr(self, name):g}")
        if self.orders < 1:
            raise InputError(f"dtu: expected at least one order, got {self.orders}")
        if self.variant == "matlab" and self.max_distance > self.patch:
            raise InputError(
                f"dtu: with variant=matlab, distances are searched up to patch ({self.patch:g} mm): expected a"
                f" max_distance of at most that, got {self.max_distance:g}"
            )

    def evaluate(self, inputs: EvaluationInputs) -> Evaluation:
        """Evaluate a candidate.

        The number of the scan comes from the scene's name, or from the names of the files. The reference may be the
        file of the data set, another cloud, or the folder of the data set, which then also has the mask and the plane.

        Raises:
            InputError: a file is missing or unusable; or a crop is given, which the mask replaces.
        """
        if inputs.crop is not None:
            raise InputError("dtu: expected no crop, because the observation mask and the ground plane select points")
        inputs.on_step("reading the scan")
        scan = _read_scan(inputs)
        inputs.on_step("reading the candidate")
        candidate = to_shape(inputs.candidate)
        if inputs.pose is None:
            check_same_unit("mm", candidate.unit)
        else:
            candidate = candidate.transformed(inputs.pose)
        points = grid_points(candidate, self.thinning) if isinstance(candidate, Mesh) else candidate.points
        runs = []
        for order in range(self.orders):
            inputs.on_step("thinning the candidate" + (f", order {order + 1}" if self.orders > 1 else ""))
            thinned = points[thin_by_disks(points, self.thinning, inputs.seed + order)]
            inputs.on_step("measuring distances")
            runs.append(self._measure(thinned, scan))
        return self._evaluation(runs, candidate, points, inputs.seed)

    def other_files(self, inputs: EvaluationInputs) -> tuple[Path, ...]:
        """Return the mask, the plane, and the reference if it is named by the folder of the data set."""
        files = _scan_files(inputs)
        reference = (files.reference,) if isinstance(files.reference, Path) else ()
        return (files.mask, files.plane, *reference)

    def _measure(self, thinned: FloatArray, scan: _ObservedScan) -> _Run:
        """Measure the distances between the thinned candidate and the reference's points above the plane."""
        above = scan.reference.points[_above(scan.plane, scan.reference.points)]
        targets = thinned
        if self.variant == "python":
            targets = thinned[self._in_extended_box(thinned, scan.mask.box)]
            observed = targets[_observed(scan.mask, targets, scan.mask.box[0].astype(np.float32), halves_up=False)]
        else:
            observed = thinned[_observed(scan.mask, thinned, scan.mask.box[0], halves_up=True)]
            observed, above = (rows[self._in_blocks(rows, scan.mask.box)] for rows in (observed, above))
        return _Run(
            len(thinned),
            len(observed),
            len(above),
            *self._mean_distance(observed, scan.reference),
            *self._mean_distance(above, Index(targets) if len(targets) else None),
        )

    def _in_extended_box(self, points: FloatArray, box: FloatArray) -> NDArray[np.bool_]:
        # The program has the box, and with it the extended one, in single precision.
        low, high = box.astype(np.float32)
        low, high = low - np.float32(self.patch), high + np.float32(2 * self.patch)
        inside: NDArray[np.bool_] = ((points >= low) & (points < high)).all(axis=1)
        return inside

    def _in_blocks(self, points: FloatArray, box: FloatArray) -> NDArray[np.bool_]:
        blocks = np.floor((box[1] - box[0]) / self.patch) + 1
        inside: NDArray[np.bool_] = ((points >= box[0]) & (points < box[0] + blocks * self.patch)).all(axis=1)
        return inside

    def _mean_distance(self, queries: FloatArray, targets: Index | None) -> tuple[float | None, int]:
        """Return the mean of the distances that count, None if there are none, and the number of the others."""
        if targets is None or not len(queries):
            return None, 0
        distances = targets.query_index(Index(queries)).distances
        counting = distances < self.max_distance
        mean = float(distances[counting].mean()) if counting.any() else None
        return mean, int(np.count_nonzero(~counting))

    def _evaluation(self, runs: list[_Run], candidate: Cloud | Mesh, points: FloatArray, seed: int) -> Evaluation:
        means = {name: _mean([getattr(run, name) for run in runs]) for name in _Run._fields}
        overall = [run.overall for run in runs]
        scores = {"accuracy": means["accuracy"], "completeness": means["completeness"], "overall": _mean(overall)}
        counts = [ProtocolScore("candidate_points", len(points), better=None)] if isinstance(candidate, Mesh) else []
        counts += [
            ProtocolScore(name, means[name], better=None)
            for name in ("points_thinned", "points_in_mask", "reference_above_plane", "accuracy_excluded",
                         "completeness_excluded")
        ]  # fmt: skip
        if self.orders > 1:
            for name in ("accuracy", "completeness", "overall"):
                spread = _deviation([getattr(run, name) for run in runs])
                counts.append(ProtocolScore(f"{name}_sd", spread, _UNIT, better=None))
        return Evaluation(
            protocol_text(self),
            tuple(ProtocolScore(name, value, _UNIT) for name, value in scores.items()),
            tuple(counts),
            tuple(self._notes(runs, candidate, points, seed)),
        )

    def _notes(self, runs: list[_Run], candidate: Cloud | Mesh, points: FloatArray, seed: int) -> list[str]:
        notes = []
        if isinstance(candidate, Mesh):
            notes.append(
                f"the candidate is a mesh: {len(points):,} points of a grid on its faces, {self.thinning:g} mm apart,"
                f" with its {len(vertex_cloud(candidate)):,} vertices"
            )
        if self.orders > 1:
            notes.append(f"means over {self.orders} random orders of the thinning (seeds {seed} to "
                         f"{seed + self.orders - 1}), with their standard deviations")  # fmt: skip
        else:
            notes.append(f"the thinning has a random order (seed {seed}); orders=6 gives the spread of the scores")
        run = runs[0]
        if not run.points_in_mask:
            notes.append(
                "no point of the candidate is in the observation mask: it must be in the coordinates of the scan, in mm"
            )
        for name, excluded, count in (
            ("accuracy", run.accuracy_excluded, run.points_in_mask),
            ("completeness", run.completeness_excluded, run.reference_above_plane),
        ):
            if excluded and count:
                notes.append(
                    f"{name} excludes {excluded:,} of its {count:,} distances, because they are at least"
                    f" {self.max_distance:g} mm"
                )
        return notes


class _ScanFiles(NamedTuple):
    """Files of one scan; the reference may be a shape in memory."""

    reference: Shape
    mask: Path
    plane: Path


class _ObservedScan(NamedTuple):
    """Contents of the data set for one scan."""

    mask: ObservationMask
    plane: FloatArray  # (4,)
    reference: Index


class _Run(NamedTuple):
    """The numbers of one random order of the thinning; distances in mm, None if there are none."""

    points_thinned: int
    points_in_mask: int
    reference_above_plane: int
    accuracy: float | None
    accuracy_excluded: int
    completeness: float | None
    completeness_excluded: int

    @property
    def overall(self) -> float | None:
        """Half the sum of accuracy and completeness."""
        if self.accuracy is None or self.completeness is None:
            return None
        return (self.accuracy + self.completeness) / 2


def _read_scan(inputs: EvaluationInputs) -> _ObservedScan:
    files = _scan_files(inputs)
    cloud = vertex_cloud(to_shape(files.reference))
    return _ObservedScan(read_mask(files.mask), read_plane(files.plane), Index(cloud.points))


def _scan_files(inputs: EvaluationInputs) -> _ScanFiles:
    reference, candidate = inputs.reference, inputs.candidate
    names = [inputs.scene, *(path.stem for path in (reference, candidate) if isinstance(path, Path))]
    scan, folders = scan_number(*names), [] if inputs.data is None else [inputs.data]
    if isinstance(reference, Path):  # the file's place in the data set, or the folder of the data set
        folders += [reference] if reference.is_dir() else [reference.parent, *reference.parent.parents[:2]]
        if reference.is_dir():
            reference = reference_file(folders, scan)
    return _ScanFiles(reference, mask_file(folders, scan), plane_file(folders, scan))


def _above(plane: FloatArray, points: FloatArray) -> NDArray[np.bool_]:
    above: NDArray[np.bool_] = points @ plane[:3] + plane[3] > 0
    return above


def _observed(
    mask: ObservationMask, points: FloatArray, origin: NDArray[np.floating], *, halves_up: bool
) -> NDArray[np.bool_]:
    """Return which points are in observed voxels; halves of a voxel's side are rounded up (MATLAB) or to even numbers.

    Args:
        mask: the mask.
        points: (N, 3) points.
        origin: (3,) centre of the first voxel, in the precision of the program.
        halves_up: how halves are rounded.
    """
    cells = (points - origin) / mask.side
    cells = np.floor(cells + 0.5) if halves_up else np.around(cells)
    # Points far outside would overflow as integers.
    return mask.contains(np.clip(cells, -1, max(mask.voxels.shape)).astype(np.int64))


def _mean(values: list[float | None] | list[float] | list[int]) -> float | None:
    numbers = [value for value in values if value is not None]
    return float(np.mean(numbers)) if len(numbers) == len(values) else None


def _deviation(values: list[float | None]) -> float | None:
    numbers = [value for value in values if value is not None]
    return float(np.std(numbers, ddof=1)) if len(numbers) == len(values) else None
