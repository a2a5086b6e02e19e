"""All numbers of the quality of a cloud, each with a stable name, its unit, its interval, definition and source.

The names are keys of quality.json, and do not change.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from functools import partial
from typing import Literal

import numpy as np

from pcbench.measure.quality.bootstrap import BlockEstimate
from pcbench.measure.quality.coordinates import coordinate_faults
from pcbench.measure.quality.density import NEIGHBORS as DENSITY_NEIGHBORS
from pcbench.measure.quality.density import CloudDensity
from pcbench.measure.quality.entropy import MapEntropy
from pcbench.measure.quality.outliers import MAX_RATIO, NEIGHBORS
from pcbench.measure.quality.quality import CloudQuality, SurfaceNoise
from pcbench.measure.quality.sheets import DoubleWalls
from pcbench.measure.quality.strips import StripAgreement
from pcbench.measure.quality.upright import Uprightness
from pcbench.measure.quality.voids import Voids

Better = Literal["lower", "higher"]
_USGS = "USGS Lidar Base Specification 2.1"
MAX_SPACING_RATIO = 1.2
"""Ratio of the spacings of two clouds, up to which numbers that depend on the density can be compared."""


@dataclass(frozen=True)
class QualityNumber:
    """One number about a cloud.

    Attributes:
        label: what it is, in few words.
        value: its value; None: it does not exist for this cloud.
        low: lower end of its 95 % interval; None: it is counted, or there are too few independent parts.
        high: upper end, likewise.
        unit: its unit; empty: a number without unit.
        better: whether lower or higher values are better; None: neither.
        needs_equal_density: whether it compares only clouds with the same spacing and radius.
        is_count: whether it is counted, so that every difference is one.
        definition: its definition in one sentence.
        source: paper, specification or tool that it is from; empty: pcbench.
        group: the group of the table in which it is listed.
    """

    label: str
    value: float | None
    low: float | None = None
    high: float | None = None
    unit: str = ""
    better: Better | None = None
    needs_equal_density: bool = False
    is_count: bool = False
    definition: str = ""
    source: str = ""
    group: str = ""


def quality_numbers(quality: CloudQuality, unit: str | None) -> dict[str, QualityNumber]:
    """Return all numbers of a cloud by their names; the order is that of tables.

    Args:
        quality: the quality of the cloud.
        unit: unit of its coordinates; None: unknown.
    """
    length = unit or "units"
    parts = [
        *_density_numbers(quality.density, length),
        *_void_numbers(quality.voids, length),
        *_surface_numbers(quality.surface, length),
        *_sheet_numbers(quality.double_walls, length),
        *_entropy_numbers(quality.entropy, length),
        *_strip_numbers(quality.strips, length),
        *_upright_numbers(quality.upright),
        *_fault_numbers(quality, length),
    ]
    return dict(parts)


def number_names() -> tuple[str, ...]:
    """Return the names of all numbers, which every cloud has."""
    faults, _ = coordinate_faults(np.zeros((1, 3)))
    return tuple(quality_numbers(CloudQuality(faults), None))


def better_cloud(name: str, first: dict[str, QualityNumber], second: dict[str, QualityNumber]) -> int | None:
    """Return which cloud, 1 or 2, is better by a number; 0 if the difference is within the intervals; None if unknown.

    Counts differ if they are not equal. Other numbers differ if their intervals do not overlap.
    """
    one, two = first[name], second[name]
    if one.better is None or one.value is None or two.value is None:
        return None
    if one.needs_equal_density and not have_equal_density(first, second):
        return None
    if not one.is_count:
        if one.low is None or one.high is None or two.low is None or two.high is None:
            return None
        if one.low <= two.high and two.low <= one.high:
            return 0
    if one.value == two.value:
        return 0
    return 1 if (one.value < two.value) == (one.better == "lower") else 2


def have_equal_density(first: dict[str, QualityNumber], second: dict[str, QualityNumber]) -> bool:
    """Return whether two clouds have about the same spacing."""
    one, two = first["spacing"].value, second["spacing"].value
    return bool(one and two and max(one, two) <= MAX_SPACING_RATIO * min(one, two))


_Numbers = Iterator[tuple[str, QualityNumber]]


def _number(
    name: str,
    label: str,
    estimate: BlockEstimate | float | None,
    unit: str,
    definition: str,
    *,
    group: str,
    source: str = "",
    better: Better | None = None,
    needs_equal_density: bool = False,
    is_count: bool = False,
) -> tuple[str, QualityNumber]:
    """Return the name and a number, with its interval if it is an estimate."""
    value = low = high = None
    if isinstance(estimate, BlockEstimate):
        value = estimate.value
        if estimate.has_interval:
            low, high = estimate.low, estimate.high
    elif estimate is not None and math.isfinite(estimate):
        value = float(estimate)
    return name, QualityNumber(
        label, value, low, high, unit, better, needs_equal_density, is_count, definition, source, group
    )


def _density_numbers(density: CloudDensity | None, length: str) -> _Numbers:
    number = partial(_number, group="Sampling")
    per_area = f"1/{length}²"
    yield number(
        "spacing",
        "point spacing",
        density and density.spacing,
        length,
        definition=f"Spacing of the points: {density.definition if density else 'the points cover no area'}.",
    )
    yield number(
        "surface_density",
        "density on the surface",
        density and density.surface,
        per_area,
        definition=f"Median of (k - 1) / (π r_k²), r_k the distance to the k-th neighbour, k = {DENSITY_NEIGHBORS}.",
    )
    yield number(
        "surface_density_ratio",
        "unevenness of the density",
        density and density.surface_ratio,
        "",
        better="lower",
        definition="Ratio of the 95th to the 5th percentile of the density on the surface.",
    )
    yield number(
        "plan_density",
        "density in plan view",
        density and density.plan,
        per_area,
        definition="Points per area of square cells that have points and are surrounded by such cells.",
    )
    yield number(
        "pulse_density",
        "pulse density (ANPD)",
        density.pulse if density is not None and density.is_seen_from_above else None,
        per_area,
        definition="First returns per area of the same cells; none without return numbers. Only of clouds that are seen"
        " from above.",
        source=_USGS,
    )
    yield number(
        "pulse_spacing",
        "pulse spacing (ANPS)",
        density.pulse_spacing if density is not None and density.is_seen_from_above else None,
        length,
        definition="1 / √(pulse density), or of all points without return numbers. Only of clouds that are seen from"
        " above.",
        source=_USGS,
    )
    yield number(
        "filled_share",
        "cells with a pulse",
        density and density.filled_share,
        "",
        better="higher",
        definition="Share of cells of twice the pulse spacing, between others with pulses, that have a pulse; the"
        " specification demands 0.9. Only of clouds that are seen from above.",
        source=_USGS,
    )


def _void_numbers(voids: Voids | None, length: str) -> _Numbers:
    number, unit = partial(_number, group="Voids"), f"{length}²"
    text = (
        "Areas inside the cloud that discs of (4 x pulse spacing)² without a point fill; at water (class 9) excluded."
        " Only of clouds that are seen from above."
    )
    counted = None if voids is None else voids.counted
    yield number(
        "void_count",
        "voids",
        None if counted is None else len(counted),
        "",
        better="lower",
        is_count=True,
        definition=text,
        source=_USGS,
    )
    yield number(
        "void_area",
        "area of all voids",
        voids and voids.area,
        unit,
        better="lower",
        is_count=True,
        definition="Total area of the voids.",
        source=_USGS,
    )
    yield number(
        "largest_void",
        "largest void",
        None if counted is None else max((void.area for void in counted), default=0.0),
        unit,
        better="lower",
        is_count=True,
        definition="Area of the largest void.",
        source=_USGS,
    )


def _surface_numbers(surface: SurfaceNoise | None, length: str) -> _Numbers:
    number = partial(_number, group="Noise")
    where = "" if surface is None else f", radius {surface.radius:.3g} {length}"
    yield number(
        "noise",
        "noise across surfaces",
        surface and surface.noise,
        length,
        better="lower",
        definition="Median over flat patches of the normalised median absolute deviation of their points from a"
        f" surface of second order{where}; places with double walls are left out.",
    )
    yield number(
        "thickness",
        "thickness of surfaces",
        surface and surface.thickness,
        length,
        better="lower",
        definition=f"Median over flat patches of the width along the normal that holds 90 % of the points{where}.",
    )
    yield number(
        "roughness",
        "roughness",
        surface and surface.roughness,
        length,
        definition=f"Median over flat patches of the standard deviation of their points about a plane{where}; the"
        " shape of the surface is part of it.",
    )
    yield number(
        "flat_share",
        "flat patches",
        surface and surface.flat_share,
        "",
        definition=f"Share of the patches whose points lie close to a smooth surface{where}.",
    )


def _sheet_numbers(walls: DoubleWalls | None, length: str) -> _Numbers:
    number = partial(_number, group="Double walls")
    limit = "" if walls is None else f" up to {walls.max_separation:.3g} {length} apart"
    yield number(
        "double_wall_count",
        "double walls",
        None if walls is None else len(walls.walls),
        "",
        better="lower",
        is_count=True,
        definition=f"Surfaces that appear as two parallel sheets{limit}, one behind the other.",
    )
    yield number(
        "double_wall_separation",
        "distance of the sheets",
        walls and walls.separation,
        length,
        better="lower",
        definition="Median distance of the sheets along their normal over all places of double walls.",
    )
    yield number(
        "double_wall_area",
        "area of double walls",
        None if walls is None else sum(wall.area for wall in walls.walls),
        f"{length}²",
        better="lower",
        is_count=True,
        definition="Area of the double walls, roughly: of the cells that their places fill, each pair of sheets once.",
    )


def _entropy_numbers(entropy: MapEntropy | None, length: str) -> _Numbers:
    number = partial(_number, group="Blur of the map")
    where = (
        "" if entropy is None else f" (radius {entropy.radius:.3g} {length}, at least {entropy.min_neighbors} points)"
    )
    yield number(
        "map_entropy",
        "mean map entropy",
        entropy and entropy.entropy,
        "nat",
        better="lower",
        needs_equal_density=True,
        definition=f"Mean of 0.5 ln det(2πe Σ), Σ the covariance of the points around a point{where}; it depends on"
        " the radius, the density and the unit of length.",
        source="Razlaw et al. 2015, eq. 1; MapEval",
    )
    yield number(
        "plane_variance",
        "mean plane variance",
        entropy and entropy.plane_variance,
        f"{length}²",
        better="lower",
        needs_equal_density=True,
        definition=f"Mean of the smallest eigenvalue of Σ{where}.",
        source="Kornilova & Ferrer 2021, eq. 4",
    )


def _strip_numbers(strips: StripAgreement | None, length: str) -> _Numbers:
    number = partial(_number, group="Strips")
    pairs = () if strips is None else strips.pairs
    field = "" if strips is None else f"; strips by {strips.field}"
    worst = next((pair for pair in pairs if pair.dz is not None), None)
    offset = None if worst is None or worst.dz is None else worst.dz
    if offset is not None and offset.value < 0:
        offset = BlockEstimate(-offset.value, -offset.high, -offset.low)
    yield number(
        "strip_pairs",
        "pairs of overlapping strips",
        len(pairs) if strips is not None else None,
        "",
        definition=f"Pairs of strips that show at least 30 places on a common surface{field}.",
    )
    yield number(
        "strip_dz",
        "largest offset of two strips",
        offset,
        length,
        better="lower",
        definition="Largest absolute median vertical difference of two strips, on surfaces of at most 30 degrees.",
    )
    yield number(
        "strip_rms_dz",
        "largest RMSDz of two strips",
        max((pair.rms_dz for pair in pairs if pair.rms_dz is not None), default=None),
        length,
        better="lower",
        definition="Largest root mean square of the vertical differences of two strips, without places beyond 5 NMAD.",
        source=f"{_USGS}, interswath consistency",
    )
    yield number(
        "strip_rms",
        "RMS of all strips",
        strips and strips.rms_normal,
        length,
        better="lower",
        definition="Root mean square of the offsets along the normals over all pairs, likewise.",
    )


def _upright_numbers(upright: Uprightness | None) -> _Numbers:
    number = partial(_number, group="Walls")
    yield number(
        "wall_count",
        "walls",
        None if upright is None else upright.walls,
        "",
        definition="Large planes within 10 degrees of the vertical.",
    )
    yield number(
        "tilt",
        "tilt of the walls",
        upright and upright.tilt_deg,
        "deg",
        better="lower",
        definition="Rotation of the whole cloud by which its walls are best upright: robust least squares over the"
        " normals of the walls. None with fewer than 6 walls.",
    )


def _fault_numbers(quality: CloudQuality, length: str) -> _Numbers:
    number, faults, outliers = partial(_number, group="Points"), quality.coordinates, quality.outliers
    share = f"Points whose {NEIGHBORS}th neighbour is {MAX_RATIO:g} times farther away than those of the points around."
    exact = partial(number, better="lower", is_count=True)
    yield number("points", "points", faults.points, "", definition="Number of points.")
    yield exact(
        "outliers",
        "outliers",
        outliers and outliers.number,
        "",
        definition=share,
        source="as the local outlier factor, Breunig et al. 2000",
    )
    yield exact("outlier_share", "share of outliers", outliers and outliers.share, "", definition=share)
    yield exact("copies", "copies of points", faults.copies, "", definition="Points at the position of an earlier one.")
    yield exact(
        "missing_points",
        "missing data stored as points",
        faults.missing,
        "",
        definition="Points with fill values such as -9999, 1e38 or (0, 0, 0), far from all others or repeated; they"
        " count in no other number.",
    )
    yield exact(
        "origin_points", "points at (0, 0, 0)", faults.at_origin, "", definition="Points that are exactly (0, 0, 0)."
    )
    yield number(
        "step",
        "step of the coordinates",
        max(faults.steps),
        length,
        better="lower",
        is_count=True,
        definition="Largest step in which x, y or z is rounded; 0: none is visible.",
    )
    yield number(
        "float32_step",
        "step of 32-bit floats",
        faults.float32_step,
        length,
        definition="Distance of neighbouring 32-bit floats at the largest coordinate: what a file with such floats"
        " would round to.",
    )
