"""Test whether one cloud is deformed against another, and estimate how much and where.

A candidate point p is paired with the tangent plane (q, n) of the reference. The residuals r = n . (p - q) are linear
in the coefficients of a polynomial displacement field u of the candidate: r = n . u(x) + noise. Five models are nested:
rigid (6 parameters), similarity (7), affine (12), quadratic (30) and cubic (60) fields. The tests ask whether a larger
model explains more than noise would. The number of points is no measure of evidence: the noise of reconstructions is
correlated over metres, so that a million points may hold a few hundred independent observations. Therefore:

1. The covariance of the noise is estimated from the residuals of the largest model, so that deformation is not taken
   for noise. It is a scale that varies smoothly over the scene times white noise plus a positive mixture of Gaussian
   kernels of fixed lengths (a Gaussian mixture represents every isotropic covariance that is valid in all dimensions,
   Schoenberg 1938), fitted by the method of moments. The expected moments are exact: they account for the degrees of
   freedom that the fit used, as in REML (Patterson & Thompson 1971). Outliers are limited by pseudo-values (Huber
   1981), whose variance is that of the robust fit.
2. The test statistic of a model is the sum of squares that it explains beyond a smaller one, in least squares. Its null
   distribution is a weighted sum of chi squares. The weights are the eigenvalues of the scores' covariance under that
   noise.
3. Closest points are found under the largest model. If that gives evidence of deformation, they are found again without
   a model: in a volume such as a forest, closest points seem to confirm any assumed deformation. Both must agree.
4. The verdict is "undecided" if the evidence is borderline, the registration is doubtful, closest points do not
   correspond, or two parts of the scene are displaced against each other.

Everything is computed from `TileSums`, which are additive over pairs. Lengths are in the clouds' unit.
"""

from pcbench.deformation.answer import assess
from pcbench.deformation.clouds import deform
from pcbench.deformation.parts import (
    Amplitude,
    Bin,
    DetectableSize,
    Field,
    Growth,
    LocalChanges,
    ModelScore,
    NoiseSize,
    Observable,
    Shape,
    ShapeFigure,
    Tiles,
    Trend,
    Wave,
    WaveLimit,
)
from pcbench.deformation.residual import residual_deformation
from pcbench.deformation.result import Deformation
from pcbench.deformation.sides import Side
from pcbench.deformation.stable import SeparatedChanges, separate_changes
from pcbench.deformation.sums import TileSums

__all__ = [
    "Amplitude",
    "Bin",
    "Deformation",
    "DetectableSize",
    "Field",
    "ShapeFigure",
    "Growth",
    "LocalChanges",
    "NoiseSize",
    "Observable",
    "ModelScore",
    "Shape",
    "Side",
    "TileSums",
    "Tiles",
    "Trend",
    "Wave",
    "WaveLimit",
    "deform",
    "assess",
    "residual_deformation",
    "SeparatedChanges",
    "separate_changes",
]
