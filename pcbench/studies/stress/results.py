"""Results of the stress study as types; their fields are the keys of stress.json.

The study asks four subjects, each with its own cells: registrations, metrics, verdicts and changes; or one on perturbed
photographs: reconstructions. A cell is one run: a scene, a ladder, a level of it, a method and a seed.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Hashable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from statistics import NormalDist, median
from typing import Any, TypeVar

from pcbench.studies.frame.folder import StudyKind
from pcbench.tasks import Workers

SCHEMA = "pcbench.stress/1"
DOCUMENT = "stress.json"

# Subjects of a ladder.
REGISTRATION = "registration"
METRICS = "metrics"
VERDICTS = "verdicts"
CHANGES = "changes"
RECONSTRUCTION = "reconstruction"
SUBJECTS = (REGISTRATION, METRICS, VERDICTS, CHANGES)  # of pairs of clouds
ALL_SUBJECTS = (*SUBJECTS, RECONSTRUCTION)

# Outcomes of a run. Every subject uses the last two.
RIGHT = "right"
FALSE_ALARM = "false-alarm"  # the pose is right, but the result is doubtful
REFUSED = "refused"  # no pose, although another method found it from the same clouds
SAID = "said"  # wrong, and the result is doubtful; or no pose where none was findable
SILENT = "silent"  # wrong but not doubted
WRONG = "wrong"  # a verdict that contradicts the truth, or a change of another kind or at another place
WITHHELD = "withheld"  # no verdict
UNNAMED = "unnamed"  # a change that is not reported
WARNED = "warned"  # a poor cloud, and the reconstructor warns
DEGRADED = "degraded"  # a poor cloud without a warning
CRASH = "crash"
TIME_OUT = "time-out"

# Outcomes by subject, in the order of bars and tables: from good to bad.
OUTCOMES: Mapping[str, tuple[str, ...]] = {
    REGISTRATION: (RIGHT, FALSE_ALARM, REFUSED, SAID, SILENT, CRASH, TIME_OUT),
    METRICS: (RIGHT, SAID, SILENT, CRASH, TIME_OUT),
    VERDICTS: (RIGHT, WITHHELD, WRONG, CRASH, TIME_OUT),
    CHANGES: (RIGHT, UNNAMED, WRONG, CRASH, TIME_OUT),
    RECONSTRUCTION: (RIGHT, WARNED, REFUSED, DEGRADED, CRASH, TIME_OUT),
}

# Failures of a verdict.
FALSE_BEND = "false-bend"  # non-affine, although nothing is deformed beyond an affine motion
MISSED = "missed"  # not non-affine, although the deformation is larger than the limit beside the verdict
WITHHELD_ALTHOUGH_RIGHT = "withheld-although-right"  # no verdict, although the pose is right
FAILURES = (FALSE_BEND, MISSED, WITHHELD_ALTHOUGH_RIGHT)

# Scopes of a method.
LOCAL = "local"  # starts from the given pose
GLOBAL = "global"  # needs no initial pose
SCOPES = (LOCAL, GLOBAL)

MAX_METRIC_ERROR = 0.1
"""Relative error up to which the value of a metric is right."""

MAX_FLOOR_SHARE = 0.3
"""Floor over value up to which point spacing hardly contributes to the value: less than 5 % of an RMS."""

MIN_COUNTED_SIZE = 0.25
"""RMS over the noise above which a deformation has to be found; a smaller one may be."""

MIN_CHANGE_SIZE, MIN_CHANGE_POINTS = 10.0, 30
"""Motion over the noise, and number of points of both clouds, from which a change has to be named; others may be."""

MIN_SCORE_SHARE = 0.5
"""Smallest F-score of a right reconstruction over that of the unperturbed run.

An F-score is halved when, for example, a complete cloud loses two thirds of the surface, or two thirds of its points
are wrong.
"""

WARNING_PREFIX = "warning: "
"""Start of a reconstructor's note that says that the result may be wrong; see `pcbench.plugins.Reconstruction`."""

_SINGULAR_UNITS = {"spacings": "spacing", "copies": "copy", "stops": "stop"}
_Z = NormalDist().inv_cdf(0.975)
_Key = TypeVar("_Key", bound=Hashable)


