"""Results of the experiment as types; their fields are the keys of experiment.json."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Self

from pcbench.deformation import Deformation, Growth
from pcbench.geometry.cameras import Intrinsics
from pcbench.studies.frame.folder import StudyKind


@dataclass(frozen=True)
class Lens:
    """Intrinsics of a solution: focal lengths in pixels, distortion coefficients and image size."""

    fx: float
    fy: float
    distortion: tuple[float, ...]
    size: tuple[int, int]

    @classmethod
    def from_intrinsics(cls, intrinsics: Intrinsics) -> Lens:
        """Take focal lengths, distortion and image size from intrinsics."""
        k = intrinsics
        return cls(k.fx, k.fy, tuple(k.distortion), (k.width, k.height))


@dataclass(frozen=True)
class BendVerdict:
    """Verdict on the deformation of a solution's cloud, without the displacement field.

    Attributes:
        verdict: verdict, as in `Deformation`.
        model: selected model, as in `Deformation`.
        rms: RMS of the deformation beyond an affine one; None if the verdict has none.
        ci: 95 % confidence interval of `rms`.
        p_value: p-value, as in `Deformation`.
        detectable: RMS of the smallest dome that would have been stated.
        growth: trends with distance and height, as in `Deformation`.
        warnings: one line each.
        conditional: whether all of this holds only if the pose is right, because the registration is doubtful.
    """

    verdict: str
    model: str
    rms: float | None
    ci: tuple[float, float] | None
    p_value: float | None
    detectable: float | None
    growth: Growth | None
    warnings: tuple[str, ...] = ()
    conditional: bool = False

    @classmethod
    def from_deformation(cls, result: Deformation, **more: str) -> Self:
        """Take the verdict without its field; a conditional one if the registration is doubtful."""
        verdict = result.assuming_pose()
        size = verdict.amplitude
        return cls(
            verdict.verdict,
            verdict.model,
            None if size is None else size.rms,
            None if size is None else size.ci,
            verdict.p_value,
            verdict.minimum_detectable_rms,
            verdict.growth,
            tuple(map(str, verdict.warnings)),
            result.conditional_verdict is not None,
            **more,
        )

    @property
    def verdict_text(self) -> str:
        """Verdict for tables; one that holds only if the pose is right is followed by `(?)`."""
        return f"{self.verdict} (?)" if self.conditional else self.verdict

    @property
    def is_bent(self) -> bool:
        """Return whether the deformation is beyond an affine one and beyond noise."""
        return self.verdict == "non-affine"

    def size_text(self, unit: str = "") -> str:
        """Return RMS and interval as text, or a dash."""
        if self.rms is None or self.ci is None:
            return "–"
        return f"{self.rms:.3g} [{self.ci[0]:.3g}, {self.ci[1]:.3g}] {unit}".rstrip()


@dataclass(frozen=True)
class MutualVerdict(BendVerdict):
    """Verdict on the deformation against another solution.

    Attributes:
        against: name of that solution.
    """

    against: str = ""


@dataclass(frozen=True)
class SolutionResult:
    """Settings and results of one solution.

    Attributes:
        name: name of the variant.
        factors: settings of the variant by name.
        images_given: number of images.
        images: number of registered images.
        failure: one line if there is no cloud.
        notes: notes of the reconstructor.
        points: number of points of the cloud.
        reprojection_error: mean reprojection error, in pixels.
        lens: solved intrinsics.
        lens_error_px: RMS error of the intrinsics beyond the focal length, in pixels.
        truth: verdict against the truth.
        mutual: verdict against the first solution.
        cells: rows of x, y, z, vertical displacement and its standard deviation; NaN if unknown.
    """

    name: str
    factors: Mapping[str, str]
    images_given: int
    images: int
    failure: str | None = None
    notes: tuple[str, ...] = ()
    points: int | None = None
    reprojection_error: float | None = None
    lens: Lens | None = None
    lens_error_px: float | None = None
    truth: BendVerdict | None = None
    mutual: MutualVerdict | None = None
    cells: tuple[tuple[float, ...], ...] | None = None


@dataclass(frozen=True)
class SurveyedScene:
    """A scene: folder, number of images, true lens, and unit of lengths."""

    path: str
    images: int
    lens: Lens
    unit: str | None


@dataclass(frozen=True)
class BendStudy:
    """Results of all solutions of a scene.

    Attributes:
        scene: the scene.
        plugin: name of the reconstructor.
        rows: one per solution.
        sentences: conclusions on the cause, computed from the rows.
        provenance: versions, machine and seed.
    """

    scene: SurveyedScene
    plugin: str
    rows: tuple[SolutionResult, ...]
    sentences: tuple[str, ...]
    provenance: Mapping[str, Any] | None = None

    @property
    def unit(self) -> str:
        """Unit of lengths; empty if unknown."""
        return self.scene.unit or ""

    @property
    def has_measured_bends(self) -> bool:
        """Return whether the deformation of any solution was measured."""
        return bool(measured_bends(self.rows))


def measured_bends(rows: Sequence[SolutionResult]) -> list[tuple[SolutionResult, BendVerdict]]:
    """Return the solutions whose deformation against the truth was measured, with their verdicts."""
    return [(row, row.truth) for row in rows if row.truth is not None and row.truth.rms is not None]


KIND = StudyKind("experiment bend", "experiment.json", "pcbench.experiment.bend/1", BendStudy)
