"""The evaluation of Tanks and Temples against laser scans.

Knapitsch et al. 2017 define it, and their program prints it.

1. The candidate is registered: RANSAC over camera centres, then three runs of ICP (see `registration.trajectories`).
2. Both clouds are cropped to the scene's volume and downsampled, and the F-score is computed at the scene's threshold,
   as in the preset `tnt`.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar, NamedTuple

import numpy as np

from pcbench.errors import InputError
from pcbench.geometry.arrays import FloatArray
from pcbench.geometry.cloud import Cloud
from pcbench.geometry.mesh import Mesh
from pcbench.geometry.mesh_samples import sample_candidate, vertex_cloud
from pcbench.geometry.regions import Region
from pcbench.geometry.transform import Similarity
from pcbench.io.meshes import to_shape
from pcbench.io.tanks_and_temples import TntScene
from pcbench.measure.metrics import FScore
from pcbench.measure.presets import tnt_fscore
from pcbench.measure.protocols.protocol import Evaluation, EvaluationInputs, ProtocolScore, Shape, protocol_text
from pcbench.registration.trajectories import TrajectorySettings, align_trajectories, refine_pose

_MESH_POINTS = ("samples", "vertices", "centers")


@dataclass(frozen=True)
class TanksAndTemples:
    """Settings of the evaluation of Tanks and Temples; lengths in m.

    Attributes:
        threshold: distance below which points count; 0: that of the scene, by its name.
        trajectory: the candidate's camera poses: a `.log` file, or the folder of a COLMAP model; `{scene}` stands for
            the name of the scene. Empty: a `.log` file beside the candidate with its name. If there is none, the
            candidate is in the coordinates of the reference reconstruction (`SCENE_COLMAP_SfM.log`).
        refine: whether ICP refines the pose. A pose that is given with the inputs is used unchanged.
        mesh: points of a candidate mesh: `samples`, uniform by area; `vertices`, as the official program; or `centers`,
            its vertices and the centroids of its faces, as the evaluations of 2DGS (Huang et al. 2024) and GOF (Yu et
            al. 2024), which many papers on splats use.
    """

    name: ClassVar[str] = "tnt"
    title: ClassVar[str] = "Tanks and Temples"
    citation: ClassVar[str] = (
        "Knapitsch et al. 2017, Tanks and Temples: benchmarking large-scale scene reconstruction, ACM TOG 36(4)"
    )
    version: ClassVar[str] = "TanksAndTemples evaluation of 2022-10-29"

    threshold: float = 0.0
    trajectory: str = ""
    refine: bool = True
    mesh: str = "samples"

    def __post_init__(self) -> None:
        if not 0 <= self.threshold < np.inf:
            raise InputError(
                f"tnt: expected threshold as a length above 0 m, or 0 for the scene's, got {self.threshold:g}"
            )
        if self.mesh not in _MESH_POINTS:
            raise InputError(f"tnt: expected mesh as one of {', '.join(_MESH_POINTS)}; got {self.mesh!r}")

    def evaluate(self, inputs: EvaluationInputs) -> Evaluation:
        """Evaluate a candidate.

        The scene is named by the inputs, or by the file of the reference. Its files are searched in `data`, in the
        subfolder of `data` with its name, and beside the reference. A crop replaces the scene's volume.

        Raises:
            InputError: a file is missing or unusable, or the threshold of the scene is unknown.
            RegistrationError: the candidate cannot be registered.
        """
        try:
            threshold = self.threshold or TntScene(Path(), _scene_name(inputs)).threshold
        except InputError as error:
            raise InputError(f"{error} (--protocol tnt:threshold=0.01)") from None
        inputs.on_step("reading the clouds")
        reference = vertex_cloud(to_shape(_reference(inputs)))
        candidate, notes = self._candidate(to_shape(inputs.candidate), reference, inputs.seed)
        inputs.on_step("registering")
        volume = _volume(inputs)
        placement = self._place(inputs, threshold, volume, reference.points, candidate)
        inputs.on_step("measuring distances")
        moved = placement.pose.apply(candidate)
        inside = [points[volume.contains(points)] for points in (reference.points, moved)]
        scores, sizes = FScore(threshold, 0.0, 0.0, 0.0), (0, 0)
        if all(map(len, inside)):
            scores, sizes = tnt_fscore(inside[0], inside[1], threshold)
        else:
            where = "the crop volume of the scene" if inputs.crop is None else "the region of --crop"
            remedy = "give the region with --crop" if inputs.crop is None else "check --crop"
            notes.append(
                f"no point of the reference or of the candidate is in {where}, so that all scores are 0: {remedy}"
            )
        counts = {"reference_points": sizes[0], "candidate_points": sizes[1], "scale": placement.pose.scale}
        return Evaluation(
            protocol_text(self),
            tuple(
                ProtocolScore(f"{name}@{threshold:g}", getattr(scores, name), better="higher")
                for name in ("precision", "recall", "fscore")
            ),
            tuple(ProtocolScore(name, n, better=None) for name, n in (counts | placement.counts).items()),
            (f"the candidate is {placement.how}", *notes),
        )

    def other_files(self, inputs: EvaluationInputs) -> tuple[Path, ...]:
        """Return the files of the scene, and the candidate's trajectory."""
        trajectory = self._trajectory_file(inputs)
        try:
            scene = _scene(inputs).files()
        except InputError:
            scene = ()  # not needed for a given pose and crop
        return (*scene, *([] if trajectory is None else [trajectory]))

    def _candidate(self, shape: Cloud | Mesh, reference: Cloud, seed: int) -> tuple[FloatArray, list[str]]:
        """Return the points (N, 3) that stand for the candidate, and how they were chosen."""
        if not isinstance(shape, Mesh):
            return shape.points, []
        if self.mesh == "samples":
            points = sample_candidate(shape, reference, seed).points
            how = f"{len(points):,} points sampled on its faces by area (seed {seed})"
        elif self.mesh == "vertices":
            points, how = shape.vertices, f"its {len(shape.vertices):,} vertices"
        else:
            points = np.concatenate([shape.vertices, shape.vertices[shape.faces].mean(axis=1)])
            how = f"its {len(shape.vertices):,} vertices and {len(shape.faces):,} centroids of faces"
        return points, [f"the candidate is a mesh: it is evaluated at {how}"]

    def _place(
        self, inputs: EvaluationInputs, threshold: float, volume: Region, reference: FloatArray, candidate: FloatArray
    ) -> _Placement:
        """Return the pose of the candidate's points on the reference's."""
        if inputs.pose is not None:
            return _Placement(inputs.pose, "in the given pose, which is not refined", {})
        scene, trajectory = _scene(inputs, "the pose with --register"), self._trajectory_file(inputs)
        if trajectory is None:
            pose, how = scene.scan_from_sfm(), f"placed by {scene.path('_trans.txt').name}"
            counts: dict[str, int] = {}
        else:
            settings = TrajectorySettings.of_scene(
                trajectory, scene, threshold, inputs.on_step, volume=volume, seed=inputs.seed
            )
            pose, inliers = align_trajectories(settings.candidate_centers, settings.reference_centers, settings.seed)
            how = f"registered by {trajectory.name}"
            counts = {"cameras": len(settings.candidate_centers), "cameras_aligned": inliers}
        if not self.refine:
            return _Placement(pose, f"{how}, without refinement", counts)
        refined = refine_pose(pose, reference, candidate, threshold, volume)
        return _Placement(refined.pose, f"{how} and refined by ICP", counts | {"icp_iterations": refined.iterations})

    def _trajectory_file(self, inputs: EvaluationInputs) -> Path | None:
        if self.trajectory:
            return Path(self.trajectory.replace("{scene}", _scene_name(inputs)))
        beside = inputs.candidate.with_suffix(".log") if isinstance(inputs.candidate, Path) else None
        return beside if beside is not None and beside.is_file() else None