@dataclass(frozen=True)
class Preset:
    """Success criterion of a benchmark: both errors are at most these.

    Attributes:
        name: name of the benchmark.
        offset: largest translation error, in metres.
        angle_deg: largest rotation error, in degrees.
    """

    name: str
    offset: float
    angle_deg: float


PRESETS = (Preset("indoor", 0.3, 15.0), Preset("outdoor", 2.0, 5.0), Preset("ETH", 0.3, 2.0))


@dataclass(frozen=True)
class StressSettings:
    """Settings of the study.

    Attributes:
        quick: whether the plan is the short one.
        seeds: number of seeds of each cell.
        seed: first seed.
        only: text that a ladder's name, kind or subject contains; None for all ladders.
        methods: names of the methods to run; empty for all that are installed.
        register: registration method that finds the true pose of a given pair.
        time_limit_s: time limit of a cell, in seconds.
        reconstructors: whether reconstructors run on perturbed photographs instead.
        workers: number of runs at the same time, each with one thread; None: as many runs as CPUs, but one
            reconstructor after another.
        cluster: Dask scheduler whose workers make the runs; None: processes on this machine.
    """

    quick: bool = False
    seeds: int = 1
    seed: int = 0
    only: str | None = None
    methods: tuple[str, ...] = ()
    register: str = "icp"
    time_limit_s: float = 120.0
    reconstructors: bool = False
    workers: int | None = None
    cluster: str | None = None

    @property
    def chosen_workers(self) -> Workers | None:
        """The workers that the user chose; None if neither their number nor a cluster is given."""
        return None if self.workers is None and self.cluster is None else Workers(self.workers, self.cluster)


@dataclass(frozen=True)
class LadderInfo:
    """Description of a ladder: what it perturbs, from nothing to certain failure.

    Attributes:
        name: identifier, in lower case with hyphens.
        title: what is perturbed, for charts and tables, such as `rotation of the start`.
        kind: group of ladders: `start`, `noise`, `parts`, `density`, `coordinates`, `warp`, `changes` or `degenerate`;
            of photographs `unperturbed`, `images`, `cameras` or `surface`.
        subjects: subjects that it is run for, of `ALL_SUBJECTS`.
        unit: unit of the levels, such as `deg` or `%`; empty for plain numbers.
        levels: levels of the run, ascending in severity.
        level_names: names of the levels of a ladder that is a list of cases; otherwise empty.
        second_title: title of the second coordinate of a map; empty for a ladder.
        second_unit: unit of the second coordinate.
        second_levels: levels of the second coordinate of a map; empty for a ladder.
    """

    name: str
    title: str
    kind: str
    subjects: tuple[str, ...]
    unit: str
    levels: tuple[float, ...]
    level_names: tuple[str, ...] = ()
    second_title: str = ""
    second_unit: str = ""
    second_levels: tuple[float, ...] = ()

    @property
    def is_map(self) -> bool:
        """Return whether its cells have two coordinates."""
        return bool(self.second_levels)

    @property
    def is_list(self) -> bool:
        """Return whether its levels are cases without an order."""
        return bool(self.level_names)

    def level_text(self, level: float) -> str:
        """Return a level with its unit, or its name."""
        if self.level_names:
            return self.level_names[self.levels.index(level)]
        unit = _SINGULAR_UNITS.get(self.unit, self.unit) if level == 1 else self.unit
        return f"{level:g} {unit}".rstrip()


@dataclass(frozen=True)
class SceneInfo:
    """A scene of the study, in the unit of its clouds.

    Attributes:
        name: name of the scene.
        extent: side of the cube that holds the middle 98 % of the reference.
        spacing: median spacing of the reference.
        noise: standard deviation of each cloud's noise along the normals; None if unknown.
        unit: unit of lengths; empty if unknown.
        points: numbers of points of the reference and the candidate.
    """

    name: str
    extent: float
    spacing: float
    noise: float | None
    unit: str
    points: tuple[int, int]


