"""Selection of the smallest sufficient model, by tests against the noise."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from pcbench.deformation.chi_squares import chi_squares_tail
from pcbench.deformation.model import TILE, Geometry, Noise, Scores, estimate_noise
from pcbench.deformation.polynomials import MODELS, PARAMETERS
from pcbench.deformation.result import ModelScore
from pcbench.deformation.size import MAX_P_SURE, amplitude, effective_count
from pcbench.deformation.sums import TileSums, sum_over_tiles
from pcbench.errors import Notice

MIN_TILES = 40
_FOLDS = 10
_MAX_P_DOUBT = 1e-3
_MIN_AMPLITUDE_SHARE = 0.1  # of the noise; certainly smaller deformations do not make a verdict undecided


class PairEvidence(NamedTuple):
    """Sums, models, scores and noise of one kind of pairs."""

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
    """Result of a test that a smaller model suffices.

    Attributes:
        modes: number of observable fields of the larger model beyond the smaller one.
        p: probability that noise alone explains as much.
    """

    modes: int
    p: float

    @property
    def sure(self) -> bool:
        """Whether the larger model is needed."""
        return self.p <= MAX_P_SURE

    @property
    def doubtful(self) -> bool:
        """Whether the evidence is weak."""
        return MAX_P_SURE < self.p <= _MAX_P_DOUBT


class Finding(NamedTuple):
    """The smallest sufficient model.

    Attributes:
        verdict: none, similarity, affine, non-affine or undecided.
        model: the model.
        evidence: evidence for a non-affine part.
        warnings: warnings.
    """

    verdict: str
    model: str
    evidence: Evidence
    warnings: tuple[Notice, ...]

    def undecided(self, reason: Notice) -> Finding:
        """Return an undecided finding with a reason as its first warning."""
        return self._replace(verdict="undecided", model="rigid", warnings=(reason, *self.warnings))


def decide(views: Sequence[PairEvidence], *, metric: bool = True, resolution: float = 0.0) -> Finding:
    """Return the smallest model that explains the pair, tested from the largest model down.

    Args:
        views: evidence of different kinds of pairs; the weakest counts.
        metric: as in `assess_deformation`.
        resolution: as in `assess_deformation`.
    """
    geometry, scores, noise = views[0].geometry, views[0].scores, views[0].noise

    def test(smaller: str, larger: str) -> Evidence:
        return weakest_evidence([test_model(view, smaller, larger) for view in views])

    def largest(smaller: str, larger: str) -> float:
        step = geometry.step(smaller, larger)
        return float(amplitude(geometry, scores, noise, step).ci[1]) if step.modes.shape[1] else 0.0

    def is_needed(smaller: str, larger: str) -> bool:
        return test(smaller, larger).sure and largest(smaller, larger) > resolution

    evidence = test("affine", "cubic")
    tiles = len(geometry.tile_matrices)
    warnings = []
    if evidence.modes == 0:
        text = "no deformation can be observed here: the surfaces constrain no direction well enough"
        warnings.append(Notice("nothing-observable", text))
    if tiles < MIN_TILES:
        text = (
            f"only {tiles} tiles of side {TILE * geometry.side:.3g} have points (at least {MIN_TILES} are needed): a"
            " larger or better covered scene would settle it"
        )
        warnings.append(Notice("few-tiles", text))
    size = largest("affine", "cubic")
    is_resolved = size > resolution
    if evidence.sure and is_resolved and not warnings:
        # The cubic part needs less evidence, because a deformation is established.
        model = "cubic" if test("quadratic", "cubic").p <= _MAX_P_DOUBT else "quadratic"
        return Finding("non-affine", model, evidence, ())
    if is_needed("similarity", "affine"):
        verdict, model = "affine", "affine"
    elif is_needed("rigid", "similarity"):
        verdict, model = ("similarity" if metric else "none"), "similarity"
        if not metric:
            text = "the scales differ, which counts as deformation only if the units of both clouds are known"
            warnings.append(Notice("scale-differs", text))
    else:
        verdict, model = "none", "rigid"
    is_relevant = is_resolved and size > _MIN_AMPLITUDE_SHARE * math.sqrt(noise.white + noise.correlated)
    if evidence.doubtful and is_relevant:
        side = geometry.side * TILE
        remedy = (
            f"it is correlated over {noise.correlation_length:.3g}, with tiles of side {side:.3g}; a scene larger than"
            f" {40 * noise.correlation_length:.3g} would settle it"
            if noise.correlation_length > side / 6
            else "more points, or a larger scene, would settle it"
        )
        text = f"the residual looks like a deformation, but noise may explain it: {remedy}"
        warnings.append(Notice("noise-or-bend", text))
    if (evidence.doubtful and is_relevant) or evidence.modes == 0 or tiles < MIN_TILES:
        verdict = "undecided"
    return Finding(verdict, model, evidence, tuple(warnings))


def weakest_evidence(evidence: Sequence[Evidence]) -> Evidence:
    """Return the weakest evidence of different pairs of the same clouds."""
    return max(evidence, key=lambda each: each.p)


def test_model(view: PairEvidence, smaller: str, larger: str) -> Evidence:
    """Test whether a smaller model suffices, against a larger one."""
    step = view.geometry.step(smaller, larger)
    modes = step.modes.T @ view.scores.total
    if not len(modes):
        return Evidence(0, 1.0)
    weights = np.linalg.eigvalsh(view.geometry.covariance(step, view.noise)).astype(np.float64)
    return Evidence(len(modes), chi_squares_tail(float(modes @ modes), weights))


def cross_validate(geometry: Geometry, scores: Scores, noise: Noise, seed: int) -> list[ModelScore]:
    """Return the cross-validation score of each model, with held-out tiles, and its BIC with the effective count."""
    tile, matrices = geometry.tiles, geometry.tile_matrices
    rows = sum_over_tiles(scores.cells, tile)
    energy, weight = sum_over_tiles(scores.energy, tile), np.maximum(sum_over_tiles(geometry.weights, tile), 1e-300)
    fold = np.random.default_rng(seed).permutation(len(matrices)) % _FOLDS
    effective = effective_count(geometry, noise)
    model_scores = []
    rigid = geometry.explained(scores, "rigid")
    for model in MODELS:
        fields, loss = geometry.fields(model), np.empty(len(matrices))
        for index in range(_FOLDS):
            out = fold == index
            # In fields of unit information, the normal matrix without a fold is close to the identity.
            training = (1 + 1e-6) * np.eye(fields.shape[1]) - fields.T @ matrices[out].sum(axis=0) @ fields
            c = fields @ np.linalg.solve(training, fields.T @ (scores.total - rows[out].sum(axis=0)))
            loss[out] = energy[out] - 2 * rows[out] @ c + (matrices[out] @ c) @ c
        score = float(loss.sum() / weight.sum())
        explained = geometry.explained(scores, model)
        residual = max(float(scores.energy.sum()) - explained, 1e-300) / geometry.total
        model_scores.append(
            ModelScore(
                model=model,
                parameters=PARAMETERS[model],
                cv_score=score,
                cv_se=float(np.std(loss - score * weight) * math.sqrt(len(loss)) / weight.sum()),
                bic_eff=effective * math.log(residual) + PARAMETERS[model] * math.log(max(effective, 2.0)),
                rms_explained=math.sqrt(max(0.0, explained - rigid) / geometry.total),
            )
        )
    return model_scores
