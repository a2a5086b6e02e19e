"""Depth supervision: resampling of maps, the gradient of the loss, and the effect on training."""

from dataclasses import dataclass, replace

import numpy as np
import pytest
import textured_corner as corner
from exact_maps import corner_map, plane_map
from optional import import_or_skip
from splat_scenes import scattered_cloud
from wording import check_text

from pcbench.geometry.cameras import Camera, Intrinsics, look_at
from pcbench.geometry.cloud import Cloud
from pcbench.io.colmap_model import write_colmap_model
from pcbench.plugins import Reconstruction
from pcbench.scenes import read_scene
from reconstructors.mvs.maps import DepthMap, write_map
from reconstructors.mvs.mvs import MAPS, VIEW_COUNTS

torch = import_or_skip("torch")

from reconstructors.splat import cpu, rasterize  # noqa: E402
from reconstructors.splat import splat as plugin  # noqa: E402
from reconstructors.splat.density import Density  # noqa: E402
from reconstructors.splat.interface import GaussianTensors  # noqa: E402
from reconstructors.splat.model import Gaussians  # noqa: E402
from reconstructors.splat.parsimony import Curve  # noqa: E402
from reconstructors.splat.photographs import Photograph  # noqa: E402
from reconstructors.splat.supervision import Supervision, read_supervision, resample_depths  # noqa: E402
from reconstructors.splat.train import Schedule, Training  # noqa: E402
from reconstructors.splat.view import View  # noqa: E402

POSE = look_at((0, -4, 0), (0, 0, 0))


def pinhole(width, height, focal, cx=0.5, cy=0.5, name="a/b.png"):
    return Camera(name, Intrinsics(width, height, focal, focal, cx * width, cy * height), POSE)


@pytest.mark.parametrize("size", [(30, 20), (60, 40), (97, 61), (240, 160)])
def test_a_slope_is_resampled_exactly_from_a_map_of_any_size(size):
    """The map's pixels are larger and smaller than the view's, with other centres."""
    width, height = size
    camera, map_camera = pinhole(60, 40, 55.0, 0.47, 0.55), pinhole(width, height, 55.0 * width / 60, 0.47, 0.55)
    normal = np.array([0.5, -0.8, -0.3]) / np.sqrt(0.98)
    resampled = resample_depths(View.of(camera), map_camera, plane_map(map_camera, normal, 0.4))
    expected = plane_map(camera, normal, 0.4).depth
    covered = resampled > 0
    assert covered.mean() >= 0.95  # a size that is no multiple covers a little less
    np.testing.assert_allclose(resampled[covered], expected[covered], rtol=1e-5)


def test_depths_are_not_mixed_across_an_edge_and_unknown_ones_stay_unknown():
    camera, map_camera = pinhole(60, 40, 55.0), pinhole(97, 65, 55.0 * 97 / 60)
    depth = np.where(np.arange(97) < 40, 2.0, 5.0) * np.ones((65, 1))
    depth[:10] = 0
    normals = np.broadcast_to(np.float32([0, 0, -1]), (65, 97, 3))
    depth_map = DepthMap(depth.astype(np.float32), normals, np.ones((65, 97), np.float32))
    resampled = resample_depths(View.of(camera), map_camera, depth_map.where(depth > 0))
    assert set(np.unique(resampled)) == {0.0, 2.0, 5.0}
    assert (resampled[:6] == 0).all() and (resampled[7:] > 0).all()


