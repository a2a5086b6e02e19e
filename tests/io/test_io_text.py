"""Text tables: delimiters, headers, unnamed columns, refused lines, and writing."""

import numpy as np
import pytest
import refusals
from data_folder import data_folder
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from wording import check_error, check_text

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


@pytest.mark.parametrize("encoding", ["utf-8", "utf-16", "cp1252"])
def test_encodings(tmp_path, encoding):
    cloud = read(tmp_path, "x,y,z,H\u00f6henfehler\n1,2,3,4\n\0".encode(encoding), "a.csv", on_warning=lambda _: None)
    assert (cloud.points.tolist(), list(cloud.attributes)) == ([[1, 2, 3]], ["H\u00f6henfehler"])


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


@pytest.mark.parametrize("values", ["256,0,0", "-1,0,0", "nan,0,0", "70000,0,0", "0.5,300.5,9"])
def test_colors_out_of_range_are_attributes(tmp_path, values):
    notes = []
    cloud = read(tmp_path, f"x,y,z,r,g,b\n1,2,3,{values}\n", on_warning=notes.append)
    check_text(*notes)
    assert cloud.colors is None
    assert list(cloud.attributes) == ["red", "green", "blue"]


@pytest.mark.parametrize(
    "text",
    [
        'name,z,x,y,i,code\nP1,3,1,2,7,tree\n"P2, old",6,4,5,8,\n',
        "name;z;x;y;i;code\nP1;3,0;1,0;2,0;7;tree\nP2;6,0;4,0;5,0;8;1,5 m\n",
        "name\tz\tx\ty\ti\tcode\nP1\t3\t1\t2\t7\ttree\nP 2\t6\t4\t5\t8\tbig tree\n",
        "# name z x y i code\nP1 3 1 2 7 tree\nP2 6 4 5 8 house\n",
    ],
)
def test_columns_of_text_are_left_out(tmp_path, text):
    notes = []
    cloud = read(tmp_path, text, on_warning=notes.append)
    assert cloud.points.tolist() == [[1, 2, 3], [4, 5, 6]]
    assert {name: values.tolist() for name, values in cloud.attributes.items()} == {"i": [7, 8]}
    check_text("\n".join(notes))


def test_words_for_empty_values(tmp_path):
    cloud = read(tmp_path, "x,y,z,a,b\n1,2,3,NA,4\n4,5,6,7,null\n", on_warning=lambda _: None)
    np.testing.assert_array_equal(cloud.attributes["a"], [np.nan, 7])
    np.testing.assert_array_equal(cloud.attributes["b"], [4, np.nan])


def test_a_second_triple_of_coordinates_has_a_warning(tmp_path):
    notes = []
    for header in ("X,Y,Z,x,y,z", "Easting,Northing,Elevation,x,y,z"):
        cloud = read(tmp_path, f"{header}\n1,2,3,4,5,6\n", on_warning=notes.append)
        assert cloud.points.tolist() == [[4, 5, 6]]
    read(tmp_path, "x,y,z,height\n1,2,3,4\n", on_warning=pytest.fail)  # above the ground
    check_text("\n".join(notes))


@pytest.mark.parametrize("name", [" " * 60_000 + "a", "a" + "(" * 60_000])
def test_long_headers_take_linear_time(tmp_path, name):
    assert read(tmp_path, f"x y z {name}\n1 2 3 4\n").points.tolist() == [[1, 2, 3]]
    refusal(tmp_path, "x\ty\tz" + "\t" * 20_000 + "\n1\t2\t3\n")


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


def test_extensions_of_open3d(tmp_path):
    assert read(tmp_path, "1 2 3 0 0 1\n", "a.xyzn").normals.tolist() == [[0, 0, 1]]
    assert read(tmp_path, "1 2 3 0 0 1\n", "a.xyzrgb").colors.tolist() == [[0, 0, 255]]
    assert list(read(tmp_path, "1 2 3 0.5\n", "a.xyzi").attributes) == ["intensity"]
    assert read(tmp_path, "x y z red green blue\n1 2 3 9 8 7\n", "a.xyzn").colors.tolist() == [[9, 8, 7]]


def test_real_files():
    folder = data_folder("autzen")
    cloud = read_cloud(folder / "autzen-bmx-cc.txt")
    lines = (folder / "autzen-bmx-cc.txt").read_text().splitlines()
    assert len(cloud) == sum(line[:1] in "-0123456789" and len(line.split()) > 0 for line in lines if line)


# ---- unusual tables ----