@dataclass(frozen=True)
class PhotographInfo:
    """The photographs of a study of reconstructors, and how clouds are measured.

    Attributes:
        images: number of images.
        size: width and height of the images, in pixels.
        rig: arrangement of the cameras, of `pcbench synth city --rig`.
        extent: side of the city, in metres.
        pixel: median size of a pixel on the surface, in metres.
        threshold: distance threshold of precision, recall and F-score, in metres.
        surface_points: number of points that represent the true surface.
    """

    images: int
    size: tuple[int, int]
    rig: str
    extent: float
    pixel: float
    threshold: float
    surface_points: int


@dataclass(frozen=True)
class MethodInfo:
    """A method of the study.

    Attributes:
        name: name in cells, tables and charts.
        subject: subject that it answers, of `ALL_SUBJECTS`.
        scope: for a registration, `local` or `global`; otherwise empty.
        library: library that it comes from; `pcbench` for our own.
        version: version of that library.
    """

    name: str
    subject: str
    scope: str
    library: str
    version: str

    @property
    def is_ours(self) -> bool:
        """Return whether the method is pcbench's own."""
        return self.library == "pcbench"


@dataclass(frozen=True)
class MissingMethod:
    """A method that was left out, and the reason in one line."""

    name: str
    reason: str


@dataclass(frozen=True)
class Cell:
    """One run, and what it cost; the cells of each subject add its result.

    Attributes:
        scene: name of the scene.
        ladder: name of the ladder.
        level: level of the ladder.
        second: second coordinate, if the ladder is a map.
        method: name of the method.
        seed: seed of the run.
        outcome: outcome, of `OUTCOMES`.
        codes: codes of all warnings.
        message: reason of a refusal or a crash, in one line; otherwise empty.
        cpu_s: CPU seconds; None after a crash or a time-out.
        memory_bytes: peak of the memory of the run beyond that of the loaded clouds; None if unknown.
    """

    scene: str
    ladder: str
    level: float
    second: float | None
    method: str
    seed: int
    outcome: str
    codes: tuple[str, ...] = ()
    message: str = ""
    cpu_s: float | None = None
    memory_bytes: int | None = None

    @property
    def place(self) -> tuple[str, str, float, float | None, int]:
        """Scene, ladder, level, second coordinate and seed: the same for all methods."""
        return (self.scene, self.ladder, self.level, self.second, self.seed)


@dataclass(frozen=True)
class RegistrationCell(Cell):
    """Result of one registration.

    Attributes:
        error: mean of |p - p'| / |p - centroid| over the candidate's points (Fontana et al. 2021), without unit; None
            without a pose.
        error_rms: root mean square of |p - p'|, in the clouds' unit.
        angle_error_deg: angle of the rotation error, in degrees.
        offset_error: displacement of the candidate's centroid, in the clouds' unit.
        tolerance: largest `error_rms` of a right pose, in the clouds' unit.
        start_error: mean of |p - p'| / |p - centroid| of the start.
        doubtful: whether the method says that the pose may be wrong.
        warned: whether any warning stands that does not make the pose doubtful.
    """

    error: float | None = None
    error_rms: float | None = None
    angle_error_deg: float | None = None
    offset_error: float | None = None
    tolerance: float = math.nan
    start_error: float = math.nan
    doubtful: bool = False
    warned: bool = False

    @property
    def pose_is_right(self) -> bool:
        """Return whether there is a pose within the tolerance."""
        return self.error_rms is not None and self.error_rms <= self.tolerance

    def meets(self, preset: Preset) -> bool:
        """Return whether the pose meets a benchmark's criterion; its lengths are metres."""
        if self.offset_error is None or self.angle_error_deg is None:
            return False
        return self.offset_error <= preset.offset and self.angle_error_deg <= preset.angle_deg


