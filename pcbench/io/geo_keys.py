"""The tags of a GeoTIFF that define the coordinate system of its pixels, as in OGC GeoTIFF 1.1 (OGC 19-008r4).

A system with EPSG codes is written as these: that of x and y, and that of heights if there is one. Another system is
written as WKT, after the words with which ESRI's programs mark it. GDAL, QGIS and ArcGIS read both.
"""

from __future__ import annotations

from pcbench.geometry.crs import epsg_codes, horizontal_wkt
from pcbench.io.tiff import ASCII, SHORT, Tags

_DIRECTORY, _TEXTS = 34735, 34737
_MODEL_TYPE, _RASTER_TYPE, _GEOGRAPHIC, _PROJECTED, _CITATION, _VERTICAL = 1024, 1025, 2048, 3072, 3073, 4096
_PROJECTED_MODEL, _GEOGRAPHIC_MODEL, _USER_DEFINED, _AREA = 1, 2, 32767, 1
_MIN_CODE = 1024  # of EPSG; `_USER_DEFINED` is beyond the last one


def geo_keys(crs: str | None) -> Tags:
    """Return the tags for a coordinate system; none if it is unknown, geocentric, or pyproj is not installed."""
    codes = None if crs is None else epsg_codes(crs)
    if codes is not None and _MIN_CODE <= codes.horizontal < _USER_DEFINED:
        model, key = (_GEOGRAPHIC_MODEL, _GEOGRAPHIC) if codes.is_geographic else (_PROJECTED_MODEL, _PROJECTED)
        entries = [*_model(model), (key, 0, 1, codes.horizontal)]
        if codes.vertical is not None and _MIN_CODE <= codes.vertical < _USER_DEFINED:
            entries.append((_VERTICAL, 0, 1, codes.vertical))
        return {_DIRECTORY: _directory(entries)}
    wkt = None if crs is None else horizontal_wkt(crs)
    if wkt is None:
        return {}
    text = f"ESRI PE String = {wkt}".replace("|", "/").encode() + b"|"  # a bar ends each text
    return {
        _DIRECTORY: _directory([*_model(_USER_DEFINED), (_CITATION, _TEXTS, len(text), 0)]),
        _TEXTS: (ASCII, text + b"\0"),
    }


def _model(kind: int) -> list[tuple[int, int, int, int]]:
    """Return the keys for the kind of the system, and for pixels that are areas."""
    return [(_MODEL_TYPE, 0, 1, kind), (_RASTER_TYPE, 0, 1, _AREA)]


def _directory(entries: list[tuple[int, int, int, int]]) -> tuple[int, list[float]]:
    """Return the directory of keys, each with the tag of its values, or 0, their number, and the value or its place."""
    return SHORT, [1, 1, 1, len(entries), *(number for entry in entries for number in entry)]
