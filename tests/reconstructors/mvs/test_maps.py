"""Depth and normal maps as files: there and back, and as COLMAP itself reads and writes them."""

import numpy as np
import pytest
from optional import import_or_skip
from wording import refused

from reconstructors.mvs.maps import DepthMap, read_depth, read_map, read_raster, write_map, write_raster


def a_map(height=5, width=7):
    rng = np.random.default_rng(0)
    depth = rng.uniform(1, 9, (height, width)).astype(np.float32)
    depth[0, 0] = 0
    normal = rng.normal(size=(height, width, 3)).astype(np.float32)
    return DepthMap(depth, normal, rng.uniform(size=(height, width)).astype(np.float32))


def test_there_and_back(tmp_path):
    made = a_map()
    write_map(tmp_path, made)
    back = read_map(tmp_path)
    for name in ("depth", "normal", "confidence"):
        np.testing.assert_array_equal(getattr(back, name), getattr(made, name))
        assert getattr(back, name).dtype == np.float32
    np.testing.assert_array_equal(read_depth(tmp_path), made.depth)
    assert not back.known[0, 0]
    assert back.known.sum() == 34
    # COLMAP writes no confidences.
    (tmp_path / "confidence.bin").unlink()
    np.testing.assert_array_equal(read_map(tmp_path).confidence, back.known.astype(np.float32))


def test_colmap_reads_and_writes_the_same_files(tmp_path):
    pycolmap = import_or_skip("pycolmap")
    made = a_map()
    write_map(tmp_path, made)
    theirs = pycolmap.DepthMap()
    theirs.read(tmp_path / "depth.bin")
    np.testing.assert_array_equal(theirs.to_array(), made.depth)
    pycolmap.DepthMap.from_array(made.depth, 1.0, 9.0).write(tmp_path / "theirs.bin")
    assert (tmp_path / "theirs.bin").read_bytes() == (tmp_path / "depth.bin").read_bytes()
    # Its arrays of normals mix up the layout, its files do not: the file is taken as it is.
    normals = pycolmap.NormalMap()
    normals.read(tmp_path / "normal.bin")
    normals.write(tmp_path / "theirs.bin")
    assert (tmp_path / "theirs.bin").read_bytes() == (tmp_path / "normal.bin").read_bytes()
    assert (normals.width, normals.height) == (7, 5)


def test_normals_lie_channel_after_channel(tmp_path):
    normal = np.zeros((2, 3, 3), np.float32)
    normal[..., 1], normal[..., 2] = 1, 2
    write_raster(tmp_path / "n.bin", normal)
    expected = b"3&2&3&" + np.repeat(np.array([0, 1, 2], "<f4"), 6).tobytes()
    assert (tmp_path / "n.bin").read_bytes() == expected


def test_nothing_is_known_outside_what_is_kept():
    made = a_map()
    kept = np.zeros((5, 7), bool)
    kept[2, 3] = True
    left = made.where(kept)
    assert left.known.sum() == 1
    assert left.depth[2, 3] == made.depth[2, 3]
    assert np.count_nonzero(left.normal) == 3
    assert np.count_nonzero(left.confidence) == 1


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
    ids=["empty", "another format", "negative", "too few bytes", "too many bytes", "nothing", "absurd"],
)
def test_damaged_files_are_refused(tmp_path, content):
    (tmp_path / "depth.bin").write_bytes(content)
    with refused():
        read_raster(tmp_path / "depth.bin")


def test_what_does_not_fit_is_refused(tmp_path):
    made = a_map()
    with refused():
        DepthMap(made.depth, made.normal[1:], made.confidence)
    write_map(tmp_path, made)
    write_raster(tmp_path / "normal.bin", made.normal[1:])
    with refused():
        read_map(tmp_path)
    write_raster(tmp_path / "depth.bin", made.normal)
    with refused():
        read_depth(tmp_path)
    with refused():
        read_map(tmp_path / "nothing")
