"""Read and write the coordinate reference system in the records of a LAS file."""

from __future__ import annotations

import struct
from functools import lru_cache
from typing import NamedTuple

from pcbench.errors import InputError, MissingExtra
from pcbench.extras import require
from pcbench.geometry.crs import axis_units, single_unit, unnamed_grid, with_units
from pcbench.geometry.units import unit_of_length
from pcbench.io.files import Warn

WKT, GEO_KEYS = ("LASF_Projection", 2112), ("LASF_Projection", 34735)

GEO_DOUBLES = ("LASF_Projection", 34736)  # values of keys that are no integers

# GeoTIFF keys, and the EPSG codes of units.
_MODEL, _GEOGRAPHIC, _PROJECTED, _VERTICAL = 1024, 2048, 3072, 4096
_LINEAR_UNIT, _LINEAR_SIZE, _VERTICAL_UNIT = 3076, 3077, 4099
_UNIT_CODES = {9001: "m", 9002: "ft", 9003: "US-ft"}
_USER_DEFINED, _GEOGRAPHIC_MODEL = 32767, 2


def read_crs(records: dict[tuple[str, int], bytes], warn: Warn) -> tuple[str | None, str | None]:
    """Return the coordinate reference system ("EPSG:n" if it can be identified, else WKT) and the unit of x and y.

    A system that cannot be interpreted only causes a warning, since the coordinates do not depend on it. Without pyproj
    the text is returned as stored.

    Args:
        records: variable length records by user and record ID.
        warn: callback for warnings.
    """
    wkt = records.get(WKT, b"").split(b"\0")[0].decode("utf-8", errors="replace").strip()
    if wkt:
        return _identified(wkt, warn)
    data = records.get(GEO_KEYS, b"")
    return _from_geo_keys(_GeoKeys.parse(data, records.get(GEO_DOUBLES, b"")), warn) if data else (None, None)


def _identified(text: str, warn: Warn) -> tuple[str | None, str | None]:
    """Return the system of a text as in `read_crs`, and its unit."""
    try:
        require("pyproj")
    except MissingExtra:
        return text, None
    identified, lines = _identify(text)
    for line in lines:
        warn(line)
    return identified, single_unit(identified, warn)


@lru_cache(maxsize=64)  # pyproj takes milliseconds, and the tiles of a cloud have the same system
def _identify(text: str) -> tuple[str | None, tuple[str, ...]]:
    """Return the system of a text as in `read_crs`, and warnings."""
    import pyproj

    try:
        authority = pyproj.CRS.from_user_input(text).to_authority(min_confidence=100)
        return ":".join(authority) if authority else text, ()
    except (pyproj.exceptions.ProjError, ValueError) as error:
        reason = " ".join(str(error).split())
        reason = "".join(char if char.isprintable() else "?" for char in reason)
        return None, (f"could not interpret the coordinate reference system: {reason[:120]}",)


class _GeoKeys(NamedTuple):
    """System and units that the GeoTIFF keys of a file state.

    Attributes:
        code: EPSG code of the system of x and y; 0 if it has none.
        vertical: EPSG code of the heights; 0 if they have none.
        unit: unit of x and y, if stated.
        height_unit: unit of z, if stated.
        is_geographic: whether x and y are degrees.
    """

    code: int
    vertical: int
    unit: str | None
    height_unit: str | None
    is_geographic: bool

    @classmethod
    def parse(cls, data: bytes, doubles: bytes) -> _GeoKeys:
        """Parse the directory of keys, and the values that it refers to."""
        shorts = [number for (number,) in struct.iter_unpack("<H", data[: len(data) // 2 * 2])]
        entries = [shorts[place : place + 4] for place in range(4, len(shorts) - 3, 4)]
        keys = {key: value for key, location, _, value in entries if location == 0}
        sizes = [size for (size,) in struct.iter_unpack("<d", doubles[: len(doubles) // 8 * 8])]
        places = {key: place for key, location, _, place in entries if location == GEO_DOUBLES[1]}
        is_geographic = keys.get(_MODEL) == _GEOGRAPHIC_MODEL or (_PROJECTED not in keys and _GEOGRAPHIC in keys)
        unit = _UNIT_CODES.get(keys.get(_LINEAR_UNIT, 0))
        if keys.get(_LINEAR_UNIT) == _USER_DEFINED and places.get(_LINEAR_SIZE, len(sizes)) < len(sizes):
            unit = unit_of_length(sizes[places[_LINEAR_SIZE]])
        codes = [keys.get(_GEOGRAPHIC if is_geographic else _PROJECTED, 0), keys.get(_VERTICAL, 0)]
        code, vertical = (code if 1024 <= code < _USER_DEFINED else 0 for code in codes)
        height_unit = _UNIT_CODES.get(keys.get(_VERTICAL_UNIT, 0))
        return cls(code, vertical, "deg" if is_geographic else unit, height_unit, is_geographic)


def _from_geo_keys(keys: _GeoKeys, warn: Warn) -> tuple[str | None, str | None]:
    """Return the system and the unit that GeoTIFF keys state; systems defined key by key only have units.

    Units that the keys state replace those of the EPSG codes, as in GDAL and PDAL.
    """
    if not keys.code:
        warn("could not interpret the coordinate reference system: its GeoTIFF keys contain no EPSG code")
        if keys.unit and keys.height_unit and not keys.is_geographic and keys.unit != keys.height_unit:
            grid = unnamed_grid(keys.unit, keys.height_unit)
            return grid, single_unit(grid, warn)
        return None, keys.unit
    code = f"EPSG:{keys.code}+{keys.vertical}" if keys.vertical else f"EPSG:{keys.code}"
    units = axis_units(code)
    if units is None:  # without pyproj, or an unknown code
        crs, unit = _identified(code, warn)
        mixed = not keys.is_geographic and keys.height_unit not in (None, keys.unit)
        return crs, unit or (None if mixed else keys.unit)
    horizontal = units.horizontal if keys.is_geographic else keys.unit or units.horizontal
    height = keys.height_unit or units.height
    if not keys.vertical and height == horizontal:
        height = units.height
    if (horizontal, height) == units:
        return _identified(code, warn)
    try:
        crs = with_units(code, horizontal, height)
    except require("pyproj").exceptions.ProjError:
        warn(f"could not interpret the coordinate reference system: {code} cannot have heights in {height}")
        return code, horizontal if height in (None, horizontal) else None
    return crs, single_unit(crs, warn)


def to_wkt(crs: str) -> bytes:
    """Return the text of a WKT record: WKT 1 as the specification requires, or WKT 2 if WKT 1 cannot express it.

    Raises:
        MissingExtra: pyproj is not installed.
        InputError: pyproj does not know the system.
    """
    pyproj = require("pyproj")
    try:
        parsed = pyproj.CRS.from_user_input(crs)
    except pyproj.exceptions.CRSError:
        raise InputError(f"expected a crs that pyproj knows, got {crs[:60]!r}: correct it or set it to None") from None
    try:
        wkt = str(parsed.to_wkt("WKT1_GDAL"))
    except pyproj.exceptions.CRSError:
        wkt = ""
    if axis_units(wkt) != axis_units(crs):  # WKT 1 has one unit for all axes of a local system
        wkt = str(parsed.to_wkt("WKT2_2019"))
    return wkt.encode() + b"\0"
