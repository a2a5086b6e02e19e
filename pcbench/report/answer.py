"""The answer in words: how far, where, why, and which numbers can be trusted."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import NamedTuple

from pcbench.measure.intervals import Interval
from pcbench.measure.results import BACK, FORTH, Candidate
from pcbench.report.inputs import SourcedComparison
from pcbench.report.notes import CLAIMS, bend_sentence, is_open, overlaps_little
from pcbench.report.words import joined, length, rounding, shortened

_MOST_SENTENCES = 4
_NEAR_FLOOR = 1.25  # times the floor, as lengths: up to there a score is mostly sampling
_MANY_STRAYS = 2.0  # times the NMAD: an RMS from which on strays are worth a word
_LONGEST_NAME = 28
_OTHER_WAYS = {  # to register, by the method that they are
    "global": "global (from any pose), global-similarity (of any scale too)",
    "points": "points:FILE (control points)",
    "matrix": "matrix:FILE (a pose that is known)",
}


class _Distance(NamedTuple):
    """A distance that candidates are ranked by, in the clouds' unit, and under which name differences know it."""

    value: float
    floor: float | None
    interval: Interval | None
    metric: str
    words: str
    what: str = "points"

    @property
    def is_sampling(self) -> bool:
        return self.floor is None or self.value <= _NEAR_FLOOR * self.floor


def answer(comparison: SourcedComparison) -> list[str]:
    """Two to four sentences. Where no registration can be trusted no verdict is given."""
    trusted = [c for c in comparison if not c.registration.doubtful]
    doubtful = [c for c in comparison if c.registration.doubtful]
    writer = _Writer(comparison)
    if not trusted:
        return writer.no_verdict(doubtful)
    sentences = writer.cautions(doubtful, [c for c in trusted if is_open(c)])
    sentences += writer.of_one(trusted[0]) if len(trusted) == 1 else writer.of_several(trusted)
    return sentences[:_MOST_SENTENCES]


