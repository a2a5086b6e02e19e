"""Presets of a tiled comparison. They cut both clouds at the region, so they are measured in cropped tiles."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np

from pcbench.geometry.regions import Region
from pcbench.measure.directions import PLANE_METRIC
from pcbench.measure.metrics import FScore, harmonic_mean
from pcbench.measure.presets import Gao2025, Open3d, Pdal, Preset
from pcbench.measure.summaries import within_key
from pcbench.measure.tiled.columns import column_file, load_column, save_column
from pcbench.measure.tiled.tiles import NORMALS, WIDE_NORMALS, TileSummary
from pcbench.measure.tiled.totals import DirectionTotals


def crop_tile(tiles: Path, number: int, region: Region, folder: Path) -> TileSummary:
    """Store the points of a tile inside a region as another tile, with their rows and normals.

    Args:
        tiles: folder of the tiles.
        number: number of the tile, which has points.
        region: the region in local coordinates.
        folder: folder for the files, which exists.
    """
    points = load_column(tiles, number, "points")
    inside = np.flatnonzero(region.contains(points))
    if not len(inside):
        return TileSummary.empty(number)
    for name in ("points", "rows", NORMALS, WIDE_NORMALS):
        if column_file(tiles, number, name).exists():
            save_column(folder, number, name, load_column(tiles, number, name)[inside])
    return TileSummary.of(number, points[inside], points[inside])


def presets_of(
    forth: DirectionTotals, back: DirectionTotals, thresholds: Sequence[float], names: Sequence[str]
) -> Iterator[tuple[str, Preset]]:
    """Yield the presets with these names that follow from the distances between the cropped clouds.

    Args:
        forth: totals of the distances candidate → reference.
        back: totals of the distances reference → candidate.
        thresholds: distance thresholds of the F-score, those of both totals.
        names: names of presets.
    """
    assert forth.farthest is not None and back.farthest is not None
    largest = max(forth.farthest.distance, back.farthest.distance)
    d1_forth, d1_back = (way.by_cell.mean("d1_mse") for way in (forth, back))
    for name in names:
        if name == "gao2025":
            d2 = forth.by_cell.mean(PLANE_METRIC) if forth.has_planes else None
            yield name, Gao2025(d1_forth, d2, None, largest, d1_forth + d1_back, d1_back)
        elif name == "open3d":
            chamfer = forth.by_cell.mean("mean_distance") + back.by_cell.mean("mean_distance")
            yield name, Open3d(chamfer, largest, tuple(_fscore(forth, back, value) for value in thresholds))
        elif name == "pdal":
            yield name, Pdal(forth.distances.count * d1_forth + back.distances.count * d1_back, largest)


def _fscore(forth: DirectionTotals, back: DirectionTotals, threshold: float) -> FScore:
    precision, recall = (way.by_cell.mean(within_key(threshold)) for way in (forth, back))
    return FScore(threshold, precision, recall, harmonic_mean(precision, recall))
