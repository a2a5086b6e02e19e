"""The result types of the test for deformation. Names and order of their fields are those of the JSON.

Missing numbers are None. Lengths are in the clouds' unit, shares from 0 to 1.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from types import NoneType
from typing import Any, get_args, get_type_hints

import numpy as np
from numpy.typing import NDArray

from pcbench.errors import Notice
from pcbench.geometry.arrays import FloatArray, IntArray

POSE_NOT_FIXED = "pose-not-fixed"  # code of the warning that the geometry does not determine the pose
_MIN_MOVED_SIGMAS = 5.0  # change of a tile that is reported, in standard deviations of a pair's noise
Interval = tuple[float, float]  # lower and upper end, 95 %


@dataclass(frozen=True)
class ModelScore:
    """Cross-validation score of one of the five nested models.

    Attributes:
        model: rigid, similarity, affine, quadratic or cubic.
        parameters: number of its parameters.
        cv_score: mean square residual of held-out tiles, in squared units.
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
        rms: RMS over the pairs with the weights of the fit, so that smooth areas count more than rough ones.
        p95: 95th percentile of the RMS in a cell.
        max: maximum of the RMS in a cell.
        ci: 95 % confidence interval of `rms`.
        rms_surface: RMS over the surface by area, with walls and rough areas.
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
    """Noise of the residuals, in the clouds' unit.

    Attributes:
        sigma_white: standard deviation of the uncorrelated noise.
        sigma_correlated: standard deviation of the spatially correlated noise.
        correlation_length: length l of the kernel exp(-d^2 / 2 l^2) with the same integral.
        n_eff: effective number of independent pairs that would determine a deformation as precisely.
    """

    sigma_white: float
    sigma_correlated: float
    correlation_length: float
    n_eff: float


@dataclass(frozen=True)
class Tiles:
    """Tiles of the scene.

    Attributes:
        count: number of tiles with pairs.
        side: edge length, in the clouds' unit.
    """

    count: int
    side: float


@dataclass(frozen=True)
class Bin:
    """A bin of a profile, in the clouds' unit.

    Attributes:
        at: mean coordinate of the bin.
        mean: mean vertical displacement.
        ci: its 95 % confidence interval.
        null: half the width of the band that contains noise alone in 95 % of all cases.
    """

    at: float
    mean: float
    ci: Interval
    null: float


@dataclass(frozen=True)
class Trend:
    """Dependence of the vertical displacement on a coordinate.

    Attributes:
        slope: displacement per length.
        ci: its 95 % confidence interval.
        profile: means in up to eight bins of equal weight, in ascending order.
    """

    slope: float
    ci: Interval
    profile: tuple[Bin, ...]


