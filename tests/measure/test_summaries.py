"""Tests of the summary of one direction: its means and sums, and that its metrics follow from it."""

import numpy as np
import pytest

from pcbench.geometry import voxels
from pcbench.measure import intervals, metrics
from pcbench.measure.directions import Direction
from pcbench.measure.metrics import Distances
from pcbench.measure.plane_sample import PlaneSample, sample_planes
from pcbench.measure.results import SampledMean
from pcbench.measure.scores import measure
from pcbench.measure.summaries import summarize, within_key

THRESHOLDS = (0.5, 1.5)
NO_FLOORS = dict.fromkeys(("d1_mse", "d2_mse", "mean_distance"))


def directions(count, *, planes=True, tolerance=None):
    """One direction of random distances, and the correlation cells that it uses."""
    rng = np.random.default_rng(count)
    points = 10 * rng.random((count, 3))
    cells = intervals.partition(points)
    to_points = np.abs(rng.normal(size=count))
    to_planes = to_points * rng.uniform(-1, 1, count) if planes else None
    if tolerance is not None:
        to_planes = sample_planes(to_points, to_planes.__getitem__, tolerance, 0)
    return Direction(points, Distances(to_points, to_planes), NO_FLOORS, cells.of_point), cells


def summary_of(direction, cells):
    return summarize(direction, THRESHOLDS, cells=cells, voxel=1.0, corner=np.zeros(3), origin=np.full(3, 100.0))


def test_means_and_sums_are_those_of_the_distances():
    direction, cells = directions(4000)
    found, (to_points, to_planes) = summary_of(direction, cells), direction.distances
    values = {"d1_mse": to_points**2, "d2_mse": to_planes**2, "mean_distance": to_points}
    values |= {within_key(t): (to_points <= t).astype(float) for t in THRESHOLDS}
    assert found.means.keys() == values.keys()
    grid = voxels.cells(direction.points, 1.0, np.zeros(3))
    for name, quantity in found.means.items():
        assert quantity.mean == values[name].mean()
        np.testing.assert_allclose(quantity.sums.sum(), values[name].sum(), rtol=1e-12)
        first = direction.cells == direction.cells[0]
        np.testing.assert_allclose(quantity.sums[direction.cells[0]], values[name][first].sum(), rtol=1e-12)
    for name, mean in found.area_weighted.items():
        assert mean == metrics.area_weighted_mean(values[name], grid)
    assert found.count == 4000 and found.cell_counts.sum() == 4000 and len(found.cell_counts) == cells.number
    assert found.extremes.largest == to_points.max()
    np.testing.assert_array_equal(found.extremes.worst_point, direction.points[to_points.argmax()] + 100)
    assert found.spreads["plane_distance"].median == np.median(to_planes)
    assert found.d2_sample is None


def test_without_planes_there_is_no_d2():
    direction, cells = directions(500, planes=False)
    found = summary_of(direction, cells)
    assert "d2_mse" not in found.means and "d2_mse" not in found.area_weighted
    assert found.spreads.keys() == {"distance"}
    assert measure(found, found, THRESHOLDS, cells=cells).metrics.d2_mse.accuracy.value is None


def test_a_sample_of_planes_has_no_area_weighted_mean():
    direction, cells = directions(150_000, tolerance=0.1)
    sample = direction.distances.to_planes
    assert isinstance(sample, PlaneSample)
    found = summary_of(direction, cells)
    assert found.area_weighted["d2_mse"] is None
    assert found.means["d2_mse"].mean == pytest.approx(sample.mean_square, rel=1e-12)
    assert found.d2_sample == SampledMean(len(sample.rows), sample.half_width)


def test_metrics_follow_from_two_summaries():
    (direction, cells), (other, _) = directions(3000), directions(3000)
    other = other._replace(distances=Distances(2 * other.distances.to_points, other.distances.to_planes))
    forth, back = summary_of(direction, cells), summary_of(other, cells)
    found = measure(forth, back, THRESHOLDS, cells=cells).metrics
    assert found.d1_mse.accuracy.value == forth.means["d1_mse"].mean
    assert found.d1_mse.completeness.value == back.means["d1_mse"].mean
    assert found.d1_mse.symmetric_max.value == back.means["d1_mse"].mean
    assert found.d1_mse.completeness.area_weighted == back.area_weighted["d1_mse"]
    assert found.chamfer.sum_unsquared.value == forth.means["mean_distance"].mean + back.means["mean_distance"].mean
    assert [s.precision.value for s in found.fscores] == [forth.means[within_key(t)].mean for t in THRESHOLDS]
    assert found.hausdorff.symmetric_max == back.extremes.largest
    assert found.spreads["distance"].completeness is back.spreads["distance"]
