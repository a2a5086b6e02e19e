"""Parts of a `Deformation`; the names and the order of the fields are those of the JSON in a report.

A value that does not exist is None. Lengths are in the clouds' unit, shares from 0 to 1.
"""

from __future__ import annotations

import dataclasses
import math
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pcbench.geometry.arrays import FloatArray, IntArray

Interval = tuple[float, float]  # lower and upper end, 95 %


@dataclass(frozen=True)
class ModelScore:
    """Score of one of the five nested models; `Deformation.rungs` and the JSON key `rungs` hold these.

    Attributes:
        model: rigid, similarity, affine, quadratic or cubic.
        parameters: number of parameters.
        cv_score: cross-validated mean squared residual, of tiles left out of the fit, in squared units.
        cv_se: standard error of `cv_score`, in squared units.
        bic_eff: Bayesian information criterion with the effective number of pairs.
        rms_explained: RMS displacement along the normals beyond the rigid model, in the clouds' unit.
    """

    model: str
    parameters: int
    cv_score: float
    cv_se: float
    bic_eff: float
    rms_explained: float


@dataclass(frozen=True)
class Amplitude:
    """Size of the displacement along the normals beyond an affine one, in the clouds' unit, corrected for noise.

    Attributes:
        rms: RMS over the pairs with their weights in the fit: smooth areas have more weight than rough ones.
        p95, max: 95th percentile and maximum of the RMS per cell.
        ci: 95 % confidence interval of `rms`.
        rms_surface: RMS over the surface by area, including walls and rough areas.
        ci_surface: 95 % confidence interval of `rms_surface`.
    """

    rms: float
    p95: float
    max: float
    ci: Interval
    rms_surface: float | None = None
    ci_surface: Interval | None = None


@dataclass(frozen=True)
class NoiseSize:
    """The residuals' noise, in the clouds' unit.

    Attributes:
        sigma_white: standard deviation of the noise that is independent between pairs.
        sigma_correlated: standard deviation of the noise that is correlated between neighbouring pairs.
        correlation_length: l of the Gaussian kernel exp(-d^2 / 2 l^2) with the same integral as the mixture.
        n_eff: effective number of pairs: independent ones that would determine a deformation as well.
    """

    sigma_white: float
    sigma_correlated: float
    correlation_length: float
    n_eff: float

    @property
    def sigma(self) -> float:
        """Standard deviation of all noise, independent and correlated."""
        return math.hypot(self.sigma_white, self.sigma_correlated)


@dataclass(frozen=True)
class Tiles:
    """Tiles of the scene.

    Attributes:
        count: number of tiles that contain pairs.
        side: edge of a tile, in the clouds' unit.
    """

    count: int
    side: float


@dataclass(frozen=True)
class Bin:
    """One bin of a profile, in the clouds' unit.

    Attributes:
        at: mean coordinate of the bin.
        mean: mean vertical displacement.
        ci: 95 % confidence interval of `mean`.
        null: half width of the band that contains 95 % of the means under noise alone.
    """

    at: float
    mean: float
    ci: Interval
    null: float


@dataclass(frozen=True)
class Trend:
    """Trend of the vertical displacement along a coordinate.

    Attributes:
        slope: displacement per length.
        ci: 95 % confidence interval of the slope.
        profile: means in up to eight bins of equal weight, in ascending order.
    """

    slope: float
    ci: Interval
    profile: tuple[Bin, ...]


@dataclass(frozen=True)
class Growth:
    """Trends of the vertical displacement with the horizontal distance from the centre and with the height.

    A trend is None if too little of the surface constrains it.
    """

    with_distance: Trend | None
    with_height: Trend | None


@dataclass(frozen=True)
class Observable:
    """Share of the tiles whose surfaces constrain a displacement along each axis."""

    x: float
    y: float
    z: float


@dataclass(frozen=True)
class DetectableSize:
    """Size above which a kind of deformation is found and stated, in the clouds' unit.

    Attributes:
        kind: dome, saddle, S-bend (a cubic vertical displacement along x), twist (about the vertical), or lean (a
            horizontal displacement that grows with the square of the height).
        rms: RMS along the normals beyond an affine motion that is detected with a power of 90 % and is not negligible;
            None if the surfaces hardly constrain this kind.
        displacement: RMS length of the same displacement, in all directions.
    """

    kind: str
    rms: float | None = None
    displacement: float | None = None


