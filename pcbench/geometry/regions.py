"""Regions in the reference frame: which points lie inside, and how they are written on a command line or in a file."""

from __future__ import annotations

import json
import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

from pcbench.errors import InputError
from pcbench.geometry.arrays import MAX_COORDINATE, FloatArray
from pcbench.geometry.cloud import Cloud

Mask = NDArray[np.bool_]

_AXES = "xyz"
_CHUNK = 1 << 20  # points whose polygon test is made at once
_FILE_BYTES = 32 << 20


class Region(Protocol):
    """A part of space, its border included."""

    def contains(self, points: FloatArray) -> Mask:
        """Mask (N,) of the points (N, 3) inside."""

    def shifted(self, origin: FloatArray) -> Region:
        """The same region for coordinates from which `origin` (3,) was subtracted."""

    def describe(self) -> str:
        """A readable name."""


@dataclass(frozen=True, eq=False)
class Box:
    """Points between two corners (3,), in the coordinates' unit.

    Raises:
        InputError: a corner is not three finite numbers, or lower > upper on an axis.
    """

    lower: FloatArray
    upper: FloatArray

    def __post_init__(self) -> None:
        lower, upper = _vector("lower corner", self.lower), _vector("upper corner", self.upper)
        for axis in np.flatnonzero(lower > upper):
            raise InputError(
                f"expected a box with lower <= upper, got {_AXES[axis]} from {lower[axis]:.10g} to {upper[axis]:.10g}"
            )
        object.__setattr__(self, "lower", lower)
        object.__setattr__(self, "upper", upper)

    def contains(self, points: FloatArray) -> Mask:
        inside = np.ones(len(points), dtype=np.bool_)
        for axis in range(3):  # one axis at a time: no (N, 3) temporaries
            inside &= _between(points[:, axis], self.lower[axis], self.upper[axis])
        return inside

    def shifted(self, origin: FloatArray) -> Box:
        return Box(self.lower - origin, self.upper - origin)

    def describe(self) -> str:
        sides = zip(_AXES, self.lower, self.upper, strict=True)
        return "box with " + ", ".join(f"{axis} from {low:.10g} to {high:.10g}" for axis, low, high in sides)

    __str__ = describe


@dataclass(frozen=True, eq=False)
class Sphere:
    """Points within `radius` of `center` (3,), in the coordinates' unit.

    Raises:
        InputError: the centre is not three finite numbers, or the radius is not positive and finite.
    """

    center: FloatArray
    radius: float

    def __post_init__(self) -> None:
        object.__setattr__(self, "center", _vector("centre", self.center))
        if not 0 < self.radius < MAX_COORDINATE:
            raise InputError(f"expected a sphere with a positive, finite radius, got {self.radius}")

    def contains(self, points: FloatArray) -> Mask:
        return _lengths(points - self.center) <= self.radius

    def shifted(self, origin: FloatArray) -> Sphere:
        return Sphere(self.center - origin, self.radius)

    def describe(self) -> str:
        return f"sphere of radius {self.radius:.10g} about ({', '.join(f'{v:.10g}' for v in self.center)})"

    __str__ = describe


