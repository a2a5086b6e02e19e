"""PCD: hand-made files in the three encodings, LZF, refused files, and writing."""

import numpy as np
import pytest
import refusals
from optional import import_or_skip
from pcd_bytes import XYZ, corpus, lzf, pcd, points
from wording import check_error, check_text

from pcbench.geometry.cloud import Cloud
from pcbench.io import lzf as lzf_reader
from pcbench.io import read_cloud, write_cloud

ENCODINGS = pytest.mark.parametrize("data", ["ascii", "binary", "binary_compressed"])


def read(tmp_path, data, **options):
    path = tmp_path / "a.pcd"
    path.write_bytes(data)
    return read_cloud(path, **options)


def refusal(tmp_path, data):
    return refusals.refusal(tmp_path / "a.pcd", data)


# ---- reading ----


@ENCODINGS
def test_points_in_all_encodings(tmp_path, data):
    cloud = read(tmp_path, pcd(data, XYZ, points(50)))
    assert cloud.points.tolist() == [list(p) for p in points(50)]
    assert (cloud.normals, cloud.colors, cloud.attributes, cloud.crs) == (None, None, {}, None)


def test_corpus_is_equal_in_all_encodings(tmp_path):
    clouds = {name: read(tmp_path, data) for name, data in corpus().items()}
    for name, cloud in clouds.items():
        ascii_cloud = clouds["ascii " + name.split()[1]]
        np.testing.assert_array_equal(cloud.points, ascii_cloud.points)
        assert cloud.attributes.keys() == ascii_cloud.attributes.keys()
        for key, values in cloud.attributes.items():
            np.testing.assert_array_equal(values, ascii_cloud.attributes[key])
            assert values.dtype == ascii_cloud.attributes[key].dtype


@ENCODINGS
def test_all_fields(tmp_path, data):
    cloud = read(tmp_path, corpus()[f"{data} full"])
    assert cloud.points.tolist() == [list(p) for p in points(12)]
    assert cloud.normals.tolist() == [[0, 0, 1]] * 12
    assert cloud.colors.tolist() == [[0x10, 0x20, 0x30 + i] for i in range(12)]
    assert list(cloud.attributes) == ["hist[0]", "hist[1]", "hist[2]", "hist[3]", "t"]
    assert cloud.attributes["hist[3]"].tolist() == [i / 2 for i in range(12)]
    assert cloud.attributes["t"].dtype == np.uint64
    assert cloud.attributes["t"].tolist() == [2**60 + i for i in range(12)]


@ENCODINGS
@pytest.mark.parametrize("code", ["I1", "U1", "I2", "U2", "I4", "U4", "I8", "U8", "F4", "F8"])
def test_attribute_types(tmp_path, data, code):
    minimum = 0 if code[0] == "U" else -(2 ** (8 * int(code[1]) - 1)) if code[0] == "I" else -0.5
    cloud = read(tmp_path, pcd(data, [*XYZ, f"a {code}"], [(0.0, 0.0, 0.0, value) for value in (minimum, 1, 100)]))
    assert cloud.attributes["a"].tolist() == [minimum, 1, 100]
    assert cloud.attributes["a"].dtype == np.dtype(code[0].lower() + code[1])


@ENCODINGS
def test_colors_in_the_bits_of_a_float(tmp_path, data):
    packed_colors = np.array([0x00102030, 0x3F8090A0], dtype=np.uint32).view(np.float32).tolist()
    cloud = read(tmp_path, pcd(data, [*XYZ, "rgb F4"], [(0.0, 0.0, 0.0, value) for value in packed_colors]))
    assert cloud.colors.tolist() == [[0x10, 0x20, 0x30], [0x80, 0x90, 0xA0]]


def test_alpha_is_dropped(tmp_path):
    cloud = read(tmp_path, pcd("binary", [*XYZ, "rgba U4"], [(0.0, 0.0, 0.0, 0x80010203)]))
    assert cloud.colors.tolist() == [[1, 2, 3]]


