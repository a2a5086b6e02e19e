"""Dense multi-view stereo from photographs to a cloud, with exact maps instead of the matcher's."""

import re
import shutil

import numpy as np
import pytest
import textured_corner as corner
from data_folder import data_folder
from exact_maps import ExactMatcher, corner_map, rays
from optional import import_or_skip
from PIL import Image
from stereo_cases import PAIRS, point_errors, read_pair, write_pair_scene
from wording import check_error, check_text

from pcbench.errors import ReconstructionError
from pcbench.geometry.cameras import Intrinsics
from pcbench.geometry.neighbors import Index
from pcbench.io import read_cloud
from pcbench.io.colmap_model import read_colmap_cameras
from pcbench.scenes import read_scene
from reconstructors.mvs.maps import read_map
from reconstructors.mvs.mvs import DenseMvs, median_footprint

import_or_skip("pycolmap")

K = corner.standard_intrinsics(240, 180)


@pytest.fixture(scope="module")
def photographs(tmp_path_factory):
    """Five images of the corner with their true cameras."""
    return corner.write_scene(tmp_path_factory.mktemp("corner"), corner.cameras(5, K))


@pytest.fixture(scope="module")
def completed_run(photographs, tmp_path_factory):
    """Return a workspace after one run with exact maps, the reconstruction, and the matcher."""
    workspace, scene = tmp_path_factory.mktemp("solved"), read_scene(photographs)
    with pytest.MonkeyPatch.context() as patch:
        matcher = ExactMatcher(scene.cameras, corner_map).install(patch)
        reconstruction = DenseMvs(backend="bundled").reconstruct(scene, workspace)
    return workspace, reconstruction, matcher


@pytest.fixture
def workspace(completed_run, tmp_path):
    """Return a copy of the workspace that a test may change."""
    shutil.copytree(completed_run[0], tmp_path / "work", symlinks=True)
    return tmp_path / "work"


def test_exact_maps_yield_an_exact_cloud(completed_run, photographs):
    _, reconstruction, matcher = completed_run
    cloud = reconstruction.cloud
    assert reconstruction.gauge == "georeferenced"
    assert len(reconstruction.cameras) == 5
    assert len(cloud) > 10_000
    # A pixel is 23 mm. Fusion takes medians per coordinate, which leave a plane by a fraction of a pixel at edges.
    error = corner.distances(cloud.points)
    assert np.median(error) < 1e-5
    assert np.quantile(error, 0.99) < 0.002
    assert set(np.unique(cloud.attributes["views"])) == {2, 3, 4, 5}
    assert cloud.attributes["confidence"].mean() > 0.97
    normals = np.eye(3)[np.argmin(np.abs(cloud.points), axis=1)]
    assert np.quantile(np.einsum("ni,ni->n", normals, cloud.normals), 0.01) > 0.99
    # A point has the colour of the photograph at its projection.
    scene = read_scene(photographs)
    pixels, _ = scene.cameras["003.png"].project(cloud.points)
    inside = ((pixels > 5) & (pixels < [235, 175])).all(axis=1)
    x, y = pixels[inside].astype(int).T
    photograph = scene.read_image("003.png")[y, x].astype(float)
    assert np.median(np.abs(photograph - cloud.colors[inside])) < 6
    # Each image was matched once, within a depth range that contains its true depths.
    assert sorted(view.camera.name for view, _, _ in matcher.matched) == list(scene.images)
    for view, sources, (near, far) in matcher.matched:
        depth = corner_map(scene.cameras[view.camera.name]).depth
        assert sources and len(sources) <= 4
        assert near < np.quantile(depth[depth > 0], 0.05)
        assert far > np.quantile(depth[depth > 0], 0.95)


def test_choices_are_reported(completed_run):
    notes = check_text("\n".join(completed_run[1].notes))
    for value in ("bundled", "240 pixels", "about 0.02", "3 + 2 iterations over 2 levels", "5 depth maps"):
        assert value in notes


