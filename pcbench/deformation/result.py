"""The answer as types: the names and the order of their fields are those of the JSON that a report holds.

A number that does not exist is None. Lengths are in the clouds' unit, shares from 0 to 1.
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

POSE_NOT_FIXED = "pose-not-fixed"  # the geometry does not fix some motion: the verdict speaks of what it does fix
_MOVED = 5.0  # standard deviations of a pair's noise, from which on a changed tile is worth a word
Interval = tuple[float, float]  # lower and upper end, 95 %


@dataclass(frozen=True)
class Rung:
    """How well one of the five nested models does.

    Attributes:
        model: rigid, similarity, affine, quadratic or cubic.
        parameters: their number.
        cv_score: mean square residual of tiles that were left out of the fit, in squared units.
        cv_se: standard error of `cv_score`, in squared units.
        bic_eff: Bayesian information criterion with the effective number of pairs.
        rms_explained: along the normals, beyond the rigid model, in the clouds' unit.
    """

    model: str
    parameters: int
    cv_score: float
    cv_se: float
    bic_eff: float
    rms_explained: float


@dataclass(frozen=True)
class Amplitude:
    """Size of the displacement along the normals beyond an affine one, in the clouds' unit, freed of noise.

    Attributes:
        rms: over the pairs as they count in the fit: smooth places count more than rough ones.
        p95, max: of the RMS in a cell.
        ci: 95 % interval of `rms`.
        rms_surface: over the surface by its area, walls and rough places included.
        ci_surface: 95 % interval of `rms_surface`.
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
        sigma_white: standard deviation of what differs from pair to pair.
        sigma_correlated: standard deviation of what neighbouring pairs share.
        correlation_length: l of the kernel exp(-d^2 / 2 l^2) that covers the same area.
        n_eff: independent pairs that would determine a bend as well.
    """

    sigma_white: float
    sigma_correlated: float
    correlation_length: float
    n_eff: float


@dataclass(frozen=True)
class Tiles:
    """The tiles that the scene is cut into.

    Attributes:
        count: tiles that hold pairs.
        side: their edge, in the clouds' unit.
    """

    count: int
    side: float


@dataclass(frozen=True)
class Bin:
    """One place of a profile, in the clouds' unit: where it is `at`, the `mean` vertical displacement there with its
    95 % interval `ci`, and `null`, half the width of the band that noise alone would fill in 95 % of all cases.
    """

    at: float
    mean: float
    ci: Interval
    null: float


@dataclass(frozen=True)
class Trend:
    """How the vertical displacement goes with a coordinate.

    Attributes:
        slope: displacement per length.
        ci: its 95 % interval.
        profile: means in up to eight bins of equal weight, in ascending order.
    """

    slope: float
    ci: Interval
    profile: tuple[Bin, ...]


@dataclass(frozen=True)
class Growth:
    """Trends of the vertical displacement with the horizontal distance from the centre and with the height; None where
    too little of the surface shows it.
    """

    with_distance: Trend | None
    with_height: Trend | None


@dataclass(frozen=True)
class Observable:
    """Share of the tiles whose surfaces show a displacement along each axis."""

    x: float
    y: float
    z: float


@dataclass(frozen=True)
class LocalChanges:
    """Parts of the scene that changed by themselves.

    Attributes:
        tiles_tested: cells that hold enough to tell.
        tiles_changed: those of them that changed.
        fdr: the false discovery rate of these.
        largest: the length of the largest change, in the clouds' unit; None where there is none.
        at: its place.
    """

    tiles_tested: int
    tiles_changed: int
    fdr: float
    largest: float | None = None
    at: tuple[float, float, float] | None = None


@dataclass(frozen=True, eq=False)
class Field:
    """The deformation on the cells, one row each (M,): what the table `NAME_deformation.csv` holds.

    Attributes:
        places: (M, 3) mean places of the pairs.
        displacements: (M, 3) of the candidate against the reference by the chosen model, beyond the rigid motion; only
            along directions that the surface in the cell shows.
        vertical: measured mean vertical displacement beyond the rigid motion, from all pairs in the cell; NaN where no
            surface there shows it.
        sigma: standard deviation of `vertical` under the noise.
        local: length of what the largest model leaves of the cell's displacement; NaN where a cell holds too little for
            its changes to be told.
        changed: whether that is more than noise, at a false discovery rate of 5 %.
        counts: pairs.
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
    """Is the candidate deformed against the reference, how much, and where?

    Attributes:
        verdict: none, similarity, affine, non-affine or undecided.
        model: the smallest that is needed: rigid, similarity, affine, quadratic or cubic.
        parameters: of that model.
        p_value: how often noise alone would look as bent: under the estimated noise, the largest over the pairs that
            were found in different ways.
        rungs: all five models, from the smallest.
        amplitude: of the non-affine part.
        remaining_rms: RMS residual of the chosen model, in the clouds' unit.
        noise, tiles: see there.
        pairs: of points, of which everything is computed.
        growth, observable, local: see there.
        minimum_detectable_rms: of a dome that would be found in 90 % of all cases.
        warnings: codes and texts; of an undecided verdict the reasons.
        field: the displacement on the cells, which a report holds as a table of its own; None where nothing could be
            asked, and in what `from_json` reads.
    """

    verdict: str
    model: str
    parameters: int | None = None
    p_value: float | None = None
    rungs: tuple[Rung, ...] = ()
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
    def unanswered(cls, reason: Notice) -> Deformation:
        """Undecided, for want of anything to decide on."""
        return cls("undecided", "rigid", warnings=(reason,))

    @classmethod
    def from_json(cls, values: Mapping[str, Any]) -> Deformation:
        """What `deformation.json`, or a candidate's `deformation` in `comparison.json`, holds; without the field.

        Raises:
            KeyError, TypeError, ValueError: it holds something else.
        """
        texts = values["warnings"]
        codes = values.get("warning_codes") or [""] * len(texts)  # older reports hold none
        notices = [{"code": code, "text": text} for code, text in zip(codes, texts, strict=True)]
        found: Deformation = _structured(cls, {**values, "warnings": notices})
        return found

    def sentence(self, name: str = "the candidate", unit: str = "") -> str:
        """The verdict on a candidate of that name in words; `unit` is the clouds'.

        It begins with what limits it: the reasons of an undecided one, and a pose that the geometry does not fix.
        """
        notice = next((notice for notice in self.warnings if notice.code == POSE_NOT_FIXED), None)
        lead = "" if notice is None or self.verdict == "undecided" else f"{notice}, "
        return lead + self._verdict_in_words(name, f" {unit}" if unit else "")

    @property
    def further_warnings(self) -> tuple[Notice, ...]:
        """Those that the sentence does not hold."""
        if self.verdict == "undecided":
            return ()
        return tuple(notice for notice in self.warnings if notice.code != POSE_NOT_FIXED)

    def _verdict_in_words(self, name: str, unit: str) -> str:
        parts = self._parts_that_moved(unit)
        if self.verdict == "undecided":
            return f"{name}: whether it is deformed is undecided: {'; '.join(map(str, self.warnings))}{parts}"
        if self.remaining_rms == 0 and self.verdict == "none":
            return f"{name} lies on the reference but for the rounding of coordinates: it is not deformed{parts}"
        limit = self.minimum_detectable_rms
        unseen = "" if limit is None else f" (a dome of {limit:.3g}{unit} RMS would show)"
        if self.verdict == "non-affine" and self.amplitude is not None:
            a = self.amplitude
            low, high = a.ci
            over = "" if a.rms_surface is None else f", {a.rms_surface:.3g}{unit} over the whole surface,"
            return (
                f"{name} is bent against the reference: {a.rms:.3g} [{low:.3g}, {high:.3g}]{unit} RMS along the normals"
                f" of smooth places{over} beyond any affine motion ({self.model} model, {_p(self.p_value)}){parts}"
            )
        if self.verdict == "affine":
            return f"{name} is sheared or stretched against the reference, but not bent{unseen}{parts}"
        if self.verdict == "similarity":
            return f"{name} has another scale than the reference, but is not bent{unseen}{parts}"
        whole = " as a whole" if parts else ""
        return f"{name} is not deformed against the reference{whole}{unseen}{parts}"

    @property
    def part_moved(self) -> bool:
        """Whether a part of the scene surely moved by itself."""
        return bool(self._parts_that_moved(""))

    def _parts_that_moved(self, unit: str) -> str:
        local, noise = self.local, self.noise
        if local is None or local.largest is None or local.at is None or noise is None:
            return ""
        if local.largest < _MOVED * math.hypot(noise.sigma_white, noise.sigma_correlated):
            return ""
        place = ", ".join(f"{x:.1f}" for x in local.at)
        return (
            f"; but a part moved by itself: {local.largest:.3g}{unit} at ({place}), {local.tiles_changed} of"
            f" {local.tiles_tested} tiles changed"
        )

    def shifted(self, origin: FloatArray) -> Deformation:
        """The same in coordinates that still carry `origin` (3,)."""
        local, field = self.local, self.field
        if local is not None and local.at is not None:
            x, y, z = (float(here + there) for here, there in zip(local.at, origin, strict=True))
            local = replace(local, at=(x, y, z))
        return replace(self, local=local, field=field and replace(field, places=field.places + origin))

    def with_changes(self, whole: Deformation) -> Deformation:
        """This answer, which left out cells that moved, with the changes and the cells that an answer on all of them
        holds.
        """
        if self.field is None or whole.field is None:
            return self
        kept = {tuple(place) for place in self.field.places.tolist()}
        left_out = np.array([tuple(place) not in kept for place in whole.field.places.tolist()])
        parts = {
            name: np.concatenate([getattr(self.field, name), getattr(whole.field, name)[left_out]])
            for name in Field.__annotations__
        }
        return replace(self, local=whole.local, field=Field(**parts))

    def withheld(self) -> Deformation:
        """Without the sizes, the places and the evidence, which mean nothing where the pose may be wrong."""
        return replace(
            self,
            p_value=None,
            amplitude=None,
            growth=None,
            local=None,
            minimum_detectable_rms=None,
        )

    def without_rounding(self, rounding: float) -> Deformation:
        """Where all that remains is the rounding of coordinates, sizes that come of it are zero."""
        if self.remaining_rms is None or self.remaining_rms > rounding:
            return self
        return replace(
            self,
            remaining_rms=0.0,
            rungs=tuple(replace(rung, cv_score=0.0, cv_se=0.0, rms_explained=0.0) for rung in self.rungs),
            amplitude=self.amplitude and _scaled(self.amplitude, 0.0),
            noise=self.noise and replace(self.noise, sigma_white=0.0, sigma_correlated=0.0),
            minimum_detectable_rms=None if self.minimum_detectable_rms is None else 0.0,
        )

    def with_warnings(self, notes: Sequence[Notice]) -> Deformation:
        return replace(self, warnings=(*self.warnings, *notes))


