"""Depth and normal maps as files: round trips, and compatibility with COLMAP's reader and writer."""

import numpy as np
import pytest
from optional import import_or_skip
from wording import check_error

from reconstructors.mvs.maps import DepthMap, read_depth, read_map, read_raster, write_map, write_raster


def random_map(height=5, width=7):
    rng = np.random.default_rng(0)
    depth = rng.uniform(1, 9, (height, width)).astype(np.float32)
    depth[0, 0] = 0
    normal = rng.normal(size=(height, width, 3)).astype(np.float32)
    return DepthMap(depth, normal, rng.uniform(size=(height, width)).astype(np.float32))


def test_round_trip(tmp_path):
    depth_map = random_map()
    write_map(tmp_path, depth_map)
    loaded_map = read_map(tmp_path)
    for name in ("depth", "normal", "confidence"):
        np.testing.assert_array_equal(getattr(loaded_map, name), getattr(depth_map, name))
        assert getattr(loaded_map, name).dtype == np.float32
    np.testing.assert_array_equal(read_depth(tmp_path), depth_map.depth)
    assert not loaded_map.known[0, 0]
    assert loaded_map.known.sum() == 34
    # COLMAP writes no confidence file.
    (tmp_path / "confidence.bin").unlink()
    np.testing.assert_array_equal(read_map(tmp_path).confidence, loaded_map.known.astype(np.float32))


def test_colmap_reads_and_writes_the_same_files(tmp_path):
    pycolmap = import_or_skip("pycolmap")
    depth_map = random_map()
    write_map(tmp_path, depth_map)
    colmap_map = pycolmap.DepthMap()
    colmap_map.read(tmp_path / "depth.bin")
    np.testing.assert_array_equal(colmap_map.to_array(), depth_map.depth)
    pycolmap.DepthMap.from_array(depth_map.depth, 1.0, 9.0).write(tmp_path / "colmap.bin")
    assert (tmp_path / "colmap.bin").read_bytes() == (tmp_path / "depth.bin").read_bytes()
    # pycolmap's arrays of normals have a wrong layout, its files are right: compare the files.
    normals = pycolmap.NormalMap()
    normals.read(tmp_path / "normal.bin")
    normals.write(tmp_path / "colmap.bin")
    assert (tmp_path / "colmap.bin").read_bytes() == (tmp_path / "normal.bin").read_bytes()
    assert (normals.width, normals.height) == (7, 5)


def test_normals_are_stored_channel_by_channel(tmp_path):
    normal = np.zeros((2, 3, 3), np.float32)
    normal[..., 1], normal[..., 2] = 1, 2
    write_raster(tmp_path / "n.bin", normal)
    expected = b"3&2&3&" + np.repeat(np.array([0, 1, 2], "<f4"), 6).tobytes()
    assert (tmp_path / "n.bin").read_bytes() == expected


def test_where_removes_depths_outside_a_mask():
    depth_map = random_map()
    mask = np.zeros((5, 7), bool)
    mask[2, 3] = True
    masked = depth_map.where(mask)
    assert masked.known.sum() == 1
    assert masked.depth[2, 3] == depth_map.depth[2, 3]
    assert np.count_nonzero(masked.normal) == 3
    assert np.count_nonzero(masked.confidence) == 1


@pytest.mark.parametrize(
    "content",
    [
        b"",
        b"ply\nformat",
        b"-3&2&1&",
        b"3&2&1&" + bytes(20),
        b"3&2&1&" + bytes(28),
        b"0&0&1&",
        b"999999999&999999999&9&",
    ],
    ids=["empty", "another format", "negative size", "too few bytes", "too many bytes", "zero size", "huge size"],
)
def test_damaged_files_are_refused(tmp_path, content):
    (tmp_path / "depth.bin").write_bytes(content)
    with check_error():
        read_raster(tmp_path / "depth.bin")


def test_mismatched_shapes_are_refused(tmp_path):
    depth_map = random_map()
    with check_error():
        DepthMap(depth_map.depth, depth_map.normal[1:], depth_map.confidence)
    write_map(tmp_path, depth_map)
    write_raster(tmp_path / "normal.bin", depth_map.normal[1:])
    with check_error():
        read_map(tmp_path)
    write_raster(tmp_path / "depth.bin", depth_map.normal)
    with check_error():
        read_depth(tmp_path)
    with check_error():
        read_map(tmp_path / "nothing")
