"""Coordinate reference systems (CRS) given as WKT or as an authority code."""

from __future__ import annotations

import re
from collections.abc import Callable
from contextlib import suppress
from functools import lru_cache
from typing import Any, NamedTuple, Protocol

import numpy as np

from pcbench.errors import InputError, MissingExtra
from pcbench.extras import require
from pcbench.geometry.arrays import FloatArray
from pcbench.geometry.transform import fit_similarity
from pcbench.geometry.units import is_degree, metres, unit_of_length

METRES_PER_DEGREE = 111_320.0  # of latitude, and of longitude at the equator
_ANGLES = ("deg", "grad", "radian")
_LONG_NAMES = {"m": "metre", "ft": "foot", "US-ft": "US survey foot"}
_UNKNOWN_HEIGHTS = {
    "type": "VerticalCRS",
    "name": "heights",
    "datum": {"type": "VerticalReferenceFrame", "name": "unknown"},
    "coordinate_system": {
        "subtype": "vertical",
        "axis": [{"name": "Gravity-related height", "abbreviation": "H", "direction": "up", "unit": "metre"}],
    },
}
_MAX_LABEL_LENGTH = 100
_MAX_HINTED_DEGREES = 1.0  # extent of a cloud that may be in degrees without saying so
_HINTED_ASPECT, _HINTED_OFFSET = 1000, 10  # of height and distance from the origin to the width
_GEOGRAPHIC_TEXT = re.compile(
    r"\s*(GEOGCS|GEOGCRS|GEOGRAPHICCRS)\s*\[|\s*(EPSG:4326|EPSG:4979|OGC:CRS84h?)\s*$", re.IGNORECASE
)


def same_crs(first: str, second: str) -> bool:
    """Return whether two texts name the same CRS. Without pyproj, this is only true of equal texts."""
    if first == second:
        return True
    a, b = parse_crs(first), parse_crs(second)
    return a is not None and b is not None and bool(a.equals(b, ignore_axis_order=True))


def crs_name(text: str) -> str:
    """Return a short name for messages: the code, such as EPSG:32617 or EPSG:32617+5703, or else the CRS's name."""
    crs = parse_crs(text)
    if crs is None:
        return text if len(text) <= 40 else f"{text[:37]}..."
    return _code(crs) or str(crs.name)


def crs_argument(text: str) -> str:
    """Return a CRS as an argument for a command: its code, such as EPSG:32617, or the word CRS if it has none."""
    name = crs_name(text)
    return name if re.fullmatch(r"[A-Z]+:\w+(\+\d+)?", name) else "CRS"


def crs_label(text: str) -> str:
    """Return the name of a CRS and its authority code, if any, on one line of at most 100 characters.

    Without pyproj, the name is read from the start of the WKT; other texts are returned as they are.
    """
    crs = parse_crs(text)
    if crs is not None:
        code = _code(crs)
        line = f"{crs.name} ({code})" if code else str(crs.name)
    else:
        quoted = re.match(r'\s*\w+\s*\[\s*"([^"]+)"', text)
        line = quoted[1] if quoted else text
    line = " ".join(line.split())
    return line if len(line) <= _MAX_LABEL_LENGTH else f"{line[: _MAX_LABEL_LENGTH - 3]}..."


def is_known_crs(text: str | None) -> bool:
    """Return whether pyproj is installed and knows the CRS."""
    return text is not None and parse_crs(text) is not None


def is_projected_crs(text: str | None) -> bool:
    """Return whether the CRS is projected, alone or with a vertical CRS, so that z is a height."""
    crs = None if text is None else parse_crs(text)
    if crs is None:
        return False
    return bool(horizontal_crs(crs).is_projected)


def is_geographic_crs(text: str | None) -> bool:
    """Return whether x and y of the CRS are angles. Without pyproj, this is read from the start of the text."""
    crs = None if text is None else parse_crs(text)
    if crs is None:
        return text is not None and _GEOGRAPHIC_TEXT.match(text) is not None
    return bool(horizontal_crs(crs).is_geographic)


