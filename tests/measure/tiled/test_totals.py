"""Tests of the totals of tiles: the metrics are those of all queries in memory, and no bit depends on the tiles."""

import pickle

import numpy as np
import pytest

from pcbench.geometry import voxels
from pcbench.measure import intervals
from pcbench.measure.directions import Direction
from pcbench.measure.metrics import Distances
from pcbench.measure.scores import measure
from pcbench.measure.summaries import summarize
from pcbench.measure.tiled import totals
from pcbench.measure.tiled.spreads import spread_of
from pcbench.measure.tiled.totals import DirectionTotals

THRESHOLDS = (0.5, 1.5)
FLOORS = {"d1_mse": 0.25, "d2_mse": None, "mean_distance": 0.125}
ORIGIN = np.array([4e5, 5e6, 100.0])
VOXEL, CORNER = 0.9, np.array([0.1, -0.2, 0.3])


def direction(seed, *, planes=True, count=5000):
    rng = np.random.default_rng(seed)
    points = 10 * rng.random((count, 3))
    points[:3] = [[3e7, 0, 0], [3e7, 5, 0], [-2e12, 0, 0]]  # far outliers have separate voxels
    cells = intervals.partition(points)
    to_points = np.abs(rng.normal(size=count))
    to_points[rng.choice(count, 4, replace=False)] = 7.5  # several farthest queries
    to_planes = to_points * rng.uniform(-1, 1, count) if planes else None
    return Direction(points, Distances(to_points, to_planes), FLOORS, cells.of_point), cells


def parts_of(whole, folder, splits, seed=0):
    """Totals of tiles with random queries, and the files of their distances."""
    order = np.random.default_rng(seed).permutation(len(whole.points))
    parts, files = [], {"distance": [], "plane_distance": []}
    to_points, to_planes = whole.distances
    for number, rows in enumerate([*np.array_split(order, splits), np.empty(0, np.int64)]):
        planes = None if to_planes is None else to_planes[rows]
        parts.append(
            DirectionTotals.of(
                whole.points[rows],
                rows,
                whole.cells[rows],
                to_points[rows],
                planes,
                thresholds=THRESHOLDS,
                voxel=VOXEL,
                corner=CORNER,
            )
        )
        for kind, values in (("distance", to_points[rows]), ("plane_distance", planes)):
            if values is not None:
                files[kind].append(folder / f"{kind}-{number}.npy")
                np.save(files[kind][-1], values)
    return parts, files


def summary_of(parts, files, cells):
    merged = DirectionTotals.merge(parts)
    spreads = {"distance": spread_of(files["distance"], merged.distances)}
    if merged.plane_distances is not None:
        spreads["plane_distance"] = spread_of(files["plane_distance"], merged.plane_distances)
    return merged.summary(cells=cells.number, floors=FLOORS, spreads=spreads, origin=ORIGIN)


@pytest.mark.parametrize("planes", [True, False])
def test_summary_is_that_of_all_queries_in_memory(planes, tmp_path):
    whole, cells = direction(1, planes=planes)
    expected = summarize(whole, THRESHOLDS, cells=cells, voxel=VOXEL, corner=CORNER, origin=ORIGIN)
    found = summary_of(*parts_of(whole, tmp_path, 4), cells)
    assert found.count == expected.count
    np.testing.assert_array_equal(found.cell_counts, expected.cell_counts)
    assert list(found.means) == list(expected.means)
    for name, mean in expected.means.items():
        assert found.means[name].mean == pytest.approx(mean.mean, rel=1e-14)
        np.testing.assert_allclose(found.means[name].sums, mean.sums, rtol=1e-12)
    assert found.area_weighted == pytest.approx(expected.area_weighted, rel=1e-14)
    assert found.floors == expected.floors
    assert found.spreads.keys() == expected.spreads.keys()
    for kind, spread in expected.spreads.items():
        assert found.spreads[kind].percentiles == spread.percentiles
        assert (found.spreads[kind].median, found.spreads[kind].nmad) == (spread.median, spread.nmad)
        assert found.spreads[kind].std == pytest.approx(spread.std, rel=1e-12)
    assert found.extremes[:3] == expected.extremes[:3]
    np.testing.assert_array_equal(found.extremes.worst_point, expected.extremes.worst_point)
    assert found.d2_sample is None
    assert found.rounding == expected.rounding


def test_metrics_are_those_of_all_queries_in_memory(tmp_path):
    (forth, cells), (back, _) = direction(1), direction(2)
    in_memory = [
        summarize(d, THRESHOLDS, cells=cells, voxel=VOXEL, corner=CORNER, origin=ORIGIN) for d in (forth, back)
    ]
    in_tiles = [summary_of(*parts_of(d, tmp_path, 3), cells) for d in (forth, back)]
    expected, found = (measure(*pair, THRESHOLDS, cells=cells) for pair in (in_memory, in_tiles))
    for name, score in expected.sampled.items():
        assert found.sampled[name].value == pytest.approx(score.value, rel=1e-14)
    for way in ("accuracy", "completeness"):
        interval = getattr(found.metrics.d1_mse, way).interval
        assert interval == pytest.approx(getattr(expected.metrics.d1_mse, way).interval, rel=1e-9)


def test_no_bit_depends_on_the_tiles(tmp_path):
    whole, cells = direction(3)
    summaries = []
    for seed, splits in enumerate((1, 2, 9)):
        parts, files = parts_of(whole, tmp_path, splits, seed)
        halves = [DirectionTotals.merge(parts[1:]), parts[0]]
        summaries.append(summary_of(pickle.loads(pickle.dumps(halves)), files, cells))
    first = summaries[0]
    for other in summaries[1:]:
        assert {n: m.mean for n, m in other.means.items()} == {n: m.mean for n, m in first.means.items()}
        for name, mean in first.means.items():
            np.testing.assert_array_equal(other.means[name].sums, mean.sums)
        assert other.area_weighted == first.area_weighted
        assert other.spreads == first.spreads
        np.testing.assert_array_equal(other.extremes.worst_point, first.extremes.worst_point)
        assert other.rounding == first.rounding


def test_the_first_of_the_farthest_queries_counts(tmp_path):
    whole, _ = direction(4)
    parts, _ = parts_of(whole, tmp_path, 5)
    first = int(np.argmax(whole.distances.to_points))
    for order in (parts, parts[::-1]):
        farthest = DirectionTotals.merge(order).farthest
        assert (farthest.distance, farthest.row) == (7.5, first)
        np.testing.assert_array_equal(farthest.point, whole.points[first])


@pytest.mark.parametrize("side", [0.5, 3e-6, 1e-12])  # all within 2^20 voxels of the corner; some; clipped at 2^31
def test_voxels_are_those_of_the_clouds(side):
    points = np.random.default_rng(6).normal(size=(3000, 3)).round(2)
    points = np.concatenate([points, points])
    corner = np.array([0.25, 0.0, -3.0])
    grid = voxels.cells(points, side, corner)
    keys = totals._voxel_keys(points, side, corner)
    assert len(np.unique(keys)) == len(grid.first)
    np.testing.assert_array_equal(keys, keys[grid.first][grid.of_point])
    groups = totals._voxel_groups(points, side, corner)
    np.testing.assert_array_equal(groups.keys[groups.of_value], keys)