def test_median_footprint_counts_images_by_their_area():
    """Over all pairs of a place and an image: one image far above the ground shows as much as 16 at a quarter of it."""
    k = Intrinsics(300, 200, 100.0, 100.0, 150.0, 100.0)
    assert median_footprint([10.0] * 15 + [40.0], [k] * 16) == pytest.approx(0.4)
    assert median_footprint([10.0] * 17 + [40.0], [k] * 18) == pytest.approx(0.1)
    half = k.scaled(0.5)  # shows the same area with pixels twice as large
    assert median_footprint([10.0, 10.0, 10.0], [k, k, half]) == pytest.approx(0.1)


def test_workspace_keeps_the_maps(completed_run):
    workspace, reconstruction, _ = completed_run
    cameras = read_colmap_cameras(workspace / "maps")
    assert [camera.name for camera in cameras] == sorted(reconstruction.cameras)
    for camera in cameras:
        stored_map, true_map = read_map(workspace / "maps" / camera.name), corner_map(camera)
        known = stored_map.known
        assert known.mean() > 0.5 * true_map.known.mean()
        np.testing.assert_allclose(stored_map.depth[known], true_map.depth[known], rtol=1e-6)
        np.testing.assert_allclose(stored_map.normal[known], true_map.normal[known], atol=1e-5)
        assert (workspace / "views" / camera.name / "image.png").is_file()


def test_mesh_is_written_on_request(workspace, completed_run, photographs, monkeypatch):
    calls = []

    def fake_write_mesh(fused, out, origin, unit):
        calls.append((fused, out, origin, unit))
        return 1234

    monkeypatch.setattr("reconstructors.mvs.mvs.write_mesh", fake_write_mesh)
    reconstruction = DenseMvs(backend="bundled", mesh=True).reconstruct(read_scene(photographs), workspace)
    ((fused, out, origin, unit),) = calls
    assert out == workspace / "mesh.ply"
    check_text(next(note for note in reconstruction.notes if f"1234 faces: {out}" in note))
    assert unit is None
    (path,) = fused
    points = read_cloud(path).points + origin
    np.testing.assert_allclose(points, completed_run[1].cloud.points, atol=0.01)  # before the cloud is smoothed


def test_little_memory_fuses_the_same_maps_in_blocks(workspace, completed_run, photographs, monkeypatch):
    matcher = ExactMatcher(read_scene(photographs).cameras, corner_map).install(monkeypatch)
    reconstruction = DenseMvs(backend="bundled", memory=0.01).reconstruct(read_scene(photographs), workspace)
    assert not matcher.matched
    assert "5 depth maps fused in 4 blocks" in " ".join(reconstruction.notes)
    whole = completed_run[1].cloud
    assert len(reconstruction.cloud) == pytest.approx(len(whole), rel=0.01)
    means = [np.mean(cloud.attributes["confidence"]) for cloud in (reconstruction.cloud, whole)]
    assert means[0] == pytest.approx(means[1], abs=0.001)
    distances = Index(whole.points).query(reconstruction.cloud.points).distances
    assert np.mean(distances == 0) > 0.5
    assert np.quantile(distances, 0.99) < 0.023  # a pixel


def test_resumed_run_computes_only_the_missing_maps(workspace, completed_run, photographs, monkeypatch):
    scene = read_scene(photographs)
    for path in ("photometric/003.png", "geometric/003.png", "maps/003.png"):
        shutil.rmtree(workspace / path)
    (workspace / "photometric/.003.png.partial").mkdir()
    (workspace / "photometric/.003.png.partial/depth.bin").write_bytes(b"480&3")
    matcher = ExactMatcher(scene.cameras, corner_map).install(monkeypatch)
    reconstruction = DenseMvs(backend="bundled").reconstruct(scene, workspace)
    assert [view.camera.name for view, _, _ in matcher.matched] == ["003.png"]
    assert matcher.refined == ["003.png"]
    np.testing.assert_array_equal(reconstruction.cloud.points, completed_run[1].cloud.points)
    # Other criteria use the same maps.
    strict_reconstruction = DenseMvs(backend="bundled", views=4, precision=1.0).reconstruct(scene, workspace)
    assert len(matcher.matched) == 1
    assert strict_reconstruction.cloud.attributes["views"].min() >= 4
    assert strict_reconstruction.cloud.attributes["confidence"].min() == 1
    assert "% of the others are expected" in check_text(next(n for n in strict_reconstruction.notes if "dropped" in n))


