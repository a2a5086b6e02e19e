"""Fusion block by block: each depth is used once, and the cloud is that of a single block except at the borders."""

import numpy as np
import pytest
from exact_maps import plane_map
from filtered_maps import cameras_over_plane, filter_maps, filtered_plane
from optional import import_or_skip
from wording import check_error

from pcbench.errors import ReconstructionError
from pcbench.geometry.neighbors import Index
from pcbench.io import read_cloud
from reconstructors.mvs import blocks
from reconstructors.mvs.blocks import fuse_blocks, fused_files, plan_cells
from reconstructors.mvs.cells import SPACE
from reconstructors.mvs.fusion import FUSED, write_mesh
from reconstructors.mvs.maps import read_depth, read_raster

import_or_skip("pycolmap")

PIXEL = 5 / 150  # size on the plane


def quarters(x=0.8, y=0.1):
    """Return four cells that meet at (x, y)."""
    return [part for half in SPACE.split(0, x) for part in half.split(1, y)]


@pytest.fixture(scope="module")
def plane(tmp_path_factory):
    """The filtered maps of a plane, and its cloud from a single block."""
    folder = tmp_path_factory.mktemp("plane")
    images = filtered_plane(folder)
    return images, fuse_blocks(images, [SPACE], PIXEL, 3, folder)


def fused_depths(monkeypatch):
    """Return a list that gets the depth maps of each fused workspace by the path of their photographs."""
    workspaces, fuse = [], blocks.fuse

    def record(workspace, *arguments):
        depths = {
            (workspace / "images" / path.name.removesuffix(".geometric.bin")).resolve(): read_raster(path)
            for path in (workspace / "stereo/depth_maps").iterdir()
        }
        workspaces.append(depths)
        fuse(workspace, *arguments)

    monkeypatch.setattr(blocks, "fuse", record)
    return workspaces


def test_each_depth_is_fused_in_exactly_one_block(plane, tmp_path, monkeypatch):
    images, _ = plane
    workspaces = fused_depths(monkeypatch)
    fuse_blocks(images, quarters(), PIXEL, 3, tmp_path)
    assert len(workspaces) == 4
    for image in images.values():
        maps = [depths[image.photograph.resolve()] for depths in workspaces if image.photograph.resolve() in depths]
        assert len(maps) > 1
        depth = read_depth(image.map)
        np.testing.assert_array_equal(sum(map_ > 0 for map_ in maps), depth > 0)
        np.testing.assert_array_equal(sum(maps), depth)


def test_blocks_yield_the_cloud_of_a_single_one_except_at_their_borders(plane, tmp_path):
    images, whole = plane
    cells = quarters()
    cloud = fuse_blocks(images, cells, PIXEL, 3, tmp_path)
    for cell, path in zip(cells, fused_files(tmp_path), strict=True):
        assert cell.grow(1e-6).contains(read_cloud(path).points).all()  # COLMAP rounds to float32
    border = np.abs(cloud.points[:, :2] - [0.8, 0.1]).min(axis=1)
    there, back = Index(whole.points).query(cloud.points).distances, Index(cloud.points).query(whole.points).distances
    # The order in which COLMAP visits the images of a block decides which pixels are merged.
    assert (there[border > 3 * PIXEL] < 1e-3 * PIXEL).mean() > 0.9
    assert max(there.max(), back.max()) < PIXEL
    # No row of points is missing or doubled along the borders.
    assert len(cloud) == pytest.approx(len(whole), rel=0.02)
    on_whole = np.abs(whole.points[:, :2] - [0.8, 0.1]).min(axis=1) < PIXEL
    assert on_whole.sum() < (border < PIXEL).sum() < 1.5 * on_whole.sum()
    np.testing.assert_array_equal(np.unique(cloud.attributes["views"]), [3, 4, 5])