@dataclass(frozen=True, eq=False)
class Polygon:
    """A prism: inside the rings as seen along `axis` (even-odd rule), and between `lower` and `upper` along it.

    The even-odd rule makes a ring within another a hole, and one beside it another part, whichever way they turn.
    Points on a ring are inside; on a slanting edge this holds up to rounding.

    Args:
        rings: each (M, 2), closed or not: x, y where `axis` is 2 (z), x, z where it is 1, y, z where it is 0.
        axis: the direction of the prism.
        lower, upper: its ends along `axis`; -inf and inf where it has none.

    Raises:
        InputError: no ring, a ring of fewer than three distinct vertices, a number that is not finite, lower > upper.
    """

    rings: tuple[FloatArray, ...]
    axis: int = 2
    lower: float = -np.inf
    upper: float = np.inf

    def __post_init__(self) -> None:
        rings = tuple(_ring(ring) for ring in self.rings)
        if not rings:
            raise InputError("expected a polygon with at least one ring, got none")
        if self.axis not in (0, 1, 2):
            raise InputError(f"expected the axis of a polygon as 0, 1 or 2, got {self.axis}")
        if not self.lower <= self.upper:
            raise InputError(
                f"expected a polygon with lower <= upper along {_AXES[self.axis]}, got {self.lower} and {self.upper}"
            )
        object.__setattr__(self, "rings", rings)

    @property
    def _plane(self) -> list[int]:
        return [axis for axis in range(3) if axis != self.axis]

    def contains(self, points: FloatArray) -> Mask:
        first, second = self._plane
        low, high = np.vstack(self.rings).min(axis=0), np.vstack(self.rings).max(axis=0)
        inside = _between(points[:, self.axis], self.lower, self.upper)
        inside &= _between(points[:, first], low[0], high[0])
        inside &= _between(points[:, second], low[1], high[1])
        candidates = np.flatnonzero(inside)
        for start in range(0, len(candidates), _CHUNK):
            chunk = candidates[start : start + _CHUNK]
            inside[chunk] = _in_rings(points[chunk, first], points[chunk, second], self.rings)
        return inside

    def shifted(self, origin: FloatArray) -> Polygon:
        along = float(origin[self.axis])
        rings = tuple(ring - origin[self._plane] for ring in self.rings)
        return Polygon(rings, self.axis, self.lower - along, self.upper - along)

    def describe(self) -> str:
        plane = "".join(_AXES[axis] for axis in self._plane)
        text = f"polygon of {sum(map(len, self.rings))} vertices in {plane}"
        if len(self.rings) > 1:
            text += f", {len(self.rings)} rings"
        if np.isfinite(self.lower) or np.isfinite(self.upper):
            text += f", {_AXES[self.axis]} from {self.lower:.10g} to {self.upper:.10g}"
        return text

    __str__ = describe


@dataclass(frozen=True, eq=False)
class Union:
    """Points inside any of several regions: what a file of several, possibly overlapping polygons means."""

    regions: tuple[Region, ...]

    def contains(self, points: FloatArray) -> Mask:
        inside = np.zeros(len(points), dtype=np.bool_)
        for region in self.regions:
            inside |= region.contains(points)
        return inside

    def shifted(self, origin: FloatArray) -> Union:
        return Union(tuple(region.shifted(origin) for region in self.regions))

    def describe(self) -> str:
        if len(self.regions) <= 3:
            return " and ".join(region.describe() for region in self.regions)
        return f"{len(self.regions)} regions, the first a {self.regions[0].describe()}"

    __str__ = describe


# From text


def parse_region(text: str, reference: Cloud) -> Region | None:
    """The region that `text` names, in the reference's coordinates and unit; None for "none".

    Known are:
        none
        box:xmin,ymin,zmin,xmax,ymax,zmax
        sphere:x,y,z,r
        polygon:FILE        GeoJSON, WKT, or the selection volume of Open3D and Tanks and Temples
        reference           the reference's bounding box
        quantile:0.99       the sphere about the reference's centre that holds this share of its points

    Raises:
        InputError: the text or the file is none of these.
    """
    kind, colon, rest = text.strip().partition(":")
    kind, rest = kind.strip().lower(), rest.strip()
    if kind in ("none", "reference"):
        if colon:
            raise InputError(f"region {text!r}: expected {kind!r} alone, without values")
        return None if kind == "none" else Box(*reference.bounds)
    if kind == "polygon":
        if not rest:
            raise InputError(f"region {text!r}: expected polygon:FILE, got no file name")
        return read_polygon(rest)
    try:
        match kind:
            case "box":
                values = _numbers(rest, "xmin,ymin,zmin,xmax,ymax,zmax")
                return Box(np.array(values[:3]), np.array(values[3:]))
            case "sphere":
                values = _numbers(rest, "x,y,z,r")
                return Sphere(np.array(values[:3]), values[3])
            case "quantile":
                return sphere_about(reference.points, *_numbers(rest, "q"))
    except InputError as error:
        raise InputError(f"region {text!r}: {error}") from error
    raise InputError(
        f"region {text!r}: expected none, box:xmin,ymin,zmin,xmax,ymax,zmax, sphere:x,y,z,r, polygon:FILE,"
        " reference or quantile:q"
    )


