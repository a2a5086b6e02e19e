"""The plan of runs, and one run: build the pair of a level, call the method, and compare the result with the truth.

One run gives one cell of a registration, one cell for each metric, and one cell for each rule of verdict.
"""

from __future__ import annotations

import os
import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from functools import lru_cache
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from pcbench.deformation.parts import round_to_six_digits
from pcbench.errors import MissingExtra
from pcbench.geometry.arrays import FloatArray
from pcbench.geometry.transform import Similarity
from pcbench.io.files import atomic_write
from pcbench.registration.result import SCALE_MISSING, UNOBSERVABLE, WEAKLY_OBSERVABLE
from pcbench.studies.stress import changes, metrics, verdicts
from pcbench.studies.stress.ladders import LADDERS, Ladder, displaced
from pcbench.studies.stress.methods import METHODS, PoseResult
from pcbench.studies.stress.results import (
    CHANGES,
    CRASH,
    FALSE_ALARM,
    LOCAL,
    METRICS,
    REFUSED,
    REGISTRATION,
    RIGHT,
    SAID,
    SCOPES,
    SILENT,
    SUBJECTS,
    Cell,
    ChangeCell,
    MetricCell,
    RegistrationCell,
    VerdictCell,
)
from pcbench.studies.stress.scenes import GIVEN, SCENES, SHAPES, WOODED, StressPair, degenerate_pair, scene_pair
from pcbench.studies.stress.surfaces import DEGENERATE, FREE
from pcbench.systems import peak_memory_since_reset, reset_peak_memory

# Start of all ladders that set none: angle in degrees, offset over the extent. Verdicts and changes start nearer.
_START_DEG, _START_SHARE = 5.0, 0.02
_VERDICT_START_DEG, _VERDICT_START_SHARE = 1.0, 0.005
_UNOBSERVABLE_CODES = {UNOBSERVABLE, WEAKLY_OBSERVABLE}


@dataclass(frozen=True)
class RunPlan:
    """One run of the plan.

    Attributes:
        subject: subject, of `SUBJECTS`.
        scene: name of the scene.
        ladder: name of the ladder.
        level: level of the ladder.
        second: second coordinate, if the ladder is a map.
        method: name of the method; for verdicts `deform`, whose fits give all rules.
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
    def stem(self) -> str:
        """File name of its record, without extension."""
        level = f"{self.level:g}" if self.second is None else f"{self.level:g}x{self.second:g}"
        parts = (self.subject, self.ladder, level, self.scene, self.method, str(self.seed))
        return "_".join("".join(c if c.isalnum() or c in ".-" else "-" for c in part) for part in parts)


class RunResult(NamedTuple):
    """Cells of a run, and for a registration its pose as a 4x4 matrix."""

    cells: tuple[Cell, ...]
    pose: list[list[float]] | None = None

    def values(self) -> dict[str, Any]:
        """Return the values of a record."""
        return {"cells": [asdict(cell) for cell in self.cells], "pose": self.pose}


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
        methods: names of the methods by subject.
        quick: whether to run the levels of the quick plan, on the first scene only.
        seeds: seeds of the runs.
        points: number of points of the reference.
        given: given pair, or None for the built-in scenes; it has no exact surface, so registrations alone can be
            judged, and may have no vegetation.
    """
    for subject in SUBJECTS if given is None else (REGISTRATION,):
        for ladder in ladders:
            if subject not in ladder.subjects or (given is not None and not ladder.applies_to(given)):
                continue
            info = ladder.info(quick=quick)
            names = [
                name for name in methods[subject] if subject != REGISTRATION or METHODS[name].scope in ladder.scopes
            ]
            for scene in _scenes(ladder, quick=quick, given=given is not None):
                for seed in seeds:
                    for level in info.levels:
                        for second in info.second_levels or (None,):
                            for name in names:
                                yield RunPlan(subject, scene, ladder.name, level, second, name, seed, points)


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
    if ladder.sets_start:
        return ladder.apply(pair, plan.level, plan.second, rng)
    if plan.subject == METRICS:
        return ladder.apply(pair, plan.level, plan.second, rng)
    angle, share = (
        (_START_DEG, _START_SHARE) if plan.subject == REGISTRATION else (_VERDICT_START_DEG, _VERDICT_START_SHARE)
    )
    start = np.random.default_rng([plan.seed, *plan.scene.encode()])
    return displaced(ladder.apply(pair, plan.level, plan.second, rng), angle, share * pair.extent, start)


