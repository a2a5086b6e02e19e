"""Which model is needed: tests of what it explains against the noise, and their agreement."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from pcbench.deformation.chi_squares import chi_squares_tail
from pcbench.deformation.model import FACTORS, TILE, Geometry, Noise, Scores
from pcbench.deformation.polynomials import MODELS, PARAMETERS
from pcbench.deformation.result import Rung
from pcbench.deformation.size import amplitude, effective_count
from pcbench.deformation.sums import added
from pcbench.errors import Notice
from pcbench.geometry.arrays import FloatArray

MIN_TILES = 40
_REPLICATES = 999
_FOLDS = 10
# The covariance is estimated: where it is a third too small, 1e-5 is 1e-3 in truth.
_MAX_P_NOISE, _MAX_P_TILES = 1e-5, 5e-3  # of a bend that is sure: both tests say so
_MAX_P_DOUBT = 1e-3  # of either test alone
_MIN_BEND = 0.1  # of the noise: a bend that is surely less is not worth a doubt


class Evidence(NamedTuple):
    """How much a model explains beyond a smaller one, and how often noise would have explained as much."""

    explained: float  # sum of w (n . u)^2
    modes: int
    p_noise: float  # under the estimated noise
    p_tiles: tuple[float, ...]  # wild bootstrap, a size of tiles each
    long_noise: bool  # whether noise reaches across tiles, which the bootstrap does not know

    @property
    def sure(self) -> bool:
        return self.p_noise <= _MAX_P_NOISE and max(self.p_tiles) <= _MAX_P_TILES

    @property
    def doubtful(self) -> bool:
        return not self.sure and (
            self.p_noise <= _MAX_P_DOUBT or (self.long_noise and max(self.p_tiles) <= _MAX_P_DOUBT)
        )


class Finding(NamedTuple):
    verdict: str  # none, similarity, affine, non-affine or undecided
    model: str
    evidence: Evidence  # that there is a non-affine part
    agreement: float  # share of the tile sizes at which the bootstrap says the same as in the middle one
    warnings: tuple[Notice, ...]


def decide(
    geometry: Geometry,
    scores: Scores,
    noise: Noise,
    signs: Sequence[FloatArray],
    *,
    metric: bool = True,
    resolution: float = 0.0,
) -> Finding:
    """The smallest model that explains the pair, from the largest question down; see `judge`."""

    def weigh(smaller: str, larger: str) -> Evidence:
        return weigh_evidence(geometry, scores, noise, smaller, larger, signs)

    def largest(smaller: str, larger: str) -> float:
        step = geometry.step(smaller, larger)
        return float(amplitude(geometry, scores, noise, step).ci[1]) if step.modes.shape[1] else 0.0

    def is_needed(smaller: str, larger: str) -> bool:
        return weigh(smaller, larger).sure and largest(smaller, larger) > resolution

    bent = weigh("affine", "cubic")
    same = [(p <= _MAX_P_TILES) == (bent.p_tiles[TILE] <= _MAX_P_TILES) for p in bent.p_tiles]
    tiles = len(geometry.tile_matrices)
    warnings = []
    if bent.modes == 0:
        text = "no bend can be seen here: the surfaces show no direction well enough"
        warnings.append(Notice("nothing-observable", text))
    if tiles < MIN_TILES:
        text = (
            f"only {tiles} tiles of {FACTORS[TILE] * geometry.side:.3g} hold points (expected {MIN_TILES}): a"
            " larger or better covered scene would settle it"
        )
        warnings.append(Notice("few-tiles", text))
    bend = largest("affine", "cubic")
    shown = bend > resolution
    if bent.sure and shown and not warnings:
        # The cubic part needs less evidence: that there is a bend is settled.
        model = "cubic" if weigh("quadratic", "cubic").p_noise <= _MAX_P_DOUBT else "quadratic"
        return Finding("non-affine", model, bent, float(np.mean(same)), ())
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
        side = geometry.side * FACTORS[TILE]
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
    return Finding(verdict, model, bent, float(np.mean(same)), tuple(warnings))


def weigh_evidence(
    geometry: Geometry, scores: Scores, noise: Noise, smaller: str, larger: str, signs: Sequence[FloatArray]
) -> Evidence:
    """Test that a smaller model suffices against a larger one. `signs` (R, T) of the bootstrap for each tile size."""
    step = geometry.step(smaller, larger)
    modes = step.modes.T @ scores.total
    explained = float(modes @ modes)
    if not len(modes):
        return Evidence(0.0, 0, 1.0, (1.0,) * len(signs), False)
    weights: FloatArray = np.linalg.eigvalsh(geometry.covariance(step, noise)).astype(np.float64)
    coefficients = step.smaller @ (step.smaller.T @ scores.total)
    left = (scores.cells - geometry.cell_matrices @ coefficients) @ step.modes  # (C, K) of the smaller model
    p_tiles = []
    for tile, flips in zip(geometry.tiles, signs, strict=True):
        replicates = np.square(flips @ added(left, tile)).sum(axis=1)
        p_tiles.append((1 + int(np.count_nonzero(replicates >= explained))) / (1 + len(replicates)))
    long_noise = noise.correlation_length > FACTORS[TILE] * geometry.side / 3
    return Evidence(explained, len(modes), chi_squares_tail(explained, weights), tuple(p_tiles), long_noise)


def bootstrap_signs(geometry: Geometry, seed: int) -> list[FloatArray]:
    """Rademacher weights (R, T) for each size of tiles."""
    rng = np.random.default_rng(seed)
    return [rng.choice([-1.0, 1.0], size=(_REPLICATES, int(tile.max()) + 1)) for tile in geometry.tiles]


def climb(geometry: Geometry, scores: Scores, noise: Noise, seed: int) -> list[Rung]:
    """Each model's cross-validated mean square residual (whole tiles are left out) and its BIC with n_eff."""
    tile = geometry.tiles[TILE]
    matrices, rows = geometry.tile_matrices, added(scores.cells, tile)
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
