"""The evaluation of reconstructed meshes of rooms, as papers on Replica and ScanNet do it.

NICE-SLAM (Zhu et al. 2022) samples each mesh by area and prints accuracy, completion and completion ratio. MonoSDF
(Yu et al. 2022) adds precision, F-score and normal consistency. For ScanNet, MonoSDF and others compare the vertices,
downsampled to the mean point of each voxel (variant=scannet).
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar, NamedTuple

import numpy as np

from pcbench.errors import InputError
from pcbench.geometry.cloud import Cloud
from pcbench.geometry.crop import points_inside
from pcbench.geometry.mesh import Mesh
from pcbench.geometry.mesh_samples import MAX_SAMPLES, vertex_cloud
from pcbench.geometry.neighbors import Index, match_both_directions
from pcbench.geometry.region_text import as_region
from pcbench.geometry.regions import Region
from pcbench.geometry.units import metres
from pcbench.geometry.voxels import cell_means
from pcbench.io.meshes import to_shape
from pcbench.measure.metrics import harmonic_mean
from pcbench.measure.protocols.culling import camera_file, cull, read_cameras
from pcbench.measure.protocols.protocol import Evaluation, EvaluationInputs, ProtocolScore, protocol_text

_UNIT = "cm"
_VARIANTS = ("replica", "scannet")


@dataclass(frozen=True)
class IndoorMeshes:
    """Settings of the evaluation of meshes of rooms.

    Attributes:
        variant: `replica`: points are sampled on each mesh uniformly by area. `scannet`: the vertices are downsampled
            to the mean point of each voxel, which has no normal.
        samples: number of points sampled on each mesh (`replica`).
        voxel_cm: side of the voxels in centimetres (`scannet`).
        threshold_cm: threshold of completion ratio, precision and F-score in centimetres; a point at that distance
            does not count as near.
        unit: unit of the coordinates.
        cameras: COLMAP model or transforms.json to whose frames both meshes are culled, in the coordinates of the
            reference; a relative path starts at the folder of the benchmark's data, and `{scene}` stands for the name
            of the scene. Empty: the complete meshes are compared.
        occlusion: whether culling also removes what the mesh itself hides from all cameras.
        tolerance_cm: distance in centimetres within which a face in front of a vertex does not hide it.
    """

    name: ClassVar[str] = "mesh"
    title: ClassVar[str] = "Meshes of rooms (Replica, ScanNet)"
    citation: ClassVar[str] = (
        "Zhu et al. 2022, NICE-SLAM, CVPR; Yu et al. 2022, MonoSDF, NeurIPS (normals, and variant=scannet)"
    )
    version: ClassVar[str] = "eval_recon.py of NICE-SLAM and of MonoSDF, 2022; variant=scannet: evaluate.py of MonoSDF"

    variant: str = "replica"
    samples: int = 200_000
    voxel_cm: float = 2.0
    threshold_cm: float = 5.0
    unit: str = "m"
    cameras: str = ""
    occlusion: bool = False
    tolerance_cm: float = 3.0

    def __post_init__(self) -> None:
        if self.variant not in _VARIANTS:
            raise InputError(f"mesh: expected variant as one of {', '.join(_VARIANTS)}; got {self.variant!r}")
        if not 1 <= self.samples <= MAX_SAMPLES:
            raise InputError(f"mesh: expected 1 to {MAX_SAMPLES:,} samples, got {self.samples:,}")
        if metres(self.unit) is None:
            raise InputError(f"mesh: expected unit as a unit of length such as m, cm or ft; got {self.unit!r}")
        for name in ("voxel_cm", "threshold_cm", "tolerance_cm"):
            if not 0 < getattr(self, name) < np.inf:
                raise InputError(f"mesh: expected {name} as a length above 0 cm, got {getattr(self, name):g}")

    def evaluate(self, inputs: EvaluationInputs) -> Evaluation:
        """Evaluate a candidate: a mesh, or a cloud whose points are used as they are.

        Raises:
            InputError: a file is missing or unusable; a cloud cannot be culled; the cameras or the crop leave nothing;
                or a file states another unit.
        """
        inputs.on_step("reading the meshes")
        reference, candidate = to_shape(inputs.reference), to_shape(inputs.candidate)
        for shape in (reference, candidate):
            self._check_unit(shape)
        if inputs.pose is not None:
            candidate = candidate.transformed(inputs.pose)
        notes: list[str] = []
        if self.cameras:
            inputs.on_step("culling the meshes")
            reference, candidate, note = self._cull(reference, candidate, inputs)
            notes.append(note)
        inputs.on_step("sampling the meshes")
        # Two seeds: the samples of equal meshes must not coincide.
        pair = _SampledPair(self._points(candidate, inputs.seed), self._points(reference, inputs.seed + 1))
        notes += [
            self._sampling_note("candidate", candidate, pair.candidate, inputs.seed),
            self._sampling_note("reference", reference, pair.reference, inputs.seed + 1),
        ]
        if inputs.crop is not None:
            as_region(inputs.crop, pair.reference)  # refuses polygons in another coordinate system
            pair = _SampledPair(*(_crop(cloud, inputs.crop, f"the {name}'s") for name, cloud in pair._asdict().items()))
            notes.append(f"both are cropped to {inputs.crop.describe()}")
        inputs.on_step("measuring distances")
        values = _measure(pair, self._in_unit(self.threshold_cm))
        counts = [ProtocolScore(f"{name}_points", len(cloud), better=None) for name, cloud in pair._asdict().items()]
        return Evaluation(protocol_text(self), self._scores(values), tuple(counts), tuple(notes))

    def other_files(self, inputs: EvaluationInputs) -> tuple[Path, ...]:
        """Return the cameras to which meshes are culled."""
        return (camera_file(self._camera_path(inputs)),) if self.cameras else ()

    def _camera_path(self, inputs: EvaluationInputs) -> Path:
        return (inputs.data or Path()) / self.cameras.replace("{scene}", inputs.scene)

    def _in_unit(self, centimetres: float) -> float:
        """Return a length in the unit of the coordinates."""
        return centimetres * (metres("cm") or 0) / (metres(self.unit) or 1)

    def _check_unit(self, shape: Cloud | Mesh) -> None:
        if (stated := metres(shape.unit)) is not None and stated != metres(self.unit):
            raise InputError(
                f"mesh: expected coordinates in {self.unit}, got a file in {shape.unit}: set unit={shape.unit}"
            )

    def _cull(
        self, reference: Cloud | Mesh, candidate: Cloud | Mesh, inputs: EvaluationInputs
    ) -> tuple[Mesh, Mesh, str]:
        if not (isinstance(reference, Mesh) and isinstance(candidate, Mesh)):
            raise InputError("mesh: expected two meshes to cull, got a cloud: leave out cameras")
        path = self._camera_path(inputs)
        cameras = read_cameras(path)
        tolerance = self._in_unit(self.tolerance_cm) if self.occlusion else None
        ours, theirs = cull(reference, cameras, tolerance), cull(candidate, cameras, tolerance)
        hidden = f" and hidden by less than {self.tolerance_cm:g} cm" if self.occlusion else ""
        note = (
            f"culled to faces with a vertex in the frame of one of the {len(cameras):,} cameras of {path}{hidden}:"
            f" without {theirs.culled_share:.1%} of the candidate's area and {ours.culled_share:.1%} of the reference's"
        )
        if not self.occlusion:
            note += "; occlusion is not tested (occlusion=true)"
        return ours.mesh, theirs.mesh, note

    def _points(self, shape: Cloud | Mesh, seed: int) -> Cloud:
        if self.variant == "replica":
            return shape.sample(self.samples, seed) if isinstance(shape, Mesh) else shape
        points, side = vertex_cloud(shape).points, self._in_unit(self.voxel_cm)
        return Cloud(cell_means(points, side, points.min(axis=0) - side / 2))  # the grid of Open3D

    def _sampling_note(self, name: str, shape: Cloud | Mesh, points: Cloud, seed: int) -> str:
        if self.variant == "scannet":
            kind = "vertices of a mesh" if isinstance(shape, Mesh) else "points of a cloud"
            return f"{name}: {kind}, downsampled to the means of {len(points):,} voxels of {self.voxel_cm:g} cm"
        if isinstance(shape, Mesh):
            return f"{name}: {len(points):,} points sampled on the mesh by area (seed {seed})"
        return f"{name}: a cloud, whose {len(points):,} points are used as they are"

    def _scores(self, values: _Measurement) -> tuple[ProtocolScore, ...]:
        in_cm = (metres(self.unit) or 1) / (metres("cm") or 1)
        threshold = f"@{self.threshold_cm:g}cm"
        shares = {
            f"completion_ratio{threshold}": values.recall,
            f"precision{threshold}": values.precision,
            f"recall{threshold}": values.recall,
            f"fscore{threshold}": harmonic_mean(values.precision, values.recall),
        }
        scores = [
            ProtocolScore("accuracy", in_cm * values.accuracy, _UNIT),
            ProtocolScore("completion", in_cm * values.completion, _UNIT),
            *(ProtocolScore(name, share, better="higher") for name, share in shares.items()),
        ]
        if self.variant == "replica":
            scores += [*_normal_scores("", values.cosines), *_normal_scores("_signed", values.signed_cosines)]
        return tuple(scores)


class _SampledPair(NamedTuple):
    """The points that are compared."""

    candidate: Cloud
    reference: Cloud


def _crop(cloud: Cloud, region: Region, owner: str) -> Cloud:
    return cloud.select(points_inside(cloud.points, region, region, owner))


class _Cosines(NamedTuple):
    """Mean cosine between the normals of closest points in each direction; None: the points have no normals."""

    candidate_to_reference: float | None = None
    reference_to_candidate: float | None = None


class _Measurement(NamedTuple):
    """Results of both directions; distances are in the unit of the coordinates."""

    accuracy: float
    completion: float
    precision: float
    recall: float
    cosines: _Cosines  # without their signs
    signed_cosines: _Cosines


def _measure(pair: _SampledPair, threshold: float) -> _Measurement:
    candidate, reference = pair
    forth, back = match_both_directions(Index(reference.points), Index(candidate.points))
    cosines = signed_cosines = _Cosines()
    if candidate.normals is not None and reference.normals is not None:
        both = (
            np.einsum("ni,ni->n", candidate.normals, reference.normals[forth.indices]),
            np.einsum("ni,ni->n", reference.normals, candidate.normals[back.indices]),
        )
        cosines = _Cosines(*(float(np.abs(values).mean()) for values in both))
        signed_cosines = _Cosines(*(float(values.mean()) for values in both))
    return _Measurement(
        accuracy=float(forth.distances.mean()),
        completion=float(back.distances.mean()),
        precision=float((forth.distances < threshold).mean()),
        recall=float((back.distances < threshold).mean()),
        cosines=cosines,
        signed_cosines=signed_cosines,
    )


def _normal_scores(ending: str, cosines: _Cosines) -> list[ProtocolScore]:
    forth, back = cosines
    both = None if forth is None or back is None else (forth + back) / 2
    named = {"normal_accuracy": forth, "normal_completion": back, "normal_consistency": both}
    return [ProtocolScore(name + ending, value, better="higher") for name, value in named.items()]