def run_cell(plan: RunPlan, pair: StressPair) -> RunResult:
    """Run a method on a pair and judge its result; an exception of the method is a crash.

    Numbers are rounded to six digits: further ones depend on the order in which threads add.

    Raises:
        MissingExtra: an optional library cannot be loaded.
    """
    start_memory = reset_peak_memory()
    start = _cpu_seconds()
    common: dict[str, Any] = {
        "scene": plan.scene,
        "ladder": plan.ladder,
        "level": plan.level,
        "second": plan.second,
        "seed": plan.seed,
    }

    def cost() -> dict[str, Any]:
        peak = peak_memory_since_reset()
        memory = None if start_memory is None or peak is None else max(0, peak - start_memory)
        return {**common, "cpu_s": _cpu_seconds() - start, "memory_bytes": memory}

    try:
        if plan.subject == REGISTRATION:
            pose = METHODS[plan.method].run(pair.reference, pair.candidate, plan.seed)
            result = _registration(plan, pair, pose, cost())
        elif plan.subject == METRICS:
            measured = metrics.METRIC_METHODS[plan.method].run(pair, plan.seed)
            result = RunResult(tuple(_metrics(plan, pair, measured, cost())))
        elif plan.subject == CHANGES:
            found = changes.CHANGE_METHODS[plan.method].run(pair)
            result = RunResult((_changes(plan, pair, found, cost()),))
        else:
            verdict = verdicts.run_deform(pair, plan.seed)
            result = RunResult(tuple(_verdicts(pair, verdict, cost())))
    except MissingExtra:
        raise
    except Exception as error:
        text = " ".join(str(error).split())
        return failed_run(plan, CRASH, f"{type(error).__name__}: {text}")
    return result._replace(cells=round_to_six_digits(result.cells))


def failed_run(plan: RunPlan, outcome: str, message: str) -> RunResult:
    """Return the cells of a run that ended in a crash or a time-out."""
    common = (plan.scene, plan.ladder, plan.level, plan.second)
    if plan.subject == REGISTRATION:
        return RunResult((RegistrationCell(*common, plan.method, plan.seed, outcome, message=message),))
    if plan.subject == METRICS:
        return RunResult(
            tuple(
                MetricCell(*common, plan.method, plan.seed, outcome, message=message, metric=name)
                for name in metrics.NAMES
            )
        )
    if plan.subject == CHANGES:
        return RunResult((ChangeCell(*common, plan.method, plan.seed, outcome, message=message),))
    return RunResult(
        tuple(VerdictCell(*common, name, plan.seed, outcome, message=message) for name in verdicts.VERDICT_METHODS)
    )


def settle_refusals(cells: Sequence[RegistrationCell]) -> list[RegistrationCell]:
    """Return the cells with each refusal as `refused`, or as `said` if no pose was findable.

    A pose is findable if the geometry determines it, and another method found it from the same clouds. For a method
    that starts from the given pose, this has to be another such method.
    """
    found = {(cell.place, METHODS[cell.method].scope) for cell in cells if cell.outcome in (RIGHT, FALSE_ALARM)}
    return [
        cell if cell.outcome != REFUSED else replace(cell, outcome=REFUSED if _is_findable(cell, found) else SAID)
        for cell in cells
    ]


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


def _is_findable(cell: RegistrationCell, found: set[tuple[Any, str]]) -> bool:
    ladder = LADDERS[cell.ladder]
    if ladder.sets_shape and list(DEGENERATE)[int(cell.level)] in FREE:
        return False
    scopes = (LOCAL,) if METHODS[cell.method].scope == LOCAL else SCOPES
    return any((cell.place, scope) in found for scope in scopes)


