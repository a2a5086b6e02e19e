"""Verdicts on deformation: ours, and two naive ones from the same fits, so that the difference shows.

The naive ones choose among the same five models: by the Bayesian information criterion, as if all pairs of points were
independent, and by the smallest error in cross-validation over tiles. Both know neither the noise's correlation nor
the doubt of a pose.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

from pcbench.deformation import Deformation, deform
from pcbench.errors import RegistrationError
from pcbench.extras import installed_versions
from pcbench.geometry.transform import Similarity
from pcbench.studies.stress.results import (
    FALSE_BEND,
    MIN_COUNTED_SIZE,
    MISSED,
    RIGHT,
    VERDICTS,
    WITHHELD,
    WITHHELD_ALTHOUGH_RIGHT,
    WRONG,
    MethodInfo,
)
from pcbench.studies.stress.scenes import StressPair

DEFORM, NAIVE_BIC, NAIVE_TILES = "deform", "naive BIC", "naive cross-validation"
NON_AFFINE, UNDECIDED = "non-affine", "undecided"
_NAMES = {"rigid": "none", "similarity": "similarity", "affine": "affine"}  # verdicts of the selected models


class VerdictValues(NamedTuple):
    """A verdict with its sizes, in the clouds' unit; `limit` is the size above which it would state a deformation."""

    verdict: str
    rms: float | None = None
    interval: tuple[float, float] | None = None
    limit: float | None = None
    codes: tuple[str, ...] = ()
    message: str = ""


@dataclass(frozen=True)
class VerdictMethod:
    """A rule that turns the fits of all models into a verdict."""

    name: str
    decide: Callable[[Deformation], VerdictValues]

    def info(self) -> MethodInfo:
        """Return the description for results; the naive rules are not ours."""
        library = "pcbench" if self.name == DEFORM else "naive"
        return MethodInfo(self.name, VERDICTS, "", library, installed_versions(["pcbench"]).get("pcbench", ""))


class VerdictRun(NamedTuple):
    """The result of `deform`: its pose, or None, its deformation, or None, and the reason of a refusal."""

    pose: Similarity | None
    deformation: Deformation | None
    message: str = ""


def run_deform(pair: StressPair, seed: int) -> VerdictRun:
    """Register a pair and test its deformation, as `pcbench deform` does."""
    try:
        registration, found = deform(pair.reference, pair.candidate, "icp", seed=seed)
    except RegistrationError as error:
        return VerdictRun(None, None, " ".join(str(error).split()))
    return VerdictRun(registration.T_reference_candidate, found)


def judge(values: VerdictValues, true_rms: float, noise: float, *, pose_is_right: bool) -> tuple[str, str]:
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


def _ours(found: Deformation) -> VerdictValues:
    size = found.amplitude if found.verdict == NON_AFFINE else None
    return VerdictValues(
        found.verdict,
        None if size is None else size.rms_surface,
        None if size is None else size.ci_surface,
        found.size_limit,
        tuple(notice.code for notice in found.warnings),
    )


def _by_bic(found: Deformation) -> VerdictValues:
    """Choose the model by N ln(mean squared residual) + k ln N over all N pairs of points."""
    if not found.rungs or not found.pairs or found.remaining_rms is None:
        return VerdictValues(UNDECIDED)
    selected = next(rung for rung in found.rungs if rung.model == found.model)
    rigid_mse = found.remaining_rms**2 + selected.rms_explained**2
    count = found.pairs
    scores = {
        rung.model: count * math.log(max(rigid_mse - rung.rms_explained**2, 1e-300)) + rung.parameters * math.log(count)
        for rung in found.rungs
    }
    return _choice(found, min(scores, key=lambda model: scores[model]))


def _by_tiles(found: Deformation) -> VerdictValues:
    """Choose the model with the smallest squared residual in tiles that were left out of its fit."""
    if not found.rungs:
        return VerdictValues(UNDECIDED)
    return _choice(found, min(found.rungs, key=lambda rung: rung.cv_score).model)


def _choice(found: Deformation, model: str) -> VerdictValues:
    explained = {rung.model: rung.rms_explained**2 for rung in found.rungs}
    if model in _NAMES:
        return VerdictValues(_NAMES[model])
    return VerdictValues(NON_AFFINE, math.sqrt(max(0.0, explained[model] - explained["affine"])))


VERDICT_METHODS = {
    method.name: method
    for method in (
        VerdictMethod(DEFORM, _ours),
        VerdictMethod(NAIVE_BIC, _by_bic),
        VerdictMethod(NAIVE_TILES, _by_tiles),
    )
}
