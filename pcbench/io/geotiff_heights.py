"""Read GeoTIFF grids of heights with tifffile in a child process, as points or as a surface; see `height_grids`.

Why tifffile (BSD): it reads striped and tiled files and BigTIFF with most compressions, those beyond deflate and
PackBits with the library imagecodecs (BSD). rasterio would bring GDAL. `geotiff.read_raster` only reads what pcbench
writes.
"""

from __future__ import annotations

import json
import re
import struct
from pathlib import Path
from typing import Any

import numpy as np

from pcbench.children import Limits, run_script
from pcbench.errors import InputError
from pcbench.extras import require
from pcbench.geometry.arrays import FloatArray
from pcbench.geometry.crs import axis_units, single_unit, with_units
from pcbench.geometry.mesh import Mesh
from pcbench.geometry.units import metres, unit_of_length
from pcbench.io import tifffile_child
from pcbench.io.files import Fields, Look, Warn
from pcbench.io.height_grids import MAX_CELLS, ElevationGrid
from pcbench.io.las_crs import GEO_DOUBLES, GEO_KEYS, WKT, read_crs
from pcbench.io.nodata import is_stated_nodata
from pcbench.scratch import scratch_folder

_RASTER_TYPE, _PIXEL_IS_POINT = 1025, 2
_ESRI_WKT = re.compile(r"ESRI PE String = ([^|]*)")  # where a system has no EPSG code
_ITEM = re.compile(r'<Item[^<>]*role="(unittype|scale|offset)"[^<>]*>([^<]*)</Item>')  # of GDAL's metadata


def look_at_geotiff(path: Path) -> Look:
    """Return that a GeoTIFF is a surface, whatever is in it; its readers check that."""
    return Look(holds_mesh=True)


def read_geotiff_points(path: Path, warn: Warn) -> Fields:
    """Read the centres of the cells with data; raises as `read_geotiff_mesh`."""
    return _read_grid(path, warn).points(warn)


def read_geotiff_mesh(path: Path, warn: Warn) -> Mesh:
    """Read the surface of a grid of heights.

    Raises:
        InputError: the file is damaged, has no place, is rotated or an image, or tifffile cannot read it.
        MissingExtra: tifffile is not installed.
        OSError: the file cannot be read.
    """
    return _read_grid(path, warn).mesh(warn)


def _read_grid(path: Path, warn: Warn) -> ElevationGrid:
    heights, tags = _run_tifffile(path)
    x, y = _centers(tags, heights.shape)
    if tags["bands"] > 1:
        warn(f"read the first of {tags['bands']} bands")
    try:
        no_data = float(str(tags.get("no_data", "nan")).strip("\0 "))
    except ValueError:
        no_data = np.nan
    heights[is_stated_nodata(heights, no_data)] = np.nan
    items = dict(_ITEM.findall(str(tags.get("metadata", ""))))
    heights = heights * _number(items.get("scale"), 1) + _number(items.get("offset"), 0)
    crs, unit = _system(tags, items.get("unittype"), warn)
    west, north = x[-1] < x[0], y[-1] > y[0]  # rows and columns may run the other way
    return ElevationGrid(
        x[::-1] if west else x, y[::-1] if north else y, heights[:: -1 if north else 1, :: -1 if west else 1], crs, unit
    )