def test_masked_pixels_yield_no_points(photographs, tmp_path, monkeypatch):
    folder = tmp_path / "scene"
    shutil.copytree(photographs, folder)
    (folder / "masks").mkdir()
    cameras = corner.cameras(5, K)
    for camera in cameras:
        # The mask hides everything below a height of 0.5.
        depth = corner_map(camera).depth
        points = camera.position + depth[..., None] * rays(camera)
        Image.fromarray(np.where(points[..., 2] < 0.5, 0, 255).astype(np.uint8)).save(folder / "masks" / camera.name)
    scene = read_scene(folder)
    assert len(scene.masks) == 5
    (tmp_path / "work").mkdir()
    matcher = ExactMatcher(scene.cameras, corner_map).install(monkeypatch)
    reconstruction = DenseMvs(backend="bundled").reconstruct(scene, tmp_path / "work")
    assert all(view.valid is not None and not view.valid.all() for view, _, _ in matcher.matched)
    assert reconstruction.cloud.points[:, 2].min() > 0.48
    assert reconstruction.cloud.points[:, 2].max() > 1


def test_failures_are_explained(completed_run, workspace, photographs, tmp_path, monkeypatch):
    scene = read_scene(photographs)
    for views, min_images in ((2, 2), (4, 4)):
        subset = scene.select(["000.png", "001.png", "002.png"][: min_images - 1])
        with check_error():
            DenseMvs(views=views).reconstruct(subset, tmp_path)

    empty_matcher = ExactMatcher(scene.cameras, lambda camera: corner_map(camera).where(np.zeros((180, 240), bool)))
    empty_matcher.install(monkeypatch)
    with check_error(ReconstructionError):
        DenseMvs(backend="bundled", seed=2).reconstruct(scene, workspace)


@pytest.mark.parametrize("poses", ["given", pytest.param("solve", marks=pytest.mark.long)])
def test_two_images_are_enough(photographs, tmp_path, monkeypatch, poses):
    """Points of two images are those on which both agree, and a note says that none confirms them.

    At a narrow angle confidences are not calibrated, so all points stay.
    """
    scene = read_scene(photographs).select(["001.png", "002.png"])
    if poses == "given":
        ExactMatcher(scene.cameras, corner_map).install(monkeypatch)
    monkeypatch.setattr("reconstructors.mvs.mvs.MIN_SCENE_ANGLE_DEG", 90.0)
    reconstruction = DenseMvs(backend="bundled", poses=poses, precision=1.0).reconstruct(scene, tmp_path)
    for start in ("two images", "warning: no uncertain points"):
        check_text(next(note for note in reconstruction.notes if note.startswith(start)))
    assert set(np.unique(reconstruction.cloud.attributes["views"])) == {2}
    assert len(reconstruction.cloud) > 5_000
    if poses == "given":
        assert np.quantile(corner.distances(reconstruction.cloud.points), 0.99) < 0.002