class _Placement(NamedTuple):
    """A pose candidate -> reference, how it was found in words, and numbers of its computation."""

    pose: Similarity
    how: str
    counts: dict[str, int]


def _scene_name(inputs: EvaluationInputs) -> str:
    name = inputs.scene or (inputs.reference.stem if isinstance(inputs.reference, Path) else "")
    if not name:
        raise InputError("tnt: expected the name of the scene, because a reference in memory does not tell it")
    return name


def _scene(inputs: EvaluationInputs, instead: str = "the path of its scan") -> TntScene:
    """Return the scene of the inputs; the error says what may be given instead of its files."""
    folders = [] if inputs.data is None else [inputs.data]
    if isinstance(inputs.reference, Path):
        folders.append(inputs.reference if inputs.reference.is_dir() else inputs.reference.parent)
    name = _scene_name(inputs)
    try:
        return TntScene.find(folders, name)
    except InputError as error:
        raise InputError(f"{error} with --protocol-data, or give {instead}") from None


def _volume(inputs: EvaluationInputs) -> Region:
    """Return the region that is evaluated: the given one, or else the crop volume of the scene.

    Raises:
        InputError: none is given, and the files of the scene are missing or unusable.
    """
    if inputs.crop is not None:
        return inputs.crop
    scene = _scene(inputs, "the region with --crop" + (" and the pose with --register" if inputs.pose is None else ""))
    try:
        return scene.crop_volume()
    except InputError as error:
        raise InputError(f"{error}; or give the region with --crop") from None


def _reference(inputs: EvaluationInputs) -> Shape:
    if isinstance(inputs.reference, Path) and inputs.reference.is_dir():
        return _scene(inputs).path(".ply")
    return inputs.reference
