"""Features as GeoJSON and GeoPackage: own readers, and that of GDAL if pyogrio is installed, find what was written."""

import json
import sqlite3
import struct

import numpy as np
import pytest
from optional import import_or_skip
from wording import check_error

from pcbench.geometry import crs as crs_texts
from pcbench.geometry.crs import unnamed_grid
from pcbench.io.geojson import write_geojson
from pcbench.io.geopackage import write_geopackage
from pcbench.io.vector import Feature, VectorLayer, line_along, point_at, polygon_within, polygons_together

ORIGIN = np.array([500_000.0, 5_400_000.0, 100.0])
SQUARE = np.array([[0, 0, 1], [0, 1, 1], [1, 1, 2], [1, 0, 3.0]])  # clockwise
PROPERTIES = {"id": 1, "Fid": "a & b <\udcff>", "dz": np.float32(-1.5), "nothing": np.nan, "ok": np.bool_(True)}


def shapes(dimensions=3):
    """Return a polygon with a hole, another one, both together, a line and a point."""
    ring = (ORIGIN + 100 * SQUARE)[:, :dimensions]
    holed = polygon_within(ring, [(ORIGIN + 100 * (0.3 + 0.3 * SQUARE))[:, :dimensions]])
    other = polygon_within(ring[::-1] + 500)
    return holed, other, polygons_together([holed, other]), line_along(ring), point_at(ring[0])


def a_layer(*geometries, name="objects", crs="EPSG:25832"):
    return VectorLayer(name, [Feature(geometry, PROPERTIES) for geometry in geometries], crs)


def area(ring):
    (x, y), (following_x, following_y) = np.transpose(ring)[:2], np.roll(ring, -1, axis=0).T[:2]
    return np.sum(x * following_y - following_x * y) / 2


def test_rings_are_closed_and_have_the_direction_of_the_standards():
    holed, other, *_ = shapes()
    (outer, hole), (second,) = holed.parts[0], other.parts[0]
    for ring in (outer, hole, second):
        np.testing.assert_array_equal(ring[0], ring[-1])
        assert len(ring) == 5
    local = [ring - ORIGIN for ring in (outer, hole, second)]
    np.testing.assert_allclose([area(ring) for ring in local], [1e4, -900, 1e4], rtol=1e-6)  # far coordinates round


def test_impossible_shapes_are_refused():
    for make, positions in (
        (point_at, np.full(2, np.nan)),
        (line_along, np.zeros((1, 2))),
        (polygon_within, np.zeros((2, 3))),
        (polygon_within, np.zeros((5, 4))),
    ):
        with check_error():
            make(positions)


def test_geojson_is_in_degrees_of_wgs84_without_heights(tmp_path):
    import_or_skip("pyproj")
    write_geojson(tmp_path / "a.geojson", a_layer(*shapes()))
    written = json.loads((tmp_path / "a.geojson").read_text())
    assert (written["type"], written["name"], "crs" in written) == ("FeatureCollection", "objects", False)
    kinds = {each["geometry"]["type"]: each["geometry"]["coordinates"] for each in written["features"]}
    assert list(kinds) == ["Polygon", "MultiPolygon", "LineString", "Point"]
    assert kinds["Point"] == pytest.approx([9.0, 48.75301], abs=1e-4)  # the central meridian of the zone
    assert np.shape(kinds["LineString"]) == (4, 2)
    assert [len(rings) for rings in kinds["MultiPolygon"]] == [2, 1]
    assert area(np.subtract(kinds["MultiPolygon"][1][0], kinds["Point"])) > 0
    properties = {"id": 1, "Fid": "a & b <\\udcff>", "dz": -1.5, "nothing": None, "ok": True}
    assert all(each["properties"] == properties for each in written["features"])


@pytest.mark.parametrize(
    ("crs", "name"),
    [
        (None, 'LOCAL_CS["unknown"'),
        ("a local grid", 'LOCAL_CS["unknown"'),
        (unnamed_grid("m", "m"), 'LOCAL_CS["user-defined"'),
    ],
)
def test_geojson_names_systems_that_are_not_on_the_earth(tmp_path, crs, name):
    import_or_skip("pyproj")
    write_geojson(tmp_path / "a.geojson", a_layer(shapes()[4], crs=crs))
    written = json.loads((tmp_path / "a.geojson").read_text())
    assert written["crs"]["properties"]["name"].startswith(name)
    assert written["features"][0]["geometry"]["coordinates"] == (ORIGIN + [0, 0, 100]).tolist()


def test_geojson_names_the_system_if_it_cannot_transform(tmp_path, monkeypatch):
    monkeypatch.setattr(crs_texts, "parse_crs", lambda text: None)  # as without pyproj
    write_geojson(tmp_path / "a.geojson", a_layer(shapes()[4]))
    assert json.loads((tmp_path / "a.geojson").read_text())["crs"]["properties"]["name"] == "EPSG:25832"


def test_positions_outside_the_area_of_a_system_stay_as_they_are(tmp_path):
    import_or_skip("pyproj")
    write_geojson(tmp_path / "a.geojson", a_layer(point_at([1e9, 1e9])))
    written = json.loads((tmp_path / "a.geojson").read_text())
    assert written["features"][0]["geometry"]["coordinates"] == [1e9, 1e9]
    assert written["crs"]["properties"]["name"] == "EPSG:25832"


