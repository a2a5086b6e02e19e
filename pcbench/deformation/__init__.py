"""Is one cloud bent against the other, how much, and where? From sums over tiles to a verdict.

Pairs of a candidate point p and the reference's tangent plane (q, n) leave residuals r = n . (p - q), linear in the
coefficients of a polynomial displacement field u of the candidate: r = n . u(x) + noise. Five models are nested:
rigid (6 parameters), similarity (7), affine (12), quadratic (30) and cubic (60) fields. The question is whether what
the larger ones explain is more than noise would have explained. Counting points answers it wrongly: the noise of
reconstructions is correlated over metres, and a million points then hold a few hundred independent facts. So

1. the noise's covariance is estimated from the residuals of the largest model (so that no bend is taken for noise):
   a size that varies smoothly over the scene times white noise plus a non-negative mixture of Gaussian kernels of
   fixed lengths (every covariance that is valid in all dimensions and isotropic is one, Schoenberg 1938), by matching
   moments. The expected moments are exact: what fitting the model took from the residuals is put back, as in REML
   (Patterson & Thompson 1971), and outliers are limited by pseudo-values (Huber 1981), which scatter as the robust fit
   does;
2. the statistic of each rung is what it explains beyond a smaller one, in least squares; its null distribution is a
   sum of chi squares whose weights are the eigenvalues of the scores' covariance under that noise;
3. closest points are found under the largest model and, where that claims something, under none too: where points fill
   a volume, any bend that is assumed finds closest points that bear it out. What is claimed has to show in both;
4. between sure and nothing it is "undecided", as it is where the registration is in doubt, where closest points do not
   belong together, and where two parts of the scene stand against each other.

Everything is computed from `TileSums`, which add up: tiles may come from anywhere. Lengths are in the clouds' unit.
"""

from pcbench.deformation.answer import judge
from pcbench.deformation.clouds import deform
from pcbench.deformation.pairs import Side
from pcbench.deformation.residual import residual_deformation
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
