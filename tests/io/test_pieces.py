"""Clouds read in pieces: the same points, bit by bit, as in memory, for each format and any size of the pieces."""

import struct
import subprocess
import sys

import e57_bytes
import numpy as np
import ply_bytes
import pytest
from cloud_pieces import check_pieces
from data_folder import data_folder
from hypothesis import given, settings
from hypothesis import strategies as st
from las_bytes import RECORDS, UTM, copc, extra, extras, las, wkt
from optional import import_or_skip

from pcbench.geometry.cloud import Cloud
from pcbench.io import write_cloud
from pcbench.io.pieces import open_cloud, read_piece

NORMALS = extras(extra(b"nx", 9), extra(b"ny", 9), extra(b"nz", 9))


@pytest.mark.parametrize("form", RECORDS)
def test_las(tmp_path, form):
    (tmp_path / "a.las").write_bytes(las(form, 50, vlrs=[wkt(UTM)]))
    disk, _ = check_pieces(tmp_path / "a.las", 7)
    assert [piece.count for piece in disk.pieces] == [7] * 7 + [1]
    assert disk.crs == "EPSG:32617" and disk.unit == "m"
    assert disk.pieces[1].label == "piece 2 of 8"


@given(count=st.integers(1, 60), piece_points=st.integers(1, 70))
@settings(max_examples=12, deadline=None)
def test_any_size_of_pieces(tmp_path_factory, count, piece_points):
    folder = tmp_path_factory.mktemp("pieces")
    (folder / "a.las").write_bytes(las(1, count))
    (folder / "b.ply").write_bytes(
        ply_bytes.ply("binary_big_endian", ("vertex", ply_bytes.XYZ, ply_bytes.points(count)))
    )
    disk, _ = check_pieces(folder, piece_points)
    assert disk.count == 2 * count
    assert max(piece.count for piece in disk.pieces) <= piece_points


def test_las_header_describes_the_cloud(tmp_path):
    cloud = Cloud(np.random.default_rng(0).uniform(0, 100, (1000, 3)), normals=np.ones((1000, 3)))
    write_cloud(tmp_path / "a.las", cloud)
    disk, read = check_pieces(tmp_path / "a.las", 300)
    assert disk.has_normals
    low, high = read.bounds
    np.testing.assert_allclose(disk.files[0].low, low, atol=1e-9)
    np.testing.assert_allclose(disk.files[0].high, high, atol=1e-9)
    held = read.points.nbytes + read.normals.nbytes + sum(a.nbytes for a in read.attributes.values())
    assert 0.7 * held < disk.nbytes_in_memory < 1.5 * held


def test_zero_point_file_is_refused_alone(tmp_path):
    (tmp_path / "a.las").write_bytes(las(1, 0))
    with pytest.raises(ValueError, match="at least one point, got none in 1 files"):
        open_cloud(tmp_path / "a.las")


def test_pieces_have_at_least_one_point(tmp_path):
    (tmp_path / "a.las").write_bytes(las(1, 5))
    with pytest.raises(ValueError, match="pieces of at least one point, got 0"):
        open_cloud(tmp_path / "a.las", piece_points=0)


# ---- LAZ and COPC ----


def test_laz_is_read_by_chunks(tmp_path):
    import_or_skip("lazrs")
    rng = np.random.default_rng(1)
    write_cloud(tmp_path / "a.laz", Cloud(rng.uniform(0, 50, (120_000, 3)), normals=rng.normal(size=(120_000, 3))))
    disk, _ = check_pieces(tmp_path / "a.laz", 1)
    assert [piece.count for piece in disk.pieces] == [50_000, 50_000, 20_000]
    disk, _ = check_pieces(tmp_path / "a.laz", 100_000)
    assert [piece.count for piece in disk.pieces] == [100_000, 20_000]


def test_filters(tmp_path):
    import_or_skip("lazrs")
    (tmp_path / "a.las").write_bytes(las(6, 60))
    (tmp_path / "a.copc.laz").write_bytes(copc(60))
    for name in ("a.las", "a.copc.laz"):
        check_pieces(tmp_path / name, 1, classes=(2,))
        check_pieces(tmp_path / name, 25, classes=(2,), returns="last")
        disk, _ = check_pieces(tmp_path / name, 7, returns="1,3")
        assert disk.returns == (1, 3)
    empty = open_cloud(tmp_path / "a.las", piece_points=1, classes=(2,))
    assert len(read_piece(empty, empty.pieces[0]).points) == 0  # its class is 6