def _registration(plan: RunPlan, pair: StressPair, found: PoseResult, cost: dict[str, Any]) -> RunResult:
    values = {
        **cost,
        "method": plan.method,
        "codes": found.codes,
        "message": found.message,
        "tolerance": pair.tolerance,
        "start_error": float(_relative_error(pair.candidate, pair.points)),
        "doubtful": found.doubtful,
        "warned": bool(found.codes) and not found.doubtful,
    }
    T = found.T_reference_candidate
    if T is None:
        return RunResult((RegistrationCell(**values, outcome=REFUSED),))
    aligned = T.apply(pair.candidate)
    rms = float(np.sqrt(np.square(aligned - pair.points).sum(axis=1).mean()))
    centre = pair.candidate.mean(axis=0)
    wrong = T @ pair.T_true.inverse()
    offset = T.apply(centre[None])[0] - pair.T_true.apply(centre[None])[0]
    cell = RegistrationCell(
        **values,
        outcome=_pose_outcome(rms <= pair.tolerance, found, pair),
        error=_relative_error(aligned, pair.points),
        error_rms=rms,
        angle_error_deg=float(wrong.motion_at(np.zeros(3)).angle_deg),
        offset_error=float(np.linalg.norm(offset)),
    )
    return RunResult((cell,), T.matrix.tolist())


def _pose_outcome(right: bool, found: PoseResult, pair: StressPair) -> str:
    """Return the outcome of a pose; a warning that names what is wrong counts as doubt.

    Where the geometry leaves motions free, the method has to name them. Where the scales differ, a method that does not
    solve for the scale has to say so.
    """
    if right:
        return FALSE_ALARM if found.doubtful else RIGHT
    codes = set(found.codes)
    named = (pair.free and codes & _UNOBSERVABLE_CODES) or (pair.T_true.scale != 1 and SCALE_MISSING in codes)
    return SAID if found.doubtful or named else SILENT


def _relative_error(aligned: FloatArray, truth: FloatArray) -> float:
    """Return the mean of |p - p'| / |p - centroid| (Fontana et al. 2021)."""
    radii = np.linalg.norm(truth - truth.mean(axis=0), axis=1)
    inside = radii > 1e-3 * radii.max()  # a point at the centroid has no relative error
    return float((np.linalg.norm(aligned - truth, axis=1)[inside] / radii[inside]).mean())


def _metrics(
    plan: RunPlan, pair: StressPair, measured: Mapping[str, metrics.MeasuredValue], cost: dict[str, Any]
) -> Iterator[MetricCell]:
    exact = metrics.exact_values(pair)
    for name, value in measured.items():
        yield MetricCell(
            **cost,
            method=plan.method,
            outcome=metrics.judge(value, exact[name]),
            metric=name,
            value=value.value,
            exact=exact[name],
            floor=value.floor,
            interval=value.interval,
        )


def _changes(
    plan: RunPlan, pair: StressPair, answer: Sequence[changes.NamedChange], cost: dict[str, Any]
) -> ChangeCell:
    true = pair.change
    there, elsewhere = changes.split_by_place(answer, pair)
    cell = ChangeCell(
        **cost,
        method=plan.method,
        outcome="",
        kinds=() if true is None else true.kinds,
        points=0 if true is None else len(true.points),
        named=tuple(change.kind for change in there),
        elsewhere=len(elsewhere),
        true_size=None if true is None else true.size,
        size=there[0].size if there else None,
        noise=float(np.hypot(pair.noise, pair.candidate_noise)),
    )
    return replace(cell, outcome=changes.judge(cell))


def _verdicts(pair: StressPair, run: verdicts.VerdictRun, cost: dict[str, Any]) -> Iterator[VerdictCell]:
    noise = float(np.hypot(pair.noise, pair.candidate_noise))
    right = False
    if run.pose is not None:
        moved = run.pose.apply(pair.candidate) - pair.points
        right = bool(np.sqrt(np.square(moved).sum(axis=1).mean()) <= pair.tolerance)
    for name, method in verdicts.VERDICT_METHODS.items():
        if run.deformation is None:
            values = verdicts.VerdictValues(verdicts.UNDECIDED, message=run.message)
        else:
            values = method.decide(run.deformation)
        outcome, failure = verdicts.judge(values, pair.true_rms, noise, pose_is_right=right)
        yield VerdictCell(
            **cost,
            method=name,
            outcome=outcome,
            codes=values.codes,
            message=values.message,
            failure=failure,
            verdict=values.verdict,
            true_rms=pair.true_rms,
            noise=noise,
            rms=values.rms,
            interval=values.interval,
            limit=values.limit,
            pose_is_right=right,
        )


def _cpu_seconds() -> float:
    """Return the CPU seconds of this process and of its ended children."""
    times = os.times()
    return time.process_time() + times.children_user + times.children_system
