"""Write rasters of numbers as GeoTIFF, the format of raster layers in QGIS, GDAL and ArcGIS; read them back.

The files are TIFF 6.0 with 32-bit floats, one plane per band, in strips compressed with deflate. The tags for places
and coordinate systems are those of OGC GeoTIFF 1.1 (OGC 19-008r4), those for names and missing values are GDAL's.
"""

from __future__ import annotations

import struct
import zlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from xml.sax.saxutils import escape, unescape

import numpy as np
from numpy.typing import NDArray

from pcbench.errors import InputError
from pcbench.geometry.crs import epsg_code
from pcbench.scratch import atomic_write

_STRIP_BYTES = 1 << 18
_MAX_GROWTH = 1032  # of deflate
_MAX_BYTES = (1 << 32) - 1  # offsets of TIFF have 32 bits
_HEADER = struct.Struct("<2sHI")
_ENTRY = struct.Struct("<HHI4s")
_SHORT, _LONG, _ASCII, _DOUBLE = 3, 4, 2, 12  # types of tags
_FORMATS = {_SHORT: "H", _LONG: "I", _DOUBLE: "d"}
_DEFLATE, _PLANES, _FLOAT = 8, 2, 3
_WIDTH, _HEIGHT, _COMPRESSION, _STRIPS, _BANDS, _ROWS_PER_STRIP, _STRIP_SIZES = 256, 257, 259, 273, 277, 278, 279
_PIXEL_SCALE, _TIEPOINT, _GEO_KEYS, _METADATA, _NO_DATA = 33550, 33922, 34735, 42112, 42113
_MODEL_TYPE, _RASTER_TYPE, _GEOGRAPHIC, _PROJECTED = 1024, 1025, 2048, 3072


@dataclass(frozen=True, eq=False)
class Raster:
    """A raster of square pixels, with rows from north to south and columns from west to east.

    Attributes:
        bands: (H, W) values by name, of one shape; NaN: no data.
        west: x of the left edge of the first column.
        north: y of the upper edge of the first row.
        pixel: edge of a pixel, in the unit of x and y.
        crs: coordinate system of x and y, if known.
    """

    bands: Mapping[str, NDArray[np.float32]]
    west: float
    north: float
    pixel: float
    crs: str | None = None

    @property
    def shape(self) -> tuple[int, int]:
        """Number of rows and columns."""
        height, width = next(iter(self.bands.values())).shape
        return height, width


