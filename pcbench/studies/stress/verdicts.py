"""Verdicts on deformation: ours, and two naive ones from the same fits, so that the difference shows.

The naive ones choose among the same five models: by the Bayesian information criterion, as if all pairs of points were
independent, and by the smallest error in cross-validation over tiles. Both know neither the noise's correlation nor
the doubt of a pose.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from pcbench.deformation import Deformation, deform
from pcbench.errors import RegistrationError
from pcbench.geometry.transform import Similarity
from pcbench.studies.stress.scenes import StressPair
from pcbench.studies.stress.subject import (
    COST_LEGEND,
    ENDS,
    RIGHT,
    WITHHELD,
    WRONG,
    Group,
    Outcome,
    PairSubject,
    RunResult,
    StressCell,
    StressMethod,
    by_name,
)

DEFORM, NAIVE_BIC, NAIVE_TILES = "deform", "naive BIC", "naive cross-validation"
NON_AFFINE, UNDECIDED = "non-affine", "undecided"
_NAMES = {"rigid": "none", "similarity": "similarity", "affine": "affine"}  # verdicts of the selected models

# Failures of a verdict.
FALSE_BEND = "false-bend"  # non-affine, although nothing is deformed beyond an affine motion
MISSED = "missed"  # not non-affine, although the deformation is larger than the limit beside the verdict
WITHHELD_ALTHOUGH_RIGHT = "withheld-although-right"  # no verdict, although the pose is right

MIN_COUNTED_SIZE = 0.25
"""RMS over the noise above which a deformation has to be found; a smaller one may be."""


@dataclass(frozen=True)
class VerdictCell(StressCell):
    """Result of one verdict on a deformation.

    Attributes:
        failure: `FALSE_BEND`, `MISSED`, `WITHHELD_ALTHOUGH_RIGHT`, or empty.
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
        """Return whether the interval contains the true RMS; None without an interval, or if nothing is deformed."""
        if self.interval is None or not self.true_rms > 0:
            return None
        return self.interval[0] <= self.true_rms <= self.interval[1]


class VerdictValues(NamedTuple):
    """A verdict with its sizes, in the clouds' unit; `limit` is the size above which it would state a deformation."""

    verdict: str
    rms: float | None = None
    interval: tuple[float, float] | None = None
    limit: float | None = None
    codes: tuple[str, ...] = ()
    message: str = ""


class VerdictRun(NamedTuple):
    """The result of `deform`: its pose, or None, its deformation, or None, and the reason of a refusal."""

    pose: Similarity | None
    deformation: Deformation | None
    message: str = ""


def run_deform(pair: StressPair, seed: int) -> VerdictRun:
    """Register a pair and test its deformation, as `pcbench deform` does."""
    try:
        registration, deformation = deform(pair.reference, pair.candidate, "icp", seed=seed)
    except RegistrationError as error:
        return VerdictRun(None, None, " ".join(str(error).split()))
    return VerdictRun(registration.T_reference_candidate, deformation)


def outcome_of(values: VerdictValues, true_rms: float, noise: float, *, pose_is_right: bool) -> tuple[str, str]:
    """Return the outcome of a verdict and the kind of its failure.

    A deformation of up to a quarter of the noise may be found or not: both verdicts are right.

    Args:
        values: the verdict.
        true_rms: true RMS of the deformation along the normals, beyond an affine one.
        noise: standard deviation of the difference of both clouds along the normals.
        pose_is_right: whether the pose below the verdict is right.
    """
    counts = true_rms > MIN_COUNTED_SIZE * noise
    if values.verdict == UNDECIDED:
        return WITHHELD, WITHHELD_ALTHOUGH_RIGHT if pose_is_right else ""
    if values.verdict == NON_AFFINE:
        return (RIGHT, "") if true_rms > 0 else (WRONG, FALSE_BEND)
    if counts and (values.limit is None or true_rms > values.limit):
        return WRONG, MISSED
    return RIGHT, ""


