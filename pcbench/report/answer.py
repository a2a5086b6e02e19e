"""The answer in sentences: how far, where, why, and which numbers can be trusted."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import NamedTuple

from pcbench.measure.budget import MAX_NOISE_RATIO
from pcbench.measure.intervals import Interval
from pcbench.measure.results import CANDIDATE_TO_REFERENCE, REFERENCE_TO_CANDIDATE, Candidate
from pcbench.measure.wording import pluralize
from pcbench.registration.result import (
    AMBIGUOUS,
    DOUBTFUL_POSE,
    FAR_OFF,
    FEW_POINTS,
    MIRRORED,
    NO_CONVERGENCE,
    UNIT_MISMATCH,
    UNKNOWN_SCALE,
)
from pcbench.registration.rounding import COARSE_STEP
from pcbench.report.budget import budget_sentence, changes_of, changes_sentence, largest_part, source_words
from pcbench.report.checked import check_point_sentences
from pcbench.report.inputs import FinishedComparison
from pcbench.report.moved import is_offset, place_sentence
from pcbench.report.notes import CLAIMS, deformation_sentence, is_open, overlaps_little
from pcbench.report.pose import doubt_clause, fit_sentence, open_clause
from pcbench.report.ranking import leaders
from pcbench.report.words import (
    interval_text,
    join_words,
    length,
    percentage,
    position_text,
    rounding_limit,
    shorten_name,
)

_MAX_SENTENCES = 4  # besides the one on changes
_MIN_OUTLIER_RATIO = 2.0  # an RMS above this multiple of the NMAD indicates outliers
_MAX_NAME_COLUMNS = 28
_UNPROVEN = "none, unproven"
_MAX_PLACES = 3  # candidates whose place as a whole is stated
_ALTERNATIVE_METHODS = {  # values of --register to suggest, by method
    "global": "global (from any pose), global-similarity (also at any scale)",
    "points": "points:FILE (control points)",
    "matrix": "matrix:FILE (a known pose)",
}

_VERDICTS = {  # of one and of several candidates, deformed ones first
    "non-affine": ("is deformed", "are deformed"),
    "affine": ("is sheared or stretched", "are sheared or stretched"),
    "similarity": ("has another scale", "have another scale"),
    "none": ("is not deformed", "are not deformed"),
    _UNPROVEN: ("shows no deformation as a whole", "show no deformation as a whole"),
    "undecided": ("may or may not be deformed (undecided)", "may or may not be deformed (undecided)"),
    "not tested": ("was not tested for deformation", "were not tested for deformation"),
}
_DOUBTS = {  # why poses are doubtful, by the code of the warning
    FEW_POINTS: "too few points overlap",
    UNKNOWN_SCALE: "the geometry does not fix the scale",
    UNIT_MISMATCH: "the sizes suggest different units",
    MIRRORED: "mirrored",
    FAR_OFF: "far from the reference",
    NO_CONVERGENCE: "ICP did not converge",
    AMBIGUOUS: "another pose fits about as well",
    DOUBTFUL_POSE: "the fit does not single out one pose",
}


class _Distance(NamedTuple):
    """A distance by which candidates are ranked, in the clouds' unit.

    Attributes:
        value: the distance.
        floor: its sampling floor, if known.
        interval: its 95 % confidence interval, if known.
        metric: its name in the list of differences.
        label: the kind of mean, as worded in sentences.
        target: what it is measured to in the reference: points or surface.
    """

    value: float
    floor: float | None
    interval: Interval | None
    metric: str
    label: str
    target: str = "points"

    @property
    def is_sampling(self) -> bool:
        """Return whether point spacing explains the distance."""
        return self.floor is None or self.value <= MAX_NOISE_RATIO * self.floor


def answer(comparison: FinishedComparison) -> list[str]:
    """Return two to five sentences on a comparison, without distances if all registrations are doubtful.

    A sentence before them says where candidates lie as a whole, if registration moved them or none was made. Offsets
    come after them if a part changed by more. The last one states the accuracy by check points, if there are any.
    """
    return [*_answer(comparison), *check_point_sentences(comparison)]


def _answer(comparison: FinishedComparison) -> list[str]:
    trusted = [c for c in comparison if c.registration.is_ranked]
    doubtful = [c for c in comparison if not c.registration.is_ranked]
    writer = _Writer(comparison)
    if not trusted:
        return writer.of_doubtful(doubtful)
    sentences = writer.cautions(doubtful, [c for c in trusted if is_open(c)])
    sentences += writer.of_one(trusted[0]) if len(trusted) == 1 else writer.of_several(trusted)
    sentences = sentences[: _MAX_SENTENCES + any(map(changes_of, trusted))]
    places = writer.places(trusted)
    return [*sentences, *places] if _have_larger_changes(comparison, trusted) else [*places, *sentences]


def _have_larger_changes(comparison: FinishedComparison, candidates: Sequence[Candidate]) -> bool:
    """Return whether a part changed by more than all offsets of the whole candidates, of which there are some."""
    offsets = [abs(c.offset.median) for c in candidates if c.offset is not None and is_offset(comparison, c)]
    changes = (change.distance for candidate in candidates for change in changes_of(candidate))
    return bool(offsets) and max(changes, default=0.0) > max(offsets)


class _Writer:
    """Writes sentences about the candidates of a comparison, with units and shortened names."""

    def __init__(self, comparison: FinishedComparison) -> None:
        self.comparison = comparison
        names = [c.name for c in comparison]
        short = [shorten_name(name, _MAX_NAME_COLUMNS) for name in names]
        self.names = dict(zip(names, short if len(set(short)) == len(set(names)) else names, strict=True))

    def length(self, value: float | None) -> str:
        """Return a length with the unit of the comparison."""
        return length(value, self.comparison.reference.unit)

    def name_list(self, candidates: Sequence[Candidate]) -> str:
        """Return the names of candidates as a list in words."""
        return join_words([self.names[c.name] for c in candidates])

    def of_doubtful(self, candidates: Sequence[Candidate]) -> list[str]:
        """Return the sentences for a comparison whose registrations are all doubtful."""
        tried = {c.registration.method.partition(":")[0].partition("-")[0] for c in candidates}
        methods = [text for name, text in _ALTERNATIVE_METHODS.items() if name not in tried]
        assumed = [
            replace(c, deformation=c.deformation.assuming_pose())
            for c in candidates
            if c.deformation.conditional_verdict is not None
        ]
        condition = "If these poses are right" if len(candidates) > 1 else "If the pose is right"
        if all(c.registration.doubts[0].code == MIRRORED for c in candidates):
            remedy = "No registration undoes a reflection; the warnings name the command that does."
        else:
            remedy = f"Try --register {', '.join(methods[:-1])} or {methods[-1]}."
        return [
            f"{self._doubt(candidates)}.",
            *([f"{condition}: {self._deformations(assumed)}."] if assumed else []),
            remedy,
        ]

    def cautions(self, doubtful: Sequence[Candidate], unconstrained: Sequence[Candidate]) -> list[str]:
        """Return one sentence on doubtful and unconstrained registrations, or none."""
        parts = []
        if doubtful:
            parts.append(f"{self._doubt(doubtful)}, so the ranking excludes {'them' if len(doubtful) > 1 else 'it'}")
        if unconstrained:
            parts.append(open_clause(self.name_list(unconstrained)))
        return [f"{'. '.join(parts)}."] if parts else []

    def _doubt(self, doubtful: Sequence[Candidate]) -> str:
        """Return which registrations are doubtful and why: one in the words of its warning, several in short."""
        if len(doubtful) == 1:
            return doubt_clause(doubtful[0].registration, self.name_list(doubtful))
        by_code: dict[str, list[Candidate]] = {}
        for candidate in doubtful:
            by_code.setdefault(candidate.registration.doubts[0].code, []).append(candidate)
        clauses = [
            f"{'' if len(by_code) == 1 else f'{self.name_list(group)}: '}{_DOUBTS[code]}"
            for code, group in by_code.items()
        ]
        return (
            f"The registrations of {self.name_list(doubtful)} are doubtful ({'; '.join(clauses)}): their numbers"
            " describe poses that may be wrong"
        )

    def places(self, candidates: Sequence[Candidate]) -> list[str]:
        """Return one sentence on where candidates lie as a whole, or none if all lie on the reference as given."""
        places = [place_sentence(self.comparison, c, self.names[c.name]) for c in candidates]
        sentences = list(filter(None, places))
        ending = f" So do {len(sentences) - _MAX_PLACES} others." if len(sentences) > _MAX_PLACES else ""
        return [f"{' '.join(sentences[:_MAX_PLACES])}{ending}"] if sentences else []

    def of_one(self, candidate: Candidate) -> list[str]:
        """Return the sentences for one candidate: distance, missing parts, deformation and pose."""
        if candidate.metrics.hausdorff.symmetric_max <= rounding_limit(self.comparison):
            return [f"{self.names[candidate.name]} coincides with the reference up to rounding.", self._pose(candidate)]
        return [
            self._how_far(candidate),
            *self._changes([candidate]),
            self._how_complete(candidate),
            f"{deformation_sentence(self.comparison, candidate, self.names[candidate.name])}.",
            self._pose(candidate),
        ]

    def _how_far(self, candidate: Candidate) -> str:
        name, off = self.names[candidate.name], _off_surface(candidate, with_planes=_has_d2(candidate))
        if off.value <= rounding_limit(self.comparison):
            return f"Each point of {name} lies on the reference's {off.target}, up to rounding."
        if candidate.censored.get(CANDIDATE_TO_REFERENCE):
            return f"{name} lies at least {self.length(off.value)} {off.label} off the reference's {off.target}."
        interval = "" if off.interval is None else f" {interval_text(off.interval)}"
        text = f"{name} lies {self.length(off.value)}{interval} {off.label} off the reference's {off.target}"
        if partly := self._overlap_warning(candidate):
            text = f"{partly[0].upper()}{partly[1:]}; the complete cloud {text.removeprefix(f'{name} ')}"
        is_noise = candidate.is_noise and not is_offset(self.comparison, candidate)
        if off.floor is not None and off.is_sampling and is_noise:
            step = self._step_words(candidate)
            with_step = f" and coordinates in {step}" if step else ""
            return f"{text}, about as far as error-free points with this density{with_step} ({self.length(off.floor)})."
        if off.floor is not None:
            text += f" (error-free points: {self.length(off.floor)})"
        if (robust := _nmad(candidate)) is not None and off.value > _MIN_OUTLIER_RATIO * robust:
            text += f"; NMAD, robust against outliers: {self.length(robust)}"
        return f"{text}. {budget_sentence(candidate)}".rstrip()

    def _changes(self, candidates: Sequence[Candidate]) -> list[str]:
        """Return the most important changes of candidates, in one text; none if there are none."""
        unit = self.comparison.reference.unit
        sentences = {c.name: changes_sentence(changes, unit) for c in candidates if (changes := changes_of(c))}
        if len(candidates) == 1:
            return list(sentences.values())
        return [" ".join(f"{self.names[name]}: {text}" for name, text in sentences.items())] if sentences else []

    def _how_complete(self, candidate: Candidate) -> str:
        away = _away(candidate)
        at_least = "at least " if candidate.censored.get(REFERENCE_TO_CANDIDATE) else ""
        text = f"Mean reference-to-candidate distance: {at_least}{self.length(away.value)}"
        if away.floor is None:
            return f"{text}."
        if away.is_sampling and not at_least:
            return f"{text}, about what {self._sampling_words([candidate])} ({self.length(away.floor)})."
        worst = candidate.metrics.hausdorff.completeness
        floor = f"{self._sampling_words([candidate])} {self.length(away.floor)}"
        return (
            f"{text}, of which {floor}: parts are missing. 5% of the reference is"
            f" farther than {self.length(worst.p95)} from the candidate; the farthest point,"
            f" {at_least}{self.length(worst.largest)} away, is at {position_text(worst.worst_point)}."
        )

    def _step_words(self, candidate: Candidate) -> str:
        """Return the coarsest step of the coordinates, if it affects the distances of a candidate."""
        if all(notice.code != COARSE_STEP for notice in candidate.registration.warnings):
            return ""
        scale = candidate.registration.T_reference_candidate.scale
        steps = (*self.comparison.reference.steps, *(scale * step for step in candidate.steps))
        return f"steps of {self.length(max(steps))}"

    def _sampling_words(self, candidates: Sequence[Candidate]) -> str:
        """Return what explains the floors of candidates, with the verb."""
        step = next(filter(None, map(self._step_words, candidates)), "")
        return f"point spacing and rounding of coordinates to {step} explain" if step else "the point spacing explains"

    def _pose(self, candidate: Candidate) -> str:
        registration, least = candidate.registration, rounding_limit(self.comparison)
        states_overlap = not self._overlap_warning(candidate)  # _how_far states a small overlap
        text = fit_sentence(registration, self.comparison.reference.unit, least, states_overlap=states_overlap)
        value, floor, *_ = candidate.metrics.mean_distance.accuracy
        if value is not None and floor is not None and least < value <= MAX_NOISE_RATIO * floor:
            cause = "density and rounding" if self._step_words(candidate) else "density"
            text += f" Point distances mainly reflect {cause}; use surface distances to judge error."
        return text

    def of_several(self, candidates: Sequence[Candidate]) -> list[str]:
        """Return the sentences for several candidates: accuracy, completeness and deformation."""
        with_planes = all(map(_has_d2, candidates))  # means and RMS have no common order
        off = {c.name: _off_surface(c, with_planes=with_planes) for c in candidates}
        away = {c.name: _away(c) for c in candidates}
        to = f"to the reference's {off[candidates[0].name].target}"
        accuracy = self._ranking(off, f"closer {to}", f"closest {to}", f"distance {to}")
        complete = self._ranking(away, "more complete", "most complete", "completeness")
        missing = [c for c in candidates if not away[c.name].is_sampling]
        if missing:
            cause = f"parts are missing in {self.name_list(missing)}"
        else:
            cause = f"{self._sampling_words(candidates).removeprefix('the ')} these distances"
        ends = [self.comparison[pick(off, key=lambda name: off[name].value)] for pick in (min, max)]
        notes = [*map(self._overlap_warning, ends), self._robust_order(candidates, off)]
        return [
            f"{'; '.join(filter(None, [accuracy, *notes]))}. {self._largest_parts(candidates)}".rstrip(),
            *self._changes(candidates),
            f"{complete}; {cause}.",
            f"{self._deformations(candidates)}.",
        ]

    def _largest_parts(self, candidates: Sequence[Candidate]) -> str:
        """Return the largest part of D2 besides noise in each candidate that noise does not explain."""
        names_by_source: dict[str, list[str]] = {}
        for candidate in candidates:
            if candidate.budget is not None and not candidate.is_noise:
                part, share = largest_part(candidate)
                name = f"{self.names[candidate.name]} ({percentage(share)})"
                names_by_source.setdefault(source_words(candidate, part), []).append(name)
        sources = [f"from {source} in {join_words(names)}" for source, names in names_by_source.items()]
        return f"Beyond noise, most of the mean square comes {', '.join(sources)}." if sources else ""

    def _ranking(self, distances: Mapping[str, _Distance], more: str, most: str, quantity: str) -> str:
        """Return the order of candidates as far as their paired differences are significant.

        Two intervals may overlap although the paired difference is significant. A candidate whose interval is so wide
        that it does not differ from the best, while better ones do, is not ranked.
        """
        order = sorted(distances, key=lambda name: distances[name].value)
        smallest = distances[order[0]]

        def differ(a: str, b: str) -> bool:
            return self._differ(a, b, smallest.metric)

        best_ones = leaders(order, differ)
        unranked = [name for name in order[len(best_ones) :] if not differ(order[0], name)]
        if unranked:
            others = {name: distances[name] for name in order if name not in unranked}
            subject = "its interval is" if len(unranked) == 1 else "their intervals are"
            wide = join_words([f"{self.names[name]} ({self.length(distances[name].value)})" for name in unranked])
            ranking = self._ranking(others, more, most, quantity)
            return f"{ranking}; {wide} cannot be ranked, because {subject} too wide"
        values = [self.length(distances[name].value) for name in order]
        best, worst = self.names[order[0]], self.names[order[-1]]
        words = f" {smallest.label}{self._floor_words([distances[name].floor for name in order])}"
        if len(best_ones) == len(order) == 2:
            return f"No significant difference in {quantity}: {best} {values[0]}, {worst} {values[1]}{words}"
        if len(order) == 2:
            return f"{best} is {more} than {worst}: {values[0]} against {values[1]}{words}"
        if len(best_ones) == len(order):
            return f"No significant difference in {quantity}: {values[0]} ({best}) to {values[-1]} ({worst}){words}"
        worst_ones = leaders(order[::-1], differ)[::-1]
        ending = ""
        if order[-1] not in best_ones:
            ending = self._last([name for name in worst_ones if name not in best_ones], distances)
        if len(best_ones) == 1:
            second = "" if order[1] in worst_ones else f", then {self.names[order[1]]} ({values[1]})"
            return f"{best} is {most}: {values[0]}{words}{second}{ending}"
        names = join_words([self.names[name] for name in best_ones])
        ends = f"{values[0]} to {values[len(best_ones) - 1]}"
        return f"{names} are {most}, without a significant difference: {ends}{words}{ending}"

    def _floor_words(self, floors: Sequence[float | None]) -> str:
        """Return the sampling floors of ranked candidates in parentheses; empty if one is unknown."""
        lengths = [self.length(floor) for floor in floors if floor is not None]
        if len(lengths) < len(floors):
            return ""
        if len(set(lengths)) == 1:
            return f" (floor {lengths[0]})"
        if len(lengths) == 2:
            return f" (floors {lengths[0]} and {lengths[1]})"
        lowest, highest = (self.length(end(floor for floor in floors if floor is not None)) for end in (min, max))
        return f" (floors {lowest} to {highest})"

    def _last(self, tied: Sequence[str], distances: Mapping[str, _Distance]) -> str:
        names = join_words([self.names[name] for name in tied])
        nearest, farthest = (self.length(distances[name].value) for name in (tied[0], tied[-1]))
        if len(tied) == 1:
            return f"; {names} is last ({nearest})"
        return f"; {names} are last, without a significant difference ({nearest} to {farthest})"

    def _overlap_warning(self, candidate: Candidate) -> str:
        """Return a warning if little of a candidate lies on the reference: the rest dominates its distances."""
        if not overlaps_little(self.comparison, candidate):
            return ""
        return f"only {candidate.registration.overlap:.0%} of {self.names[candidate.name]} lies on the reference"

    def _robust_order(self, candidates: Sequence[Candidate], off: Mapping[str, _Distance]) -> str:
        """Return a note if outliers determine the order by RMS: another candidate has a much smaller NMAD."""
        robust = {c.name: value for c in candidates if (value := _nmad(c)) is not None}
        if len(robust) < len(candidates):
            return ""
        best, better = min(off, key=lambda name: off[name].value), min(robust, key=lambda name: robust[name])
        if _MIN_OUTLIER_RATIO * robust[better] >= robust[best]:
            return ""
        values = f"{self.length(robust[better])} against {self.length(robust[best])}"
        return f"by the NMAD, which is robust against outliers, {self.names[better]} is closer ({values})"

    def _deformations(self, candidates: Sequence[Candidate]) -> str:
        """Return the verdicts on deformation, deformed candidates first."""
        sentences = []
        for verdict, (singular, plural) in _VERDICTS.items():
            chosen = [c for c in candidates if _claim(c) == verdict]
            if not chosen:
                continue
            text = f"{join_words([self._with_size(c) for c in chosen])} {singular if len(chosen) == 1 else plural}"
            if verdict == "non-affine":
                text += " beyond any affine motion"
            limits = [c.deformation.size_limit for c in chosen]
            limit = max((limit for limit in limits if limit is not None), default=None)
            if verdict in ("none", _UNPROVEN) and limit is not None:
                text += f"; a smooth deformation above {self.length(limit)} RMS would have been detected"
            problems = dict.fromkeys(c.deformation.limit_problem for c in chosen if verdict in ("none", _UNPROVEN))
            for problem in filter(None, problems):
                limited = [c for c in chosen if c.deformation.limit_problem == problem]
                text += f"; {problem if limited == chosen else f'for {self.name_list(limited)} {problem}'}"
            sentences.append(text)
        return ". ".join(sentences)

    def _with_size(self, candidate: Candidate) -> str:
        result, notes = candidate.deformation, []
        if result.amplitude is not None and _verdict(candidate) == "non-affine":
            notes.append(f"{self.length(result.amplitude.rms)} RMS")
        if changes := changes_of(candidate):
            notes.append(f"{pluralize(len(changes), 'part')} changed")
        return f"{self.names[candidate.name]} ({', '.join(notes)})" if notes else self.names[candidate.name]

    def _differ(self, a: str, b: str, metric: str) -> bool:
        """Return whether the paired difference of two candidates is significant; True if it is unknown."""
        for difference in self.comparison.differences:
            if difference.metric == metric and {difference.a, difference.b} == {a, b}:
                return not difference.interval.low <= 0 <= difference.interval.high
        return True


def _verdict(candidate: Candidate) -> str:
    """Return the verdict on deformation: undecided if the geometry does not determine the pose."""
    verdict = candidate.deformation.verdict
    return "undecided" if is_open(candidate) and verdict in CLAIMS else verdict


def _claim(candidate: Candidate) -> str:
    """Return the verdict; one of no deformation is unproven where noise does not explain the distances."""
    verdict = _verdict(candidate)
    return _UNPROVEN if verdict == "none" and not candidate.is_noise else verdict


def _has_d2(candidate: Candidate) -> bool:
    return candidate.metrics.d2_mse.accuracy.value is not None


def _off_surface(candidate: Candidate, *, with_planes: bool) -> _Distance:
    """Return the RMS distance to the reference's surface, or the mean distance to its points."""
    d2, mean = candidate.metrics.d2_mse.accuracy, candidate.metrics.mean_distance.accuracy
    if with_planes and d2.value is not None:
        rms = d2.root()
        return _Distance(d2.value**0.5, rms.floor, rms.interval, f"d2_mse/{CANDIDATE_TO_REFERENCE}", "RMS", "surface")
    metric = f"mean_distance/{CANDIDATE_TO_REFERENCE}"
    return _Distance(mean.value or 0.0, mean.floor, mean.interval, metric, "on average")


def _away(candidate: Candidate) -> _Distance:
    """Return the mean distance from the reference's points to the candidate."""
    mean = candidate.metrics.mean_distance.completeness
    label = "mean distance from the reference"
    return _Distance(mean.value or 0.0, mean.floor, mean.interval, f"mean_distance/{REFERENCE_TO_CANDIDATE}", label)


def _nmad(candidate: Candidate) -> float | None:
    """Return the NMAD of the signed distances to the surface, if there are any."""
    spread = candidate.metrics.spreads.get("plane_distance")
    return None if spread is None else spread.accuracy.nmad
