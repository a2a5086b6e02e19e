"""The tiles of `report.html` without a browser: their values, their words, and what is left out."""

from dataclasses import replace

import numpy as np
import pytest
import shapes
from html_pages import HOSTILE, PROVENANCE, Page

from pcbench import Cloud, Settings, compare
from pcbench.measure.deviation import DeviationMap
from pcbench.report.html import layers as html_layers
from pcbench.report.html import page
from pcbench.report.html.tiles import tile_maps
from pcbench.report.plot.views import scene_axes
from pcbench.report.viewing import ViewingCameras


@pytest.fixture(scope="module")
def comparison():
    """Compare two clouds, the second raised by 0.3 in a corner."""
    points = shapes.terrain(4000, seed=1)[0] + [500_000, 5_000_000, 100]
    rng = np.random.default_rng(2)
    a, b = (points + rng.normal(0, 0.02, points.shape) for _ in range(2))
    b[(b[:, :2] < [500_005, 5_000_005]).all(axis=1), 2] += 0.3
    return compare(Cloud(points, unit="m"), {"a": Cloud(a), "b": Cloud(b)}, Settings("none", deformation=False))


def with_deviation(comparison, map_):
    first, *others = comparison.candidates
    return replace(comparison, candidates=(replace(first, deviation=map_), *others))


def words_of(text):
    return " ".join("".join(Page(text).words).split())


def test_tiles_summarise_all_points_although_few_are_shown(comparison, monkeypatch):
    full = tile_maps(comparison)
    monkeypatch.setattr(html_layers, "MAX_BYTES", 10_000)
    text = page(comparison, PROVENANCE)
    parsed = Page(text)
    assert sum(head["shown"] for head in parsed.view["layers"]) < 2000
    assert all(f"<title>{tile.text}</title>" in text for tile in full.tiles)
    assert np.allclose(np.reshape(parsed.view["tiles"]["at"], (-1, 3)), [tile.statistics.at for tile in full.tiles])


def test_the_worst_tile_is_where_the_cloud_is_off(comparison):
    maps = tile_maps(comparison)
    worst = maps.tiles[0]
    assert worst.candidate == "b" and worst.statistics.median == pytest.approx(0.3, abs=0.05)
    assert worst.statistics.at[:2] == (500_002.5, 5_000_002.5)
    map_ = comparison["b"].deviation
    inside = (np.abs(map_.points[:, :2] - worst.statistics.at[:2]) <= maps.grid.size / 2).all(axis=1)
    values = map_.scalars["plane_distance"][inside]
    assert worst.text == (
        f"{len(values):,} points, median {np.median(values):.3g} m,"
        f" NMAD {1.4826 * np.median(np.abs(values - np.median(values))):.3g} m,"
        f" 95th percentile {np.percentile(np.abs(values), 95):.3g} m"
    )
    assert worst.column == min(tile.column for tile in maps.tiles)
    assert worst.row == max(tile.row for tile in maps.tiles)  # y grows upwards


def test_tiles_are_round_and_few(comparison):
    for factor in (1e-3, 1, 7, 1e4):
        scaled = [replace(c, deviation=replace(c.deviation, points=factor * c.deviation.points)) for c in comparison]
        maps = tile_maps(replace(comparison, candidates=tuple(scaled)))
        leading = float(f"{maps.grid.size:e}".split("e")[0])
        assert round(leading, 6) in (1, 2, 5)
        assert 5 <= max(maps.grid.shape) <= 15


def test_all_points_are_counted(comparison):
    maps = tile_maps(comparison)
    assert sum(tile.statistics.count for tile in maps.tiles) + maps.sparse == 8000
    said = "points lie in them or outside the maps"
    assert (f"; {maps.sparse:,} {said}" in words_of(page(comparison, PROVENANCE))) == (maps.sparse > 1)


def test_without_surface_distances_tiles_show_those_to_points(comparison):
    map_ = comparison["a"].deviation
    unknown = {**map_.scalars, "plane_distance": np.full(len(map_.points), np.nan)}
    maps = tile_maps(with_deviation(comparison, DeviationMap(map_.points, map_.rows, unknown)))
    assert maps.quantity == "distances to the closest point" and not maps.scale.signed and maps.scale.low == 0


def test_small_and_empty_clouds_have_no_tiles(comparison):
    points = compare(np.zeros((1, 3)), np.ones((1, 3)), Settings(register="none"))
    assert tile_maps(points) is None
    text = page(points, PROVENANCE)
    assert "Tile by tile" not in text and Page(text).view["tiles"] is None
    map_ = comparison["a"].deviation
    none = DeviationMap(map_.points[:0], map_.rows[:0], {key: values[:0] for key, values in map_.scalars.items()})
    assert tile_maps(with_deviation(comparison, none)).candidates == ["b"]


