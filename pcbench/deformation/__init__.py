"""Is one cloud bent against the other, how much, and where? From sums over tiles to a verdict.

Pairs of a candidate point p and the reference's tangent plane (q, n) leave residuals r = n . (p - q), linear in the
coefficients of a polynomial displacement field u of the candidate: r = n . u(x) + noise. Five models are nested:
rigid (6 parameters), similarity (7), affine (12), quadratic (30) and cubic (60) fields. The question is whether what
the larger ones explain is more than noise would have explained. Counting points answers it wrongly: the noise of
reconstructions is correlated over metres, and a million points then hold a few hundred independent facts. So

1. the noise's covariance is estimated from the residuals of the largest model (so that no bend is taken for noise):
   white noise plus a non-negative mixture of Gaussian kernels of fixed lengths (every covariance that is valid in all
   dimensions and isotropic is one, Schoenberg 1938), by matching moments. The expected moments are exact: what
   fitting the model took from the residuals is put back, as in REML (Patterson & Thompson 1971);
2. the statistic of each rung is what it explains beyond a smaller one, in least squares; its null distribution is a
   sum of chi squares whose weights are the eigenvalues of the scores' covariance under that noise;
3. the same statistic is tested by a wild bootstrap over tiles (Cameron, Gelbach & Miller 2008) with three sizes of
   tiles, which assumes nothing about the noise within tiles and independence between them;
4. where both say so it is a verdict; where they contradict each other, or are short of being sure, it is "undecided".

Everything is computed from `TileSums`, which add up: tiles may come from anywhere. Lengths are in the clouds' unit.
"""

from pcbench.deformation.answer import judge
from pcbench.deformation.clouds import deform
from pcbench.deformation.pairs import Side, residual_deformation
from pcbench.deformation.result import (
    Amplitude,
    Bin,
    Deformation,
    Field,
    Growth,
    LocalChanges,
    NoiseSize,
    Observable,
    Rung,
    Tiles,
    Trend,
)
from pcbench.deformation.sums import TileSums

__all__ = [
    "Amplitude",
    "Bin",
    "Deformation",
    "Field",
    "Growth",
    "LocalChanges",
    "NoiseSize",
    "Observable",
    "Rung",
    "Side",
    "TileSums",
    "Tiles",
    "Trend",
    "deform",
    "judge",
    "residual_deformation",
]
