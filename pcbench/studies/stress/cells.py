"""The plan of runs, and one run: build the pair of a level, ask the method, and compare its answer with the truth.

One run gives one cell of a registration, one cell for each metric, and one cell for each rule of verdict.
"""

from __future__ import annotations

import os
import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np

from pcbench.deformation.parts import round_to_six_digits
from pcbench.errors import MissingExtra
from pcbench.geometry.transform import Similarity
from pcbench.scratch import atomic_write
from pcbench.studies.stress.ladders import LADDERS, Ladder, displaced
from pcbench.studies.stress.scenes import GIVEN, SCENES, SHAPES, WOODED, StressPair, degenerate_pair, scene_pair
from pcbench.studies.stress.subject import CRASH, LOCAL, RunResult
from pcbench.studies.stress.subjects import PAIR_SUBJECTS
from pcbench.studies.stress.surfaces import DEGENERATE
from pcbench.systems import peak_memory_since_reset, reset_peak_memory

RECORDS = "runs"  # folder of the records of a study


@dataclass(frozen=True)
class RunPlan:
    """One run of the plan.

    Attributes:
        subject: name of the subject.
        scene: name of the scene.
        ladder: name of the ladder.
        level: level of the ladder.
        second: second coordinate, if the ladder is a map.
        method: name of the method; where one run gives the cells of all methods, the first of them.
        seed: seed of the run.
        points: number of points of the reference.
    """

    subject: str
    scene: str
    ladder: str
    level: float
    second: float | None
    method: str
    seed: int
    points: int

    @property
    def pair(self) -> tuple[str, str, str, float, float | None, int]:
        """Identifier of its pair of clouds, which the runs of all methods share."""
        return (self.subject, self.scene, self.ladder, self.level, self.second, self.seed)

    @property
    def shared_values(self) -> dict[str, Any]:
        """Values that its cells share."""
        names = ("scene", "ladder", "level", "second", "seed")
        return {name: getattr(self, name) for name in names}

    @property
    def stem(self) -> str:
        """File name of its record, without extension."""
        level = f"{self.level:g}" if self.second is None else f"{self.level:g}x{self.second:g}"
        parts = (self.subject, self.ladder, level, self.scene, self.method, str(self.seed))
        return "_".join("".join(c if c.isalnum() or c in ".-" else "-" for c in part) for part in parts)

    def record(self, out: Path) -> Path:
        """Return the path of its record in the folder of a study."""
        return out / RECORDS / f"{self.stem}.json"


def plan_runs(
    ladders: Sequence[Ladder],
    methods: Mapping[str, Sequence[str]],
    *,
    quick: bool,
    seeds: range,
    points: int,
    given: StressPair | None,
) -> Iterator[RunPlan]:
    """Yield all runs of a study.

    Args:
        ladders: ladders to run.
        methods: names of the methods by the name of their subject.
        quick: whether to run the levels of the quick plan, on the first scene only.
        seeds: seeds of the runs.
        points: number of points of the reference.
        given: given pair, or None for the built-in scenes; it has no exact surface, so registrations alone can be
            judged, and may have no vegetation.
    """
    for subject in PAIR_SUBJECTS.values():
        if given is not None and subject.needs_scene:
            continue
        for ladder in ladders:
            if subject not in ladder.subjects or (given is not None and not ladder.applies_to(given)):
                continue
            info = ladder.info(quick=quick)
            names = methods[subject.name][: 1 if subject.is_joint else None]
            if ladder.needs_start:
                names = [name for name in names if subject.methods[name].scope == LOCAL]
            for scene in _scenes(ladder, quick=quick, given=given is not None):
                for seed in seeds:
                    for level in info.levels:
                        for second in info.second_levels or (None,):
                            for name in names:
                                yield RunPlan(subject.name, scene, ladder.name, level, second, name, seed, points)


