"""Polygons from files: formats that agree, and every refusal."""

import json
from dataclasses import replace

import numpy as np
import pytest
from data_folder import data_folder
from hypothesis import given, settings
from hypothesis import strategies as st
from polygon_rings import BESIDE, HOLE, SQUARE
from wording import refused

from pcbench import Cloud, parse_region
from pcbench.errors import InputError
from pcbench.geometry.polygon_files import read_polygon
from pcbench.geometry.regions import Polygon, Union

unhurried = settings(deadline=None)  # a busy machine is no failure
CLOUD = Cloud(np.random.default_rng(0).normal(size=(500, 3)))


def points(*rows):
    return np.array(rows, dtype=float)


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


def test_several_polygons_are_a_union(tmp_path):
    (tmp_path / "two.json").write_text(json.dumps(geojson("MultiPolygon", [[SQUARE], [BESIDE]])))
    region = parse_region(f"polygon:{tmp_path / 'two.json'}", CLOUD)
    assert isinstance(region, Union)
    assert region.contains(points([1, 1, 0], [5, 1, 0], [7, 1, 0])).tolist() == [1, 0, 1]
    assert region.text == f"polygon:{tmp_path / 'two.json'}"


def test_the_text_of_a_polygon_is_its_file(tmp_path):
    (tmp_path / "p.wkt").write_text("POLYGON((0 0,4 0,4 4))")
    region = read_polygon(tmp_path / "p.wkt")
    assert region.text == f"polygon:{tmp_path / 'p.wkt'}"
    # What is made of it is not what the file says.
    assert replace(region, lower=1).text == "polygon of 3 vertices in xy, z from 1 to inf"
    assert region.shifted(np.ones(3)).text == "polygon of 3 vertices in xy"


# Refusals


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


def test_refused_endless_file():
    with refused():
        read_polygon("/dev/zero")


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
