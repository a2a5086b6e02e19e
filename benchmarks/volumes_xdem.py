"""Interval of the net volume by xDEM: `python volumes_xdem.py MAP.tif OUT.json MODEL...`, in a Python that has xDEM.

MAP.tif is that of `pcbench change`: its band `dz` is the difference of heights, and what its band `part` leaves at 0 is
stable terrain. The variogram of that terrain is fitted by the sum of the models, and gives the number of independent
samples of the area. The file is no part of pcbench, which neither needs nor imports xDEM.
"""

import json
import sys
from pathlib import Path

import geoutils
import numpy as np
import rasterio
import xdem


def main() -> None:
    """Write the version, the net volume, half the width of its 95 % interval and the fitted ranges."""
    path, out, *models = sys.argv[1:]
    with rasterio.open(path) as file:
        heights, parts = (file.read(file.descriptions.index(name) + 1, masked=True) for name in ("dz", "part"))
        cell = file.res[0]
    dz = heights.astype(float).filled(np.nan)
    stable = np.isfinite(dz) & (parts.filled(0) == 0)
    spread = float(geoutils.stats.nmad(dz[stable]))
    _, fit, _ = xdem.spatialstats.infer_spatial_correlation_from_stable(
        dvalues=dz / spread, list_models=models, stable_mask=stable, gsd=cell, random_state=0
    )
    area = float(np.count_nonzero(np.isfinite(dz)) * cell**2)
    samples = xdem.spatialstats.number_effective_samples(area, fit)
    result = {
        "version": xdem.__version__,
        "net": float(np.nansum(dz)) * cell**2,
        "half_width": 1.96 * spread / samples**0.5 * area,
        "ranges": fit["range"].tolist(),
    }
    Path(out).write_text(json.dumps(result), encoding="utf-8")


if __name__ == "__main__":
    main()
