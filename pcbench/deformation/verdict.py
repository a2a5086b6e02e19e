"""Which model is needed: tests of what it explains against the noise."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from pcbench.deformation.chi_squares import chi_squares_tail
from pcbench.deformation.model import TILE, Geometry, Noise, Scores, estimate_noise
from pcbench.deformation.polynomials import MODELS, PARAMETERS
from pcbench.deformation.result import Rung
from pcbench.deformation.size import MAX_P_SURE, amplitude, effective_count
from pcbench.deformation.sums import TileSums, added
from pcbench.errors import Notice

MIN_TILES = 40
_FOLDS = 10
_MAX_P_DOUBT = 1e-3
_MIN_BEND = 0.1  # of the noise: a bend that is surely less is not worth a doubt


class PairEvidence(NamedTuple):
    """What one kind of pairs shows."""

    sums: TileSums
    geometry: Geometry
    scores: Scores
    noise: Noise

    @classmethod
    def of(cls, sums: TileSums) -> PairEvidence:
        geometry = Geometry(sums)
        scores = Scores(geometry, sums.scores, sums.energy, sums.powers)
        return cls(sums, geometry, scores, estimate_noise(geometry, scores))


class Evidence(NamedTuple):
    """How many fields a model has beyond a smaller one, and how often noise would have explained as much as they do."""

    modes: int
    p: float

    @property
    def sure(self) -> bool:
        return self.p <= MAX_P_SURE

    @property
    def doubtful(self) -> bool:
        return MAX_P_SURE < self.p <= _MAX_P_DOUBT


class Finding(NamedTuple):
    verdict: str  # none, similarity, affine, non-affine or undecided
    model: str
    evidence: Evidence  # that there is a non-affine part
    warnings: tuple[Notice, ...]

    def undecided(self, reason: Notice) -> Finding:
        """The same, withheld: the reason comes first."""
        return self._replace(verdict="undecided", model="rigid", warnings=(reason, *self.warnings))


def decide(views: Sequence[PairEvidence], *, metric: bool = True, resolution: float = 0.0) -> Finding:
    """The smallest model that explains the pair, from the largest question down; see `judge`."""
    geometry, scores, noise = views[0].geometry, views[0].scores, views[0].noise

    def weigh(smaller: str, larger: str) -> Evidence:
        return weakest([weigh_evidence(view, smaller, larger) for view in views])

    def largest(smaller: str, larger: str) -> float:
        step = geometry.step(smaller, larger)
        return float(amplitude(geometry, scores, noise, step).ci[1]) if step.modes.shape[1] else 0.0

    def is_needed(smaller: str, larger: str) -> bool:
        return weigh(smaller, larger).sure and largest(smaller, larger) > resolution

    bent = weigh("affine", "cubic")
    tiles = len(geometry.tile_matrices)
    warnings = []
    if bent.modes == 0:
        text = "no bend can be seen here: the surfaces show no direction well enough"
        warnings.append(Notice("nothing-observable", text))
    if tiles < MIN_TILES:
        text = (
            f"only {tiles} tiles of {TILE * geometry.side:.3g} hold points (expected {MIN_TILES}): a"
            " larger or better covered scene would settle it"
        )
        warnings.append(Notice("few-tiles", text))
    bend = largest("affine", "cubic")
    shown = bend > resolution
    if bent.sure and shown and not warnings:
        # The cubic part needs less evidence: that there is a bend is settled.
        model = "cubic" if weigh("quadratic", "cubic").p <= _MAX_P_DOUBT else "quadratic"
        return Finding("non-affine", model, bent, ())
    if is_needed("similarity", "affine"):
        verdict, model = "affine", "affine"
    elif is_needed("rigid", "similarity"):
        verdict, model = ("similarity" if metric else "none"), "similarity"
        if not metric:
            text = "the scales differ; that counts as deformation only where both clouds' unit is known"
            warnings.append(Notice("scale-differs", text))
    else:
        verdict, model = "none", "rigid"
    matters = shown and bend > _MIN_BEND * math.sqrt(noise.white + noise.correlated)
    if bent.doubtful and matters:
        side = geometry.side * TILE
        remedy = (
            f"it is correlated over {noise.correlation_length:.3g}, with tiles of {side:.3g}; a scene of more than"
            f" {40 * noise.correlation_length:.3g} would settle it"
            if noise.correlation_length > side / 6
            else "more points, or a larger scene, would settle it"
        )
        text = f"what remains looks bent, but noise may have done it: {remedy}"
        warnings.append(Notice("noise-or-bend", text))
    if (bent.doubtful and matters) or bent.modes == 0 or tiles < MIN_TILES:
        verdict = "undecided"
    return Finding(verdict, model, bent, tuple(warnings))


def weakest(evidence: Sequence[Evidence]) -> Evidence:
    """Of different pairs of the same clouds: that which noise explains most easily."""
    return max(evidence, key=lambda each: each.p)


def weigh_evidence(view: PairEvidence, smaller: str, larger: str) -> Evidence:
    """Test that a smaller model suffices against a larger one."""
    step = view.geometry.step(smaller, larger)
    modes = step.modes.T @ view.scores.total
    if not len(modes):
        return Evidence(0, 1.0)
    weights = np.linalg.eigvalsh(view.geometry.covariance(step, view.noise)).astype(np.float64)
    return Evidence(len(modes), chi_squares_tail(float(modes @ modes), weights))


def climb(geometry: Geometry, scores: Scores, noise: Noise, seed: int) -> list[Rung]:
    """Each model's cross-validated mean square residual (whole tiles are left out) and its BIC with n_eff."""
    tile, matrices = geometry.tiles, geometry.tile_matrices
    rows = added(scores.cells, tile)
    energy, weight = added(scores.energy, tile), np.maximum(added(geometry.weights, tile), 1e-300)
    fold = np.random.default_rng(seed).permutation(len(matrices)) % _FOLDS
    effective = effective_count(geometry, noise)
    found = []
    rigid = geometry.explained(scores, "rigid")
    for model in MODELS:
        half, loss = geometry.half(model), np.empty(len(matrices))
        for number in range(_FOLDS):
            out = fold == number
            # In fields of unit information: what remains of it when a fold is left out is near the identity.
            kept = (1 + 1e-6) * np.eye(half.shape[1]) - half.T @ matrices[out].sum(axis=0) @ half
            c = half @ np.linalg.solve(kept, half.T @ (scores.total - rows[out].sum(axis=0)))
            loss[out] = energy[out] - 2 * rows[out] @ c + (matrices[out] @ c) @ c
        score = float(loss.sum() / weight.sum())
        explained = geometry.explained(scores, model)
        left = max(float(scores.energy.sum()) - explained, 1e-300) / geometry.total
        found.append(
            Rung(
                model=model,
                parameters=PARAMETERS[model],
                cv_score=score,
                cv_se=float(np.std(loss - score * weight) * math.sqrt(len(loss)) / weight.sum()),
                bic_eff=effective * math.log(left) + PARAMETERS[model] * math.log(max(effective, 2.0)),
                rms_explained=math.sqrt(max(0.0, explained - rigid) / geometry.total),
            )
        )
    return found
