"""The maps of a measured change: GeoTIFF of the cells, polygons of parts and zones, and cells as points."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pcbench.errors import InputError, MissingExtra
from pcbench.geometry.cloud import Cloud
from pcbench.geometry.crs import is_known_crs
from pcbench.io import write_cloud
from pcbench.io.geojson import write_geojson
from pcbench.io.geopackage import write_geopackage
from pcbench.io.geotiff import BandText, Raster, write_geotiff
from pcbench.io.vector import Feature, VectorLayer, line_along, point_at, polygon_within, polygons_together
from pcbench.measure.dem.difference import DemOfDifference
from pcbench.measure.dem.outlines import outlines_of
from pcbench.measure.dem.result import AreaHistory, EpochChange
from pcbench.measure.dem.series import HeightTrend
from pcbench.measure.dem.volumes import AreaChange
from pcbench.report.change.words import peak

MAPS = "maps"
GEOPACKAGE = "change.gpkg"
NO_UNIT = "1"
"""Unit of bands that are numbers: GDAL gives a band without one the unit of the heights."""
TREND_NAME = "trend"
"""Name of the map of the trend, which no epoch may have."""
TREND = f"{TREND_NAME}.tif"


def difference_file(epoch: str) -> str:
    """Return the name of the GeoTIFF of the change to an epoch, relative to the folder."""
    return f"{MAPS}/{epoch}.tif"


def write_maps(folder: Path, history: AreaHistory) -> None:
    """Write all maps of a change into its folder."""
    (folder / MAPS).mkdir()
    for change in history.changes:
        path = folder / difference_file(change.epoch.name)
        write_geotiff(path, _difference_raster(change.difference, history))
        _write_cells(path.with_suffix(".laz"), change.difference, history)
    if history.trend is not None:
        write_geotiff(folder / MAPS / TREND, _trend_raster(history.trend, history))
    features = {
        "parts": [feature for change in history.changes for feature in _part_features(change, history)],
        "zones": [feature for change in history.changes for feature in _zone_features(change, history)],
        "profiles": list(_profile_features(history)),
        "places": list(_place_features(history)),
    }
    layers = [VectorLayer(name, each, history.crs) for name, each in features.items() if each or name == "parts"]
    write_geopackage(folder / GEOPACKAGE, layers)
    for layer in layers:
        write_geojson(folder / f"{layer.name}.geojson", layer)


def _difference_raster(difference: DemOfDifference, history: AreaHistory) -> Raster:
    unit = history.unit
    with np.errstate(invalid="ignore"):
        bands: dict[str, tuple[NDArray[Any], BandText]] = {
            "dz": (difference.dz, BandText("Later height less earlier height; positive: raised.", unit)),
            "sigma": (difference.sigma, BandText("Standard deviation of dz from all errors.", unit)),
            "lod": (
                difference.level_of_detection,
                BandText("Level of detection: 95 % of cells without change stay below these 1.96 sigma.", unit),
            ),
            "significance": (
                difference.dz / difference.sigma,
                BandText("dz over sigma; beyond 1.96 or -1.96, dz exceeds the level of detection.", NO_UNIT),
            ),
            "count_before": (
                difference.before.counts,
                BandText("Points of the earlier epoch in the cell.", NO_UNIT),
            ),
            "count_after": (
                difference.after.counts,
                BandText("Points of the later epoch in the cell.", NO_UNIT),
            ),
            "filled": (
                difference.filled,
                BandText("1 where dz is from the cells around, else 0.", NO_UNIT),
            ),
            "part": (
                difference.parts,
                BandText("Number of the changed part, 1 for the largest; 0 outside of parts.", NO_UNIT, "max"),
            ),
            "height_after": (difference.after.heights, BandText("Height of the later epoch.", unit)),
        }
    return _raster(bands, history)


def _trend_raster(trend: HeightTrend, history: AreaHistory) -> Raster:
    per = "year" if trend.is_per_year else "epoch"
    unit = f"{history.unit or 'unit'}/{per}"
    bands = {
        "rate": (trend.rate, BandText(f"Slope of the line through the heights per {per}; positive: rising.", unit)),
        "sigma": (trend.sigma, BandText("Standard error of the rate.", unit)),
    }
    return _raster(bands, history)


def _raster(bands: Mapping[str, tuple[NDArray[Any], BandText]], history: AreaHistory) -> Raster:
    grid = history.grid
    return Raster(
        {name: values for name, (values, _) in bands.items()},
        grid.west,
        grid.north,
        grid.cell,
        history.crs,
        {name: text for name, (_, text) in bands.items()},
    )


def _write_cells(path: Path, difference: DemOfDifference, history: AreaHistory) -> None:
    """Write the centres of the cells at the later height, with dz, its standard deviation and level of detection."""
    heights = difference.after.heights.ravel()
    rows = np.flatnonzero(np.isfinite(heights) & difference.measured.ravel())
    grid = history.grid
    down, right = np.divmod(rows, grid.shape[1])
    points = np.column_stack([grid.columns_x[right], grid.rows_y[down], heights[rows]])
    scalars = {"dz": difference.dz, "sigma": difference.sigma, "lod": difference.level_of_detection}
    attributes = {name: values.ravel()[rows].astype(np.float32) for name, values in scalars.items()}
    cloud = Cloud(points, attributes=attributes, crs=history.crs, unit=history.unit)
    if not is_known_crs(cloud.crs):  # LAS needs a coordinate system with a known definition, not just a name
        cloud = replace(cloud, crs=None, unit=None)
    # Without the extra, or with coordinates that 32 bits cannot store, the GeoTIFF has the same values.
    with suppress(InputError, MissingExtra):
        write_cloud(path, cloud, on_warning=lambda _: None)


def _part_features(change: EpochChange, history: AreaHistory) -> Iterator[Feature]:
    for number, part in enumerate(change.parts, 1):
        outlines = outlines_of(change.difference.parts == number, history.grid)
        shape = polygons_together(polygon_within(each.outer, each.holes) for each in outlines)
        yield Feature(shape, {"part": number, "epoch": change.epoch.name, **_properties(part, history.unit)})


def _zone_features(change: EpochChange, history: AreaHistory) -> Iterator[Feature]:
    """Yield the cells of the zones, which the volumes are those of."""
    for (name, mask), zone in zip(history.zones.items(), change.zones, strict=True):
        shape = polygons_together(polygon_within(each.outer, each.holes) for each in outlines_of(mask, history.grid))
        yield Feature(shape, {"zone": name, "epoch": change.epoch.name, **_properties(zone, history.unit)})


def _profile_features(history: AreaHistory) -> Iterator[Feature]:
    for number, profile in enumerate(history.profiles, 1):
        yield Feature(line_along(np.reshape(profile.line, (2, 2))), {"profile": f"P{number}"})


def _place_features(history: AreaHistory) -> Iterator[Feature]:
    for place in history.places:
        for change, (dz, low, high) in zip(history.changes, place.changes, strict=True):
            values = {"epoch": change.epoch.name, "dz": dz, "dz_low": low, "dz_high": high, "unit": history.unit}
            yield Feature(point_at(np.array(place.place)), values)


def _properties(area: AreaChange, unit: str | None) -> dict[str, float | str | None]:
    """Return the values of an area as properties, with the unit of lengths, of which volumes have the cube."""
    volumes = {"net": area.volumes.net, "fill": area.volumes.fill, "cut": area.volumes.cut, "mean": area.mean}
    values = {
        f"{name}{end}": number
        for name, value in volumes.items()
        for end, number in zip(("", "_low", "_high"), value, strict=True)
    }
    return {**values, "area": area.area, "peak": peak(area), "below_lod": area.undetected_share, "unit": unit}