class _Writer:
    """Writes sentences on a comparison's candidates: knows the unit, and short names where names are long."""

    def __init__(self, comparison: SourcedComparison) -> None:
        self.comparison = comparison
        names = [c.name for c in comparison]
        short = [shortened(name, _LONGEST_NAME) for name in names]
        self.names = dict(zip(names, short if len(set(short)) == len(set(names)) else names, strict=True))

    def length(self, value: float | None) -> str:
        return length(value, self.comparison.reference.unit)

    def all(self, candidates: Sequence[Candidate]) -> str:
        return joined([self.names[c.name] for c in candidates])

    def no_verdict(self, doubtful: Sequence[Candidate]) -> list[str]:
        tried = {c.registration.method.partition(":")[0].partition("-")[0] for c in doubtful}
        ways = [text for name, text in _OTHER_WAYS.items() if name not in tried]
        return [
            f"{self._doubt(doubtful)}, and no verdict is given.",
            f"What may help: --register {', '.join(ways[:-1])} or {ways[-1]}.",
        ]

    def cautions(self, doubtful: Sequence[Candidate], left_open: Sequence[Candidate]) -> list[str]:
        """What has to be known before anything else, in one sentence if there is any."""
        parts = []
        if doubtful:
            parts.append(
                f"{self._doubt(doubtful)}, and what follows leaves {'them' if len(doubtful) > 1 else 'it'} out"
            )
        if left_open:
            parts.append(
                f"The geometry does not fix the pose of {self.all(left_open)} (see the warnings): along what is not"
                " fixed no number means anything"
            )
        return [f"{'; '.join([*parts[:1], *(part[0].lower() + part[1:] for part in parts[1:])])}."] if parts else []

    def _doubt(self, doubtful: Sequence[Candidate]) -> str:
        several = len(doubtful) > 1
        whose = f"registrations of {self.all(doubtful)} are" if several else f"registration of {self.all(doubtful)} is"
        numbers = "their numbers" if several else "its numbers"
        return f"The {whose} doubtful (see the warnings): {numbers} describe a pose that may be wrong"

    def of_one(self, candidate: Candidate) -> list[str]:
        """How far, what is missing, why, and how well the pose is known."""
        if candidate.metrics.hausdorff.symmetric_max <= rounding(self.comparison):
            same = f"{self.names[candidate.name]} coincides with the reference: all distances are rounding."
            return [same, self._pose(candidate)]
        bend = bend_sentence(self.comparison, candidate, self.names[candidate.name])
        return [self._how_far(candidate), self._how_complete(candidate), f"{bend}.", self._pose(candidate)]

    def _how_far(self, candidate: Candidate) -> str:
        name, off = self.names[candidate.name], _off_surface(candidate)
        if off.value <= rounding(self.comparison):
            return f"Every point of {name} lies on the reference's {off.what}, but for rounding."
        known = "" if off.interval is None else f" [{off.interval.low:.3g}, {off.interval.high:.3g}]"
        text = f"{name} lies {self.length(off.value)}{known} {off.words} off the reference's {off.what}"
        if partly := self._partly(candidate):
            text = f"{partly[0].upper()}{partly[1:]}, and all of it {text.removeprefix(f'{name} ')}"
        if off.floor is not None and off.is_sampling:
            return f"{text}, no farther than error-free points of it would ({self.length(off.floor)})."
        if (robust := _nmad(candidate)) is not None and off.value > _MANY_STRAYS * robust:
            text += f", but {self.length(robust)} by the NMAD, which strays do not move"
        return f"{text}." if off.floor is None else f"{text}; error-free points would lie {self.length(off.floor)} off."

    def _how_complete(self, candidate: Candidate) -> str:
        away = _away(candidate)
        text = f"From the reference to it the mean distance is {self.length(away.value)}"
        if away.floor is None:
            return f"{text}."
        if away.is_sampling:
            return f"{text}, as its density explains ({self.length(away.floor)})."
        worst = candidate.metrics.hausdorff.completeness
        place = ", ".join(f"{x:.1f}" for x in worst.worst_point)
        return (
            f"{text}, where its density explains {self.length(away.floor)}: it leaves parts out; 5% of the reference"
            f" lies farther than {self.length(worst.p95)} from it, the farthest point {self.length(worst.largest)}, at"
            f" ({place})."
        )

    def _pose(self, candidate: Candidate) -> str:
        found, least = candidate.registration, rounding(self.comparison)
        how = found.method.partition(":")[0]
        given = {"none": "Taken in the pose as it is", "matrix": "Taken in the given pose"}
        pose = given.get(how, f"Registered by {'control points' if how == 'points' else how}")
        parts = [] if self._partly(candidate) else [f"{found.overlap:.1%} of it lies on the reference"]  # said before
        if found.weakest_sigma is not None and found.weakest_sigma > least and how not in given:
            parts.append(f"the pose is known to {self.length(found.weakest_sigma)} (one sigma, weakest direction)")
        text = f"{pose}: {', and '.join(parts)}" if parts else pose
        value, floor, *_ = candidate.metrics.mean_distance.accuracy
        if value is not None and floor is not None and least < value <= _NEAR_FLOOR * floor:
            text += "; distances to points say how dense the clouds are, those to the surface how wrong"
        return f"{text}."

    def of_several(self, candidates: Sequence[Candidate]) -> list[str]:
        """Which is more accurate, which more complete, and which are deformed."""
        off, away = ({c.name: measure(c) for c in candidates} for measure in (_off_surface, _away))
        to = f"to the reference's {off[candidates[0].name].what}"
        accuracy = self._ranking(off, f"closer {to}", f"closest {to}")
        missing = [c for c in candidates if not away[c.name].is_sampling]
        if not missing:
            why = "; their densities explain that"
        elif len(missing) == len(candidates):
            why = "; all leave parts of it out, beyond what their densities explain"
        elif [c.name for c in missing] == [max(away, key=lambda name: away[name].value)]:
            why = " and leaves parts of it out, beyond what its density explains"
        else:
            leaves = "leaves" if len(missing) == 1 else "leave"
            why = f"; {self.all(missing)} {leaves} parts of it out, beyond what density explains"
        complete = self._ranking(away, "more complete", "most complete")
        ends = [self.comparison[pick(off, key=lambda name: off[name].value)] for pick in (min, max)]
        return [
            f"{'; '.join(filter(None, [accuracy, *map(self._partly, ends)]))}{self._but_for_strays(candidates, off)}.",
            f"{complete}{why}.",
            f"{self._bends(candidates)}.",
        ]

    def _ranking(self, found: Mapping[str, _Distance], more: str, most: str) -> str:
        """Who is best, and whom it can be told from: the paired differences decide, not whether intervals overlap."""
        order = sorted(found, key=lambda name: found[name].value)
        first = found[order[0]]
        like = self._tied_with(order[0], order, first.metric)
        values = [self.length(found[name].value) for name in order]
        best, worst = self.names[order[0]], self.names[order[-1]]
        words = f" {first.words}" + ("" if first.floor is None else f" (floor {self.length(first.floor)})")
        if len(like) == len(order) == 2:
            return f"Which is {more} cannot be told: {best} has {values[0]}, {worst} {values[1]}{words}"
        if len(order) == 2:
            return f"{best} is {more} than {worst}: {values[0]} against {values[1]}{words}"
        if len(like) == len(order):
            return f"Which is {most} cannot be told: {values[0]} ({best}) to {values[-1]} ({worst}){words}"
        tied = self._tied_with(order[-1], order, first.metric)
        last = "" if order[-1] in like else self._last([name for name in tied if name not in like], found)
        if len(like) == 1:
            then = "" if order[1] in tied else f", then {self.names[order[1]]} ({values[1]})"
            return f"{best} is {most}: {values[0]}{words}{then}{last}"
        these, farthest = joined([self.names[name] for name in like]), self.length(found[like[-1]].value)
        return f"{these} are {most} and cannot be told apart: {values[0]} to {farthest}{words}{last}"

    def _tied_with(self, one: str, order: Sequence[str], metric: str) -> list[str]:
        """Those that cannot be told from one of them, and itself, in the same order."""
        return [name for name in order if name == one or not self._differ(one, name, metric)]

    def _last(self, tied: Sequence[str], found: Mapping[str, _Distance]) -> str:
        names, ends = joined([self.names[k] for k in tied]), [self.length(found[k].value) for k in (tied[0], tied[-1])]
        if len(tied) == 1:
            return f"; {names} is last ({ends[0]})"
        return f"; {names} are last and cannot be told apart ({' to '.join(ends)})"

    def _partly(self, candidate: Candidate) -> str:
        """Of what only a part lies on the reference, the distances are mostly those of the rest."""
        if not overlaps_little(self.comparison, candidate):
            return ""
        return f"only {candidate.registration.overlap:.0%} of {self.names[candidate.name]} lies on the reference"

    def _but_for_strays(self, candidates: Sequence[Candidate], off: Mapping[str, _Distance]) -> str:
        """Where strays alone make the order by the RMS: another candidate is far better by the NMAD."""
        robust = {c.name: value for c in candidates if (value := _nmad(c)) is not None}
        if len(robust) < len(candidates):
            return ""
        best, better = min(off, key=lambda name: off[name].value), min(robust, key=lambda name: robust[name])
        if _MANY_STRAYS * robust[better] >= robust[best]:
            return ""
        values = f"{self.length(robust[better])} against {self.length(robust[best])}"
        return f"; but by the NMAD, which strays do not move, it is {self.names[better]} ({values})"

    def _bends(self, candidates: Sequence[Candidate]) -> str:
        """Every candidate under its verdict, those that are bent first."""
        kinds = {
            "non-affine": "bent",
            "affine": "sheared or stretched",
            "similarity": "of another scale",
            "none": "not deformed",
            "undecided": "undecided whether deformed",
        }
        parts = []
        for verdict, words in kinds.items():
            of_it = [c for c in candidates if _verdict(c) == verdict]
            if of_it:
                parts.append(f"{words}: {joined([self._bend(c) for c in of_it])}")
            limits = [c.deformation.minimum_detectable_rms for c in of_it]
            seen = max((limit for limit in limits if limit is not None), default=None)
            if verdict == "none" and seen is not None:
                parts[-1] += f" (a dome of {self.length(seen)} RMS would show)"
        text = "; ".join(parts)
        return text[:1].upper() + text[1:]

    def _bend(self, candidate: Candidate) -> str:
        bend, notes = candidate.deformation, []
        if bend.amplitude is not None and _verdict(candidate) == "non-affine":
            notes.append(f"{self.length(bend.amplitude.rms)} RMS")
        if bend.part_moved:
            notes.append("a part moved by itself")
        return f"{self.names[candidate.name]} ({', '.join(notes)})" if notes else self.names[candidate.name]

    def _differ(self, a: str, b: str, metric: str) -> bool:
        """Whether the paired difference of two candidates is more than chance; True where it is not known."""
        for found in self.comparison.differences:
            if found.metric == metric and {found.a, found.b} == {a, b}:
                return not found.interval.low <= 0 <= found.interval.high
        return True