def test_copc_is_read_by_nodes(tmp_path):
    import_or_skip("lazrs")
    (tmp_path / "a.copc.laz").write_bytes(copc(300))
    disk, _ = check_pieces(tmp_path / "a.copc.laz", 1)
    assert [piece.count for piece in disk.pieces] == [100, 200]


@pytest.mark.parametrize(
    ("folder", "name"), [("copc", "lone-star"), ("copc", "1.2-with-color"), ("wild", "Topography")]
)
def test_real_laz(folder, name):
    import_or_skip("lazrs")
    laspy = import_or_skip("laspy")
    path = next(data_folder(folder).glob(f"{name}.*"))
    disk, cloud = check_pieces(path, 60_000)
    theirs = laspy.read(path)
    assert disk.count == len(theirs.points)
    np.testing.assert_array_equal(cloud.points, np.stack([theirs.x, theirs.y, theirs.z], axis=1))
    np.testing.assert_array_equal(cloud.attributes["classification"], theirs.classification)


def test_real_las():
    disk, _ = check_pieces(data_folder("autzen") / "autzen_trim.las", 30_000, returns="first")
    assert len(disk.pieces) == 4


# ---- other formats ----

VERTICES = ("vertex", [*ply_bytes.XYZ, "float nx", "float ny", "float nz"])


@pytest.mark.parametrize("form", ply_bytes.FORMATS)
def test_ply(tmp_path, form):
    rows = [(*xyz, 0.0, 0.0, float(k > 5)) for k, xyz in enumerate(ply_bytes.points(20))]
    before = ("sensor", ["uchar id", "double time"], [(1, 2.5), (3, 4.5)])
    comments = ["comment crs EPSG:32617", "comment unit m", "comment coordinates about 500000 0.1 -7"]
    (tmp_path / "a.ply").write_bytes(ply_bytes.ply(form, before, (*VERTICES, rows), comments=comments))
    disk, _ = check_pieces(tmp_path / "a.ply", 6)
    assert disk.has_normals and disk.crs == "EPSG:32617"
    assert len(disk.pieces) == (1 if form == "ascii" else 4)


def test_ply_normals_that_are_all_zero_are_left_out(tmp_path):
    rows = [(*xyz, 0.0, 0.0, 0.0) for xyz in ply_bytes.points(20)]
    (tmp_path / "a.ply").write_bytes(ply_bytes.ply("binary_little_endian", (*VERTICES, rows)))
    assert not check_pieces(tmp_path / "a.ply", 6)[0].has_normals


def test_ply_with_faces_is_one_piece(tmp_path):
    faces = ("face", ["list uchar int vertex_indices"], [([0, 1, 2],)])
    vertices = ("vertex", ply_bytes.XYZ, ply_bytes.points(9))
    (tmp_path / "a.ply").write_bytes(ply_bytes.ply("binary_little_endian", vertices, faces))
    assert len(check_pieces(tmp_path / "a.ply", 2)[0].pieces) == 1


def test_points_that_are_not_finite_are_dropped(tmp_path):
    rows = [(float("nan") if k in (3, 4, 5) else x, y, z) for k, (x, y, z) in enumerate(ply_bytes.points(8))]
    (tmp_path / "a.ply").write_bytes(ply_bytes.ply("binary_little_endian", ("vertex", ply_bytes.XYZ, rows)))
    disk, _ = check_pieces(tmp_path / "a.ply", 2)
    assert len(read_piece(disk, disk.pieces[2]).points) == 0


def test_points_at_the_origin_are_counted_over_all_pieces(tmp_path):
    write_cloud(tmp_path / "a.ply", Cloud(np.concatenate([np.zeros((120, 3)), np.ones((30, 3))])))
    check_pieces(tmp_path / "a.ply", 40)  # compares the warnings


@pytest.mark.parametrize("extension", [".npy", ".npz", ".pcd", ".xyz"])
def test_other_formats_are_one_piece(tmp_path, extension):
    write_cloud(tmp_path / f"a{extension}", Cloud(np.arange(30.0).reshape(10, 3)))
    disk, cloud = check_pieces(tmp_path / f"a{extension}", 3)
    assert len(disk.pieces) == 1
    np.testing.assert_array_equal([disk.files[0].low, disk.files[0].high], cloud.bounds)