def sphere_about(points: FloatArray, quantile: float) -> Sphere:
    """The sphere about points (N, 3) whose radius is the given quantile of their distances to its centre.

    For clouds that thin out. The centre is the median of each coordinate: stragglers do not move it.

    Raises:
        InputError: the quantile is outside (0, 1], or that share of the points lies at the centre.
    """
    if not 0 < quantile <= 1:
        raise InputError(f"expected a quantile in (0, 1], such as 0.99, got {quantile:g}")
    center = np.median(points, axis=0)
    radius = float(np.quantile(_lengths(points - center), quantile))
    if radius == 0:
        raise InputError(f"expected points around a centre, got {quantile:g} of them all in one place: ask for more")
    # The point that the radius goes to stays inside when coordinates are shifted: their rounding is below this.
    return Sphere(center, radius * (1 + 1e-9))


def read_polygon(path: str | Path) -> Region:
    """Read a polygon from a GeoJSON or WKT file (heights are ignored), or from a selection volume.

    GeoJSON may be a Polygon, a MultiPolygon, a Feature or a FeatureCollection (RFC 7946); WKT a POLYGON or
    MULTIPOLYGON, with or without Z and M and an SRID in front. A selection volume is the JSON that Open3D writes and
    Tanks and Temples crops by: class_name SelectionPolygonVolume. Coordinates are the reference's, whatever
    coordinate system the file states.

    Raises:
        InputError: the file cannot be read or is none of these.
    """
    try:
        with Path(path).open("rb") as file:
            data = file.read(_FILE_BYTES + 1)
    except (OSError, ValueError) as error:  # ValueError: a NUL in the name
        raise InputError(f"{path}: cannot read a polygon: {getattr(error, 'strerror', None) or error}") from error
    try:
        return _polygon_from(data)
    except InputError as error:
        raise InputError(f"{path}: {error}") from error


def _polygon_from(data: bytes) -> Region:
    expected = "expected a polygon as GeoJSON, WKT or SelectionPolygonVolume"
    if len(data) > _FILE_BYTES:
        raise InputError(f"{expected}, got a file of more than {_FILE_BYTES >> 20} MiB")
    try:
        text = data.decode("utf-8-sig").strip()
    except UnicodeDecodeError as error:
        raise InputError(f"{expected}, got a binary file") from error
    if not text:
        raise InputError(f"{expected}, got an empty file")
    if text.startswith(("{", "[")):
        try:
            content = json.loads(text)
        except RecursionError as error:
            raise InputError(f"{expected}, got JSON that is nested too deeply") from error
        except ValueError as error:
            raise InputError(f"{expected}, got invalid JSON: {error}") from error
        if not isinstance(content, dict):
            raise InputError(f"{expected}, got a JSON {type(content).__name__} instead of an object")
        if "class_name" in content or "bounding_polygon" in content:
            return _selection_volume(content)
        return _union(_geojson_parts(content))
    if match := _WKT.match(text):
        return _union(_wkt_parts(bool(match["multi"]), text[match.end() :]))
    raise InputError(f"{expected}, got a text that starts with {text[:20]!r}")


# A part is a polygon in the files' sense: its outer ring, then its holes.
_Part = Sequence[Sequence[Sequence[float]]]


def _union(parts: Iterable[_Part]) -> Region:
    polygons = tuple(Polygon(tuple(np.array([v[:2] for v in ring]) for ring in part)) for part in parts)
    if not polygons:
        raise InputError("expected at least one polygon, got none")
    return polygons[0] if len(polygons) == 1 else Union(polygons)


def _geojson_parts(content: dict[str, Any]) -> list[_Part]:
    kind = content.get("type")
    if kind == "FeatureCollection":
        features = _list("features", content.get("features"))
        return [part for feature in features for part in _feature_parts(feature)]
    return _feature_parts(content)