def test_invalid_points_of_an_organised_cloud_are_dropped(tmp_path):
    nan = float("nan")
    notes = []
    data = pcd("binary", XYZ, [(1.0, 2.0, 3.0), (nan, nan, nan)] * 3, WIDTH=2, HEIGHT=3)
    assert len(read(tmp_path, data, on_warning=notes.append)) == 3
    assert notes == [f"{tmp_path / 'a.pcd'}: dropped 3 of 6 points with NaN or Inf coordinates"]


def test_ascii_coordinates_keep_their_digits(tmp_path):
    assert read(tmp_path, pcd("ascii", XYZ, [(4e6 + 0.123456, 1.0, 2.0)])).points[0, 0] == 4e6 + 0.123456


def test_viewpoint_is_not_applied(tmp_path):
    notes = []
    read(tmp_path, pcd("ascii", XYZ, points(2), viewpoint="0 0 0.0 1 0 0 0"), on_warning=notes.append)
    assert not notes
    cloud = read(tmp_path, pcd("ascii", XYZ, points(2), viewpoint="0 0 5 1 0 0 0"), on_warning=notes.append)
    assert notes == [f"{tmp_path / 'a.pcd'}: the viewpoint '0 0 5 1 0 0 0' was not applied"]
    assert cloud.points.tolist() == [list(p) for p in points(2)]


@pytest.mark.parametrize("data", ["ascii", "binary", "binary_compressed"])
@pytest.mark.parametrize("counts", [{"WIDTH": 5}, {"POINTS": 5}, {"WIDTH": 1, "HEIGHT": 1}])
def test_count_of_points_is_that_of_the_body(tmp_path, data, counts):
    notes = []
    cloud = read(tmp_path, pcd(data, XYZ, points(4), **counts), on_warning=notes.append)
    assert (cloud.points.tolist(), len(notes)) == ([list(row) for row in points(4)], 1)


def test_short_headers(tmp_path):
    data = pcd("ascii", XYZ, points(4), VERSION=None, VIEWPOINT=None, COUNT=None, HEIGHT=None)
    assert len(read(tmp_path, data)) == 4
    assert len(read(tmp_path, pcd("ascii", XYZ, points(4), WIDTH=None, HEIGHT=None))) == 4


def test_packed_colors_as_whole_numbers(tmp_path):
    rows, notes = [(*row, 0x0A0B0C) for row in points(4)], []
    cloud = read(tmp_path, pcd("ascii", [*XYZ, "rgb F4"], rows), on_warning=notes.append)
    assert (cloud.colors.tolist(), len(notes)) == ([[10, 11, 12]] * 4, 1)
    check_text(*notes)
    rows[0] = (*rows[0][:3], float("nan"))
    cloud = read(tmp_path, pcd("ascii", [*XYZ, "rgb F4"], rows), on_warning=notes.append)
    assert cloud.colors[:2].tolist() == [[0, 0, 0], [10, 11, 12]]


# ---- LZF ----


@pytest.mark.parametrize("seed", range(4))
def test_lzf_round_trip(seed):
    rng = np.random.default_rng(seed)
    data = b"".join(
        rng.integers(0, 256, rng.integers(1, 90), dtype=np.uint8).tobytes() * rng.integers(1, 99) for _ in range(60)
    )
    for size in (0, 1, 3, 40, len(data)):
        compressed_data = lzf(data[:size])
        assert lzf_reader.decompress(compressed_data, size) == data[:size]
    assert len(compressed_data) < len(data) / 3


def test_lzf_overlapping_copies():
    assert lzf_reader.decompress(b"\x00a\xe0\xff\x00", 265) == b"a" * 265
    assert lzf_reader.decompress(b"\x01ab\x60\x01", 7) == b"abababa"


