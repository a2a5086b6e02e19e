"""Scalar maps of the candidates of a comparison or a saved report, with common colour ranges and a common frame."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from pcbench.errors import InputError
from pcbench.geometry.arrays import FloatArray
from pcbench.geometry.cloud import Cloud
from pcbench.measure.results import CANDIDATE_TO_REFERENCE, REFERENCE_TO_CANDIDATE, Candidate
from pcbench.report.colors import Range, ranges_of
from pcbench.report.inputs import FinishedComparison
from pcbench.report.plot.maps import frame, frame_of
from pcbench.report.plot.panels import join_title
from pcbench.report.plot.views import Frame
from pcbench.report.plotters.stage import Stage, Window
from pcbench.report.read import UNKNOWN_UNIT, MapSample, Report, ReportedCandidate
from pcbench.report.scalars import COMPLETENESS, scalar_of
from pcbench.report.viewing import ViewingCameras
from pcbench.report.words import point_count


class ScalarMap(NamedTuple):
    """Points with a scalar.

    Attributes:
        points: (N, 3) points.
        values: (N,) finite values.
        sampled_from: number of measured points, if these are a sample of them.
        is_even: (N,) whether a point belongs to the even sample, see `DeviationMap.is_even`; None: all do.
    """

    points: FloatArray
    values: FloatArray
    sampled_from: int | None = None
    is_even: NDArray[np.bool_] | None = None

    @property
    def even_values(self) -> FloatArray:
        """Values at the points of the even sample."""
        return self.values if self.is_even is None else self.values[self.is_even]

    def at(self, rows: NDArray[np.bool_]) -> ScalarMap:
        """Return the map at some of its points."""
        is_even = None if self.is_even is None else self.is_even[rows]
        return ScalarMap(self.points[rows], self.values[rows], self.sampled_from, is_even)


@dataclass(frozen=True, eq=False)
class CandidateMaps:
    """The maps of all candidates of a comparison.

    Attributes:
        maps: maps by candidate and scalar; the last scalar is `completeness`, the reference's distances.
        unit: unit of lengths, if known.
        spacing: median spacing of the reference.
        range: the end of all colour ranges, if the user set it.
        cameras: the cameras of the scene, which select the view, if known.
    """

    maps: Mapping[str, Mapping[str, ScalarMap]]
    unit: str | None
    spacing: float
    range: float | None = None
    cameras: ViewingCameras | None = None

    @classmethod
    def of_comparison(cls, comparison: FinishedComparison, range: float | None) -> CandidateMaps:
        """Return the maps of a measured comparison."""
        reference = comparison.reference
        maps = {candidate.name: _measured(candidate) for candidate in comparison}
        return cls(maps, reference.unit, reference.spacing_median, range, comparison.cameras)

    @classmethod
    def of_report(cls, report: Report, range: float | None) -> CandidateMaps:
        """Read the maps of a saved report."""
        maps = {candidate.name: _reported(candidate) for candidate in report.candidates}
        unit = None if report.unit == UNKNOWN_UNIT else report.unit
        return cls(maps, unit, report.spacing_median, range, report.cameras)

    def of(self, name: str, scalar: str) -> ScalarMap:
        """Return a map.

        Raises:
            InputError: the candidate has no such map.
        """
        if scalar not in self.maps[name]:
            names = ", ".join(self.maps[name])
            raise InputError(f"expected a map of {name} ({names}), or deformation; got {scalar!r}")
        return self.maps[name][scalar]

    def ranges(self, scalar: str) -> dict[str, Range]:
        """Return the colour range of a scalar for each candidate that has it."""
        values = {name: maps[scalar].even_values for name, maps in self.maps.items() if scalar in maps}
        return ranges_of(values, spacing=self.spacing, end=self.range)

    @cached_property
    def frame(self) -> Frame:
        """The common frame of all maps."""
        first, *_ = self.maps.values()
        measured = Cloud(first[COMPLETENESS].points) if COMPLETENESS in first else None
        shown = {name: Cloud(next(iter(maps.values())).points) for name, maps in self.maps.items()}
        return frame(measured, shown, self.cameras)

    def stage(self, name: str, scalar: str, window: Window) -> Stage:
        """Return an empty stage with the frame of a map."""
        return Stage(frame_of(self.of(name, scalar).points, self.frame)[0], self.unit, window)

    def show(self, stage: Stage, name: str, scalar: str) -> Range:
        """Show a map on a stage, in place of an earlier one, and return its colour range."""
        shown, scale = self.of(name, scalar), self.ranges(scalar)[name]
        # The reference is the ghost behind a candidate, and the candidate behind the reference.
        ghost = next(iter(self.maps[name])) if scalar == COMPLETENESS else COMPLETENESS
        if ghost in self.maps[name]:
            stage.add_ghost(self.maps[name][ghost].points)
        stage.add_bar(stage.add_values(shown.points, shown.values, scale), scalar_of(scalar).label)
        count = point_count(len(shown.points), shown.sampled_from, scalar_of(scalar).noun)
        title = f"completeness of {name} (the reference's {count})" if scalar == COMPLETENESS else f"{name} ({count})"
        stage.write_title(join_title(title, frame_of(shown.points, self.frame)[1]))
        return scale


def _measured(candidate: Candidate) -> dict[str, ScalarMap]:
    deviation = candidate.deviation
    completeness = candidate.completeness
    maps = {
        name: ScalarMap(deviation.points, values, deviation.sampled_from, deviation.is_even)
        for name, values in deviation.scalars.items()
    }
    if deviation.m3c2 is not None:
        maps["m3c2_distance"] = ScalarMap(deviation.m3c2.cores, deviation.m3c2.distances)
    distances = completeness.scalars["distance"]
    maps[COMPLETENESS] = ScalarMap(completeness.points, distances, completeness.sampled_from, completeness.is_even)
    return _known(maps)


def _reported(candidate: ReportedCandidate) -> dict[str, ScalarMap]:
    deviation, m3c2, completeness = candidate.deviation, candidate.m3c2, candidate.completeness()
    sample = candidate.samples.get(CANDIDATE_TO_REFERENCE)
    maps = {name: _scalar_map(deviation.points, values, sample) for name, values in deviation.attributes.items()}
    if m3c2 is not None:
        maps["m3c2_distance"] = _scalar_map(m3c2.points, m3c2.attributes["m3c2_distance"])
    if completeness is not None:
        sample = candidate.samples.get(REFERENCE_TO_CANDIDATE)
        maps[COMPLETENESS] = _scalar_map(completeness.points, completeness.attributes["distance"], sample)
    return _known(maps)


def _scalar_map(points: FloatArray, values: NDArray[np.generic], sample: MapSample | None = None) -> ScalarMap:
    numbers = np.asarray(values, dtype=np.float64)
    if sample is None:
        return ScalarMap(points, numbers)
    return ScalarMap(points, numbers, sample.sampled_from, np.arange(len(numbers)) < sample.even)


def _known(maps: Mapping[str, ScalarMap]) -> dict[str, ScalarMap]:
    """Return the points of each map whose value is known, without maps that have none."""
    is_known = {name: np.isfinite(scalar_map.values) for name, scalar_map in maps.items()}
    return {
        name: scalar_map if is_known[name].all() else scalar_map.at(is_known[name])
        for name, scalar_map in maps.items()
        if is_known[name].any()
    }