def read_with_notes(tmp_path, text, name="a.txt"):
    """Return the cloud and the warnings, which are compared with the golden file."""
    notes = []
    cloud = read(tmp_path, text, name, on_warning=notes.append)
    for note in notes:
        check_text(note)
    return cloud, notes


POINTS = [[1.5, 2.5, 3.25], [4.5, 5.5, 6.25]]
TABLES = {  # text, number of warnings and unit
    "trailing comma": ("1.5,2.5,3.25,\n4.5,5.5,6.25,\n", 1, None),
    "trailing semicolon": ("x;y;z;\n1.5;2.5;3.25;\n4.5;5.5;6.25;\n", 1, None),
    "trailing tab": ("1.5\t2.5\t3.25\t\n4.5\t5.5\t6.25\t\n", 0, None),
    "trailing comma of the header": ("x,y,z,\n1.5,2.5,3.25\n4.5,5.5,6.25\n", 0, None),
    "units in brackets": ("X [m],Y [m],Z [m]\n1.5,2.5,3.25\n4.5,5.5,6.25\n", 0, "m"),
    "units in parentheses": ("X(ft) Y(ft) Z(ft)\n1.5 2.5 3.25\n4.5 5.5 6.25\n", 0, "ft"),
    "quoted units": ('"X [m]";"Y [m]";"Z [m]"\n1.5;2.5;3.25\n4.5;5.5;6.25\n', 0, "m"),
    "units after blanks": ("X [m] Y [m] Z [m]\n1.5 2.5 3.25\n4.5 5.5 6.25\n", 0, "m"),
    "units in a comment": ("# X [m] Y [m] Z [m]\n1.5 2.5 3.25\n4.5 5.5 6.25\n", 0, "m"),
    "row of units": ("x,y,z\nm,m,m\n1.5,2.5,3.25\n4.5,5.5,6.25\n", 0, "m"),
    "row of units in brackets": ("x\ty\tz\n[ft]\t[ft]\t[ft]\n1.5\t2.5\t3.25\n4.5\t5.5\t6.25\n", 0, "ft"),
    "other order": ("Z,X,Y\n3.25,1.5,2.5\n6.25,4.5,5.5\n", 0, None),
    "decimal commas": ("1,5;2,5;3,25\n4,5;5,5;6,25\n", 1, None),
    "decimal commas after blanks": ("1,5 2,5 3,25\n4,5 5,5 6,25\n", 1, None),
    "decimal commas after tabs": ("1,5\t2,5\t3,25\n4,5\t5,5\t6,25\n", 1, None),
    "decimal commas later": ("x;y;z\n1.5;2.5;3.25\n4,5;5,5;6,25\n", 1, None),
    "quotes": ('"1.5","2.5","3.25"\n"4.5","5.5","6.25"\n', 0, None),
    "Fortran": ("1.5D0 2.5d+00 0.325D+01\n4.5D0 5.5D0 6.25D0\n", 0, None),
    "tabs and blanks": ("1.5\t2.5 3.25\n4.5 \t5.5\t\t6.25\n", 0, None),
    "windows": ("\ufeffx,y,z\r\n1.5,2.5,3.25\r\n4.5,5.5,6.25\r\n", 0, None),
    "comments": ("% by hand\n; x, y, z\n1.5 2.5 3.25\n% half way\n4.5 5.5 6.25 // end\n", 0, None),
    "ArcGIS": ("POINT_X,POINT_Y,POINT_Z\n1.5,2.5,3.25\n4.5,5.5,6.25\n", 0, None),
    "count of one more": ("3\n1.5 2.5 3.25\n4.5 5.5 6.25\n", 1, None),
    "count of one less": ("1\n1.5 2.5 3.25\n4.5 5.5 6.25\n", 1, None),
    "last value is empty": ("x,y,z,i\n1.5,2.5,3.25,\n4.5,5.5,6.25,7\n", 1, None),
    "last column is empty": ("x;y;z;i\n1.5;2.5;3.25;\n4.5;5.5;6.25;\n", 1, None),
    "end of file": ("1.5 2.5 3.25\n4.5 5.5 6.25\n\x1a", 1, None),
    "padding": ("1.5 2.5 3.25\n4.5 5.5 6.25\n" + 99 * "\0", 1, None),
    "ParaView": ('"Normals:0","Points:0","Points:1","Points:2"\n0,1.5,2.5,3.25\n0,4.5,5.5,6.25\n', 0, None),
    "row numbers": ("x y z\n1 1.5 2.5 3.25\n2 4.5 5.5 6.25\n3 nan nan nan\n", 2, None),
}  # fmt: skip


