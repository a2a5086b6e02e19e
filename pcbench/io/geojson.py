"""Write features as GeoJSON (RFC 7946), which every GIS and web map reads."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np

from pcbench.geometry.arrays import FloatArray
from pcbench.geometry.crs import system_definition, to_wgs84
from pcbench.io.vector import FeatureGeometry, VectorLayer
from pcbench.scratch import atomic_write

_DEGREE_DECIMALS = 9  # a tenth of a millimetre
_UNKNOWN_SYSTEM = 'LOCAL_CS["unknown",UNIT["unknown",1]]'


def write_geojson(path: Path, layer: VectorLayer) -> None:
    """Write a layer as a FeatureCollection with one feature per line.

    RFC 7946 knows only longitude and latitude in WGS84, and programs take all coordinates as these. If pyproj can
    transform the layer's system, positions are written so, without heights, which would have to be those above the
    WGS84 ellipsoid. Else x, y and z are written as they are, and the member "crs" of the earlier standard
    (GeoJSON 2008) names the system by its code or its WKT. GDAL and QGIS read both. An unknown system is named as a
    local one, because they would take positions without a system as degrees.

    Args:
        path: output file.
        layer: the layer.

    Raises:
        OSError: the file cannot be written; an existing file is then unchanged.
    """
    shapes, system = _degrees(layer), {}
    if shapes is None:
        shapes = [_coordinates(feature.geometry, feature.geometry.positions) for feature in layer.features]
        system = {"crs": {"type": "name", "properties": {"name": _system_name(layer.crs)}}}
    columns = layer.columns
    features = [
        {
            "type": "Feature",
            "properties": dict(zip(columns, row, strict=True)),
            "geometry": {"type": feature.geometry.kind, "coordinates": shape},
        }
        for feature, shape, row in zip(layer.features, shapes, layer.rows(), strict=True)
    ]
    head = json.dumps({"type": "FeatureCollection", "name": layer.name, **system})
    lines = ",\n".join(json.dumps(feature, allow_nan=False) for feature in features)
    with atomic_write(path) as file:
        file.write(f'{head[:-1]}, "features": [\n{lines}\n]}}\n'.encode())


def _degrees(layer: VectorLayer) -> list[Any] | None:
    """Return the coordinates of each feature in WGS84; None if they cannot be transformed."""
    if layer.crs is None:
        return None
    shapes = [feature.geometry for feature in layer.features]
    positions = [np.empty((0, 2)), *(shape.positions[:, :2] for shape in shapes)]
    try:
        degrees = to_wgs84(layer.crs, np.concatenate(positions)).round(_DEGREE_DECIMALS)
    except ValueError:
        return None
    _, *each = np.split(degrees, np.cumsum([len(part) for part in positions])[:-1])
    return [_coordinates(shape, part) for shape, part in zip(shapes, each, strict=True)]


def _system_name(crs: str | None) -> str:
    """Return the code or the WKT of a coordinate system."""
    system = None if crs is None else system_definition(crs)
    if system is None:
        return _UNKNOWN_SYSTEM
    return system.wkt if system.authority is None else "{}:{}".format(*system.authority)


def _coordinates(geometry: FeatureGeometry, positions: FloatArray) -> Any:
    """Return the positions (N, 2 or 3) of a shape, nested as in GeoJSON."""
    ends = np.cumsum([len(ring) for rings in geometry.parts for ring in rings])
    rings = iter([part.tolist() for part in np.split(positions, ends[:-1])])
    nested = [[next(rings) for _ in part] for part in geometry.parts]
    match geometry.kind:
        case "Point":
            return nested[0][0][0]
        case "LineString":
            return nested[0][0]
        case "Polygon":
            return nested[0]
        case "MultiPolygon":
            return nested
