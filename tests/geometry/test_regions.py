"""Regions: known answers, an independent point-in-polygon, far coordinates, and every refusal."""

import json

import numpy as np
import pytest
from data_folder import data_folder
from hypothesis import given, settings
from hypothesis import strategies as st

from pcbench.errors import InputError
from pcbench.geometry.cloud import Cloud
from pcbench.geometry.regions import Box, Polygon, Sphere, Union, parse_region, read_polygon, sphere_about

unhurried = settings(deadline=None)  # a busy machine is no failure
UTM = np.array([512_345.678, 5_612_345.678, 123.456])
SQUARE = [[0, 0], [4, 0], [4, 4], [0, 4], [0, 0]]
HOLE = [[1, 1], [1, 3], [3, 3], [3, 1], [1, 1]]
BESIDE = [[6, 0], [8, 0], [8, 2], [6, 2], [6, 0]]
CLOUD = Cloud(np.random.default_rng(0).normal(size=(500, 3)))


def points(*rows):
    return np.array(rows, dtype=float)


# Known answers


def test_box_is_closed():
    box = parse_region("box:0,0,0,1,2,3", CLOUD)
    inside = box.contains(points([0, 0, 0], [1, 2, 3], [0.5, 1, 1], [1.1, 1, 1], [0.5, -0.1, 1], [0.5, 1, 3.1]))
    assert inside.tolist() == [True, True, True, False, False, False]
    assert inside.dtype == bool
    assert str(box) == "box with x from 0 to 1, y from 0 to 2, z from 0 to 3"


def test_sphere_is_closed():
    sphere = parse_region(" Sphere: 1, 2, 3, 2.5 ", CLOUD)
    assert sphere.contains(points([1, 2, 3], [3.5, 2, 3], [3.51, 2, 3], [2.5, 4, 3])).tolist() == [1, 1, 0, 1]
    assert str(sphere) == "sphere of radius 2.5 about (1, 2, 3)"


def test_polygon_with_hole_and_second_part():
    polygon = Polygon((SQUARE, HOLE, BESIDE), lower=0, upper=1)
    rows = [[0.5, 0.5, 0], [2, 2, 0], [7, 1, 1], [5, 1, 0], [0.5, 0.5, 1.1], [0.5, 0.5, -0.1]]
    assert polygon.contains(points(*rows)).tolist() == [1, 0, 1, 0, 0, 0]
    assert str(polygon) == "polygon of 12 vertices in xy, 3 rings, z from 0 to 1"
    assert str(Polygon((SQUARE,))) == "polygon of 4 vertices in xy"


@pytest.mark.parametrize("ring", [SQUARE, SQUARE[::-1], SQUARE[:-1], [v for v in SQUARE for _ in range(3)]])
def test_border_and_vertices_are_inside(ring):
    border = [[x, y, 0] for x in range(5) for y in range(5) if x in (0, 4) or y in (0, 4)]
    assert Polygon((ring,)).contains(points(*border)).all()
    hole = [[x, y, 0] for x in range(1, 4) for y in range(1, 4) if (x, y) != (2, 2)]
    assert Polygon((ring, HOLE)).contains(points(*hole)).all()


def test_level_with_vertices():
    # A diamond: the ray from a point at the height of its left and right tips runs through a vertex.
    diamond = Polygon(([[0, -1], [1, 0], [0, 1], [-1, 0]],))
    rows = [[0, 0, 0], [-2, 0, 0], [2, 0, 0], [-1, 1, 0], [-1, -1, 0], [0.5, 0.5, 0], [0.51, 0.5, 0]]
    assert diamond.contains(points(*rows)).tolist() == [1, 0, 0, 0, 0, 1, 0]


@pytest.mark.parametrize("axis", [0, 1, 2])
def test_axis_of_a_prism(axis):
    u, v = (other for other in range(3) if other != axis)
    rows = np.zeros((3, 3))
    rows[:, u], rows[:, v], rows[:, axis] = [3.5, 0.5, 3.5], [0.5, 3.5, 0.5], [9, 9, 11]
    triangle = Polygon(([[0, 0], [4, 0], [4, 4]],), axis=axis, lower=8, upper=10)
    assert triangle.contains(rows).tolist() == [True, False, False]


def test_overlapping_polygons_are_united(tmp_path):
    squares = [[[[x, 0], [x + 4, 0], [x + 4, 4], [x, 4], [x, 0]]] for x in (0, 2)]
    (tmp_path / "two.json").write_text(json.dumps({"type": "MultiPolygon", "coordinates": squares}))
    region = parse_region(f"polygon:{tmp_path / 'two.json'}", CLOUD)
    assert isinstance(region, Union)
    assert region.contains(points([1, 1, 0], [3, 1, 0], [5, 1, 0], [7, 1, 0])).tolist() == [1, 1, 1, 0]
    assert str(region) == "polygon of 4 vertices in xy and polygon of 4 vertices in xy"
    assert str(Union((region,) * 4)).startswith("4 regions, the first a polygon")


