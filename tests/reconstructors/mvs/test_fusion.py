"""Fusion of exact maps: a plane and a city are recovered only with the right pixel conventions."""

import os

import numpy as np
import pytest
from exact_maps import mesh_map, plane_map
from optional import import_or_skip
from PIL import Image
from wording import check_error

from pcbench.errors import ReconstructionError
from pcbench.geometry.cameras import Camera, Intrinsics, look_at
from pcbench.geometry.mesh import MeshIndex
from pcbench.geometry.neighbors import Index
from pcbench.geometry.visibility import in_frame
from pcbench.io.meshes import read_mesh
from pcbench.scenes.synthetic.plan import CitySettings
from pcbench.scenes.synthetic.rigs import Site, rig
from pcbench.scenes.synthetic.surface import build_city
from pcbench.scenes.synthetic.truth import surface_cloud
from reconstructors.mvs.filter import Criteria, filter_map
from reconstructors.mvs.fusion import (
    FUSED,
    OverlapSamples,
    build_tracks,
    fuse,
    link_maps,
    read_fused,
    read_visibility,
    sample_overlap,
    write_mesh,
    write_workspace,
)
from reconstructors.mvs.maps import write_map

import_or_skip("pycolmap")

K = Intrinsics(160, 120, 150.0, 155.0, 81.0, 58.5)


def over_a_plane(count=5):
    return [Camera(f"{k}/a b.jpg", K, look_at([0.5 * k, 0.4 * (k % 2), 5], [0.4 * k, 0, 0])) for k in range(count)]


def fused(folder, cameras, maps, image=None):
    """Fuse maps with the reconstructor's steps; return the arguments of `read_fused`."""
    by_name = {camera.name: camera for camera in cameras}
    overlaps, folders, images, counts = {}, {}, {}, {}
    for k, (camera, depth_map) in enumerate(zip(cameras, maps, strict=True)):
        others = [j for j in range(len(cameras)) if j != k]
        kept, agree = filter_map(camera, depth_map, [(cameras[j], maps[j]) for j in others], Criteria())
        folders[camera.name] = folder / f"map{k}"
        folders[camera.name].mkdir()
        write_map(folders[camera.name], kept)
        counts[camera.name] = folder / f"count{k}.npy"
        np.save(counts[camera.name], np.where(kept.known, 1 + agree.sum(axis=0), 0).astype(np.uint8))
        overlaps[camera.name] = sample_overlap(camera, kept, agree, [cameras[j].name for j in others])
        images[camera.name] = folder / f"image{k}.png"
        grey = np.full((camera.intrinsics.height, camera.intrinsics.width, 3), 10 + k, np.uint8)
        Image.fromarray(grey if image is None else image(camera)).save(images[camera.name])
    workspace = folder / "fused"
    workspace.mkdir()
    write_workspace(workspace, by_name, images, build_tracks(overlaps, by_name))
    link_maps(workspace, folders)
    fuse(workspace, workspace / FUSED, by_name, 30.0)
    return workspace / FUSED, by_name, counts, 3


@pytest.fixture(scope="module")
def plane(tmp_path_factory):
    """The fused cloud of the plane z = 0, observed by five cameras from 5 above."""
    cameras = over_a_plane()
    folder = tmp_path_factory.mktemp("plane")
    return fused(folder, cameras, [plane_map(camera, (0, 0, 1), 0.0) for camera in cameras])


def test_plane_is_recovered(plane):
    cloud = read_fused(*plane)
    assert len(cloud) > 5000
    assert np.abs(cloud.points[:, 2]).max() < 1e-6 * 5
    np.testing.assert_allclose(cloud.normals, np.broadcast_to([0, 0, 1], cloud.points.shape), atol=1e-5)
    # Points are a pixel apart, 5 / 150 along a side: fusion does not thin them out.
    inner = cloud.points[(np.abs(cloud.points[:, :2] - [1, 0]) < 0.5).all(axis=1)]
    assert len(inner) == pytest.approx(1 / (5 / 150) / (5 / 155), rel=0.35)


def test_views_count_the_agreeing_images(plane):
    cloud = read_fused(*plane)
    assert cloud.attributes["views"].min() == 3
    assert cloud.attributes["views"].max() == 5
    # At most the images with a point in their frames agree on it.
    shown = sum(in_frame(camera, cloud.points, beyond=0.02).astype(int) for camera in plane[1].values())
    assert (cloud.attributes["views"] <= shown).all()
    inner = sum(in_frame(camera, cloud.points, beyond=-0.02).astype(int) for camera in plane[1].values())
    assert (cloud.attributes["views"] >= inner).mean() > 0.99
    # COLMAP's file read byte by byte.
    path = plane[0].with_name("fused.ply.vis")
    data = path.read_bytes()
    count, position, expected = int.from_bytes(data[:8], "little"), 8, []
    for point in range(count):
        length = int.from_bytes(data[position : position + 4], "little")
        positions = range(position + 4, position + 4 + 4 * length, 4)
        expected += [(point, int.from_bytes(data[at : at + 4], "little")) for at in positions]
        position += 4 + 4 * length
    assert position == len(data)
    assert list(zip(*(column.tolist() for column in read_visibility(path)), strict=True)) == expected