@pytest.mark.parametrize("name", TABLES)
def test_unusual_tables(tmp_path, name):
    text, warnings, unit = TABLES[name]
    cloud, notes = read_with_notes(tmp_path, text)
    assert (cloud.points.tolist(), cloud.unit, len(notes)) == (POINTS, unit, warnings)


def test_repeated_names_are_numbered(tmp_path):
    cloud, _ = read_with_notes(tmp_path, "x y z a a\n1 2 3 4 5\n")
    assert {name: values.tolist() for name, values in cloud.attributes.items()} == {"a": [4], "a_5": [5]}


def test_units_below_the_names(tmp_path):
    text = "X;Y;Z;Intensity;\nm;m;m;;\n1,5;2,0;3,0;12;\n2,5;3,0;4,25;13;\n"
    cloud, _ = read_with_notes(tmp_path, text)
    assert (cloud.points.tolist(), cloud.unit) == ([[1.5, 2, 3], [2.5, 3, 4.25]], "m")
    assert cloud.attributes["intensity"].tolist() == [12, 13]


EMPTY_VALUES = {  # of attributes a and b; other programs write them for NaN
    "in the middle": ("x,y,z,a,b\n1,2,3,4,5\n6,7,8,,9\n", [[4, np.nan], [5, 9]]),
    "at the end": ("x,y,z,a,b\n1,2,3,4,5\n6,7,8,9,\n", [[4, 9], [5, np.nan]]),
    "at the end of the first line": ("# x;y;z;a;b\n1;2;3;4;\n6;7;8;;9\n", [[4, np.nan], [np.nan, 9]]),
    "in all lines": ("x,y,z,a,b\n1,2,3,4,\n6,7,8,,\n", [[4, np.nan], [np.nan, np.nan]]),
    "between tabs": ("x\ty\tz\ta\tb\n1\t2\t3\t4\t\n6\t7\t8\t\t9\n", [[4, np.nan], [np.nan, 9]]),
    "before a last delimiter": ("x,y,z,a,b,\n1,2,3,4,5,\n6,7,8,9,,\n", [[4, 9], [5, np.nan]]),
}  # fmt: skip


@pytest.mark.parametrize("name", EMPTY_VALUES)
def test_empty_values_of_attributes_are_nan(tmp_path, name):
    text, expected = EMPTY_VALUES[name]
    cloud, _ = read_with_notes(tmp_path, text)
    assert cloud.points.tolist() == [[1, 2, 3], [6, 7, 8]]
    np.testing.assert_array_equal([cloud.attributes["a"], cloud.attributes["b"]], expected)


def test_longitude_and_latitude_are_degrees(tmp_path):
    cloud, _ = read_with_notes(tmp_path, "Latitude,Longitude,Height\n40.5,-81.25,100\n")
    assert (cloud.points.tolist(), cloud.crs) == ([[-81.25, 40.5, 100]], "EPSG:4326")
    cloud, _ = read_with_notes(tmp_path, "x,y,z,lat,lon\n1,2,3,40.5,-81.25\n")
    assert (cloud.points.tolist(), cloud.crs, list(cloud.attributes)) == ([[1, 2, 3]], None, ["lat", "lon"])


def test_blocks_of_pts(tmp_path):
    text = "2\n1 2 3 -2048 10 20 30\n4 5 6 2047 40 50 60\n0\n2\n7 8 9 0 1 2 3\n1\n9 8 7 5 4 3 2\n"
    cloud, _ = read_with_notes(tmp_path, text, "a.pts")
    assert cloud.points.tolist() == [[1, 2, 3], [4, 5, 6], [7, 8, 9], [9, 8, 7]]
    assert cloud.colors.tolist() == [[10, 20, 30], [40, 50, 60], [1, 2, 3], [4, 3, 2]]
    assert cloud.attributes["intensity"].tolist() == [-2048, 2047, 0, 5]
    assert cloud.attributes["scan"].tolist() == [0, 0, 2, 3]


def test_esri_ascii_grids(tmp_path):
    header = "ncols 3\nnrows 2\nxllcorner 100\nyllcorner 200.0\ncellsize 2\nNODATA_value -1\n"
    cloud, _ = read_with_notes(tmp_path, header + "1 2 3\n4 -1 6\n", "a.asc")
    assert cloud.points.tolist() == [[101, 203, 1], [103, 203, 2], [105, 203, 3], [101, 201, 4], [105, 201, 6]]
    header = "NCOLS 1\r\nNROWS 2\r\nXLLCENTER 5\r\nYLLCENTER 6\r\nDX 1\r\nDY 3\r\n"
    assert read(tmp_path, header + "1\r\n2", "a.asc").points.tolist() == [[5, 9, 1], [5, 6, 2]]


