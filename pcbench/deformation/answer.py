"""From sums over tiles to the answer."""

from __future__ import annotations

import math
from dataclasses import replace

from pcbench.deformation.field import FDR, CellDisplacements
from pcbench.deformation.model import FACTORS, TILE, Geometry, Scores, estimate_noise
from pcbench.deformation.polynomials import PARAMETERS
from pcbench.deformation.result import Deformation, Field, Growth, LocalChanges, NoiseSize, Tiles, rounded
from pcbench.deformation.size import amplitude, effective_count, minimum_detectable_rms, observable
from pcbench.deformation.sums import TileSums
from pcbench.deformation.verdict import bootstrap_signs, climb, decide


def judge(sums: TileSums, *, metric: bool = True, resolution: float = 0.0, seed: int = 0) -> Deformation:
    """The verdict on a pair of clouds.

    Args:
        sums: over their pairs.
        metric: whether both clouds' scale is known; otherwise a scale is no deformation.
        resolution: a bend that is surely smaller is none: tangent planes through points that lie apart do not show it.
        seed: of the bootstrap and of the folds.
    """
    geometry = Geometry(sums)
    scores = Scores(geometry, sums.scores, sums.energy, sums.dyadic)
    noise = estimate_noise(geometry, scores)
    finding = decide(geometry, scores, noise, bootstrap_signs(geometry, seed), metric=metric, resolution=resolution)
    rungs = climb(geometry, scores, noise, seed)
    beyond = geometry.step("affine", finding.model if PARAMETERS[finding.model] > 12 else "quadratic")
    cells = CellDisplacements(geometry, scores, noise, sums)
    changed, tested, local = cells.changes(sums, resolution)
    remaining = sums.energy.sum() - geometry.explained(scores, finding.model)
    tiles = geometry.tiles[TILE]
    answer: Deformation = rounded(
        Deformation(
            verdict=finding.verdict,
            model=finding.model,
            parameters=PARAMETERS[finding.model],
            p_value=finding.evidence.p_tiles[TILE],
            p_value_noise=finding.evidence.p_noise,
            rungs=tuple(rungs),
            amplitude=amplitude(geometry, scores, noise, beyond),
            remaining_rms=math.sqrt(max(0.0, float(remaining)) / geometry.total),
            noise=NoiseSize(
                sigma_white=math.sqrt(noise.white),
                sigma_correlated=math.sqrt(noise.correlated),
                correlation_length=noise.correlation_length,
                n_eff=effective_count(geometry, noise),
            ),
            tiles=Tiles(count=int(tiles.max()) + 1, side=FACTORS[TILE] * sums.side, agreement=finding.agreement),
            pairs=int(sums.counts.sum()),
            growth=Growth(with_distance=cells.trend(cells.distance), with_height=cells.trend(cells.height)),
            observable=observable(sums, tiles),
            local=LocalChanges(tiles_tested=int(tested.sum()), tiles_changed=int(changed.sum()), fdr=FDR),
            minimum_detectable_rms=minimum_detectable_rms(geometry, noise),
            warnings=finding.warnings,
        )
    )
    field = Field(
        places=geometry.means,
        displacements=cells.displacements(finding.model),
        vertical=cells.vertical,
        sigma=cells.sigma,
        local=local,
        changed=changed,
        counts=sums.counts,
    )
    return replace(answer, field=field)
