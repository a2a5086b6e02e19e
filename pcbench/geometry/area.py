"""Area on Earth that a cloud covers, and whether a coordinate system is made for it."""

from __future__ import annotations

import warnings
from typing import Any

import numpy as np

from pcbench.geometry.arrays import FloatArray
from pcbench.geometry.crs import crs_name, horizontal_crs, known_crs

_MARGIN_DEG = 1.0  # beyond the area of use, as maps at the border of a zone extend


def covered_area(crs: str, points: FloatArray) -> tuple[float, float, float, float] | None:
    """Return west, south, east and north of points (N, 3) in degrees of WGS 84; None if they have no place on Earth.

    Raises:
        InputError: pyproj does not know the CRS.
        MissingExtra: pyproj is not installed.
    """
    system = horizontal_crs(known_crs(crs))
    if system.is_engineering:
        return None
    from pyproj import Transformer

    corners = points if system.is_geocentric else _along_box(points.min(axis=0), points.max(axis=0))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of pyproj: metres do not matter here
        transformer = Transformer.from_crs(system, "EPSG:4326", always_xy=True)
    longitudes, latitudes, *_ = transformer.transform(*corners.T)
    with np.errstate(invalid="ignore"):
        is_on_earth = np.isfinite(longitudes) & (np.abs(latitudes) <= 90) & (np.abs(longitudes) <= 360)
    if not is_on_earth.any():
        return None
    east, north = (longitudes[is_on_earth] + 180) % 360 - 180, latitudes[is_on_earth]
    return float(east.min()), float(north.min()), float(east.max()), float(north.max())


def area_warning(crs: str, points: FloatArray) -> str | None:
    """Return a warning if points (N, 3) in a CRS lie outside its area of use: perhaps they are in another one."""
    use, covered = horizontal_crs(known_crs(crs)).area_of_use, covered_area(crs, points)
    if use is None:
        return None
    name = (
        f"{crs_name(crs)} is made for {use.west:g} to {use.east:g} degrees east, {use.south:g} to {use.north:g} north"
    )
    if covered is None:
        return f"{name}, and the cloud has no place on Earth in it: is it in another system?"
    west, south, east, north = covered
    is_beyond_latitudes = north < use.south - _MARGIN_DEG or south > use.north + _MARGIN_DEG
    if not is_beyond_latitudes and _overlap_longitudes(west, east, use.west, use.east):
        return None
    centre = f"{(west + east) / 2:.4g} degrees east, {(south + north) / 2:.4g} north"
    return f"{name}, and the centre of the cloud is at {centre}: is it in another system?"


def _overlap_longitudes(west: float, east: float, use_west: float, use_east: float) -> bool:
    """Return whether two ranges of longitude overlap; an area of use may cross the meridian of 180 degrees."""
    use_east += 360 if use_east < use_west else 0
    return any(
        west + turn <= use_east + _MARGIN_DEG and east + turn >= use_west - _MARGIN_DEG for turn in (-360, 0, 360)
    )


def _along_box(low: FloatArray, high: FloatArray) -> Any:
    """Return corners, middles and centre (9, 3) of the box of a cloud, at its mean height."""
    steps = np.stack(np.meshgrid((0.0, 0.5, 1.0), (0.0, 0.5, 1.0)), axis=-1).reshape(-1, 2)
    inside = low[:2] + steps * (high[:2] - low[:2])
    return np.column_stack([inside, np.full(len(inside), (low[2] + high[2]) / 2)])
