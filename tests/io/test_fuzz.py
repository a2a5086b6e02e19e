"""Thousands of damaged files, see `fuzz_worker`."""

import fuzz_worker
import pytest
from optional import import_or_skip


def check_corpus(corpus, count, seed, folder):
    if corpus == "laz":
        import_or_skip("lazrs")
    if corpus == "tif":
        import_or_skip("tifffile")
    if corpus == "e57":
        import_or_skip("pye57")
    fuzz_worker.run(corpus, count, seed, folder)


# Each LAZ file with a valid header starts a child process (about 15 ms), as each E57 and TIFF file (about 200 ms).
@pytest.mark.parametrize(
    ("corpus", "count"),
    [
        ("ply", 100),
        ("las", 80),
        pytest.param("laz", 100, marks=pytest.mark.long),
        ("pcd", 80),
        ("txt", 80),
        ("meshes", 80),
        pytest.param("e57", 15, marks=pytest.mark.long),
        ("mvs", 80),
        ("ptx", 80),
        ("bin", 80),
        ("splat", 80),
        ("spz", 80),
        ("ksplat", 80),
        ("glb", 80),
        pytest.param("tif", 15, marks=pytest.mark.long),
    ],
)
def test_damaged_files(tmp_path, corpus, count):
    check_corpus(corpus, count, 1, tmp_path)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("corpus", "count"),
    [
        ("ply", 20_000),
        ("las", 20_000),
        ("laz", 5000),
        ("pcd", 20_000),
        ("txt", 20_000),
        ("meshes", 10_000),
        ("e57", 2000),
        ("mvs", 20_000),
        ("ptx", 20_000),
        ("bin", 20_000),
        ("splat", 20_000),
        ("spz", 20_000),
        ("ksplat", 20_000),
        ("glb", 20_000),
        ("tif", 1000),
    ],
)
def test_many_damaged_files(tmp_path, corpus, count):
    check_corpus(corpus, count, 2, tmp_path)
