"""Text tables: delimiters, headers, unnamed columns, refused lines, and writing."""

import numpy as np
import pytest
import refusals
from data_folder import data_folder
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from wording import check_error

from pcbench.geometry.cloud import Cloud
from pcbench.io import read_cloud, write_cloud

DOUBLES = st.floats(-1e99, 1e99)


def read(tmp_path, text, name="a.txt", **options):
    path = tmp_path / name
    path.write_bytes(text if isinstance(text, bytes) else text.encode())
    return read_cloud(path, **options)


def refusal(tmp_path, text, name="a.txt"):
    return refusals.refusal(tmp_path / name, text)


# ---- delimiters and lines ----


@pytest.mark.parametrize("extension", ["xyz", "csv", "txt", "asc", "pts", "XYZ"])
@pytest.mark.parametrize("delimiter", [" ", "  ", ",", ", ", ";", "; ", "\t", " \t ", " , "])
@pytest.mark.parametrize("newline", ["\n", "\r\n"])
def test_delimiters(tmp_path, extension, delimiter, newline):
    lines = [delimiter.join(row) for row in (["1", "-2.5", "3e2"], ["+4.", ".5", "6E-1"])]
    cloud = read(tmp_path, newline.join(lines), f"a.{extension}")
    assert cloud.points.tolist() == [[1, -2.5, 300], [4, 0.5, 0.6]]


def test_single_point_and_byte_order_mark(tmp_path):
    assert read(tmp_path, b"\xef\xbb\xbf1 2 3").points.tolist() == [[1, 2, 3]]
    assert read(tmp_path, b"\xef\xbb\xbfx,y,z\n1,2,3\n", "a.csv").points.tolist() == [[1, 2, 3]]


def test_comments_and_empty_lines(tmp_path):
    text = "# made by hand\n\n// in metres\n  1 2 3\n\n# half way\n4 5 6 # the end\n7 8 9 // really\n   \n"
    assert read(tmp_path, text).points.tolist() == [[1, 2, 3], [4, 5, 6], [7, 8, 9]]


def test_crs_and_unit(tmp_path):
    cloud = read(tmp_path, "# crs EPSG:32617\n# unit US survey foot\n# crs other\n1 2 3\n")
    assert (cloud.crs, cloud.unit) == ("EPSG:32617", "US survey foot")


def test_nan_points_are_dropped(tmp_path):
    notes = []
    cloud = read(tmp_path, "1 2 3\nnan nan NaN\n4 5 inf\n", on_warning=notes.append)
    assert (len(cloud), notes) == (1, [f"{tmp_path / 'a.txt'}: dropped 2 of 3 points with NaN or Inf coordinates"])


# ---- headers ----


@pytest.mark.parametrize(
    "header",
    [
        "X,Y,Z,R,G,B,Nx,Ny,Nz,Scalar",
        '"x","y","z","red","green","blue","nx","ny","nz","Scalar"',
        "Easting,Northing,Elevation,Red,Green,Blue,normal_x,normal_y,normal_z,Scalar",
        "//X,Y,Z,R,G,B,Nx,Ny,Nz,Scalar",
        "# x,y,z,r,g,b,NormalX,NormalY,NormalZ,Scalar",
    ],
)
def test_headers(tmp_path, header):
    cloud = read(tmp_path, f"{header}\n1,2,3,255,0,7,0,0,1,0.5\n4,5,6,1,2,3,1,0,0,1.5\n")
    assert cloud.points.tolist() == [[1, 2, 3], [4, 5, 6]]
    assert cloud.colors.tolist() == [[255, 0, 7], [1, 2, 3]]
    assert cloud.normals.tolist() == [[0, 0, 1], [1, 0, 0]]
    assert list(cloud.attributes) == ["Scalar"]
    assert cloud.attributes["Scalar"].tolist() == [0.5, 1.5]


def test_header_in_another_order(tmp_path):
    cloud = read(tmp_path, "id;z;;y;x\n1;2;3;4;5\n")
    assert cloud.points.tolist() == [[5, 4, 2]]
    assert {name: values.tolist() for name, values in cloud.attributes.items()} == {"id": [1], "column_3": [3]}