@dataclass(frozen=True)
class MetricCell(Cell):
    """Result of one metric.

    A value within 10 % of the exact one is right. Any other is said if the exact value lies in its interval, or below
    it by at most the sampling floor, which states how much the point spacing may add; otherwise it is silent.

    Attributes:
        metric: name of the metric, such as `RMS off the surface`.
        value: measured value, in the clouds' unit.
        exact: exact value, from the distances to the true surface, in the clouds' unit.
        floor: sampling floor; None if the method has none.
        interval: 95 % confidence interval of `value`; None if the method has none.
    """

    metric: str = ""
    value: float | None = None
    exact: float = math.nan
    floor: float | None = None
    interval: tuple[float, float] | None = None

    @property
    def ratio(self) -> float | None:
        """Value over exact value; None without a value."""
        return None if self.value is None or not self.exact > 0 else self.value / self.exact

    @property
    def covers(self) -> bool | None:
        """Return whether the interval contains the exact value; None without an interval.

        It is None also where the floor exceeds 30 % of the value: an interval covers random errors, not the spacing.
        """
        if self.interval is None or self.value is None or (self.floor or 0.0) > MAX_FLOOR_SHARE * self.value:
            return None
        return self.interval[0] <= self.exact <= self.interval[1]


@dataclass(frozen=True)
class VerdictCell(Cell):
    """Result of one verdict on a deformation.

    Attributes:
        failure: one of `FAILURES`, or empty.
        verdict: verdict: none, similarity, affine, non-affine or undecided; empty after a crash.
        true_rms: true RMS of the deformation along the normals beyond an affine one, in the clouds' unit.
        noise: standard deviation of the difference of both clouds along the normals, in the clouds' unit.
        rms: measured RMS of the deformation over the surface; None if the verdict has none.
        interval: 95 % confidence interval of `rms`; None if the verdict has none.
        limit: RMS of the smallest deformation that would have been stated; None if not stated.
        pose_is_right: whether the pose that it stands on is right.
    """

    failure: str = ""
    verdict: str = ""
    true_rms: float = 0.0
    noise: float = math.nan
    rms: float | None = None
    interval: tuple[float, float] | None = None
    limit: float | None = None
    pose_is_right: bool = True

    @property
    def size_in_noise(self) -> float:
        """True RMS of the deformation over the noise."""
        return self.true_rms / self.noise

    @property
    def is_deformed(self) -> bool:
        """Return whether the true deformation is so large that it has to be found."""
        return self.true_rms > MIN_COUNTED_SIZE * self.noise

    @property
    def ratio(self) -> float | None:
        """Measured over true RMS; None without a size, or if nothing is deformed."""
        return None if self.rms is None or not self.true_rms > 0 else self.rms / self.true_rms

    @property
    def covers(self) -> bool | None:
        """Return whether the interval contains the true RMS; None without an interval."""
        return None if self.interval is None else self.interval[0] <= self.true_rms <= self.interval[1]


@dataclass(frozen=True)
class ChangeCell(Cell):
    """Result of one search for changes.

    Attributes:
        kinds: kinds of the true change that are right; empty if nothing changed.
        points: number of points of both clouds that belong to it.
        named: kinds of the changes that are reported at its place, the one with the most points first.
        elsewhere: number of changes that are reported elsewhere.
        true_size: length by which it moved, in the clouds' unit; None if it did not.
        size: length of the motion that is reported for it; None if there is none.
        noise: standard deviation of the difference of both clouds along the normals, in the clouds' unit.
    """

    kinds: tuple[str, ...] = ()
    points: int = 0
    named: tuple[str, ...] = ()
    elsewhere: int = 0
    true_size: float | None = None
    size: float | None = None
    noise: float = math.nan

    @property
    def has_to_be_named(self) -> bool:
        """Return whether the change is so large that it has to be reported."""
        is_far = self.true_size is None or self.true_size >= MIN_CHANGE_SIZE * self.noise
        return bool(self.kinds) and is_far and self.points >= MIN_CHANGE_POINTS


@dataclass(frozen=True)
class ReconstructionCell(Cell):
    """Result of one reconstruction; lengths are in metres.

    Attributes:
        fscore: F-score over the surface that three cameras of the unperturbed scene saw; None without a measured cloud.
        standard: F-score of the unperturbed run of the same method and seed; None if it has none.
        precision: share of the points within the threshold of the true surface.
        recall: share of that surface with a point within the threshold.
        threshold: the threshold.
        rms: root mean square distance from the points to the true surface.
        points: number of points; None without a cloud.
        cameras: number of images whose camera the reconstructor returned.
        images: number of images that it got.
        registration: how the cloud was registered to the truth: `none`, `cameras` or a method of `compare`.
        notes: notes of the reconstructor.
        wall_s: wall time of the reconstruction, in seconds; None if unknown.
    """

    fscore: float | None = None
    standard: float | None = None
    precision: float | None = None
    recall: float | None = None
    threshold: float | None = None
    rms: float | None = None
    points: int | None = None
    cameras: int | None = None
    images: int | None = None
    registration: str = ""
    notes: tuple[str, ...] = ()
    wall_s: float | None = None

    @property
    def warns(self) -> bool:
        """Return whether the reconstructor says that its result may be wrong."""
        return any(note.startswith(WARNING_PREFIX) for note in self.notes)

    @property
    def is_good(self) -> bool:
        """Return whether the F-score is at least half that of the unperturbed run."""
        return (
            self.fscore is not None
            and self.standard is not None
            and self.standard > 0
            and self.fscore >= MIN_SCORE_SHARE * self.standard
        )


