"""Fusion of exact maps: a plane and a city are recovered only with the right pixel conventions."""

import os

import numpy as np
import pytest
from exact_maps import mesh_map, plane_map
from filtered_maps import cameras_over_plane, filter_maps
from optional import import_or_skip
from wording import check_error

from pcbench.errors import ReconstructionError
from pcbench.geometry.cameras import Intrinsics
from pcbench.geometry.mesh import MeshIndex
from pcbench.geometry.neighbors import Index
from pcbench.geometry.visibility import in_frame
from pcbench.io.meshes import read_mesh
from pcbench.scenes.synthetic.plan import CitySettings
from pcbench.scenes.synthetic.rigs import Site, rig
from pcbench.scenes.synthetic.surface import build_city
from pcbench.scenes.synthetic.truth import surface_cloud
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

import_or_skip("pycolmap")


def fuse_maps(folder, cameras, maps, image=None):
    """Fuse maps with the reconstructor's steps; return the arguments of `read_fused`."""
    images = filter_maps(folder, cameras, maps, image)
    cameras_by_name = {name: image.camera for name, image in images.items()}
    workspace = folder / "fused"
    workspace.mkdir()
    tracks = build_tracks({name: image.overlap for name, image in images.items()}, cameras_by_name)
    write_workspace(workspace, cameras_by_name, {name: image.photograph for name, image in images.items()}, tracks)
    link_maps(workspace, {name: image.map for name, image in images.items()})
    fuse(workspace, workspace / FUSED, cameras_by_name, 30.0)
    return (
        workspace / FUSED,
        cameras_by_name,
        *({n: getattr(image, part) for n, image in images.items()} for part in ("counts", "percents")),
        3,
    )


@pytest.fixture(scope="module")
def plane(tmp_path_factory):
    """The fused cloud of the plane z = 0, observed by five cameras from 5 above."""
    cameras = cameras_over_plane()
    folder = tmp_path_factory.mktemp("plane")
    return fuse_maps(folder, cameras, [plane_map(camera, (0, 0, 1), 0.0) for camera in cameras])


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
    frame_counts = sum(in_frame(camera, cloud.points, beyond=0.02).astype(int) for camera in plane[1].values())
    assert (cloud.attributes["views"] <= frame_counts).all()
    inner_frame_counts = sum(in_frame(camera, cloud.points, beyond=-0.02).astype(int) for camera in plane[1].values())
    assert (cloud.attributes["views"] >= inner_frame_counts).mean() > 0.99
    # COLMAP's file read byte by byte.
    path = plane[0].with_name("fused.ply.vis")
    data = path.read_bytes()
    count, position, expected = int.from_bytes(data[:8], "little"), 8, []
    for point in range(count):
        length = int.from_bytes(data[position : position + 4], "little")
        positions = range(position + 4, position + 4 + 4 * length, 4)
        expected += [(point, int.from_bytes(data[offset : offset + 4], "little")) for offset in positions]
        position += 4 + 4 * length
    assert position == len(data)
    assert list(zip(*(column.tolist() for column in read_visibility(path)), strict=True)) == expected


def test_tilted_plane_is_recovered(tmp_path):
    """Medians per coordinate leave a tilted plane by a fraction of a pixel, which is 0.033 here."""
    normal = np.array([0.2, -0.3, 0.933]) / np.linalg.norm([0.2, -0.3, 0.933])
    cameras = cameras_over_plane()
    arguments = fuse_maps(tmp_path, cameras, [plane_map(camera, normal, 0.1) for camera in cameras])
    error = read_fused(*arguments).points @ normal - 0.1
    assert abs(error.mean()) < 0.01 * 0.033
    assert np.abs(error).max() < 0.5 * 0.033


@pytest.mark.long
def test_city_is_recovered(tmp_path):
    """The error is a tenth of a pixel's footprint, and all surface is covered that three cameras observe."""
    city = build_city(CitySettings(extent=100.0, seed=2), texel=4.0)
    plan, index = city.plan, MeshIndex(city.mesh)
    k = Intrinsics(160, 120, 130.0, 130.0, 80.0, 60.0)
    cameras = rig("oblique", 8, Site(100.0, float(np.median(plan.terrain.heights)), plan.top), k)
    arguments = fuse_maps(tmp_path, cameras, [mesh_map(camera, index) for camera in cameras])
    cloud = read_fused(*arguments)
    truth = surface_cloud(plan, index, cameras, 4000)
    footprint = float(np.median([np.median(mesh_map(c, index).depth) / k.fx for c in cameras]))
    errors = index.query(cloud.points).distances
    assert np.median(errors) < 0.1 * footprint
    assert np.quantile(errors, 0.9) < footprint
    visible_points = truth.points[truth.attributes["visible"] > 0]
    assert len(visible_points) > 1000
    gaps = Index(cloud.points).query(visible_points).distances
    assert (gaps < 2 * footprint).mean() > 0.9


@pytest.mark.parametrize("file_name", [FUSED, f"{FUSED}.vis", "sparse/images.bin"])
def test_truncated_colmap_files_are_refused(tmp_path, monkeypatch, file_name):
    """On a full disk COLMAP writes truncated files without an error."""
    import pycolmap

    def truncate(path):
        os.truncate(path, path.stat().st_size - 10)

    stereo_fusion, write = pycolmap.stereo_fusion, pycolmap.Reconstruction.write

    def fuse_and_truncate(out, *arguments, **options):
        stereo_fusion(out, *arguments, **options)
        truncate(out.with_name(file_name))

    def write_and_truncate(model, folder):
        write(model, folder)
        truncate(folder.parent / file_name)

    if file_name.startswith("sparse"):
        monkeypatch.setattr(pycolmap.Reconstruction, "write", write_and_truncate)
    else:
        monkeypatch.setattr(pycolmap, "stereo_fusion", fuse_and_truncate)
    cameras = cameras_over_plane()
    with check_error(ReconstructionError):
        fuse_maps(tmp_path, cameras, [plane_map(camera, (0, 0, 1), 0.0) for camera in cameras])


@pytest.mark.long
def test_mesh_of_the_plane(plane, tmp_path):
    faces = write_mesh([plane[0]], tmp_path / "mesh.ply", np.array([0.0, 0, 7]), "m")
    mesh = read_mesh(tmp_path / "mesh.ply")
    assert len(mesh) == faces > 500
    is_inner = (mesh.vertices[:, :2] > [0.2, -0.8]).all(axis=1) & (mesh.vertices[:, :2] < [1.4, 0.8]).all(axis=1)
    assert is_inner.any()
    assert np.abs(mesh.vertices[is_inner, 2] - 7).max() < 0.02
    # There is no surface where there are no points.
    assert np.ptp(mesh.vertices, axis=0).max() < 8
    assert not list(tmp_path.glob(".*"))


def test_overlap_samples_form_a_grid_of_known_depths():
    camera = cameras_over_plane(1)[0]
    depth_map = plane_map(camera, (0, 0, 1), 0.0)
    agreement = np.zeros((2, 120, 160), bool)
    agreement[1] = True
    overlap = sample_overlap(camera, depth_map.where(np.arange(160) < 80), agreement, ["b", "c"])
    assert isinstance(overlap, OverlapSamples)
    assert len(overlap.points) == 20 * 13  # every sixth of 120 rows and of 80 columns
    assert np.abs(overlap.points[:, 2]).max() < 1e-5
    tracks = build_tracks({camera.name: overlap}, [camera.name, "b", "c"])
    assert [track.image_ids.tolist() for track in tracks[:2]] == [[1, 3], [1, 3]]
