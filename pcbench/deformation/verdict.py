"""Select the smallest adequate model by tests against the noise, and score all models by cross-validation."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from pcbench.deformation.chi_squares import chi_squares_tail
from pcbench.deformation.model import TILE, Geometry, Noise, Scores, estimate_noise
from pcbench.deformation.polynomials import MODELS, PARAMETERS
from pcbench.deformation.result import NEGLIGIBLE_SHARE, ModelScore
from pcbench.deformation.size import MAX_P_SIGNIFICANT, amplitude, effective_count
from pcbench.deformation.sums import TileSums, sum_over_tiles
from pcbench.errors import Notice

MIN_TILES = 40
_FOLDS = 10
_MAX_P_DOUBTFUL = 1e-3


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

    def as_undecided(self, reason: Notice) -> Finding:
        """Return the finding as undecided, with the reason as first warning."""
        return self._replace(verdict="undecided", model="rigid", warnings=(reason, *self.warnings))

    def as_conditional(self, reason: Notice) -> Finding:
        """Return the finding as undecided, with its verdict as the one that holds if the pose is right."""
        if self.verdict == "undecided":
            return self.as_undecided(reason)
        return self._replace(verdict="undecided", conditional=self.verdict, warnings=(reason, *self.warnings))


def decide(views: Sequence[PairEvidence], *, metric: bool = True, resolution: float = 0.0) -> Finding:
    """Return the smallest adequate model, tested from the largest down.

    A larger model is stated only if it is significant and its size is not negligible: tiny systematic errors of a
    scanner or of a matching method are significant if there are enough points.

    Args:
        views: evidence of several sets of pairs of the same clouds; all must agree.
        metric: whether the scale of both clouds is known; otherwise a difference in scale is not a deformation.
        resolution: smallest deformation that counts, in the clouds' unit.
    """
    geometry, noise = views[0].geometry, views[0].noise
    negligible = max(resolution, negligible_rms(noise))

    def compare(smaller: str, larger: str) -> Evidence:
        return least_significant([compare_models(view, smaller, larger) for view in views])

    def exceeds(smaller: str, larger: str, limit: float, *, upper: bool = False) -> bool:
        """Return whether the larger model's part, or the end of its interval, exceeds a limit in each view."""
        for view in views:
            step = view.geometry.step(smaller, larger)
            if not step.modes.shape[1]:
                return False
            found = amplitude(view.geometry, view.scores, view.noise, step)
            if (found.ci[1] if upper else found.rms) <= limit:
                return False
        return True

    def is_needed(smaller: str, larger: str) -> bool:
        return compare(smaller, larger).significant and exceeds(smaller, larger, negligible)

    non_affine = compare("affine", "cubic")
    tiles = len(geometry.tile_matrices)
    warnings = []
    if non_affine.modes == 0:
        text = "a deformation is not observable here: the surfaces do not constrain any direction well enough"
        warnings.append(Notice("nothing-observable", text))
    if tiles < MIN_TILES:
        text = (
            f"only {tiles} tiles of {TILE * geometry.side:.3g} contain points (expected at least {MIN_TILES}): use a"
            " larger or better covered scene"
        )
        warnings.append(Notice("few-tiles", text))
    if is_needed("affine", "cubic") and not warnings:
        # The choice of quadratic or cubic needs less evidence: a non-affine deformation is already established.
        model = "cubic" if compare("quadratic", "cubic").p <= _MAX_P_DOUBTFUL else "quadratic"
        return Finding("non-affine", model, non_affine, ())
    if is_needed("similarity", "affine"):
        verdict, model = "affine", "affine"
    elif is_needed("rigid", "similarity"):
        verdict, model = ("similarity" if metric else "none"), "similarity"
        if not metric:
            text = "the scales differ; this counts as deformation only if the unit of both clouds is known"
            warnings.append(Notice("scale-differs", text))
    else:
        verdict, model = "none", "rigid"
    matters = exceeds("affine", "cubic", negligible, upper=True)
    if non_affine.doubtful and matters:
        side = geometry.side * TILE
        remedy = (
            f"it is correlated over {noise.correlation_length:.3g}, and the tiles are {side:.3g} wide; use a scene of"
            f" more than {40 * noise.correlation_length:.3g}"
            if noise.correlation_length > side / 6
            else "use more points or a larger scene"
        )
        text = f"the residuals suggest a deformation, but noise may explain them: {remedy}"
        warnings.append(Notice("noise-or-bend", text))
    if (non_affine.doubtful and matters) or non_affine.modes == 0 or tiles < MIN_TILES:
        verdict = "undecided"
    return Finding(verdict, model, non_affine, tuple(warnings))


def negligible_rms(noise: Noise) -> float:
    """Return the RMS below which a deformation is negligible, in the clouds' unit."""
    return NEGLIGIBLE_SHARE * math.sqrt(noise.white + noise.correlated)


def least_significant(evidence: Sequence[Evidence]) -> Evidence:
    """Return the evidence with the largest p-value among several sets of pairs of the same clouds."""
    return max(evidence, key=lambda each: each.p)


def compare_models(view: PairEvidence, smaller: str, larger: str) -> Evidence:
    """Test a smaller model against a larger one (the null hypothesis is that the smaller one suffices)."""
    step = view.geometry.step(smaller, larger)
    modes = step.modes.T @ view.scores.total
    if not len(modes):
        return Evidence(0, 1.0)
    weights = np.linalg.eigvalsh(view.geometry.covariance(step, view.noise)).astype(np.float64)
    return Evidence(len(modes), chi_squares_tail(float(modes @ modes), weights))


def cross_validate(geometry: Geometry, scores: Scores, noise: Noise, seed: int) -> list[ModelScore]:
    """Score each model by leaving out tiles (10 folds) and by the BIC with the effective number of pairs."""
    tile, matrices = geometry.tiles, geometry.tile_matrices
    rows = sum_over_tiles(scores.cells, tile)
    energy, weight = sum_over_tiles(scores.energy, tile), np.maximum(sum_over_tiles(geometry.weights, tile), 1e-300)
    fold = np.random.default_rng(seed).permutation(len(matrices)) % _FOLDS
    effective = effective_count(geometry, noise)
    found = []
    rigid = geometry.explained_sum(scores, "rigid")
    for model in MODELS:
        half, loss = geometry.half(model), np.empty(len(matrices))
        for number in range(_FOLDS):
            out = fold == number
            # In whitened coordinates: without one fold, the information is still close to the identity.
            kept = (1 + 1e-6) * np.eye(half.shape[1]) - half.T @ matrices[out].sum(axis=0) @ half
            c = half @ np.linalg.solve(kept, half.T @ (scores.total - rows[out].sum(axis=0)))
            loss[out] = energy[out] - 2 * rows[out] @ c + (matrices[out] @ c) @ c
        score = float(loss.sum() / weight.sum())
        explained = geometry.explained_sum(scores, model)
        left = max(float(scores.energy.sum()) - explained, 1e-300) / geometry.total
        found.append(
            ModelScore(
                model=model,
                parameters=PARAMETERS[model],
                cv_score=score,
                cv_se=float(np.std(loss - score * weight) * math.sqrt(len(loss)) / weight.sum()),
                bic_eff=effective * math.log(left) + PARAMETERS[model] * math.log(max(effective, 2.0)),
                rms_explained=math.sqrt(max(0.0, explained - rigid) / geometry.total),
            )
        )
    return found
