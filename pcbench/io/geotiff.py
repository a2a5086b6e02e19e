"""Write rasters of numbers as GeoTIFF, the format of raster layers in QGIS, GDAL and ArcGIS; read them back.

The files are cloud-optimised (OGC 21-026): all directories come first, that of the full raster before those of its
overviews, then the pixels of the smallest overview, and those of the full raster last. Values are 32-bit floats, in
one plane of tiles per band, compressed with deflate. A predictor would make files of distances, whose noise fills all
bits, a tenth larger. The tags for places are those of OGC GeoTIFF 1.1 (OGC 19-008r4), those for names and missing
values are GDAL's.
"""

from __future__ import annotations

import struct
import zlib
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from html import escape, unescape
from pathlib import Path
from typing import BinaryIO, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from pcbench.errors import InputError
from pcbench.io.geo_keys import geo_keys
from pcbench.io.tiff import ASCII, DOUBLE, LONG, PLACE, SHORT, Tags, file_header, read_directory
from pcbench.scratch import atomic_write

_TILE, _SMALL_TILE = 512, 256  # edges of the tiles of rasters above 512 pixels, and of others
_HALVED_ROWS = 64  # of an overview that are made at once: their sums are doubles
_MAX_GROWTH = 1032  # of deflate
_MAX_CLASSIC_BYTES = (1 << 32) - (1 << 24)  # larger files have offsets of 64 bits; deflate may lengthen noise a little
_DEFLATE, _PLANES, _FLOAT, _REDUCED = 8, 2, 3, 1
_SUBFILE, _WIDTH, _HEIGHT, _COMPRESSION, _BANDS = 254, 256, 257, 259, 277
_TILE_WIDTH, _TILE_HEIGHT, _TILES, _TILE_SIZES = 322, 323, 324, 325
_PIXEL_SCALE, _TIEPOINT, _METADATA, _NO_DATA = 33550, 33922, 42112, 42113


@dataclass(frozen=True)
class BandText:
    """Texts of a band that a GIS shows, and the rule for its overviews.

    Attributes:
        definition: one sentence that defines the values; for signed ones, it says what is positive.
        unit: unit of the values, `1` for counts and shares; None: that of the system's heights, as GDAL assumes.
        overview: value of an overview's pixel, from the four pixels below it that have data: their `mean`, or their
            `max`. Counts and yes-or-no values have means too: the count per pixel and the share, so that their colours
            stay the same at each scale.
    """

    definition: str
    unit: str | None = None
    overview: Literal["mean", "max"] = "mean"


@dataclass(frozen=True, eq=False)
class Raster:
    """A raster of square pixels, with rows from north to south and columns from west to east.

    Attributes:
        bands: (H, W) values by name, of one shape; NaN: no data.
        west: x of the left edge of the first column.
        north: y of the upper edge of the first row.
        pixel: edge of a pixel, in the unit of x and y.
        crs: coordinate system of x and y, if known.
        texts: texts and rules of the bands, by their names.
    """

    bands: Mapping[str, NDArray[np.floating] | NDArray[np.integer]]
    west: float
    north: float
    pixel: float
    crs: str | None = None
    texts: Mapping[str, BandText] = field(default_factory=dict)

    @property
    def shape(self) -> tuple[int, int]:
        """Number of rows and columns."""
        height, width = next(iter(self.bands.values())).shape
        return height, width