# ---- numbers of points ----

RNG = np.random.default_rng(4)
COORDINATES = RNG.uniform(0, 100, (200, 3)).round(3)
COUNTS = {
    "from 0": np.arange(200),
    "from 1": np.arange(1, 201),
    "down": np.arange(900, 700, -1),
    "shuffled": RNG.permutation(200),
    "selection": np.sort(RNG.choice(10**6, 200, replace=False)),
}


@pytest.mark.parametrize("name", COUNTS)
@pytest.mark.parametrize("delimiter", [" ", ",", ";", "\t"])
def test_a_first_column_that_counts_is_an_id(tmp_path, name, delimiter):
    numbers = COUNTS[name].tolist()
    rows = [
        delimiter.join(map(repr, [number, *point]))
        for number, point in zip(COUNTS[name].tolist(), COORDINATES.tolist(), strict=True)
    ]
    notes = []
    cloud = read(tmp_path, "\n".join(rows), on_warning=notes.append)
    assert (cloud.points.tolist(), len(notes)) == (COORDINATES.tolist(), 1)
    assert cloud.attributes["id"].tolist() == numbers


def test_ids_before_colors_and_normals(tmp_path):
    rows = "1 0.5 0.5 2.5 9 0 255 0 0 1\n2 1.5 0.5 2.5 9 0 255 0 1 0\n3 1.5 0.5 2.5 7 0 255 1 0 0\n"
    cloud, _ = read_with_notes(tmp_path, rows)
    assert cloud.points[0].tolist() == [0.5, 0.5, 2.5]
    assert (cloud.colors[0].tolist(), cloud.normals[0].tolist()) == ([9, 0, 255], [0, 0, 1])


def test_three_columns_and_named_ones_are_no_ids(tmp_path):
    profile = [[float(k), 0.5, 2.5] for k in range(9)]
    text = "\n".join(" ".join(map(repr, row)) for row in profile)
    cloud, notes = read_with_notes(tmp_path, text)
    assert (cloud.points.tolist(), notes) == (profile, [])
    text = "# x y z a\n" + "\n".join(" ".join(map(repr, [*row, 7])) for row in profile)
    cloud, notes = read_with_notes(tmp_path, text)
    assert (cloud.points.tolist(), notes) == (profile, [])


@pytest.mark.parametrize("first", [RNG.integers(1, 7, 200), np.sort(RNG.uniform(1e5, 2e5, 200))])
def test_a_first_column_that_may_be_a_class_or_a_time_has_a_warning(tmp_path, first):
    rows = np.column_stack([first, COORDINATES])
    cloud, notes = read_with_notes(tmp_path, "\n".join(" ".join(map(repr, row)) for row in rows.tolist()))
    assert (cloud.points[:, 0].tolist(), len(notes)) == (first.tolist(), 1)


def test_comment_that_names_other_columns_has_a_warning(tmp_path):
    cloud, notes = read_with_notes(tmp_path, "# id x y z\n0.5 1 2 3 4\n")
    assert (cloud.points.tolist(), len(notes)) == ([[0.5, 1, 2]], 1)


@pytest.mark.parametrize(
    ("row", "expected"),
    [
        ("0.5 2 3 0 0 1", "normals"),
        ("0.5 2 3 9 0 1", "colors"),
        ("0.5 2 3 0.1 0.2 0.3", "column_4 column_5 column_6"),
        ("0.5 2 3 77.5 9 0 1", "colors column_4"),
        ("0.5 2 3 9 0 1 77.5", "colors column_7"),
        ("0.5 2 3 0.5 0 0.6 0.8", "normals column_4"),
        ("0.5 2 3 9 9 0 1 1", "column_4 column_5 column_6 column_7 column_8"),
        ("0.5 2 3 9 0 1 0 0.6 0.8\n1 2 3 9 9 9 1 0 0", "colors normals"),
        ("0.5 2 3 0 0.6 0.8 9 0 1\n1 2 3 1 0 0 9 9 9", "colors normals"),
        ("0.5 2 3 0.25 9 0 1 0 0 1\n1 2 3 0.5 9 9 9 0 0 1", "colors normals column_4"),
    ],
)
def test_columns_without_names(tmp_path, row, expected):
    cloud, _ = read_with_notes(tmp_path, row)
    found = [name for name in ("colors", "normals") if getattr(cloud, name) is not None]
    assert " ".join([*found, *cloud.attributes]) == expected
    if cloud.colors is not None:
        assert cloud.colors[0].tolist() == [9, 0, 1]


