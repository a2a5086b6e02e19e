"""Read polygons from GeoJSON, WKT, and the selection volumes of Open3D and Tanks and Temples."""

from __future__ import annotations

import json
import math
import re
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from pcbench.errors import InputError, reason_of
from pcbench.geometry.arrays import MAX_COORDINATE
from pcbench.geometry.regions import AXES, Polygon, Union
from pcbench.regular_files import decode_text, read_bytes


def read_polygon(path: str | Path) -> Polygon | Union:
    """Read a polygon from a GeoJSON or WKT file (heights are ignored), or from a selection volume.

    GeoJSON may be a Polygon, a MultiPolygon, a Feature or a FeatureCollection (RFC 7946). WKT may be a POLYGON or
    MULTIPOLYGON, with or without Z and M and a leading SRID. A selection volume is the JSON file that Open3D writes and
    Tanks and Temples uses for cropping: class_name SelectionPolygonVolume. Coordinates are taken as those of the
    reference, see `stated_epsg`.

    Raises:
        InputError: the file cannot be read or has none of these formats.
    """
    try:
        data = read_bytes(path)
    except (InputError, OSError) as error:
        raise InputError(f"{path}: cannot read a polygon: {reason_of(error)}") from error
    try:
        polygon = _polygon_from(data)
    except InputError as error:
        raise InputError(f"{path}: {error}") from error
    object.__setattr__(polygon, "file", Path(path))  # safe on a frozen dataclass: the polygon is not shared yet
    return polygon


def stated_epsg(path: str | Path) -> int | None:
    """Return the EPSG code of the coordinate system that a file of polygons states; None if it states none.

    GeoJSON states it in the member "crs" of the earlier standard, as QGIS writes it, and WKT by a leading SRID.

    Raises:
        InputError, OSError: the file cannot be read.
    """
    data = read_bytes(path)
    match = _SRID.match(data) or _NAMED_CRS.search(data)
    if match is None:
        return None
    return int(match["code"]) if match["code"] else _WGS84


def read_zones(path: str | Path) -> dict[str, Polygon | Union]:
    """Read polygons by their names from a GeoJSON or WKT file.

    The name of a feature of GeoJSON is its property `name`, `zone`, `id` or `label`, its id, or else "zone" with its
    number. Features of one name are one zone. A file of another kind is one zone with the name of the file.

    Raises:
        InputError: the file cannot be read or has no polygon.
    """
    whole = read_polygon(path)
    try:
        content = json.loads(decode_text(read_bytes(path)))
    except ValueError:
        content = None
    if not isinstance(content, dict) or content.get("type") != "FeatureCollection":
        return {Path(path).stem: whole}
    parts: dict[str, list[_Part]] = {}
    for number, feature in enumerate(content["features"], 1):
        parts.setdefault(_feature_name(feature, number), []).extend(_feature_parts(feature))
    return {name: _union(polygons) for name, polygons in parts.items() if polygons}


def _feature_name(feature: dict[str, Any], number: int) -> str:
    properties = feature.get("properties")
    values = {str(key).lower(): value for key, value in properties.items()} if isinstance(properties, dict) else {}
    for value in (*(values.get(key) for key in ("name", "zone", "id", "label")), feature.get("id")):
        if isinstance(value, str | int) and not isinstance(value, bool) and str(value).strip():
            return " ".join(str(value).split())
    return f"zone {number}"


def _polygon_from(data: bytes) -> Polygon | Union:
    expected = "expected a polygon as GeoJSON, WKT or SelectionPolygonVolume"
    try:
        text = decode_text(data).strip()
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


# A part is a polygon as files define it: its outer ring, then its holes.
_Part = Sequence[Sequence[Sequence[float]]]


def _union(parts: Iterable[_Part]) -> Polygon | Union:
    polygons = tuple(Polygon(tuple(np.array([v[:2] for v in ring]) for ring in part)) for part in parts)
    if not polygons:
        raise InputError("expected at least one polygon, got none")
    return polygons[0] if len(polygons) == 1 else Union(polygons)


def _geojson_parts(content: dict[str, Any]) -> list[_Part]:
    kind = content.get("type")
    if kind == "FeatureCollection":
        features = _as_list("features", content.get("features"))
        return [part for feature in features for part in _feature_parts(feature)]
    return _feature_parts(content)


def _feature_parts(feature: Any) -> list[_Part]:
    geometry = feature.get("geometry") if isinstance(feature, dict) and feature.get("type") == "Feature" else feature
    kind = geometry.get("type") if isinstance(geometry, dict) else geometry
    if not isinstance(geometry, dict) or kind not in ("Polygon", "MultiPolygon"):
        raise InputError(
            f"expected GeoJSON of type Polygon, MultiPolygon, Feature or FeatureCollection, got {shorten(kind)}"
        )
    coordinates = _as_list("coordinates", geometry.get("coordinates"))
    parts = [coordinates] if kind == "Polygon" else coordinates
    return [[_vertices(ring, 2) for ring in _as_list("a polygon", part)] for part in parts]


