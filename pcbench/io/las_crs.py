"""The coordinate reference system of a LAS file: from its records, and into them."""

from __future__ import annotations

import struct
from typing import Any

from pcbench.errors import InputError, MissingExtra
from pcbench.extras import require
from pcbench.io.files import Warn

WKT, GEO_KEYS = ("LASF_Projection", 2112), ("LASF_Projection", 34735)

# GeoTIFF keys, and the EPSG codes of units in them.
_GEOGRAPHIC, _PROJECTED, _LINEAR_UNIT, _VERTICAL = 2048, 3072, 3076, 4096
_UNIT_CODES = {9001: "m", 9002: "ft", 9003: "US-ft"}
_UNITS_BY_METRES = {1.0: "m", 0.3048: "ft", 0.3048006096: "US-ft"}  # units by their length, to ten digits


def read_crs(records: dict[tuple[str, int], bytes], warn: Warn) -> tuple[str | None, str | None]:
    """The system ("EPSG:n" where one is known to be meant, else WKT) and the unit of x and y.

    What cannot be understood is a warning: the coordinates do not depend on it. Without pyproj the text is returned as
    the file has it.
    """
    wkt = records.get(WKT, b"").split(b"\0")[0].decode("utf-8", errors="replace").strip()
    crs, unit = (wkt, None) if wkt else _from_geo_keys(records.get(GEO_KEYS, b""), warn)
    if crs is None:
        return None, unit
    try:
        pyproj = require("pyproj")
    except MissingExtra:
        return crs, unit
    try:
        parsed = pyproj.CRS.from_user_input(crs)
        authority = parsed.to_authority(min_confidence=100)
        return ":".join(authority) if authority else crs, _unit(parsed, warn) or unit
    except (pyproj.exceptions.ProjError, ValueError) as error:
        reason = " ".join(str(error).split())
        reason = "".join(char if char.isprintable() else "?" for char in reason)
        warn(f"coordinate reference system not understood: {reason[:120]}")
        return None, unit


def _unit(crs: Any, warn: Warn) -> str | None:
    """The unit of x; heights in another one are worth a warning, for a distance then mixes the two."""
    units = [
        "deg" if axis.unit_name == "degree" else _UNITS_BY_METRES.get(round(axis.unit_conversion_factor, 10), axis.unit_name)
        for axis in crs.axis_info
    ]
    if len(units) == 3 and units[2] != units[0]:
        warn(f"x and y are in {units[0]}, z is in {units[2]}: the coordinates were left as they are")
        return None  # no unit is true of a distance
    return units[0] if units else None


def _from_geo_keys(data: bytes, warn: Warn) -> tuple[str | None, str | None]:
    """EPSG codes that stand in the keys themselves; systems spelled out key by key are not put together."""
    if not data:
        return None, None
    shorts = [number for (number,) in struct.iter_unpack("<H", data[: len(data) // 2 * 2])]
    entries = [shorts[place : place + 4] for place in range(4, len(shorts) - 3, 4)]
    keys = {key: value for key, location, _, value in entries if location == 0}
    unit = _UNIT_CODES.get(keys.get(_LINEAR_UNIT, 0))
    code = keys.get(_PROJECTED) or keys.get(_GEOGRAPHIC, 0)
    if not 1024 <= code < 32767:  # 32767: defined by the user
        warn("coordinate reference system not understood: its GeoTIFF keys name no EPSG code")
        return None, unit
    vertical = keys.get(_VERTICAL, 0)
    return f"EPSG:{code}+{vertical}" if 1024 <= vertical < 32767 else f"EPSG:{code}", unit


def to_wkt(crs: str) -> bytes:
    """The text of a WKT record: WKT 1 as the specification asks for, WKT 2 where 1 cannot express the system.

    Raises:
        MissingExtra: pyproj is not installed.
        InputError: it does not know the system.
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
