"""Normals and spacings of tiles equal those of the complete cloud in all bits."""

import numpy as np
import pytest
from hypothesis import Phase, given, settings
from hypothesis import strategies as st
from sampled_surfaces import sampled
from tiled_clouds import clouds_of_all_kinds, stored_tiles

from pcbench.geometry.neighbors import Index
from pcbench.geometry.normals import Surface
from pcbench.geometry.sampling import sampling_of, sampling_of_profile
from pcbench.measure.tiled import normals as tiled_normals
from pcbench.measure.tiled.normals import add_normals, add_wide_normals
from pcbench.tasks.results import write_result


def computed(folder, points, most, k, given_normals=None):
    """Normals (N, 3), surface variation (N,) and the sampling of a cloud in tiles."""
    tiles = stored_tiles(folder, points, most, piece_points=max(1, len(points) // 3), normals=given_normals)
    write_result(folder / "shared", str(folder), tiles)
    found, variation, spacings, profile = np.full((len(points), 3), 7.0), np.full(len(points), 7.0), [], []
    for number in tiles.occupied:
        histogram = add_normals(folder / "shared", str(folder), number, k)
        spacings.append(tiles.load(number, "spacings"))
        assert histogram.count == len(spacings[-1])
        profile.append(tiles.load(number, "profile"))
        rows = tiles.load(number, "rows")
        found[rows], variation[rows] = tiles.load(number, "normals"), tiles.load(number, "variation")
    nearest = np.median(np.concatenate(spacings)) if any(map(len, spacings)) else 0.0
    return found, variation, sampling_of_profile(nearest, np.concatenate(profile), len(points))


@settings(max_examples=6, deadline=None, phases=[Phase.explicit, Phase.generate])
@given(
    seed=st.integers(0, 2**32),
    count=st.integers(3, 500),
    kind=st.integers(0, 8),
    most=st.sampled_from([20, 100, 1000]),
    with_given=st.booleans(),
)
def test_normals_and_spacings_are_those_in_memory(tmp_path_factory, seed, count, kind, most, with_given):
    rng = np.random.default_rng(seed)
    points = list(clouds_of_all_kinds(rng, count))[kind][1]
    if len(points) < 3:
        return
    given_normals = None
    if with_given:
        given_normals = rng.integers(-9, 9, points.shape).astype(float)  # files have float32
        given_normals[rng.random(len(points)) < 0.3] = 0
    k = min(20, len(points))
    found, variation, sampling = computed(tmp_path_factory.mktemp("normals"), points, most, k, given_normals)
    surface = Surface(Index(points), k, given_normals)
    np.testing.assert_array_equal(found, surface.compute_normals(None))
    np.testing.assert_array_equal(variation, surface.variation(np.arange(len(points))))
    index = Index(points)
    assert sampling == sampling_of(index, index.nearest_other())


def test_wide_normals_are_those_in_memory(tmp_path):
    points = sampled("lines 25:1", 900)
    tiles = stored_tiles(tmp_path, points, 200, piece_points=300)
    write_result(tmp_path / "shared", "key", tiles)
    surface, found = Surface(Index(points), is_even=False), np.empty(points.shape)
    assert surface.k > 50
    for number in tiles.occupied:
        add_wide_normals(tmp_path / "shared", "key", number, surface.k)
        rows = tiles.load(number, "rows")
        found[rows] = tiles.load(number, "wide_normals")
        np.testing.assert_array_equal(tiles.load(number, "wide_variation"), surface.variation(rows))
    np.testing.assert_array_equal(found, surface.compute_normals(None))


def test_tiles_of_one_point_have_normals(tmp_path):
    points = np.random.default_rng(0).random((6, 3))
    found, *_ = computed(tmp_path, points, 1, 6)
    np.testing.assert_array_equal(found, Surface(Index(points), 6).compute_normals(None))


@pytest.fixture
def read_around(monkeypatch):
    """Number of points that each tile has read around itself."""
    counts = []
    read = tiled_normals._points_in_box

    def counted(*arguments, **options):
        points, rows = read(*arguments, **options)
        counts.append(len(points))
        return points, rows

    monkeypatch.setattr(tiled_normals, "_points_in_box", counted)
    return counts


def test_strewn_points_do_not_read_the_whole_cloud(tmp_path, read_around):
    """A tile of a few points far apart is large; its box overlaps many dense tiles."""
    rng = np.random.default_rng(0)
    dense = rng.random((60_000, 3)) * [10, 10, 0.01]
    strewn = rng.random((30, 3)) * [1000, 1000, 100]
    points = np.concatenate([dense, strewn])
    found, *_ = computed(tmp_path, points, 2000, 20)
    np.testing.assert_array_equal(found, Surface(Index(points), 20).compute_normals(None))
    assert max(read_around) < 25_000
