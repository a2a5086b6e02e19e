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
    fuzz_worker.run([corpus], count, seed, folder)


SMALL_CORPORA = ("ply", "las", "pcd", "txt", "meshes", "mvs", "ptx", "bin", "splat", "spz", "ksplat", "glb")


def test_damaged_files(tmp_path):
    fuzz_worker.run(SMALL_CORPORA, 100, 1, tmp_path)


# Each LAZ file with a valid header starts a child process (about 15 ms), as each E57 and TIFF file (about 200 ms).
@pytest.mark.long
@pytest.mark.parametrize(("corpus", "count"), [("laz", 100), ("e57", 15), ("tif", 15)])
def test_damaged_files_that_children_read(tmp_path, corpus, count):
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
