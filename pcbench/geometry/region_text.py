"""Parse regions as they are written on the command line."""

from __future__ import annotations

import math
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from pcbench.errors import InputError, did_you_mean
from pcbench.geometry.arrays import FloatArray
from pcbench.geometry.cloud import Cloud
from pcbench.geometry.crs import epsg_codes
from pcbench.geometry.polygon_files import as_finite_number, read_polygon, shorten, stated_epsg
from pcbench.geometry.regions import AXES, Box, Polygon, Region, Sphere, Union

_KINDS = ("none", "box", "sphere", "polygon", "reference", "quantile")
_POLYGON_EXTENSIONS = (".json", ".geojson", ".wkt")
_DEGREES = np.array([180.0, 90.0])  # largest longitude and latitude
_MAX_SITE_DEGREES = 1.0  # extent of polygons of a site; wider ones may as well be lengths near the origin


def parse_region(text: str, reference: Cloud) -> Region | None:
    """Parse a region in the reference's coordinates and unit; return None for "none".

    The forms are:
        none
        box:xmin,ymin,zmin,xmax,ymax,zmax
        sphere:x,y,z,r
        polygon:FILE        GeoJSON, WKT, or a selection volume of Open3D and Tanks and Temples
        reference           bounding box of the reference
        quantile:0.99       sphere about the reference's centre that contains this share of its points

    Raises:
        InputError: the text or the file has none of these forms.
    """
    kind, colon, rest = text.strip().partition(":")
    kind, rest = kind.strip().lower(), rest.strip()
    if kind in ("none", "reference"):
        if colon:
            raise InputError(f"region {text!r}: expected {kind!r} alone, without values")
        return None if kind == "none" else Box.around(reference)
    if kind == "polygon":
        if not rest:
            raise InputError(f"region {text!r}: expected polygon:FILE, got no file name")
        return read_polygon(rest)
    try:
        match kind:
            case "box":
                values = _parse_numbers(rest, "xmin,ymin,zmin,xmax,ymax,zmax")
                return Box(np.array(values[:3]), np.array(values[3:]))
            case "sphere":
                values = _parse_numbers(rest, "x,y,z,r")
                return Sphere(np.array(values[:3]), values[3])
            case "quantile":
                return Sphere.around(reference, *_parse_numbers(rest, "q"))
    except InputError as error:
        raise InputError(f"region {text!r}: {error}") from error
    if _is_file(text.strip()):
        raise InputError(f"region {text!r}: expected polygon:FILE, got a file alone: write polygon:{text.strip()}")
    raise InputError(
        f"region {text!r}: expected none, box:xmin,ymin,zmin,xmax,ymax,zmax, sphere:x,y,z,r, polygon:FILE,"
        f" reference or quantile:q{did_you_mean(kind, _KINDS)}"
    )


def _is_file(text: str) -> bool:
    """Return whether a text names a file, or would by its extension."""
    try:
        return Path(text).suffix.lower() in _POLYGON_EXTENSIONS or Path(text).is_file()
    except OSError:  # too long for a name
        return False


def as_region(region: Region | str, reference: Cloud) -> Region | None:
    """Return a region itself, or the region that a text describes; see `parse_region`.

    Raises:
        InputError: `region` is neither a region nor the text of one, or a file of polygons is in another coordinate
            system than the reference, see `check_polygon_system`.
    """
    if isinstance(region, str):
        parsed = parse_region(region, reference)
    elif isinstance(region, Region):
        parsed = region
    else:
        raise InputError(
            "expected a region, such as pcbench.Box(lower, upper), or its text, such as 'box:0,0,0,1,1,1', got"
            f" {type(region).__name__}"
        )
    if parsed is not None and (file := region_file(parsed)) is not None:
        check_polygon_system(file, parsed, reference.crs, *reference.bounds)
    return parsed


def check_polygon_system(file: Path, region: Region, crs: str | None, low: FloatArray, high: FloatArray) -> None:
    """Check that polygons are in the coordinate system of a cloud, as far as their file and their numbers tell.

    Args:
        file: their file, for the message and for the system that it states.
        region: the polygons.
        crs: coordinate system of the cloud, if known.
        low: smallest coordinates (3,) of the cloud.
        high: largest coordinates (3,) of the cloud.

    Raises:
        InputError: the file states another horizontal system, or the polygons look like longitudes and latitudes, and
            the cloud has none.
    """
    codes = None if crs is None else epsg_codes(crs)
    try:
        stated = stated_epsg(file)
    except (InputError, OSError):  # the file was removed after it was read
        stated = None
    source = ""
    if codes is not None and stated not in (None, codes.horizontal):
        came = f"EPSG:{stated}"
    elif (extent := _degrees_text(region, low, high)) is not None:
        came = f"what look like longitudes and latitudes ({extent})"
        source = " -s_srs EPSG:4326" if stated is None else ""
    else:
        return
    expected, remedy = f"the coordinates of the cloud ({_extent_text(low, high)})", "transform it in a GIS"
    if codes is not None:
        expected = f"EPSG:{codes.horizontal} as the cloud"
        remedy = f"transform it with ogr2ogr{source} -t_srs EPSG:{codes.horizontal}, or in a GIS"
    raise InputError(f"{file}: expected a polygon in {expected}, got {came}: {remedy}")


def _degrees_text(region: Region, low: FloatArray, high: FloatArray) -> str | None:
    """Return the extent of polygons that look like longitudes and latitudes beside a cloud that has none, else None."""
    rings = list(_rings_in_plan(region))
    if not rings:
        return None
    vertices = np.vstack(rings)
    first, last = vertices.min(axis=0), vertices.max(axis=0)
    are_degrees = (np.abs(vertices) <= _DEGREES).all() and (last - first).max() <= _MAX_SITE_DEGREES
    is_cloud_elsewhere = (low[:2] > _DEGREES).any() or (high[:2] < -_DEGREES).any()
    return _extent_text(first, last) if are_degrees and is_cloud_elsewhere else None


def _rings_in_plan(region: Region) -> Iterator[FloatArray]:
    """Yield the rings (M, 2) of polygons in x and y."""
    if isinstance(region, Union):
        for part in region.regions:
            yield from _rings_in_plan(part)
    elif isinstance(region, Polygon) and AXES[region.axis] == "z":
        yield from region.rings


def _extent_text(low: FloatArray, high: FloatArray) -> str:
    return f"x {low[0]:,.7g} to {high[0]:,.7g}, y {low[1]:,.7g} to {high[1]:,.7g}"


def region_file(region: Region | str) -> Path | None:
    """Return the file that a text names, or from which a region was read; None for other regions."""
    if not isinstance(region, str):
        file: Path | None = getattr(region, "file", None)
        return file
    kind, _, rest = region.partition(":")
    return Path(rest.strip()) if rest.strip() and kind.strip().lower() == "polygon" else None


def _parse_numbers(text: str, names: str) -> list[float]:
    words = text.split(",") if text else []
    if len(words) != (count := names.count(",") + 1):
        raise InputError(f"expected {count} number{'s' * (count > 1)} ({names}), got {len(words)}")
    values = []
    for word in words:
        try:
            value = float(word)
        except ValueError:
            value = math.nan
        if not math.isfinite(value):
            raise InputError(f"expected finite numbers ({names}), got {shorten(word.strip())}")
        values.append(as_finite_number(names, value))
    return values
