"""The layers of a change that pictures draw: read from the folder, and thinned to the size of a picture."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from pcbench.geometry.arrays import FloatArray
from pcbench.io.geotiff import halved, read_geotiff
from pcbench.io.json_values import from_json
from pcbench.measure.dem.difference import LEVEL_Z
from pcbench.regular_files import read_json
from pcbench.report.change.document import DOCUMENT, ChangeDocument
from pcbench.report.change.maps import MAPS, TREND, difference_file
from pcbench.report.colors import Range, robust_maximum

_MOST_PIXELS = 1600  # along an edge of a drawn raster
_SUN_AZIMUTH_DEG, _SUN_HEIGHT_DEG = 315.0, 45.0
_RELIEF = 0.35  # mean absolute slope of a shaded surface after it is exaggerated


@dataclass(frozen=True, eq=False)
class PlanLayers:
    """Rasters of a change in one size.

    Attributes:
        dz: (H, W) change of height; NaN in voids.
        sigma: (H, W) its standard deviation.
        significant: (H, W) whether it exceeds the level of detection.
        parts: (H, W) numbers of the changed parts, 0 outside.
        shade: (H, W) brightness of the later surface from 0 to 1 in the light from the north-west; 1 in voids.
        west, east, south, north: borders.
        pixel: edge of a pixel.
    """

    dz: FloatArray
    sigma: FloatArray
    significant: NDArray[np.bool_]
    parts: FloatArray
    shade: FloatArray
    west: float
    east: float
    south: float
    north: float
    pixel: float

    @property
    def extent(self) -> tuple[float, float, float, float]:
        """Borders in matplotlib's order."""
        return self.west, self.east, self.south, self.north


def read_document(folder: Path) -> ChangeDocument:
    """Read the document of a folder.

    Raises:
        InputError, OSError, KeyError, TypeError, ValueError: it is missing or damaged.
    """
    return from_json(ChangeDocument, read_json(folder / DOCUMENT))


def read_layers(folder: Path, epoch: str) -> PlanLayers:
    """Read the layers of the change to an epoch, thinned so that they fit into a picture."""
    raster = read_geotiff(folder / difference_file(epoch))
    names = ("dz", "sigma", "significance", "part", "height_after")
    dz, sigma, scores, parts, heights = (raster.bands[name].astype(float) for name in names)
    pixel, rows, columns = raster.pixel, *dz.shape
    while max(dz.shape) > _MOST_PIXELS:
        dz, sigma, scores, heights = (_half_size(each) for each in (dz, sigma, scores, heights))
        parts, pixel = halved(parts, "max").astype(float), 2 * pixel
    return PlanLayers(
        dz=dz,
        sigma=sigma,
        significant=np.abs(np.nan_to_num(scores)) > LEVEL_Z,
        parts=np.nan_to_num(parts),
        shade=hillshade(heights, pixel),
        west=raster.west,
        east=raster.west + columns * raster.pixel,
        south=raster.north - rows * raster.pixel,
        north=raster.north,
        pixel=pixel,
    )


def trend_layers(folder: Path) -> PlanLayers:
    """Read the trend of the cells as a change: rates beyond 1.96 standard errors are significant."""
    raster = read_geotiff(folder / MAPS / TREND)
    rate, sigma = (raster.bands[name].astype(float) for name in ("rate", "sigma"))
    pixel = raster.pixel
    rows, columns = rate.shape
    while max(rate.shape) > _MOST_PIXELS:
        rate, sigma, pixel = _half_size(rate), _half_size(sigma), 2 * pixel
    with np.errstate(invalid="ignore", divide="ignore"):
        significant = np.abs(np.nan_to_num(rate / sigma)) > LEVEL_Z
    return PlanLayers(
        dz=rate,
        sigma=sigma,
        significant=significant,
        parts=np.zeros(rate.shape),
        shade=np.where(np.isfinite(rate), 0.5, 1.0),
        west=raster.west,
        east=raster.west + columns * raster.pixel,
        south=raster.north - rows * raster.pixel,
        north=raster.north,
        pixel=pixel,
    )


def _half_size(values: FloatArray) -> FloatArray:
    return halved(values, "mean").astype(float)


def hillshade(heights: FloatArray, pixel: float) -> FloatArray:
    """Return the brightness (H, W) from 0 to 1 of a surface that is lit from the north-west; flat terrain is 0.5.

    The slopes are exaggerated so that both flat and steep terrain show their relief.
    """
    measured = np.isfinite(heights)
    if not measured.any():
        return np.ones(heights.shape)
    values = np.where(measured, heights, np.median(heights[measured])).astype(float)
    south, east = (np.gradient(values, pixel, axis=axis) if values.shape[axis] > 1 else 0 * values for axis in (0, 1))
    inner = measured.copy()
    for axis in (0, 1):
        inner &= np.roll(measured, 1, axis) & np.roll(measured, -1, axis)
    typical = float(np.mean(np.hypot(south, east)[inner])) if inner.any() else 0.0
    scale = _RELIEF / typical if typical > 0 else 1.0
    azimuth, height = np.radians(_SUN_AZIMUTH_DEG), np.radians(_SUN_HEIGHT_DEG)
    towards = np.sin(azimuth) * np.cos(height), np.cos(azimuth) * np.cos(height), np.sin(height)  # east, north, up
    lit = (-scale * east * towards[0] + scale * south * towards[1] + towards[2]) / np.sqrt(
        1 + (scale * south) ** 2 + (scale * east) ** 2
    )
    return np.where(inner, np.clip(0.5 + 0.75 * (lit - towards[2]), 0.0, 1.0), np.where(measured, 0.5, 1.0))


def change_range(layers: PlanLayers, end: float | None) -> Range:
    """Return the colour range of changes: to the 95th percentile of the significant ones, or to a given end."""
    if end is not None:
        return Range(-end, end, "range set by the user", signed=True)
    values = layers.dz[layers.significant]
    if not len(values):
        values = layers.dz[np.isfinite(layers.dz)]
    high = robust_maximum(values) or 1.0
    return Range(-high, high, "95th percentile beyond the level of detection", signed=True)
