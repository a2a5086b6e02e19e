"""Polygon files: agreement between formats, and every refusal."""

import json
from dataclasses import replace

import numpy as np
import pytest
from data_folder import data_folder
from hypothesis import given, settings
from hypothesis import strategies as st
from optional import import_or_skip
from polygon_rings import HOLE, SEPARATE_SQUARE, SQUARE
from wording import check_error, check_text

from pcbench import Cloud, parse_region
from pcbench.errors import InputError
from pcbench.geometry.crs import unnamed_grid
from pcbench.geometry.polygon_files import read_polygon
from pcbench.geometry.region_text import as_region
from pcbench.geometry.regions import Polygon, Union

no_deadline = settings(deadline=None, max_examples=40)  # must not fail on a busy machine
CLOUD = Cloud(np.random.default_rng(0).normal(size=(500, 3)))


def points(*rows):
    return np.array(rows, dtype=float)


def geojson(kind, coordinates):
    return {"type": kind, "coordinates": coordinates}


def feature(geometry):
    return {"type": "Feature", "properties": {"name": "x"}, "geometry": geometry}


SQUARE_3D = [[*map(float, v), 7.0] for v in SQUARE]
MULTIPOLYGON = geojson("MultiPolygon", [[SQUARE, HOLE], [SEPARATE_SQUARE]])
SAME_REGION = {
    "multi.json": json.dumps(MULTIPOLYGON),
    "bom.json": "\ufeff" + json.dumps(MULTIPOLYGON),
    "feature.json": json.dumps(feature(MULTIPOLYGON)),
    "collection.json": json.dumps(
        {
            "type": "FeatureCollection",
            "features": [
                feature(geojson("Polygon", [SQUARE_3D, HOLE])),
                feature(geojson("Polygon", [SEPARATE_SQUARE])),
            ],
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
def test_wkt_polygons_are_read(tmp_path, text):
    (tmp_path / "p.wkt").write_text(text)
    region = read_polygon(tmp_path / "p.wkt")
    assert isinstance(region, Polygon)
    assert region.rings[0].tolist() == [[0, 0], [4, 0], [4, 4]]


def selection_volume(**changes):
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


def test_selection_volumes_are_read(tmp_path):
    (tmp_path / "barn.json").write_text(json.dumps(selection_volume()))
    region = parse_region(f"polygon:{tmp_path / 'barn.json'}", CLOUD)
    rows = points([3.5, 0, 0.5], [0.5, 0, 3.5], [3.5, -1.5, 0.5], [3.5, 2.6, 0.5])
    assert region.contains(rows).tolist() == [True, False, True, False]
    check_text(region, masked=False)


def test_autzen_selection():
    region = parse_region(f"polygon:{data_folder('autzen') / 'autzen-selection.json'}", CLOUD)
    corners = [[636758.0, 850667.0], [637000.0, 851000.0], [636539.2, 851056.6], [636540.0, 850500.0]]
    inside = region.contains(np.column_stack([corners, np.zeros(4)]))
    # Two corners moved outwards, the middle, and the empty corner of the bounding box.
    assert inside.tolist() == [False, True, True, False]
    assert len(region.rings[0]) == 18


def test_several_polygons_are_a_union(tmp_path):
    (tmp_path / "two.json").write_text(json.dumps(geojson("MultiPolygon", [[SQUARE], [SEPARATE_SQUARE]])))
    region = parse_region(f"polygon:{tmp_path / 'two.json'}", CLOUD)
    assert isinstance(region, Union)
    assert region.contains(points([1, 1, 0], [5, 1, 0], [7, 1, 0])).tolist() == [1, 0, 1]
    assert region.text == f"polygon:{tmp_path / 'two.json'}"


@pytest.mark.parametrize("stated", ["urn:ogc:def:crs:EPSG::32632", "EPSG:32633", "urn:ogc:def:crs:OGC:1.3:CRS84", None])
def test_another_coordinate_system_is_refused(tmp_path, stated):
    import_or_skip("pyproj")
    path = tmp_path / "p.geojson"
    crs = {} if stated is None else {"crs": {"type": "name", "properties": {"name": stated}}}
    path.write_text(json.dumps(crs | geojson("Polygon", [SQUARE])))
    cloud = Cloud(np.eye(3), crs="EPSG:32632+5783")
    if stated in (None, "urn:ogc:def:crs:EPSG::32632"):
        assert as_region(f"polygon:{path}", cloud) is not None
    else:
        for region in (f"polygon:{path}", read_polygon(path)):
            with check_error():
                as_region(region, cloud)
        assert as_region(f"polygon:{path}", CLOUD) is not None
    path.write_text("SRID=32633;POLYGON((0 0,4 0,4 4))")
    with check_error():
        as_region(f"polygon:{path}", cloud)


def test_longitudes_and_latitudes_beside_a_cloud_in_metres_are_refused(tmp_path):
    import_or_skip("pyproj")
    site = np.array([[500_000.0, 5_200_000.0, 300.0], [500_032.0, 5_200_020.0, 304.0]])
    path = tmp_path / "p.geojson"
    path.write_text(json.dumps(geojson("MultiPolygon", [[np.add([15.0, 46.95], np.array(SQUARE) * 1e-4).tolist()]])))
    for cloud in (Cloud(site, crs="EPSG:32633"), Cloud(site), Cloud(site, crs=unnamed_grid("ft", "m"))):
        with check_error():
            as_region(f"polygon:{path}", cloud)
    assert as_region(f"polygon:{path}", Cloud(site - site[0])) is not None  # near the origin, both may be metres
    path.write_text(json.dumps(geojson("Polygon", [SQUARE])))  # 4 by 4 are no degrees of one site
    assert as_region(f"polygon:{path}", Cloud(site)) is not None


def test_the_text_of_a_polygon_is_its_file(tmp_path):
    (tmp_path / "p.wkt").write_text("POLYGON((0 0,4 0,4 4))")
    region = read_polygon(tmp_path / "p.wkt")
    assert region.text == f"polygon:{tmp_path / 'p.wkt'}"
    # A modified copy no longer refers to the file.
    check_text(replace(region, lower=1).text, masked=False)
    check_text(region.shifted(np.ones(3)).text, masked=False)


# Refusals


@pytest.mark.parametrize(
    "content",
    [
        b"",
        b" \n",
        b"\x93\xff\x00\x01",
        b"\x00" * 100,
        b"ply\nformat ascii",
        b'{"type": ',
        b"[" * 200_000,
        b'{"a":' * 200_000,
        b"[1, 2]",
        b'{"type": "Polygon", "coordinates": ' + b"9" * 5000 + b"}",
        {},
        geojson("Point", [1, 2]),
        geojson(["Polygon"], [SQUARE]),
        feature(None),
        feature(feature(MULTIPOLYGON)),
        {"type": "FeatureCollection"},
        {"type": "FeatureCollection", "features": []},
        {"type": "FeatureCollection", "features": [3]},
        geojson("Polygon", None),
        geojson("Polygon", []),
        geojson("Polygon", [[]]),
        geojson("Polygon", [[1, 2]]),
        geojson("Polygon", [[[1]]]),
        geojson("Polygon", [[[1, "2"]]]),
        geojson("Polygon", [[[1, True]]]),
        geojson("Polygon", [[[1, float("nan")]]]),
        geojson("Polygon", [[[1, 10**200]]]),
        geojson("Polygon", [[[1, "x" * 99]]]),
        geojson("Polygon", [[[0, 0], [1, 1], [0, 0], [1, 1], [0, 0]]]),
        geojson("MultiPolygon", [SQUARE]),
        b"POLYGON EMPTY",
        b"POLYGON (0 0, 1 0, 1 1)",
        b"POLYGON ((0 0, 1 0, 1 1)",
        b"MULTIPOLYGON ((0 0, 1 0, 1 1))",
        b"POLYGON ((0 0, 1 0, 1 x))",
        b"POLYGON ((0 0, 1 0, nan 1))",
        b"POLYGON ((0 0, 1 0, 1))",
        b"POLYGON ((0 0, 1 0))",
        b"POLYGON ()",
        b"POLYGON (())",
        b"POLYGON " + b"(" * 100_000,
        b"POLYGONS ((0 0, 1 0, 1 1))",
        selection_volume(class_name="Box"),
        {"bounding_polygon": []},
        selection_volume(orthogonal_axis="xy"),
        selection_volume(orthogonal_axis=2),
        selection_volume(axis_min=None),
        selection_volume(axis_max=float("inf")),
        selection_volume(axis_min=3),
        selection_volume(bounding_polygon=SQUARE),
        selection_volume(bounding_polygon=[]),
        selection_volume(bounding_polygon=[[0, 0, 0], [4, 1, 0]]),
    ],
    ids=lambda content: str(content)[:50],
)
def test_invalid_files_are_refused(tmp_path, content):
    path = tmp_path / "p"
    path.write_bytes(content if isinstance(content, bytes) else json.dumps(content).encode())
    with check_error() as caught:
        parse_region(f"polygon:{path}", CLOUD)
    assert len(str(caught.value)) < len(str(path)) + 250


def test_an_endless_file_is_refused():
    with check_error():
        read_polygon("/dev/zero")


json_values = st.recursive(
    st.none() | st.booleans() | st.floats() | st.integers() | st.sampled_from(["Polygon", "Feature", "X"]),
    lambda inner: (
        st.lists(inner, max_size=4)
        | st.dictionaries(st.sampled_from(["type", "coordinates", "geometry", "features", "class_name"]), inner)
    ),
)


@no_deadline
@given(st.binary(max_size=60) | json_values.map(lambda value: json.dumps(value).encode()))
def test_any_file_gives_a_region_or_a_one_line_error(tmp_path_factory, content):
    path = tmp_path_factory.getbasetemp() / "any"
    path.write_bytes(content)
    try:
        read_polygon(path)
    except InputError as error:
        assert len(str(error).splitlines()) == 1
