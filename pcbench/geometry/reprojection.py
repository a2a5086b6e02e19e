"""Convert a cloud to another unit or another coordinate reference system."""

from __future__ import annotations

import warnings
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np

from pcbench.errors import InputError
from pcbench.extras import require
from pcbench.geometry.cloud import Cloud
from pcbench.geometry.crs import axis_lengths, axis_units, crs_name, is_in_degrees, parse_crs, with_units
from pcbench.geometry.transform import Affine
from pcbench.geometry.units import metres


def convert_unit(cloud: Cloud, unit: str) -> Cloud:
    """Return a cloud with x, y and z in a unit of length, such as "m", and its CRS with this unit.

    Args:
        cloud: a cloud whose unit is known, or whose CRS states it; z may have another unit than x and y.
        unit: the new unit.

    Raises:
        InputError: a unit is unknown or no length.
        MissingExtra: the cloud has a CRS, and pyproj is not installed.
    """
    new = metres(unit)
    if new is None:
        raise InputError(f"expected a unit of length such as m, ft, US-ft or mm, got {unit[:20]!r}")
    if cloud.crs is not None:
        require("pyproj")
    if is_in_degrees(cloud.crs, cloud.unit):
        raise InputError(
            f"expected lengths, got degrees, which have no length in {unit}: add --crs, such as --crs EPSG:32617"
        )
    length = metres(cloud.unit)
    lengths = axis_lengths(cloud.crs) if length is None else (length, length)
    if lengths is None:
        raise InputError(
            f"expected a cloud whose unit is known, got {cloud.unit or 'none'}: state it in the file, in a .txt by a"
            " line '# unit m'"
        )
    horizontal, height = (length / new for length in lengths)
    crs, units = cloud.crs, axis_units(cloud.crs)
    if crs is not None and units is not None:
        crs = with_units(crs, unit, unit if units.height else None)
    moved = cloud.transformed(Affine(np.diag([horizontal, horizontal, height]), np.zeros(3)))
    return replace(moved, crs=crs, unit=unit)


def project(
    cloud: Cloud, target: str, source: str | None = None, on_warning: Callable[[str], None] | None = None
) -> Cloud:
    """Return a cloud in another CRS, with its attributes and colours, without normals.

    x and y are transformed. Heights keep their datum and are converted to the unit of the new CRS; geocentric
    coordinates become ellipsoidal heights.

    Args:
        cloud: the cloud.
        target: the new CRS, projected or geographic, such as "EPSG:32617".
        source: CRS of the cloud if it states none.
        on_warning: called with one line for each loss of accuracy or of normals.

    Raises:
        InputError: a CRS is unknown or does not suit, or points lie outside the area of the new one.
        MissingExtra: pyproj is not installed.
    """
    pyproj = require("pyproj")
    warn = on_warning or (lambda _: None)
    if source is not None and cloud.crs is not None:
        raise InputError(f"expected a cloud without a coordinate system, got {crs_name(cloud.crs)}: omit --from-crs")
    stated = cloud.crs or source
    if stated is None:
        raise InputError(
            "expected a cloud with a coordinate system, got none: state it with --from-crs, such as EPSG:4326"
        )
    (below, *heights), (new, *new_heights) = (_parts(text) for text in (stated, target))
    if not (new.is_projected or new.is_geographic):
        raise InputError(
            f"expected a projected or geographic coordinate system, such as EPSG:32617, got {crs_name(target)}: choose"
            " another system"
        )
    if below.is_engineering:
        raise InputError(
            "expected a coordinate system with a place on Earth, got one of which only the units are known: export the"
            " file with its system"
        )
    if new_heights and not (heights and new_heights[0].datum == heights[0].datum):
        raise InputError(
            f"expected a coordinate system without heights, got {crs_name(target)}: heights keep their datum, so name"
            " the system of x and y alone"
        )
    lengths, new_lengths, new_units = axis_lengths(stated), axis_lengths(target), axis_units(target)
    assert lengths is not None and new_lengths is not None and new_units is not None
    (_, length), (_, new_length) = lengths, new_lengths
    x, y, z = cloud.points.T
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of pyproj about grids, which are reported below
        if below.is_geocentric:
            new = new.to_3d()
        group = pyproj.transformer.TransformerGroup(below, new, always_xy=True)
        transformer = pyproj.Transformer.from_crs(below, new, always_xy=True)
    if not group.best_available:
        warn(f"the most accurate transformation to {crs_name(target)} needs a grid: install it with pyproj sync")
    if below.is_geocentric:
        x, y, z = transformer.transform(x, y, z)
        z = np.asarray(z) * (new.axis_info[2].unit_conversion_factor / new_length)
    else:
        x, y = transformer.transform(x, y)
        z = z * (length / new_length)
    points = np.stack([x, y, z], axis=1)
    if outside := int(np.count_nonzero(~np.isfinite(points).all(axis=1))):
        raise InputError(
            f"expected points in the area of {crs_name(target)}, got {outside} of {len(points)} outside of it: choose"
            " another system"
        )
    if cloud.normals is not None:
        warn("left out normals, which have other directions in the new system")
    moved = cloud.moved(points)
    crs = target
    if heights and new_units.height is None:
        crs = _with_heights(target, stated, new_units.horizontal if metres(new_units.horizontal) else "m")
    unit = axis_units(crs)
    return replace(moved, crs=crs, unit=None if unit is None or unit.are_mixed else unit.horizontal)


def _parts(text: str) -> list[Any]:
    """Return a CRS as a list, or the horizontal and the vertical CRS that it consists of.

    Raises:
        InputError: pyproj does not know it.
    """
    crs = parse_crs(text)
    if crs is None:
        raise InputError(f"expected a coordinate system that pyproj knows, such as EPSG:32617, got {text[:60]!r}")
    return crs.sub_crs_list or [crs]


def _with_heights(target: str, source: str, unit: str) -> str:
    """Return the CRS of a target with the vertical CRS of a source, in a unit; codes if both have one."""
    from pyproj import CRS

    parts = [_parts(target)[0], _parts(with_units(source, "m", unit))[1]]
    codes = [part.to_epsg(min_confidence=100) for part in parts]
    if all(codes):
        return f"EPSG:{codes[0]}+{codes[1]}"
    values = {"type": "CompoundCRS", "name": " + ".join(part.name for part in parts)}
    return str(CRS.from_json_dict(values | {"components": [part.to_json_dict() for part in parts]}).to_wkt())
