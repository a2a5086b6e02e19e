"""Read and write the coordinate reference system in the records of a LAS file."""

from __future__ import annotations

import struct
from functools import lru_cache
from typing import Any

from pcbench.errors import InputError, MissingExtra
from pcbench.extras import require
from pcbench.io.files import Warn

WKT, GEO_KEYS = ("LASF_Projection", 2112), ("LASF_Projection", 34735)

# GeoTIFF keys, and the EPSG codes of units.
_GEOGRAPHIC, _PROJECTED, _LINEAR_UNIT, _VERTICAL = 2048, 3072, 3076, 4096
_UNIT_CODES = {9001: "m", 9002: "ft", 9003: "US-ft"}
_UNITS_BY_METRES = {1.0: "m", 0.3048: "ft", 0.3048006096: "US-ft"}  # by length in metres, rounded to ten decimals


def read_crs(records: dict[tuple[str, int], bytes], warn: Warn) -> tuple[str | None, str | None]:
    """Return the coordinate reference system ("EPSG:n" if it can be identified, else WKT) and the unit of x and y.

    A system that cannot be interpreted only causes a warning, since the coordinates do not depend on it. Without pyproj
    the text is returned as stored.

    Args:
        records: variable length records by user and record ID.
        warn: callback for warnings.
    """
    wkt = records.get(WKT, b"").split(b"\0")[0].decode("utf-8", errors="replace").strip()
    crs, unit = (wkt, None) if wkt else _from_geo_keys(records.get(GEO_KEYS, b""), warn)
    if crs is None:
        return None, unit
    try:
        require("pyproj")
    except MissingExtra:
        return crs, unit
    identified, crs_unit, lines = _identify(crs)
    for line in lines:
        warn(line)
    return identified, crs_unit or unit


@lru_cache(maxsize=64)  # pyproj takes milliseconds, and the tiles of a cloud have the same system
def _identify(text: str) -> tuple[str | None, str | None, tuple[str, ...]]:
    """Return the system of a text as in `read_crs`, its unit, and warnings."""
    import pyproj

    lines: list[str] = []
    try:
        parsed = pyproj.CRS.from_user_input(text)
        authority = parsed.to_authority(min_confidence=100)
        return ":".join(authority) if authority else text, _unit(parsed, lines.append), tuple(lines)
    except (pyproj.exceptions.ProjError, ValueError) as error:
        reason = " ".join(str(error).split())
        reason = "".join(char if char.isprintable() else "?" for char in reason)
        lines.append(f"could not interpret the coordinate reference system: {reason[:120]}")
        return None, None, tuple(lines)


def _unit(crs: Any, warn: Warn) -> str | None:
    """Return the unit of x; None, with a warning, if heights have another unit, since distances then have none."""
    units = [
        "deg"
        if axis.unit_name == "degree"
        else _UNITS_BY_METRES.get(round(axis.unit_conversion_factor, 10), axis.unit_name)
        for axis in crs.axis_info
    ]
    if len(units) == 3 and units[2] != units[0]:
        warn(f"x and y are in {units[0]}, z is in {units[2]}: convert z, the coordinates were not changed")
        return None  # distances have no single unit
    return units[0] if units else None


def _from_geo_keys(data: bytes, warn: Warn) -> tuple[str | None, str | None]:
    """Return the EPSG code in the GeoTIFF keys and the unit; systems defined key by key are not supported."""
    if not data:
        return None, None
    shorts = [number for (number,) in struct.iter_unpack("<H", data[: len(data) // 2 * 2])]
    entries = [shorts[place : place + 4] for place in range(4, len(shorts) - 3, 4)]
    keys = {key: value for key, location, _, value in entries if location == 0}
    unit = _UNIT_CODES.get(keys.get(_LINEAR_UNIT, 0))
    code = keys.get(_PROJECTED) or keys.get(_GEOGRAPHIC, 0)
    if not 1024 <= code < 32767:  # 32767: user-defined
        warn("could not interpret the coordinate reference system: its GeoTIFF keys contain no EPSG code")
        return None, unit
    vertical = keys.get(_VERTICAL, 0)
    return f"EPSG:{code}+{vertical}" if 1024 <= vertical < 32767 else f"EPSG:{code}", unit


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
        wkt = parsed.to_wkt("WKT1_GDAL")
    except pyproj.exceptions.CRSError:
        wkt = parsed.to_wkt("WKT2_2019")
    return str(wkt).encode() + b"\0"