def write_geotiff(path: Path, raster: Raster) -> None:
    """Write a raster as a cloud-optimised GeoTIFF with 32-bit floats; missing values are NaN and declared as such.

    Overviews halve the raster until it fits into a tile. They are made from the level before, and have a value where
    one of the four pixels has one. Rasters above 4 GiB are BigTIFF. The memory needed is a third of the 32-bit raster.
    `pcbench.io.geo_keys` says how coordinate systems are written. If pyproj does not know the system, viewers ask for
    it.

    Args:
        path: output file.
        raster: the raster. Values are rounded to 32 bits.

    Raises:
        InputError: the raster has no pixels, or its bands differ in shape.
        OSError: the file cannot be written; an existing file is then unchanged.
    """
    shapes = {np.shape(values) for values in raster.bands.values()}
    if len(shapes) != 1 or len(shape := shapes.pop()) != 2 or 0 in shape or not 0 < raster.pixel < np.inf:
        raise InputError(f"{path}: expected a raster with bands of one shape and square pixels")
    tile = _TILE if max(shape) > _TILE else _SMALL_TILE
    levels = [_Level(list(raster.bands.values()), tile)]
    rules = [raster.texts[name].overview if name in raster.texts else "mean" for name in raster.bands]
    while max(levels[-1].shape) > tile:
        halves = [halved(band, rule) for band, rule in zip(levels[-1].bands, rules, strict=True)]
        levels.append(_Level(halves, tile))
    is_big = sum(level.size for level in levels) > _MAX_CLASSIC_BYTES
    described = _raster_tags(raster)
    directories = [level.tags(described if level is levels[0] else {_SUBFILE: (LONG, [_REDUCED])}) for level in levels]
    start = len(file_header(directories, is_big=is_big))
    with atomic_write(path) as file:
        file.seek(start)
        for number in reversed(range(len(levels))):
            sizes = levels[number].write(file)
            *places, start = (start + np.cumsum([0, *sizes])).tolist()
            directories[number] = {**directories[number], _TILES: (PLACE, places), _TILE_SIZES: (LONG, sizes)}
        file.seek(0)
        file.write(file_header(directories, is_big=is_big))