_WKT = re.compile(r"(SRID\s*=\s*\d+\s*;\s*)?(?P<multi>MULTI)?POLYGON\s*(ZM|Z|M)?(?![a-z])\s*", re.IGNORECASE)
_SRID = re.compile(rb"\s*SRID\s*=\s*(?P<code>\d{1,9})\s*;", re.IGNORECASE)
_NAMED_CRS = re.compile(rb'"crs"\s*:\s*\{[^{}]*\{\s*"name"\s*:\s*"[^"]*(?:EPSG:+(?P<code>\d{1,9})|CRS84)"')
_WGS84 = 4326
_WKT_RING = re.compile(r"\(([^()]*)\)")
_WKT_PART = re.compile(r"\((?:R,)*R\)")
_WKT_PARTS = re.compile(r"\((?:\((?:R,)*R\),)*\((?:R,)*R\)\)")


def _wkt_parts(multi: bool, body: str) -> list[_Part]:
    body = body.rstrip().removesuffix(";")
    if body.upper() == "EMPTY":
        return []
    # With each innermost pair of brackets replaced by one letter, the nesting is a regular language.
    skeleton = "".join(_WKT_RING.sub("R", body.replace("R", "?")).split())
    if not (_WKT_PARTS if multi else _WKT_PART).fullmatch(skeleton):
        example = "MULTIPOLYGON (((x y, ...), (hole)), ((x y, ...)))" if multi else "POLYGON ((x y, ...), (hole))"
        raise InputError(f"expected WKT of the form {example}, got brackets of another form")
    rings = iter(_WKT_RING.findall(body))
    return [[_wkt_ring(next(rings)) for _ in range(part.count("R"))] for part in _WKT_PART.findall(skeleton)]


def _wkt_ring(text: str) -> Sequence[Sequence[float]]:
    try:
        return _vertices([[float(word) for word in vertex.split()] for vertex in text.split(",")], 2)
    except InputError:  # a subclass of ValueError whose message is complete already
        raise
    except ValueError as error:
        raise InputError(f"expected WKT vertices as numbers, got {shorten(str(error).partition(': ')[2])}") from error


def _selection_volume(content: dict[str, Any]) -> Polygon:
    if content.get("class_name") != "SelectionPolygonVolume":
        raise InputError(f"expected class_name SelectionPolygonVolume, got {shorten(content.get('class_name'))}")
    axis_name = content.get("orthogonal_axis")
    if not isinstance(axis_name, str) or len(axis_name) != 1 or axis_name.lower() not in AXES:
        raise InputError(f"expected orthogonal_axis X, Y or Z, got {shorten(axis_name)}")
    axis = AXES.index(axis_name.lower())
    lower, upper = (as_finite_number(name, content.get(name)) for name in ("axis_min", "axis_max"))
    vertices = np.array(_vertices(content.get("bounding_polygon"), 3))
    return Polygon((np.delete(vertices[:, :3], axis, axis=1),), axis, lower, upper)


# Checks of file contents


def _vertices(ring: Any, size: int) -> list[list[float]]:
    """Return the first `size` coordinates of each vertex of a ring."""
    result = []
    for vertex in _as_list("a ring of vertices", ring):
        values = _as_list("a vertex", vertex)
        if len(values) < size:
            raise InputError(f"expected vertices of at least {size} numbers, got {shorten(vertex)}")
        result.append([as_finite_number("a coordinate", value) for value in values[:size]])
    if not result:
        raise InputError("expected a ring of vertices, got none")
    return result


def _as_list(name: str, value: Any) -> list[Any]:
    if not isinstance(value, list):
        raise InputError(f"expected {name} as a list, got {shorten(value)}")
    return value


def as_finite_number(name: str, value: Any) -> float:
    """Return a number in a file as a float; raise InputError if it is not a finite number or is out of range."""
    # bool is an int in Python, and integers in JSON have any length.
    if isinstance(value, bool) or not isinstance(value, int | float) or not abs(value) < MAX_COORDINATE:
        expected = "a finite number"
        if isinstance(value, float) and math.isfinite(value):
            expected += f" below {MAX_COORDINATE:g}"
        raise InputError(f"expected {name} as {expected}, got {shorten(value)}")
    return float(value)


def shorten(value: Any) -> str:
    """Return a value as text on one line of at most 40 characters, for messages."""
    if isinstance(value, int) and abs(value) >= MAX_COORDINATE:
        return "a number out of range"
    if isinstance(value, list | dict):
        return f"a {type(value).__name__} of {len(value)}"
    text = "null" if value is None else repr(value)
    return text if len(text) <= 40 else text[:37] + "..."
