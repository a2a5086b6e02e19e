"""Small grids of heights as files of ESRI and GeoTIFF. Does not import pcbench."""

import io

import numpy as np
from optional import import_or_skip

# Columns 2 wide and rows 3 high; z = x + 10 y at the centres, and one cell without data.
X, Y = 101 + 2 * np.arange(4), 210.5 - 3 * np.arange(3)
HEIGHTS = X + 10.0 * Y[:, None]
HEIGHTS[1, 2] = -9999
CENTERS = [(x, y, x + 10 * y) for y in Y for x in X if (x, y) != (X[2], Y[1])]


def asc():
    rows = "\n".join(" ".join(map(repr, row)) for row in HEIGHTS.tolist())
    return f"ncols 4\nnrows 3\nxllcorner 100\nyllcorner 203\ndx 2\ndy 3\nNODATA_value -9999\n{rows}\n"


def write_tif(path, heights=HEIGHTS, *, raster_type=1, epsg=32632, unit=None, more=(), place=None, **options):
    tifffile = import_or_skip("tifffile")
    keys = [1, 1, 0, 3, 1024, 0, 1, 1, 1025, 0, 1, raster_type, 3072, 0, 1, epsg]
    shift = 0.5 if raster_type == 2 else 0
    place = place or [
        (33550, "d", 3, (2.0, 3.0, 0.0), True),
        (33922, "d", 6, (0.0, 0.0, 0.0, 100 + 2 * shift, 212 - 3 * shift, 0.0), True),
    ]
    tags = [*place, (34735, "H", len(keys), keys, True), (42113, "s", 0, "-9999", True), *more]
    if unit:
        tags.append((42112, "s", 0, f'<GDALMetadata><Item role="unittype">{unit}</Item></GDALMetadata>', True))
    options = {"photometric": "minisblack", "metadata": None, "extratags": tags} | options
    tifffile.imwrite(path, heights, **options)
    return path


def tif_corpus():
    options = {"plain": {}, "tiles": {"tile": (16, 16), "compression": "deflate"}, "big": {"bigtiff": True}}
    return {name: write_tif(io.BytesIO(), **each).getvalue() for name, each in options.items()}
