"""Select the smallest adequate model by tests against the noise, and score all models by cross-validation."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from pcbench.deformation.chi_squares import chi_squares_tail
from pcbench.deformation.model import TILE, Geometry, Noise, Scores, estimate_noise
from pcbench.deformation.parts import Amplitude, ModelScore
from pcbench.deformation.polynomials import MODELS, PARAMETERS
from pcbench.deformation.result import NEGLIGIBLE_SHARE
from pcbench.deformation.size import MAX_P_SIGNIFICANT, amplitude, effective_count, with_systematic_errors
from pcbench.deformation.sums import TileSums, sum_over_tiles
from pcbench.errors import Notice
from pcbench.geometry.arrays import FloatArray

CORRELATED_MISFIT = "correlated-misfit"  # residuals that look like noise of a long correlation
MIN_TILES = 40
_FOLDS = 10
_MAX_P_DOUBTFUL = 1e-3
# Ratio of the standard deviations of correlated and independent noise; at most 1.2 in clouds from photographs that are
# not deformed.
_MAX_CORRELATED_RATIO = 1.5
_MIN_PREDICTION_GAIN = 1.645  # standard errors by which a larger model has to predict better: 5 %, one-sided


class PairEvidence(NamedTuple):
    """Sums over one set of pairs, and the geometry, scores and noise computed from them."""

    sums: TileSums
    geometry: Geometry
    scores: Scores
    noise: Noise

    @classmethod
    def of(cls, sums: TileSums) -> PairEvidence:
        """Return the evidence in sums over pairs."""
        geometry = Geometry(sums)
        scores = Scores(geometry, sums.scores, sums.energy, sums.powers)
        return cls(sums, geometry, scores, estimate_noise(geometry, scores))


class Evidence(NamedTuple):
    """Number of modes of a model beyond a smaller one, and the p-value of the sum of squares that they explain."""

    modes: int
    p: float

    @property
    def significant(self) -> bool:
        """Return whether the larger model is needed."""
        return self.p <= MAX_P_SIGNIFICANT

    @property
    def doubtful(self) -> bool:
        """Return whether the evidence is too weak for a decision."""
        return MAX_P_SIGNIFICANT < self.p <= _MAX_P_DOUBTFUL


class Finding(NamedTuple):
    """The verdict and the selected model, with the evidence for a non-affine part and the warnings."""

    verdict: str  # none, similarity, affine, non-affine or undecided
    model: str
    evidence: Evidence  # that there is a non-affine part
    warnings: tuple[Notice, ...]
    conditional: str | None = None  # the verdict if the pose is right, where the verdict is undecided

    @property
    def is_open_to_waves(self) -> bool:
        """Return whether a wave settles the verdict: a model was found, or residuals that are only correlated."""
        codes = {notice.code for notice in self.warnings}
        return self.verdict in ("none", "similarity", "affine") or codes == {CORRELATED_MISFIT}

    def as_undecided(self, reason: Notice) -> Finding:
        """Return the finding as undecided, with the reason as first warning."""
        return self._replace(verdict="undecided", model="rigid", warnings=(reason, *self.warnings))

    def as_conditional(self, reason: Notice) -> Finding:
        """Return the finding as undecided, with its verdict as the one that holds if the pose is right."""
        if self.verdict == "undecided":
            return self.as_undecided(reason)
        return self._replace(verdict="undecided", conditional=self.verdict, warnings=(reason, *self.warnings))


def decide(
    evidence: Sequence[PairEvidence], *, metric: bool = True, resolution: float = 0.0, unit: str = ""
) -> Finding:
    """Return the smallest adequate model, tested from the largest down.

    A larger model is stated only if it is significant and its size is not negligible; the whole interval of the size of
    a non-affine one has to lie above the negligible size, for each set of pairs. An affine or larger one must also
    predict tiles that are left out of its fit significantly better than the smaller model does. Tiny systematic errors
    of a scanner or of a matching method are significant if there are enough points. Errors of planes through sparse
    points near edges are significant too, but do not continue from tile to tile. Closest points hide a displacement
    along a surface by many spacings; what they leave of it is significant, and looks like noise that is more correlated
    than that of any reconstruction. There is then no verdict.

    Args:
        evidence: that of several sets of pairs of the same clouds; all must agree.
        metric: whether the scale of both clouds is known; otherwise a difference in scale is not a deformation.
        resolution: smallest deformation that counts, in the clouds' unit.
        unit: that unit after a space, for the warnings; empty if it is unknown.
    """
    geometry, noise = evidence[0].geometry, evidence[0].noise
    negligible = max(resolution, negligible_rms(noise))

    def compare(smaller: str, larger: str) -> Evidence:
        return least_significant([compare_models(each, smaller, larger) for each in evidence])

    def sizes(smaller: str, larger: str) -> list[Amplitude]:
        """Return the size of the larger model's part for each set of pairs; none if it has no modes."""
        steps = [(each, each.geometry.step(smaller, larger)) for each in evidence]
        if not all(step.modes.shape[1] for _, step in steps):
            return []
        return [
            with_systematic_errors(amplitude(each.geometry, each.scores, each.noise, step), each.noise)
            for each, step in steps
        ]

    def is_needed(smaller: str, larger: str) -> bool:
        amplitudes = sizes(smaller, larger)
        return compare(smaller, larger).significant and bool(amplitudes) and min(a.rms for a in amplitudes) > negligible

    def gain(smaller: str, larger: str) -> float:
        return min(prediction_gain(each, smaller, larger) for each in evidence)

    non_affine = compare("affine", "cubic")
    tiles = len(geometry.tile_matrices)
    warnings = []
    if non_affine.modes == 0:
        text = (
            "a deformation is not observable here: the surfaces do not constrain any direction well enough; use a scene"
            " with surfaces in several directions"
        )
        warnings.append(Notice("nothing-observable", text))
    if tiles < MIN_TILES:
        text = (
            f"only {tiles} tiles of {TILE * geometry.side:.3g}{unit} contain points (expected at least"
            f" {MIN_TILES}): use a larger or better covered scene"
        )
        warnings.append(Notice("few-tiles", text))
    amplitudes = sizes("affine", "cubic")
    surely, possibly = (amplitudes and min(a.ci[end] for a in amplitudes) > negligible for end in (0, 1))
    is_indicated = non_affine.significant and bool(surely) and not warnings
    may_be_noise = non_affine.doubtful and bool(possibly)
    if is_indicated or may_be_noise:
        gains = {model: gain("affine", model) for model in ("quadratic", "cubic")}
        # The choice of quadratic or cubic needs less evidence: a non-affine deformation is already established.
        needs_cubic = compare("quadratic", "cubic").p <= _MAX_P_DOUBTFUL
        for model in ("cubic", "quadratic") if needs_cubic else ("quadratic",):
            if is_indicated and gains[model] >= _MIN_PREDICTION_GAIN:
                return Finding("non-affine", model, non_affine, ())
        is_indicated, may_be_noise = (each and max(gains.values()) > 0 for each in (is_indicated, may_be_noise))
    if is_needed("similarity", "affine") and gain("similarity", "affine") >= _MIN_PREDICTION_GAIN:
        verdict, model = "affine", "affine"
    elif is_needed("rigid", "similarity"):
        verdict, model = ("similarity" if metric else "none"), "similarity"
        if not metric:
            text = "the scales differ; this counts as deformation only if the unit of both clouds is known"
            warnings.append(Notice("scale-differs", text))
    else:
        verdict, model = "none", "rigid"
    if model != "affine" and (hidden := min(_affine_rms(each) for each in evidence)) > negligible:
        text = (
            f"{hidden:.2g}{unit} RMS along the normals may be a deformation, or a shear or stretch"
            " along surfaces that hardly constrain it; use a scene with walls, or control points (--register"
            " points:FILE)"
        )
        warnings.append(Notice("stretch-or-bend", text))
        verdict = "undecided"
    # Rounding and the errors of planes through sparse points are correlated too: their size is negligible.
    is_correlated = noise.correlated > max(negligible**2, _MAX_CORRELATED_RATIO**2 * noise.white)
    if non_affine.significant and is_correlated and not (is_indicated or may_be_noise):
        text = (
            "the residuals are correlated more strongly than the noise of scans and photographs: closest points may"
            " hide a displacement along the surfaces; measure known points in both clouds (--register points:FILE)"
        )
        warnings.append(Notice(CORRELATED_MISFIT, text))
        verdict = "undecided"
    if is_indicated or may_be_noise:
        side = geometry.side * TILE
        remedy = (
            f"it is correlated over {noise.correlation_length:.3g}{unit}, so that this scene has too few independent"
            f" parts (it would have to be about {40 * noise.correlation_length:.3g}{unit} wide); measure a larger area,"
            " or known points in both clouds (--register points:FILE)"
            if noise.correlation_length > side / 6
            else "use more points or a larger scene"
        )
        size = max(a.rms for a in amplitudes)
        text = (
            f"the residuals suggest a deformation of {size:.2g}{unit} RMS along the normals, but noise may explain"
            f" them: {remedy}"
        )
        warnings.append(Notice("noise-or-bend", text))
    if is_indicated or may_be_noise or non_affine.modes == 0 or tiles < MIN_TILES:
        verdict = "undecided"
    return Finding(verdict, model, non_affine, tuple(warnings))


