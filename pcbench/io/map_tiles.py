"""Files of deviation maps that are too large for memory: tiles of points as LAZ, and overviews as GeoTIFF."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pcbench.errors import MissingExtra
from pcbench.extras import require
from pcbench.geometry.arrays import FloatArray
from pcbench.geometry.cloud import Cloud
from pcbench.geometry.crs import is_known_crs, to_wgs84, wkt2
from pcbench.io import write_cloud
from pcbench.io.geotiff import BandText, Raster, read_geotiff, write_geotiff
from pcbench.io.las_header import read_header
from pcbench.scratch import atomic_write

_VPC_VERSION = "1.1.0"  # of STAC
_POINTS = {"distance": "the candidate's points", "completeness": "the reference's points"}
_NEAREST = {"distance": "the nearest point of the reference", "completeness": "the nearest point of the candidate"}
_SIGNED_DEFINITION = (
    "Mean signed distance of the candidate from the reference's tangent planes. Positive: the candidate is above the"
    " reference, or in front of it."
)


@dataclass(frozen=True, eq=False)
class MapOverview:
    """Distances of a map per pixel, with rows from north to south and columns from west to east.

    Attributes:
        signed: (H, W) mean signed distance along the reference's upward normals: positive where the candidate is above
            the reference, or in front of it; NaN where it is unknown for all points.
        mean: (H, W) mean distance of the points in each pixel; NaN without points.
        largest: (H, W) largest distance; NaN without points.
        count: (H, W) number of points.
        west: x of the left edge of the first column.
        north: y of the upper edge of the first row.
        pixel: edge of a pixel, in the clouds' unit.
    """

    signed: FloatArray
    mean: FloatArray
    largest: FloatArray
    count: NDArray[Any]
    west: float
    north: float
    pixel: float

    def halved(self) -> MapOverview:
        """Return the overview with pixels of twice the edge."""
        height, width = self.count.shape
        padding = [(0, height % 2), (0, width % 2)]

        def blocks(values: NDArray[Any]) -> NDArray[Any]:
            """Return the four pixels of each new one: (H, W, 4)."""
            padded = np.pad(values, padding)
            rows, columns = padded.shape
            return padded.reshape(rows // 2, 2, columns // 2, 2).swapaxes(1, 2).reshape(rows // 2, columns // 2, 4)

        counts = blocks(self.count)

        def mean(values: FloatArray) -> FloatArray:
            """Return the mean of the points in each new pixel."""
            is_known = np.isfinite(blocks(values))
            number = np.where(is_known, counts, 0).sum(axis=2)
            total = np.where(is_known, counts * blocks(values), 0).sum(axis=2)
            means: FloatArray = np.divide(total, number, out=np.full(number.shape, np.nan), where=number > 0)
            return means

        largest = np.where(counts > 0, blocks(self.largest), -np.inf).max(axis=2)
        count = counts.sum(axis=2)
        largest = np.where(count > 0, largest, np.nan)
        return MapOverview(mean(self.signed), mean(self.mean), largest, count, self.west, self.north, 2 * self.pixel)


def map_tile_extension() -> str:
    """Return the extension of map tiles: `.laz`, or `.las` if lazrs is not installed."""
    try:
        require("lazrs")
    except MissingExtra:
        return ".las"
    return ".laz"


def write_map_tile(
    path: Path,
    points: FloatArray,
    distance: FloatArray,
    plane_distance: FloatArray | None = None,
    *,
    crs: str | None = None,
) -> None:
    """Write a tile of a deviation map as LAS 1.4 with the distances as extra bytes of 32-bit floats.

    Coordinates are rounded as by `pcbench.io.las_grid.choose_grid`.

    Args:
        path: output file, with the extension of `map_tile_extension`.
        points: (N, 3) points in the reference's coordinates, at least one.
        distance: (N,) distances to the nearest point.
        plane_distance: (N,) signed distances of the candidate along the reference's normals, positive where the normals
            point; None: unknown.
        crs: coordinate system of the reference. It is written if pyproj knows it.

    Raises:
        InputError: 32 bits cannot store the coordinates of the tile.
        OSError: the file cannot be written; an existing file is then unchanged.
    """
    attributes = {"distance": distance.astype(np.float32)}
    if plane_distance is not None:
        attributes["plane_distance"] = plane_distance.astype(np.float32)
    write_cloud(path, Cloud(points, attributes=attributes, crs=crs if is_known_crs(crs) else None))


def write_tile_index(folder: Path, crs: str | None) -> Path | None:
    """Write FOLDER.vpc, a virtual point cloud that QGIS and PDAL open like one file, beside a folder of map tiles.

    Args:
        folder: folder with map tiles.
        crs: coordinate system of the reference.

    Returns:
        The file; None if there are no tiles, or the places of the tiles on the Earth are unknown, which a .vpc file
        must have.

    Raises:
        OSError: a tile cannot be read or the file cannot be written.
    """
    tiles = sorted(path for path in folder.iterdir() if path.suffix in (".laz", ".las"))
    if crs is None or not tiles or not is_known_crs(crs):
        return None
    path = folder.with_name(f"{folder.name}.vpc")
    items = [_index_entry(tile, f"./{folder.name}/{tile.name}", crs) for tile in tiles]
    if None in items:
        return None
    with atomic_write(path) as file:
        file.write(json.dumps({"type": "FeatureCollection", "features": items}).encode())
    return path


def write_overview(
    folder: Path,
    name: str,
    overview: MapOverview,
    *,
    kind: str = "distance",
    crs: str | None = None,
    unit: str | None = None,
) -> Path:
    """Write FOLDER/NAME_KIND.tif, a GeoTIFF with the bands signed, mean, largest and count, and return its path.

    Args:
        folder: folder of the maps.
        name: name of the candidate.
        overview: the raster.
        kind: `distance` for the candidate's points, `completeness` for the reference's.
        crs: coordinate system of the reference.
        unit: unit of its lengths.

    Raises:
        OSError: the file cannot be written.
    """
    path = folder / f"{name}_{kind}.tif"
    bands = {"signed": overview.signed, "mean": overview.mean, "largest": overview.largest, "count": overview.count}
    length = unit or "unknown"  # GDAL would take the unit of heights
    texts = {
        "signed": BandText(_SIGNED_DEFINITION, length),
        "mean": BandText(f"Mean distance of {_POINTS[kind]} to {_NEAREST[kind]}.", length),
        "largest": BandText(f"Largest distance of {_POINTS[kind]} to {_NEAREST[kind]}.", length, "max"),
        "count": BandText(f"Number of {_POINTS[kind]}.", "1"),
    }
    write_geotiff(path, Raster(bands, overview.west, overview.north, overview.pixel, crs, texts))
    return path


def read_overview(path: Path) -> MapOverview:
    """Read a file of `write_overview`; raises the same errors as `read_geotiff`."""
    raster = read_geotiff(path)
    names = ("signed", "mean", "largest", "count")
    signed, mean, largest, count = (np.asarray(raster.bands[name], np.float64) for name in names)
    return MapOverview(signed, mean, largest, count, raster.west, raster.north, raster.pixel)


def _index_entry(tile: Path, href: str, crs: str) -> dict[str, Any] | None:
    """Return the STAC item of a tile: its corners as longitude and latitude, its bounds, count and system.

    The result is None if its place on the Earth is unknown, as on a local grid.
    """
    with tile.open("rb") as file:
        header = read_header(file, lambda _: None)
    (west, south, low), (east, north, high) = header.bounds or ((0.0,) * 3, (0.0,) * 3)
    ring = np.array([[west, south], [east, south], [east, north], [west, north], [west, south]])
    degrees = to_wgs84(crs, ring)
    if degrees is None:
        return None
    corners = degrees.tolist()
    longitudes, latitudes = zip(*corners, strict=True)
    return {
        "type": "Feature",
        "stac_version": _VPC_VERSION,
        "stac_extensions": [
            "https://stac-extensions.github.io/pointcloud/v1.0.0/schema.json",
            "https://stac-extensions.github.io/projection/v1.1.0/schema.json",
        ],
        "id": tile.stem,
        "geometry": {"type": "Polygon", "coordinates": [corners]},
        "bbox": [min(longitudes), min(latitudes), low, max(longitudes), max(latitudes), high],
        "properties": {
            "datetime": None,
            "pc:count": header.count,
            "pc:encoding": "LASzip" if header.compressed else "LAS",
            "pc:type": "other",
            "proj:bbox": [west, south, low, east, north, high],
            "proj:wkt2": wkt2(crs),
        },
        "links": [],
        "assets": {"data": {"href": href, "roles": ["data"]}},
    }