def _ours(deformation: Deformation) -> VerdictValues:
    size = deformation.amplitude if deformation.verdict == NON_AFFINE else None
    return VerdictValues(
        deformation.verdict,
        None if size is None else size.rms_surface,
        None if size is None else size.ci_surface,
        deformation.size_limit,
        tuple(notice.code for notice in deformation.warnings),
    )


def _by_bic(deformation: Deformation) -> VerdictValues:
    """Choose the model by N ln(mean squared residual) + k ln N over all N pairs of points."""
    if not deformation.rungs or not deformation.pairs or deformation.remaining_rms is None:
        return VerdictValues(UNDECIDED)
    selected = next(rung for rung in deformation.rungs if rung.model == deformation.model)
    rigid_mse = deformation.remaining_rms**2 + selected.rms_explained**2
    count = deformation.pairs
    scores = {
        rung.model: count * math.log(max(rigid_mse - rung.rms_explained**2, 1e-300)) + rung.parameters * math.log(count)
        for rung in deformation.rungs
    }
    return _choice(deformation, min(scores, key=lambda model: scores[model]))


def _by_tiles(deformation: Deformation) -> VerdictValues:
    """Choose the model with the smallest squared residual in tiles that were left out of its fit."""
    if not deformation.rungs:
        return VerdictValues(UNDECIDED)
    return _choice(deformation, min(deformation.rungs, key=lambda rung: rung.cv_score).model)


def _choice(deformation: Deformation, model: str) -> VerdictValues:
    explained = {rung.model: rung.rms_explained**2 for rung in deformation.rungs}
    if model in _NAMES:
        return VerdictValues(_NAMES[model])
    return VerdictValues(NON_AFFINE, math.sqrt(max(0.0, explained[model] - explained["affine"])))


VERDICT_METHODS = by_name(
    StressMethod(DEFORM, _ours),
    StressMethod(NAIVE_BIC, _by_bic, "naive"),
    StressMethod(NAIVE_TILES, _by_tiles, "naive"),
)


def _judge(answer: VerdictRun, pair: StressPair, values: Mapping[str, Any]) -> RunResult:
    """Compare the verdict of each rule with the true deformation."""
    noise = float(np.hypot(pair.noise, pair.candidate_noise))
    right = False
    if answer.pose is not None:
        moved = answer.pose.apply(pair.candidate) - pair.points
        right = bool(np.sqrt(np.square(moved).sum(axis=1).mean()) <= pair.tolerance)
    cells = []
    for name, rule in VERDICT_METHODS.items():
        if answer.deformation is None:
            verdict = VerdictValues(UNDECIDED, message=answer.message)
        else:
            verdict = rule.run(answer.deformation)
        outcome, failure = outcome_of(verdict, pair.true_rms, noise, pose_is_right=right)
        cells.append(
            VerdictCell(
                **{**values, "method": name, **verdict._asdict()},
                outcome=outcome,
                failure=failure,
                true_rms=pair.true_rms,
                noise=noise,
                pose_is_right=right,
            )
        )
    return RunResult(tuple(cells))


VERDICTS = PairSubject(
    name="verdicts",
    title="Verdicts on deformation",
    noun="verdict",
    key="verdicts",
    cell=VerdictCell,
    outcomes=(
        Outcome(RIGHT, "right", Group.SUCCESS),
        Outcome(WITHHELD, "withheld", Group.SAID_SO),
        Outcome(WRONG, "wrong with confidence", Group.CONFIDENT),
        *ENDS,
    ),
    legend=f"withheld: no verdict; wrong: contradicts the truth; {COST_LEGEND}, each for all rules together",
    success="right verdicts [% of runs]",
    charts=("outcomes", "matrix", "sizes", "severity"),
    methods=VERDICT_METHODS,
    ask=lambda _, pair, seed: run_deform(pair, seed),
    judge=_judge,
    warm_up=lambda pair: run_deform(pair, 0),
    start=(1.0, 0.005),
    is_joint=True,
    cells_of=lambda _: [{"method": name} for name in VERDICT_METHODS],
)