def negligible_rms(noise: Noise) -> float:
    """Return the RMS below which a deformation is negligible, in the clouds' unit."""
    return NEGLIGIBLE_SHARE * math.sqrt(noise.white + noise.correlated)


def least_significant(evidence: Sequence[Evidence]) -> Evidence:
    """Return the evidence with the largest p-value among several sets of pairs of the same clouds."""
    return max(evidence, key=lambda each: each.p)


def compare_models(evidence: PairEvidence, smaller: str, larger: str) -> Evidence:
    """Test a smaller model against a larger one (the null hypothesis is that the smaller one suffices)."""
    step = evidence.geometry.step(smaller, larger)
    modes = step.modes.T @ evidence.scores.total
    if not len(modes):
        return Evidence(0, 1.0)
    weights = np.linalg.eigvalsh(evidence.geometry.covariance(step, evidence.noise)).astype(np.float64)
    return Evidence(len(modes), chi_squares_tail(float(modes @ modes), weights))


def _affine_rms(evidence: PairEvidence) -> float:
    """Return the RMS along the normals that an affine field explains beyond a similarity, observable or not.

    A dome of nearly flat ground looks like a large stretch along the ground, which the affine models include although
    no test shows it.
    """
    explained = [evidence.geometry.explained_sum(evidence.scores, model) for model in ("similarity", "affine")]
    return math.sqrt(max(0.0, explained[1] - explained[0]) / evidence.geometry.total)