def _feature_parts(feature: Any) -> list[_Part]:
    geometry = feature.get("geometry") if isinstance(feature, dict) and feature.get("type") == "Feature" else feature
    kind = geometry.get("type") if isinstance(geometry, dict) else geometry
    if not isinstance(geometry, dict) or kind not in ("Polygon", "MultiPolygon"):
        raise InputError(
            f"expected GeoJSON of type Polygon, MultiPolygon, Feature or FeatureCollection, got {_brief(kind)}"
        )
    coordinates = _list("coordinates", geometry.get("coordinates"))
    parts = [coordinates] if kind == "Polygon" else coordinates
    return [[_vertices(ring, 2) for ring in _list("a polygon", part)] for part in parts]


_WKT = re.compile(r"(SRID\s*=\s*\d+\s*;\s*)?(?P<multi>MULTI)?POLYGON\s*(ZM|Z|M)?(?![a-z])\s*", re.IGNORECASE)
_WKT_RING = re.compile(r"\(([^()]*)\)")
_WKT_PART = re.compile(r"\((?:R,)*R\)")
_WKT_PARTS = re.compile(r"\((?:\((?:R,)*R\),)*\((?:R,)*R\)\)")


def _wkt_parts(multi: bool, body: str) -> list[_Part]:
    body = body.rstrip().removesuffix(";")
    if body.upper() == "EMPTY":
        return []
    # With each innermost pair of brackets as one letter, the nesting is a regular language.
    skeleton = "".join(_WKT_RING.sub("R", body.replace("R", "?")).split())
    if not (_WKT_PARTS if multi else _WKT_PART).fullmatch(skeleton):
        example = "MULTIPOLYGON (((x y, ...), (hole)), ((x y, ...)))" if multi else "POLYGON ((x y, ...), (hole))"
        raise InputError(f"expected WKT of the form {example}, got brackets of another form")
    rings = iter(_WKT_RING.findall(body))
    return [[_wkt_ring(next(rings)) for _ in range(part.count("R"))] for part in _WKT_PART.findall(skeleton)]


def _wkt_ring(text: str) -> Sequence[Sequence[float]]:
    try:
        return _vertices([[float(word) for word in vertex.split()] for vertex in text.split(",")], 2)
    except InputError:  # a ValueError too, but it says all already
        raise
    except ValueError as error:
        raise InputError(f"expected WKT vertices as numbers, got {_brief(str(error).partition(': ')[2])}") from error


def _selection_volume(content: dict[str, Any]) -> Polygon:
    if content.get("class_name") != "SelectionPolygonVolume":
        raise InputError(f"expected class_name SelectionPolygonVolume, got {_brief(content.get('class_name'))}")
    axis_name = content.get("orthogonal_axis")
    if not isinstance(axis_name, str) or len(axis_name) != 1 or axis_name.lower() not in _AXES:
        raise InputError(f"expected orthogonal_axis X, Y or Z, got {_brief(axis_name)}")
    axis = _AXES.index(axis_name.lower())
    lower, upper = (_number(name, content.get(name)) for name in ("axis_min", "axis_max"))
    vertices = np.array(_vertices(content.get("bounding_polygon"), 3))
    return Polygon((np.delete(vertices[:, :3], axis, axis=1),), axis, lower, upper)


# Checks of what files and callers give


def _vertices(ring: Any, size: int) -> list[list[float]]:
    """A list of vertices, cut to their first `size` numbers."""
    result = []
    for vertex in _list("a ring of vertices", ring):
        values = _list("a vertex", vertex)
        if len(values) < size:
            raise InputError(f"expected vertices of at least {size} numbers, got {_brief(vertex)}")
        result.append([_number("a coordinate", value) for value in values[:size]])
    if not result:
        raise InputError("expected a ring of vertices, got none")
    return result


def _list(what: str, value: Any) -> list[Any]:
    if not isinstance(value, list):
        raise InputError(f"expected {what} as a list, got {_brief(value)}")
    return value


