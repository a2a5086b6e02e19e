"""Results of the experiment as types; their fields are the keys of experiment.json."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from pcbench.deformation import Deformation
from pcbench.geometry.cameras import Camera
from pcbench.io.colmap_model import read_colmap_cameras
from pcbench.measure.images import ViewScores
from pcbench.measure.presets import Gao2025
from pcbench.studies.frame.folder import StudyKind
from pcbench.studies.gao.plan import MVS

CLOUD_FILE, CAMERAS_FOLDER = "cloud.ply", "cameras"  # of a reconstruction
TRUTH = "truth"  # the second reference, next to mvs


@dataclass(frozen=True)
class ReferenceEvaluation:
    """Evaluation of a cloud against one reference.

    Attributes:
        reference: `mvs` or `truth`.
        points: number of the cloud's points after the crop.
        measures: measures by the paper's definitions; None if the cloud could not be measured.
        floor: D1 (c→r) of a cloud without errors, which is above 0 because of the spacing of the reference's points.
        deformation: verdict on the deformation.
        doubts: warnings of the registration.
        failure: why the cloud could not be measured.
    """

    reference: str
    points: int | None = None
    measures: Gao2025 | None = None
    floor: float | None = None
    deformation: Deformation | None = None
    doubts: tuple[str, ...] = ()
    failure: str = ""

    @property
    def r2c_mse(self) -> float | None:
        """Mean squared distance from the reference to the cloud, which the paper's D1 does not include."""
        return None if self.measures is None else self.measures.d1_back_mse

    @property
    def c2r_rms(self) -> float | None:
        """Root mean square distance from the cloud to the reference."""
        return None if self.measures is None else math.sqrt(self.measures.d1_mse)

    @property
    def r2c_rms(self) -> float | None:
        """Root mean square distance from the reference to the cloud."""
        return None if self.r2c_mse is None else math.sqrt(self.r2c_mse)


@dataclass(frozen=True)
class CloudResult:
    """A cloud with its cost and its evaluations.

    Attributes:
        name: name of the cloud.
        points: number of points.
        seconds: wall time of its process.
        resumed: whether the process resumed an earlier one, so that `seconds` is too short.
        memory_bytes: peak memory of its process.
        extra: whether it is a second cloud of the training before it, so that its seconds add to those.
        against: evaluations, one per reference.
        notes: notes of the reconstructor.
        failure: why there is no cloud.
        beside_others: whether it had one thread, and other scenes were processed at the same time.
        folder: folder with the cloud and its cameras; None if there is no cloud, and after reading.
    """

    name: str
    points: int | None = None
    seconds: float | None = None
    resumed: bool = False
    memory_bytes: int | None = None
    extra: bool = False
    against: tuple[ReferenceEvaluation, ...] = ()
    notes: tuple[str, ...] = ()
    failure: str = ""
    beside_others: bool = False
    folder: Path | None = field(default=None, compare=False, metadata={"json": False})

    @property
    def file(self) -> Path | None:
        """File of the cloud; None if there is none."""
        return None if self.folder is None else self.folder / CLOUD_FILE

    def cameras(self) -> dict[str, Camera]:
        """Read the cameras of the cloud by image name; empty if there is no cloud."""
        if self.folder is None:
            return {}
        return {camera.name: camera for camera in read_colmap_cameras(self.folder / CAMERAS_FOLDER)}

    def evaluation(self, reference: str) -> ReferenceEvaluation | None:
        """Return the evaluation against a reference; None if there is none or it failed."""
        return next((a for a in self.against if a.reference == reference and a.measures is not None), None)


@dataclass(frozen=True)
class SurfaceDeformation:
    """Displacement of the true surface that the errors of solved cameras cause by themselves.

    Attributes:
        moved: RMS along the normals beyond a rigid motion.
        bent: RMS along the normals beyond an affine motion.
        with_distance: pairs of horizontal distance from the centre and mean vertical displacement beyond the rigid
            motion.
        with_height: pairs of height above the lowest point and mean vertical displacement beyond the rigid motion.
    """

    moved: float
    bent: float
    with_distance: tuple[tuple[float, float], ...] = ()
    with_height: tuple[tuple[float, float], ...] = ()