def prediction_gain(evidence: PairEvidence, smaller: str, larger: str) -> float:
    """Return how much better a larger model predicts tiles left out of its fit, in standard errors over the tiles."""
    losses = [_left_out_losses(evidence.geometry, evidence.scores, model, seed=0) for model in (smaller, larger)]
    return in_standard_errors(losses[0] - losses[1])


def in_standard_errors(gains: FloatArray) -> float:
    """Return the sum of gains (N,) in standard errors of a sum of N; 0 if all are equal."""
    error = float(np.std(gains)) * math.sqrt(len(gains))
    return float(gains.sum()) / error if error > 0 else 0.0


def cross_validate(geometry: Geometry, scores: Scores, noise: Noise, seed: int) -> list[ModelScore]:
    """Score each model by leaving out tiles (10 folds) and by the BIC with the effective number of pairs."""
    weight = np.maximum(sum_over_tiles(geometry.weights, geometry.tiles), 1e-300)
    effective = effective_count(geometry, noise)
    model_scores = []
    rigid = geometry.explained_sum(scores, "rigid")
    for model in MODELS:
        loss = _left_out_losses(geometry, scores, model, seed)
        score = float(loss.sum() / weight.sum())
        explained = geometry.explained_sum(scores, model)
        mean_square = max(float(scores.energy.sum()) - explained, 1e-300) / geometry.total
        model_scores.append(
            ModelScore(
                model=model,
                parameters=PARAMETERS[model],
                cv_score=score,
                cv_se=float(np.std(loss - score * weight) * math.sqrt(len(loss)) / weight.sum()),
                bic_eff=effective * math.log(mean_square) + PARAMETERS[model] * math.log(max(effective, 2.0)),
                rms_explained=math.sqrt(max(0.0, explained - rigid) / geometry.total),
            )
        )
    return model_scores


def _left_out_losses(geometry: Geometry, scores: Scores, model: str, seed: int) -> FloatArray:
    """Return the weighted sum of squared residuals of each tile (T,) under the fit to nine tenths of the others."""
    tile, matrices = geometry.tiles, geometry.tile_matrices
    rows, energy = sum_over_tiles(scores.cells, tile), sum_over_tiles(scores.energy, tile)
    fold = np.random.default_rng(seed).permutation(len(matrices)) % _FOLDS
    half, loss = geometry.half(model), np.empty(len(matrices))
    for number in range(_FOLDS):
        out = fold == number
        # In whitened coordinates: without one fold, the information is still close to the identity.
        kept = (1 + 1e-6) * np.eye(half.shape[1]) - half.T @ matrices[out].sum(axis=0) @ half
        c = half @ np.linalg.solve(kept, half.T @ (scores.total - rows[out].sum(axis=0)))
        loss[out] = energy[out] - 2 * rows[out] @ c + (matrices[out] @ c) @ c
    return loss
