"""Registrations: is the pose right, and does the method say so if it is not?"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from pcbench.geometry.arrays import FloatArray
from pcbench.registration import register
from pcbench.registration.result import SCALE_MISSING, UNOBSERVABLE, WEAKLY_OBSERVABLE
from pcbench.studies.stress.methods import METHODS, PoseResult
from pcbench.studies.stress.scenes import StressPair
from pcbench.studies.stress.subject import (
    COST_LEGEND,
    ENDS,
    FALSE_ALARM,
    GLOBAL,
    REFUSED,
    RIGHT,
    SAID,
    SILENT,
    Group,
    Outcome,
    PairSubject,
    RunResult,
    StressCell,
)

_UNOBSERVABLE_CODES = {UNOBSERVABLE, WEAKLY_OBSERVABLE}


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
class RegistrationCell(StressCell):
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


def _judge(answer: PoseResult, pair: StressPair, values: Mapping[str, Any]) -> RunResult:
    """Compare a pose with the true one."""
    common = {
        **values,
        "codes": answer.codes,
        "message": answer.message,
        "tolerance": pair.tolerance,
        "start_error": float(_relative_error(pair.candidate, pair.points)),
        "doubtful": answer.doubtful,
        "warned": bool(answer.codes) and not answer.doubtful,
    }
    T = answer.T_reference_candidate
    if T is None:
        return RunResult((RegistrationCell(**common, outcome=SAID if pair.free else REFUSED),))
    aligned = T.apply(pair.candidate)
    rms = float(np.sqrt(np.square(aligned - pair.points).sum(axis=1).mean()))
    centre = pair.candidate.mean(axis=0)
    wrong = T @ pair.T_true.inverse()
    offset = T.apply(centre[None])[0] - pair.T_true.apply(centre[None])[0]
    cell = RegistrationCell(
        **common,
        outcome=_outcome(rms <= pair.tolerance, answer, pair),
        error=_relative_error(aligned, pair.points),
        error_rms=rms,
        angle_error_deg=float(wrong.motion_at(np.zeros(3)).angle_deg),
        offset_error=float(np.linalg.norm(offset)),
    )
    return RunResult((cell,), T.matrix.tolist())


def _outcome(right: bool, answer: PoseResult, pair: StressPair) -> str:
    """Return the outcome of a pose; a warning that names what is wrong counts as doubt.

    Where the geometry leaves motions free, the method has to name them. Where the scales differ, a method that does not
    solve for the scale has to say so.
    """
    if right:
        return FALSE_ALARM if answer.doubtful else RIGHT
    codes = set(answer.codes)
    named = (pair.free and codes & _UNOBSERVABLE_CODES) or (pair.T_true.scale != 1 and SCALE_MISSING in codes)
    return SAID if answer.doubtful or named else SILENT


def _relative_error(aligned: FloatArray, truth: FloatArray) -> float:
    """Return the mean of |p - p'| / |p - centroid| (Fontana et al. 2021)."""
    radii = np.linalg.norm(truth - truth.mean(axis=0), axis=1)
    inside = radii > 1e-3 * radii.max()  # a point at the centroid has no relative error
    return float((np.linalg.norm(aligned - truth, axis=1)[inside] / radii[inside]).mean())


def settle_refusals(cells: Sequence[RegistrationCell]) -> list[RegistrationCell]:
    """Return the cells with each refusal as `refused`, or as `said` if no other method found the pose either.

    The other method has to find it from the same clouds, and for a method that starts from the given pose from that.
    """
    solved = {(cell.place, METHODS[cell.method].scope) for cell in cells if cell.outcome in (RIGHT, FALSE_ALARM)}
    anywhere = {place for place, _ in solved}

    def is_findable(cell: RegistrationCell) -> bool:
        scope = METHODS[cell.method].scope
        return cell.place in anywhere if scope == GLOBAL else (cell.place, scope) in solved

    return [replace(c, outcome=SAID) if c.outcome == REFUSED and not is_findable(c) else c for c in cells]


REGISTRATION = PairSubject(
    name="registration",
    title="Registration",
    noun="registration",
    key="registrations",
    cell=RegistrationCell,
    outcomes=(
        Outcome(RIGHT, "right", Group.SUCCESS),
        Outcome(FALSE_ALARM, "right, but doubted", Group.SUCCESS),
        Outcome(REFUSED, "refused, though findable", Group.SAID_SO),
        Outcome(SAID, "wrong and said so", Group.SAID_SO),
        Outcome(SILENT, "silently wrong", Group.CONFIDENT),
        *ENDS,
    ),
    legend="false-alarm: right, but doubted; refused: no pose, although another method found one; said: wrong and"
    f" doubted; silent: wrong but not doubted; {COST_LEGEND}",
    success="right poses [% of runs]",
    charts=("outcomes", "matrix", "recall", "basin", "profiles", "speed", "severity"),
    methods=METHODS,
    ask=lambda method, pair, seed: METHODS[method].run(pair.reference, pair.candidate, seed),
    judge=_judge,
    warm_up=lambda pair: register(pair.reference, pair.points),
    needs_scene=False,
    start=(5.0, 0.02),
    settle=settle_refusals,
)