def single_unit(crs: str | None, warn: Callable[[str], None]) -> str | None:
    """Return the unit of the coordinates in a CRS; None, with a warning, if heights have another unit than x and y."""
    units = axis_units(crs)
    if units is None:
        return None
    if units.are_mixed:
        warn(
            f"x and y are in {units.horizontal}, z is in {units.height}, so distances have no unit: convert them with"
            f" pcbench convert FILE OUT --to-unit {units.horizontal}"
        )
        return None
    return units.horizontal


def check_lengths(cloud: Located, name: str) -> None:
    """Check that the coordinates of a cloud are lengths.

    Args:
        cloud: the cloud, its mesh, or what the headers of its files state.
        name: path or name of the cloud, for the message.

    Raises:
        InputError: x and y are degrees. The message names a command that projects the cloud.
    """
    if is_in_degrees(cloud.crs, cloud.unit):
        system = f" ({crs_name(cloud.crs)})" if cloud.crs else ""
        raise InputError(
            f"{name}: expected coordinates in a unit of length, got degrees{system}: project the cloud with"
            f" {projection_command(cloud.crs, *cloud.centre)}"
        )


def check_heights(crs: str | None, name: str) -> None:
    """Check that z of a CRS is a height, for measures in which only z counts as such.

    Raises:
        InputError: the coordinates are geocentric, so that z is along the axis of the Earth.
    """
    system = None if crs is None else parse_crs(crs)
    if system is not None and system.is_geocentric:
        raise InputError(
            f"{name}: expected heights as z, got geocentric coordinates ({crs_name(str(crs))}): project the cloud with"
            " pcbench convert FILE OUT --to-crs EPSG:CODE"
        )


def projection_command(crs: str | None, longitude: float, latitude: float) -> str:
    """Return a command that projects a cloud in degrees at a place."""
    source = "" if crs else " --crs EPSG:4326"
    return f"pcbench convert FILE OUT{source} --to-crs {suggested_crs(crs, longitude, latitude)}"


def degrees_hint(low: FloatArray, high: FloatArray) -> str | None:
    """Return a warning if a cloud without a CRS, with these corners (3,), seems to have longitudes and latitudes.

    Lengths do not look like this: a column that is a thousand times as high as it is wide, and far from the origin.
    """
    (east, north, up), centre = (high - low).tolist(), (low / 2 + high / 2).tolist()
    width = max(east, north)
    if not (0 < width <= _MAX_HINTED_DEGREES and up > _HINTED_ASPECT * width):
        return None
    if abs(centre[0]) > 180 or abs(centre[1]) > 90 or max(map(abs, centre[:2])) < _HINTED_OFFSET * width:
        return None
    return (
        "x and y look like longitudes and latitudes in degrees, which are no lengths; if so:"
        f" {projection_command(None, *centre[:2])}"
    )


def is_in_degrees(crs: str | None, unit: str | None) -> bool:
    """Return whether a cloud with this CRS and this unit has longitudes and latitudes as x and y."""
    return is_degree(unit) or is_geographic_crs(crs)


class Located(Protocol):
    """Place and unit of a cloud, of a mesh or of files."""

    @property
    def crs(self) -> str | None:
        """Coordinate reference system, if known."""

    @property
    def unit(self) -> str | None:
        """Unit of the coordinates, if known."""

    @property
    def centre(self) -> tuple[float, float]:
        """Middle of the ranges of x and y."""


class AxisUnits(NamedTuple):
    """Units of a CRS: that of x and y, and that of z, or None if the CRS has no heights."""

    horizontal: str
    height: str | None

    @property
    def are_mixed(self) -> bool:
        """Return whether x, y and z are lengths in different units."""
        return self.height not in (None, self.horizontal) and self.horizontal not in _ANGLES


