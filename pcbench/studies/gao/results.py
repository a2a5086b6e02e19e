"""What the experiment found, as types; experiment.json holds them as they are."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

from pcbench.deformation import Deformation
from pcbench.errors import InputError
from pcbench.io.files import read_json
from pcbench.measure.images import ViewScores
from pcbench.measure.presets import Gao2025
from pcbench.studies.gao.plan import MVS

SCHEMA = "pcbench.experiment.gao/1"
DOCUMENT = "experiment.json"
TRUTH = "truth"  # beside mvs, what clouds are held against


@dataclass(frozen=True)
class ReferenceEvaluation:
    """A cloud held against a reference.

    Attributes:
        reference: `mvs` or `truth`.
        points: of the cloud after the crop.
        measures: by the paper's definitions; None where it could not be measured.
        floor: what a cloud without errors would have for D1, c→r, because the reference's points are apart.
        deformation: the verdict.
        doubts: warnings of the registration.
        failure: why it could not be measured.
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
        """Mean squared distance from the reference to the cloud, which the paper's D1 leaves out."""
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
    """A cloud: what it took, and what it is worth.

    Attributes:
        seconds: of its process; `resumed`: it found a part of its work done.
        extra: whether it is another cloud of the training before it, whose seconds come on top.
        failure: why there is no cloud.
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

    def evaluation(self, reference: str) -> ReferenceEvaluation | None:
        """Against one reference; None where it was not, or could not be."""
        return next((a for a in self.against if a.reference == reference and a.measures is not None), None)


@dataclass(frozen=True)
class SurfaceDeformation:
    """Displacement of the true surface that solved cameras make by themselves.

    Attributes:
        moved, bent: RMS along the normals beyond a rigid motion, and beyond an affine one.
        with_distance, with_height: horizontal distance from the centre, or height above the lowest place, and mean
            vertical displacement beyond the rigid motion there.
    """

    moved: float
    bent: float
    with_distance: tuple[tuple[float, float], ...] = ()
    with_height: tuple[tuple[float, float], ...] = ()


@dataclass(frozen=True)
class CameraErrors:
    """Of solved cameras, against those of the scene: what the best similarity of their positions leaves.

    Attributes:
        solved: images with a camera; given: images.
        median, largest: distances between positions.
        focal_ratio: solved focal length over the scene's, the median.
        astray: cameras that are more than ten times the median off: they were placed wrongly.
        surface: what the others do by themselves to the true one; None where that is not known.
    """

    solved: int
    given: int
    median: float
    largest: float
    focal_ratio: float
    astray: int = 0
    surface: SurfaceDeformation | None = None


@dataclass(frozen=True)
class NewViews:
    """Means over views that were trained on, and over those that were held out."""

    train: ViewScores | None
    test: ViewScores | None
    train_views: int
    test_views: int
    test_error: float | None


@dataclass(frozen=True)
class SceneResult:
    """One scene.

    Attributes:
        unit: of lengths; None where it is not known.
        images: how many.
        positions: of the cameras (x, y, z) in their order; looked_at: the place that all look at.
        region: that was measured, as `pcbench.geometry.region_text` has it.
        cameras: errors of solved ones; None where those of the scene were taken.
        references: points of each reference, all and after the crop.
        clouds: in the order in which they were made.
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

    def cloud(self, name: str) -> CloudResult:
        """The cloud of that name.

        Raises:
            KeyError: there is none.
        """
        for cloud in self.clouds:
            if cloud.name == name:
                return cloud
        raise KeyError(name)

    def evaluation(self, name: str, reference: str) -> ReferenceEvaluation | None:
        """A cloud against a reference; None where it was not, or could not be."""
        return self.cloud(name).evaluation(reference)

    @property
    def has_truth(self) -> bool:
        return TRUTH in self.references


@dataclass(frozen=True)
class GaoStudy:
    """All scenes, and what follows.

    Attributes:
        poses: `solve` or `given`.
        splat: the settings of `splat`.
        sentences: computed from the figures.
    """

    poses: str
    splat: Mapping[str, str]
    scenes: tuple[SceneResult, ...]
    sentences: tuple[str, ...] = ()
    provenance: Mapping[str, Any] | None = None

    @property
    def unit(self) -> str:
        """Of lengths, for words; nothing where it is not known, or not one."""
        units = {scene.unit or "" for scene in self.scenes}
        return units.pop() if len(units) == 1 else ""