def test_reference_and_none():
    assert parse_region("none", CLOUD) is None
    box = parse_region("REFERENCE", CLOUD)
    assert box.contains(CLOUD.points).all()
    assert not box.contains(CLOUD.points + np.ptp(CLOUD.points, axis=0) * 1.01).any()


@pytest.mark.parametrize("quantile", [0.25, 0.99, 1])
def test_quantile_holds_its_share(quantile):
    for offset in (0, UTM):
        cloud = Cloud(CLOUD.points + offset)
        region = parse_region(f"quantile:{quantile}", cloud)
        assert region.contains(cloud.points).mean() == pytest.approx(quantile, abs=1 / len(cloud))
        assert region.shifted(UTM).contains(cloud.points - UTM).mean() == pytest.approx(quantile, abs=1 / len(cloud))


def test_quantile_centre_ignores_stragglers():
    stray = np.vstack([CLOUD.points, np.full((20, 3), 1e6)])
    assert np.linalg.norm(sphere_about(stray, 0.9).center) < 0.3  # median of 500 standard normals +- 0.06 each
    assert sphere_about(stray, 0.9).radius < 5


# Files


def geojson(kind, coordinates):
    return {"type": kind, "coordinates": coordinates}


def feature(geometry):
    return {"type": "Feature", "properties": {"name": "x"}, "geometry": geometry}


THREE = [[*map(float, v), 7.0] for v in SQUARE]
MULTI = geojson("MultiPolygon", [[SQUARE, HOLE], [BESIDE]])
SAME_REGION = {
    "multi.json": json.dumps(MULTI),
    "bom.json": "\ufeff" + json.dumps(MULTI),
    "feature.json": json.dumps(feature(MULTI)),
    "collection.json": json.dumps(
        {
            "type": "FeatureCollection",
            "features": [feature(geojson("Polygon", [THREE, HOLE])), feature(geojson("Polygon", [BESIDE]))],
        }
    ),
    "plain.wkt": "MULTIPOLYGON (((0 0,4 0,4 4,0 4,0 0),(1 1,1 3,3 3,3 1,1 1)),((6 0,8 0,8 2,6 2,6 0)))\n",
    "z.wkt": "SRID=25832; multipolygon z(((0 0 9, 4 0 9, 4e0 4 9, 0 4 9, 0 0 9), (1 1 9, 1 3 9, 3 3 9, 3 1 9))"
    " , \n ((6 0 9, 8 0 9, 8 2 9, 6 2 9)));",
}


@pytest.mark.parametrize("name", SAME_REGION)
def test_formats_agree(tmp_path, name):
    (tmp_path / name).write_text(SAME_REGION[name], encoding="utf-8")
    region = read_polygon(tmp_path / name)
    rows = points([0.5, 0.5, 0], [2, 2, 50], [7, 1, -50], [5, 1, 0], [7, 3, 0])
    assert region.contains(rows).tolist() == [True, False, True, False, False]


@pytest.mark.parametrize(
    "text", ["POLYGON((0 0,4 0,4 4))", "POLYGONZ ((0 0 1,4 0 1,4 4 1))", "polygon zm((0 0 1 1,4 0 1 1,4 4 1 1))"]
)
def test_wkt_polygon(tmp_path, text):
    (tmp_path / "p.wkt").write_text(text)
    region = read_polygon(tmp_path / "p.wkt")
    assert isinstance(region, Polygon)
    assert region.rings[0].tolist() == [[0, 0], [4, 0], [4, 4]]


def volume(**changes):
    # Open3D writes the polygon's coordinate along the axis as 0.
    content = {
        "class_name": "SelectionPolygonVolume",
        "orthogonal_axis": "Y",
        "axis_min": -1.5,
        "axis_max": 2.5,
        "bounding_polygon": [[0, 0, 0], [4, 0, 0], [4, 0, 4]],
        "version_major": 1,
        "version_minor": 0,
    }
    return {**content, **changes}


def test_selection_volume(tmp_path):
    (tmp_path / "barn.json").write_text(json.dumps(volume()))
    region = parse_region(f"polygon:{tmp_path / 'barn.json'}", CLOUD)
    rows = points([3.5, 0, 0.5], [0.5, 0, 3.5], [3.5, -1.5, 0.5], [3.5, 2.6, 0.5])
    assert region.contains(rows).tolist() == [True, False, True, False]
    assert str(region) == "polygon of 3 vertices in xz, y from -1.5 to 2.5"


