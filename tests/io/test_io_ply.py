"""PLY: hand-made files of all types, byte orders and layouts; and writing."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from ply_bytes import FORMATS, TYPES, XYZ, corpus, ply, points
from wording import check_error

from pcbench.geometry.cloud import Cloud
from pcbench.io import read_cloud, write_cloud

EXTREMES = {"b": (-128, 127), "B": (0, 255), "h": (-32768, 32767), "H": (0, 65535), "i": (-(2**31), 2**31 - 1),
            "I": (0, 2**32 - 1), "f": (-1.5, 0.25), "d": (1 / 3, -1e99)}  # fmt: skip
ALL_FORMATS = pytest.mark.parametrize("form", FORMATS)


def read(tmp_path, data):
    path = tmp_path / "a.ply"
    path.write_bytes(data)
    return read_cloud(path)


@ALL_FORMATS
@pytest.mark.parametrize("kind", TYPES)
def test_property_types(tmp_path, form, kind):
    minimum, maximum = EXTREMES[TYPES[kind]]
    coordinates = [f"{kind} x", f"{kind} y", f"{kind} z"]
    cloud = read(
        tmp_path,
        ply(form, ("vertex", [*coordinates, f"{kind} a"], [(minimum, maximum, 1, maximum), (1, 2, 3, minimum)])),
    )
    np.testing.assert_array_equal(cloud.points, [[minimum, maximum, 1], [1, 2, 3]])
    attribute = cloud.attributes["a"]
    assert attribute.dtype == np.dtype(TYPES[kind]) and attribute.dtype.isnative
    assert attribute.tolist() == [maximum, minimum]
    assert cloud.points.flags.c_contiguous and cloud.points.flags.aligned


@ALL_FORMATS
def test_properties_in_any_order(tmp_path, form):
    cloud = read(tmp_path, ply(form, ("vertex", ["float z", "uchar a", "double y", "float x"], [(3.0, 9, 2.0, 1.0)])))
    assert cloud.points.tolist() == [[1, 2, 3]]
    assert cloud.attributes["a"].tolist() == [9]


@ALL_FORMATS
@pytest.mark.parametrize("sizes", [[3, 3, 3], [3, 4, 0, 3], [0, 0]])
def test_elements_in_any_order(tmp_path, form, sizes):
    faces = ("face", ["list uchar int vertex_indices", "float q"], [(tuple(range(n)), 0.5) for n in sizes])
    strips = ("tristrips", ["list int int a", "list ushort double b"], [((1, 2, -1), (0.5,)), ((), (1.0, 2.0))])
    no_rows, no_properties = ("edge", ["int a"], []), ("nothing", [], [(), ()])
    vertices = ("vertex", [*XYZ, "uchar a"], [(*p, 7) for p in points(5)])
    for elements in ([faces, vertices, strips], [vertices, no_rows, faces], [no_properties, strips, faces, vertices]):
        cloud = read(tmp_path, ply(form, *elements))
        assert cloud.points.tolist() == [list(p) for p in points(5)]
        assert cloud.attributes["a"].tolist() == [7] * 5


@ALL_FORMATS
@pytest.mark.parametrize("list_lengths", [[2, 2, 2, 2], [0, 3, 1, 255]])
def test_lists_in_the_vertex_element_are_skipped(tmp_path, form, list_lengths):
    properties = ["float x", "list uchar uint view_indices", "float y", "float z", "list uchar float w", "short id"]
    rows = [(float(i), tuple(range(n)), i + 0.5, -1.0, (0.5,) * n, i) for i, n in enumerate(list_lengths)]
    cloud = read(tmp_path, ply(form, ("vertex", properties, rows)))
    assert cloud.points.tolist() == [[i, i + 0.5, -1] for i in range(4)]
    assert {name: values.tolist() for name, values in cloud.attributes.items()} == {"id": [0, 1, 2, 3]}


@ALL_FORMATS
@pytest.mark.parametrize("newline", ["\n", "\r\n"])
def test_comments_and_line_ends(tmp_path, form, newline):
    comments = [
        "comment",
        "comment crs EPSG:32617",
        "obj_info unit ft",
        "comment unit m",
        "",
        "comment  end_header",
        "obj_info",
    ]
    cloud = read(tmp_path, ply(form, ("vertex", XYZ, points(3)), comments=comments, newline=newline))
    assert (len(cloud), cloud.crs, cloud.unit) == (3, "EPSG:32617", "m")


@ALL_FORMATS
@pytest.mark.parametrize(
    ("origin", "offset"),
    [
        ("448262 5411932 -12.5", (448262, 5411932, -12.5)),
        ("1 2", (0, 0, 0)),
        ("1 2 north", (0, 0, 0)),
        ("1 2 nan", (0, 0, 0)),
        ("", (0, 0, 0)),
    ],
)
def test_coordinates_about_an_origin(tmp_path, form, origin, offset):
    """A comment without three coordinates is an ordinary comment."""
    comments = [f"comment coordinates about {origin}"]
    shifted_cloud = read(tmp_path, ply(form, ("vertex", XYZ, points(3)), comments=comments))
    cloud = read(tmp_path, ply(form, ("vertex", XYZ, points(3))))
    assert np.array_equal(shifted_cloud.points, cloud.points + offset)


def test_comments_in_another_encoding(tmp_path):
    data = ply("ascii", ("vertex", XYZ, points(3)), comments=["comment X"])
    assert len(read(tmp_path, data.replace(b"X", "Größe".encode("latin-1")))) == 3


def test_ascii_line_layout_does_not_matter(tmp_path):
    data = (
        b"ply\nformat ascii 1.0\nelement vertex 2\nproperty float x\nproperty float y\nproperty float z\nend_header\n"
    )
    cloud = read(tmp_path, data + b"\n  1\t2   3e0 \r\n\n+4 -.5 6.")
    assert cloud.points.tolist() == [[1, 2, 3], [4, -0.5, 6]]


def test_ascii_float_coordinates_keep_their_digits(tmp_path):
    """A UTM northing declared `float`: float32 would move it by up to 0.25 m."""
    cloud = read(tmp_path, ply("ascii", ("vertex", XYZ, [(500000.123, 4428123.457, 12.5)])))
    assert cloud.points.tolist() == [[500000.123, 4428123.457, 12.5]]


# ---- properties ----


@ALL_FORMATS
@pytest.mark.parametrize("names", ["red green blue", "r g b", "diffuse_red diffuse_green diffuse_blue"])
def test_colors(tmp_path, form, names):
    properties = [*XYZ, *(f"uchar {name}" for name in names.split()), "uchar alpha"]
    cloud = read(tmp_path, ply(form, ("vertex", properties, [(0.0, 0.0, 0.0, 1, 2, 255, 9)])))
    assert cloud.colors.tolist() == [[1, 2, 255]]
    assert cloud.colors.dtype == np.uint8
    assert list(cloud.attributes) == ["alpha"]


@ALL_FORMATS
def test_normals(tmp_path, form):
    properties = ["float nz", *XYZ, "float nx", "float ny"]
    cloud = read(tmp_path, ply(form, ("vertex", properties, [(3.0, 0.0, 0.0, 0.0, 1.0, 2.0)])))
    assert cloud.normals.tolist() == [[1, 2, 3]]
    cloud = read(tmp_path, ply(form, ("vertex", properties[:-1], [(3.0, 0.0, 0.0, 0.0, 1.0)])))
    assert cloud.normals is None
    assert list(cloud.attributes) == ["nz", "nx"]


@ALL_FORMATS
def test_splat_properties_are_attributes(tmp_path, form):
    names = [*(f"f_dc_{i}" for i in range(3)), *(f"f_rest_{i}" for i in range(45)), "opacity"]
    names += [*(f"scale_{i}" for i in range(3)), *(f"rot_{i}" for i in range(4))]
    properties = [*XYZ, "float nx", "float ny", "float nz", *(f"float {name}" for name in names)]
    rows = [(*p, 0.0, 0.0, 0.0, *(i + k / 4 for k in range(len(names)))) for i, p in enumerate(points(6))]
    cloud = read(tmp_path, ply(form, ("vertex", properties, rows)))
    assert cloud.normals is None
    assert list(cloud.attributes) == names
    for k, name in enumerate(names):
        assert cloud.attributes[name].dtype == np.float32
        assert cloud.attributes[name].tolist() == [i + k / 4 for i in range(6)]


def test_corpus_is_equal_in_all_formats(tmp_path):
    clouds = {name: read(tmp_path, data) for name, data in corpus().items()}
    for name, cloud in clouds.items():
        ascii_cloud = clouds["ascii" + name.removeprefix(name.split()[0])]
        np.testing.assert_array_equal(cloud.points, ascii_cloud.points)
        assert cloud.attributes.keys() == ascii_cloud.attributes.keys()


# ---- writer ----

DOUBLES = st.floats(-1e100, 1e100)


@settings(max_examples=20, deadline=None)
@given(points=arrays(np.float64, st.tuples(st.integers(1, 9), st.just(3)), elements=DOUBLES))
def test_float64_round_trip_is_exact(tmp_path_factory, points):
    path = tmp_path_factory.mktemp("exact") / "a.ply"
    write_cloud(path, Cloud(points))
    np.testing.assert_array_equal(read_cloud(path).points, points)
    rows = [tuple(row) for row in points.tolist()]
    path.write_bytes(ply("ascii", ("vertex", ["double x", "double y", "double z"], rows)))
    np.testing.assert_array_equal(read_cloud(path).points, points)


def test_all_fields_round_trip(tmp_path):
    rng = np.random.default_rng(3)
    attributes = {
        code: np.array([0, 1, 2, 3, 100]).astype(code) for code in ("i1", "u1", "i2", "u2", "i4", "u4", "f4", "f8")
    }
    cloud = Cloud(
        rng.normal(size=(5, 3)),
        normals=rng.normal(size=(5, 3)),
        colors=rng.integers(0, 256, (5, 3), dtype=np.uint8),
        attributes=attributes,
        crs='PROJCRS["Höhe",\n  BASEGEOGCRS["WGS 84"]]',
        unit="US survey foot",
    )
    path = tmp_path / "a.ply"
    write_cloud(path, cloud)
    result = read_cloud(path)
    np.testing.assert_array_equal(result.points, cloud.points)
    np.testing.assert_array_equal(result.normals, cloud.normals.astype(np.float32))
    np.testing.assert_array_equal(result.colors, cloud.colors)
    assert {name: values.dtype for name, values in result.attributes.items()} == {
        code: np.dtype(code) for code in attributes
    }
    for name, values in result.attributes.items():
        np.testing.assert_array_equal(values, attributes[name])
    assert result.crs == 'PROJCRS["Höhe", BASEGEOGCRS["WGS 84"]]'
    assert result.unit == "US survey foot"


@pytest.mark.parametrize(
    ("values", "dtype"),
    [
        (np.array([True, False]), np.uint8),
        (np.array([-1, 2**31 - 1]), np.int32),
        (np.array([0, 2**32 - 1]), np.uint32),
        (np.array([-1, 2**32 - 1]), np.float64),
        (np.array([0, 2**53], dtype=np.uint64), np.float64),
        (np.array([0.5, np.inf], dtype=np.float16), np.float32),
        (np.array([0.5, 0.25], dtype=np.longdouble), np.float64),
        (np.array([1.5, 2.5], dtype=">f4"), np.float32),
    ],
)
def test_types_that_ply_lacks(tmp_path, values, dtype):
    write_cloud(tmp_path / "a.ply", Cloud(np.zeros((2, 3)), attributes={"a": values}))
    result = read_cloud(tmp_path / "a.ply").attributes["a"]
    assert result.dtype == dtype
    np.testing.assert_array_equal(result, values)


@pytest.mark.parametrize("values", [np.array(["a"]), np.array([1j]), np.array([None])])
def test_attributes_that_are_not_numbers_are_refused(tmp_path, values):
    with check_error():
        write_cloud(tmp_path / "a.ply", Cloud(np.zeros((1, 3)), attributes={"a": values}))
    assert not list(tmp_path.iterdir())


def test_written_header(tmp_path):
    write_cloud(
        tmp_path / "a.ply", Cloud(np.ones((2, 3)), attributes={"i": np.zeros(2, np.int16)}, crs="EPSG:2", unit="m")
    )
    header, body = (tmp_path / "a.ply").read_bytes().split(b"end_header\n")
    assert header.decode() == (
        "ply\nformat binary_little_endian 1.0\ncomment crs EPSG:2\ncomment unit m\nelement vertex 2\n"
        "property double x\nproperty double y\nproperty double z\nproperty short i\n"
    )
    assert len(body) == 2 * 26


def test_a_line_break_after_a_binary_body_is_no_data(tmp_path):
    """Some programs end every file with one."""
    points = np.arange(12.0).reshape(4, 3)
    write_cloud(tmp_path / "a.ply", Cloud(points))
    with (tmp_path / "a.ply").open("ab") as file:
        file.write(b"\n")
    np.testing.assert_array_equal(read_cloud(tmp_path / "a.ply").points, points)