def test_each_scan_of_e57_is_a_piece(tmp_path):
    import_or_skip("pye57")
    rng = np.random.default_rng(2)
    scan = dict(zip(e57_bytes.XYZ, rng.uniform(-1, 1, (3, 50)), strict=True))
    scan |= {f"nor:normal{axis}": rng.uniform(-1, 1, 50) for axis in "XYZ"}
    invalid = scan | {"cartesianInvalidState": np.arange(50) % 2, "pose": ((0.6, 0, 0.8, 0), (1, 2, 3))}
    all_invalid = scan | {"cartesianInvalidState": np.ones(50, int)}
    e57_bytes.write(tmp_path / "a.e57", [scan, invalid])
    disk, cloud = check_pieces_without_counts(tmp_path / "a.e57")
    assert [piece.count for piece in disk.pieces] == [50, 50] and len(cloud.points) == 75 and disk.has_normals
    e57_bytes.write(tmp_path / "b.e57", [scan, all_invalid])
    disk, cloud = check_pieces_without_counts(tmp_path / "b.e57")
    assert len(read_piece(disk, disk.pieces[1]).points) == 0


def check_pieces_without_counts(path):
    """As `check_pieces`, but the warnings of E57 count the invalid points of each piece instead of each file."""
    from pcbench.io import read_cloud

    cloud = read_cloud(path, on_warning=lambda _: None)
    disk = open_cloud(path)
    read = [read_piece(disk, piece) for piece in disk.pieces]
    assert np.concatenate([piece.points for piece in read]).tobytes() == cloud.points.tobytes()
    assert np.concatenate([piece.normals for piece in read]).tobytes() == cloud.normals.tobytes()
    return disk, cloud


@pytest.mark.parametrize("name", ["A_moved_B", "bunnyInt32", "ColouredCubeFloat"])
def test_real_e57(name):
    import_or_skip("pye57")
    check_pieces(data_folder("e57") / f"{name}.e57")


# ---- memory ----

_PIECE, _PIECES = 200_000, 10
# A piece needs its records (30 bytes per point) and at most three times its points (24), normals being absent, and its
# attributes (14): 116 bytes per point. The rest is what the allocator keeps.
_MAX_GROWTH = 116 * _PIECE + (16 << 20)
_MEASURE = """
import sys
from pcbench.io import read_cloud
from pcbench.io.pieces import open_cloud, read_piece
from pcbench.systems import peak_memory_since_reset, reset_peak_memory
cloud = open_cloud(sys.argv[1], piece_points=int(sys.argv[2]))
start = reset_peak_memory()
if start is None:
    sys.exit("skip")
count = sum(len(read_piece(cloud, piece).points) for piece in cloud.pieces)
in_pieces = peak_memory_since_reset()
read_cloud(sys.argv[1])
print(count, in_pieces - start, peak_memory_since_reset() - start)
"""


@pytest.mark.long
@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="other systems state the peak in other units")
def test_memory_is_that_of_a_piece(tmp_path):
    import_or_skip("lazrs")
    points = np.zeros((_PIECE * _PIECES, 3))
    points[:, 0] = np.arange(len(points)) * 0.001
    write_cloud(tmp_path / "a.laz", Cloud(points))
    command = [sys.executable, "-c", _MEASURE, str(tmp_path / "a.laz"), str(_PIECE)]
    done = subprocess.run(command, capture_output=True, text=True)
    if done.stderr.strip() == "skip":
        pytest.skip("this system does not let a process reset its peak memory")
    count, in_pieces, at_once = map(int, done.stdout.split())
    assert count == len(points)
    print(f"{in_pieces / 1e6:.0f} MB in pieces, {at_once / 1e6:.0f} MB at once")
    assert in_pieces < _MAX_GROWTH < at_once


def test_large_coordinates_are_refused_as_in_memory(tmp_path):
    (tmp_path / "a.ply").write_bytes(
        ply_bytes.ply("binary_little_endian", ("vertex", [f"double {axis}" for axis in "xyz"], [(1e200, 0.0, 0.0)]))
    )
    disk = open_cloud(tmp_path / "a.ply")
    with pytest.raises(ValueError, match="expected coordinates up to"):
        read_piece(disk, disk.pieces[0])


def test_extra_bytes_of_normals(tmp_path):
    data = las(3, 20, vlrs=[NORMALS], tail=lambda i: struct.pack("<3f", i, 0.5, -1))
    (tmp_path / "a.las").write_bytes(data)
    assert check_pieces(tmp_path / "a.las", 6)[0].has_normals
