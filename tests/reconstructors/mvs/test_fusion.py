"""Fusing exact maps: pixel conventions are right where a plane and a city come back."""

import numpy as np
import pytest
from exact_maps import mesh_map, plane_map
from PIL import Image

from pcbench.errors import ReconstructionError
from pcbench.geometry.cameras import Camera, Intrinsics, look_at
from pcbench.geometry.mesh import MeshIndex
from pcbench.geometry.neighbors import Index
from pcbench.io.meshes import read_mesh
from pcbench.scenes.synthetic.plan import CitySettings
from pcbench.scenes.synthetic.rigs import Site, rig
from pcbench.scenes.synthetic.surface import build_city
from pcbench.scenes.synthetic.truth import surface_cloud
from reconstructors.mvs.filter import Criteria, filter_map
from reconstructors.mvs.fusion import (
    FUSED,
    Links,
    fuse,
    link_maps,
    links,
    read_fused,
    tracks_of,
    visibility_counts,
    write_mesh,
    write_workspace,
)
from reconstructors.mvs.maps import write_map

pytest.importorskip("pycolmap")

K = Intrinsics(160, 120, 150.0, 155.0, 81.0, 58.5)


def over_a_plane(count=5):
    return [Camera(f"{k}/a b.jpg", K, look_at([0.5 * k, 0.4 * (k % 2), 5], [0.4 * k, 0, 0])) for k in range(count)]


def fused(folder, cameras, maps, image=None):
    """The cloud of maps by the steps that the reconstructor takes; with two views fusion alone decides."""
    by_name = {camera.name: camera for camera in cameras}
    found, folders, images = {}, {}, {}
    for k, (camera, made) in enumerate(zip(cameras, maps, strict=True)):
        others = [j for j in range(len(cameras)) if j != k]
        kept, agree = filter_map(camera, made, [(cameras[j], maps[j]) for j in others], Criteria(views=2))
        folders[camera.name] = folder / f"map{k}"
        folders[camera.name].mkdir()
        write_map(folders[camera.name], kept)
        found[camera.name] = links(camera, kept, agree, [cameras[j].name for j in others])
        images[camera.name] = folder / f"image{k}.png"
        grey = np.full((camera.intrinsics.height, camera.intrinsics.width, 3), 10 + k, np.uint8)
        Image.fromarray(grey if image is None else image(camera)).save(images[camera.name])
    workspace = folder / "fused"
    workspace.mkdir()
    write_workspace(workspace, by_name, images, tracks_of(found, by_name))
    link_maps(workspace, folders)
    fuse(workspace, workspace / FUSED, by_name, 3)
    return workspace / FUSED


@pytest.fixture(scope="module")
def plane(tmp_path_factory):
    """The fused file of the plane z = 0, seen by five cameras from 5 above."""
    cameras = over_a_plane()
    folder = tmp_path_factory.mktemp("plane")
    return fused(folder, cameras, [plane_map(camera, (0, 0, 1), 0.0) for camera in cameras])


def test_a_plane_comes_back(plane):
    cloud = read_fused(plane, np.zeros(3), "m")
    assert len(cloud) > 5000
    assert np.abs(cloud.points[:, 2]).max() < 1e-6 * 5
    np.testing.assert_allclose(cloud.normals, np.broadcast_to([0, 0, 1], cloud.points.shape), atol=1e-5)
    assert cloud.unit == "m"
    # Points are a pixel apart, not fewer and larger: 5 / 150 along a side.
    inner = cloud.points[(np.abs(cloud.points[:, :2] - [1, 0]) < 0.5).all(axis=1)]
    assert len(inner) == pytest.approx(1 / (5 / 150) / (5 / 155), rel=0.35)
    # In another frame it is the same cloud there.
    moved = read_fused(plane, np.array([4e5, 5e6, 100.0]), None)
    np.testing.assert_allclose(moved.points - [4e5, 5e6, 100.0], cloud.points, atol=1e-8)