@pytest.mark.parametrize("data", [b"\x05abc", b"\xe0", b"\x00a\x20", b"\x00a", b"\x00a\xe0\xff\x00" * 9])
def test_lzf_of_wrong_size_is_refused(data):
    with check_error():
        lzf_reader.decompress(data, 7)


def test_lzf_reference_before_the_start_is_refused():
    with check_error():
        lzf_reader.decompress(b"\x00a\x20\x05", 4)


# ---- damage ----

FOUR_POINTS = points(4)
COMPRESSED_PCD = pcd("binary_compressed", XYZ, FOUR_POINTS)
BODY_START = COMPRESSED_PCD.index(b"binary_compressed\n") + len(b"binary_compressed\n")
DAMAGED_FILES = {
    "many values": pcd("binary", [*XYZ, "a U1 10000"], [(*point, *[0] * 10_000) for point in points(1)]),
    "another format": b"ply\nformat ascii 1.0\n",
    "no data": b"VERSION 0.7\nFIELDS x y z\n",
    "long": b"# long\n" * 200_000,
    "no size": pcd("ascii", XYZ, FOUR_POINTS, SIZE=None),
    "sizes": pcd("ascii", XYZ, FOUR_POINTS, SIZE="4 4"),
    "type": pcd("ascii", XYZ, FOUR_POINTS, TYPE="F F X"),
    "half": pcd("ascii", XYZ, FOUR_POINTS, SIZE="4 4 2"),
    "no z": pcd("ascii", ["x F4", "y F4"], [(1.0, 2.0)]),
    "twice": pcd("ascii", [*XYZ, "x F4"], [(1.0, 2.0, 3.0, 4.0)]),
    "line twice": b"VERSION 0.7\nVERSION 0.7\n",
    "count 0": pcd("ascii", XYZ, FOUR_POINTS, COUNT="1 1 0"),
    "count 2": pcd("ascii", XYZ, FOUR_POINTS, COUNT="1 2 1"),
    "count -1": pcd("ascii", XYZ, FOUR_POINTS, COUNT="1 1 -1"),
    "width": pcd("ascii", XYZ, FOUR_POINTS, WIDTH=5, POINTS=6),
    "points": pcd("ascii", XYZ, FOUR_POINTS, POINTS="4e0"),
    "no points": pcd("ascii", XYZ, []),
    "data": pcd("ascii", XYZ, FOUR_POINTS, DATA="gzip"),
    "truncated": pcd("binary", XYZ, FOUR_POINTS)[:-1],
    "absurd": pcd("binary", XYZ, FOUR_POINTS, POINTS=10**17, WIDTH=10**17),
    "absurd ascii": pcd("ascii", XYZ, FOUR_POINTS, POINTS=10**17, WIDTH=10**17),
    "absurd count": pcd("ascii", [*XYZ, "a U1"], [(*p, 1) for p in FOUR_POINTS], COUNT=f"1 1 1 {10**17}"),
    "truncated ascii": pcd("ascii", XYZ, FOUR_POINTS, POINTS=5, WIDTH=5),
    "too many lines": pcd("ascii", XYZ, FOUR_POINTS, POINTS=3, WIDTH=3),
    "short line": pcd("ascii", XYZ, [*FOUR_POINTS[:2], (1.0, 2.0)]),
    "word": pcd("ascii", XYZ, FOUR_POINTS).replace(b"0.5 -1.0", b"half -1.0"),
    "uchar": pcd("ascii", [*XYZ, "a U1"], [(*p, 300) for p in FOUR_POINTS]),
    "no body": COMPRESSED_PCD[:BODY_START],
    "truncated packed": COMPRESSED_PCD[:-1],
    "sizes differ": COMPRESSED_PCD[: BODY_START + 4] + b"\xff\0\0\0" + COMPRESSED_PCD[BODY_START + 8 :],
}  # fmt: skip