def test_header_with_blanks_in_names(tmp_path):
    assert list(read(tmp_path, "x\ty\tz\tpoint number\n1\t2\t3\t4\n").attributes) == ["point number"]


@pytest.mark.parametrize("values", ["0.5,0.5,0.5", "256,0,0", "-1,0,0", "nan,0,0"])
def test_colors_out_of_range_are_attributes(tmp_path, values):
    cloud = read(tmp_path, f"x,y,z,r,g,b\n1,2,3,{values}\n")
    assert cloud.colors is None
    assert list(cloud.attributes) == ["red", "green", "blue"]


def test_prose_is_not_a_header(tmp_path):
    assert read(tmp_path, "# x y z in metres\n1 2 3\n").points.tolist() == [[1, 2, 3]]


def test_cloudcompare_header_and_count(tmp_path):
    assert len(read(tmp_path, "//X Y Z Intensity\n2\n1 2 3 4\n5 6 7 8\n", "a.asc")) == 2


# ---- without a header ----


def test_six_columns(tmp_path):
    assert read(tmp_path, "1 2 3 0 128 255\n").colors.tolist() == [[0, 128, 255]]
    cloud = read(tmp_path, "1 2 3 0.6 0 -0.8\n1 2 3 0 1 0\n")
    assert cloud.normals.tolist() == [[0.6, 0, -0.8], [0, 1, 0]]
    cloud = read(tmp_path, "1 2 3 0.6 0 -0.8\n1 2 3 0 1.5 0\n")
    assert (cloud.normals, cloud.colors) == (None, None)
    assert list(cloud.attributes) == ["column_4", "column_5", "column_6"]


def test_other_column_counts(tmp_path):
    assert list(read(tmp_path, "1 2 3 4\n").attributes) == ["column_4"]
    assert list(read(tmp_path, "1 2 3 4 5 6 7\n").attributes) == ["column_4", "column_5", "column_6", "column_7"]


def test_pts_columns(tmp_path):
    cloud = read(tmp_path, "2\n1 2 3 -2048 10 20 30\n4 5 6 2047 40 50 60\n", "a.pts")
    assert cloud.points.tolist() == [[1, 2, 3], [4, 5, 6]]
    assert cloud.colors.tolist() == [[10, 20, 30], [40, 50, 60]]
    assert cloud.attributes["intensity"].tolist() == [-2048, 2047]
    assert list(read(tmp_path, "1\n1 2 3 4\n", "a.pts").attributes) == ["intensity"]


def test_real_files():
    folder = data_folder("autzen")
    cloud = read_cloud(folder / "autzen-bmx-cc.txt")
    lines = (folder / "autzen-bmx-cc.txt").read_text().splitlines()
    assert len(cloud) == sum(line[:1] in "-0123456789" and len(line.split()) > 0 for line in lines if line)


# ---- damage ----

DAMAGED_TEXTS = {
    "binary": b"1 2 3\n\0\0",
    "utf-16": "1 2 3\n".encode("utf-16"),
    "blank": "\n \n# nothing\n",
    "header only": "x y z\n",
    "two columns": "1 2\n3 4\n",
    "ragged": "1 2 3\n\n4 5\n7 8 9\n",
    "longer": "# a\n1 2 3\n4 5 6 7\n",
    "word": "1 2 3\n4 five 6\n",
    "gap": "1,2,3\n4,,6\n",
    "underscore": "1 2 3\n4 5_0 6\n",
    "other digits": "1 2 3\n4 \u0665 6\n",
    "latin-1": b"1 2 3\n4 5 6 m\xb2\n",
    "label": "P1 1 2 3\n",
    "prose": "hello world\n1 2 3\n",
    "two headers": "x y z\na b c\n1 2 3\n",
    "names": "x y z a\n1 2 3\n",
    "twice": "x y z a a\n1 2 3 4 5\n",
    "comma ;": "1,5;2,5;3,5\n",
    "comma blank": "x y z\n1,5 2,5 3,5\n",
    "comma tab": "1,5\t2,5\t3,5\n",
    "count": "3\n1 2 3\n4 5 6\n",
    "lower count": "1\n1 2 3\n4 5 6\n",
    "two blocks": "1\n1 2 3\n1\n1 2 3\n",
    "long": "1 2 3\n" + "a" * 1000,
}  # fmt: skip


