"""Clouds of Gaussians: surfaces with closed forms, and the agreement of images."""

import gc
import weakref
from dataclasses import replace

import numpy as np
import pytest
from exact_maps import plane_map
from optional import import_or_skip
from wording import check_error

from pcbench.errors import ReconstructionError
from pcbench.geometry.cameras import Camera, Intrinsics, look_at
from pcbench.geometry.cloud import Cloud
from pcbench.io.colmap_model import write_colmap_model
from reconstructors.mvs.cells import SPACE
from reconstructors.mvs.maps import write_map

torch = import_or_skip("torch")

from reconstructors.splat import depths as depths_module  # noqa: E402
from reconstructors.splat.combine import DepthAgreement, add_map, combine  # noqa: E402
from reconstructors.splat.depths import RenderedMaps, find_overlap  # noqa: E402
from reconstructors.splat.extract import SURFACE_CRITERIA, means, surface  # noqa: E402
from reconstructors.splat.model import SH_DC, Gaussians, LocalFrame  # noqa: E402
from reconstructors.splat.voxels import Points, Voxels  # noqa: E402

PIXELS, FOCAL, DISTANCE = 48, 6000.0, 400.0  # far away, so that the projection of a Gaussian is nearly affine
FOOTPRINT = DISTANCE / FOCAL


def cameras_on_circle(count=6, distance=DISTANCE, tilt_deg=35.0, target=(0.0, 0.0, 0.0)):
    """Return cameras on a circle that look down at a target, by name."""
    k = Intrinsics(PIXELS, PIXELS - 8, FOCAL, FOCAL, 0.47 * PIXELS, 0.4 * PIXELS)
    tilt, azimuths = np.radians(tilt_deg), 2 * np.pi * np.arange(count) / count
    directions = np.stack(
        [np.sin(tilt) * np.cos(azimuths), np.sin(tilt) * np.sin(azimuths), np.full(count, np.cos(tilt))], axis=1
    )
    names = [f"{number}.png" for number in range(count)]
    return {
        name: Camera(name, k, look_at(target + distance * a, target)) for name, a in zip(names, directions, strict=True)
    }


def make_discs(points, normals, size, color=(0.2, 0.5, 0.8), opacity=0.95):
    """Return flat round Gaussians on a surface, in the world's frame."""
    w = 1 + normals[:, 2]  # of the rotation from +z to the normal
    quats = np.stack([w, -normals[:, 1], normals[:, 0], np.zeros(len(w))], axis=1)
    scales = np.tile(np.log([size, size, 1e-4 * size]), (len(points), 1))
    logits = np.full(len(points), np.log(opacity / (1 - opacity)))
    sh = np.tile((np.array(color) - 0.5) / SH_DC, (len(points), 1, 1))
    return Gaussians(*(torch.from_numpy(a.astype(np.float32)) for a in (points, quats, scales, logits, sh)))


def make_plane(half=3.0, spacing=0.5, size=1.0):
    """The plane z = 0, tilted by 35 degrees in each of the cameras."""
    grid = np.arange(-half, half, spacing) + spacing / 2
    points = np.stack([*(a.ravel() for a in np.meshgrid(grid, grid)), np.zeros(len(grid) ** 2)], axis=1)
    return make_discs(points, np.tile([0.0, 0.0, 1.0], (len(points), 1)), size)


WORLD = LocalFrame(np.zeros(3), 1.0)


def test_flat_gaussians_on_a_plane_yield_that_plane():
    """Half a pixel is 0.3 footprints of height at this tilt. The remaining error comes from the dilation of 0.3 square
    pixels: it flattens the slope in depth, 0.7, by 0.3 over the square of 12 pixels, up to 36 pixels from a mean."""
    cloud = surface(make_plane(), WORLD, cameras_on_circle())
    heights = cloud.points[:, 2] / FOOTPRINT
    assert len(cloud) > 1000
    assert np.abs(heights).max() < 0.7 * (0.3 / 12**2) * 36 + 0.02
    assert cloud.normals[:, 2].min() > np.cos(np.radians(0.2))
    assert np.abs(cloud.colors.astype(int) - [51, 128, 204]).max() <= 1
    assert (cloud.attributes["views"] >= 3).all() and cloud.attributes["views"].max() == 6
    assert cloud.attributes["confidence"].min() > 0.5