def test_autzen_selection():
    region = parse_region(f"polygon:{data_folder('autzen') / 'autzen-selection.json'}", CLOUD)
    rings = [[636758.0, 850667.0], [637000.0, 851000.0], [636539.2, 851056.6], [636540.0, 850500.0]]
    inside = region.contains(np.column_stack([rings, np.zeros(4)]))
    # A corner moved outwards, the middle, a corner moved outwards, and the box's empty corner.
    assert inside.tolist() == [False, True, True, False]
    assert len(region.rings[0]) == 18


# Oracle


def slow_inside(point, rings):
    """The angle that each ring turns about the point, summed edge by edge: odd number of turns in all is inside."""
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
def test_against_winding_numbers(seed, offset):
    generator = np.random.default_rng(seed)
    # Enough vertices that no gap between directions exceeds half a turn: holes stay within, parts apart.
    outer, hole, island = (star(generator, 25, *radii, offset) for radii in ((0.6, 1), (0.3, 0.4), (0.1, 0.2)))
    rings = (outer, hole[::-1], island, star(generator, 12, 0.2, 0.5, np.add(offset, [2.0, 0.3])))
    xy = generator.uniform(-1.1, 2.6, (400, 2)) + offset
    expected = [slow_inside(point, rings) for point in xy]
    assert 30 < sum(expected) < 370
    got = Polygon(rings).contains(np.column_stack([xy, np.zeros(400)]))
    assert got.tolist() == expected


def test_chunks_do_not_show(monkeypatch):
    generator = np.random.default_rng(5)
    ring, xyz = star(generator, 30, 0.3, 1, (0, 0)), generator.uniform(-1, 1, (1000, 3))
    whole = Polygon((ring,)).contains(xyz)
    monkeypatch.setattr("pcbench.geometry.regions._CHUNK", 7)
    assert (Polygon((ring,)).contains(xyz) == whole).all()


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
def test_shift_is_invisible(region):
    xyz = np.random.default_rng(2).uniform(-0.2, 1.2, (5000, 3))
    expected = region.contains(xyz)
    assert 0 < expected.sum() < 5000
    far = region.shifted(-UTM)
    # Coordinates at 5.6e6 round to 1e-9; none of the 5000 points lies that near to a border.
    assert (far.contains(xyz + UTM) == expected).all()
    assert (far.shifted(UTM).contains(xyz) == expected).all()
    assert (region.contains(xyz) == expected).all()


def test_nothing_in_nothing():
    for region in (Box([0, 0, 0], [1, 1, 1]), Sphere([0, 0, 0], 1), Polygon((SQUARE,)), Union(())):
        assert region.contains(np.empty((0, 3))).shape == (0,)
        assert not region.contains(points([50, 50, 50])).any()


# Refusals


KNOWN = "none, box:xmin,ymin,zmin,xmax,ymax,zmax, sphere:x,y,z,r, polygon:FILE, reference or quantile:q"


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", f"region '': expected {KNOWN}"),
        ("cube:1", f"region 'cube:1': expected {KNOWN}"),
        ("none:1", "expected 'none' alone"),
        ("reference:", "expected 'reference' alone"),
        ("polygon:", "expected polygon:FILE, got no file name"),
        ("polygon", "expected polygon:FILE, got no file name"),
        ("box:1,2,3", "region 'box:1,2,3': expected 6 numbers (xmin,ymin,zmin,xmax,ymax,zmax), got 3"),
        ("box", "expected 6 numbers (xmin,ymin,zmin,xmax,ymax,zmax), got 0"),
        ("box:1,2,3,4,5,x", "expected finite numbers (xmin,ymin,zmin,xmax,ymax,zmax), got 'x'"),
        ("box:1,2,3,4,5,nan", "got 'nan'"),
        ("box:1,2,3,4,5,inf", "got 'inf'"),
        ("box:1,2,3,4,5,1e200", "got '1e200'"),
        ("box:1,2,3,4,1,6", "expected a box with lower <= upper, got y from 2 to 1"),
        ("sphere:1,2,3", "expected 4 numbers (x,y,z,r), got 3"),
        ("sphere:1,2,3,", "expected finite numbers (x,y,z,r), got ''"),
        ("sphere:1,2,3,0", "expected a sphere with a positive, finite radius, got 0"),
        ("sphere:1,2,3,-1", "got -1"),
        ("quantile:", "expected 1 number (q), got 0"),
        ("quantile:0", "expected a quantile in (0, 1], such as 0.99, got 0"),
        ("quantile:1.01", "expected a quantile in (0, 1], such as 0.99, got 1.01"),
        ("quantile:99%", "expected finite numbers (q), got '99%'"),
        ("polygon:/nowhere/a.json", "/nowhere/a.json: cannot read a polygon: No such file or directory"),
        ("polygon:/", "/: cannot read a polygon: Is a directory"),
        ("polygon:a\0b", "cannot read a polygon"),
    ],
)
def test_refused_texts(text, message):
    with pytest.raises(InputError) as caught:
        parse_region(text, CLOUD)
    assert message in str(caught.value)
    assert "\n" not in str(caught.value)


