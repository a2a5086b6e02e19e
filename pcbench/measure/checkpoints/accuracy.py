"""Errors of a cloud at check points, and its vertical and horizontal accuracy."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from pcbench.geometry.arrays import FloatArray
from pcbench.io.check_points import CheckPoints
from pcbench.measure.checkpoints.neighbors import PlanNeighbors
from pcbench.measure.checkpoints.settings import CheckPointSettings
from pcbench.measure.checkpoints.statistics import ErrorStatistics, are_outliers, root_mean_square
from pcbench.measure.checkpoints.surface import LocalSurface, local_surface


@dataclass(frozen=True)
class PointError:
    """The error of a cloud at one check point, cloud minus survey, in the unit of the cloud.

    Attributes:
        name: name of the check point.
        x: surveyed x.
        y: surveyed y.
        z: surveyed z.
        vegetated: whether it tests vegetated vertical accuracy.
        dz: vertical error; None if the cloud does not cover the point.
        dx: error in x; None if the target was not measured in the cloud.
        dy: error in y; None likewise.
        is_outlier: whether dz lies more than three NMAD from the median of its class.
        method: where the cloud's height is from: `tin`, `plane` or `measured`; empty if there is none.
        reason: why the cloud does not cover the point; empty if it does.
        spacing: local point spacing of the cloud.
        noise: standard deviation of the cloud's heights about the plane around the point.
        slope: slope of that plane, as rise over run.
    """

    name: str
    x: float
    y: float
    z: float
    vegetated: bool
    dz: float | None = None
    dx: float | None = None
    dy: float | None = None
    is_outlier: bool = False
    method: str = ""
    reason: str = ""
    spacing: float | None = None
    noise: float | None = None
    slope: float | None = None


@dataclass(frozen=True)
class VerticalAccuracy:
    """Vertical accuracy at the check points of one class.

    Attributes:
        errors: statistics of dz.
        survey_rmse: root mean square of the standard errors of the surveyed heights (RMSE_V2); None: not stated.
        rmse_v: the product's vertical accuracy, sqrt(RMSE_V1² + RMSE_V2²) (ASPRS 2024, section 7).
    """

    errors: ErrorStatistics
    survey_rmse: float | None
    rmse_v: float


@dataclass(frozen=True)
class HorizontalAccuracy:
    """Horizontal accuracy at targets whose position was measured in the cloud.

    Attributes:
        x: statistics of dx.
        y: statistics of dy.
        survey_rmse: the survey's own radial error (RMSE_H2), sqrt(2) times that of a coordinate; None: not stated.
        rmse_h: the product's radial accuracy, sqrt(RMSE_x² + RMSE_y² + RMSE_H2²).
    """

    x: ErrorStatistics
    y: ErrorStatistics
    survey_rmse: float | None
    rmse_h: float


@dataclass(frozen=True)
class CloudAccuracy:
    """Accuracy of a cloud by check points; lengths are in the unit of the cloud.

    Attributes:
        unit: the unit; None if it is unknown.
        surface: how heights of the cloud were found: `tin` or `plane`.
        spacing: median of the local spacings; None if no point is covered.
        noise: median of the noise about local planes; None likewise.
        points: the errors, one per check point, in the order of the file.
        nva: non-vegetated vertical accuracy; None if no such point is covered.
        vva: vegetated vertical accuracy; None likewise.
        every: vertical accuracy at all covered points.
        horizontal: horizontal accuracy; None if no target was measured in the cloud.
        hint: what is probably wrong if few points are covered; empty if nothing is.
    """

    unit: str | None
    surface: str
    spacing: float | None
    noise: float | None
    points: tuple[PointError, ...]
    nva: VerticalAccuracy | None
    vva: VerticalAccuracy | None
    every: VerticalAccuracy | None
    horizontal: HorizontalAccuracy | None
    hint: str = ""

    @property
    def covered(self) -> list[PointError]:
        """The check points that have a vertical error."""
        return [point for point in self.points if point.dz is not None]

    @property
    def uncovered(self) -> list[PointError]:
        """The check points that the cloud does not cover."""
        return [point for point in self.points if point.dz is None]

    @property
    def outliers(self) -> list[PointError]:
        """The check points whose vertical error is an outlier; they are part of all statistics."""
        return [point for point in self.points if point.is_outlier]


@dataclass(frozen=True)
class CandidateAccuracy:
    """Accuracy of a candidate of a comparison by check points.

    Attributes:
        as_given: its own accuracy: check points are absolute, and so are the coordinates of its file.
        aligned: after registration to the reference, whose own errors it then has; None if it was not moved.
    """

    as_given: CloudAccuracy
    aligned: CloudAccuracy | None


def assess(
    check_points: CheckPoints, neighbors: PlanNeighbors, settings: CheckPointSettings, unit: str | None
) -> CloudAccuracy:
    """Return the accuracy of a cloud by check points.

    Args:
        check_points: the check points, in the coordinate system and the unit of the cloud.
        neighbors: the points of the cloud around the check points.
        settings: the settings.
        unit: unit of the coordinates, if known.
    """
    surfaces = [
        local_surface(position, neighbors.around(row), are_all=neighbors.are_all, unit=unit)
        for row, position in enumerate(check_points.points[:, :2])
    ]
    level = _levels([surface for surface in surfaces if isinstance(surface, LocalSurface)])
    method = settings.surface if settings.surface != "auto" else "plane" if level.noise > level.spacing else "tin"
    points = [_error_of(check_points, row, surface, method) for row, surface in enumerate(surfaces)]
    points = _with_outliers(points)
    sigma_z = _given(check_points.sigma_z, settings.sigma_z)
    return CloudAccuracy(
        unit=unit,
        surface=method,
        spacing=None if math.isnan(level.spacing) else level.spacing,
        noise=None if math.isnan(level.noise) else level.noise,
        points=tuple(points),
        nva=_vertical(points, sigma_z, ~check_points.vegetated),
        vva=_vertical(points, sigma_z, check_points.vegetated),
        every=_vertical(points, sigma_z, np.ones(len(points), dtype=bool)),
        horizontal=_horizontal(points, _given(check_points.sigma_xy, settings.sigma_xy)),
        hint=_hint(check_points, points, neighbors),
    )


class _Levels(NamedTuple):
    """Medians of noise and spacing over the covered check points; NaN if there are none."""

    noise: float
    spacing: float


def _levels(surfaces: Sequence[LocalSurface]) -> _Levels:
    if not surfaces:
        return _Levels(math.nan, math.nan)
    return _Levels(*(float(np.median([getattr(s, name) for s in surfaces])) for name in _Levels._fields))


def _error_of(check_points: CheckPoints, row: int, surface: LocalSurface | str, method: str) -> PointError:
    x, y, z = check_points.points[row].tolist()
    error = PointError(check_points.names[row], x, y, z, bool(check_points.vegetated[row]))
    measured_x, measured_y, measured_z = check_points.measured[row].tolist()
    if not math.isnan(measured_x):
        error = replace(error, dx=measured_x - x, dy=measured_y - y)
    if isinstance(surface, str):
        error = replace(error, reason=surface)
    else:
        height = surface.plane if method == "plane" else surface.tin
        error = replace(
            error,
            dz=height - z,
            method=method,
            spacing=surface.spacing,
            noise=surface.noise,
            slope=surface.slope,
        )
    return error if math.isnan(measured_z) else replace(error, dz=measured_z - z, method="measured", reason="")


def _with_outliers(points: list[PointError]) -> list[PointError]:
    """Return the errors with the outliers of each class marked."""
    for vegetated in (False, True):
        rows = [row for row, point in enumerate(points) if point.dz is not None and point.vegetated == vegetated]
        if not rows:
            continue
        flags = are_outliers(np.array([points[row].dz for row in rows], dtype=np.float64))
        for row, flag in zip(rows, flags, strict=True):
            points[row] = replace(points[row], is_outlier=bool(flag))
    return points


def _given(column: FloatArray, default: float | None) -> FloatArray:
    """Return the standard errors of check points (N,), where missing the default."""
    return column if default is None else np.where(np.isnan(column), default, column)


def _vertical(points: Sequence[PointError], sigmas: FloatArray, wanted: NDArray[np.bool_]) -> VerticalAccuracy | None:
    rows = [row for row, point in enumerate(points) if point.dz is not None and wanted[row]]
    if not rows:
        return None
    errors = ErrorStatistics.of(np.array([points[row].dz for row in rows], dtype=np.float64))
    survey = root_mean_square(sigmas[rows])
    return VerticalAccuracy(errors, survey, math.hypot(errors.rmse, survey or 0.0))


def _horizontal(points: Sequence[PointError], sigmas: FloatArray) -> HorizontalAccuracy | None:
    rows = [row for row, point in enumerate(points) if point.dx is not None]
    if not rows:
        return None
    x, y = (
        ErrorStatistics.of(np.array([getattr(points[row], name) for row in rows], dtype=np.float64))
        for name in ("dx", "dy")
    )
    coordinate = root_mean_square(sigmas[rows])
    survey = None if coordinate is None else math.sqrt(2.0) * coordinate
    return HorizontalAccuracy(x, y, survey, math.hypot(x.rmse, y.rmse, survey or 0.0))


def _hint(check_points: CheckPoints, points: Sequence[PointError], neighbors: PlanNeighbors) -> str:
    """Return what is probably wrong with check points of which none lies within the extent of the cloud."""
    low, high, xy = neighbors.low[:2], neighbors.high[:2], check_points.points[:, :2]

    def inside(positions: FloatArray) -> int:
        return int(((positions >= low) & (positions <= high)).all(axis=1).sum())

    if any(point.dz is not None for point in points) or inside(xy):
        return ""
    extent = f"the cloud has x {low[0]:.1f} to {high[0]:.1f} and y {low[1]:.1f} to {high[1]:.1f}"
    if exchanged := inside(xy[:, ::-1]):
        return f"{extent}; with x and y exchanged, {exchanged} of {len(xy)} would lie on it: exchange the two columns"
    return f"{extent}: check that both have the same coordinate system and unit"