@pytest.mark.parametrize("name", DAMAGED_TEXTS)
def test_damaged_files(tmp_path, name):
    assert len(refusal(tmp_path, DAMAGED_TEXTS[name])) < 200


# ---- writer ----


@settings(max_examples=50, deadline=None)
@given(points=arrays(np.float64, st.tuples(st.integers(1, 9), st.just(3)), elements=DOUBLES))
@pytest.mark.parametrize("extension", ["xyz", "csv"])
def test_float64_round_trip_is_exact(tmp_path_factory, extension, points):
    path = tmp_path_factory.mktemp("exact") / f"a.{extension}"
    write_cloud(path, Cloud(points))
    np.testing.assert_array_equal(read_cloud(path).points, points)


@pytest.mark.parametrize("extension", ["xyz", "txt", "asc", "csv"])
def test_all_fields_round_trip(tmp_path, extension):
    rng = np.random.default_rng(3)
    cloud = Cloud(
        rng.normal(size=(70_000, 3)) * 1e6,  # more rows than one write
        normals=rng.normal(size=(70_000, 3)),
        colors=rng.integers(0, 256, (70_000, 3), dtype=np.uint8),
        attributes={"id": np.arange(70_000), "flag": np.arange(70_000) % 2 == 0, "f": rng.random(70_000, np.float32)},
        crs="EPSG:32617",
        unit="US survey\nfoot",
    )
    path = tmp_path / f"a.{extension}"
    write_cloud(path, cloud)
    result = read_cloud(path)
    np.testing.assert_array_equal(result.points, cloud.points)
    np.testing.assert_array_equal(result.normals, cloud.normals)
    np.testing.assert_array_equal(result.colors, cloud.colors)
    assert list(result.attributes) == ["id", "flag", "f"]
    for name, values in cloud.attributes.items():
        np.testing.assert_array_equal(result.attributes[name], values)
    assert (result.crs, result.unit) == ((None, None) if extension == "csv" else ("EPSG:32617", "US survey foot"))


def test_written_text(tmp_path):
    cloud = Cloud(np.array([[0.1, 1e-300, 3]]), colors=np.array([[1, 2, 3]], np.uint8), unit="m")
    write_cloud(tmp_path / "a.csv", cloud)
    assert (tmp_path / "a.csv").read_text() == "x,y,z,red,green,blue\n0.1,1e-300,3.0,1,2,3\n"
    write_cloud(tmp_path / "a.txt", cloud)
    assert (tmp_path / "a.txt").read_text() == "# unit m\n# x y z red green blue\n0.1 1e-300 3.0 1 2 3\n"
    write_cloud(tmp_path / "a.xyz", Cloud(np.ones((2, 3))))
    assert (tmp_path / "a.xyz").read_text() == "1.0 1.0 1.0\n1.0 1.0 1.0\n"


def test_pts_is_not_written(tmp_path):
    with check_error():
        write_cloud(tmp_path / "a.pts", Cloud(np.zeros((1, 3))))


@pytest.mark.parametrize("name", ["", "two words", "a,b", "a;b", "#a", "x", "nx", "R", 'a"b', "a//b", "Y"])
def test_invalid_attribute_names_are_refused(tmp_path, name):
    cloud = Cloud(
        np.zeros((1, 3)), normals=np.ones((1, 3)), colors=np.zeros((1, 3), np.uint8), attributes={name: np.zeros(1)}
    )
    with check_error():
        write_cloud(tmp_path / "a.csv", cloud)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("values", [np.array(["a"]), np.array([1j]), np.array([None])])
def test_attributes_that_are_not_numbers_are_refused(tmp_path, values):
    with check_error():
        write_cloud(tmp_path / "a.csv", Cloud(np.zeros((1, 3)), attributes={"a": values}))
    assert not list(tmp_path.iterdir())
