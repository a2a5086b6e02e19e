"""Coordinate reference systems (CRS) given as WKT or as an authority code."""

from __future__ import annotations

import re
from functools import lru_cache
from typing import Any

import numpy as np

from pcbench.errors import MissingExtra
from pcbench.extras import require
from pcbench.geometry.arrays import FloatArray
from pcbench.geometry.transform import fit_similarity

METRES_PER_DEGREE = 111_320.0  # of latitude, and of longitude at the equator
_MAX_LABEL_LENGTH = 100
_GEOGRAPHIC_TEXT = re.compile(
    r"\s*(GEOGCS|GEOGCRS|GEOGRAPHICCRS)\s*\[|\s*(EPSG:4326|EPSG:4979|OGC:CRS84h?)\s*$", re.IGNORECASE
)
_DEGREE_UNITS = ("deg", "degree", "degrees", "°")


def same_crs(first: str, second: str) -> bool:
    """Return whether two texts name the same CRS. Without pyproj, this is only true of equal texts."""
    if first == second:
        return True
    a, b = _parse_crs(first), _parse_crs(second)
    return a is not None and b is not None and bool(a.equals(b, ignore_axis_order=True))


def crs_name(text: str) -> str:
    """Return a short name for messages: the authority code, or else the name of the CRS."""
    crs = _parse_crs(text)
    if crs is None:
        return text if len(text) <= 40 else f"{text[:37]}..."
    authority = crs.to_authority(min_confidence=100)
    return ":".join(authority) if authority else str(crs.name)


def crs_label(text: str) -> str:
    """Return the name of a CRS and its authority code, if any, on one line of at most 100 characters.

    Without pyproj, the name is read from the start of the WKT; other texts are returned as they are.
    """
    crs = _parse_crs(text)
    if crs is not None:
        code = crs.to_authority(min_confidence=100)
        line = f"{crs.name} ({':'.join(code)})" if code else str(crs.name)
    else:
        quoted = re.match(r'\s*\w+\s*\[\s*"([^"]+)"', text)
        line = quoted[1] if quoted else text
    line = " ".join(line.split())
    return line if len(line) <= _MAX_LABEL_LENGTH else f"{line[: _MAX_LABEL_LENGTH - 3]}..."


def is_known_crs(text: str | None) -> bool:
    """Return whether pyproj is installed and knows the CRS."""
    return text is not None and _parse_crs(text) is not None


def is_projected_crs(text: str | None) -> bool:
    """Return whether the CRS is projected, alone or with a vertical CRS, so that z is a height."""
    crs = None if text is None else _parse_crs(text)
    if crs is None:
        return False
    return bool((crs.sub_crs_list[0] if crs.sub_crs_list else crs).is_projected)


def is_geographic_crs(text: str | None) -> bool:
    """Return whether x and y of the CRS are angles. Without pyproj, this is read from the start of the text."""
    crs = None if text is None else _parse_crs(text)
    if crs is None:
        return text is not None and _GEOGRAPHIC_TEXT.match(text) is not None
    return bool((crs.sub_crs_list[0] if crs.sub_crs_list else crs).is_geographic)


def is_in_degrees(crs: str | None, unit: str | None) -> bool:
    """Return whether a cloud with this CRS and this unit has longitudes and latitudes as x and y."""
    return (unit or "").strip().lower() in _DEGREE_UNITS or is_geographic_crs(crs)


def epsg_code(text: str) -> tuple[int, bool] | None:
    """Return the EPSG code of a CRS in the plane, and whether it is geographic; None if it has none or is unknown."""
    crs = _parse_crs(text)
    if crs is None:
        return None
    crs = crs.sub_crs_list[0] if crs.sub_crs_list else crs
    code = crs.to_epsg(min_confidence=100)
    return None if code is None or not (crs.is_projected or crs.is_geographic) else (code, bool(crs.is_geographic))


def wkt2(text: str) -> str:
    """Return a known CRS as WKT 2.

    Raises:
        ValueError: pyproj is not installed or does not know the CRS.
    """
    return str(_known(text).to_wkt("WKT2_2019"))


def to_wgs84(text: str, positions: FloatArray) -> FloatArray:
    """Return longitude and latitude (N, 2) of positions (N, 2) in a known CRS, in degrees of WGS84.

    Raises:
        ValueError: pyproj is not installed or does not know the CRS.
    """
    crs = _known(text)
    from pyproj import Transformer

    transformer = Transformer.from_crs(crs.sub_crs_list[0] if crs.sub_crs_list else crs, "EPSG:4326", always_xy=True)
    return np.stack(transformer.transform(positions[:, 0], positions[:, 1]), axis=1)


def euclidean_offsets(text: str, positions: FloatArray) -> FloatArray | None:
    """Return offsets (N, 3) from positions (N, 3) on a map grid to their Euclidean positions, in the map's unit.

    Earth-centred coordinates are fitted to the map coordinates by a rigid motion. The residuals are the Earth's
    curvature and the scale of the projection. Heights are taken as ellipsoidal. The result is None if the CRS is
    unknown or not projected.
    """
    crs = _parse_crs(text)
    if crs is None:
        return None
    crs = crs.sub_crs_list[0] if crs.sub_crs_list else crs
    if not crs.is_projected:
        return None
    from pyproj import Transformer

    unit = crs.axis_info[0].unit_conversion_factor
    to_geographic = Transformer.from_crs(crs, crs.geodetic_crs, always_xy=True)
    longitude, latitude = to_geographic.transform(positions[:, 0], positions[:, 1])
    to_space = Transformer.from_crs(crs.geodetic_crs.to_3d(), {"proj": "geocent", "datum": "WGS84"}, always_xy=True)
    space = np.stack(to_space.transform(longitude, latitude, positions[:, 2] * unit), axis=1) / unit
    if not np.isfinite(space).all():
        return None
    offsets: FloatArray = fit_similarity(space, positions, with_scale=False).apply(space) - positions
    return offsets


def _known(text: str) -> Any:
    crs = _parse_crs(text)
    if crs is None:
        raise ValueError(f"expected a CRS that pyproj knows, got {text[:60]!r}")
    return crs


def _parse_crs(text: str) -> Any | None:
    try:
        require("pyproj")
    except MissingExtra:
        return None
    return _parse_known(text)


@lru_cache(maxsize=64)  # pyproj takes milliseconds, and the tiles of a cloud have the same system
def _parse_known(text: str) -> Any | None:
    import pyproj

    try:
        return pyproj.CRS.from_user_input(text)
    except pyproj.exceptions.CRSError:
        return None