def build_pair(plan: RunPlan, given: StressPair | None = None) -> StressPair:
    """Return the perturbed pair of a run; the same plan gives the same pair.

    The random numbers do not depend on the level: along a ladder the severity alone changes.
    """
    ladder = LADDERS[plan.ladder]
    if plan.scene == GIVEN:
        assert given is not None
        pair = given
    elif ladder.sets_shape:
        pair = degenerate_pair(list(DEGENERATE)[int(plan.level)], plan.seed, plan.points)
    else:
        pair = _scene(plan.scene, plan.seed, plan.points)
    rng = np.random.default_rng([plan.seed, *plan.ladder.encode(), *plan.scene.encode()])
    perturbed = ladder.apply(pair, plan.level, plan.second, rng)
    start = PAIR_SUBJECTS[plan.subject].start
    if ladder.sets_start or start is None:
        return perturbed
    angle_deg, share = start
    return displaced(
        perturbed, angle_deg, share * pair.extent, np.random.default_rng([plan.seed, *plan.scene.encode()])
    )


def run_cell(plan: RunPlan, pair: StressPair) -> RunResult:
    """Ask a method about a pair and judge its answer; an exception of the method is a crash.

    Numbers are rounded to six digits: further ones depend on the order in which threads add.

    Raises:
        MissingExtra: an optional library cannot be loaded.
    """
    subject = PAIR_SUBJECTS[plan.subject]
    start_memory = reset_peak_memory()
    start = _cpu_seconds()
    try:
        answer = subject.ask(plan.method, pair, plan.seed)
        peak = peak_memory_since_reset()
        memory = None if start_memory is None or peak is None else max(0, peak - start_memory)
        cost = {"cpu_s": _cpu_seconds() - start, "memory_bytes": memory}
        result = subject.judge(answer, pair, {**plan.shared_values, "method": plan.method, **cost})
    except MissingExtra:
        raise
    except Exception as error:
        text = " ".join(str(error).split())
        return failed_run(plan, CRASH, f"{type(error).__name__}: {text}")
    return replace(result, cells=round_to_six_digits(result.cells))


def failed_run(plan: RunPlan, outcome: str, message: str) -> RunResult:
    """Return the cells of a run that ended in a crash or a time-out."""
    subject = PAIR_SUBJECTS[plan.subject]
    end = {**plan.shared_values, "outcome": outcome, "message": message}
    return RunResult(tuple(subject.cell(**end, **names) for names in subject.cells_of(plan.method)))


def save_pair(path: Path, pair: StressPair) -> None:
    """Save a given pair for the child processes."""
    with atomic_write(path) as file:
        np.savez(
            file,
            reference=pair.reference,
            points=pair.points,
            normals=pair.normals,
            sizes=np.array([pair.spacing, pair.extent, pair.noise]),
            pose=pair.T_true.matrix,
            plants=np.zeros(0, np.int64) if pair.plants is None else pair.plants,
        )


def load_pair(path: Path) -> StressPair:
    """Read a pair that `save_pair` saved."""
    with np.load(path) as arrays:
        spacing, extent, noise = (float(value) for value in arrays["sizes"])
        return StressPair(
            arrays["reference"],
            arrays["points"],
            arrays["normals"],
            spacing,
            extent,
            noise,
            noise,
            Similarity.from_matrix(arrays["pose"]),
            plants=arrays["plants"] if len(arrays["plants"]) else None,
        )


def _scenes(ladder: Ladder, *, quick: bool, given: bool) -> tuple[str, ...]:
    if given:
        return (GIVEN,)
    if ladder.sets_shape:
        return (SHAPES,)
    if ladder.needs_vegetation:
        return (WOODED,)
    return SCENES[:1] if quick else SCENES


@lru_cache(maxsize=1)
def _scene(name: str, seed: int, points: int) -> StressPair:
    return scene_pair(name, seed, points)


def _cpu_seconds() -> float:
    """Return the CPU seconds of this process and of its ended children."""
    times = os.times()
    return time.process_time() + times.children_user + times.children_system
