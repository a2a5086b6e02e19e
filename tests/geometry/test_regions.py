"""Regions: known answers, an independent point-in-polygon test, far coordinates, and their text."""

from dataclasses import replace

import numpy as np
import pytest
from polygon_rings import HOLE, SEPARATE_SQUARE, SQUARE
from shapes import UTM_DECIMAL as UTM
from wording import check_error, check_text

from pcbench import Cloud, parse_region
from pcbench.geometry.regions import Box, Polygon, Region, Sphere, Union

CLOUD = Cloud(np.random.default_rng(0).normal(size=(500, 3)))


def points(*rows):
    return np.array(rows, dtype=float)


# Known answers


def test_box_is_closed():
    box = Box([0, 0, 0], [1, 2, 3])
    inside = box.contains(points([0, 0, 0], [1, 2, 3], [0.5, 1, 1], [1.1, 1, 1], [0.5, -0.1, 1], [0.5, 1, 3.1]))
    assert inside.tolist() == [True, True, True, False, False, False]
    assert inside.dtype == bool
    check_text(box, masked=False)


def test_sphere_is_closed():
    sphere = Sphere([1, 2, 3], 2.5)
    assert sphere.contains(points([1, 2, 3], [3.5, 2, 3], [3.51, 2, 3], [2.5, 4, 3])).tolist() == [1, 1, 0, 1]
    check_text(sphere, masked=False)


def test_polygon_with_hole_and_second_part():
    polygon = Polygon((SQUARE, HOLE, SEPARATE_SQUARE), lower=0, upper=1)
    rows = [[0.5, 0.5, 0], [2, 2, 0], [7, 1, 1], [5, 1, 0], [0.5, 0.5, 1.1], [0.5, 0.5, -0.1]]
    assert polygon.contains(points(*rows)).tolist() == [1, 0, 1, 0, 0, 0]
    check_text(polygon, masked=False)
    check_text(Polygon((SQUARE,)), masked=False)


@pytest.mark.parametrize("ring", [SQUARE, SQUARE[::-1], SQUARE[:-1], [v for v in SQUARE for _ in range(3)]])
def test_border_and_vertices_are_inside(ring):
    border = [[x, y, 0] for x in range(5) for y in range(5) if x in (0, 4) or y in (0, 4)]
    assert Polygon((ring,)).contains(points(*border)).all()
    hole = [[x, y, 0] for x in range(1, 4) for y in range(1, 4) if (x, y) != (2, 2)]
    assert Polygon((ring, HOLE)).contains(points(*hole)).all()


def test_points_level_with_vertices():
    # A diamond: the ray from a point at the height of its left and right tips runs through a vertex.
    diamond = Polygon(([[0, -1], [1, 0], [0, 1], [-1, 0]],))
    rows = [[0, 0, 0], [-2, 0, 0], [2, 0, 0], [-1, 1, 0], [-1, -1, 0], [0.5, 0.5, 0], [0.51, 0.5, 0]]
    assert diamond.contains(points(*rows)).tolist() == [1, 0, 0, 0, 0, 1, 0]


@pytest.mark.parametrize("axis", [0, 1, 2])
def test_a_prism_extends_along_its_axis(axis):
    u, v = (other for other in range(3) if other != axis)
    rows = np.zeros((3, 3))
    rows[:, u], rows[:, v], rows[:, axis] = [3.5, 0.5, 3.5], [0.5, 3.5, 0.5], [9, 9, 11]
    triangle = Polygon(([[0, 0], [4, 0], [4, 4]],), axis=axis, lower=8, upper=10)
    assert triangle.contains(rows).tolist() == [True, False, False]


def test_one_ring_needs_no_list_of_rings():
    for vertices in (SQUARE, np.array(SQUARE), [np.array(vertex) for vertex in SQUARE], tuple(map(tuple, SQUARE))):
        polygon = Polygon(vertices, lower=0)
        assert [len(ring) for ring in polygon.rings] == [4]
        assert polygon.contains(points([1, 1, 1], [5, 1, 1], [1, 1, -1])).tolist() == [True, False, False]