def _run_tifffile(path: Path) -> tuple[FloatArray, dict[str, Any]]:
    """Return the heights (H, W) and the tags for their place."""
    size = path.stat().st_size
    # The child holds the cells as stored and as float64; deflate and others shrink those without data to nothing.
    memory, seconds = (1 << 30) + 20 * MAX_CELLS, 60 + size // 1_000_000
    with scratch_folder() as folder:
        heights, tags = folder / "heights.npy", folder / "tags.json"
        done = run_script(
            tifffile_child.__file__,
            str(path.resolve()),
            str(MAX_CELLS),
            str(heights),
            str(tags),
            limits=Limits(seconds=2 * seconds, cpu_seconds=seconds, memory=memory),
            environment={"OPENBLAS_NUM_THREADS": "1"},  # each thread of a pool takes address space
        )
        if done.timed_out:
            raise InputError(f"tifffile did not finish within {2 * seconds} s: crop the raster")
        if done.code:
            require("tifffile")
            given = done.last_error_line or f"exit status {done.code}"
            reason = "".join(c if c.isprintable() else " " for c in given)[:200]
            needs_codecs = "imagecodecs" in reason or "ModuleNotFoundError" in reason
            remedy = ": pip install imagecodecs, or save it with compression DEFLATE and without predictor"
            raise InputError(f"cannot be read as a grid of heights: {reason}{remedy if needs_codecs else ''}")
        return np.load(heights, allow_pickle=False), json.loads(tags.read_text(encoding="utf-8"))


def _centers(tags: dict[str, Any], shape: tuple[int, ...]) -> tuple[FloatArray, FloatArray]:
    """Return x of the columns and y of the rows.

    Raises:
        InputError: the file does not state them, or rows and columns do not run along the axes.
    """
    scale, tiepoint, matrix = (_numbers(tags.get(name)) for name in ("scale", "tiepoint", "matrix"))
    if len(matrix) == 16:
        a, b, _, left, c, d, _, top = matrix[:8]
        if b or c:
            raise InputError("expected rows and columns along x and y, got a rotated raster: resample it with gdalwarp")
        steps, origin = (a, d), (left, top)
    elif len(scale) >= 2 and len(tiepoint) == 6:
        steps = scale[0], -scale[1]
        origin = tiepoint[3] - tiepoint[0] * steps[0], tiepoint[4] - tiepoint[1] * steps[1]
    else:
        raise InputError("expected a GeoTIFF, got a TIFF without the place and size of its pixels: export it with both")
    if not all(step and abs(step) < 1e18 and abs(start) < 1e18 for step, start in zip(steps, origin, strict=True)):
        raise InputError(f"expected pixels with a size and a place, got {steps} at {origin}: export it again")
    keys = [int(number) for number in _numbers(tags.get("keys"))]
    entries = {keys[k]: keys[k + 3] for k in range(4, len(keys) - 3, 4)}
    first = 0.0 if entries.get(_RASTER_TYPE) == _PIXEL_IS_POINT else 0.5  # of a pixel, to its centre
    height, width = shape
    columns, rows = (first + np.arange(count, dtype=np.float64) for count in (width, height))
    return origin[0] + steps[0] * columns, origin[1] + steps[1] * rows


def _system(tags: dict[str, Any], unit_name: str | None, warn: Warn) -> tuple[str | None, str | None]:
    """Return the coordinate reference system, with the unit of the heights if the file states one, and the unit."""
    records = {
        GEO_KEYS: struct.pack(f"<{len(keys)}H", *keys) if (keys := _shorts(tags.get("keys"))) else b"",
        GEO_DOUBLES: np.array(_numbers(tags.get("doubles")), "<f8").tobytes(),
    }
    if wkt := _ESRI_WKT.search(str(tags.get("texts", ""))):
        records[WKT] = wkt[1].encode()
    crs, unit = read_crs(records, warn)
    length, units = metres(unit_name), axis_units(crs)
    height_unit = None if length is None else unit_of_length(length)
    if crs is None or units is None or units.height is not None or height_unit in (None, units.horizontal):
        return crs, unit
    mixed = with_units(crs, units.horizontal, height_unit)
    return mixed, single_unit(mixed, warn)


def _number(text: str | None, default: float) -> float:
    try:
        value = default if text is None else float(text)
    except ValueError:
        return default
    return value if np.isfinite(value) else default


def _numbers(value: Any) -> list[float]:
    values = value if isinstance(value, list) else []
    return [float(number) for number in values] if all(isinstance(n, int | float) for n in values) else []


def _shorts(value: Any) -> list[int]:
    numbers = _numbers(value)
    return [int(number) for number in numbers] if all(0 <= number < 1 << 16 for number in numbers) else []
