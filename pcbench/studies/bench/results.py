"""Results of a bench as types; their fields are the keys of bench.json."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any

from pcbench.studies.frame.folder import StudyKind

COLUMNS = (
    *("method", "settings", "seed", "status", "wall_s", "cpu_s", "peak_rss_bytes", "gpu_bytes", "points"),
    *("registration", "accuracy_to", "mean_c2r", "mean_c2r_floor", "mean_r2c", "mean_r2c_floor", "d1_c2r", "d1_r2c"),
    *("chamfer", "hausdorff", "threshold", "pixels", "precision", "precision_floor", "recall", "recall_floor"),
    *("fscore", "recall_visible", "recall_visible_floor", "fscore_visible", "pareto", "beside_others", "message"),
)
"""Columns of bench.csv."""
MEASURED = "ok"  # status of a run whose cloud was measured


def choice_text(choices: Mapping[str, str]) -> str:
    """Return chosen settings as text."""
    return " ".join(f"{key}={value}" for key, value in choices.items())


@dataclass(frozen=True)
class RunRecord:
    """A reconstruction, as its `run.json` has it.

    Attributes:
        id: random identifier of the run.
        status: status, as in `pcbench.plugins.run.Run`, or `unmeasured`.
        message: one line that explains the status; empty for `ok`.
        wall_s, cpu_s: seconds of the process and its children.
        peak_rss_bytes, gpu_bytes: peak memory; None if unknown.
        beside_others: whether it had one thread, and other runs went on at the same time.
        time_limit_s: its time limit; None without one.
        settings: all settings of the reconstructor, including defaults.
        points: number of points; None without a cloud.
        gauge: gauge of the cloud.
        cameras: number of its cameras.
        survey: residuals of control and check points; None without any.
        reconstruction_notes: warnings about the scene and notes of the reconstructor.
    """

    id: str
    status: str
    message: str
    wall_s: float
    cpu_s: float
    peak_rss_bytes: int | None
    gpu_bytes: int | None
    beside_others: bool
    time_limit_s: float | None
    settings: Mapping[str, str]
    points: int | None
    gauge: str | None
    cameras: int | None
    survey: Mapping[str, Any] | None
    reconstruction_notes: tuple[str, ...]


@dataclass(frozen=True)
class ThresholdScore:
    """Precision, recall and F-score at one threshold, with their floors.

    Attributes:
        threshold: distance threshold, in the reference's unit.
        pixels: the threshold in pixels on the ground, if it was specified in pixels.
        precision: share of the cloud's points within the threshold of the true surface, or of the reference's points if
            the surface is unknown.
        recall: share of the reference's points with a point of the cloud within the threshold.
        fscore: harmonic mean of precision and recall.
        recall_visible: recall over the area that the cameras saw; None if unknown.
        fscore_visible: harmonic mean of precision and `recall_visible`; None if unknown.
        precision_floor: precision of a cloud without errors: 1 against the surface, less against sparse points.
        recall_floor: recall of the cloud's own points moved onto the surface. It is low if they are few or clustered.
            None if the surface is unknown.
        recall_visible_floor: the same over the area that the cameras saw.
    """

    threshold: float
    pixels: float | None
    precision: float
    recall: float
    fscore: float
    recall_visible: float | None
    fscore_visible: float | None
    precision_floor: float
    recall_floor: float | None
    recall_visible_floor: float | None


@dataclass(frozen=True)
class Score(ThresholdScore):
    """Evaluation of one cloud; precision, recall and F-score are those at the last threshold.

    Attributes:
        registration: method that registered the cloud to the reference.
        accuracy_to: `surface` if the true surface is known, otherwise `points` of the reference.
        mean_c2r: mean distance from the cloud to the surface or the points.
        mean_c2r_floor: `mean_c2r` of a cloud without errors; None if undefined.
        mean_r2c: mean distance from the reference's points to the cloud.
        mean_r2c_floor: `mean_r2c` of a cloud without errors; None if undefined.
        d1_c2r: mean squared distance from the cloud to the surface or the points.
        d1_r2c: mean squared distance from the reference's points to the cloud.
        chamfer: sum of the two mean distances, in the reference's unit.
        hausdorff: largest distance in either direction.
        thresholds: scores at each threshold.
        notes: one line each.
        comparison: the complete comparison, as in comparison.json.
    """

    registration: str
    accuracy_to: str
    mean_c2r: float
    mean_c2r_floor: float | None
    mean_r2c: float
    mean_r2c_floor: float | None
    d1_c2r: float
    d1_r2c: float
    chamfer: float
    hausdorff: float
    thresholds: tuple[ThresholdScore, ...]
    notes: tuple[str, ...]
    comparison: Mapping[str, Any]


@dataclass(frozen=True)
class BenchRow:
    """A run of a method and its score.

    Attributes:
        method: label of the method.
        choices: chosen settings.
        seed: random seed; None if the method has none.
        run: the reconstruction.
        folder: its folder, relative to that of the bench.
        score: score of its cloud; None if it was not measured.
        pareto: whether its configuration is on the Pareto front; None if it was not measured.
    """

    method: str
    choices: Mapping[str, str]
    seed: int | None
    run: RunRecord = field(metadata={"flat": True})
    folder: str
    score: Score | None = field(default=None, metadata={"flat": True})
    pareto: bool | None = None

    @property
    def name(self) -> str:
        """Method and settings as text."""
        return " ".join(filter(None, (self.method, choice_text(self.choices))))

    @property
    def title(self) -> str:
        """Method, settings and seed as text."""
        return self.name if self.seed is None else f"{self.name} seed {self.seed}"

    def value(self, column: str) -> Any:
        """Return the value of a column of bench.csv; None if the row has none."""
        if column == "settings":
            return choice_text(self.choices)
        owner = next((part for part in (self.score, self.run, self) if hasattr(part, column)), None)
        return None if owner is None else getattr(owner, column)

    def unmeasured(self, reason: str) -> BenchRow:
        """Return the row of a run whose cloud cannot be measured."""
        return replace(self, run=replace(self.run, status="unmeasured", message=reason))


@dataclass(frozen=True)
class BenchInput:
    """A file or folder that a bench reads, with the SHA-256 of its content."""

    path: str
    sha256: str


@dataclass(frozen=True)
class BenchReference(BenchInput):
    """The reference of a bench.

    Attributes:
        points: number of its points.
        unit: unit of lengths, if known.
        mesh: mesh of the true surface; None without one.
        visible_share: share of the points that the cameras saw; None if unknown.
        visibility: how that is known, or why it is not.
        pixel: median size of a pixel on the surface; None without cameras.
        seen_points: number of points at which `recall_visible` is measured; None if it is not.
        seen_spacing: their spacing.
    """

    points: int
    unit: str | None
    mesh: BenchInput | None
    visible_share: float | None
    visibility: str
    pixel: float | None
    seen_points: int | None
    seen_spacing: float | None


@dataclass(frozen=True)
class Bench:
    """A bench.

    Attributes:
        scene: folder of the photographs.
        reference: the reference.
        methods: label, specification and description of each method.
        settings: settings of the bench.
        provenance: versions and machine.
        notes: notes on the whole bench.
        rows: finished runs.
    """

    scene: BenchInput
    reference: BenchReference
    methods: tuple[Mapping[str, Any], ...]
    settings: Mapping[str, Any]
    provenance: Mapping[str, Any] | None
    notes: tuple[str, ...]
    rows: tuple[BenchRow, ...]

    @property
    def unit(self) -> str:
        """Unit of lengths in words."""
        return self.reference.unit or "the files' unit"

    @property
    def scores(self) -> list[Score]:
        """Scores of the measured runs."""
        return [row.score for row in self.rows if row.score is not None]


KIND = StudyKind("bench", "bench.json", "pcbench.bench/1", Bench, "bench.md")
