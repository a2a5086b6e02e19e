"""Points that stand for missing data: found in all kinds of files and in pieces, and nothing else is taken for them."""

import numpy as np
import pytest
from wording import check_text

from pcbench import read_cloud, write_cloud
from pcbench.geometry.cloud import Cloud
from pcbench.io.nodata import CoordinateCounts, Nodata, without_nodata
from pcbench.io.pieces import open_cloud, read_piece, reading_warnings


def terrain(count=4_000, low=100.0, seed=0, offset=(5e5, 5.6e6)):
    """Return hills between `low` and `low` + 60 on 200 x 200."""
    xy = np.random.default_rng(seed).uniform(0, 200, (count, 2))
    return np.column_stack([xy + offset, low + 30 * (1 + np.sin(xy[:, 0] / 40) * np.cos(xy[:, 1] / 30))])


def fill(points, value, axes=(2,), count=80):
    filled = points.copy()
    rows = np.random.default_rng(1).choice(len(points), count, replace=False)
    for axis in axes:
        filled[rows, axis] = value
    return filled


def found(points):
    return Nodata.of(CoordinateCounts.of(points))


FILL_VALUES = (
    *(-9999.0, -99999.0, -32768.0, -3.4028234663852886e38, -3.4e38, 1e30, 9999.0, 1e20, -9999.9, 32767.0),
    *(float(np.float32(-9999.9)), float(np.float32(1e30)), -9999.000000001, 0.0, -500.0, 7777.0),
)


@pytest.mark.parametrize("value", FILL_VALUES)
def test_fill_values_are_found_with_their_number(value):
    points = fill(terrain(low=900), value)
    nodata = found(points)
    assert [(axis, n) for axis, _, n in nodata.values] == [(2, 80)]
    assert nodata.values[0].value == pytest.approx(value, rel=1e-7)
    assert (nodata.mask(points) == (points[:, 2] == value)).all()


@pytest.mark.parametrize("value", [-9999.0, 1e30, -3.4e38])
def test_one_point_with_a_known_value_suffices(value):
    assert found(fill(terrain(), value, count=1)).mask(fill(terrain(), value, count=1)).sum() == 1


@pytest.mark.parametrize(
    ("points", "count"),
    [
        (fill(terrain(), -9999.0, axes=(0, 1, 2)), 80),
        (fill(terrain(), 0.0, axes=(0, 1, 2)), 80),
        (fill(terrain(), 0.0, axes=(0, 1), count=1), 1),
        (fill(fill(terrain(), -9999.0), 1e30, count=30), 80),  # some rows have both
        (fill(terrain() * [1, 1, 0], -32768.0), 80),
        (fill(np.where([True, True, False], terrain(), 3.0), -9999.0, count=3_000), 3_000),
        (np.concatenate([np.zeros((200, 3)), np.random.default_rng(0).normal(size=(1_000, 3))]), 200),
    ],
    ids=["all axes", "all axes 0", "x = y = 0", "two values", "on a plane", "most points", "in the midst"],
)
def test_other_kinds_are_found(points, count):
    nodata = found(points)
    assert nodata.mask(points).sum() == pytest.approx(count, abs=30 if len(nodata.values) == 2 else 0)
    check_text(nodata.text())


def flat_city(levels, ground=0.0):
    """Return a city seen from above: flat roofs of exact heights, and no walls."""
    xy = np.random.default_rng(2).uniform(0, 100, (5_000, 2))
    roofs = np.array(levels)[((xy[:, 0] // 10) % len(levels)).astype(int)]
    return np.column_stack([xy, np.where((xy[:, 0] % 10 < 4) & (xy[:, 1] % 20 < 12), roofs, ground)])


def water():
    points = terrain(low=-20)
    return np.column_stack([points[:, :2], np.maximum(points[:, 2], 0)])


GRID = np.stack(np.meshgrid(np.arange(60.0), np.arange(70.0)), axis=-1).reshape(-1, 2)


@pytest.mark.parametrize(
    "points",
    [
        water(),
        flat_city([10.0, 20.0, 25.0]),
        flat_city([20.0, 20.5]),
        np.column_stack([GRID, np.sin(GRID[:, 0])]),
        np.column_stack([9_990 + GRID, GRID[:, 0]]),
        np.vstack([terrain(), [5e5, 5.6e6, 8_000]]),
        np.vstack([terrain(), [[5e5, 5.6e6, -700], [5e5, 5.6e6, -701]]]),
        np.vstack([terrain(offset=(0, 0)), [0, 0, 120]]),
        np.vstack([flat_city([12.0]), np.column_stack([GRID[:300] / 60 + 50, np.full(300, 100.0)])]),
        np.round(terrain(), 1),
        np.zeros((500, 3)),
        np.full((3, 3), -9999.0),
        np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0]]),
    ],
    ids=[
        *("water", "flat roofs", "one level of roofs", "grid", "near a known value", "outlier", "two outliers"),
        *("corner", "tower", "decimetres", "origin", "nothing else", "triangle"),
    ],
)
def test_ordinary_points_are_none(points):
    assert not found(points)


@pytest.mark.parametrize("suffix", ["ply", "las", "pcd", "xyz", "csv", "npy"])
def test_files_are_read_with_a_warning_or_without_these_points(tmp_path, suffix):
    path, kept, removed = tmp_path / f"a.{suffix}", [], []
    write_cloud(path, fill(terrain(), -9999.0))
    assert len(read_cloud(path, on_warning=kept.append)) == 4_000
    assert "--drop-nodata" in check_text("\n".join(kept))
    clean = read_cloud(path, on_warning=removed.append, drop_nodata=True)
    assert len(clean) == 3_920
    assert clean.points[:, 2].min() > 90
    check_text("\n".join(removed))


def test_pieces_give_the_warning_of_the_cloud(tmp_path):
    """One piece has nothing but fill values, and each piece has other extremes."""
    points = fill(terrain(), -9999.0)
    points = points[np.argsort(points[:, 2], kind="stable")]
    write_cloud(tmp_path / "a.las", points)
    whole: list[str] = []
    read_cloud(tmp_path / "a.las", on_warning=whole.append)
    cloud = open_cloud(tmp_path / "a.las", piece_points=40)
    notes = [(piece, read_piece(cloud, piece).notes) for piece in cloud.pieces]
    assert [*cloud.warnings, *reading_warnings(cloud, notes)] == whole
    assert "80 of 4,000" in whole[-1]


def test_other_values_of_the_points_are_kept():
    points = fill(terrain(), -9999.0)
    cloud = without_nodata(Cloud(points, attributes={"row": np.arange(4_000)}))
    assert (points[cloud.attributes["row"]] == cloud.points).all()