def write_geotiff(path: Path, raster: Raster) -> None:
    """Write a raster as GeoTIFF with 32-bit floats; missing values are NaN and declared as such.

    The coordinate system is written as an EPSG code. Without pyproj, or if the system has no such code, the file has
    only the place and the size of the pixels, and viewers ask for the system.

    Args:
        path: output file.
        raster: the raster. Values are rounded to 32 bits.

    Raises:
        InputError: the raster has no pixels, its bands differ in shape, or it is too large for TIFF (4 GiB).
        OSError: the file cannot be written; an existing file is then unchanged.
    """
    shapes = {np.shape(values) for values in raster.bands.values()}
    if len(shapes) != 1 or len(shape := shapes.pop()) != 2 or 0 in shape or not raster.pixel > 0:
        raise InputError(f"{path}: expected a raster with bands of one shape and square pixels")
    height, width = shape
    rows = max(1, _STRIP_BYTES // (4 * width))
    strips = [
        zlib.compress(np.ascontiguousarray(values[row : row + rows], dtype="<f4").tobytes())
        for values in raster.bands.values()
        for row in range(0, height, rows)
    ]
    sizes = [len(strip) for strip in strips]
    if _HEADER.size + sum(sizes) + 1024 * len(raster.bands) + 8 * len(sizes) > _MAX_BYTES:
        raise InputError(f"{path}: expected a raster that fits into 4 GiB: choose larger pixels")
    places = (_HEADER.size + np.cumsum([0, *sizes[:-1]])).tolist()
    count = len(raster.bands)
    names = "".join(
        f'<Item name="DESCRIPTION" sample="{k}" role="description">{escape(name)}</Item>'
        for k, name in enumerate(raster.bands)
    )
    tags: dict[int, tuple[int, Sequence[float] | bytes]] = {
        _WIDTH: (_LONG, [width]),
        _HEIGHT: (_LONG, [height]),
        258: (_SHORT, [32] * count),  # bits
        _COMPRESSION: (_SHORT, [_DEFLATE]),
        262: (_SHORT, [1]),  # the smallest value is black
        _STRIPS: (_LONG, places),
        _BANDS: (_SHORT, [count]),
        _ROWS_PER_STRIP: (_LONG, [rows]),
        _STRIP_SIZES: (_LONG, sizes),
        284: (_SHORT, [_PLANES]),
        **({338: (_SHORT, [0] * (count - 1))} if count > 1 else {}),  # further bands have no colours
        339: (_SHORT, [_FLOAT] * count),
        _PIXEL_SCALE: (_DOUBLE, [raster.pixel, raster.pixel, 0.0]),
        _TIEPOINT: (_DOUBLE, [0.0, 0.0, 0.0, raster.west, raster.north, 0.0]),
        **({_GEO_KEYS: (_SHORT, keys)} if (keys := _geo_keys(raster.crs)) else {}),
        _METADATA: (_ASCII, f"<GDALMetadata>{names}</GDALMetadata>".encode() + b"\0"),
        _NO_DATA: (_ASCII, b"nan\0"),
    }
    start = _HEADER.size + sum(sizes)
    padding = start % 2  # directories start at even offsets
    with atomic_write(path) as file:
        file.write(_HEADER.pack(b"II", 42, start + padding))
        file.writelines(strips)
        file.write(b"\0" * padding + _directory(tags, start + padding))


def read_geotiff(path: Path) -> Raster:
    """Read a raster that `write_geotiff` wrote, without its coordinate system.

    Raises:
        InputError: the file is damaged or another kind of TIFF.
        OSError: the file cannot be read.
    """
    data = path.read_bytes()
    try:
        tags = _read_directory(data)
        (width,), (height,), (count,), (rows,) = (tags[tag] for tag in (_WIDTH, _HEIGHT, _BANDS, _ROWS_PER_STRIP))
        per_band, strips = -(-height // rows), len(tags[_STRIPS])
        if strips != count * per_band or 4 * count * height * width > _MAX_GROWTH * len(data):
            raise ValueError(f"{count} bands of {width} x {height} pixels in {strips} strips and {len(data)} bytes")
        values = np.empty((count, height, width), np.float32)
        for strip, (place, size) in enumerate(zip(tags[_STRIPS], tags[_STRIP_SIZES], strict=True)):
            band, row = strip // per_band, strip % per_band * rows
            lines = values[band, row : row + rows]
            raw = zlib.decompressobj().decompress(data[place : place + size], lines.nbytes + 1)
            lines[:] = np.frombuffer(raw, "<f4").reshape(lines.shape)
        texts = tags[_METADATA].decode().split('role="description">')[1:]
        names = [unescape(text.partition("<")[0]) for text in texts]
        pixel, _, _ = tags[_PIXEL_SCALE]
        west, north = tags[_TIEPOINT][3:5]
        return Raster(dict(zip(names, values, strict=True)), west, north, pixel)
    # A damaged kind of values is a TypeError or KeyError, a damaged number of rows a ZeroDivisionError.
    except (KeyError, TypeError, ValueError, ArithmeticError, AttributeError, struct.error, zlib.error) as error:
        raise InputError(f"{path}: expected a GeoTIFF of pcbench: {error}") from error


def _geo_keys(crs: str | None) -> list[float]:
    """Return the key directory of a coordinate system; [] if it has no EPSG code."""
    epsg = None if crs is None else epsg_code(crs)
    if epsg is None:
        return []
    code, is_geographic = epsg
    entries = [
        (_MODEL_TYPE, 2 if is_geographic else 1),
        (_RASTER_TYPE, 1),  # a pixel is an area
        (_GEOGRAPHIC if is_geographic else _PROJECTED, code),
    ]
    return [1, 1, 0, len(entries), *(number for key, value in entries for number in (key, 0, 1, value))]


def _directory(tags: Mapping[int, tuple[int, Sequence[float] | bytes]], start: int) -> bytes:
    """Return the directory of a TIFF at a byte offset, followed by the values that do not fit into it."""
    entries, beyond = [], b""
    end = start + 2 + _ENTRY.size * len(tags) + 4
    for tag, (kind, values) in sorted(tags.items()):
        data = values if isinstance(values, bytes) else struct.pack(f"<{len(values)}{_FORMATS[kind]}", *values)
        if len(data) > 4:
            place, beyond = end + len(beyond), beyond + data + b"\0" * (len(data) % 2)
            data = struct.pack("<I", place)
        entries.append(_ENTRY.pack(tag, kind, len(values), data))
    return struct.pack("<H", len(tags)) + b"".join(entries) + struct.pack("<I", 0) + beyond


def _read_directory(data: bytes) -> dict[int, Any]:
    """Return the values of the tags in the first directory of a TIFF."""
    mark, version, start = _HEADER.unpack_from(data)
    if (mark, version) != (b"II", 42):
        raise ValueError("it is no little-endian TIFF")
    (count,) = struct.unpack_from("<H", data, start)
    tags: dict[int, Any] = {}
    for k in range(count):
        place = start + 2 + _ENTRY.size * k
        tag, kind, length, _ = _ENTRY.unpack_from(data, place)
        form = f"<{length}{'s' if kind == _ASCII else _FORMATS[kind]}"
        place += 8
        if struct.calcsize(form) > 4:
            (place,) = struct.unpack_from("<I", data, place)
        values = struct.unpack_from(form, data, place)
        tags[tag] = values[0] if kind == _ASCII else values
    return tags
