"""The verdict on the deformation of a candidate, in values and in words.

The names and the order of the fields are those of the JSON in a report. A value that does not exist is None. Lengths
are in the clouds' unit, shares from 0 to 1.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from pcbench.changes import Change
from pcbench.deformation.parts import (
    Amplitude,
    DetectableSize,
    Field,
    Growth,
    LocalChanges,
    ModelScore,
    NoiseSize,
    Observable,
    Shape,
    Tiles,
    Wave,
    WaveLimit,
    round_to_six_digits,
    scale_amplitude,
)
from pcbench.errors import Notice
from pcbench.geometry.arrays import FloatArray
from pcbench.io.json_values import from_json

BOTH_FROM_PHOTOGRAPHS = "both-from-photographs"  # errors that the clouds share, such as those of cameras, cannot show
NO_SIZE_LIMIT = "no-size-limit"  # no deformation is found, but one of any size may be there
POSE_NOT_FIXED = "pose-not-fixed"  # the geometry leaves some motion free: the verdict covers the constrained part
_CODES_IN_SENTENCE = (BOTH_FROM_PHOTOGRAPHS, POSE_NOT_FIXED)
_NOT_TESTED = "not tested"
NEGLIGIBLE_SHARE = 0.4  # share of the noise, white and correlated, below which a deformation is negligible
RESOLUTION_SHARE = 7.5e-3  # share of the spacing of the points that define the planes: they do not resolve less
_KINDS_IN_WORDS = {
    "dome": "a dome",
    "saddle": "a saddle",
    "S-bend": "an S-bend",
    "twist": "a twist about the vertical",
    "lean": "a lean that increases with height",
}
_MIN_VERTICAL_SHARE = 0.1  # of the tiles that constrain vertical displacements: below it, the surfaces hardly show them
_WHOLE_SURFACE = 0.7  # share of the surface from which the sentence does not name it
_LARGE_DISPLACEMENT_RATIO = 3.0  # of a kind's detectable displacement to that of a dome: the kind is then named


@dataclass(frozen=True)
class Deformation:
    """Verdict on the deformation of a candidate against the reference, with its size and location.

    Attributes:
        verdict: none, similarity, affine, non-affine or undecided; `not tested` if the test was not wanted.
        model: smallest adequate model: rigid, similarity, affine, quadratic or cubic; empty without a test.
        parameters: number of parameters of that model.
        p_value: probability that noise alone explains as much non-affine deformation; the largest over the sets of
            pairs.
        rungs: scores of all five models, from the smallest; see `ModelScore`.
        amplitude: size of the non-affine part.
        remaining_rms: RMS residual of the selected model, in the clouds' unit.
        coincides: whether every point of the candidate equals one of the reference up to rounding.
        noise: noise of the residuals.
        tiles: tiles of the scene.
        pairs: number of pairs of points.
        surface_share: share of the surface, in blocks of a tenth of the scene, whose pairs constrain the deformation;
            the verdict says nothing about the rest, which is too rough or differs otherwise.
        growth: trends of the vertical displacement.
        observable: observable directions.
        local: local changes.
        minimum_detectable_rms: RMS of the smallest dome that is detected with a power of 90 %.
        negligible_rms: RMS below which a deformation is negligible: 40 % of the noise, white and correlated, or 0.75 %
            of the spacing of the points that define the planes, whichever is larger.
        stated_rms: RMS of the smallest deformation that is stated as non-affine: from here on the interval of its size
            lies above `negligible_rms`.
        detectable: smallest detectable sizes by kind of deformation.
        shape: the shape of a stated deformation, with its figures; None if it has no simple one.
        wave: the wave that stands out of what the models leave; None if there is none.
        waves_from: range of wave lengths that were searched, and the size above which a wave is found.
        conditional_verdict: the verdict if the pose is right, where the registration is doubtful and `verdict` is
            therefore undecided; sizes and p-value then belong to it. None otherwise.
        warnings: codes and texts; for an undecided verdict, the reasons.
        field: the displacement per cell, a separate table in a report; None if there was nothing to test, and after
            `from_json`.
        changes: changes that were left out, if the deformation was tested by itself; in a comparison they are the
            candidate's. Not set by `from_json`.
    """

    verdict: str
    model: str
    parameters: int | None = None
    p_value: float | None = None
    rungs: tuple[ModelScore, ...] = ()
    amplitude: Amplitude | None = None
    remaining_rms: float | None = None
    coincides: bool = False
    noise: NoiseSize | None = None
    tiles: Tiles | None = None
    pairs: int | None = None
    surface_share: float | None = None
    growth: Growth | None = None
    observable: Observable | None = None
    local: LocalChanges | None = None
    minimum_detectable_rms: float | None = None
    negligible_rms: float | None = None
    stated_rms: float | None = None
    detectable: tuple[DetectableSize, ...] = ()
    shape: Shape | None = None
    wave: Wave | None = None
    waves_from: WaveLimit | None = None
    conditional_verdict: str | None = None
    warnings: tuple[Notice, ...] = ()
    field: Field | None = dataclasses.field(default=None, compare=False, metadata={"json": False})
    changes: tuple[Change, ...] = dataclasses.field(default=(), compare=False, metadata={"json": False})

    def __repr__(self) -> str:
        if not self.is_tested:
            return f"<Deformation: {self.verdict}>"
        size = "" if self.amplitude is None else f", bend {self.amplitude.rms:.3g} RMS"
        p = "" if self.p_value is None else f", {_p_value_text(self.p_value)}"
        return f"<Deformation: {self.verdict} ({self.model} model{size}{p})>"

    @classmethod
    def not_tested(cls) -> Deformation:
        """Return the result where the test was not wanted."""
        return cls(_NOT_TESTED, "")

    @classmethod
    def undecided_because(cls, reason: Notice) -> Deformation:
        """Return an undecided result, for data that allow no test."""
        return cls("undecided", "rigid", warnings=(reason,))

    @classmethod
    def from_json(cls, values: Mapping[str, Any]) -> Deformation:
        """Read `deformation.json`, or a candidate's `deformation` in `comparison.json`, without the field.

        Raises:
            KeyError, TypeError, ValueError: the content is not a deformation.
        """
        return from_json(cls, values)

    def sentence(self, name: str = "the candidate", unit: str = "", *, is_noise: bool = True) -> str:
        """Return the verdict as a sentence.

        It starts with its limitations: the reasons of an undecided verdict, or a pose that the geometry does not fix.

        Args:
            name: name of the candidate.
            unit: unit of the clouds.
            is_noise: whether noise explains the distances between the clouds, as far as known. Otherwise the sentence
                never says that the candidate equals the reference or is not deformed.
        """
        words = self._verdict_in_words(name, f" {unit}" if unit else "", is_noise)
        return self._reach_in_words() + words + self._origin_in_words()

    @property
    def is_tested(self) -> bool:
        """Return whether the deformation was tested."""
        return self.verdict != _NOT_TESTED

    @property
    def further_warnings(self) -> tuple[Notice, ...]:
        """Warnings that the sentence does not contain."""
        if self.verdict == "undecided":
            return ()
        return tuple(notice for notice in self.warnings if notice.code not in _CODES_IN_SENTENCE)

    @property
    def label(self) -> str:
        """Verdict for tables; a verdict that holds only if the pose is right is followed by `(?)`."""
        return self.verdict if self.conditional_verdict is None else f"{self.conditional_verdict} (?)"

    @property
    def size_limit(self) -> float | None:
        """RMS above which a dome is detected, and its interval above the negligible size."""
        limits = (self.minimum_detectable_rms, self.negligible_rms, self.stated_rms)
        return None if self.minimum_detectable_rms is None else max(limit for limit in limits if limit is not None)

    @property
    def limit_problem(self) -> str:
        """Reason why there is no `size_limit`, as a clause; empty if there is one, or if nothing is known."""
        hidden = {size.kind for size in self.detectable if size.displacement is None}
        if self.size_limit is not None or "dome" not in hidden:
            return ""
        is_seen = self.observable is not None and self.observable.z >= _MIN_VERTICAL_SHARE
        reason = "the clouds are too noisy" if is_seen else "the surfaces hardly show vertical displacements"
        return f"no size limit can be given, because {reason}"

    def without_empty_denial(self) -> Deformation:
        """Return the result as undecided if it denies a deformation of any size without a limit for it."""
        if "none" not in (self.verdict, self.conditional_verdict) or not self.limit_problem:
            return self
        others = [notice for notice in self.warnings if notice.code != POSE_NOT_FIXED]
        warnings = (Notice(NO_SIZE_LIMIT, self.limit_problem), *others)
        return replace(self, verdict="undecided", conditional_verdict=None, warnings=warnings)

    def _verdict_in_words(self, name: str, unit: str, is_noise: bool) -> str:
        if not self.is_tested:
            return f"{name} was not tested for deformation"
        if self.verdict == "undecided":
            reasons = "; ".join(notice.text for notice in self.warnings if notice.code != BOTH_FROM_PHOTOGRAPHS)
            text = f"{name}: whether it is deformed is undecided: {reasons}"
            if self.conditional_verdict is None:
                return text
            return f"{text}. If the pose is right, {self.assuming_pose()._verdict_in_words('it', unit, is_noise)}"
        if self.coincides and self.verdict == "none" and is_noise:
            return f"{name} equals the reference up to the rounding of coordinates: it is not deformed"
        unseen, shape = self._limit_in_words(unit), self._shape_in_words(unit)
        if self.verdict == "non-affine" and self.amplitude is not None:
            a = self.amplitude
            low, high = a.ci
            over = ""
            if a.rms_surface is not None and a.ci_surface is not None:
                least, most = a.ci_surface
                over = f", {a.rms_surface:.3g} [{least:.3g}, {most:.3g}]{unit} over the whole surface,"
            if self.wave is not None:
                return (
                    f"{name} is deformed: {a.rms:.3g} [{low:.3g}, {high:.3g}]{unit} RMS along the normals of smooth"
                    f" areas beyond any affine motion, of which {self._wave_in_words(unit)}"
                )
            return (
                f"{name} is deformed: {a.rms:.3g} [{low:.3g}, {high:.3g}]{unit} RMS along the normals of smooth areas"
                f"{over} beyond any affine motion ({self.model} model, {_p_value_text(self.p_value)}){shape}"
            )
        if self.verdict == "affine":
            return (
                f"{name} is sheared or stretched relative to the reference{shape}, without further deformation{unseen}"
            )
        if self.verdict == "similarity":
            return f"{name} differs from the reference in scale, without further deformation{unseen}"
        if not is_noise:
            return f"{name} shows no deformation as a whole{unseen}"
        return f"{name} is not deformed{unseen}"

    def _reach_in_words(self) -> str:
        """Return what the verdict is limited to, as the start of its sentence: a pose, or a part of the surface."""
        if self.verdict == "undecided":
            return ""
        limits = [notice.text for notice in self.warnings if notice.code == POSE_NOT_FIXED]
        if self.surface_share is not None and self.surface_share < _WHOLE_SURFACE:
            limits.append(f"for {self.surface_share:.0%} of the surface")
        return f"{', '.join(limits)}, " if limits else ""

    def _shape_in_words(self, unit: str) -> str:
        """Return the shape with its figures, as in `: a dome, +0.07 m in the centre, -0.11 m at the edge`."""
        if self.shape is None:
            return ""
        article = {"S-bend": "an "}.get(self.shape.name, "" if " " in self.shape.name else "a ")
        figures = ", ".join(f"{figure.value:+.2g}{unit} {figure.where}" for figure in self.shape.figures)
        return f": {article}{self.shape.name}, {figures}"

    def _wave_in_words(self, unit: str) -> str:
        """Return the size, length and direction of the wave."""
        if self.wave is None:
            return ""
        x, y, z = self.wave.direction
        angle = math.degrees(math.atan2(y, x)) % 180
        along = f"at {angle:.0f} degrees from x" if abs(z) < 0.1 else f"along ({x:.2f}, {y:.2f}, {z:.2f})"
        return (
            f"{self.wave.rms:.3g}{unit} in waves of {self.wave.length:.3g}{unit} {along}, displaced along"
            f" {self.wave.axis}"
        )

    def _origin_in_words(self) -> str:
        """Return what a comparison of two clouds from photographs cannot show."""
        verdict = self.verdict if self.conditional_verdict is None else self.conditional_verdict
        if verdict == "undecided" or all(notice.code != BOTH_FROM_PHOTOGRAPHS for notice in self.warnings):
            return ""
        whose = "either may be deformed, and " if verdict == "non-affine" else ""
        return f". Both clouds come from photographs: {whose}errors that they share (cameras, method) do not show"

    def assuming_pose(self) -> Deformation:
        """Return the result that holds if the pose is right: the conditional verdict, where there is one."""
        if self.conditional_verdict is None:
            return self
        return replace(self, verdict=self.conditional_verdict, conditional_verdict=None)

    def _limit_in_words(self, unit: str) -> str:
        """Return the size above which a deformation would have been stated, and kinds that have to be much larger."""
        limit = self.size_limit
        if limit is None:
            return f"; {self.limit_problem}" if self.limit_problem else ""
        of_noise = 0.0 if self.noise is None else NEGLIGIBLE_SHARE * self.noise.sigma
        share = ""
        if limit != self.minimum_detectable_rms and self.negligible_rms:
            of_what = f"{NEGLIGIBLE_SHARE * limit / self.negligible_rms:.0%} of the noise"
            if not math.isclose(self.negligible_rms, of_noise, rel_tol=1e-4):
                of_what = f"{RESOLUTION_SHARE * limit / self.negligible_rms:.2%} of the point spacing"
            share = f" ({of_what})"
        text = (
            f"; a smooth deformation (dome, saddle, S-bend) above {limit:.3g}{unit} RMS{share} would have been detected"
        )
        measurable = [size for size in self.detectable if size.displacement is not None]
        large = [size for size in measurable if (size.displacement or 0.0) > _LARGE_DISPLACEMENT_RATIO * limit]
        if large:
            parts = [f"{_in_words(size.kind)} above {size.displacement:.3g}{unit}" for size in large]
            text += f", and so would {' or '.join(parts)}"
        if (waves := self.waves_from) is not None:
            size = f"{waves.shortest:.3g} to {waves.longest:.3g}{unit} length above {waves.rms:.3g}{unit} RMS"
            text += f", and so would waves of {size}"
        if hidden := [_in_words(size.kind) for size in self.detectable if size.displacement is None]:
            text += f"; the surfaces do not show {' or '.join(hidden)}, however large"
        return text

    def shifted(self, origin: FloatArray) -> Deformation:
        """Return the same result in coordinates that include `origin` (3,)."""
        local, field = self.local, self.field
        if local is not None and local.at is not None:
            x, y, z = (float(here + there) for here, there in zip(local.at, origin, strict=True))
            local = replace(local, at=(x, y, z))
        return replace(self, local=local, field=field and replace(field, places=field.places + origin))

    def with_changes(self, whole: Deformation) -> Deformation:
        """Add the local changes and excluded cells of a result on all cells to this one, which excluded moved cells."""
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
        """Remove sizes, positions and p-value, which are meaningless if the pose may be wrong."""
        return replace(
            self,
            p_value=None,
            amplitude=None,
            growth=None,
            local=None,
            minimum_detectable_rms=None,
            negligible_rms=None,
            stated_rms=None,
            detectable=(),
            shape=None,
            wave=None,
            waves_from=None,
        )

    def without_rounding(self) -> Deformation:
        """Return the result for a candidate that equals the reference up to rounding: its sizes are zero."""
        return replace(
            self,
            coincides=True,
            remaining_rms=0.0,
            surface_share=1.0,
            rungs=tuple(replace(rung, cv_score=0.0, cv_se=0.0, rms_explained=0.0) for rung in self.rungs),
            amplitude=self.amplitude and scale_amplitude(self.amplitude, 0.0),
            noise=self.noise and replace(self.noise, sigma_white=0.0, sigma_correlated=0.0),
            minimum_detectable_rms=None if self.minimum_detectable_rms is None else 0.0,
            negligible_rms=None if self.negligible_rms is None else 0.0,
            stated_rms=None if self.stated_rms is None else 0.0,
            detectable=(),
            waves_from=None,
        )

    def with_waves(self, wave: Wave | None, limit: WaveLimit | None) -> Deformation:
        """Add a wave and the limit of the search for waves; the amplitude includes the wave."""
        if limit is not None and self.stated_rms is not None:
            limit = replace(limit, rms=max(limit.rms, self.stated_rms))
        amplitude = self.amplitude
        if wave is not None and amplitude is not None:
            rms = math.hypot(wave.rms, amplitude.rms)
            low, high = (math.hypot(*ends) for ends in zip(wave.ci, amplitude.ci, strict=True))
            most = math.sqrt(2) * wave.rms
            amplitude = Amplitude(rms, max(amplitude.p95, most), max(amplitude.max, most), (low, high))
        rounded: Deformation = round_to_six_digits(replace(self, amplitude=amplitude, wave=wave, waves_from=limit))
        return rounded

    def with_warnings(self, notes: Sequence[Notice]) -> Deformation:
        """Return the same result with further warnings."""
        return replace(self, warnings=(*self.warnings, *notes))


def _in_words(kind: str) -> str:
    """Return a kind of deformation with its article; kinds of other versions as they are."""
    return _KINDS_IN_WORDS.get(kind, f"a {kind}")


def _p_value_text(value: float | None) -> str:
    """Return a p-value as text; below 1e-9 only the bound."""
    if value is None:
        return "p unknown"
    return f"p = {value:.2g}" if value >= 1e-9 else "p < 1e-9"
