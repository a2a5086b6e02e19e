"""Supervision by depths: what a map says at the pixels of a view, the loss's derivative, and what training gains."""

from dataclasses import replace

import numpy as np
import pytest
from splat_scenes import scattered

from pcbench.geometry.cameras import Camera, Intrinsics, look_at
from pcbench.io.colmap_model import write_colmap_model
from reconstructors.mvs.maps import DepthMap, write_map

torch = pytest.importorskip("torch")

from reconstructors.splat import cpu, rasterize  # noqa: E402
from reconstructors.splat.density import Unchanged  # noqa: E402
from reconstructors.splat.model import Gaussians  # noqa: E402
from reconstructors.splat.photographs import Photograph  # noqa: E402
from reconstructors.splat.supervision import Supervision, depths_at, read_supervision  # noqa: E402
from reconstructors.splat.train import Schedule, Training  # noqa: E402
from reconstructors.splat.view import View  # noqa: E402

POSE = look_at((0, -4, 0), (0, 0, 0))


def pinhole(width, height, focal, cx=0.5, cy=0.5, name="a/b.png"):
    return Camera(name, Intrinsics(width, height, focal, focal, cx * width, cy * height), POSE)


def on_plane(camera, normal, offset):
    """(H, W) depths of the plane normal . x = offset, in the camera's frame."""
    k = camera.intrinsics
    v, u = np.indices((k.height, k.width)) + 0.5
    return offset / (normal[0] * (u - k.cx) / k.fx + normal[1] * (v - k.cy) / k.fy + normal[2])


def map_of(depth, normal):
    return DepthMap(
        depth.astype(np.float32),
        np.broadcast_to(normal, (*depth.shape, 3)).astype(np.float32),
        np.ones(depth.shape, np.float32),
    )


@pytest.mark.parametrize("size", [(30, 20), (60, 40), (97, 61), (240, 160)])
def test_a_slope_is_met_by_a_map_of_any_size(size):
    """The map's pixels are larger and smaller than the view's, and their centres elsewhere."""
    width, height = size
    camera, mapped = pinhole(60, 40, 55.0, 0.47, 0.55), pinhole(width, height, 55.0 * width / 60, 0.47, 0.55)
    normal, offset = np.array([0.5, -0.3, -0.8]) / np.sqrt(0.98), -3.0
    found = depths_at(View.of(camera), mapped, map_of(on_plane(mapped, normal, offset), normal))
    expected = on_plane(camera, normal, offset)
    seen = found > 0
    assert seen.mean() >= 0.95  # a size that is no multiple covers a little less
    np.testing.assert_allclose(found[seen], expected[seen], rtol=1e-5)


def test_nothing_is_mixed_across_an_edge_and_what_is_unknown_stays_so():
    camera, mapped = pinhole(60, 40, 55.0), pinhole(97, 65, 55.0 * 97 / 60)
    depth = np.where(np.arange(97) < 40, 2.0, 5.0) * np.ones((65, 1))
    depth[:10] = 0
    made = map_of(depth, (0.0, 0.0, -1.0))
    found = depths_at(View.of(camera), mapped, made.where(depth > 0))
    assert set(np.unique(found)) == {0.0, 2.0, 5.0}
    assert (found[:6] == 0).all() and (found[7:] > 0).all()


def test_the_derivative_is_that_of_the_loss():
    """Of the mean relative difference, by every number of the Gaussians, against torch's own through `rasterize`."""
    scene = scattered(np.random.default_rng(3), 60)
    leaves = [torch.from_numpy(a).clone().requires_grad_() for a in scene.arrays]
    view = View.of(scene.camera)
    rng = np.random.default_rng(1)
    target = torch.from_numpy(rng.uniform(2, 6, (view.height, view.width)).astype(np.float32))
    target[rng.random(target.shape) < 0.3] = 0
    held = target > 0
    shown = rasterize(*leaves, scene.camera)
    off = (shown.depth * shown.alpha - shown.alpha * target)[held]
    (0.7 * (off.abs() / target[held]).mean()).backward()

    rasterizer = cpu.Rasterizer()
    drawn = rasterizer.forward(*(leaf.detach() for leaf in leaves), view, torch.zeros(3), geometry=True)
    photograph = Photograph("view", view, torch.zeros(view.height, view.width, 3, dtype=torch.uint8), None)
    pull = Supervision({"view": [target]}, 0.7).pull(photograph, drawn)
    pulled = rasterizer.backward(torch.zeros_like(drawn.color), pull.transmittance, pull.depth, None, None)
    for leaf, rows in zip(leaves[:4], (pulled.means, pulled.quats, pulled.scales, pulled.opacities), strict=True):
        expected = leaf.grad[pulled.ids]
        assert float(expected.abs().max()) > 0
        np.testing.assert_allclose(rows, expected, atol=2e-4 * float(expected.abs().max()))
    unknown = photograph._replace(name="another")
    assert Supervision({"view": [target]}).pull(unknown, drawn) == (None, None)


def wall():
    """A grey wall at y = 0, which no photograph tells from one anywhere else, and Gaussians half a unit before it."""
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


def wall_depth(camera):
    """In closed form: where rays meet y = 0."""
    k = camera.intrinsics
    v, u = np.indices((k.height, k.width)) + 0.5
    rays = np.stack([(u - k.cx) / k.fx, (v - k.cy) / k.fy, np.ones(u.shape)], axis=-1) @ camera.cam_from_world.rotation
    return -camera.position[1] / rays[..., 1]


def test_depths_hold_what_photographs_do_not(tmp_path):
    """Read from the folder that `mvs` keeps, in a world whose unit is not the model's."""
    unit, errors = 50.0, []
    model, cameras = wall()
    write_colmap_model(tmp_path, cameras)
    for camera in cameras:
        (tmp_path / camera.name).mkdir()
        write_map(tmp_path / camera.name, map_of(unit * wall_depth(camera), (0.0, 0.0, -1.0)))
    pictures = [
        [Photograph(camera.name, View.of(camera), torch.full((32, 48, 3), 128, dtype=torch.uint8), None)]
        for camera in cameras
    ]
    supervision = read_supervision(tmp_path, pictures, unit)
    for given in (None, supervision):
        training = Training(
            Gaussians(*(part.clone() for part in vars(model).values())),
            pictures,
            Schedule(steps=200, sh_degree=0, halved=(0, 0)),
            Unchanged(),
            given,
        )
        training.run(200)
        now = training.model
        drawn = rasterize(now.means, now.quats, now.scales, now.opacities, now.sh, cameras[1])
        off = (drawn.depth - torch.from_numpy(wall_depth(cameras[1]).astype(np.float32)))[drawn.alpha > 0.5]
        errors.append(float(off.abs().mean()))
    assert errors[0] > 0.3  # the photographs leave them where they were
    assert errors[1] < 0.1