def test_images_are_counted(plane):
    cloud = read_fused(plane, np.zeros(3), None)
    assert cloud.attributes["views"].min() == 3
    assert cloud.attributes["views"].max() == 5
    # The file of COLMAP read byte by byte.
    data = plane.with_name("fused.ply.vis").read_bytes()
    count, place, expected = int.from_bytes(data[:8], "little"), 8, []
    for _ in range(count):
        expected.append(int.from_bytes(data[place : place + 4], "little"))
        place += 4 + 4 * expected[-1]
    assert place == len(data)
    assert list(visibility_counts(plane.with_name("fused.ply.vis"))) == expected


def test_a_tilted_plane_comes_back(tmp_path):
    """Medians of each coordinate apart leave a tilted plane by a part of a pixel, which is 0.033 here."""
    normal = np.array([0.2, -0.3, 0.933]) / np.linalg.norm([0.2, -0.3, 0.933])
    cameras = over_a_plane()
    path = fused(tmp_path, cameras, [plane_map(camera, normal, 0.1) for camera in cameras])
    error = read_fused(path, np.zeros(3), None).points @ normal - 0.1
    assert abs(error.mean()) < 0.01 * 0.033
    assert np.abs(error).max() < 0.5 * 0.033


def test_a_city_comes_back(tmp_path):
    """To a tenth of the pixel's footprint, and all of it that three cameras see."""
    city = build_city(CitySettings(extent=100.0, seed=2), texel=4.0)
    plan, index = city.plan, MeshIndex(city.mesh)
    k = Intrinsics(160, 120, 130.0, 130.0, 80.0, 60.0)
    cameras = rig("oblique", 8, Site(100.0, float(np.median(plan.terrain.heights)), plan.top), k)
    path = fused(tmp_path, cameras, [mesh_map(camera, index) for camera in cameras])
    cloud = read_fused(path, np.zeros(3), "m")
    truth = surface_cloud(plan, index, cameras, 4000)
    footprint = float(np.median([np.median(mesh_map(c, index).depth) / k.fx for c in cameras]))
    off = index.query(cloud.points).distances
    assert np.median(off) < 0.1 * footprint
    assert np.quantile(off, 0.9) < footprint
    seen = truth.points[truth.attributes["visible"] > 0]
    assert len(seen) > 1000
    near = Index(cloud.points).query(seen).distances
    assert (near < 2 * footprint).mean() > 0.9


def test_nothing_fused_is_said(tmp_path):
    cameras = over_a_plane(3)
    maps = [plane_map(camera, (0, 0, 1), 0.0) for camera in cameras]
    path = fused(tmp_path, cameras, [made.where(np.zeros(made.depth.shape, bool)) for made in maps])
    with pytest.raises(ReconstructionError, match="nothing is fused"):
        read_fused(path, np.zeros(3), None)


def test_a_mesh_of_the_plane(plane, tmp_path):
    faces = write_mesh(plane, tmp_path / "mesh.ply", np.array([0.0, 0, 7]), "m")
    mesh = read_mesh(tmp_path / "mesh.ply")
    assert len(mesh) == faces > 500
    inside = (mesh.vertices[:, :2] > [0.2, -0.8]).all(axis=1) & (mesh.vertices[:, :2] < [1.4, 0.8]).all(axis=1)
    assert inside.any()
    assert np.abs(mesh.vertices[inside, 2] - 7).max() < 0.02
    # Where there were no points no surface is made up.
    assert np.ptp(mesh.vertices, axis=0).max() < 8
    assert not list(tmp_path.glob(".*"))


def test_links_are_on_a_grid_of_what_is_known():
    camera = over_a_plane(1)[0]
    made = plane_map(camera, (0, 0, 1), 0.0)
    agree = np.zeros((2, 120, 160), bool)
    agree[1] = True
    found = links(camera, made.where(np.arange(160) < 80), agree, ["b", "c"])
    assert isinstance(found, Links)
    assert len(found.points) == 20 * 13  # every sixth of 120 rows and of 80 columns
    assert np.abs(found.points[:, 2]).max() < 1e-5
    ours = tracks_of({camera.name: found}, [camera.name, "b", "c"])
    assert [track.images.tolist() for track in ours[:2]] == [[1, 3], [1, 3]]
