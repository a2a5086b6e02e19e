"""Presets of a tiled comparison. They cut both clouds at the region, so they are measured in cropped tiles."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from pcbench.geometry.regions import Region
from pcbench.measure.directions import PLANE_METRIC
from pcbench.measure.library_presets import LIBRARY_PRESETS, OneWay
from pcbench.measure.presets import Gao2025, Preset
from pcbench.measure.summaries import within_key
from pcbench.measure.tiled.columns import column_file, load_column, save_column
from pcbench.measure.tiled.directions import MeasuredDirection, TiledPair, measure_tiles
from pcbench.measure.tiled.settings import TILED_PRESETS
from pcbench.measure.tiled.steps import REFERENCE, Steps, tile_tasks
from pcbench.measure.tiled.tiles import NORMALS, WIDE_NORMALS, TiledCloud, TileSummary, save_points
from pcbench.measure.tiled.totals import DirectionTotals


def measure_presets(
    steps: Steps,
    pair: TiledPair,
    directions: tuple[MeasuredDirection, MeasuredDirection],
    region: Region | None,
    stage: str,
    name: str,
) -> dict[str, Preset]:
    """Return the presets that tiles support, measured again between clouds cut at the region if there is one.

    Args:
        steps: the steps of the comparison.
        pair: both clouds.
        directions: the distances c→r and r→c of the complete clouds.
        region: the region in local coordinates; None: everything.
        stage: start of the names of the candidate's stages.
        name: name of the candidate, for progress.
    """
    names = [preset for preset in steps.settings.measured_presets if preset in TILED_PRESETS]
    if region is not None and names:
        cropped = replace(
            pair,
            reference=_crop(steps, REFERENCE, pair.reference, region),
            candidate=_crop(steps, stage, pair.candidate, region),
            forth=pair.forth / "cropped",
            back=pair.back / "cropped",
            pixels=None,
            frame=None,
        )
        directions = measure_tiles(steps, cropped, f"{stage}-cropped", f"{name}, presets", None)
    forth, back = (direction.sums.totals for direction in directions)
    return dict(presets_of(forth, back, pair.thresholds, names))


def _crop(steps: Steps, stage: str, tiles: TiledCloud, region: Region) -> TiledCloud:
    """Cut tiles at the region."""
    folder = steps.folder / stage / "cropped"
    folder.mkdir(parents=True, exist_ok=True)
    tasks = tile_tasks(tiles, lambda number: (tiles.folder, number, region, folder))
    results = steps.results(f"{stage}-crop", crop_tile, tasks, "cutting at the region")
    summaries = {summary.number: summary for summary in results}
    every = (summaries.get(number) or TileSummary.empty(number) for number in range(len(tiles)))
    return replace(TiledCloud.of(folder, every), normals=tiles.normals)


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
    save_points(folder, number, points[inside], load_column(tiles, number, "rows")[inside])
    for name in (NORMALS, WIDE_NORMALS):
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
    accuracy, completeness = _one_way(forth, thresholds), _one_way(back, thresholds)
    for name in names:
        if name == "gao2025":
            d2 = forth.by_cell.mean(PLANE_METRIC) if forth.has_planes else None
            largest = max(accuracy.largest, completeness.largest)
            d1, d1_back = accuracy.mean_square, completeness.mean_square
            yield name, Gao2025(d1, d2, None, largest, d1 + d1_back, d1_back)
        else:
            yield name, LIBRARY_PRESETS[name](accuracy, completeness, thresholds)


def _one_way(totals: DirectionTotals, thresholds: Sequence[float]) -> OneWay:
    assert totals.farthest is not None
    return OneWay(
        totals.distances.count,
        totals.by_cell.mean("mean_distance"),
        totals.by_cell.mean("d1_mse"),
        totals.farthest.distance,
        tuple(totals.by_cell.mean(within_key(threshold)) for threshold in thresholds),
    )