@dataclass(frozen=True)
class CameraErrors:
    """Errors of solved cameras after the best similarity of their positions to those of the scene.

    Attributes:
        solved: number of images with a solved camera.
        given: number of images with a camera of the scene.
        median: median distance between positions.
        largest: largest distance between positions.
        focal_ratio: median ratio of solved to given focal length.
        astray: number of outliers: cameras with more than ten times the median distance.
        surface: deformation of the true surface by the other cameras; None if the surface is unknown.
    """

    solved: int
    given: int
    median: float
    largest: float
    focal_ratio: float
    astray: int = 0
    surface: SurfaceDeformation | None = None


@dataclass(frozen=True)
class InjectedDeformation:
    """A deformation of known size that was added to one cloud, and the verdicts against `mvs` that follow.

    Attributes:
        cloud: the deformed cloud; `mvs` if the reference itself was deformed.
        rms: RMS length of the displacements inside the region.
        verdicts: verdict on each cloud against `mvs`, as in tables.
        sizes: RMS along the normals of the clouds that are found deformed, also if only on condition of their poses.
        attributed: the cloud to which these verdicts attribute the deformation; None if to none.
    """

    cloud: str
    rms: float
    verdicts: Mapping[str, str]
    sizes: Mapping[str, float]
    attributed: str | None

    @property
    def is_found(self) -> bool:
        """Return whether any cloud is found deformed."""
        return bool(self.sizes)


@dataclass(frozen=True)
class NewViews:
    """Mean scores of training views and of held-out views."""

    train: ViewScores | None
    test: ViewScores | None
    train_views: int
    test_views: int
    test_error: float | None


@dataclass(frozen=True)
class SceneResult:
    """Results of one scene.

    Attributes:
        name: name of the scene.
        path: its folder.
        unit: unit of lengths; None if unknown.
        images: number of images.
        positions: positions of the cameras (x, y, z), in their order.
        looked_at: focus of the cameras; None if they have none.
        region: measured region, as text (see `pcbench.geometry.region_text`).
        cameras: errors of solved cameras; None if the cameras of the scene were used.
        references: number of points of each reference, before and after the crop.
        clouds: results in the order of reconstruction.
        views: mean scores of novel views, if there are any.
        injected: results for deformations of known size.
    """

    name: str
    path: str
    unit: str | None
    images: int
    positions: tuple[tuple[float, ...], ...]
    looked_at: tuple[float, ...] | None
    region: str
    cameras: CameraErrors | None
    references: Mapping[str, tuple[int, int]]
    clouds: tuple[CloudResult, ...]
    views: NewViews | None = None
    injected: tuple[InjectedDeformation, ...] = ()

    def cloud(self, name: str) -> CloudResult:
        """Return the cloud of that name.

        Raises:
            KeyError: there is none.
        """
        for cloud in self.clouds:
            if cloud.name == name:
                return cloud
        raise KeyError(name)

    def evaluation(self, name: str, reference: str) -> ReferenceEvaluation | None:
        """Return the evaluation of a cloud against a reference; None if there is none or it failed."""
        return self.cloud(name).evaluation(reference)

    @property
    def has_truth(self) -> bool:
        """Return whether the truth is one of the references."""
        return TRUTH in self.references


@dataclass(frozen=True)
class GaoStudy:
    """Results of all scenes.

    Attributes:
        poses: `solve` or `given`.
        splat: settings of `splat`.
        scenes: results of the scenes.
        sentences: conclusions, computed from the results.
        provenance: versions, machine and seed.
    """

    poses: str
    splat: Mapping[str, str]
    scenes: tuple[SceneResult, ...]
    sentences: tuple[str, ...] = ()
    provenance: Mapping[str, Any] | None = None

    @property
    def unit(self) -> str:
        """Unit of lengths; empty if unknown or not the same in all scenes."""
        units = {scene.unit or "" for scene in self.scenes}
        return units.pop() if len(units) == 1 else ""


def references(scene: SceneResult) -> Sequence[str]:
    """Return the references of a scene, that of the paper first."""
    return [name for name in (MVS, TRUTH) if name in scene.references]


KIND = StudyKind("experiment gao", "experiment.json", "pcbench.experiment.gao/1", GaoStudy, "gao.md")