def test_the_four_candidates_with_the_worst_tiles_have_maps(comparison):
    near, bumped = comparison
    many = [replace(near, name=f"candidate {k}") for k in range(5)] + [replace(bumped, name="bumped")]
    changed = replace(comparison, candidates=tuple(many), differences=())
    maps = tile_maps(changed)
    assert maps.candidates == ["candidate 0", "candidate 1", "candidate 2", "bumped"] and maps.omitted == 2
    assert maps.tiles[0].candidate == "bumped"
    assert "The maps show the 4 of 6 candidates with the worst tiles." in words_of(page(changed, PROVENANCE))


def test_equal_clouds_have_no_worst_tiles(comparison):
    map_ = comparison["a"].deviation
    zeros = {key: np.zeros(len(map_.points)) for key in map_.scalars}
    same = replace(comparison["a"], deviation=DeviationMap(map_.points, map_.rows, zeros))
    alone = replace(comparison, candidates=(same,), differences=())
    maps = tile_maps(alone)
    assert maps.ranked == 0 and len(maps.tiles) > 4
    said = words_of(page(alone, PROVENANCE))
    assert "All distances are within rounding, so no tile is worse than others." in said
    assert f"All {len(maps.tiles)} tiles" in said


def test_numbers_on_tiles_are_readable(comparison):
    def luminance(color):
        return np.array([int(color[k : k + 2], 16) for k in (1, 3, 5)]) @ [0.299, 0.587, 0.114]

    for tile in tile_maps(comparison).tiles:
        assert abs(luminance(tile.color) - {"#000": 0, "#fff": 255}[tile.ink]) > 110


@pytest.mark.parametrize("angle_deg", [30, pytest.param(160, marks=pytest.mark.long)])
def test_a_wall_is_mapped_along_its_own_axes(angle_deg):
    rng = np.random.default_rng(3)
    along, height = rng.uniform(0, 20, 6000), rng.uniform(0, 8, 6000)
    turn = np.radians(angle_deg)
    rows = np.array([[np.cos(turn), np.sin(turn), 0], [0, 0, 1], [np.sin(turn), -np.cos(turn), 0]])
    flat = np.column_stack([along, height, rng.normal(0, 0.01, len(along))])
    wall = flat @ rows + [446_123, 5_380_456, 410]
    flat[(along > 14) & (height > 6), 2] += 0.2
    found = compare(wall, {"a": flat @ rows + [446_123, 5_380_456, 410]}, Settings(register="none", crop="none"))
    maps = tile_maps(found, axes=scene_axes(wall))
    assert maps.axes == ("along", "height") and maps.size == "2"
    assert len(maps.tiles) >= 40  # not only those along a diagonal
    worst = found["a"].deviation.points[found["a"].deviation.scalars["distance"] > 0.15].mean(axis=0)
    place = np.reshape(maps.data()["at"], (-1, 3))[0]
    assert np.abs(place - worst).max() < 3


def test_the_axes_of_tilted_cameras_are_used(comparison):
    """Clouds of photographs, whose y axis points down, are mapped from above and not along y."""
    turn = np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]])
    cameras = ViewingCameras(np.zeros((1, 3)), np.array([[0.0, 0.8, 0.6]]), np.array([0.0, -1, 0]))
    turned = tuple(
        replace(c, deviation=replace(c.deviation, points=c.deviation.points @ turn.T)) for c in comparison.candidates
    )
    axes = scene_axes(turned[0].deviation.points, cameras)
    maps = tile_maps(replace(comparison, candidates=turned), axes=axes)
    assert maps.axes == ("right", "forward") and not axes.is_wall
    assert len(maps.tiles) == len(tile_maps(comparison).tiles)


def test_names_with_markup_are_text(comparison):
    hostile = replace(comparison["b"], name=HOSTILE + "\u202e")
    text = page(replace(comparison, candidates=(hostile, comparison["a"]), differences=()), PROVENANCE)
    plain = Page(page(comparison, PROVENANCE))
    assert Page(text).tags.count("img") == 0 and Page(text).unbalanced == plain.unbalanced == []


def test_the_same_tiles_have_the_same_colors(comparison):
    same = replace(comparison["b"], name="same")
    maps = tile_maps(replace(comparison, candidates=(comparison["b"], same), differences=()))
    (_, first), (_, second) = maps.maps
    colors = [{tile.statistics.tile: tile.color for _, tile in tiles} for tiles in (first, second)]
    assert colors[0] == colors[1] and len(set(colors[0].values())) > 3
    assert max(abs(tile.statistics.median) for tile in maps.tiles) == pytest.approx(maps.scale.high)


def test_names_that_print_alike_have_maps_of_their_own(comparison):
    alike = tuple(replace(c, name=f"a{mark}") for c, mark in zip(comparison, "\u202a\u202b", strict=False))
    maps = tile_maps(replace(comparison, candidates=alike, differences=()))
    assert [name for name, _ in maps.maps] == ["a?", "a?"]
    assert sum(len(tiles) for _, tiles in maps.maps) == len(maps.tiles)