@dataclass(frozen=True)
class Rate:
    """A share of runs with its 95 % Wilson interval.

    Attributes:
        count: number of runs that are counted.
        total: number of all runs.
    """

    count: int
    total: int

    @property
    def share(self) -> float:
        """Count over total; NaN without runs."""
        return self.count / self.total if self.total else math.nan

    @property
    def interval(self) -> tuple[float, float]:
        """95 % Wilson score interval of the share; 0 to 1 without runs."""
        if not self.total:
            return 0.0, 1.0
        n, p = self.total, self.share
        centre, spread = p + _Z**2 / (2 * n), _Z * math.sqrt(p * (1 - p) / n + _Z**2 / (4 * n**2))
        low, high = (centre - spread) / (1 + _Z**2 / n), (centre + spread) / (1 + _Z**2 / n)
        return (0.0 if self.count == 0 else low, 1.0 if self.count == n else high)


@dataclass(frozen=True)
class Tally:
    """Outcomes of a group of cells.

    Attributes:
        counts: number of cells by outcome; outcomes that do not occur are absent.
        total: number of cells.
        cpu_s: median of the CPU seconds; None if none is known.
        memory_bytes: largest peak of memory; None if none is known.
    """

    counts: Mapping[str, int]
    total: int
    cpu_s: float | None
    memory_bytes: int | None

    @classmethod
    def of(cls, cells: Iterable[Cell]) -> Tally:
        """Count the outcomes of cells."""
        group = list(cells)
        counts: dict[str, int] = {}
        for cell in group:
            counts[cell.outcome] = counts.get(cell.outcome, 0) + 1
        times = [cell.cpu_s for cell in group if cell.cpu_s is not None]
        peaks = [cell.memory_bytes for cell in group if cell.memory_bytes is not None]
        return cls(counts, len(group), median(times) if times else None, max(peaks, default=None))

    def rate(self, *outcomes: str) -> Rate:
        """Return the share of the cells with any of these outcomes."""
        return Rate(sum(self.counts.get(outcome, 0) for outcome in outcomes), self.total)

    @property
    def pose_right(self) -> Rate:
        """Share of registrations whose pose is right, doubted or not."""
        return self.rate(RIGHT, FALSE_ALARM)


_AnyCell = TypeVar("_AnyCell", bound=Cell)


def grouped(cells: Iterable[_AnyCell], key: Callable[[_AnyCell], _Key]) -> dict[_Key, list[_AnyCell]]:
    """Return cells in groups, in the order in which their keys first occur."""
    groups: dict[_Key, list[_AnyCell]] = {}
    for cell in cells:
        groups.setdefault(key(cell), []).append(cell)
    return groups


@dataclass(frozen=True)
class SilentFailure:
    """One of the worst silent failures, with the clouds for its picture.

    Attributes:
        cell: the registration; `error` is its size.
        file: file name in the folder of the study, an .npz with the arrays `reference`, `found` and `true`: (N, 3)
            points of the reference, and of the candidate under the found and the true pose.
    """

    cell: RegistrationCell
    file: str