def test_the_gradient_equals_that_of_the_loss():
    """Gradients of the mean relative difference with respect to all parameters agree with torch autograd."""
    scene = scattered_cloud(np.random.default_rng(3), 60)
    leaves = [torch.from_numpy(a).clone().requires_grad_() for a in scene.arrays]
    view = View.of(scene.camera)
    rng = np.random.default_rng(1)
    target = torch.from_numpy(rng.uniform(2, 6, (view.height, view.width)).astype(np.float32))
    target[rng.random(target.shape) < 0.3] = 0
    known = target > 0
    autograd_rendering = rasterize(*leaves, scene.camera)
    difference = (autograd_rendering.depth * autograd_rendering.alpha - autograd_rendering.alpha * target)[known]
    (0.7 * (difference.abs() / target[known]).mean()).backward()

    rasterizer = cpu.CpuRasterizer()
    rendering = rasterizer.forward(
        GaussianTensors(*(leaf.detach() for leaf in leaves)), view, torch.zeros(3), geometry=True
    )
    photograph = Photograph("view", view, torch.zeros(view.height, view.width, 3, dtype=torch.uint8), None)
    depth_gradients = Supervision({"view": [target]}, 0.7).gradients(photograph, rendering)
    gradients = rasterizer.backward(
        torch.zeros_like(rendering.color), depth_gradients.transmittance, depth_gradients.depth, None
    )
    for leaf, rows in zip(
        leaves[:4], (gradients.means, gradients.quats, gradients.scales, gradients.opacities), strict=True
    ):
        expected = leaf.grad[gradients.ids]
        assert float(expected.abs().max()) > 0
        np.testing.assert_allclose(rows, expected, atol=2e-4 * float(expected.abs().max()))
    other_photograph = photograph._replace(name="another")
    assert Supervision({"view": [target]}).gradients(other_photograph, rendering) == (None, None)


def wall():
    """A grey wall at y = 0, whose depth no photograph shows, and Gaussians half a unit in front of it."""
    rng = np.random.default_rng(2)
    means = np.column_stack([rng.uniform(-2, 2, 150), np.full(150, -0.5), rng.uniform(-1.5, 1.5, 150)])
    model = Gaussians(
        torch.from_numpy(means.astype(np.float32)),
        torch.tensor([1.0, 0, 0, 0]).repeat(150, 1),
        torch.full((150, 3), float(np.log(0.25))),
        torch.zeros(150),
        torch.zeros(150, 1, 3),
    )
    cameras = []
    for k, x in enumerate((-1.0, 0.0, 1.0)):
        camera = pinhole(48, 32, 60.0, name=f"{k}.png")
        cameras.append(replace(camera, cam_from_world=look_at((x, -4, 0), (0.3 * x, 0, 0))))
    return model, cameras


def save_map(folder, depth_map, counts):
    folder.mkdir(exist_ok=True)
    write_map(folder, depth_map)
    np.save(folder / VIEW_COUNTS, np.broadcast_to(np.uint8(counts), depth_map.depth.shape))


def test_uncertain_depths_are_not_used(tmp_path):
    """Initial points may come from two images and have a low confidence."""
    camera = pinhole(60, 40, 55.0)
    depth_map = plane_map(camera, (0.0, -1.0, 0.0), 0.0)
    counts = np.full(depth_map.depth.shape, 3, np.uint8)
    counts[:, :20] = 2
    depth_map.confidence[30:] = 0.2
    write_colmap_model(tmp_path, [camera])
    (tmp_path / "a").mkdir()
    save_map(tmp_path / camera.name, depth_map, counts)
    picture = Photograph(camera.name, View.of(camera), torch.zeros(40, 60, 3, dtype=torch.uint8), None)
    (resampled,) = read_supervision(tmp_path, [[picture]], 1.0).depths[camera.name]
    np.testing.assert_array_equal(resampled > 0, (counts == 3) & (depth_map.confidence > 0.5))


def test_depths_constrain_what_photographs_do_not(tmp_path):
    """Read from the folder of `mvs`, in a world whose unit is not the model's."""
    unit, errors = 50.0, []
    model, cameras = wall()
    write_colmap_model(tmp_path, cameras)
    for camera in cameras:
        depth_map = plane_map(camera, (0.0, -1.0, 0.0), 0.0)
        save_map(tmp_path / camera.name, replace(depth_map, depth=np.float32(unit) * depth_map.depth), 3)
    pictures = [
        [Photograph(camera.name, View.of(camera), torch.full((32, 48, 3), 128, dtype=torch.uint8), None)]
        for camera in cameras
    ]
    supervision = read_supervision(tmp_path, pictures, unit)
    for depth_supervision in (None, supervision):
        training = Training(
            Gaussians(*(part.clone() for part in vars(model).values())),
            pictures,
            Schedule(steps=200, sh_degree=0, downscale_shares=(0, 0)),
            Density(),
            depth_supervision,
        )
        training.run(200)
        trained_model = training.model
        rendering = rasterize(
            trained_model.means,
            trained_model.quats,
            trained_model.scales,
            trained_model.opacities,
            trained_model.sh,
            cameras[1],
        )
        difference = (rendering.depth - torch.from_numpy(plane_map(cameras[1], (0.0, -1.0, 0.0), 0.0).depth))[
            rendering.alpha > 0.5
        ]
        errors.append(float(difference.abs().mean()))
    assert errors[0] > 0.3  # photographs alone leave the Gaussians where they were
    assert errors[1] < 0.1