def axis_units(text: str | None) -> AxisUnits | None:
    """Return the units of a CRS, as short names if they have one; None if the CRS is unknown."""
    crs = None if text is None else parse_crs(text)
    units = [
        "deg" if axis.unit_name == "degree" else unit_of_length(axis.unit_conversion_factor) or str(axis.unit_name)
        for axis in (() if crs is None else crs.axis_info)
    ]
    return AxisUnits(units[0], units[2] if len(units) > 2 else None) if len(units) > 1 else None


def axis_lengths(text: str | None) -> tuple[float, float] | None:
    """Return the lengths in metres of the units of x and y, and of z, in a CRS; None if it is unknown.

    z is in the unit of x and y if the CRS has no heights, and in metres if x and y are angles.
    """
    units, crs = axis_units(text), None if text is None else parse_crs(text)
    if units is None or crs is None:
        return None
    factors = [float(axis.unit_conversion_factor) for axis in crs.axis_info]
    return factors[0], factors[2] if len(factors) > 2 else 1.0 if units.horizontal in _ANGLES else factors[0]


def with_units(text: str, horizontal: str, height: str | None) -> str:
    """Return the WKT of a CRS with other units of length and otherwise the same definition.

    Args:
        text: a projected or geographic CRS that pyproj knows, alone or with a vertical one.
        horizontal: unit of x and y; degrees stay.
        height: unit of z; None: the CRS has no heights, or they are in the unit of x and y. If it had none before,
            their datum is unknown.

    Raises:
        InputError: pyproj does not know the CRS.
        MissingExtra: pyproj is not installed.
    """
    from pyproj import CRS

    crs = known_crs(text)
    below, *above = crs.sub_crs_list or [crs]
    parts = [_in_unit(below, horizontal, height)]
    if height is not None and len(below.axis_info) < 3:
        parts.append(_in_unit(above[0] if above else CRS.from_json_dict(_UNKNOWN_HEIGHTS), height))
    if len(parts) == 1:
        return str(parts[0].to_wkt())
    name = " + ".join(part.name for part in parts)
    components = [part.to_json_dict() for part in parts]
    return str(CRS.from_json_dict({"type": "CompoundCRS", "name": name, "components": components}).to_wkt())


def unnamed_grid(horizontal: str, height: str) -> str:
    """Return the WKT of a Cartesian system of which only the units are known."""
    lengths = [f'LENGTHUNIT["{unit}",{metres(unit)}]' for unit in (horizontal, horizontal, height)]
    axes = zip(("(X)", "(Y)", "(Z)"), ("east", "north", "up"), lengths, strict=True)
    listed = ",".join(f'AXIS["{name}",{direction},{unit}]' for name, direction, unit in axes)
    return f'ENGCRS["user-defined",EDATUM["user-defined"],CS[Cartesian,3],{listed}]'


def _in_unit(crs: Any, unit: str, height: str | None = None) -> Any:
    """Return a CRS with its axes in units of length, or the CRS itself if they are, or if the units are unknown.

    Args:
        crs: the CRS, not compound.
        unit: unit of the axes that are lengths.
        height: unit of the third axis, if it differs.
    """
    from pyproj import CRS

    units = [unit, unit, height or unit][: len(crs.axis_info)]
    values, is_changed = crs.to_json_dict(), False
    for axis, name, given in zip(values["coordinate_system"]["axis"], units, crs.axis_info, strict=True):
        length = metres(name)
        if length is None or given.unit_name in ("degree", "grad", "radian"):
            continue
        if abs(given.unit_conversion_factor / length - 1) >= 1e-9:
            axis["unit"] = {"type": "LinearUnit", "name": _LONG_NAMES.get(name, name), "conversion_factor": length}
            is_changed = True
    if not is_changed:
        return crs
    values.pop("id", None)
    label = (height if crs.is_geographic else None) or unit
    values["name"] = f"{re.sub(r' [(](m|ft|ftUS|US-ft)[)]$', '', crs.name)} ({label})"
    return CRS.from_json_dict(values)