def _scaled(amplitude: Amplitude, factor: float) -> Amplitude:
    """The same times a factor."""

    def times(value: Any) -> Any:
        return tuple(map(times, value)) if isinstance(value, tuple) else None if value is None else factor * value

    return Amplitude(*(times(getattr(amplitude, item.name)) for item in dataclasses.fields(amplitude)))


def _p(value: float | None) -> str:
    """A p-value in words: beyond a billionth it says nothing more."""
    if value is None:
        return "p unknown"
    return f"p = {value:.2g}" if value >= 1e-9 else "p < 1e-9"


def rounded(value: Any) -> Any:
    """Six digits: what a statistic is worth, and the same at any number of threads of the linear algebra."""
    if isinstance(value, float):
        return float(f"{value:.6g}")
    if isinstance(value, tuple):
        return tuple(map(rounded, value))
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        return replace(value, **{item.name: rounded(getattr(value, item.name)) for item in dataclasses.fields(value)})
    return value


def _structured(kind: Any, value: Any) -> Any:
    """A value of JSON as the type (a dataclass, a tuple, a plain type, or one of them or None) that was written so."""
    if value is None:
        return None
    kind = next((part for part in get_args(kind) if NoneType in get_args(kind) and part is not NoneType), kind)
    if isinstance(kind, type) and dataclasses.is_dataclass(kind):
        hints = get_type_hints(kind)
        names = [item.name for item in dataclasses.fields(kind) if item.metadata.get("json", True)]
        # Older reports hold fewer: what is missing takes its default, or is refused where it has none.
        return kind(**{name: _structured(hints[name], value[name]) for name in names if name in value})
    if get_args(kind):  # tuple[X, ...] or tuple[X, X]
        return tuple(_structured(get_args(kind)[0], part) for part in value)
    return value