def test_refused_quantile_of_one_place():
    with pytest.raises(InputError, match="all in one place"):
        parse_region("quantile:0.5", Cloud(np.vstack([np.zeros((9, 3)), np.ones((1, 3))])))


EXPECTED = "expected a polygon as GeoJSON, WKT or SelectionPolygonVolume, got "


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (b"", EXPECTED + "an empty file"),
        (b" \n", EXPECTED + "an empty file"),
        (b"\x93\xff\x00\x01", EXPECTED + "a binary file"),
        (b"\x00" * 100, EXPECTED + "a text that starts with '\\x00"),
        (b"ply\nformat ascii", EXPECTED + "a text that starts with 'ply\\nformat ascii'"),
        (b'{"type": ', EXPECTED + "invalid JSON: Expecting value"),
        (b"[" * 200_000, EXPECTED + "JSON that is nested too deeply"),
        (b'{"a":' * 200_000, EXPECTED + "JSON that is nested too deeply"),
        (b"[1, 2]", EXPECTED + "a JSON list instead of an object"),
        (b'{"type": "Polygon", "coordinates": ' + b"9" * 5000 + b"}", EXPECTED + "invalid JSON: Exceeds the limit"),
        ({}, "expected GeoJSON of type Polygon, MultiPolygon, Feature or FeatureCollection, got null"),
        (geojson("Point", [1, 2]), "got 'Point'"),
        (geojson(["Polygon"], [SQUARE]), "got a list of 1"),
        (feature(None), "FeatureCollection, got null"),
        (feature(feature(MULTI)), "FeatureCollection, got 'Feature'"),
        ({"type": "FeatureCollection"}, "expected features as a list, got null"),
        ({"type": "FeatureCollection", "features": []}, "expected at least one polygon, got none"),
        ({"type": "FeatureCollection", "features": [3]}, "FeatureCollection, got 3"),
        (geojson("Polygon", None), "expected coordinates as a list, got null"),
        (geojson("Polygon", []), "expected a polygon with at least one ring, got none"),
        (geojson("Polygon", [[]]), "expected a ring of vertices, got none"),
        (geojson("Polygon", [[1, 2]]), "expected a vertex as a list, got 1"),
        (geojson("Polygon", [[[1]]]), "expected vertices of at least 2 numbers, got a list of 1"),
        (geojson("Polygon", [[[1, "2"]]]), "expected a coordinate as a finite number, got '2'"),
        (geojson("Polygon", [[[1, True]]]), "expected a coordinate as a finite number, got True"),
        (geojson("Polygon", [[[1, float("nan")]]]), "expected a coordinate as a finite number, got nan"),
        (geojson("Polygon", [[[1, 10**200]]]), "expected a coordinate as a finite number, got a number out of range"),
        (geojson("Polygon", [[[1, "x" * 99]]]), "..."),
        (
            geojson("Polygon", [[[0, 0], [1, 1], [0, 0], [1, 1], [0, 0]]]),
            "at least 3 distinct vertices in each ring, got 2",
        ),
        (geojson("MultiPolygon", [SQUARE]), "expected a vertex as a list, got 0"),
        (b"POLYGON EMPTY", "expected at least one polygon, got none"),
        (b"POLYGON (0 0, 1 0, 1 1)", "expected WKT of the form POLYGON ((x y, ...), (hole)), got brackets of another"),
        (b"POLYGON ((0 0, 1 0, 1 1)", "got brackets of another form"),
        (b"MULTIPOLYGON ((0 0, 1 0, 1 1))", "expected WKT of the form MULTIPOLYGON (((x y"),
        (b"POLYGON ((0 0, 1 0, 1 x))", "expected WKT vertices as numbers, got \"'x'\""),
        (b"POLYGON ((0 0, 1 0, nan 1))", "expected a coordinate as a finite number, got nan"),
        (b"POLYGON ((0 0, 1 0, 1))", "expected vertices of at least 2 numbers, got a list of 1"),
        (b"POLYGON ((0 0, 1 0))", "at least 3 distinct vertices in each ring, got 2"),
        (b"POLYGON ()", "got brackets of another form"),
        (b"POLYGON (())", "expected vertices of at least 2 numbers, got a list of 0"),
        (b"POLYGON " + b"(" * 100_000, "got brackets of another form"),
        (b"POLYGONS ((0 0, 1 0, 1 1))", EXPECTED + "a text that starts with 'POLYGONS"),
        (volume(class_name="Box"), "expected class_name SelectionPolygonVolume, got 'Box'"),
        ({"bounding_polygon": []}, "expected class_name SelectionPolygonVolume, got null"),
        (volume(orthogonal_axis="xy"), "expected orthogonal_axis X, Y or Z, got 'xy'"),
        (volume(orthogonal_axis=2), "expected orthogonal_axis X, Y or Z, got 2"),
        (volume(axis_min=None), "expected axis_min as a finite number, got null"),
        (volume(axis_max=float("inf")), "expected axis_max as a finite number, got inf"),
        (volume(axis_min=3), "expected a polygon with lower <= upper along y, got 3.0 and 2.5"),
        (volume(bounding_polygon=SQUARE), "expected vertices of at least 3 numbers, got a list of 2"),
        (volume(bounding_polygon=[]), "expected a ring of vertices, got none"),
        (volume(bounding_polygon=[[0, 0, 0], [4, 1, 0]]), "at least 3 distinct vertices in each ring, got 2"),
    ],
)
def test_refused_files(tmp_path, content, message):
    path = tmp_path / "p"
    path.write_bytes(content if isinstance(content, bytes) else json.dumps(content).encode())
    with pytest.raises(InputError) as caught:
        parse_region(f"polygon:{path}", CLOUD)
    assert str(caught.value).startswith(f"{path}: ")
    assert message in str(caught.value)
    assert "\n" not in str(caught.value)
    assert len(str(caught.value)) < len(str(path)) + 250