def suggested_crs(text: str | None, longitude: float, latitude: float) -> str:
    """Return the code of the UTM zone of a place, with the datum of a geographic CRS if there is one, else WGS 84."""
    crs = None if text is None else parse_crs(text)
    zone = min(int((longitude + 180) % 360 // 6) + 1, 60)
    code = (32600 if latitude >= 0 else 32700) + zone if abs(latitude) < 84 else 5041 if latitude > 0 else 5042
    if crs is not None and crs.geodetic_crs is not None and abs(latitude) < 84:
        from pyproj.aoi import AreaOfInterest
        from pyproj.database import query_utm_crs_info

        place = AreaOfInterest(longitude, latitude, longitude, latitude)
        zones = query_utm_crs_info(crs.geodetic_crs.name, place)
        return f"EPSG:{zones[0].code}" if zones else f"EPSG:{code}"
    return f"EPSG:{code}"


class EpsgCodes(NamedTuple):
    """EPSG codes of a CRS.

    Attributes:
        horizontal: code of the system of x and y.
        is_geographic: whether x and y are angles.
        vertical: code of the system of heights; None if there is none, or if it has no code.
    """

    horizontal: int
    is_geographic: bool
    vertical: int | None


def epsg_codes(text: str) -> EpsgCodes | None:
    """Return the EPSG codes of a CRS; None if that of x and y has none, or if the CRS is unknown."""
    crs = parse_crs(text)
    if crs is None:
        return None
    below, *above = crs.sub_crs_list or [crs]
    below = below if below.is_geocentric or len(below.axis_info) < 3 else below.to_2d()
    code = below.to_epsg(min_confidence=100)
    if code is None or not (below.is_projected or below.is_geographic):
        return None
    vertical = above[0].to_epsg(min_confidence=100) if above else None
    return EpsgCodes(code, bool(below.is_geographic), vertical)


class SystemDefinition(NamedTuple):
    """Name, authority with its code, if any, and WKT of a CRS, as databases store them."""

    name: str
    authority: tuple[str, int] | None
    wkt: str


def system_definition(text: str) -> SystemDefinition | None:
    """Return the definition of a complete CRS, as WKT 1 of GDAL if that can express it; None if it is unknown.

    Without pyproj, it is not known of a code what it means, nor of WKT whether it is right: both are passed on.
    """
    crs = parse_crs(text)
    if crs is None:
        if match := re.fullmatch(r"EPSG:(\d{4,5})", text):
            return SystemDefinition(text, ("EPSG", int(match[1])), "undefined")
        return SystemDefinition(crs_label(text), None, text) if re.match(r"[A-Z_]+\[", text) else None
    from pyproj.exceptions import CRSError

    authority, code = crs.to_authority(min_confidence=100) or ("", "")
    try:
        wkt = crs.to_wkt("WKT1_GDAL")
    except CRSError:
        wkt = crs.to_wkt("WKT2_2019")
    return SystemDefinition(str(crs.name), (authority, int(code)) if code.isdecimal() else None, str(wkt))


def horizontal_wkt(text: str) -> str | None:
    """Return the system of x and y as WKT that most programs read; None if it is unknown or geocentric.

    The result is the first of ESRI's WKT 1, GDAL's WKT 1, and WKT 2 that defines the same system.
    """
    crs = parse_crs(text)
    crs = None if crs is None else horizontal_crs(crs)
    if crs is None or crs.is_geocentric:
        return None
    from pyproj import CRS
    from pyproj.exceptions import CRSError

    for version in ("WKT1_ESRI", "WKT1_GDAL"):
        with suppress(CRSError):  # the dialect has no name for the method or the datum
            wkt = str(crs.to_wkt(version))
            if CRS.from_wkt(wkt).equals(crs, ignore_axis_order=True):
                return wkt
    return str(crs.to_wkt("WKT2_2019"))


def wkt2(text: str) -> str:
    """Return a known CRS as WKT 2.

    Raises:
        InputError: pyproj does not know the CRS.
        MissingExtra: pyproj is not installed.
    """
    return str(known_crs(text).to_wkt("WKT2_2019"))


def to_wgs84(text: str, positions: FloatArray) -> FloatArray | None:
    """Return longitude and latitude (N, 2) of positions (N, 2) in degrees of WGS84.

    The result is None if the CRS is unknown or not on the Earth, or if a position is outside its area.
    """
    crs = parse_crs(text)
    if crs is None:
        return None
    from pyproj import Transformer
    from pyproj.exceptions import ProjError

    try:
        transformer = Transformer.from_crs(horizontal_crs(crs), "EPSG:4326", always_xy=True)
        degrees = np.stack(transformer.transform(positions[:, 0], positions[:, 1]), axis=1)
    except ProjError:
        return None
    return degrees if np.isfinite(degrees).all() else None


def euclidean_offsets(text: str, positions: FloatArray) -> FloatArray | None:
    """Return offsets (N, 3) from positions (N, 3) on a map grid to their Euclidean positions, in the map's unit.

    Earth-centred coordinates are fitted to the map coordinates by a rigid motion. The residuals are the Earth's
    curvature and the scale of the projection. Heights are taken as ellipsoidal. The result is None if the CRS is
    unknown or not projected.
    """
    crs = parse_crs(text)
    if crs is None:
        return None
    crs = horizontal_crs(crs)
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


def horizontal_crs(crs: Any) -> Any:
    """Return the `pyproj.CRS` of x and y: the first part of a compound CRS, or the CRS itself."""
    return crs.sub_crs_list[0] if crs.sub_crs_list else crs


def without_heights(text: str) -> str:
    """Return the text of the CRS of x and y of a CRS; the text itself if pyproj does not know it."""
    crs = parse_crs(text)
    if crs is None or len(crs.axis_info) < 3 or crs.is_geocentric or horizontal_crs(crs).is_engineering:
        return text
    plane = horizontal_crs(crs).to_2d()
    return _code(plane) or str(plane.to_wkt())


def with_ellipsoidal_heights(text: str) -> str:
    """Return the text of a known CRS with heights above its ellipsoid: codes such as EPSG:32617+4979, or WKT."""
    from pyproj import CRS

    crs = known_crs(text).to_3d()
    code = _code(crs)
    return code if code is not None and CRS(code) == crs else str(crs.to_wkt())


def _code(crs: Any) -> str | None:
    """Return the authority code of a CRS, or those of its parts, such as EPSG:32617+5703; None if one has none."""
    if authority := crs.to_authority(min_confidence=100):
        return ":".join(authority)
    if crs.is_projected and len(crs.axis_info) == 3 and not crs.sub_crs_list:  # with ellipsoidal heights
        parts = [crs.to_2d(), crs.geodetic_crs.to_3d()]
    elif not (parts := crs.sub_crs_list):
        return None
    codes = [part.to_epsg(min_confidence=100) for part in parts]
    return f"EPSG:{'+'.join(map(str, codes))}" if all(codes) else None


def known_crs(text: str) -> Any:
    """Return the `pyproj.CRS` of a text.

    Raises:
        InputError: pyproj does not know it.
        MissingExtra: pyproj is not installed.
    """
    require("pyproj")
    crs = parse_crs(text)
    if crs is None:
        raise InputError(f"expected a coordinate system that pyproj knows, such as EPSG:32617, got {text[:60]!r}")
    return crs


def parse_crs(text: str) -> Any | None:
    """Return the `pyproj.CRS` of a text; None if pyproj is not installed or does not know it."""
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