def test_gaussians_on_a_sphere_yield_that_sphere_with_outward_normals():
    rng = np.random.default_rng(5)
    normals = rng.normal(size=(2500, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    normals = normals[normals[:, 2] > -0.9]
    cloud = surface(make_discs(normals, normals, 0.1), WORLD, cameras_on_circle(10, tilt_deg=50))
    radii = np.linalg.norm(cloud.points, axis=1)
    outward = cloud.points / radii[:, None]
    tangent_distance = (3 * 0.1) ** 2 / 2  # distance of a tangent disc from the sphere at three standard deviations
    assert 0 < np.median(radii) - 1 < tangent_distance
    assert np.percentile(np.abs(radii - 1), 95) < tangent_distance + 0.5 * FOOTPRINT
    assert np.degrees(np.arccos(np.clip(np.einsum("ni,ni->n", outward, cloud.normals), -1, 1))).max() < 30
    assert np.percentile(cloud.points[:, 2], 1) < 0.1  # below the equator too


def test_the_surface_does_not_depend_on_the_local_frame():
    """In projected coordinates and with another unit."""
    model, cameras = make_plane(half=1.5), cameras_on_circle()
    expected = surface(model, WORLD, cameras)
    origin, unit = np.array([448_262.0, 5_411_932.0, 120.0]), 50.0
    world_cameras = {}
    for name, camera in cameras.items():
        rotation, position = camera.cam_from_world.rotation, origin + unit * camera.position
        world_cameras[name] = replace(
            camera, cam_from_world=replace(camera.cam_from_world, translation=-rotation @ position)
        )
    cloud = surface(model, LocalFrame(origin, unit), world_cameras)
    assert len(cloud) == pytest.approx(len(expected), rel=0.01)
    assert cloud.points[:, 2].mean() == pytest.approx(120.0, abs=unit * 0.05 * FOOTPRINT)
    assert np.abs((cloud.points.min(axis=0) - origin) / unit - expected.points.min(axis=0)).max() < FOOTPRINT


def test_surface_that_too_few_images_see_is_left_out():
    """Two of six cameras see another part of the plane."""
    far_target = np.array([20.0, 0.0, 0.0])
    model = make_plane()
    model = model.concatenate(replace(model, means=model.means + torch.tensor([20.0, 0.0, 0.0])))
    far_cameras = {f"there {name}": camera for name, camera in list(cameras_on_circle(target=far_target).items())[:2]}
    cloud = surface(model, WORLD, cameras_on_circle(4) | far_cameras)
    assert cloud.points[:, 0].max() < 3
    third_camera = {f"third {name}": camera for name, camera in list(cameras_on_circle(target=far_target).items())[2:3]}
    assert surface(model, WORLD, cameras_on_circle(4) | far_cameras | third_camera).points[:, 0].max() > 19


def test_a_gaussian_in_front_of_one_camera_only_is_no_surface():
    model, cameras = make_plane(), cameras_on_circle()
    position = next(iter(cameras.values())).position * 0.9
    floater = make_discs(position[None], (position / np.linalg.norm(position))[None], 0.2)
    cloud = surface(model.concatenate(floater), WORLD, cameras)
    assert cloud.points[:, 2].max() < 0.1 * FOOTPRINT


def test_the_voxel_size_sets_the_spacing():
    coarse_cloud, fine_cloud = (surface(make_plane(), WORLD, cameras_on_circle(), voxel=side) for side in (0.4, 0.1))
    assert 8 < len(fine_cloud) / len(coarse_cloud) < 22
    with check_error():
        surface(make_plane(), WORLD, cameras_on_circle(), voxel=0.0)


def test_surface_that_all_of_three_cameras_see_is_kept():
    """Three cameras that agree are few of six, but all of three."""
    assert len(surface(make_plane(), WORLD, cameras_on_circle(3))) > 0.7 * len(
        surface(make_plane(), WORLD, cameras_on_circle(6))
    )


def test_no_surface_is_an_error():
    cameras = cameras_on_circle()
    with check_error():
        surface(make_plane(), WORLD, dict(list(cameras.items())[:2]))
    faint_model = replace(make_plane(), logits=torch.full_like(make_plane().logits, -9.0))
    with check_error(ReconstructionError):
        surface(faint_model, WORLD, cameras)
    with check_error(ReconstructionError):
        surface(make_plane(), WORLD, cameras, criteria=replace(SURFACE_CRITERIA, views=6, depth=1e-12))


def test_a_small_cache_of_maps_gives_the_same_cloud(monkeypatch):
    expected = surface(make_plane(), WORLD, cameras_on_circle())
    monkeypatch.setattr(depths_module, "_CACHE_BYTES", 0)
    depths = RenderedMaps(make_plane(), WORLD, cameras_on_circle(20), 12)
    find_overlap(make_plane(), depths, 12)
    assert depths.of.cache_info().currsize == 13
    assert np.array_equal(surface(make_plane(), WORLD, cameras_on_circle()).points, expected.points)


def test_rendered_maps_are_freed_with_their_cache():
    """Without a collection of cycles, which Python may put off while maps of the next block are rendered."""
    gc.disable()
    try:
        depths = RenderedMaps(make_plane(), WORLD, cameras_on_circle(3), 12)
        map_of_first = weakref.ref(depths.of(next(iter(depths.cameras))).depth_map.depth)
        assert map_of_first() is not None
        del depths
        assert map_of_first() is None
    finally:
        gc.enable()


def test_a_cell_has_the_part_of_the_surface_that_lies_in_it():
    model, cameras = make_plane(), cameras_on_circle()
    whole = surface(model, WORLD, cameras)
    left, right = SPACE.split(0, 0.3)
    parts = [surface(model, WORLD, cameras, cell=cell) for cell in (left, right)]
    # A voxel at the border averages points of both cells.
    assert len(whole) <= sum(map(len, parts)) <= 1.05 * len(whole)
    assert parts[0].points[:, 0].max() <= 0.31 and parts[1].points[:, 0].min() >= 0.29
    far_left = parts[0].points[:, 0] < 0.1
    expected = whole.points[whole.points[:, 0] < 0.1]
    np.testing.assert_allclose(np.sort(parts[0].points[far_left], axis=0), np.sort(expected, axis=0), atol=1e-9)
    with check_error(ReconstructionError):
        surface(model, WORLD, cameras, cell=SPACE.split(0, -100.0)[0])


def test_points_are_averaged_by_weight_and_coarse_ones_only_fill_gaps():
    def make_points(*rows, views=3):
        n = len(rows)
        up = np.tile([0.0, 0.0, 1.0], (n, 1))
        return Points(np.array(rows, float), up, np.full((n, 3), 10.0), np.ones(n), np.full(n, views), np.zeros(n))

    voxels = Voxels(1.0)
    voxels.add(make_points((0.2, 0.5, 0.5), (0.6, 0.5, 0.5)), np.array([3.0, 1.0]), np.zeros(2))
    voxels.add(make_points((0.4, 0.5, 0.5), views=5), np.array([1e-9]), np.zeros(1))
    coarse_points = make_points((1.5, 0.5, 0.5), (1.4, 0.5, 0.5), (-1.5, 0.5, 0.5), (-1.3, 0.5, 0.5))
    voxels.add(coarse_points, np.ones(4), np.full(4, 1.7))
    fused_points = voxels.fuse()
    # The points at 1.5 and 1.4 are in the cell of two units that has a finer point.
    assert np.allclose(fused_points.points, [[0.3, 0.5, 0.5], [-1.4, 0.5, 0.5]])
    assert fused_points.views.tolist() == [5, 3] and np.allclose(fused_points.normals, [0, 0, 1])


def test_means_are_those_of_the_gaussians():
    frame = LocalFrame(np.array([500_000.0, 5_000_000.0, 100.0]), 10.0)
    model = make_plane(half=2.5)
    cloud = means(model, frame)
    assert np.allclose(cloud.points, frame.to_world(model.means.numpy()))
    assert np.allclose(np.abs(cloud.normals), [0, 0, 1], atol=1e-6)
    assert (cloud.colors == [51, 128, 204]).all()
    assert np.allclose(cloud.attributes["largest_axis"], 10.0) and np.allclose(cloud.attributes["opacity"], 0.95)


def test_means_are_filtered_by_opacity_and_size():
    model = make_plane(half=2.5)
    logits, log_scales = model.logits.clone(), model.log_scales.clone()
    logits[:10] = -2.0
    log_scales[5:20, 1] = 1.0  # e
    model = replace(model, logits=logits, log_scales=log_scales)
    assert len(means(model, WORLD, min_opacity=0.5)) == len(model) - 10
    assert len(means(model, WORLD, max_axis=1.5)) == len(model) - 15
    assert len(means(model, WORLD, min_opacity=0.5, max_axis=1.5)) == len(model) - 20
    with check_error():
        means(model, WORLD, max_axis=1e-6)


def write_stereo_maps(folder, cameras):
    """Write exact maps of the plane z = 0, as `mvs` keeps them."""
    folder.mkdir()
    write_colmap_model(folder, list(cameras.values()))
    for name, camera in cameras.items():
        (folder / name).mkdir()
        write_map(folder / name, plane_map(camera, (0.0, 0.0, 1.0), 0.0))


def make_stereo_cloud(points):
    n = len(points)
    views = {"views": np.full(n, 3, np.int32)}
    return Cloud(points, np.tile([0.0, 0.0, 1.0], (n, 1)), np.full((n, 3), 90, np.uint8), views)


def plane_points(rng, count, x_range=(-1.0, 1.0)):
    return np.column_stack([rng.uniform(*x_range, count), rng.uniform(-1, 1, count), np.zeros(count)])


def test_stereo_fills_what_gaussians_lack_and_points_that_no_map_confirms_are_left_out(tmp_path):
    """The Gaussians cover one half of the plane. The world's unit is not the model's."""
    frame, rng = LocalFrame(np.zeros(3), 50.0), np.random.default_rng(1)
    cameras = cameras_on_circle()
    model = make_plane()
    model = model.select(model.means[:, 0] < -1.0)
    world_cameras = {name: scaled_camera(camera, 50.0) for name, camera in cameras.items()}
    write_stereo_maps(tmp_path / "maps", world_cameras)
    plane, above = plane_points(rng, 4000), plane_points(rng, 200) + [0, 0, 2 * FOOTPRINT]
    stereo = make_stereo_cloud(50 * np.concatenate([plane, above]))
    gaussians_surface = surface(model, frame, world_cameras)
    assert gaussians_surface.points[:, 0].max() < 50 * 0.9  # the discs fade out
    cloud = combine(gaussians_surface, stereo, model, frame, world_cameras, tmp_path / "maps")
    assert np.abs(cloud.points[:, 2]).max() < 50 * 0.3 * FOOTPRINT
    share = cloud.attributes["stereo"]
    far = cloud.points[:, 0] > gaussians_surface.points[:, 0].max() + 50 * FOOTPRINT
    assert far.sum() > 50 and (share[far] == 1).all()
    assert ((share > 0) & (share < 1)).any() and (share == 0).any()
    assert (cloud.attributes["views"] >= 3).all() and cloud.attributes["confidence"].max() > 0.9


def scaled_camera(camera, unit):
    pose = camera.cam_from_world
    return replace(camera, cam_from_world=replace(pose, translation=unit * pose.translation))


def test_the_more_certain_depth_replaces_the_other(tmp_path):
    """The Gaussians lie a third of a footprint above the plane that all stereo maps show on one half."""
    cameras, model = cameras_on_circle(), make_plane()
    model = replace(model, means=model.means + torch.tensor([0.0, 0.0, FOOTPRINT / 3]))
    write_stereo_maps(tmp_path / "maps", cameras)
    gaussians_surface = surface(model, WORLD, cameras)
    stereo = make_stereo_cloud(plane_points(np.random.default_rng(2), 20_000, (0.0, 1.0)))
    cloud = combine(gaussians_surface, stereo, model, WORLD, cameras, tmp_path / "maps")
    with_stereo = (cloud.points[:, 0] > 0.1) & (np.abs(cloud.points[:, :2]).max(axis=1) < 0.9)
    without_stereo = cloud.points[:, 0] < -0.1
    assert with_stereo.sum() > 500 and without_stereo.sum() > 500
    assert np.mean(np.abs(cloud.points[with_stereo, 2]) < 0.1 * FOOTPRINT) > 0.95
    assert np.median(cloud.points[without_stereo, 2]) > 0.3 * FOOTPRINT


@pytest.mark.parametrize("tilt_deg", [0.0, 50.0])
def test_maps_agree_by_the_distance_of_their_surface(tilt_deg):
    """The distance is perpendicular to the surface, in footprints, from any direction."""
    (camera,) = cameras_on_circle(1, tilt_deg=tilt_deg).values()
    heights = np.array([0.0, 0.2, 0.39, 0.41, 3.0]) * FOOTPRINT
    points = np.column_stack([np.zeros((5, 2)), heights])
    up, down = np.tile([0.0, 0.0, 1.0], (5, 1)), np.tile([0.0, 0.0, -1.0], (5, 1))
    depth_map = plane_map(camera, (0.0, 0.0, 1.0), 0.0)
    for normals, expected in ((up, [1, (1 - 0.25) ** 2, (1 - (0.39 / 0.4) ** 2) ** 2, 0, 0]), (down, [0] * 5)):
        agreement = DepthAgreement(np.zeros(5), np.full(5, np.inf))
        add_map(agreement, points, normals, camera, depth_map)
        np.testing.assert_allclose(agreement.maps, expected, atol=1e-3)
        assert np.isfinite(agreement.footprint).all() == (normals is up)


def test_a_point_behind_the_camera_or_off_the_map_agrees_with_nothing():
    (camera,) = cameras_on_circle(1).values()
    points = np.array([[0.0, 0.0, 2 * DISTANCE], [50.0, 0.0, 0.0]])
    agreement = DepthAgreement(np.zeros(2), np.full(2, np.inf))
    add_map(agreement, points, np.tile([0.0, 0.0, 1.0], (2, 1)), camera, plane_map(camera, (0.0, 0.0, 1.0), 0.0))
    assert (agreement.maps == 0).all() and np.isinf(agreement.footprint).all()


def test_no_map_near_the_points_is_an_error(tmp_path):
    """The stereo cloud and the surface are of another place."""
    cameras, model = cameras_on_circle(), make_plane()
    write_stereo_maps(tmp_path / "maps", cameras)
    elsewhere = make_stereo_cloud(np.array([[1000.0, 0.0, 0.0], [1001.0, 0.0, 0.0]]))
    with check_error(ReconstructionError):
        combine(elsewhere, elsewhere, model, WORLD, cameras, tmp_path / "maps")
