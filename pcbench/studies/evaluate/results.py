"""Result types of an evaluation; their fields are the keys of evaluate.json and of each pair's evaluation.json."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from typing import Any, Literal, NamedTuple

from pcbench.extras import require
from pcbench.measure.protocols.protocol import Better
from pcbench.studies.frame.folder import StudyKind

Status = Literal["ok", "missing", "failed"]
OK: Status = "ok"
MISSING: Status = "missing"
FAILED: Status = "failed"


@dataclass(frozen=True)
class EvaluateSettings:
    """Settings of an evaluation.

    Attributes:
        protocol: protocol with its settings, as on the command line.
        protocol_data: folder with files of the benchmark; None: there is none.
        columns: names of the scores in tables and in the answer; none: all.
        seed: seed of random samples and orders, and of the bootstrap.
        workers: number of pairs at the same time; None: as many as CPUs.
        cluster: address of a Dask scheduler, or its scheduler file; None: processes on this machine.
        metrics: user-defined metrics, as for `pcbench compare --metric`, which only the protocol `pcbench` computes.
    """

    protocol: str = "pcbench"
    protocol_data: str | None = None
    columns: tuple[str, ...] = ()
    seed: int = 0
    workers: int | None = None
    cluster: str | None = None
    metrics: tuple[str, ...] = ()


@dataclass(frozen=True)
class ProtocolInfo:
    """The protocol of an evaluation.

    Attributes:
        text: as on the command line, with the settings that differ from the official ones.
        title: name of the benchmark, for people.
        citation: paper that defines it.
        version: official program whose numbers it reproduces.
        settings: all its settings by name, as text.
    """

    text: str
    title: str
    citation: str
    version: str
    settings: Mapping[str, str]


@dataclass(frozen=True)
class ScoreColumn:
    """A score of the protocol: its name, its unit, and whether lower or higher is better; None: neither."""

    name: str
    unit: str = ""
    better: Better | None = "lower"

    @property
    def title(self) -> str:
        """Name with the unit in brackets, if there is one."""
        return f"{self.name} [{self.unit}]" if self.unit else self.name


@dataclass(frozen=True)
class PairEvaluation:
    """The evaluation of one candidate.

    Attributes:
        scene: name of the scene.
        method: name of the method.
        status: `ok`; `missing` if a file is; `failed` if it could not be evaluated.
        message: why it has no scores; empty if it has.
        scores: scores by name; None: a score is undefined for this pair.
        reference: path of the ground truth.
        candidate: path of the reconstruction.
        register: how its pose was determined.
        crop: region to which the evaluation was limited.
        seconds: time that the method took, if it was given.
        evaluation_s: time that the evaluation took.
        counts: numbers of points and other intermediate values by name.
        notes: what a reader of the scores has to know.
        folder: folder with its own report, relative to that of the evaluation; empty if there is none.
        failed_metrics: names of user-defined metrics that failed; notes say why.
    """

    scene: str
    method: str
    status: Status
    message: str = ""
    scores: Mapping[str, float | None] = field(default_factory=dict)
    reference: str = ""
    candidate: str = ""
    register: str = "none"
    crop: str = "none"
    seconds: float | None = None
    evaluation_s: float | None = None
    counts: Mapping[str, float | None] = field(default_factory=dict)
    notes: tuple[str, ...] = ()
    folder: str = ""
    failed_metrics: tuple[str, ...] = ()


@dataclass(frozen=True)
class PairRecord:
    """A pair's own document `evaluation.json`: its evaluation, and what its numbers are.

    Attributes:
        pair: the evaluation.
        protocol: the protocol as on the command line.
        columns: the scores of the protocol.
        count_columns: its counts.
        schema: schema of the document.
    """

    pair: PairEvaluation
    protocol: str
    columns: tuple[ScoreColumn, ...] = ()
    count_columns: tuple[ScoreColumn, ...] = ()
    schema: str = "pcbench.evaluation/1"


@dataclass(frozen=True)
class MethodMean:
    """The mean of a score of a method over the scenes for which all methods have this score.

    Attributes:
        method: name of the method.
        score: name of the score.
        mean: its mean; None if there is no such scene.
        scenes: number of these scenes.
        rank: 1 for the best mean; equal means have the same rank. None for scores of which none is better.
        mean_rank: mean over the scenes of its rank in the scene.
        difference: mean over the scenes of its difference to the method with the best mean; None for this method.
        low: lower end of the interval of the difference.
        high: upper end; both are None if there are too few scenes.
        differs: whether the interval excludes zero; None without an interval.
    """

    method: str
    score: str
    mean: float | None
    scenes: int
    rank: int | None = None
    mean_rank: float | None = None
    difference: float | None = None
    low: float | None = None
    high: float | None = None
    differs: bool | None = None


class ScoreRow(NamedTuple):
    """A row of evaluate.csv: one score of one pair; a pair without scores has one row without a value."""

    scene: str
    method: str
    score: str
    value: float | None
    unit: str
    better: str
    status: str
    message: str
    seconds: float | None
    evaluation_s: float | None


@dataclass(frozen=True)
class MethodComparison:
    """Methods on scenes, evaluated by one protocol.

    Attributes:
        settings: settings.
        protocol: the protocol.
        columns: its scores, in its order.
        scenes: names of the scenes.
        methods: names of the methods.
        pairs: the evaluation of each pair, by scene and method.
        means: means over scenes of each score and method.
        level: probability with which the intervals of all pairs of methods hold together, for each score.
        sentences: the answer in words.
        warnings: what not to trust.
        provenance: version, commit, machine and time.
    """

    settings: EvaluateSettings
    protocol: ProtocolInfo
    columns: tuple[ScoreColumn, ...]
    scenes: tuple[str, ...]
    methods: tuple[str, ...]
    pairs: tuple[PairEvaluation, ...]
    means: tuple[MethodMean, ...] = ()
    level: float = 0.95
    sentences: tuple[str, ...] = ()
    warnings: tuple[str, ...] = ()
    provenance: Mapping[str, Any] | None = field(default=None, compare=False)

    @property
    def is_complete(self) -> bool:
        """Return whether all pairs have scores."""
        return all(pair.status == OK for pair in self.pairs)

    @property
    def chosen_columns(self) -> tuple[ScoreColumn, ...]:
        """Scores of tables and of the answer: those of `settings.columns`, in this order, or all."""
        by_name = {column.name: column for column in self.columns}
        return tuple(by_name[name] for name in self.settings.columns) or self.columns

    def pair(self, scene: str, method: str) -> PairEvaluation | None:
        """Return the evaluation of a method on a scene; None if there is none."""
        return next((pair for pair in self.pairs if (pair.scene, pair.method) == (scene, method)), None)

    def means_of(self, score: str) -> tuple[MethodMean, ...]:
        """Return the means of a score, in the order of the methods."""
        return tuple(mean for mean in self.means if mean.score == score)

    def rows(self) -> Iterator[ScoreRow]:
        """Yield each score of each pair."""
        for pair in self.pairs:
            rest = (pair.status, pair.message, pair.seconds, pair.evaluation_s)
            if not pair.scores:
                yield ScoreRow(pair.scene, pair.method, "", None, "", "", *rest)
            for column in self.columns if pair.scores else ():
                value = pair.scores.get(column.name)
                yield ScoreRow(pair.scene, pair.method, column.name, value, column.unit, column.better or "", *rest)

    def table(self) -> Any:
        """Return each score of each pair as a tidy `pandas.DataFrame`.

        Raises:
            MissingExtra: pandas is not installed.
        """
        return require("pandas").DataFrame(list(self.rows()), columns=list(ScoreRow._fields))

    def means_table(self) -> Any:
        """Return the means over scenes, with ranks and intervals of differences, as a tidy `pandas.DataFrame`.

        Raises:
            MissingExtra: pandas is not installed.
        """
        return require("pandas").DataFrame([vars(mean) for mean in self.means])


KIND = StudyKind("evaluate", "evaluate.json", "pcbench.evaluate/1", MethodComparison, "evaluate.md")
