"""Results of the stress study as types; their fields are the keys of stress.json.

A cell is the result of one run: a scene, a ladder, a level of it, a method and a seed.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from pcbench.studies.frame.folder import StudyKind
from pcbench.studies.stress.changes import ChangeCell
from pcbench.studies.stress.descriptions import LadderInfo, MethodInfo, MissingMethod, PhotographInfo, SceneInfo
from pcbench.studies.stress.metrics import MetricCell
from pcbench.studies.stress.reconstructors.reconstruction import ReconstructionCell
from pcbench.studies.stress.registration import RegistrationCell
from pcbench.studies.stress.subject import C, Subject
from pcbench.studies.stress.subjects import SUBJECTS
from pcbench.studies.stress.verdicts import VerdictCell
from pcbench.tasks import Workers

SCHEMA = "pcbench.stress/1"
DOCUMENT = "stress.json"
RENDERED = "scenes"  # folder of the rendered scenes of a study of reconstructors


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

    def cells(self, subject: Subject[C]) -> tuple[C, ...]:
        """Return the cells of a subject."""
        cells: tuple[C, ...] = getattr(self, subject.key)
        return cells

    def subjects(self) -> list[Subject[Any]]:
        """Return the subjects that have cells."""
        return [subject for subject in SUBJECTS.values() if self.cells(subject)]

    def ladder(self, name: str) -> LadderInfo:
        """Return a ladder by its name."""
        return next(ladder for ladder in self.ladders if ladder.name == name)

    def methods_of(self, subject: Subject[Any]) -> tuple[MethodInfo, ...]:
        """Return the methods of a subject that have cells: ours first."""
        present = {cell.method for cell in self.cells(subject)}
        methods = [method for method in self.methods if method.subject == subject.name and method.name in present]
        return tuple(sorted(methods, key=lambda method: not method.is_ours))

    def ladders_of(self, subject: Subject[Any]) -> tuple[LadderInfo, ...]:
        """Return the ladders that have cells of a subject."""
        present = {cell.ladder for cell in self.cells(subject)}
        return tuple(ladder for ladder in self.ladders if ladder.name in present)


KIND = StudyKind("stress", DOCUMENT, SCHEMA, StressStudy, "stress.md")