@dataclass(frozen=True)
class InexactMvs:
    """Replaces `mvs`: exact maps, of which three images confirm those of the first images, and inexact points."""

    poses: str = "given"
    memory: float = 4.0
    seed: int = 0
    confirmed: int = 100

    def reconstruct(self, scene, workspace):
        pinholes = [replace(c, intrinsics=corner.standard_intrinsics(72, 54)) for c in scene.cameras.values()]
        write_colmap_model(workspace / MAPS, pinholes)
        for number, camera in enumerate(pinholes):
            save_map(workspace / MAPS / camera.name, corner_map(camera), 3 if number < self.confirmed else 2)
        rng = np.random.default_rng(4)
        points = rng.uniform(0, corner.SIDE / 2, (3, 300, 3))
        points[range(3), :, range(3)] = rng.normal(0, 0.15, (3, 300))
        cloud = Cloud(
            points.reshape(-1, 3),
            np.repeat(np.eye(3), 300, axis=0),
            np.full((900, 3), 128, np.uint8),
            {"views": np.full(900, 3, np.int32)},
        )
        return Reconstruction(cloud, "georeferenced", scene.cameras)


def test_the_surface_is_more_accurate_with_depth_supervision(tmp_path, monkeypatch):
    monkeypatch.setattr(plugin, "INITIAL_MVS", InexactMvs())
    scene_folder = tmp_path / "corner"
    scene_folder.mkdir()
    scene = read_scene(corner.write_scene(scene_folder, corner.cameras(6, corner.standard_intrinsics(96, 72))))
    errors, clouds = {}, {}
    for supervision_setting in ("mvs", "none"):
        workspace = tmp_path / supervision_setting
        workspace.mkdir()
        splat = plugin.GaussianSplatting(supervision=supervision_setting, density="fixed", steps=100, gaussians=900)
        for kind in ("surface", "combined"):
            reconstruction = replace(splat, cloud=kind).reconstruct(scene, workspace)
            clouds[kind, supervision_setting] = reconstruction
            errors[kind, supervision_setting] = corner.distances(reconstruction.cloud.points).mean()
    assert errors["surface", "mvs"] < 0.6 * errors["surface", "none"]
    initial = InexactMvs().reconstruct(scene, tmp_path / "mvs/mvs").cloud
    assert errors["combined", "mvs"] < 0.5 * corner.distances(initial.points).mean()
    assert "stereo" in clouds["combined", "mvs"].cloud.attributes
    assert "stereo" not in clouds["surface", "mvs"].cloud.attributes
    check_text(next(note for note in clouds["combined", "mvs"].notes if "from mvs" in note))


def test_the_number_of_gaussians_is_selected_by_confirmed_depths(tmp_path, monkeypatch):
    """Photographs without confirmed depths are not held out; the depths need not supervise the training too."""
    scene_folder = tmp_path / "corner"
    scene_folder.mkdir()
    scene = read_scene(corner.write_scene(scene_folder, corner.cameras(9, corner.standard_intrinsics(96, 72))))
    splat = plugin.GaussianSplatting(select="surface", supervision="none", steps=50, gaussians=900, cloud="means")

    def notes(confirmed):
        monkeypatch.setattr(plugin, "INITIAL_MVS", InexactMvs(confirmed=confirmed))
        workspace = tmp_path / str(confirmed)
        workspace.mkdir()
        return splat.reconstruct(scene, workspace).notes

    note, warning = (note for note in notes(4) if "correct depths" in note or "decide" in note)
    assert "%" in check_text(note) and check_text(warning).startswith("warning: only 2 ")
    curve = Curve.read(tmp_path / "4/model" / plugin.CURVE)
    assert len(curve.budgets[0].scores[0]) == 2
    assert curve.selected.gaussians < 900
    check_text(next(note for note in notes(3) if "was not optimized" in note))
