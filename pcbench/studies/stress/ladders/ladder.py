"""The types of ladders, and the start poses that all ladders share."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from typing import Any, TypeVar

import numpy as np

from pcbench.errors import InputError
from pcbench.geometry.arrays import FloatArray
from pcbench.geometry.transform import Similarity
from pcbench.studies.stress.descriptions import LadderInfo
from pcbench.studies.stress.registration import REGISTRATION
from pcbench.studies.stress.scenes import StressPair
from pcbench.studies.stress.subject import Subject

Perturbation = Callable[[StressPair, float, np.random.Generator], StressPair]
Perturbation2 = Callable[[StressPair, float, float, np.random.Generator], StressPair]


@dataclass(frozen=True)
class PlannedLadder:
    """Levels of a perturbation, from nothing to certain failure.

    Attributes:
        name: identifier, in lower case with hyphens.
        title: what is perturbed.
        kind: group of ladders, as in `LadderInfo`.
        unit: unit of the levels.
        levels: levels in order of severity.
        quick: levels of the quick plan; empty if it leaves the ladder out.
    """

    name: str
    title: str
    kind: str
    unit: str
    levels: tuple[float, ...]
    quick: tuple[float, ...]

    def describe(self, subjects: Iterable[Subject[Any]], level_names: tuple[str, ...], *, quick: bool) -> LadderInfo:
        """Return the description for results, with the levels of the quick or of the full plan.

        Args:
            subjects: subjects that the ladder is run for.
            level_names: names of all levels of a list of cases; otherwise empty.
            quick: whether the plan is the quick one.
        """
        levels = self.quick if quick else self.levels
        names = tuple(level_names[self.levels.index(level)] for level in levels) if level_names else ()
        subject_names = tuple(subject.name for subject in subjects)
        return LadderInfo(self.name, self.title, self.kind, subject_names, self.unit, levels, names)


LadderT = TypeVar("LadderT", bound=PlannedLadder)


def choose(
    ladders: Iterable[LadderT],
    only: str | None,
    *,
    quick: bool,
    texts_of: Callable[[LadderT], Iterable[str]],
    searched: str,
) -> tuple[LadderT, ...]:
    """Return the ladders of the full or of the quick plan that contain one of several texts; without texts, all.

    Args:
        ladders: all ladders.
        only: texts separated by commas; None for all ladders of the plan.
        quick: whether the plan is the quick one, which has the ladders with `quick` levels.
        texts_of: function that returns the texts of a ladder to search.
        searched: these texts in words, for the error.

    Raises:
        InputError: no ladder of the plan matches.
    """
    ladders = tuple(ladders)
    planned = tuple(ladder for ladder in ladders if ladder.quick or not quick)
    if only is None:
        return planned
    words = [word.strip() for word in only.split(",") if word.strip()]
    matching = [ladder for ladder in ladders if any(word in text for word in words for text in texts_of(ladder))]
    chosen = tuple(ladder for ladder in matching if ladder.quick or not quick)
    if not chosen:
        names = ", ".join(ladder.name for ladder in planned)
        if matching:
            raise InputError(f"--only {only} is not in the quick plan: leave out --quick, or choose from {names}")
        raise InputError(f"expected --only as part of a ladder's {searched}, got {only!r}: {names}")
    return chosen


@dataclass(frozen=True)
class Ladder(PlannedLadder):
    """A perturbation of a pair.

    Attributes:
        perturb: function of pair, level and random generator that returns the perturbed pair.
        subjects: subjects that it is run for.
        level_names: names of the levels of a list of cases.
        sets_start: whether it sets the start pose; any other ladder starts from a small displacement.
        sets_shape: whether it replaces the scene by another surface.
        needs_vegetation: whether it runs on scenes with vegetation alone.
        needs_start: whether it is run for methods that start from the given pose alone.
        second_title, second_unit, second_levels: second coordinate of a map.
        quick_second: second coordinates of the quick plan.
        perturb_map: for a map, function of pair, level, second coordinate and random generator.
    """

    perturb: Perturbation
    subjects: tuple[Subject[Any], ...] = (REGISTRATION,)
    level_names: tuple[str, ...] = ()
    sets_start: bool = False
    sets_shape: bool = False
    needs_vegetation: bool = False
    needs_start: bool = False
    second_title: str = ""
    second_unit: str = ""
    second_levels: tuple[float, ...] = ()
    quick_second: tuple[float, ...] = ()
    perturb_map: Perturbation2 | None = None

    def apply(self, pair: StressPair, level: float, second: float | None, rng: np.random.Generator) -> StressPair:
        """Return the pair perturbed to a level, and for a map to a second coordinate."""
        if self.perturb_map is not None and second is not None:
            return self.perturb_map(pair, level, second, rng)
        return self.perturb(pair, level, rng)

    def applies_to(self, given: StressPair) -> bool:
        """Return whether it can be run on a given pair."""
        return not self.sets_shape and (given.plants is not None or not self.needs_vegetation)

    def info(self, *, quick: bool) -> LadderInfo:
        """Return the description for results, with the levels of the quick or of the full plan."""
        return replace(
            self.describe(self.subjects, self.level_names, quick=quick),
            second_title=self.second_title,
            second_unit=self.second_unit,
            second_levels=self.quick_second if quick else self.second_levels,
        )


def displaced(
    pair: StressPair, angle_deg: float, offset: float, rng: np.random.Generator, *, scale: float = 1.0
) -> StressPair:
    """Move the start of a pair away from its true pose: by an angle about a random axis, and in a random direction.

    The rotation is about the candidate's centroid, so that it does not displace the candidate too.

    Args:
        pair: the pair.
        angle_deg: angle of the rotation, in degrees.
        offset: displacement of the centroid, in the clouds' unit.
        rng: random generator.
        scale: true scale from candidate to reference.
    """
    axis, heading = _unit(rng.normal(size=3)), _unit(rng.normal(size=3))
    return _moved(pair, rotation(axis, np.radians(angle_deg)), offset * heading, scale)


def turned(pair: StressPair, angle_deg: float, offset: FloatArray) -> StressPair:
    """Turn the start of a pair about the vertical through the candidate's centroid, and move it by an offset (3,)."""
    return _moved(pair, rotation(np.array([0.0, 0.0, 1.0]), np.radians(angle_deg)), offset, 1.0)


def rotation(axis: FloatArray, angle: float) -> FloatArray:
    """Return the rotation matrix of a unit axis and an angle in radians (Rodrigues' formula)."""
    x, y, z = axis
    k = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    turn: FloatArray = np.eye(3) + np.sin(angle) * k + (1 - np.cos(angle)) * k @ k
    return turn


def _moved(pair: StressPair, R: FloatArray, shift: FloatArray, scale: float) -> StressPair:
    centre = pair.points.mean(axis=0)
    # The candidate starts at its true pose, turned and shifted; its true transform takes that back.
    start = Similarity(R, centre + shift - R @ centre)
    return replace(pair, T_true=start.inverse() @ _scaled_about(centre, scale))


def _scaled_about(centre: FloatArray, scale: float) -> Similarity:
    return Similarity(np.eye(3), (1 - scale) * centre, scale)


def _unit(vector: FloatArray) -> FloatArray:
    return vector / np.linalg.norm(vector)