@dataclass(frozen=True)
class ShapeFigure:
    """Mean displacement of the candidate at one place of a shape, positive upwards or outwards, in the clouds' unit."""

    where: str
    value: float


@dataclass(frozen=True)
class Shape:
    """The shape of a deformation in a word.

    Attributes:
        name: dome, bowl, saddle, S-bend, twist, growth with distance, growth with height, or stretch or shear.
        share: share of the mean squared displacement beyond a rigid motion that the shape explains.
        figures: displacement at both of its ends.
    """

    name: str
    share: float
    figures: tuple[ShapeFigure, ...]


@dataclass(frozen=True)
class Wave:
    """A wave of the displacement that is shorter than a cubic field shows, such as an error from strip to strip.

    Attributes:
        length: from crest to crest, in the clouds' unit.
        direction: unit vector from crest to crest.
        axis: axis x, y or z of the displacement.
        rms: RMS displacement along the normals, in the clouds' unit.
        ci: 95 % confidence interval of `rms`.
        gain: standard errors by which the wave, fitted to half of the tiles, predicts the other half better than none.
    """

    length: float
    direction: tuple[float, float, float]
    axis: str
    rms: float
    ci: Interval
    gain: float


@dataclass(frozen=True)
class WaveLimit:
    """Size above which waves are found and stated, in the clouds' unit.

    Attributes:
        shortest, longest: range of the lengths that were searched.
        rms: RMS along the normals of a wave, across the plane of the scene, that is found with a power of 90 %.
    """

    shortest: float
    longest: float
    rms: float


@dataclass(frozen=True)
class LocalChanges:
    """Parts of the scene that changed locally.

    Attributes:
        tiles_tested: number of cells with enough smooth surface for a test.
        tiles_changed: number of tested cells that changed.
        fdr: false discovery rate of the tests.
        largest: length of the largest change, in the clouds' unit; None if there is none.
        at: position of the largest change.
        largest_group: number of changed cells in the largest group of adjacent ones.
    """

    tiles_tested: int
    tiles_changed: int
    fdr: float
    largest: float | None = None
    at: tuple[float, float, float] | None = None
    largest_group: int = 0


@dataclass(frozen=True, eq=False)
class Field:
    """The deformation per cell, one row each (M,), as in the table `NAME_deformation.csv`.

    Attributes:
        places: (M, 3) mean positions of the pairs.
        displacements: (M, 3) displacement of the candidate by the selected model, beyond the rigid motion, in the
            directions that the surface in the cell constrains.
        vertical: mean vertical displacement beyond the rigid motion, from all pairs in the cell; NaN if the surface
            does not constrain it.
        sigma: standard error of `vertical`.
        local: length of the cell's displacement from the largest model; NaN if the cell was not tested.
        changed: whether the cell changed locally, at a false discovery rate of 5 %.
        counts: number of pairs.
    """

    places: FloatArray
    displacements: FloatArray
    vertical: FloatArray
    sigma: FloatArray
    local: FloatArray
    changed: NDArray[np.bool_]
    counts: IntArray


def scale_amplitude(amplitude: Amplitude, factor: float) -> Amplitude:
    """Return the amplitude times a factor."""

    def times(value: Any) -> Any:
        return tuple(map(times, value)) if isinstance(value, tuple) else None if value is None else factor * value

    return Amplitude(*(times(getattr(amplitude, item.name)) for item in dataclasses.fields(amplitude)))


def round_to_six_digits(value: Any) -> Any:
    """Round to six significant digits: more carry no information and depend on the number of threads."""
    if isinstance(value, float):
        return float(f"{value:.6g}")
    if isinstance(value, tuple):
        return tuple(map(round_to_six_digits, value))
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        return replace(
            value, **{item.name: round_to_six_digits(getattr(value, item.name)) for item in dataclasses.fields(value)}
        )
    return value
