"""From the sums over pairs to a `Deformation`."""

from __future__ import annotations

import math
from dataclasses import replace

from pcbench.deformation.field import CellDisplacements, local_changes
from pcbench.deformation.model import TILE
from pcbench.deformation.parts import Field, Growth, NoiseSize, Tiles, round_to_six_digits
from pcbench.deformation.polynomials import PARAMETERS
from pcbench.deformation.result import Deformation
from pcbench.deformation.shapes import shape_of
from pcbench.deformation.size import (
    NullDistribution,
    amplitude,
    detectable_sizes,
    effective_count,
    minimum_detectable_rms,
    observable_shares,
    stated_rms,
    with_systematic_errors,
)
from pcbench.deformation.sums import TileSums
from pcbench.deformation.verdict import Finding, PairEvidence, cross_validate, decide, negligible_rms


def assess(sums: TileSums, *, metric: bool = True, resolution: float = 0.0, seed: int = 0) -> Deformation:
    """Assess the deformation of a pair of clouds.

    Args:
        sums: sums over the pairs.
        metric: whether the scale of both clouds is known; otherwise a difference in scale is not a deformation.
        resolution: smallest deformation that counts, in the clouds' unit: tangent planes through sparse points cannot
            resolve smaller ones.
        seed: random seed for the folds of the cross-validation.
    """
    evidence = PairEvidence.of(sums)
    finding = decide([evidence], metric=metric, resolution=resolution)
    return describe(evidence, finding, resolution=resolution, seed=seed).without_empty_denial()


def describe(evidence: PairEvidence, finding: Finding, *, resolution: float = 0.0, seed: int = 0) -> Deformation:
    """Complete a finding with model scores, amplitude, noise, local changes and the minimum detectable deformation."""
    sums, geometry, scores, noise = evidence
    negligible = max(resolution, negligible_rms(noise))
    stated = stated_rms(negligible, noise)
    null = NullDistribution.of(geometry, noise)
    rungs = cross_validate(geometry, scores, noise, seed)
    beyond = geometry.step("affine", finding.model if PARAMETERS[finding.model] > 12 else "quadratic")
    cells = CellDisplacements(geometry, scores, noise, sums)
    changed, length, local = local_changes(geometry, noise, sums, negligible)
    remaining = sums.energy.sum() - geometry.explained_sum(scores, finding.model)
    answer: Deformation = round_to_six_digits(
        Deformation(
            verdict=finding.verdict,
            model=finding.model,
            parameters=PARAMETERS[finding.model],
            p_value=finding.evidence.p,
            rungs=tuple(rungs),
            amplitude=with_systematic_errors(amplitude(geometry, scores, noise, beyond), noise),
            remaining_rms=math.sqrt(max(0.0, float(remaining)) / geometry.total),
            noise=NoiseSize(
                sigma_white=math.sqrt(noise.white),
                sigma_correlated=math.sqrt(noise.correlated),
                correlation_length=noise.correlation_length,
                n_eff=effective_count(geometry, noise),
            ),
            tiles=Tiles(count=len(geometry.tile_matrices), side=TILE * sums.side),
            pairs=int(sums.counts.sum()),
            growth=Growth(with_distance=cells.trend(cells.distance), with_height=cells.trend(cells.height)),
            observable=observable_shares(sums, geometry.tiles),
            local=local,
            minimum_detectable_rms=minimum_detectable_rms(geometry, null),
            negligible_rms=negligible,
            stated_rms=stated,
            detectable=detectable_sizes(geometry, null, stated),
            conditional_verdict=finding.conditional,
            warnings=finding.warnings,
        )
    )
    field = Field(
        places=geometry.means,
        displacements=cells.displacements(finding.model),
        vertical=cells.vertical,
        sigma=cells.sigma,
        local=length,
        changed=changed,
        counts=sums.counts,
    )
    verdict = finding.conditional or finding.verdict
    shape = round_to_six_digits(shape_of(field)) if verdict in ("affine", "non-affine") else None
    return replace(answer, field=field, shape=shape)