def test_given_cameras_suffice_without_features(photographs, tmp_path, monkeypatch):
    """Blank photographs have no features; sources and depth ranges follow from the cameras."""
    shutil.copytree(photographs, tmp_path / "blank")
    for path in (tmp_path / "blank/images").iterdir():
        Image.new("RGB", (240, 180), (90, 90, 90)).save(path)
    scene = read_scene(tmp_path / "blank")
    matcher = ExactMatcher(scene.cameras, corner_map).install(monkeypatch)
    (tmp_path / "work").mkdir()
    reconstruction = DenseMvs(backend="bundled").reconstruct(scene, tmp_path / "work")
    assert reconstruction.gauge == "georeferenced"
    assert np.quantile(corner.distances(reconstruction.cloud.points), 0.99) < 0.002
    assert sorted(view.camera.name for view, _, _ in matcher.matched) == list(scene.images)
    for view, sources, (near, far) in matcher.matched:
        depth = corner_map(scene.cameras[view.camera.name]).depth
        assert sources
        assert near < depth[depth > 0].min()
        assert far > depth.max()
    notes = check_text("\n".join(note for note in reconstruction.notes if "points" in note))
    assert "warning: no sparse points" in notes
    with check_error(ReconstructionError):
        DenseMvs(backend="bundled", poses="solve").reconstruct(scene, tmp_path / "work")


@pytest.mark.slow
@pytest.mark.parametrize("name", PAIRS)
def test_stereo_pairs(name, tmp_path):
    """Two photographs agree with depths measured by structured light."""
    photographs = data_folder("stereo") / name
    pair = read_pair(photographs)
    for part in ("scene", "work"):
        (tmp_path / part).mkdir()
    write_pair_scene(pair, photographs, tmp_path / "scene")
    reconstruction = DenseMvs(backend="bundled").reconstruct(read_scene(tmp_path / "scene"), tmp_path / "work")
    errors = np.abs(point_errors(pair, reconstruction.cloud.points))
    assert len(reconstruction.cloud) > 100_000
    assert np.median(errors) < 0.3
    assert np.mean(errors < 1) > 0.8


def test_full_disk_is_reported_before_matching(completed_run, workspace, photographs, monkeypatch):
    scene = read_scene(photographs)
    ExactMatcher(scene.cameras, corner_map).install(monkeypatch)
    folders = [workspace / folder for folder in ("views", "photometric", "geometric", "maps", "blocks")]
    files = [path for folder in folders for path in folder.rglob("*") if path.is_file() and not path.is_symlink()]
    present_bytes = sum(path.stat().st_size for path in files)

    def set_free_space(free):
        monkeypatch.setattr("shutil.disk_usage", lambda _: shutil._ntuple_diskusage(10**9, 10**9, free))

    # Files that exist already need no more space.
    set_free_space(100 * 5 * 240 * 180 - present_bytes)
    DenseMvs(backend="bundled").reconstruct(scene, workspace)
    # The estimate covers everything that a run writes, including the cloud, and not much more.
    for folder in folders:
        shutil.rmtree(folder)
    written_bytes = present_bytes + 40 * len(completed_run[1].cloud)
    set_free_space(written_bytes)
    with check_error(ReconstructionError) as error:
        DenseMvs(backend="bundled").reconstruct(scene, workspace)
    estimate = 2**20 * int(re.search(r"need (\d+) MiB more", str(error.value))[1])
    assert written_bytes < estimate < 1.5 * written_bytes


def test_images_without_depths_are_named(workspace, photographs, monkeypatch):
    scene = read_scene(photographs)

    def map_without_last(camera):
        depth_map = corner_map(camera)
        return depth_map.where(np.full(depth_map.depth.shape, camera.name != "004.png"))

    matcher = ExactMatcher(scene.cameras, map_without_last).install(monkeypatch)
    reconstruction = DenseMvs(backend="bundled", seed=4).reconstruct(scene, workspace)
    assert len(matcher.matched) == 5  # another seed needs new maps
    (note,) = [note for note in reconstruction.notes if "004.png" in note]
    assert "1 of 5 images" in check_text(note)
    assert "4 depth maps" in " ".join(reconstruction.notes)


@pytest.mark.parametrize(
    "settings",
    [
        {"spacing": 0.0},
        {"sources": 0},
        {"sources": 9},
        {"precision": 1.5},
        {"correlation": -0.1},
        {"views": 1},
        {"memory": 0.009},
        {"seed": -1},
    ],
    ids=str,
)
def test_settings_out_of_range_are_refused(settings):
    with check_error(ValueError):
        DenseMvs(**settings)
