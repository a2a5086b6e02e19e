"""Files of clouds in tiles: folders, filters, damaged files, and disks that cannot be written."""

import errno
import os

import numpy as np
import pytest
from las_tiles import write_tiles
from tiled_clouds import in_this_process
from tiled_pairs import Pair, check_equal, noisy, surface
from wording import check_error, check_text

from pcbench.comparison.in_tiles import SAMPLED_REGION
from pcbench.geometry.cloud import Cloud
from pcbench.io import write_cloud
from pcbench.measure.results import LeftOut
from pcbench.measure.tiled.settings import TilingSettings

pytestmark = pytest.mark.usefixtures("without_deformation")


@pytest.fixture
def pair(tmp_path, monkeypatch):
    """A PLY file as the reference, and a folder of LAZ tiles."""
    in_this_process(monkeypatch)
    rng = np.random.default_rng(0)
    points = surface(rng, 800)
    pair = Pair(tmp_path / "pair", points, noisy(rng, points[::2]))
    pair.paths["a"] = write_tiles(tmp_path / "a", noisy(rng, points[::2]), 5.0)
    return pair


def test_a_folder_of_tiles_against_a_file(pair):
    check_equal(pair.tiled(), pair.memory())


def test_filters_of_las_files(tmp_path, monkeypatch):
    in_this_process(monkeypatch)
    monkeypatch.setattr(TilingSettings, "chosen_piece_points", 400)
    rng = np.random.default_rng(0)
    paths = {}
    for name, count in (("ref", 2000), ("a", 1200)):
        points = noisy(rng, surface(rng, count))
        classes = rng.choice([2, 6], count).astype(np.uint8)
        classes[: count // 3] = 6  # the first piece has no point that passes
        paths[name] = tmp_path / f"{name}.laz"
        write_cloud(paths[name], Cloud(points, attributes={"classification": classes}))
    pair = Pair(tmp_path / "pair", np.zeros((3, 3)), classes=(2,))
    pair.paths = paths
    tiled = pair.tiled()
    assert 0 < tiled.reference.points < 1400
    check_equal(tiled, pair.memory())


def test_filters_that_no_point_passes_are_named(tmp_path, monkeypatch):
    in_this_process(monkeypatch)
    rng = np.random.default_rng(0)
    points = surface(rng, 500)
    pair = Pair(tmp_path / "pair", np.zeros((3, 3)), classes=(9,), returns="last")
    for name in ("ref", "a"):
        pair.paths[name] = tmp_path / f"{name}.las"
        write_cloud(pair.paths[name], Cloud(points, attributes={"classification": np.full(500, 2, np.uint8)}))
    with check_error():
        pair.tiled()


def damage(path):
    """Clear the chunk table at the end of a LAZ file, which no tile of any size survives."""
    data = bytearray(path.read_bytes())
    data[-16:] = bytes(16)
    path.write_bytes(data)


def test_damaged_files_end_the_comparison_or_are_left_out(pair, tmp_path):
    files = sorted(pair.paths["a"].iterdir())
    damage(files[1])
    files[3].write_bytes(files[3].read_bytes()[:300])
    with check_error():
        pair.tiled(skip_bad=False)
    tiled = pair.tiled("skipping", skip_bad=True)
    assert {left_out.path for left_out in tiled.tiling.left_out} == {str(files[1]), str(files[3])}
    assert all(isinstance(left_out, LeftOut) and left_out.reason for left_out in tiled.tiling.left_out)
    assert not any(left_out.path in left_out.reason for left_out in tiled.tiling.left_out)
    for file in (files[1], files[3]):
        file.unlink()
    check_equal(tiled, pair.memory(), with_warnings=False)
    again = pair.tiled("without", skip_bad=True)
    assert not again.tiling.left_out


def test_a_damaged_file_that_is_repaired_is_used(pair):
    file = sorted(pair.paths["a"].iterdir())[1]
    intact, times = file.read_bytes(), file.stat()
    damage(file)
    os.utime(file, ns=(times.st_atime_ns, times.st_mtime_ns - 10**9))
    assert len(pair.tiled(skip_bad=True).tiling.left_out) == 1
    file.write_bytes(intact)
    check_equal(pair.tiled(skip_bad=True), pair.memory())


def test_two_candidates_may_have_equal_file_names(tmp_path, monkeypatch):
    in_this_process(monkeypatch)
    rng = np.random.default_rng(0)
    points = surface(rng, 900)
    pair = Pair(tmp_path / "pair", points, noisy(rng, points[::2]), noisy(rng, points[::3]))
    for name in ("a", "b"):
        (tmp_path / name).mkdir()
        pair.paths[name] = pair.paths[name].rename(tmp_path / name / "cloud.ply")
    check_equal(pair.tiled(), pair.memory())


def test_a_region_from_a_sample_is_said(tmp_path, monkeypatch):
    in_this_process(monkeypatch)
    rng = np.random.default_rng(0)
    points = surface(rng, 900)
    pair = Pair(tmp_path / "pair", points, noisy(rng, points), crop="quantile:0.9", deformation=False)
    for even, codes in ((900, []), (300, [SAMPLED_REGION])):
        monkeypatch.setattr("pcbench.measure.tiled.stored.EVEN_POINTS", even)
        reference = pair.tiled(work=f"work-{even}").reference
        assert [notice.code for notice in reference.warnings if notice.code == SAMPLED_REGION] == codes
    check_text(*(notice.text for notice in reference.warnings if notice.code == SAMPLED_REGION))


def test_a_full_disk_names_the_file(pair, monkeypatch):
    def full(*_):
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr("pcbench.measure.tiled.columns.write_array", full)
    with pytest.raises(OSError, match="No space left on device") as error:
        pair.tiled()
    assert error.value.errno == errno.ENOSPC and str(error.value.filename).endswith(".npy")
    assert not list(pair.folder.rglob("*.npy"))
    monkeypatch.undo()
    in_this_process(monkeypatch)
    check_equal(pair.tiled(), pair.memory())


@pytest.mark.long
def test_thinned_clouds_are_those_in_memory(tmp_path, monkeypatch):
    """Large clouds: cells and voxels come from every n-th point that passes the filters and lies in the region."""
    in_this_process(monkeypatch)
    monkeypatch.setattr(TilingSettings, "chosen_piece_points", 60_000)
    monkeypatch.setattr("pcbench.measure.tiled.windows.MAX_SAMPLE", 10**6)
    rng = np.random.default_rng(0)
    paths = {}
    for name, count in (("ref", 420_000), ("a", 30_000)):
        points = noisy(rng, surface(rng, count, 100.0))
        paths[name] = tmp_path / f"{name}.laz"
        classes = rng.choice([2, 6], count, p=[0.8, 0.2]).astype(np.uint8)
        write_cloud(paths[name], Cloud(points, attributes={"classification": classes}))
    pair = Pair(tmp_path / "pair", np.zeros((3, 3)), classes=(2,), crop="box:0,0,-99,80,95,99")
    pair.paths = paths
    tiled = pair.tiled(tile_points=50_000)
    assert tiled.reference.points_in_region > 200_000
    check_equal(tiled, pair.memory())