def _number(what: str, value: Any) -> float:
    # bool is an int in Python, and integers of any length come out of JSON.
    if isinstance(value, bool) or not isinstance(value, int | float) or not abs(value) < MAX_COORDINATE:
        raise InputError(f"expected {what} as a finite number, got {_brief(value)}")
    return float(value)


def _numbers(text: str, names: str) -> list[float]:
    words = text.split(",") if text else []
    if len(words) != (count := names.count(",") + 1):
        raise InputError(f"expected {count} number{'s' * (count > 1)} ({names}), got {len(words)}")
    values = []
    for word in words:
        try:
            values.append(_number(names, float(word)))
        except (ValueError, InputError) as error:
            raise InputError(f"expected finite numbers ({names}), got {_brief(word.strip())}") from error
    return values


def _brief(value: Any) -> str:
    """A value on one short line."""
    if isinstance(value, int) and abs(value) >= MAX_COORDINATE:
        return "a number out of range"
    if isinstance(value, list | dict):
        return f"a {type(value).__name__} of {len(value)}"
    text = "null" if value is None else repr(value)
    return text if len(text) <= 40 else text[:37] + "..."


def _vector(what: str, values: ArrayLike) -> FloatArray:
    array = np.array(values, dtype=np.float64)
    if array.shape != (3,) or not (np.abs(array) < MAX_COORDINATE).all():
        raise InputError(f"expected the {what} as three finite numbers, got {array.tolist()}")
    return array


def _ring(vertices: ArrayLike) -> FloatArray:
    array = np.array(vertices, dtype=np.float64)
    if array.ndim != 2 or array.shape[1] != 2 or not (np.abs(array) < MAX_COORDINATE).all():
        raise InputError(f"expected the ring of a polygon as (M, 2) finite numbers, got shape {array.shape}")
    if len(array) > 1 and (array[0] == array[-1]).all():  # rings in files are closed
        array = array[:-1]
    if (distinct := len(np.unique(array, axis=0))) < 3:
        raise InputError(f"expected a polygon with at least 3 distinct vertices in each ring, got {distinct}")
    return array


# Geometry


def _between(values: FloatArray, lower: float, upper: float) -> Mask:
    result: Mask = values >= lower
    result &= values <= upper
    return result


def _lengths(vectors: FloatArray) -> FloatArray:
    return np.asarray(np.sqrt(np.einsum("ni,ni->n", vectors, vectors)), dtype=np.float64)


def _in_rings(u: FloatArray, v: FloatArray, rings: tuple[FloatArray, ...]) -> Mask:
    """Even-odd rule for points (u, v), each (N,): an odd number of edges to their right, or on an edge."""
    # Sorted by v, an edge concerns one contiguous run of points: the cost goes with the crossings, not the vertices.
    order = np.argsort(v)
    u, v = u[order], v[order]
    begin, end = np.vstack(rings), np.vstack([np.roll(ring, -1, axis=0) for ring in rings])
    upwards = (begin[:, 1] <= end[:, 1])[:, None]
    low, high = np.where(upwards, begin, end), np.where(upwards, end, begin)
    # Closed runs touch the edge; half-open ones [low, high) count a crossing at a shared vertex once.
    first, last = np.searchsorted(v, low[:, 1], "left"), np.searchsorted(v, high[:, 1], "right")
    half_open = np.searchsorted(v, high[:, 1], "left")

    odd, border = np.zeros((2, len(u)), dtype=np.bool_)
    for (u0, v0), (u1, v1), i, j, k in zip(low, high, first, half_open, last, strict=True):
        if i == k:
            continue
        # Positive left of the edge; a sign, not a division: exact on vertices and on level or upright edges.
        side = (u1 - u0) * (v[i:k] - v0) - (v1 - v0) * (u[i:k] - u0)
        border[i:k] |= (side == 0) & _between(u[i:k], min(u0, u1), max(u0, u1))
        odd[i:j] ^= side[: j - i] > 0
    inside = np.empty_like(odd)
    inside[order] = odd | border
    return inside