def test_columns_that_may_be_classes_have_a_warning(tmp_path):
    cloud, notes = read_with_notes(tmp_path, "0.5 2 3 2 1 1\n0.5 2 4 6 2 3\n")
    assert (cloud.colors.tolist(), len(notes)) == ([[2, 1, 1], [6, 2, 3]], 1)
    check_text(*notes)
    assert not read_with_notes(tmp_path, "0.5 2 3 2 1 1\n0.5 2 4 6 2 32\n")[1]


# ---- damage ----

DAMAGED_TEXTS = {
    "binary": b"1 2 3\0\0\n",
    "utf-16": "1 2 3\n".encode("utf-16-le"),
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
    "text for a coordinate": "name,x,y,z\nP1,1,2,3\nP2,4,five,6\n",
    "text below numbers": "x,y,z,name\n1,2,3,4\n1,2,3,P4\n",
    "prose": "hello world\n1 2 3\n",
    "two headers": "x y z\na b c\n1 2 3\n",
    "names": "x y z a\n1 2 3\n",
    "twice": "x y z x\n1 2 3 4\n",
    "thousands": "1,234.5;2,345.6;3,456.7\n",
    "commas of two kinds": "1,5, 2,0, 3,0\n2,5, 3,0, 4,5\n",
    "thousands or decimals": "1,234;2,345;3,456\n",
    "quoted commas": '"1,5","2,5","3,5"\n',
    "count": "4\n1 2 3\n4 5 6\n",
    "lower count": "1\n1 2 3\n4 5 6\n7 8 9\n",
    "second count": "1\n1 2 3\n5\n1 2 3\n",
    "two units": "x [m],y [m],z [ft]\n1,2,3\n",
    "units without a header": "m,m,m\n1,2,3\n",
    "too few names": "x y z\n1 2 3 4\n5 6 7 8\n",
    "grid without cells": "ncols 2\nnrows 2\ncellsize 1\n1 2 3\n",
    "grid without size": "ncols 2\nnrows 2\n1 2 3 4\n",
    "grid of words": "ncols 2\nnrows 1\ncellsize 1\n1 two\n",
    "grid without data": "ncols 2\nnrows 1\ncellsize 1\n-9999 -9999\n",
    "camera matrix": "2759.48 0 1520.69\n0 2764.16 1006.81\n0 0 1\n",
    "transform": "0 -2 0 100\n2 0 0 200\n0 0 2 5\n0 0 0 1\n",
    "pose": "0 -1 0 100\n1 0 0 200\n0 0 1 5\n",
    "long": "1 2 3\n" + "a" * 1000,
}  # fmt: skip


@pytest.mark.parametrize("name", DAMAGED_TEXTS)
def test_damaged_files(tmp_path, name):
    assert len(refusal(tmp_path, DAMAGED_TEXTS[name])) < 200


# ---- writer ----


@settings(max_examples=20, deadline=None)
@given(points=arrays(np.float64, st.tuples(st.integers(1, 9), st.just(3)), elements=DOUBLES))
@pytest.mark.parametrize("extension", ["xyz", "csv"])
def test_float64_round_trip_is_exact(tmp_path_factory, extension, points):
    path = tmp_path_factory.mktemp("exact") / f"a.{extension}"
    write_cloud(path, Cloud(points))
    np.testing.assert_array_equal(read_cloud(path).points, points)


@pytest.mark.parametrize("extension", ["xyz", "txt", "asc", "csv"])
def test_all_fields_round_trip(tmp_path, monkeypatch, extension):
    monkeypatch.setattr("pcbench.io.text._ROWS_PER_WRITE", 2000)
    rng = np.random.default_rng(3)
    cloud = Cloud(
        rng.normal(size=(7000, 3)) * 1e6,  # more rows than one write
        normals=rng.normal(size=(7000, 3)),
        colors=rng.integers(0, 256, (7000, 3), dtype=np.uint8),
        attributes={"id": np.arange(7000), "flag": np.arange(7000) % 2 == 0, "f": rng.random(7000, np.float32)},
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


@pytest.mark.parametrize("values", [np.array(["a"]), np.array([1j]), np.array([None])])
def test_attributes_that_are_not_numbers_are_refused(tmp_path, values):
    with check_error():
        write_cloud(tmp_path / "a.csv", Cloud(np.zeros((1, 3)), attributes={"a": values}))
    assert not list(tmp_path.iterdir())
