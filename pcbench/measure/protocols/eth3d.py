"""The evaluation of the ETH3D multi-view stereo benchmark against laser scans.

Schoeps et al. 2017 define it, and their program prints it. The reference is a MeshLab project of scans, each in the
coordinates of its scanner.

1. Completeness at a tolerance: the share of scan points whose nearest reconstructed point is within it.
2. Accuracy at a tolerance: the share of observed reconstructed points that are within it of a scan point in whose beam
   they lie. A point is observed if it is accurate for a scan, or lies in the free space of one (see `free_space`).
3. Both shares are averaged over voxels (see `voxel_grids`). F1 is their harmonic mean.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar, NamedTuple

import numpy as np

from pcbench.errors import InputError
from pcbench.geometry.arrays import FloatArray
from pcbench.geometry.mesh import Mesh
from pcbench.geometry.mesh_samples import REFERENCE_SAMPLES, vertex_cloud
from pcbench.geometry.neighbors import Index
from pcbench.geometry.regions import Region
from pcbench.geometry.units import check_same_unit
from pcbench.io.files import errors_named
from pcbench.io.meshes import to_shape
from pcbench.io.meshlab_project import ProjectMesh, read_meshlab_project
from pcbench.measure.protocols.free_space import Beam, BeamObservation, Floats, FreeSpace
from pcbench.measure.protocols.protocol import Evaluation, EvaluationInputs, ProtocolScore, protocol_text
from pcbench.measure.protocols.voxel_grids import Mask, VoxelGrids

_PROJECT = "scan_alignment.mlp"
_FOLDERS = (".", "dslr_scan_eval", "rig_scan_eval")  # where the downloads of the benchmark have it in a scene's folder
_PRECISIONS: dict[str, type[np.floating[Any]]] = {"float32": np.float32, "float64": np.float64}
_MAX_LENGTH = 1e15  # metres; keeps squares within single precision
_MAX_ROTATION_ERROR = 1e-3  # of products of rows: some projects print few digits


@dataclass(frozen=True)
class Eth3d:
    """Settings of the evaluation of ETH3D; lengths in m.

    Attributes:
        tolerances: distances up to which points are accurate and complete, in ascending order.
        voxel_size: length of the edges of the voxels.
        beam_start_radius: radius of a laser beam at the scanner.
        beam_divergence_halfangle_deg: angle between the axis of a beam and its side.
        precision: `float32`, the arithmetic of the official program, which its printed digits depend on, or `float64`.
    """

    name: ClassVar[str] = "eth3d"
    title: ClassVar[str] = "ETH3D"
    citation: ClassVar[str] = (
        "Schoeps et al. 2017, A multi-view stereo benchmark with high-resolution images and multi-camera videos, CVPR"
    )
    version: ClassVar[str] = "ETH3D multi-view-evaluation of 2021-10-26"

    tolerances: tuple[float, ...] = (0.01, 0.02, 0.05, 0.1, 0.2, 0.5)
    voxel_size: float = 0.01
    beam_start_radius: float = 0.001125
    beam_divergence_halfangle_deg: float = 0.011
    precision: str = "float32"

    def __post_init__(self) -> None:
        if not self.tolerances or not all(0 <= value <= _MAX_LENGTH for value in self.tolerances):
            raise InputError(
                f"eth3d: expected tolerances as lengths of at least 0 m, got {'/'.join(map(str, self.tolerances))!r}"
            )
        object.__setattr__(self, "tolerances", tuple(sorted(set(self.tolerances))))
        if not 0 < self.voxel_size < np.inf:
            raise InputError(f"eth3d: expected voxel_size as a length above 0 m, got {self.voxel_size:g}")
        if not 0 <= self.beam_start_radius < np.inf:
            raise InputError(
                f"eth3d: expected beam_start_radius as a length of at least 0 m, got {self.beam_start_radius:g}"
            )
        if not 0 <= self.beam_divergence_halfangle_deg < 90:
            raise InputError(
                "eth3d: expected beam_divergence_halfangle_deg as an angle from 0 to below 90 degrees, got"
                f" {self.beam_divergence_halfangle_deg:g}"
            )
        if self.precision not in _PRECISIONS:
            raise InputError(f"eth3d: expected precision as {' or '.join(_PRECISIONS)}, got {self.precision!r}")

    def evaluate(self, inputs: EvaluationInputs) -> Evaluation:
        """Evaluate a candidate.

        The reference is a `scan_alignment.mlp`, or a folder of a scene that has it. Without one, it is searched in the
        folder of the scene in `data`. A crop selects the points that count; searches use all points.

        Raises:
            InputError: the project or a scan is missing or unusable, or a scan's pose is not rigid.
        """
        kind = _PRECISIONS[self.precision]
        inputs.on_step("reading the scans")
        scans = [_read_scan(mesh, kind) for mesh in read_meshlab_project(_project_file(inputs))]
        inputs.on_step("reading the candidate")
        shape, notes = to_shape(inputs.candidate), list[str]()
        if inputs.pose is None:
            check_same_unit("m", shape.unit)
        if isinstance(shape, Mesh):
            shape = shape.sample(REFERENCE_SAMPLES, inputs.seed)
            notes.append(
                f"the candidate is a mesh: it is evaluated at {len(shape):,} points sampled on its faces by area (seed"
                f" {inputs.seed})"
            )
        moved = shape if inputs.pose is None else shape.transformed(inputs.pose)
        points = _rounded(moved.points, kind)

        inputs.on_step("completeness")
        completeness, scan_points = self._completeness(scans, points, inputs.crop)
        inputs.on_step("accuracy")
        observation = self._observe(scans, points)
        counted = _inside(points, inputs.crop)
        accuracy = self._accuracy(observation, points, counted)
        unseen = ~_within(observation.squared_distances, self.tolerances[-1]) & ~observation.in_free_space

        scores = []
        for tolerance, a, c in zip(self.tolerances, map(kind, accuracy), map(kind, completeness), strict=True):
            f1 = 2 * (a * c) / (a + c) if a + c > 0 else kind(0)  # of the rounded shares, and rounded at each step
            for name, value in (("accuracy", a), ("completeness", c), ("f1", f1)):
                scores.append(ProtocolScore(f"{name}@{tolerance:g}", float(value), better="higher"))
        if not (counted & ~unseen).any():
            notes.append(
                "no scan observes a point of the candidate: it must be in the coordinates of the project, in metres"
            )
        counts = {
            "scans": len(scans),
            "scan_points": scan_points,
            "candidate_points": int(counted.sum()),
            "unobserved_points": int((counted & unseen).sum()),
        }
        return Evaluation(
            protocol_text(self),
            tuple(scores),
            tuple(ProtocolScore(name, value, better=None) for name, value in counts.items()),
            tuple(notes),
        )

    def other_files(self, inputs: EvaluationInputs) -> tuple[Path, ...]:
        """Return the project and its scans."""
        project = _project_file(inputs)
        return (project, *(mesh.file for mesh in read_meshlab_project(project)))

    def _completeness(self, scans: list[_LaserScan], points: Floats, crop: Region | None) -> tuple[list[float], int]:
        """Return the completeness at each tolerance, and the number of scan points that count."""
        merged = np.concatenate([scan.in_project for scan in scans])
        differences = merged - points[Index(points).query(merged).indices]
        x, y, z = np.square(differences.T)
        squared = (x + y) + z  # the order in which the official program adds
        counted, grids = _inside(merged, crop), VoxelGrids(merged, self.voxel_size)
        shares = [grids.mean_share(_within(squared, tolerance), counted) for tolerance in self.tolerances]
        return shares, int(counted.sum())

    def _observe(self, scans: list[_LaserScan], points: Floats) -> BeamObservation:
        """Merge the evidence of all scans. Points that are accurate at each tolerance need no further scan.

        Returns:
            The smallest of the squared distances, and whether a point lies in free space for any scan.
        """
        beam = Beam(self.beam_start_radius, _radians(self.beam_divergence_halfangle_deg, points.dtype.type))
        merged = BeamObservation.nothing(len(points), points.dtype.type)
        for scan in scans:
            open_rows = np.flatnonzero(~_within(merged.squared_distances, self.tolerances[0]))
            with errors_named(scan.name):
                space = FreeSpace(scan.points, beam)
            seen = space.observe(scan.to_scanner(points[open_rows]))
            merged.squared_distances[open_rows] = np.minimum(
                merged.squared_distances[open_rows], seen.squared_distances
            )
            merged.in_free_space[open_rows] |= seen.in_free_space
        return merged

    def _accuracy(self, observation: BeamObservation, points: Floats, counted: Mask) -> list[float]:
        grids, shares = VoxelGrids(points, self.voxel_size), []
        for tolerance in self.tolerances:
            accurate = _within(observation.squared_distances, tolerance)
            shares.append(grids.mean_share(accurate, counted & (accurate | observation.in_free_space)))
        return shares


class _LaserScan(NamedTuple):
    """A scan in the coordinates of its scanner, its rigid pose (4, 4), and the name of its file.

    Points and pose have the precision of the evaluation.
    """

    points: Floats
    pose: Floats
    name: str

    @property
    def in_project(self) -> Floats:
        """The points (N, 3) in the coordinates of the project."""
        x, y, z = self.points.T
        columns = [row[0] * x + (row[1] * y + (row[2] * z + row[3])) for row in self.pose[:3]]
        return np.stack(columns, axis=1)

    def to_scanner(self, points: Floats) -> Floats:
        """Return points (N, 3) of the project in the coordinates of the scanner: R^T p + R^T (-t)."""
        x, y, z = points.T
        shift = -self.pose[:3, 3]
        columns = [
            (axis[0] * x + (axis[1] * y + axis[2] * z))
            + (axis[0] * shift[0] + (axis[1] * shift[1] + axis[2] * shift[2]))
            for axis in self.pose[:3, :3].T
        ]
        return np.stack(columns, axis=1)


def _read_scan(mesh: ProjectMesh, kind: type[np.floating[Any]]) -> _LaserScan:
    points = vertex_cloud(to_shape(mesh.file)).points
    with errors_named(mesh.file.name):
        _check_rigid(mesh.matrix)
        return _LaserScan(_rounded(points, kind), mesh.matrix.astype(kind), mesh.file.name)


def _check_rigid(matrix: FloatArray) -> None:
    rotation = matrix[:3, :3]
    if np.abs(matrix).max() > _MAX_LENGTH:
        raise InputError(f"expected a pose of numbers up to {_MAX_LENGTH:g}, got {np.abs(matrix).max():g}")
    if not np.array_equal(matrix[3], (0, 0, 0, 1)):
        raise InputError(f"expected a pose with the last row 0 0 0 1, got {' '.join(f'{v:g}' for v in matrix[3])}")
    error = np.abs(rotation @ rotation.T - np.eye(3)).max()
    if not error <= _MAX_ROTATION_ERROR or np.linalg.det(rotation) < 0:
        raise InputError(
            "expected a pose without scale, shear or reflection, because beams are in metres: apply these to the scan"
        )


def _project_file(inputs: EvaluationInputs) -> Path:
    reference = inputs.reference
    if isinstance(reference, Path) and not reference.is_dir() and reference.suffix.lower() == ".mlp":
        return reference
    folders = [reference] if isinstance(reference, Path) and reference.is_dir() else []
    if inputs.data is not None:
        folders += [inputs.data / inputs.scene, inputs.data]
    files = [folder / part / _PROJECT for folder in folders for part in _FOLDERS]
    if (file := next((file for file in files if file.is_file()), None)) is not None:
        return file
    name = reference if isinstance(reference, Path) else "a shape in memory"
    places = ", ".join(map(str, dict.fromkeys(folders)))
    raise InputError(
        f"eth3d: expected the reference as a {_PROJECT}, which has the positions of the scanners, got {name}"
        + (f"; there is none in {places}" if places else "")
    )


def _rounded(points: FloatArray, kind: type[np.floating[Any]]) -> Floats:
    if (largest := np.abs(points).max()) > _MAX_LENGTH:
        raise InputError(f"eth3d: expected coordinates up to {_MAX_LENGTH:g} m, got {largest:g}: remove such points")
    return points.astype(kind)


def _inside(points: Floats, crop: Region | None) -> Mask:
    return np.ones(len(points), np.bool_) if crop is None else crop.contains(points.astype(np.float64))


def _within(squared_distances: Floats, tolerance: float) -> Mask:
    kind = squared_distances.dtype.type
    within: Mask = squared_distances <= kind(tolerance) * kind(tolerance)
    return within


def _radians(degrees: float, kind: type[np.floating[Any]]) -> float:
    return float(kind(np.pi / 180) * kind(degrees))