def test_overlapping_polygons_are_united():
    region = Union(tuple(Polygon([[x, 0], [x + 4, 0], [x + 4, 4], [x, 4]]) for x in (0, 2)))
    assert region.contains(points([1, 1, 0], [3, 1, 0], [5, 1, 0], [7, 1, 0])).tolist() == [1, 1, 1, 0]
    check_text(region, masked=False)
    check_text(Union((region,) * 4), masked=False)


def test_bounding_box_contains_all_points():
    box = Box.around(CLOUD)
    assert box.contains(CLOUD.points).all()
    assert not box.contains(CLOUD.points + np.ptp(CLOUD.points, axis=0) * 1.01).any()
    assert box.text == Box.around(CLOUD.points).text


@pytest.mark.parametrize("quantile", [0.25, 0.99, 1])
def test_quantile_sphere_contains_its_share(quantile):
    for offset in (0, UTM):
        cloud = Cloud(CLOUD.points + offset)
        region = Sphere.around(cloud, quantile)
        assert region.contains(cloud.points).mean() == pytest.approx(quantile, abs=1 / len(cloud))
        assert region.shifted(UTM).contains(cloud.points - UTM).mean() == pytest.approx(quantile, abs=1 / len(cloud))


def test_quantile_centre_is_robust_to_outliers():
    outliers = np.vstack([CLOUD.points, np.full((20, 3), 1e6)])
    assert np.linalg.norm(Sphere.around(outliers, 0.9).center) < 0.3  # median of 500 standard normals +- 0.06 each
    assert Sphere.around(outliers, 0.9).radius < 5


def test_a_region_does_not_change_with_the_callers_array():
    corner, ring = np.zeros(3), np.array(SQUARE, dtype=float)
    box, polygon = Box(corner, [1, 1, 1]), Polygon(ring)
    corner += 5
    ring += 5
    assert box.lower.tolist() == [0, 0, 0]
    assert polygon.rings[0].min() == 0


# Text form


@pytest.mark.parametrize(
    ("region", "text", "representation"),
    [
        (Box([0, 0, 0], [1, 1, 1]), "box:0,0,0,1,1,1", "Box([0.0, 0.0, 0.0], [1.0, 1.0, 1.0])"),
        (Box(-UTM, UTM + 0.1), None, None),
        (Sphere([1e-7, -2, 3e20], 0.1), "sphere:1e-07,-2,3e+20,0.1", "Sphere([1e-07, -2.0, 3e+20], 0.1)"),
        (Sphere.around(CLOUD, 0.9), None, None),
    ],
    ids=["box", "far box", "sphere", "quantile"],
)
def test_text_round_trip(region, text, representation):
    parsed = parse_region(region.text, CLOUD)
    # Every float64 has a shortest decimal that reads back exactly.
    assert parsed.text == region.text
    assert repr(parsed) == repr(region)
    if text is not None:
        assert region.text == text
        assert repr(region) == representation


def test_a_polygon_without_a_file_is_described():
    polygon = Polygon(SQUARE, upper=2)
    assert polygon.text == check_text(polygon, masked=False)
    assert repr(polygon) == f"<{polygon}>"
    assert repr(Union((polygon,))) == repr(polygon)
    assert replace(polygon, upper=3).upper == 3


def test_regions_satisfy_the_protocol():
    assert all(isinstance(region, Region) for region in (Box.around(CLOUD), Union(())))
    assert not isinstance("box:0,0,0,1,1,1", Region)


# Oracle


def is_inside_by_winding(point, rings):
    """Whether the rings wind about the point an odd number of times; angles are summed over edges."""
    turns = 0
    for ring in rings:
        d = np.asarray(ring, dtype=float) - point
        e = np.roll(d, -1, axis=0)
        angles = np.arctan2(d[:, 0] * e[:, 1] - d[:, 1] * e[:, 0], (d * e).sum(axis=1))
        turns += round(angles.sum() / (2 * np.pi))
    return turns % 2 == 1


