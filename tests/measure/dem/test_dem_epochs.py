"""The surveys of an area: what points cover, dates in names, common systems and grids, and profiles."""

from collections.abc import Sequence
from datetime import date
from pathlib import Path

import numpy as np
import pytest
from wording import check_error

from pcbench import write_cloud
from pcbench.geometry.cloud import Cloud
from pcbench.io.source import Source
from pcbench.measure.dem.difference import difference_of
from pcbench.measure.dem.epochs import (
    Coverage,
    Epoch,
    check_same_system,
    common_grid,
    date_of,
    epoch_surface,
    open_epoch,
)
from pcbench.measure.dem.grid import HeightGrid
from pcbench.measure.dem.profiles import profile_along
from pcbench.measure.dem.surface import EpochSurface, GridMethod


def _lattice(width: float, height: float, spacing: float) -> np.ndarray:
    """Return points at the centres of square cells from the origin."""
    x, y = np.meshgrid(np.arange(spacing / 2, width, spacing), np.arange(spacing / 2, height, spacing))
    return np.column_stack([x.ravel(), y.ravel(), 0 * x.ravel()])


def _covered(points: np.ndarray) -> float:
    coverage = Coverage()
    coverage.add(points)
    return coverage.area


def test_area_of_a_rectangle_and_of_an_l() -> None:
    points = _lattice(96, 64, 0.5)
    assert _covered(points) == 96 * 64
    # Its cells of 1 or 2 m divide the edges, so that no cell is covered in part.
    kept = (points[:, 0] < 32) | (points[:, 1] < 16)
    assert _covered(points[kept]) == 32 * 64 + 64 * 16


def test_area_of_random_points() -> None:
    rng = np.random.default_rng(0)
    points = rng.uniform(0, 1, (40_000, 3)) * [70, 30, 1]
    # Cells on the rim are covered in part: half a cell of at most 2 m along the outline of 200 m.
    assert 70 * 30 <= _covered(points) <= 72 * 32


@pytest.mark.parametrize("seed", range(4))
def test_coverage_does_not_depend_on_order_or_pieces(seed: int) -> None:
    rng = np.random.default_rng(seed)
    points = rng.normal(0, [900, 40, 3], (3000, 3)) + [5e5, 5.2e6, 100]
    whole, parts = Coverage(), Coverage()
    whole.add(points)
    for piece in np.split(rng.permutation(points), np.sort(rng.integers(0, len(points), 9))):
        parts.add(piece)
    assert parts.area == whole.area and parts.count == whole.count
    assert np.array_equal(parts.low, whole.low) and np.array_equal(parts.high, whole.high)


@pytest.mark.parametrize(
    ("name", "day"),
    [
        ("site_2023.laz", date(2023, 1, 1)),
        ("2023-05.las", date(2023, 5, 1)),
        ("site-2023-05-17.laz", date(2023, 5, 17)),
        ("flight_20230517_a.laz", date(2023, 5, 17)),
        ("site.laz", None),
        ("tile_12023.laz", None),
        ("2019_to_2023.laz", None),
        ("site_2023-02-30.laz", None),
    ],
)
def test_dates_in_names(name: str, day: date | None) -> None:
    assert date_of(name) == day


def _epoch(path: Path, points: np.ndarray, crs: str | None = None, unit: str | None = None) -> Epoch:
    write_cloud(path, Cloud(points, crs=crs, unit=unit))
    return open_epoch(Source.open(path), path.stem, None)


def _pair(folder: Path, systems: Sequence[tuple[str | None, str | None]], shift: float = 0.0) -> list[Epoch]:
    points = _lattice(8, 8, 0.25)
    clouds = [points, points + [shift, 0.0, 0.0]]
    return [
        _epoch(folder / f"e{k}.las", cloud, *system)
        for k, (cloud, system) in enumerate(zip(clouds, systems, strict=True))
    ]


def test_surveys_of_other_systems_units_or_places_are_refused(tmp_path: Path) -> None:
    pytest.importorskip("pyproj")
    metres = ("EPSG:32632", None)
    check_same_system(_pair(tmp_path, [metres, metres]))
    with check_error():
        check_same_system(_pair(tmp_path, [metres, ("EPSG:32633", None)]))
    with check_error():
        check_same_system(_pair(tmp_path, [metres, metres], shift=8.0))


def test_surveys_of_other_units_are_refused(tmp_path: Path) -> None:
    pytest.importorskip("pyproj")
    feet, metres = ("EPSG:2992", None), (None, "m")  # Oregon Lambert in feet
    points = _lattice(8, 8, 1.0)
    first = _epoch(tmp_path / "feet.las", points, *feet)
    second = _epoch(tmp_path / "metres.ply", points, *metres)
    with check_error():
        check_same_system([first, second])


def test_a_survey_of_two_units_is_refused(tmp_path: Path) -> None:
    pytest.importorskip("pyproj")
    with check_error():
        _epoch(tmp_path / "mixed.las", _lattice(8, 8, 1.0), "EPSG:2991+6360")  # places in m, heights in feet


def test_points_on_a_line_are_refused(tmp_path: Path) -> None:
    with check_error():
        _epoch(tmp_path / "line.ply", np.ones((5, 3)))


def test_grid_of_the_common_area(tmp_path: Path) -> None:
    pair = _pair(tmp_path, [(None, None)] * 2, shift=3.0)
    grid = common_grid(pair, 1.0, 1 << 30)
    assert (grid.west, grid.north, grid.shape) == (3.0, 8.0, (8, 5))
    assert common_grid(pair, None, 1 << 30).cell == 0.5  # four points per cell at 16 per square metre
    with check_error():
        common_grid(pair, 0.002, 300 << 20)
    # Cells become larger where they would not fit.
    assert common_grid(pair, None, (250 << 20) + 4000).cell == 2


def test_triangulation_that_does_not_fit_into_the_memory_is_refused(tmp_path: Path) -> None:
    epoch = _epoch(tmp_path / "e.ply", _lattice(8, 8, 1.0))
    with check_error():
        epoch_surface(epoch, common_grid([epoch, epoch], 1.0, 1 << 30), GridMethod.TIN, 1000)


def test_profile_of_a_plane() -> None:
    grid = HeightGrid.over(np.zeros(2), np.array([19.9, 5.9]), 1.0)
    x, y = grid.centres().T.reshape(2, *grid.shape)
    variances, counts = np.full(grid.shape, 1e-4), np.full(grid.shape, 5, np.int32)
    heights = [0.5 * x + 0.25 * y, 0.5 * x + 0.25 * y + 1.0]
    heights[1][3, 8] = np.nan
    surfaces = [EpochSurface(each, np.where(each == each, variances, np.nan), counts) for each in heights]
    difference = difference_of(grid, *surfaces)
    profile = profile_along((-2.25, 2.5, 17.75, 2.5), grid, surfaces, [difference])
    assert len(profile.distances) == 41 and profile.distances[-1] == pytest.approx(20)
    places = profile.distances - 2.25
    expected = np.where(places >= 0, 0.5 * (np.floor(places) + 0.5) + 0.25 * 2.5, np.nan)
    np.testing.assert_allclose(profile.heights[0], expected, atol=1e-12)
    is_void = np.floor(places) == 8
    np.testing.assert_allclose(profile.heights[1], np.where(is_void, np.nan, expected + 1), atol=1e-12)
    assert np.array_equal(np.isnan(profile.levels[0]), is_void | (places < 0))
    with check_error():
        profile_along((30, 30, 40, 40), grid, surfaces, [difference])