@pytest.mark.long
def test_a_killed_run_resumes_with_the_next_block(plane, tmp_path, monkeypatch):
    images, _ = plane
    (tmp_path / "whole").mkdir()
    expected = fuse_blocks(images, quarters(), PIXEL, 3, tmp_path / "whole")
    fuse = blocks.fuse

    def fail_in_third(workspace, *arguments):
        if "0003" in workspace.name:
            raise KeyboardInterrupt
        fuse(workspace, *arguments)

    monkeypatch.setattr(blocks, "fuse", fail_in_third)
    with pytest.raises(KeyboardInterrupt):
        fuse_blocks(images, quarters(), PIXEL, 3, tmp_path)
    monkeypatch.setattr(blocks, "fuse", fuse)
    workspaces = fused_depths(monkeypatch)
    cloud = fuse_blocks(images, quarters(), PIXEL, 3, tmp_path)
    assert len(workspaces) == 2
    for part in ("points", "normals", "colors"):
        np.testing.assert_array_equal(getattr(cloud, part), getattr(expected, part))
    np.testing.assert_array_equal(cloud.attributes["views"], expected.attributes["views"])
    # A run with more memory removes the other blocks.
    fuse_blocks(images, [SPACE], PIXEL, 3, tmp_path)
    assert [path.parent.name for path in fused_files(tmp_path)] == ["0001"]
    assert not list((tmp_path / "blocks").glob("*/stereo"))


def test_blocks_without_depths_and_with_one_image_are_fused(plane, tmp_path):
    """The first and the last camera alone see the ends of the plane, if depths need no other image."""
    images, _ = plane
    left = min(float(image.overlap.points[:, 0].min()) for image in images.values())
    empty, rest = SPACE.split(0, left - 10)
    edge, rest = rest.split(0, left + 0.2 * PIXEL)
    cloud = fuse_blocks(images, [empty, edge, rest], PIXEL, 3, tmp_path)
    assert not (tmp_path / "blocks/0001" / FUSED).exists()
    assert len(fused_files(tmp_path)) == 2
    assert cloud.points[:, 0].min() < left + 0.2 * PIXEL
    one = {name: image for name, image in images.items() if name == "2/a b.jpg"}
    (tmp_path / "one").mkdir()
    alone = fuse_blocks(one, quarters(), PIXEL, 3, tmp_path / "one")
    (image,) = one.values()
    assert len(alone) == image.depths


def test_a_mesh_is_made_of_the_points_of_all_blocks(plane, tmp_path, monkeypatch):
    import pycolmap

    images, _ = plane
    fuse_blocks(images, quarters(), PIXEL, 3, tmp_path)
    clouds = [read_cloud(path) for path in fused_files(tmp_path)]

    def check_points(points, out, options):
        joined = read_cloud(points)
        for part in ("points", "normals", "colors"):
            np.testing.assert_array_equal(getattr(joined, part), np.concatenate([getattr(c, part) for c in clouds]))
        assert options.depth == 8  # half of the logarithm of the number of points
        raise RuntimeError("the points were read")

    monkeypatch.setattr(pycolmap, "poisson_meshing", check_points)
    with pytest.raises(ReconstructionError, match="the points were read"):
        write_mesh(fused_files(tmp_path), tmp_path / "mesh.ply", np.zeros(3), None)
    assert not list(tmp_path.glob("*mesh*"))


def test_a_fusion_without_points_is_reported(tmp_path):
    cameras = cameras_over_plane(3)
    hidden = [plane_map(camera, (0, 0, 1), 0.0).where(np.zeros((120, 160), bool)) for camera in cameras]
    images = filter_maps(tmp_path, cameras, hidden)
    for cells in ([SPACE], quarters()):
        with check_error(ReconstructionError):
            fuse_blocks(images, cells, PIXEL, 3, tmp_path)


def test_cells_are_planned_for_the_points_that_fit_into_memory(plane, monkeypatch):
    images, whole = plane
    assert plan_cells(images, 4.0) == [SPACE]
    monkeypatch.setattr(blocks, "_MIN_BLOCK_POINTS", 10)
    cells = plan_cells(images, len(whole) / 4 * 600 / 1e9)
    counts = [np.count_nonzero(cell.contains(whole.points)) for cell in cells]
    assert sum(counts) == len(whole)
    assert len(cells) in (4, 5, 6, 7, 8)
    assert max(counts) < 1.5 * len(whole) / 4
    # A minimum bounds the number of blocks, whatever the memory.
    monkeypatch.undo()
    assert len(plan_cells(images, 1e-9)) <= max(1, len(whole) // 5000)