@dataclass(frozen=True)
class StressStudy:
    """Results of a stress study.

    Attributes:
        settings: settings of the run.
        scenes: scenes of the run.
        ladders: ladders of the run, each with the levels that were run.
        methods: methods of the run.
        missing: methods that were left out.
        registrations: one per registration.
        metrics: one per metric and run.
        verdicts: one per verdict.
        changes: one per search for changes.
        reconstructions: one per reconstruction.
        photographs: the photographs of the reconstructions; None without any.
        worst: up to three silent failures with the largest error, from different ladders if possible.
        sentences: conclusions, computed from the cells.
        provenance: versions, machine and seed.
    """

    settings: StressSettings
    scenes: tuple[SceneInfo, ...]
    ladders: tuple[LadderInfo, ...]
    methods: tuple[MethodInfo, ...]
    missing: tuple[MissingMethod, ...] = ()
    registrations: tuple[RegistrationCell, ...] = ()
    metrics: tuple[MetricCell, ...] = ()
    verdicts: tuple[VerdictCell, ...] = ()
    changes: tuple[ChangeCell, ...] = ()
    reconstructions: tuple[ReconstructionCell, ...] = ()
    photographs: PhotographInfo | None = None
    worst: tuple[SilentFailure, ...] = ()
    sentences: tuple[str, ...] = ()
    provenance: Mapping[str, Any] | None = field(default=None, compare=False)

    def cells(self, subject: str) -> Sequence[Cell]:
        """Return the cells of a subject."""
        by_subject: Mapping[str, Sequence[Cell]] = {
            REGISTRATION: self.registrations,
            METRICS: self.metrics,
            VERDICTS: self.verdicts,
            CHANGES: self.changes,
            RECONSTRUCTION: self.reconstructions,
        }
        return by_subject[subject]

    def ladder(self, name: str) -> LadderInfo:
        """Return a ladder by its name."""
        return next(ladder for ladder in self.ladders if ladder.name == name)

    def method(self, name: str, subject: str) -> MethodInfo:
        """Return a method by its name."""
        return next(method for method in self.methods if (method.name, method.subject) == (name, subject))

    def methods_of(self, subject: str) -> tuple[MethodInfo, ...]:
        """Return the methods of a subject that have cells: ours first."""
        present = {cell.method for cell in self.cells(subject)}
        found = [method for method in self.methods if method.subject == subject and method.name in present]
        return tuple(sorted(found, key=lambda method: not method.is_ours))

    def ladders_of(self, subject: str) -> tuple[LadderInfo, ...]:
        """Return the ladders that have cells of a subject."""
        present = {cell.ladder for cell in self.cells(subject)}
        return tuple(ladder for ladder in self.ladders if ladder.name in present)

    def tallies(self, subject: str) -> dict[tuple[str, str, float, float | None], Tally]:
        """Return the outcomes by (method, ladder, level, second coordinate)."""
        groups = grouped(self.cells(subject), lambda cell: (cell.method, cell.ladder, cell.level, cell.second))
        return {key: Tally.of(cells) for key, cells in groups.items()}


KIND = StudyKind("stress", DOCUMENT, SCHEMA, StressStudy, "stress.md")


def registration_cell(values: Mapping[str, Any]) -> RegistrationCell:
    """Return the cell of a row of stress.json."""
    return RegistrationCell(**_numbers(_tuples(values), "tolerance", "start_error"))


def metric_cell(values: Mapping[str, Any]) -> MetricCell:
    """Return the cell of a row of stress.json."""
    return MetricCell(**_numbers(_tuples(values), "exact"))


def verdict_cell(values: Mapping[str, Any]) -> VerdictCell:
    """Return the cell of a row of stress.json."""
    return VerdictCell(**_numbers(_tuples(values), "noise"))


def change_cell(values: Mapping[str, Any]) -> ChangeCell:
    """Return the cell of a row of stress.json."""
    return ChangeCell(**_numbers(_tuples(values), "noise"))


def reconstruction_cell(values: Mapping[str, Any]) -> ReconstructionCell:
    """Return the cell of a row of stress.json."""
    return ReconstructionCell(**_tuples(values))


def _tuples(values: Mapping[str, Any]) -> dict[str, Any]:
    return {key: tuple(value) if isinstance(value, list) else value for key, value in values.items()}


def _numbers(values: Mapping[str, Any], *names: str) -> dict[str, Any]:
    """Return values with NaN for unknown numbers, which JSON writes as null."""
    return {key: math.nan if key in names and value is None else value for key, value in values.items()}
