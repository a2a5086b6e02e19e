"""The spacing of a cloud is that of its surfaces: copies of points, scan lines and densities do not change it."""

from functools import cache

import numpy as np
import pytest
from data_folder import data_folder
from sampled_surfaces import COPIES, KINDS, LINES, SIZE, sampled
from shapes import fibonacci_sphere, plane_grid
from wording import check_text

from pcbench import read_cloud
from pcbench.geometry.neighbors import Index
from pcbench.geometry.sampling import (
    PROFILE_NEIGHBORS,
    NeighborRange,
    Sampling,
    line_gaps,
    median_spacing,
    nearest_elsewhere,
    sampling_of,
    spacing_of_all,
)


@cache
def of(kind: str) -> Sampling:
    return sampling_of(Index(sampled(kind)))


@pytest.mark.parametrize("points", [sampled("strewn"), plane_grid(80), fibonacci_sphere(5000)[0]], ids=str)
def test_the_spacing_of_evenly_spread_points_is_the_median_distance_to_the_nearest(points):
    index = Index(points)
    nearest = index.nearest_other()
    assert sampling_of(index, nearest) == Sampling(np.median(nearest.distances))


@pytest.mark.parametrize("kind", COPIES)
def test_copies_do_not_change_the_spacing(kind):
    found = of(kind)
    # The medians of 2,500 to 5,000 points have standard errors of 1.3 %. Loose copies are partly other points.
    tolerance = 0.15 if kind == "twice, loosely" else 0.06
    assert found.spacing == pytest.approx(of("strewn").spacing, rel=tolerance) and not found.has_lines


@pytest.mark.parametrize(
    ("copies", "share", "apart"),
    [(1, 0.1, 1e-9), (1, 0.2, 1e-3), (1, 1, 0.1), (1, 1, 0.2), (2, 1, 1e-3), (2, 1, 0.1), (9, 1, 0), (9, 1, 1e-3)],
)
def test_copies_of_any_number_and_distance_do_not_change_the_spacing(copies, share, apart):
    rng = np.random.default_rng(0)
    points = sampled("strewn", 3_000)
    spacing = median_spacing(Index(points))
    copied = np.repeat(points[: int(share * len(points))], copies, axis=0)
    moved = copied + rng.normal(0, apart * spacing / np.sqrt(3), copied.shape)
    # Copies that are many and far apart are partly other points.
    tolerance = 0.3 if copies > 1 and apart >= 0.1 else 0.1
    assert median_spacing(Index(np.concatenate([points, moved]))) == pytest.approx(spacing, rel=tolerance)


@pytest.mark.parametrize("kind", LINES)
def test_the_spacing_of_scan_lines_is_that_of_as_many_strewn_points(kind):
    found = of(kind)
    # The last neighbours before the next line are the farthest for their number: a quarter farther than on average.
    assert found.has_lines
    assert found.spacing == pytest.approx(1.25 * of("strewn").spacing, rel=0.1)


def test_merged_strips_are_denser_and_dense_parts_count_by_their_points():
    strewn = of("strewn").spacing
    # Each strip has the points of the whole on two thirds of its area, and the middle third has two.
    assert 0.5 * strewn < of("strips").spacing < 0.8 * strewn and not of("strips").has_lines
    assert 0.1 * strewn < of("1:1000").spacing < strewn and not of("1:1000").has_lines


@pytest.mark.parametrize("kind", ["strewn", "twice", "lines 25:1"])
def test_the_spacing_says_what_it_is(kind):
    check_text(of(kind).definition)


@pytest.mark.parametrize("kind", KINDS)
def test_the_nearest_point_elsewhere_is_no_copy(kind):
    index, found = Index(sampled(kind)), of(kind)
    rows = np.arange(0, len(index), 7)
    nearest = nearest_elsewhere(index, found, rows)
    assert (nearest.distances > found.copy_radius).all()
    np.testing.assert_array_equal(
        nearest.distances, np.linalg.norm(index.points[nearest.indices] - index.points[rows], axis=1)
    )
    if kind == "strewn":
        np.testing.assert_array_equal(nearest.distances, index.nearest_other().distances[rows])


@pytest.mark.parametrize("kind", LINES)
def test_gaps_reach_from_line_to_line(kind):
    points = sampled(kind)
    lines = round(np.sqrt(8_000 / int(kind.split()[1].split(":")[0])))
    gaps = line_gaps(Index(points), points[::20])
    # On slopes, gaps are longer than on the map; some positions see parts of two lines.
    assert np.median(np.linalg.norm(gaps, axis=1)) == pytest.approx(SIZE / lines, rel=0.2)
    assert np.median(np.abs(gaps[:, 0]) / np.linalg.norm(gaps, axis=1)) > 0.8


@pytest.mark.parametrize("name", ["scans/vehicle0.xyz", "scans/webots1.xyz", "halves/mincut.pcd", "halves/samp11.pcd"])
def test_measured_clouds_keep_their_spacing_when_doubled(name):
    folder, file = name.split("/")
    points = read_cloud(data_folder(folder) / file, on_warning=lambda _: None).points
    points = points - points.mean(axis=0)
    single = median_spacing(Index(points))
    # Half of the points of webots1 occur twice already, and have three copies then: the spacing changes by 11 %.
    moved = points + np.random.default_rng(0).normal(0, 1e-3 * single, points.shape)
    assert median_spacing(Index(np.concatenate([points, moved]))) == pytest.approx(single, rel=0.15)


def clouds_with_copies_and_lines():
    rng = np.random.default_rng(0)
    strewn = rng.random((1500, 3)) * [40, 40, 0.01]
    # The next line is as far as the 60th neighbour in the same line.
    along = 0.05 * (np.tile(np.arange(300), 10) + rng.uniform(-0.2, 0.2, 3000))
    lines = np.column_stack([along, np.repeat(1.5 * np.arange(10), 300), np.zeros(3000)])
    return strewn, np.repeat(strewn[:300], 5, axis=0), np.concatenate([strewn, strewn + 1e-3]), lines, strewn[:30]


def test_farther_neighbors_than_those_that_are_searched_have_no_effect():
    for points in clouds_with_copies_and_lines():
        index = Index(points)
        every = index.query(points, min(1 + PROFILE_NEIGHBORS, len(points))).distances[:, 1:]
        assert sampling_of(index) == sampling_of(index, profile=every)


def test_the_spacing_of_all_points_follows_from_the_sampling():
    rng = np.random.default_rng(0)
    plane = rng.random((41_000, 3)) * [1, 1, 0]
    along = 0.2 * (np.tile(np.arange(1000), 41) + rng.uniform(-0.2, 0.2, 41_000))
    lines = np.column_stack([along, np.repeat(np.arange(41), 1000), np.zeros(41_000)])
    copies = np.concatenate([plane, plane + 1e-5]), np.repeat(plane[:5_000], 9, axis=0)
    for points in (*clouds_with_copies_and_lines(), plane, lines, *copies):
        index = Index(points)
        nearest_other = index.nearest_other()
        assert spacing_of_all(index, sampling_of(index), nearest_other) == median_spacing(index, nearest_other)


def test_the_range_of_neighbors_is_that_of_all_points():
    index = Index([[0.0, 0, 0], [1, 0, 0], [1, 0, 0], [4, 0, 0]])
    assert NeighborRange.within(index) == NeighborRange.of(index.nearest_other()) == (0.0, 3.0)
    assert NeighborRange.within(Index(np.zeros((1, 3)))) is NeighborRange.of(None) is None