@dataclass(frozen=True)
class Growth:
    """Trends of the vertical displacement; None if too little of the surface constrains it.

    Attributes:
        with_distance: trend with the horizontal distance from the centre.
        with_height: trend with the height.
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
class LocalChanges:
    """Parts of the scene that changed separately.

    Attributes:
        tiles_tested: number of cells with enough smooth surface for a test.
        tiles_changed: number of changed cells.
        fdr: their false discovery rate.
        largest: length of the largest change, in the clouds' unit; None without changes.
        at: its position.
    """

    tiles_tested: int
    tiles_changed: int
    fdr: float
    largest: float | None = None
    at: tuple[float, float, float] | None = None


@dataclass(frozen=True, eq=False)
class Field:
    """The deformation on M cells, one row each, as in the table `NAME_deformation.csv`.

    Attributes:
        places: (M, 3) mean positions of the pairs.
        displacements: (M, 3) displacements of the candidate relative to the reference by the chosen model, beyond the
            rigid motion, in the observable directions of each cell.
        vertical: (M,) measured mean vertical displacement beyond the rigid motion; NaN if not observable.
        sigma: (M,) standard deviation of `vertical` under the noise.
        local: (M,) length of the displacement beyond the largest model; NaN if a cell is not tested.
        changed: (M,) whether that exceeds noise, at a false discovery rate of 5 %.
        counts: (M,) number of pairs.
    """

    places: FloatArray
    displacements: FloatArray
    vertical: FloatArray
    sigma: FloatArray
    local: FloatArray
    changed: NDArray[np.bool_]
    counts: IntArray


@dataclass(frozen=True)
class Deformation:
    """Result of the test for deformation of a candidate relative to a reference.

    Attributes:
        verdict: none, similarity, affine, non-affine or undecided.
        model: the smallest sufficient model: rigid, similarity, affine, quadratic or cubic.
        parameters: number of its parameters.
        p_value: probability that noise alone, with its estimated covariance, looks at least as deformed. Of the pairs
            found with and without an assumed deformation the larger value counts.
        rungs: scores of the five nested models, from the smallest to the largest.
        amplitude: size of the non-affine part.
        remaining_rms: RMS residual of the chosen model, in the clouds' unit.
        noise: the noise.
        tiles: the tiles.
        pairs: number of pairs of points.
        growth: trends with distance and height.
        observable: observability along each axis.
        local: local changes.
        minimum_detectable_rms: RMS of a dome that is detected in 90 % of all cases.
        warnings: warnings with codes; for an undecided verdict the reasons.
        field: displacements of the cells, stored as a separate table; None without pairs, and after `from_json`.
    """

    verdict: str
    model: str
    parameters: int | None = None
    p_value: float | None = None
    rungs: tuple[ModelScore, ...] = ()
    amplitude: Amplitude | None = None
    remaining_rms: float | None = None
    noise: NoiseSize | None = None
    tiles: Tiles | None = None
    pairs: int | None = None
    growth: Growth | None = None
    observable: Observable | None = None
    local: LocalChanges | None = None
    minimum_detectable_rms: float | None = None
    warnings: tuple[Notice, ...] = ()
    field: Field | None = dataclasses.field(default=None, compare=False, metadata={"json": False})

    def __repr__(self) -> str:
        size = "" if self.amplitude is None else f", bend {self.amplitude.rms:.3g} RMS"
        p = "" if self.p_value is None else f", {_p(self.p_value)}"
        return f"<Deformation: {self.verdict} ({self.model} model{size}{p})>"

    @classmethod
    def without_evidence(cls, reason: Notice) -> Deformation:
        """Return an undecided result without evidence."""
        return cls("undecided", "rigid", warnings=(reason,))

    @classmethod
    def from_json(cls, values: Mapping[str, Any]) -> Deformation:
        """Return the result in `deformation.json` or a candidate's `deformation` in `comparison.json`, without field.

        Raises:
            KeyError, TypeError, ValueError: the values have another form.
        """
        texts = values["warnings"]
        codes = values.get("warning_codes") or [""] * len(texts)  # older reports have none
        notices = [{"code": code, "text": text} for code, text in zip(codes, texts, strict=True)]
        result: Deformation = _from_json(cls, {**values, "warnings": notices})
        return result

    def sentence(self, name: str = "the candidate", unit: str = "") -> str:
        """Return the verdict as a sentence without a period, with its limitations first.

        Args:
            name: name of the candidate.
            unit: unit of lengths.
        """
        notice = next((notice for notice in self.warnings if notice.code == POSE_NOT_FIXED), None)
        lead = "" if notice is None or self.verdict == "undecided" else f"{notice}, "
        return lead + self._verdict_in_words(name, f" {unit}" if unit else "")

    @property
    def further_warnings(self) -> tuple[Notice, ...]:
        """Warnings that the sentence does not contain."""
        if self.verdict == "undecided":
            return ()
        return tuple(notice for notice in self.warnings if notice.code != POSE_NOT_FIXED)

    def _verdict_in_words(self, name: str, unit: str) -> str:
        parts = self._parts_that_moved(unit)
        if self.verdict == "undecided":
            return f"{name} may or may not be deformed (undecided): {'; '.join(map(str, self.warnings))}{parts}"
        if self.remaining_rms == 0 and self.verdict == "none":
            return f"{name} is not deformed: it coincides with the reference up to rounding{parts}"
        limit = self.minimum_detectable_rms
        detectable = "" if limit is None else f"; a dome above {limit:.3g}{unit} RMS would have been detected"
        if self.verdict == "non-affine" and self.amplitude is not None:
            a = self.amplitude
            low, high = a.ci
            surface = "" if a.rms_surface is None else f", {a.rms_surface:.3g}{unit} over the whole surface,"
            return (
                f"{name} is deformed: {a.rms:.3g} [{low:.3g}, {high:.3g}]{unit} RMS along the normals of smooth"
                f" areas{surface} beyond any affine motion ({self.model} model, {_p(self.p_value)}){parts}"
            )
        if self.verdict == "affine":
            return f"{name} is sheared or stretched, but not deformed beyond that{detectable}{parts}"
        if self.verdict == "similarity":
            return f"{name} has another scale than the reference, but is not deformed beyond that{detectable}{parts}"
        whole = " as a whole" if parts else ""
        return f"{name} is not deformed{whole}{detectable}{parts}"

    @property
    def part_moved(self) -> bool:
        """Whether a part of the scene moved separately."""
        return bool(self._parts_that_moved(""))

    def _parts_that_moved(self, unit: str) -> str:
        local, noise = self.local, self.noise
        if local is None or local.largest is None or local.at is None or noise is None:
            return ""
        if local.largest < _MIN_MOVED_SIGMAS * math.hypot(noise.sigma_white, noise.sigma_correlated):
            return ""
        position = ", ".join(f"{x:.1f}" for x in local.at)
        return (
            f"; but a part moved separately: {local.largest:.3g}{unit} at ({position}), {local.tiles_changed} of"
            f" {local.tiles_tested} tiles changed"
        )

    def shifted(self, origin: FloatArray) -> Deformation:
        """Return the result with `origin` (3,) added to all positions."""
        local, field = self.local, self.field
        if local is not None and local.at is not None:
            x, y, z = (float(a + b) for a, b in zip(local.at, origin, strict=True))
            local = replace(local, at=(x, y, z))
        return replace(self, local=local, field=field and replace(field, places=field.places + origin))

    def with_changes(self, whole: Deformation) -> Deformation:
        """Return this result, computed without moved cells, with the changes and cells of a result on all cells."""
        if self.field is None or whole.field is None:
            return self
        present = {tuple(place) for place in self.field.places.tolist()}
        is_missing = np.array([tuple(place) not in present for place in whole.field.places.tolist()])
        parts = {
            name: np.concatenate([getattr(self.field, name), getattr(whole.field, name)[is_missing]])
            for name in Field.__annotations__
        }
        return replace(self, local=whole.local, field=Field(**parts))

    def without_sizes(self) -> Deformation:
        """Return the result without sizes, positions and evidence, which are meaningless if the pose may be wrong."""
        return replace(
            self,
            p_value=None,
            amplitude=None,
            growth=None,
            local=None,
            minimum_detectable_rms=None,
        )

    def without_rounding(self, rounding: float) -> Deformation:
        """Return the result with zero sizes if the residual is within the rounding of coordinates."""
        if self.remaining_rms is None or self.remaining_rms > rounding:
            return self
        return replace(
            self,
            remaining_rms=0.0,
            rungs=tuple(replace(row, cv_score=0.0, cv_se=0.0, rms_explained=0.0) for row in self.rungs),
            amplitude=self.amplitude and _scaled(self.amplitude, 0.0),
            noise=self.noise and replace(self.noise, sigma_white=0.0, sigma_correlated=0.0),
            minimum_detectable_rms=None if self.minimum_detectable_rms is None else 0.0,
        )

    def with_warnings(self, notes: Sequence[Notice]) -> Deformation:
        """Return the result with additional warnings."""
        return replace(self, warnings=(*self.warnings, *notes))


def _scaled(amplitude: Amplitude, factor: float) -> Amplitude:
    """Return an amplitude times a factor."""

    def times(value: Any) -> Any:
        return tuple(map(times, value)) if isinstance(value, tuple) else None if value is None else factor * value

    return Amplitude(*(times(getattr(amplitude, item.name)) for item in dataclasses.fields(amplitude)))


def _p(value: float | None) -> str:
    """Return a p-value as text, at least 1e-9."""
    if value is None:
        return "p unknown"
    return f"p = {value:.2g}" if value >= 1e-9 else "p < 1e-9"


def rounded(value: Any) -> Any:
    """Return values rounded to six digits, which do not depend on the number of threads of the linear algebra."""
    if isinstance(value, float):
        return float(f"{value:.6g}")
    if isinstance(value, tuple):
        return tuple(map(rounded, value))
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        return replace(value, **{item.name: rounded(getattr(value, item.name)) for item in dataclasses.fields(value)})
    return value


def _from_json(kind: Any, value: Any) -> Any:
    """Convert a JSON value to a type: a dataclass, a tuple, a plain type, or one of these or None."""
    if value is None:
        return None
    kind = next((part for part in get_args(kind) if NoneType in get_args(kind) and part is not NoneType), kind)
    if isinstance(kind, type) and dataclasses.is_dataclass(kind):
        hints = get_type_hints(kind)
        names = [item.name for item in dataclasses.fields(kind) if item.metadata.get("json", True)]
        # Older reports have fewer fields: missing ones get their defaults.
        return kind(**{name: _from_json(hints[name], value[name]) for name in names if name in value})
    if get_args(kind):  # tuple[X, ...] or tuple[X, X]
        return tuple(_from_json(get_args(kind)[0], part) for part in value)
    return value
