"""All numbers of the quality of a cloud, each with a stable name, its unit, its interval, definition and source.

The names are keys of quality.json, and do not change.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from functools import partial
from typing import Literal

from pcbench.measure.quality.bootstrap import Estimate
from pcbench.measure.quality.density import NEIGHBORS as DENSITY_NEIGHBORS
from pcbench.measure.quality.density import Density
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
    label: str,
    estimate: Estimate | float | None,
    unit: str,
    definition: str,
    *,
    group: str,
    source: str = "",
    better: Better | None = None,
    needs_equal_density: bool = False,
    is_count: bool = False,
) -> QualityNumber:
    value = low = high = None
    if isinstance(estimate, Estimate):
        value = estimate.value
        if estimate.has_interval:
            low, high = estimate.low, estimate.high
    elif estimate is not None and math.isfinite(estimate):
        value = float(estimate)
    return QualityNumber(
        label, value, low, high, unit, better, needs_equal_density, is_count, definition, source, group
    )


def _density_numbers(density: Density | None, length: str) -> _Numbers:
    group = "Sampling"
    per_area = f"1/{length}²"
    yield (
        "spacing",
        _number(
            "point spacing",
            density and density.spacing,
            length,
            group=group,
            definition=f"Spacing of the points: {density.definition if density else 'the points cover no area'}.",
        ),
    )
    yield (
        "surface_density",
        _number(
            "density on the surface",
            density and density.surface,
            per_area,
            group=group,
            definition="Median of (k - 1) / (π r_k²), r_k the distance to the k-th neighbour,"
            f" k = {DENSITY_NEIGHBORS}.",
        ),
    )
    yield (
        "surface_density_ratio",
        _number(
            "unevenness of the density",
            density and density.surface_ratio,
            "",
            better="lower",
            group=group,
            definition="Ratio of the 95th to the 5th percentile of the density on the surface.",
        ),
    )
    yield (
        "plan_density",
        _number(
            "density in plan view",
            density and density.plan,
            per_area,
            group=group,
            definition="Points per area of square cells that have points and are surrounded by such cells.",
        ),
    )
    yield (
        "pulse_density",
        _number(
            "pulse density (ANPD)",
            density.pulse if density is not None and density.is_seen_from_above else None,
            per_area,
            group=group,
            definition="First returns per area of the same cells; none without return numbers. Only of clouds that are seen from"
            " above.",
            source=_USGS,
        ),
    )
    yield (
        "pulse_spacing",
        _number(
            "pulse spacing (ANPS)",
            density.pulse_spacing if density is not None and density.is_seen_from_above else None,
            length,
            group=group,
            definition="1 / √(pulse density), or of all points without return numbers. Only of clouds that are seen from above.",
            source=_USGS,
        ),
    )
    yield (
        "filled_share",
        _number(
            "cells with a pulse",
            density and density.filled_share,
            "",
            better="higher",
            group=group,
            definition="Share of cells of twice the pulse spacing, between others with pulses, that have a pulse; the"
            " specification demands 0.9. Only of clouds that are seen from above.",
            source=_USGS,
        ),
    )


def _void_numbers(voids: Voids | None, length: str) -> _Numbers:
    group, unit = "Voids", f"{length}²"
    text = (
        "Areas inside the cloud that discs of (4 x pulse spacing)² without a point fill; at water (class 9) excluded."
        " Only of clouds that are seen from above."
    )
    counted = None if voids is None else voids.counted
    yield (
        "void_count",
        _number(
            "voids",
            None if counted is None else len(counted),
            "",
            better="lower",
            is_count=True,
            group=group,
            definition=text,
            source=_USGS,
        ),
    )
    yield (
        "void_area",
        _number(
            "area of all voids",
            voids and voids.area,
            unit,
            better="lower",
            is_count=True,
            group=group,
            definition="Total area of the voids.",
            source=_USGS,
        ),
    )
    yield (
        "largest_void",
        _number(
            "largest void",
            None if counted is None else max((void.area for void in counted), default=0.0),
            unit,
            better="lower",
            is_count=True,
            group=group,
            definition="Area of the largest void.",
            source=_USGS,
        ),
    )


def _surface_numbers(surface: SurfaceNoise | None, length: str) -> _Numbers:
    group = "Noise"
    where = "" if surface is None else f", radius {surface.radius:.3g} {length}"
    yield (
        "noise",
        _number(
            "noise across surfaces",
            surface and surface.noise,
            length,
            better="lower",
            group=group,
            definition="Median over flat patches of the normalised median absolute deviation of their points from a"
            f" surface of second order{where}; places with double walls are left out.",
        ),
    )
    yield (
        "thickness",
        _number(
            "thickness of surfaces",
            surface and surface.thickness,
            length,
            better="lower",
            group=group,
            definition=f"Median over flat patches of the width along the normal that holds 90 % of the points{where}.",
        ),
    )
    yield (
        "roughness",
        _number(
            "roughness",
            surface and surface.roughness,
            length,
            group=group,
            definition=f"Median over flat patches of the standard deviation of their points about a plane{where}; the"
            " shape of the surface is part of it.",
        ),
    )
    yield (
        "flat_share",
        _number(
            "flat patches",
            surface and surface.flat_share,
            "",
            group=group,
            definition=f"Share of the patches whose points lie close to a smooth surface{where}.",
        ),
    )


def _sheet_numbers(walls: DoubleWalls | None, length: str) -> _Numbers:
    group = "Double walls"
    limit = "" if walls is None else f" up to {walls.max_separation:.3g} {length} apart"
    yield (
        "double_wall_count",
        _number(
            "double walls",
            None if walls is None else len(walls.walls),
            "",
            better="lower",
            is_count=True,
            group=group,
            definition=f"Surfaces that appear as two parallel sheets{limit}, one behind the other.",
        ),
    )
    yield (
        "double_wall_separation",
        _number(
            "distance of the sheets",
            walls and walls.separation,
            length,
            better="lower",
            group=group,
            definition="Median distance of the sheets along their normal over all places of double walls.",
        ),
    )
    yield (
        "double_wall_area",
        _number(
            "area of double walls",
            None if walls is None else sum(wall.area for wall in walls.walls),
            f"{length}²",
            better="lower",
            is_count=True,
            group=group,
            definition="Area of the double walls: half of the voxels that their places fill, roughly.",
        ),
    )


def _entropy_numbers(entropy: MapEntropy | None, length: str) -> _Numbers:
    group = "Blur of the map"
    where = (
        "" if entropy is None else f" (radius {entropy.radius:.3g} {length}, at least {entropy.min_neighbors} points)"
    )
    yield (
        "map_entropy",
        _number(
            "mean map entropy",
            entropy and entropy.entropy,
            "nat",
            better="lower",
            needs_equal_density=True,
            group=group,
            definition=f"Mean of 0.5 ln det(2πe Σ), Σ the covariance of the points around a point{where}; it depends on"
            " the radius, the density and the unit of length.",
            source="Razlaw et al. 2015, eq. 1; MapEval",
        ),
    )
    yield (
        "plane_variance",
        _number(
            "mean plane variance",
            entropy and entropy.plane_variance,
            f"{length}²",
            better="lower",
            needs_equal_density=True,
            group=group,
            definition=f"Mean of the smallest eigenvalue of Σ{where}.",
            source="Kornilova & Ferrer 2021, eq. 4",
        ),
    )


def _strip_numbers(strips: StripAgreement | None, length: str) -> _Numbers:
    group = "Strips"
    pairs = () if strips is None else strips.pairs
    field = "" if strips is None else f"; strips by {strips.field}"
    worst = next((pair for pair in pairs if pair.dz is not None), None)
    offset = None if worst is None or worst.dz is None else worst.dz
    if offset is not None and offset.value < 0:
        offset = Estimate(-offset.value, -offset.high, -offset.low)
    yield (
        "strip_pairs",
        _number(
            "pairs of overlapping strips",
            len(pairs) if strips is not None else None,
            "",
            group=group,
            definition=f"Pairs of strips that show at least 30 places on a common surface{field}.",
        ),
    )
    yield (
        "strip_dz",
        _number(
            "largest offset of two strips",
            offset,
            length,
            better="lower",
            group=group,
            definition="Largest absolute median vertical difference of two strips, on surfaces of at most 30 degrees.",
        ),
    )
    yield (
        "strip_rms_dz",
        _number(
            "largest RMSDz of two strips",
            max((pair.rms_dz for pair in pairs if pair.rms_dz is not None), default=None),
            length,
            better="lower",
            group=group,
            definition="Largest root mean square of the vertical differences of two strips, without places beyond"
            " 5 NMAD.",
            source=f"{_USGS}, interswath consistency",
        ),
    )
    yield (
        "strip_rms",
        _number(
            "RMS of all strips",
            strips and strips.rms_normal,
            length,
            better="lower",
            group=group,
            definition="Root mean square of the offsets along the normals over all pairs, likewise.",
        ),
    )


def _upright_numbers(upright: Uprightness | None) -> _Numbers:
    group = "Walls"
    yield (
        "wall_count",
        _number(
            "walls",
            None if upright is None else upright.walls,
            "",
            group=group,
            definition="Large planes within 10 degrees of the vertical.",
        ),
    )
    yield (
        "tilt",
        _number(
            "tilt of the walls",
            upright and upright.tilt_deg,
            "deg",
            better="lower",
            group=group,
            definition="Rotation of the whole cloud by which its walls are best upright: robust least squares over the"
            " normals of the walls. None with fewer than 6 walls.",
        ),
    )


def _fault_numbers(quality: CloudQuality, length: str) -> _Numbers:
    group, faults, outliers = "Points", quality.coordinates, quality.outliers
    share = f"Points whose {NEIGHBORS}th neighbour is {MAX_RATIO:g} times farther away than those of the points around."
    exact = partial(_number, better="lower", is_count=True, group=group)
    yield "points", _number("points", faults.points, "", group=group, definition="Number of points.")
    yield (
        "outliers",
        exact(
            "outliers",
            outliers and outliers.number,
            "",
            definition=share,
            source="as the local outlier factor, Breunig et al. 2000",
        ),
    )
    yield "outlier_share", exact("share of outliers", outliers and outliers.share, "", definition=share)
    yield (
        "copies",
        exact("copies of points", faults.copies, "", definition="Points at the position of an earlier one."),
    )
    yield (
        "missing_points",
        exact(
            "missing data stored as points",
            faults.missing,
            "",
            definition="Points with fill values such as -9999, 1e38 or (0, 0, 0), far from all others or repeated; they"
            " count in no other number.",
        ),
    )
    yield (
        "origin_points",
        exact("points at (0, 0, 0)", faults.at_origin, "", definition="Points that are exactly (0, 0, 0)."),
    )
    yield (
        "step",
        _number(
            "step of the coordinates",
            max(faults.steps),
            length,
            better="lower",
            is_count=True,
            group=group,
            definition="Largest step in which x, y or z is rounded; 0: none is visible.",
        ),
    )
    yield (
        "float32_step",
        _number(
            "step of 32-bit floats",
            faults.float32_step,
            length,
            group=group,
            definition="Distance of neighbouring 32-bit floats at the largest coordinate: what a file with such floats"
            " would round to.",
        ),
    )