def read_blob(blob, dimensions):
    """Return the system, the box and the shape of a GeoPackage blob: nested positions, as in GeoJSON."""
    mark, version, flags, system = struct.unpack_from("<2sBBi", blob)
    assert (mark, version, flags) == (b"GP", 0, 1 | (dimensions - 1) << 1)
    place = 8 + 16 * dimensions
    box = np.frombuffer(blob, "<f8", 2 * dimensions, 8).reshape(dimensions, 2)

    def number():
        nonlocal place
        place += 4
        return struct.unpack_from("<I", blob, place - 4)[0]

    def positions(count):
        nonlocal place
        place += 8 * dimensions * count
        return np.frombuffer(blob, "<f8", dimensions * count, place - 8 * dimensions * count).reshape(count, -1)

    def shape():
        nonlocal place
        assert blob[place] == 1
        place += 1
        kind, with_heights = number() % 1000, dimensions == 3
        assert struct.unpack_from("<I", blob, place - 4)[0] // 1000 == with_heights
        match kind:
            case 1:
                return positions(1)[0]
            case 2:
                return positions(number())
            case 3:
                return [positions(number()) for _ in range(number())]
            case 6:
                return [shape() for _ in range(number())]

    read = shape()
    assert place == len(blob)
    return system, box, read


@pytest.mark.parametrize("dimensions", [2, 3])
def test_a_geopackage_has_the_shapes_and_their_boxes(tmp_path, dimensions):
    import_or_skip("pyproj")
    made = shapes(dimensions)
    write_geopackage(tmp_path / "a.gpkg", [a_layer(*made)])
    with sqlite3.connect(tmp_path / "a.gpkg") as database:
        blobs = [blob for (blob,) in database.execute("SELECT geom FROM objects")]
    database.close()
    for blob, geometry in zip(blobs, made, strict=True):
        system, box, read = read_blob(blob, dimensions)
        assert system == 25832
        np.testing.assert_array_equal(box.T, [geometry.positions.min(axis=0), geometry.positions.max(axis=0)])
        match geometry.kind:
            case "Point" | "LineString":
                read = [[np.atleast_2d(read)]]
            case "Polygon":
                read = [read]
        for rings, expected in zip(read, geometry.parts, strict=True):
            for ring, positions in zip(rings, expected, strict=True):
                np.testing.assert_array_equal(ring, positions)


def test_the_tables_of_a_geopackage(tmp_path):
    import_or_skip("pyproj")
    holed, other, both, _, point = shapes()
    layers = [a_layer(holed, other), a_layer(both, point, name='mixed "x"', crs=None), a_layer(name="empty")]
    layers.append(a_layer(shapes(2)[4], name="own", crs="+proj=tmerc +lon_0=9.1 +ellps=bessel +type=crs"))
    write_geopackage(tmp_path / "a.gpkg", layers)
    content = (tmp_path / "a.gpkg").read_bytes()
    write_geopackage(tmp_path / "a.gpkg", layers)
    assert (tmp_path / "a.gpkg").read_bytes() == content  # no date, nothing random
    database = sqlite3.connect(tmp_path / "a.gpkg")

    def rows(command):
        return database.execute(command).fetchall()

    assert rows("PRAGMA application_id") + rows("PRAGMA user_version") == [(0x47504B47,), (10300,)]
    assert rows("PRAGMA integrity_check") + rows("PRAGMA foreign_key_check") == [("ok",)]
    columns = "SELECT table_name, geometry_type_name, srs_id, z FROM gpkg_geometry_columns"
    assert rows(columns) == [
        ("objects", "POLYGON", 25832, 1),
        ('mixed "x"', "GEOMETRY", -1, 1),
        ("empty", "GEOMETRY", 25832, 0),
        ("own", "POINT", 100_000, 0),
    ]
    boxes = rows("SELECT min_x, min_y, max_x, max_y FROM gpkg_contents")
    assert boxes[0] == (500_000, 5_400_000, 500_600, 5_400_600)
    assert boxes[2] == (None,) * 4
    systems = dict(rows("SELECT srs_id, definition FROM gpkg_spatial_ref_sys"))
    assert list(systems) == [-1, 0, 4326, 25832, 100_000]
    assert systems[100_000].startswith("PROJCS[")
    types = [(name, kind) for _, name, kind, *_ in rows("PRAGMA table_info(objects)")]
    assert types[2:] == [("id", "INTEGER"), ("Fid_2", "TEXT"), ("dz", "DOUBLE"), ("nothing", "TEXT"), ("ok", "BOOLEAN")]
    assert rows('SELECT id, "Fid_2", dz, "nothing", ok FROM objects')[1] == (1, "a & b <\\udcff>", -1.5, None, 1)
    database.close()


@pytest.mark.parametrize("names", [[""], ["a", "A"], ["gpkg_contents"]])
def test_impossible_names_of_layers_are_refused(tmp_path, names):
    with check_error():
        write_geopackage(tmp_path / "a.gpkg", [a_layer(name=name) for name in names])
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("extension", ["gpkg", "geojson"])
def test_gdal_reads_shapes_values_and_systems(tmp_path, extension):
    pyogrio = pytest.importorskip("pyogrio", reason="needs pyogrio, which reads files as GDAL and QGIS do")
    import_or_skip("pyproj")
    path = tmp_path / f"a.{extension}"
    layer = a_layer(*shapes(2)[:2])
    if extension == "gpkg":
        write_geopackage(path, [layer])
    else:
        write_geojson(path, layer)
    meta, _, blobs, columns = pyogrio.raw.read(path)
    assert meta["crs"] == ("EPSG:25832" if extension == "gpkg" else "EPSG:4326")
    assert meta["geometry_type"] == "Polygon"
    assert [len(blob) for blob in blobs] == [177, 93]  # WKB of rings of ten and of five positions
    np.testing.assert_array_equal(columns[list(meta["fields"]).index("dz")], [-1.5, -1.5])