def test_tilted_plane_is_recovered(tmp_path):
    """Medians per coordinate leave a tilted plane by a fraction of a pixel, which is 0.033 here."""
    normal = np.array([0.2, -0.3, 0.933]) / np.linalg.norm([0.2, -0.3, 0.933])
    cameras = over_a_plane()
    path = fused(tmp_path, cameras, [plane_map(camera, normal, 0.1) for camera in cameras])
    error = read_fused(*path).points @ normal - 0.1
    assert abs(error.mean()) < 0.01 * 0.033
    assert np.abs(error).max() < 0.5 * 0.033


def test_city_is_recovered(tmp_path):
    """The error is a tenth of a pixel's footprint, and all surface is covered that three cameras observe."""
    city = build_city(CitySettings(extent=100.0, seed=2), texel=4.0)
    plan, index = city.plan, MeshIndex(city.mesh)
    k = Intrinsics(160, 120, 130.0, 130.0, 80.0, 60.0)
    cameras = rig("oblique", 8, Site(100.0, float(np.median(plan.terrain.heights)), plan.top), k)
    path = fused(tmp_path, cameras, [mesh_map(camera, index) for camera in cameras])
    cloud = read_fused(*path)
    truth = surface_cloud(plan, index, cameras, 4000)
    footprint = float(np.median([np.median(mesh_map(c, index).depth) / k.fx for c in cameras]))
    off = index.query(cloud.points).distances
    assert np.median(off) < 0.1 * footprint
    assert np.quantile(off, 0.9) < footprint
    seen = truth.points[truth.attributes["visible"] > 0]
    assert len(seen) > 1000
    near = Index(cloud.points).query(seen).distances
    assert (near < 2 * footprint).mean() > 0.9


def test_empty_fusion_is_reported(tmp_path):
    cameras = over_a_plane(3)
    maps = [plane_map(camera, (0, 0, 1), 0.0) for camera in cameras]
    path = fused(tmp_path, cameras, [depth_map.where(np.zeros(depth_map.depth.shape, bool)) for depth_map in maps])
    with check_error(ReconstructionError):
        read_fused(*path)


@pytest.mark.parametrize("cut", [FUSED, f"{FUSED}.vis", "sparse/images.bin"])
def test_truncated_colmap_files_are_refused(tmp_path, monkeypatch, cut):
    """On a full disk COLMAP writes truncated files without an error."""
    import pycolmap

    def shorten(path):
        os.truncate(path, path.stat().st_size - 10)

    fuse_completely, write_completely = pycolmap.stereo_fusion, pycolmap.Reconstruction.write

    def fuse_partly(out, *arguments, **options):
        fuse_completely(out, *arguments, **options)
        shorten(out.with_name(cut))

    def write_partly(model, folder):
        write_completely(model, folder)
        shorten(folder.parent / cut)

    if cut.startswith("sparse"):
        monkeypatch.setattr(pycolmap.Reconstruction, "write", write_partly)
    else:
        monkeypatch.setattr(pycolmap, "stereo_fusion", fuse_partly)
    cameras = over_a_plane()
    with check_error(ReconstructionError):
        fused(tmp_path, cameras, [plane_map(camera, (0, 0, 1), 0.0) for camera in cameras])


def test_mesh_of_the_plane(plane, tmp_path):
    faces = write_mesh(plane[0], tmp_path / "mesh.ply", np.array([0.0, 0, 7]), "m")
    mesh = read_mesh(tmp_path / "mesh.ply")
    assert len(mesh) == faces > 500
    inside = (mesh.vertices[:, :2] > [0.2, -0.8]).all(axis=1) & (mesh.vertices[:, :2] < [1.4, 0.8]).all(axis=1)
    assert inside.any()
    assert np.abs(mesh.vertices[inside, 2] - 7).max() < 0.02
    # There is no surface where there are no points.
    assert np.ptp(mesh.vertices, axis=0).max() < 8
    assert not list(tmp_path.glob(".*"))


def test_overlap_samples_form_a_grid_of_known_depths():
    camera = over_a_plane(1)[0]
    depth_map = plane_map(camera, (0, 0, 1), 0.0)
    agree = np.zeros((2, 120, 160), bool)
    agree[1] = True
    overlap = sample_overlap(camera, depth_map.where(np.arange(160) < 80), agree, ["b", "c"])
    assert isinstance(overlap, OverlapSamples)
    assert len(overlap.points) == 20 * 13  # every sixth of 120 rows and of 80 columns
    assert np.abs(overlap.points[:, 2]).max() < 1e-5
    tracks = build_tracks({camera.name: overlap}, [camera.name, "b", "c"])
    assert [track.image_ids.tolist() for track in tracks[:2]] == [[1, 3], [1, 3]]