@pytest.mark.parametrize("name", DAMAGED_FILES)
def test_damaged_files(tmp_path, name):
    refusal(tmp_path, DAMAGED_FILES[name])


def test_lzf_beyond_maximum_growth_is_refused(tmp_path):
    data = pcd("binary", XYZ, [], POINTS=10**8, WIDTH=10**8, DATA="binary_compressed")
    data += (5).to_bytes(4, "little") + (12 * 10**8).to_bytes(4, "little") + b"\x00a\xe0\xff\x00"
    refusal(tmp_path, data)


# ---- writer ----


def test_round_trip(tmp_path):
    rng = np.random.default_rng(3)
    attributes = {code: np.arange(50).astype(code) for code in ("i1", "u1", "i2", "u2", "i4", "u4", "i8", "u8", ">f4")}
    attributes |= {"flag": np.arange(50) % 2 == 0, "half": np.arange(50).astype(np.float16)}
    cloud = Cloud(
        rng.normal(size=(50, 3)) * 1e6,
        normals=rng.normal(size=(50, 3)),
        colors=rng.integers(0, 256, (50, 3), dtype=np.uint8),
        attributes=attributes,
    )
    write_cloud(tmp_path / "a.pcd", cloud)
    result = read_cloud(tmp_path / "a.pcd")
    np.testing.assert_array_equal(result.points, cloud.points)
    np.testing.assert_array_equal(result.normals, cloud.normals.astype(np.float32))
    np.testing.assert_array_equal(result.colors, cloud.colors)
    assert result.attributes.keys() == attributes.keys()
    for name, values in attributes.items():
        np.testing.assert_array_equal(result.attributes[name], values)


def test_open3d_reads_written_files(tmp_path):
    open3d = import_or_skip("open3d")
    points = np.random.default_rng(3).normal(size=(50, 3)).astype(np.float32)
    colors = np.arange(150, dtype=np.uint8).reshape(50, 3)
    write_cloud(tmp_path / "a.pcd", Cloud(points, colors=colors))
    open3d_cloud = open3d.io.read_point_cloud(str(tmp_path / "a.pcd"))
    np.testing.assert_array_equal(np.asarray(open3d_cloud.points), points)
    np.testing.assert_allclose(np.asarray(open3d_cloud.colors) * 255, colors, atol=1e-9)


@pytest.mark.parametrize("options", [{"write_ascii": True}, {"compressed": True}, {}])
def test_files_written_by_open3d(tmp_path, options):
    open3d = import_or_skip("open3d")
    rng = np.random.default_rng(4)
    open3d_cloud = open3d.geometry.PointCloud(open3d.utility.Vector3dVector(rng.normal(size=(3000, 3))))
    open3d_cloud.colors = open3d.utility.Vector3dVector(rng.integers(0, 256, (3000, 3)) / 255)
    open3d_cloud.normals = open3d.utility.Vector3dVector(rng.normal(size=(3000, 3)))
    open3d.io.write_point_cloud(str(tmp_path / "a.pcd"), open3d_cloud, **options)
    cloud = read_cloud(tmp_path / "a.pcd")
    tolerance = 1e-6 if options.get("write_ascii") else 4e-7  # ten digits, or float32
    np.testing.assert_allclose(cloud.points, np.asarray(open3d_cloud.points), rtol=tolerance, atol=tolerance)
    np.testing.assert_allclose(cloud.normals, np.asarray(open3d_cloud.normals), rtol=tolerance, atol=tolerance)
    np.testing.assert_array_equal(cloud.colors, np.rint(np.asarray(open3d_cloud.colors) * 255))


@pytest.mark.parametrize("values", [np.array(["a"]), np.array([1j]), np.array([None])])
def test_attributes_that_are_not_numbers_are_refused(tmp_path, values):
    with check_error():
        write_cloud(tmp_path / "a.pcd", Cloud(np.zeros((1, 3)), attributes={"a": values}))
    assert not list(tmp_path.iterdir())