def test_refused_endless_file(monkeypatch):
    monkeypatch.setattr("pcbench.geometry.regions._FILE_BYTES", 1 << 20)
    with pytest.raises(InputError, match="got a file of more than 1 MiB"):
        read_polygon("/dev/zero")


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: Box([0, 0], [1, 1, 1]), "expected the lower corner as three finite numbers, got [0.0, 0.0]"),
        (lambda: Box([0, 0, 0], [1, 1, np.inf]), "expected the upper corner as three finite numbers"),
        (lambda: Sphere([0, 0, np.nan], 1), "expected the centre as three finite numbers"),
        (lambda: Sphere([0, 0, 0], np.nan), "expected a sphere with a positive, finite radius, got nan"),
        (lambda: Sphere([0, 0, 0], np.inf), "expected a sphere with a positive, finite radius, got inf"),
        (lambda: Polygon(()), "expected a polygon with at least one ring, got none"),
        (lambda: Polygon((np.zeros((4, 3)),)), "expected the ring of a polygon as (M, 2) finite numbers, got shape"),
        (lambda: Polygon((SQUARE,), axis=3), "expected the axis of a polygon as 0, 1 or 2, got 3"),
        (lambda: Polygon((SQUARE,), lower=np.nan), "expected a polygon with lower <= upper along z, got nan and inf"),
    ],
)
def test_refused_values(make, message):
    with pytest.raises(InputError) as caught:
        make()
    assert message in str(caught.value)


@unhurried
@given(st.text(max_size=30) | st.from_regex(r"(box|sphere|quantile|polygon):[-0-9.,e ]{0,30}", fullmatch=True))
def test_any_text_is_a_region_or_one_line(text):
    try:
        region = parse_region(text, CLOUD)
    except InputError as error:
        assert len(str(error).splitlines()) == 1 or "polygon" in text
    else:
        assert region is None or region.contains(CLOUD.points).shape == (500,)


json_like = st.recursive(
    st.none() | st.booleans() | st.floats() | st.integers() | st.sampled_from(["Polygon", "Feature", "X"]),
    lambda inner: (
        st.lists(inner, max_size=4)
        | st.dictionaries(st.sampled_from(["type", "coordinates", "geometry", "features", "class_name"]), inner)
    ),
)


@unhurried
@given(st.binary(max_size=60) | json_like.map(lambda value: json.dumps(value).encode()))
def test_any_file_is_a_region_or_one_line(tmp_path_factory, content):
    path = tmp_path_factory.getbasetemp() / "any"
    path.write_bytes(content)
    try:
        read_polygon(path)
    except InputError as error:
        assert len(str(error).splitlines()) == 1