def references(scene: SceneResult) -> Sequence[str]:
    """Those that clouds of a scene are held against, the paper's first."""
    return [name for name in (MVS, TRUTH) if name in scene.references]


def document(study: GaoStudy) -> dict[str, Any]:
    """What experiment.json holds of a study."""

    def values(of: Any) -> dict[str, Any]:
        return {field.name: getattr(of, field.name) for field in fields(of)}

    def views(of: NewViews | None) -> dict[str, Any] | None:
        if of is None:
            return None
        means = {
            key: None if mean is None else mean._asdict() for key, mean in (("train", of.train), ("test", of.test))
        }
        return {**values(of), **means}

    scenes = [{**values(scene), "views": views(scene.views)} for scene in study.scenes]
    return {"schema": SCHEMA, **values(study), "scenes": scenes}


def read_study(folder: Path) -> GaoStudy:
    """What experiment.json in a folder holds.

    Raises:
        InputError: it is another one, or damaged.
        OSError: it cannot be read.
    """
    values: dict[str, Any] = read_json(folder / DOCUMENT)
    if not isinstance(values, dict) or values.get("schema") != SCHEMA:
        raise InputError(f"{folder / DOCUMENT}: expected the schema {SCHEMA}")
    try:
        scenes = tuple(_scene(scene) for scene in values["scenes"])
        return GaoStudy(values["poses"], values["splat"], scenes, tuple(values["sentences"]), values["provenance"])
    except (KeyError, TypeError, ValueError, AttributeError) as error:
        raise InputError(f"{folder / DOCUMENT}: it is damaged: {type(error).__name__}: {error}") from error


def _scene(values: dict[str, Any]) -> SceneResult:
    place, cameras, views = (values[key] for key in ("looked_at", "cameras", "views"))
    return SceneResult(
        **{key: values[key] for key in ("name", "path", "unit", "images", "region")},
        positions=tuple(map(tuple, values["positions"])),
        looked_at=None if place is None else tuple(place),
        cameras=None if cameras is None else _cameras(cameras),
        references={name: (int(counts[0]), int(counts[1])) for name, counts in values["references"].items()},
        clouds=tuple(map(_cloud, values["clouds"])),
        views=None if views is None else _views(views),
    )


def _cameras(values: dict[str, Any]) -> CameraErrors:
    of = values["surface"]
    if of is None:
        return CameraErrors(**values)
    profiles = {key: tuple(map(tuple, of[key])) for key in ("with_distance", "with_height")}
    return CameraErrors(**{**values, "surface": SurfaceDeformation(of["moved"], of["bent"], **profiles)})


def _cloud(values: dict[str, Any]) -> CloudResult:
    against = tuple(evaluation_from_json(row) for row in values["against"])
    return CloudResult(**{**values, "against": against, "notes": tuple(values["notes"])})


def evaluation_from_json(values: Mapping[str, Any]) -> ReferenceEvaluation:
    """A cloud held against a reference, as JSON holds it."""
    measures, bend = values["measures"], values["deformation"]
    parts = {
        "measures": None if measures is None else _measures(measures),
        "deformation": None if bend is None else Deformation.from_json(bend),
        "doubts": tuple(values["doubts"]),
    }
    return ReferenceEvaluation(**{**values, **parts})


def _measures(values: Mapping[str, float]) -> Gao2025:
    # Earlier versions wrote only the sum of both directions.
    return Gao2025(**{"d1_back_mse": values["chamfer"] - values["d1_mse"], **values})


def _views(values: dict[str, Any]) -> NewViews:
    def scores(key: str) -> ViewScores | None:
        row = values[key]
        if row is None:
            return None
        psnr = math.inf if row["psnr"] is None else row["psnr"]
        return ViewScores(psnr, math.nan if row["ssim"] is None else row["ssim"], row["lpips"], row["flip"])

    return NewViews(**{**values, "train": scores("train"), "test": scores("test")})
