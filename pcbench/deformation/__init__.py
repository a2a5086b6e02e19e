"""Test for deformation of one cloud relative to another: is it deformed, by how much, and where?

A pair of a candidate point p and a tangent plane (q, n) of the reference has the residual r = n . (p - q). It is linear
in the coefficients of a polynomial displacement field u of the candidate: r = n . u(x) + noise. Five models are nested:
rigid (6 parameters), similarity (7), affine (12), quadratic (30) and cubic (60) fields. The test asks whether the
larger models explain more than noise would. Points must not be counted as independent: the noise of reconstructions is
correlated over metres, so that a million points may hold only a few hundred independent observations. Therefore:

1. The covariance of the noise is estimated from the residuals of the largest model, so that no deformation counts as
   noise. It is white noise plus a non-negative mixture of Gaussian kernels of fixed lengths, times a size that varies
   smoothly over the scene. (Each isotropic covariance that is valid in all dimensions is such a mixture, Schoenberg
   1938.) The variances are fitted by matching moments. Expected moments are corrected for the fitted model, as in REML
   (Patterson & Thompson 1971). Pseudo-values (Huber 1981) limit outliers and have the variance of the robust fit.
2. The test statistic of a model is the sum of squares that it explains beyond a smaller model. Its null distribution is
   a weighted sum of chi-squared variables; the weights are the eigenvalues of the scores' covariance under that noise.
3. Closest points are found under the largest model, and under none if that model is needed. In a volume such as a
   forest, closest points seem to confirm any assumed deformation. A deformation must appear in both.
4. Between clear evidence and none the verdict is "undecided". It is also undecided if the registration is doubtful, if
   closest points do not belong together, or if two parts of the scene are offset against each other.

All quantities are computed from `TileSums`, which are additive over tiles. Lengths are in the clouds' unit.
"""

from pcbench.deformation.answer import assess_deformation
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
    ModelScore,
    NoiseSize,
    Observable,
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
    "ModelScore",
    "Side",
    "TileSums",
    "Tiles",
    "Trend",
    "deform",
    "assess_deformation",
    "residual_deformation",
]
