"""The maps of a cloud's quality: as GeoTIFF if its coordinates are projected, and as arrays for the pictures."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from pcbench.geometry.crs import is_projected_crs
from pcbench.io.geotiff import BandText, Raster, write_geotiff
from pcbench.measure.quality.density import PlanMap
from pcbench.measure.quality.quality import QualityMaps
from pcbench.scratch import atomic_write
from pcbench.studies.quality.results import MeasuredCloud

KINDS = ("density", "thickness", "voids")
_TEXTS = {
    "density": ("Points per squared unit of the cell.", "1/{unit}²"),
    "thickness": ("Mean thickness of flat patches in the cell: the width that holds 90 % of their points.", "{unit}"),
    "voids": ("1 in areas without returns, 2 in those at water, else 0.", "1"),
}


def geotiff_name(name: str, kind: str) -> str:
    """Return the name of a map's GeoTIFF, relative to the folder of maps."""
    return f"{name}_{kind}.tif"


def write_maps(folder: Path, clouds: Sequence[MeasuredCloud], maps: Sequence[QualityMaps]) -> None:
    """Write the maps of all clouds into a folder, and delete those of an earlier run.

    Raises:
        OSError: a file cannot be written.
    """
    for former in (*folder.glob("*.tif"), *folder.glob("*.npz")):
        former.unlink()
    for cloud, plans in zip(clouds, maps, strict=True):
        arrays: dict[str, Any] = {}
        for kind, plan in zip(KINDS, plans, strict=True):
            if plan is None:
                continue
            arrays[kind] = plan.values.astype(np.float32)
            arrays[f"{kind}_place"] = np.array([plan.west, plan.north, plan.cell])
            if is_projected_crs(cloud.crs):
                definition, unit = _TEXTS[kind]
                text = BandText(
                    definition, unit.format(unit=cloud.unit or "unit"), "max" if kind == "voids" else "mean"
                )
                raster = Raster({kind: plan.values}, plan.west, plan.north, plan.cell, cloud.crs, {kind: text})
                write_geotiff(folder / geotiff_name(cloud.name, kind), raster)
        with atomic_write(folder / f"{cloud.name}.npz") as file:
            np.savez_compressed(file, **arrays)


def read_maps(folder: Path, name: str) -> QualityMaps:
    """Read the maps of a cloud that `write_maps` wrote as arrays.

    Raises:
        OSError: the file cannot be read.
    """
    with np.load(folder / f"{name}.npz", allow_pickle=False) as arrays:
        plans: list[PlanMap | None] = []
        for kind in KINDS:
            if kind not in arrays:
                plans.append(None)
                continue
            west, north, cell = arrays[f"{kind}_place"].tolist()
            plans.append(PlanMap(west, north, cell, arrays[kind].astype(np.float64)))
    return QualityMaps(*plans)