def _verdict(candidate: Candidate) -> str:
    """On deformation: none is claimed under a pose that the geometry leaves open."""
    verdict = candidate.deformation.verdict
    return "undecided" if is_open(candidate) and verdict in CLAIMS else verdict


def _off_surface(candidate: Candidate) -> _Distance:
    """How far the candidate lies off the reference's surface; off its points where there are too few for normals."""
    d2 = candidate.metrics.d2_mse.accuracy
    if d2.value is not None:
        floor = None if d2.floor is None else d2.floor**0.5
        ends = None if d2.interval is None else Interval(d2.interval.low**0.5, d2.interval.high**0.5)
        return _Distance(d2.value**0.5, floor, ends, f"d2_mse/{FORTH}", "RMS", "surface")
    mean = candidate.metrics.mean_distance.accuracy
    return _Distance(mean.value or 0.0, mean.floor, mean.interval, f"mean_distance/{FORTH}", "on average")


def _away(candidate: Candidate) -> _Distance:
    """How far the reference's points lie from the candidate, on average."""
    mean = candidate.metrics.mean_distance.completeness
    words = "on average from the reference to it"
    return _Distance(mean.value or 0.0, mean.floor, mean.interval, f"mean_distance/{BACK}", words)


def _nmad(candidate: Candidate) -> float | None:
    """Of the signed distances to the surface."""
    spread = candidate.metrics.spreads.get("plane_distance")
    return None if spread is None else spread.accuracy.nmad
