"""Parse regions as they are written on the command line."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np

from pcbench.errors import InputError, did_you_mean
from pcbench.geometry.cloud import Cloud
from pcbench.geometry.crs import epsg_codes
from pcbench.geometry.polygon_files import as_finite_number, read_polygon, shorten, stated_epsg
from pcbench.geometry.regions import Box, Region, Sphere

_KINDS = ("none", "box", "sphere", "polygon", "reference", "quantile")
_POLYGON_EXTENSIONS = (".json", ".geojson", ".wkt")


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
        InputError: `region` is neither a region nor the text of one, or a file states another coordinate system than
            that of the reference.
    """
    if reference.crs is not None and (file := region_file(region)) is not None:
        _check_system(file, reference.crs)
    if isinstance(region, str):
        return parse_region(region, reference)
    if not isinstance(region, Region):
        raise InputError(
            "expected a region, such as pcbench.Box(lower, upper), or its text, such as 'box:0,0,0,1,1,1', got"
            f" {type(region).__name__}"
        )
    return region


def _check_system(file: Path, crs: str) -> None:
    """Raise InputError if a file of polygons states another horizontal coordinate system than that of the cloud."""
    try:
        stated = stated_epsg(file)
    except (InputError, OSError):  # its reader says so
        return
    codes = None if stated is None else epsg_codes(crs)
    if codes is not None and codes.horizontal != stated:
        raise InputError(
            f"{file}: expected a polygon in EPSG:{codes.horizontal} as the cloud, got EPSG:{stated}: transform it with"
            f" ogr2ogr -t_srs EPSG:{codes.horizontal}, or in a GIS"
        )


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
