"""Features of a map: points, lines and polygons with properties, as GeoJSON and GeoPackage store them."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np

from pcbench.errors import InputError
from pcbench.geometry.arrays import FloatArray

Value = str | bool | int | float | None
"""Value of a property; None: unknown."""


@dataclass(frozen=True, eq=False)
class FeatureGeometry:
    """A shape of OGC Simple Features (ISO 19125): a point, a line, a polygon with holes, or several polygons.

    `point_at`, `line_along`, `polygon_within` and `polygons_together` make shapes.

    Attributes:
        kind: its name in the standard.
        parts: (N, 2) or (N, 3) positions of each ring of each polygon. The outer ring is the first one and runs
            anticlockwise, holes run clockwise, and the last position of a ring is its first one. A point or a line is a
            single ring, which is open.
    """

    kind: Literal["Point", "LineString", "Polygon", "MultiPolygon"]
    parts: tuple[tuple[FloatArray, ...], ...]

    @property
    def positions(self) -> FloatArray:
        """All positions (N, 2) or (N, 3)."""
        return np.concatenate([ring for rings in self.parts for ring in rings])

    @property
    def has_heights(self) -> bool:
        """Return whether the positions have a z."""
        return len(self.parts[0][0][0]) == 3


def point_at(position: FloatArray) -> FeatureGeometry:
    """Return a point at a position (2,) or (3,)."""
    return FeatureGeometry("Point", ((_checked([position], 1),),))


def line_along(positions: FloatArray) -> FeatureGeometry:
    """Return a line along at least two positions (N, 2) or (N, 3)."""
    return FeatureGeometry("LineString", ((_checked(positions, 2),),))


def polygon_within(outer: FloatArray, holes: Iterable[FloatArray] = ()) -> FeatureGeometry:
    """Return a polygon from its outer ring and its holes: at least three corners (N, 2) or (N, 3) each.

    Rings may be open or closed, and may run in either direction.
    """
    return FeatureGeometry("Polygon", ((_ring(outer, 1), *(_ring(hole, -1) for hole in holes)),))


def polygons_together(polygons: Iterable[FeatureGeometry]) -> FeatureGeometry:
    """Return several polygons as one shape."""
    return FeatureGeometry("MultiPolygon", tuple(part for polygon in polygons for part in polygon.parts))


@dataclass(frozen=True, eq=False)
class Feature:
    """A shape with properties by name. Numbers that are not finite are unknown."""

    geometry: FeatureGeometry
    properties: Mapping[str, Any]


@dataclass(frozen=True, eq=False)
class VectorLayer:
    """Features that a GIS shows together.

    Attributes:
        name: name of the layer.
        features: its features. A property that some of them lack is unknown there.
        crs: coordinate system of the positions, if known.
    """

    name: str
    features: Sequence[Feature]
    crs: str | None = None

    @property
    def columns(self) -> list[str]:
        """Names of all properties, in the order in which they occur first."""
        return list(dict.fromkeys(name for feature in self.features for name in feature.properties))

    def rows(self) -> list[list[Value]]:
        """Return the values of each feature, in the order of the columns."""
        columns = self.columns
        return [[plain_value(feature.properties.get(name)) for name in columns] for feature in self.features]


def plain_value(value: Any) -> Value:
    """Return a value without numpy types; None for a number that is not finite. Bytes that are no text are escaped."""
    if isinstance(value, np.generic):
        value = value.item()
    if isinstance(value, float) and not math.isfinite(value):
        return None
    if isinstance(value, str):
        return value.encode("utf-8", "backslashreplace").decode()
    assert value is None or isinstance(value, bool | int | float), f"no value of a property: {value!r}"
    return value


def _checked(positions: Any, least: int) -> FloatArray:
    array = np.array(positions, np.float64)
    if array.ndim != 2 or array.shape[1] not in (2, 3) or len(array) < least or not np.isfinite(array).all():
        raise InputError(f"expected at least {least} finite positions (N, 2) or (N, 3), got shape {array.shape}")
    return array


def _ring(corners: Any, sign: int) -> FloatArray:
    """Return a closed ring whose signed area has a sign: 1 for anticlockwise, -1 for clockwise."""
    ring = _checked(corners, 3)
    if not (ring[0] == ring[-1]).all():
        ring = np.concatenate([ring, ring[:1]])
    x, y = (ring[:, :2] - ring[0, :2]).T  # relative, so that far coordinates do not round the area
    area = float(np.sum(x[:-1] * y[1:] - x[1:] * y[:-1]))
    return ring if area * sign >= 0 else ring[::-1]
