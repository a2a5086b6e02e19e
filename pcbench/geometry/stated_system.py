"""State or convert the units of a cloud, and state its coordinate system."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np

from pcbench.errors import InputError
from pcbench.extras import require
from pcbench.geometry.area import area_warning
from pcbench.geometry.arrays import bounds
from pcbench.geometry.cloud import Cloud
from pcbench.geometry.crs import (
    axis_lengths,
    axis_units,
    crs_name,
    horizontal_crs,
    is_geographic_crs,
    is_in_degrees,
    known_crs,
    same_crs,
    single_unit,
    unnamed_grid,
    with_units,
    without_heights,
)
from pcbench.geometry.transform import Affine
from pcbench.geometry.units import metres, unit_of_length

Warn = Callable[[str], None]
_MAX_ROUNDING_SHARE = 1e-6  # of the extent, up to which the rounding of shifted coordinates is not worth a warning


def state_crs(cloud: Cloud, crs: str, warn: Warn) -> Cloud:
    """Return a cloud with the same coordinates in another CRS than its file states, and with the unit of this CRS.

    Args:
        cloud: the cloud.
        crs: its CRS, such as "EPSG:32617", "EPSG:32617+5703" with heights, or "EPSG:32617+4979" with ellipsoidal ones.
        warn: called with one line if the file states another system or unit, or if the cloud lies outside the area of
            use of the system.

    Raises:
        InputError: pyproj does not know the CRS, it has no x and y, or the coordinates are no longitudes and latitudes.
        MissingExtra: pyproj is not installed.
    """
    system = horizontal_crs(known_crs(crs))
    if not (system.is_projected or system.is_geographic or system.is_geocentric or system.is_engineering):
        raise InputError(
            f"expected a coordinate system with x and y, such as EPSG:32617+5703, got {crs_name(crs)}: put the"
            " system of x and y before it"
        )
    if is_geographic_crs(crs):
        _check_degrees(cloud, crs)
    unit = single_unit(crs, warn)
    if cloud.crs is not None and not _is_refined(cloud.crs, crs):
        warn(f"the file states {crs_name(cloud.crs)}, which {crs_name(crs)} replaces; coordinates stay as they are")
    elif cloud.crs is None and unit is not None and not _is_same_unit(cloud.unit, unit):
        warn(f"the file states coordinates in {cloud.unit}, which {unit} of {crs_name(crs)} replaces")
    if line := area_warning(crs, cloud.points):
        warn(line)
    return replace(cloud, crs=crs, unit=unit)


def state_unit(cloud: Cloud, unit: str | None, z_unit: str | None, warn: Warn) -> Cloud:
    """Return a cloud with the same coordinates in other units than its file states, and with its CRS in these units.

    Args:
        cloud: the cloud.
        unit: unit of x and y, and of z without `z_unit`; None: as the file states.
        z_unit: unit of z.
        warn: called with one line if the file states other units.

    Raises:
        InputError: a unit is no length, x and y are degrees, or their unit is unknown.
        MissingExtra: the cloud has a CRS, and pyproj is not installed.
    """
    if cloud.crs is not None:
        require("pyproj")
    units = axis_units(cloud.crs)
    before = cloud.unit if units is None else units.horizontal
    before_z = (None if units is None else units.height) or (before if before is None or metres(before) else None)
    in_degrees = is_in_degrees(cloud.crs, cloud.unit)
    if unit is not None and in_degrees:
        raise InputError(
            f"expected a cloud whose x and y are lengths, got degrees ({crs_name(cloud.crs or 'deg')}): state its"
            " system with --crs, or the unit of its heights alone with --z-unit"
        )
    horizontal = before if unit is None else _length_name(unit)
    height = before_z if z_unit is None and unit is None else _length_name(z_unit or unit or "")
    if horizontal is None:
        raise InputError("expected the unit of x and y besides that of z, got none: state it with --unit, such as m")
    changes = [("x and y", before, horizontal), ("z", before_z, height)]
    if (before, horizontal) == (before_z, height):
        changes = [("x, y and z", before, horizontal)]
    replaced = [f"{axes} in {old} (now {new})" for axes, old, new in changes if not _is_same_unit(old, new)]
    if replaced:
        warn(f"replaced what was stated: {' and '.join(replaced)}; coordinates stay as they are")
    if units is None:  # without a CRS, or with one that pyproj does not know
        if height is None or _is_same_unit(height, horizontal):
            return replace(cloud, unit=horizontal)
        if cloud.crs is not None or in_degrees:
            raise InputError("expected a coordinate system that pyproj knows, got another: state it with --crs")
        return replace(cloud, crs=unnamed_grid(horizontal, height), unit=None)
    assert cloud.crs is not None
    if known_crs(cloud.crs).is_geocentric and not _is_same_unit(height, horizontal):
        raise InputError("expected one unit for geocentric x, y and z, got two: leave out --z-unit")
    has_heights = units.height is not None or z_unit is not None
    crs = with_units(cloud.crs, horizontal, height if has_heights else None)
    return replace(cloud, crs=crs, unit=single_unit(crs, warn))


def convert_unit(cloud: Cloud, unit: str) -> Cloud:
    """Return a cloud with x, y and z in a unit of length, such as "m", and its CRS with this unit.

    Args:
        cloud: a cloud whose unit is known, or whose CRS states it; z may have another unit than x and y.
        unit: the new unit.

    Raises:
        InputError: a unit is unknown or no length.
        MissingExtra: the cloud has a CRS, and pyproj is not installed.
    """
    unit = _length_name(unit)
    new = metres(unit)
    assert new is not None
    if cloud.crs is not None:
        require("pyproj")
    if is_in_degrees(cloud.crs, cloud.unit):
        raise InputError(
            f"expected lengths, got degrees, which have no length in {unit}: add --to-crs, such as --to-crs EPSG:32617"
        )
    length = metres(cloud.unit)
    lengths = axis_lengths(cloud.crs) if length is None else (length, length)
    if lengths is None:
        raise InputError(
            f"expected a cloud whose unit is known, got {cloud.unit or 'none'}: state it with --unit, such as --unit ft"
        )
    horizontal, height = (length / new for length in lengths)
    crs, units = cloud.crs, axis_units(cloud.crs)
    if crs is not None and units is not None:
        crs = with_units(crs, unit, unit if units.height else None)
    moved = cloud.transformed(Affine(np.diag([horizontal, horizontal, height]), np.zeros(3)))
    return replace(moved, crs=crs, unit=unit)


def scale_coordinates(cloud: Cloud, factor: float, warn: Warn) -> Cloud:
    """Return a cloud whose coordinates are multiplied by a factor, about the origin, without CRS and unit.

    Args:
        cloud: the cloud.
        factor: the positive factor.
        warn: called with one line if the file states a CRS or a unit, in which the new coordinates are not.

    Raises:
        InputError: coordinates overflow.
    """
    if not math.isfinite(float(np.abs(cloud.points).max(initial=0.0)) * factor):
        raise InputError(f"expected a factor with which coordinates stay finite, got {factor:g}")
    if cloud.crs is not None or cloud.unit is not None:
        stated = f"the system {crs_name(cloud.crs)}" if cloud.crs is not None else f"the unit {cloud.unit}"
        warn(f"left out {stated}, which the file states and scaled coordinates are not in")
    scaled = cloud.transformed(Affine(np.eye(3) * factor, np.zeros(3)))
    return replace(scaled, crs=None, unit=None)


def shift_coordinates(cloud: Cloud, offset: Sequence[float], warn: Warn) -> Cloud:
    """Return a cloud with an offset added to its coordinates, without CRS; its unit and attributes stay.

    Args:
        cloud: the cloud.
        offset: numbers to add to x, y and z.
        warn: called with one line if the file states a CRS, in which the new coordinates are not, and if they are so
            large that rounding shows.

    Raises:
        InputError: these are not three finite numbers.
    """
    if len(offset) != 3 or not np.isfinite(offset).all():
        raise InputError(f"expected a shift of three finite numbers, got {', '.join(f'{x:g}' for x in offset)}")
    if cloud.crs is not None:
        warn(f"left out the system {crs_name(cloud.crs)}, which the file states and shifted coordinates are not in")
    shifted = replace(cloud, points=cloud.points + np.asarray(offset), crs=None)
    rounding = float(np.spacing(np.abs(shifted.points).max(initial=0.0)))
    low, high = cloud.bounds
    extent = float((high - low).max())
    if 0 < _MAX_ROUNDING_SHARE * extent < rounding:
        warn(f"shifted coordinates are so large that they are rounded to {rounding:.2g}: check the shift")
    return shifted


def _check_degrees(cloud: Cloud, crs: str) -> None:
    (west, south, _), (east, north, _) = bounds(cloud.points)
    units = axis_units(crs)
    is_degree = units is not None and units.horizontal == "deg"
    if is_degree and (max(abs(west), abs(east)) > 360 or max(abs(south), abs(north)) > 90):
        raise InputError(
            f"expected longitudes as x and latitudes as y in degrees, as in {crs_name(crs)}, got x from {west:.8g} to"
            f" {east:.8g} and y from {south:.8g} to {north:.8g}: state the system of the file"
        )


def _is_refined(file: str, crs: str) -> bool:
    """Return whether a CRS is that of a file, or adds heights to it."""
    return same_crs(file, crs) or same_crs(file, without_heights(crs))


def _is_same_unit(first: str | None, second: str | None) -> bool:
    lengths = metres(first), metres(second)
    return None in (first, second) or first == second or (None not in lengths and lengths[0] == lengths[1])


def _length_name(unit: str) -> str:
    """Return the short name of a unit of length.

    Raises:
        InputError: it is unknown or no length.
    """
    length = metres(unit)
    if length is None:
        raise InputError(f"expected a unit of length such as m, ft, US-ft or mm, got {unit[:20]!r}")
    return unit_of_length(length) or unit
