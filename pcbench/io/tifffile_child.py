"""Read a GeoTIFF with tifffile in a child process: `tifffile_child.py FILE MAX_CELLS HEIGHTS.npy TAGS.json`.

The parent limits the time and memory of this process, and reports the file. The script does not import pcbench.
"""

import json
import sys
from pathlib import Path
from typing import Any

# Bound of the unpacked size: this factor times the file size, plus bytes. Deflate shrinks empty cells 1032 times.
_MAX_GROWTH, _MAX_FREE_GROWTH_BYTES = 2000, 64 << 20
_TAGS = {  # of OGC GeoTIFF 1.1 and GDAL, by the names that the parent reads
    "scale": 33550,
    "tiepoint": 33922,
    "matrix": 34264,
    "keys": 34735,
    "doubles": 34736,
    "texts": 34737,
    "metadata": 42112,
    "no_data": 42113,
}


def main(source: str, most: str, heights: str, tags: str) -> None:
    """Write the first band of the first image as .npy, and the tags for its place as JSON."""
    import numpy as np
    import tifffile

    with tifffile.TiffFile(source) as file:
        page: Any = file.pages[0]
        if page.imagewidth * page.imagelength > int(most):
            sys.exit(f"it has {page.imagewidth} x {page.imagelength} cells, more than {int(most):,}: crop it")
        bytes_stated = page.imagewidth * page.imagelength * page.samplesperpixel * page.bitspersample // 8
        if bytes_stated > _MAX_GROWTH * Path(source).stat().st_size + _MAX_FREE_GROWTH_BYTES:
            sys.exit(
                f"it states {page.imagewidth} x {page.imagelength} cells, more than the file can hold: copy it again"
            )
        if page.samplesperpixel > 1 and page.dtype is not None and page.dtype.itemsize == 1:
            sys.exit(f"it is an image with {page.samplesperpixel} colours, not a grid of heights")
        values = {name: page.tags[code].value for name, code in _TAGS.items() if code in page.tags}
        bands = page.asarray()
        if bands.ndim == 3:
            bands = bands[0] if page.planarconfig == 2 else bands[..., 0]
        if bands.ndim != 2 or bands.dtype.kind not in "fiu":
            sys.exit(f"it has cells of shape {bands.shape} and type {bands.dtype}, not numbers in rows and columns")
        np.save(heights, bands.astype(np.float64))
    values["bands"] = page.samplesperpixel
    plain = {name: list(value) if isinstance(value, tuple) else value for name, value in values.items()}
    Path(tags).write_text(json.dumps(plain, default=str), encoding="utf-8")


if __name__ == "__main__":
    try:
        main(*sys.argv[1:])
    except MemoryError:
        sys.exit("it states larger sizes than the file can hold: copy or export it again")
    except Exception as error:
        sys.exit(f"{type(error).__name__}: {error}")