def read_geotiff(path: Path) -> Raster:
    """Read a raster that `write_geotiff` wrote, without its coordinate system and texts.

    Raises:
        InputError: the file is damaged or another kind of TIFF.
        OSError: the file cannot be read.
    """
    data = path.read_bytes()
    try:
        tags = read_directory(data)
        (width,), (height,), (count,) = (tags[tag] for tag in (_WIDTH, _HEIGHT, _BANDS))
        (tile,), (tile_height,) = tags[_TILE_WIDTH], tags[_TILE_HEIGHT]
        needed = count * -(-height // tile) * -(-width // tile)
        if (number := len(tags[_TILES])) != needed or tile != tile_height:
            raise ValueError(f"{count} bands of {width} x {height} pixels in {number} tiles of {tile} x {tile_height}")
        if 4 * count * height * width > _MAX_GROWTH * len(data):
            raise ValueError(f"{count} bands of {width} x {height} pixels in {len(data)} bytes")
        values = np.empty((count, height, width), np.float32)
        blocks = (band[place] for band in values for place in _tile_places((height, width), tile))
        for block, start, size in zip(blocks, tags[_TILES], tags[_TILE_SIZES], strict=True):
            raw = zlib.decompressobj().decompress(data[start : start + size], 4 * tile**2 + 1)
            block[:] = np.frombuffer(raw, "<f4").reshape(tile, tile)[: block.shape[0], : block.shape[1]]
        texts = tags[_METADATA].decode().split('role="description">')[1:]
        names = [unescape(unescape(text.partition("<")[0])) for text in texts]
        pixel, _, _ = tags[_PIXEL_SCALE]
        west, north = tags[_TIEPOINT][3:5]
        return Raster(dict(zip(names, values, strict=True)), west, north, pixel)
    # A damaged kind of values is a TypeError or KeyError, a damaged size of tiles a ZeroDivisionError.
    except (KeyError, TypeError, ValueError, ArithmeticError, AttributeError, struct.error, zlib.error) as error:
        raise InputError(f"{path}: expected a GeoTIFF of pcbench: {error}") from error


def halved(values: NDArray[np.generic], rule: Literal["mean", "max"]) -> NDArray[np.float32]:
    """Return a raster (H, W) with pixels of twice the edge, from those of each four pixels that have data.

    The result (ceil(H / 2), ceil(W / 2)) is NaN where all four pixels are NaN.
    """
    height, width = values.shape
    half = np.empty((-(-height // 2), -(-width // 2)), np.float32)
    for row in range(0, len(half), _HALVED_ROWS):
        rows = half[row : row + _HALVED_ROWS]
        block = np.full((2 * rows.shape[0], 2 * rows.shape[1]), np.nan)
        below = values[2 * row : 2 * row + len(block)]
        block[: len(below), :width] = below
        four = block.reshape(len(rows), 2, -1, 2)
        if rule == "max":
            rows[:] = np.fmax.reduce(four, axis=(1, 3))
            continue
        counts = np.count_nonzero(~np.isnan(four), axis=(1, 3))
        rows[:] = np.divide(np.nansum(four, axis=(1, 3)), counts, out=np.full(rows.shape, np.nan), where=counts > 0)
    return half


class _Level(NamedTuple):
    """The bands (H, W) of a raster or of an overview, and the edge of its tiles."""

    bands: Sequence[NDArray[np.generic]]
    tile: int

    @property
    def shape(self) -> tuple[int, int]:
        height, width = self.bands[0].shape
        return height, width

    @property
    def size(self) -> int:
        """Number of bytes without compression, at most."""
        return 4 * len(self.bands) * len(_tile_places(self.shape, self.tile)) * self.tile**2

    def tags(self, more: Tags) -> Tags:
        """Return the tags of the directory, with offsets and sizes of tiles that are still to be set."""
        count, (height, width) = len(self.bands), self.shape
        unset = [0] * (count * len(_tile_places(self.shape, self.tile)))
        return {
            _WIDTH: (LONG, [width]),
            _HEIGHT: (LONG, [height]),
            258: (SHORT, [32] * count),  # bits
            _COMPRESSION: (SHORT, [_DEFLATE]),
            262: (SHORT, [1]),  # the smallest value is black
            _BANDS: (SHORT, [count]),
            284: (SHORT, [_PLANES]),
            _TILE_WIDTH: (LONG, [self.tile]),
            _TILE_HEIGHT: (LONG, [self.tile]),
            _TILES: (PLACE, unset),
            _TILE_SIZES: (LONG, unset),
            **({338: (SHORT, [0] * (count - 1))} if count > 1 else {}),  # further bands have no colours
            339: (SHORT, [_FLOAT] * count),
            _NO_DATA: (ASCII, b"nan\0"),
            **more,
        }

    def write(self, file: BinaryIO) -> list[int]:
        """Write the compressed tiles, and return their sizes."""
        return [file.write(zlib.compress(tile)) for tile in self._tiles()]

    def _tiles(self) -> Iterator[bytes]:
        for values in self.bands:
            for place in _tile_places(self.shape, self.tile):
                block = np.full((self.tile, self.tile), np.nan, "<f4")
                part = values[place]
                block[: part.shape[0], : part.shape[1]] = part
                yield block.tobytes()


def _tile_places(shape: tuple[int, int], tile: int) -> list[tuple[slice, slice]]:
    """Return the rows and columns of each tile of a raster, row by row."""
    height, width = shape
    return [
        (slice(row, row + tile), slice(column, column + tile))
        for row in range(0, height, tile)
        for column in range(0, width, tile)
    ]


def _raster_tags(raster: Raster) -> Tags:
    """Return the tags for place, coordinate system and texts, which only the full raster has."""
    items = []
    for k, name in enumerate(raster.bands):
        items.append(f'<Item name="DESCRIPTION" sample="{k}" role="description">{_escape(name)}</Item>')
        if (text := raster.texts.get(name)) is not None:
            items.append(f'<Item name="DEFINITION" sample="{k}">{_escape(text.definition)}</Item>')
            if text.unit is not None:
                items.append(f'<Item name="UNITTYPE" sample="{k}" role="unittype">{_escape(text.unit)}</Item>')
    return {
        _PIXEL_SCALE: (DOUBLE, [raster.pixel, raster.pixel, 0.0]),
        _TIEPOINT: (DOUBLE, [0.0, 0.0, 0.0, raster.west, raster.north, 0.0]),
        **geo_keys(raster.crs),
        _METADATA: (ASCII, f"<GDALMetadata>{''.join(items)}</GDALMetadata>".encode() + b"\0"),
    }


def _escape(text: str) -> str:
    """Return a text for GDAL's metadata, whose XML is escaped twice."""
    return escape(escape(text, quote=False), quote=False)