def star(generator, vertices, low, high, centre):
    """A random star-shaped ring: no edge crosses another, so winding and even-odd agree."""
    angles = np.sort(generator.uniform(0, 2 * np.pi, vertices))
    radii = generator.uniform(low, high, (vertices, 1))
    return np.asarray(centre) + radii * np.column_stack([np.cos(angles), np.sin(angles)])


@pytest.mark.parametrize("seed", range(20))
@pytest.mark.parametrize("offset", [(0, 0), UTM[:2]])
def test_polygons_agree_with_winding_numbers(seed, offset):
    generator = np.random.default_rng(seed)
    # Enough vertices that no gap between directions exceeds half a turn: holes stay inside, parts stay separate.
    outer, hole, island = (star(generator, 25, *radii, offset) for radii in ((0.6, 1), (0.3, 0.4), (0.1, 0.2)))
    rings = (outer, hole[::-1], island, star(generator, 12, 0.2, 0.5, np.add(offset, [2.0, 0.3])))
    xy = generator.uniform(-1.1, 2.6, (400, 2)) + offset
    expected = [is_inside_by_winding(point, rings) for point in xy]
    assert 30 < sum(expected) < 370
    got = Polygon(rings).contains(np.column_stack([xy, np.zeros(400)]))
    assert got.tolist() == expected


def test_chunk_size_does_not_matter(monkeypatch):
    generator = np.random.default_rng(5)
    ring, xyz = star(generator, 30, 0.3, 1, (0, 0)), generator.uniform(-1, 1, (1000, 3))
    expected = Polygon((ring,)).contains(xyz)
    monkeypatch.setattr("pcbench.geometry.regions._CHUNK_POINTS", 7)
    assert (Polygon((ring,)).contains(xyz) == expected).all()


@pytest.mark.parametrize(
    "region",
    [
        Box([0, 0, 0], [1, 1, 1]),
        Sphere([0.5, 0.5, 0.5], 0.4),
        Polygon(([[0, 0], [1, 0.1], [0.7, 1]],), axis=0, lower=0.2),
        Union((Polygon(([[0, 0], [1, 0.1], [0.7, 1]],), axis=1, upper=0.9), Sphere([1, 1, 1], 0.5))),
    ],
    ids=lambda region: type(region).__name__,
)
def test_shifted_regions_contain_the_same_points(region):
    xyz = np.random.default_rng(2).uniform(-0.2, 1.2, (5000, 3))
    expected = region.contains(xyz)
    assert 0 < expected.sum() < 5000
    shifted = region.shifted(-UTM)
    # Coordinates at 5.6e6 round to 1e-9; none of the 5000 points lies that close to a border.
    assert (shifted.contains(xyz + UTM) == expected).all()
    assert (shifted.shifted(UTM).contains(xyz) == expected).all()
    assert (region.contains(xyz) == expected).all()


def test_empty_and_distant_points_are_outside():
    for region in (Box([0, 0, 0], [1, 1, 1]), Sphere([0, 0, 0], 1), Polygon((SQUARE,)), Union(())):
        assert region.contains(np.empty((0, 3))).shape == (0,)
        assert not region.contains(points([50, 50, 50])).any()


# Refusals


@pytest.mark.parametrize(
    "make",
    [
        lambda: Box([0, 0], [1, 1, 1]),
        lambda: Box([0, 0, 0], [1, 1, np.inf]),
        lambda: Sphere([0, 0, np.nan], 1),
        lambda: Sphere([0, 0, 0], np.nan),
        lambda: Sphere([0, 0, 0], np.inf),
        lambda: Box("abc", [1, 1, 1]),
        lambda: Box([0, 0, [0]], [1, 1, 1]),
        lambda: Sphere([0, 0, 0], "one"),
        lambda: Sphere.around(CLOUD, 1.5),
        lambda: Union(["box"]),
        lambda: Polygon([[0, 0], [1]]),
        lambda: Polygon("square"),
        lambda: Polygon(None),
        lambda: Polygon(()),
        lambda: Polygon((np.zeros((4, 3)),)),
        lambda: Polygon((SQUARE,), axis=3),
        lambda: Polygon((SQUARE,), lower=np.nan),
    ],
)
def test_invalid_values_are_refused(make):
    with check_error():
        make()
