"""The photographed city: its layout, rigs, and true data checked without the search tree."""

from dataclasses import replace

import numpy as np
import pytest
from oracles import first_hits
from wording import check_error

from pcbench.geometry.cameras import Intrinsics, look_at
from pcbench.geometry.mesh import MeshIndex
from pcbench.geometry.visibility import views
from pcbench.scenes.synthetic import surface
from pcbench.scenes.synthetic.layout import lay_out
from pcbench.scenes.synthetic.noise import FractalNoise, Grid
from pcbench.scenes.synthetic.paint import Painter
from pcbench.scenes.synthetic.plan import CitySettings
from pcbench.scenes.synthetic.rigs import Site, perturbed_positions, rig
from pcbench.scenes.synthetic.surface import build_city
from pcbench.scenes.synthetic.truth import depth_map

SMALL_CITY = CitySettings(extent=120.0, seed=3)
DISTORTION = (-0.08, 0.01, 0.002, -0.001)


# ---- the plan ----


def test_plan_follows_its_settings():
    plan, second_plan = lay_out(SMALL_CITY), lay_out(SMALL_CITY)
    assert plan.solids == second_plan.solids
    assert plan.trees == second_plan.trees
    assert lay_out(replace(SMALL_CITY, seed=4)).solids != plan.solids
    buildings = [s for s in lay_out(CitySettings()).solids if s.kind in ("house", "block", "tower", "hall")]
    corners = np.concatenate([s.footprint() for s in buildings])
    assert np.abs(corners).max() < 200
    assert {"house", "block", "tower"} <= {s.kind for s in buildings}
    assert 0 < np.mean([s.rise > 0 for s in buildings]) < 1  # gables and flat roofs
    sparse_solids = lay_out(CitySettings(density=0.2)).solids
    assert len([s for s in sparse_solids if s.kind == "house"]) < 0.5 * len([s for s in buildings if s.kind == "house"])
    assert not [s for s in lay_out(CitySettings(density=0)).solids if s.kind != "car"]
    assert not any(block.kind == "lake" for block in lay_out(CitySettings()).blocks)


def test_lakes_are_level():
    plan = lay_out(CitySettings().hard())
    lakes = [block for block in plan.blocks if block.kind == "lake"]
    assert lakes
    for lake in lakes:
        x, y = np.random.default_rng(0).uniform(lake.low, lake.high, (200, 2)).T
        assert np.ptp(plan.terrain.at(x, y)) < 1e-12
    land = next(block for block in plan.blocks if block.kind == "houses")
    assert np.ptp(plan.terrain.at(*np.random.default_rng(0).uniform(land.low, land.high, (200, 2)).T)) > 0.05


@pytest.mark.parametrize("extent", [100, 130, pytest.param(250, marks=pytest.mark.slow)])
def test_every_city_can_be_built(extent):
    """Narrow, single and central blocks: nothing has a negative size or leaves the city."""
    for seed in range(12):
        for symmetric in (False, True):
            plan = lay_out(CitySettings(extent=extent, seed=seed, symmetric=symmetric))
            assert all(min(s.width, s.depth, s.eaves - s.bottom) > 0.3 for s in plan.solids)
            buildings = [s for s in plan.solids if s.kind in ("house", "block", "hall")]
            assert np.abs([s.footprint() for s in buildings]).max() < extent / 2
            for solid in buildings:  # no corner or middle of one is inside another
                other_points = [np.concatenate([s.footprint(), [[s.x, s.y]]]) for s in buildings if s is not solid]
                is_inside = np.abs(solid.local(np.concatenate(other_points))) < [0.49 * solid.width, 0.49 * solid.depth]
                assert not is_inside.all(axis=1).any()
            assert all(np.subtract(b.high, b.low).min() > 10 for b in plan.blocks)


def test_relief_follows_its_setting():
    terrain = lay_out(CitySettings(relief=3.0)).terrain
    city_heights = terrain.heights[40:121, 40:121]  # the city is half as wide as the terrain
    assert city_heights.std() == pytest.approx(3.0)
    np.testing.assert_array_equal(lay_out(CitySettings(relief=0.0)).terrain.heights, 0.0)


def test_symmetric_city_is_unchanged_by_half_a_turn():
    plan = lay_out(CitySettings(symmetric=True, seed=1))
    boxes = np.array([(s.x, s.y, s.width, s.depth, s.eaves) for s in plan.solids])
    rotated_boxes = boxes * [-1, -1, 1, 1, 1]
    order, rotated_order = np.lexsort(boxes.T.round(6)), np.lexsort(rotated_boxes.T.round(6))
    np.testing.assert_allclose(boxes[order], rotated_boxes[rotated_order], atol=1e-9)
    np.testing.assert_allclose(plan.terrain.heights, plan.terrain.heights[::-1, ::-1], atol=1e-9)
    centres = np.arange(400) + 0.5
    color = Painter(plan.settings).paint_town(plan, Grid(centres, centres, 400.0, 400.0)).color
    np.testing.assert_array_equal(color, color[::-1, ::-1])


@pytest.mark.parametrize(
    "values", [{"extent": 10}, {"density": 1.5}, {"texture": -1}, {"height": 0}, {"relief": 100}, {"seed": -1}]
)
def test_settings_out_of_range_are_refused(values):
    with check_error():
        CitySettings(**values)


@pytest.mark.long
def test_zero_texture_gives_plain_surfaces():
    plan = lay_out(replace(SMALL_CITY, texture=0.0))
    plain_painter, rich_painter = Painter(plan.settings), Painter(SMALL_CITY)
    centres = np.arange(0.1, 120, 0.4)
    town_grid, wide_grid = Grid(centres, centres, 120.0, 120.0), Grid(2 * centres, 2 * centres, 240.0, 240.0)
    for plain_paint, rich_paint in (
        (plain_painter.paint_town(plan, town_grid), rich_painter.paint_town(plan, town_grid)),
        (plain_painter.paint_countryside(wide_grid), rich_painter.paint_countryside(wide_grid)),
        (plain_painter.paint_leaves(64), rich_painter.paint_leaves(64)),
        *(
            (plain_painter.paint_face(kind, side, 5, Grid(centres[:60], centres[:40], 24.0, 16.0)), None)
            for kind in ("house", "block", "tower", "hall", "car", "clutter", "chimney")
            for side in ("wall0", "slope1", "roof")
        ),
    ):
        assert np.ptp(plain_paint.color.reshape(-1, 3), axis=0).max() < 1e-6
        assert plain_paint.mirror is None
        if rich_paint is not None:
            assert rich_paint.color.std() > 0.05
    half_color = Painter(replace(SMALL_CITY, texture=0.5)).paint_town(plan, town_grid).color
    end_colors = plain_painter.paint_town(plan, town_grid).color, rich_painter.paint_town(plan, town_grid).color
    np.testing.assert_allclose(half_color, np.mean(end_colors, axis=0), atol=1e-6)
    # A lake is not part of the texture: it is painted and reflects at zero texture too.
    lakes = lay_out(replace(CitySettings(seed=1), texture=0.0, water=True))
    pond = next(block for block in lakes.blocks if block.kind == "lake")
    u, v = (np.arange(pond.low[a], pond.high[a], 0.5) + 200 for a in (0, 1))
    shore = Painter(lakes.settings).paint_town(lakes, Grid(u, v, 400.0, 400.0))
    assert len(np.unique(shore.color[..., 0])) == 2
    assert shore.mirror.max() == pytest.approx(0.02)


def test_noise_does_not_depend_on_the_texel_size():
    """Finer texels show more detail of the same noise: coarse texels are their means over squares."""
    noise = FractalNoise(3, 0.075)

    def sample_noise(texel):
        centres = np.arange(0.5 * texel, 40, texel)
        return noise(Grid(centres, centres, 40.0, 40.0), np.random.default_rng(1))

    fine, coarse = sample_noise(0.1), sample_noise(0.4)
    means = fine.reshape(100, 4, 100, 4).mean(axis=(1, 3))
    assert np.corrcoef(means.ravel(), coarse.ravel())[0, 1] > 0.97
    assert coarse.std() < fine.std()
    centres = 0.075 * np.arange(2048)  # once over the whole tile
    tile = noise(Grid(centres, centres, 153.6, 153.6), np.random.default_rng(1))
    assert (tile.mean(), tile.std()) == (pytest.approx(0, abs=1e-4), pytest.approx(1, rel=0.15))


@pytest.mark.long
def test_texels_are_no_larger_than_pixels(monkeypatch):
    plan = lay_out(SMALL_CITY)
    k = Intrinsics.from_fov(192, 128, 40.0)
    cameras = rig("circles", 7, Site(120.0, 0.0, plan.top), k)
    near_camera = replace(cameras[0], cam_from_world=look_at([10, -20, 12], [10, 20, 2]))
    city = build_city(plan, cameras=[*cameras, near_camera])
    pages = np.array([page.shape[1::-1] for page in city.pages])
    uv = city.uv * pages[city.page][:, None]
    (p, q), (a, b) = (np.diff(x, axis=1).transpose(1, 0, 2) for x in (uv, city.mesh.vertices[city.mesh.faces]))
    texels = np.sqrt(np.linalg.norm(np.cross(a, b), axis=1) / np.abs(p[:, 0] * q[:, 1] - p[:, 1] * q[:, 0]))
    foliage_start = len(city.mesh) - 117 * len(plan.trees)  # trees come last
    u, v = np.meshgrid(np.arange(192) + 0.5, np.arange(128) + 0.5)
    for camera in (*cameras, near_camera):
        rays = k.directions(np.stack([u.ravel(), v.ravel()], axis=1)) @ camera.cam_from_world.rotation
        hits = MeshIndex(city.mesh).cast(camera.position, rays)
        is_surface = (hits.faces >= 0) & (hits.faces < foliage_start)
        # A few texels are larger: charts have a whole number of texels, and the terrain stretches texels on slopes.
        assert (texels[hits.faces[is_surface]] < 1.05 * hits.distances[is_surface] / k.fx).mean() > 0.9995
    monkeypatch.setattr(surface, "_MAX_TEXELS", 3e5)  # beyond the memory limit all texels are larger
    sizes = sum(page.size for page in city.pages), sum(page.size for page in build_city(plan, cameras=cameras).pages)
    assert sizes[1] < 0.3 * sizes[0]


# ---- rigs ----


def test_circles_rig_follows_the_paper():
    site = Site(400.0, 0.0, 40.0)
    cameras = rig("circles", 70, site, Intrinsics.from_fov(960, 540, 40.0))
    positions = np.array([c.position for c in cameras])
    radii = np.hypot(*positions[:, :2].T)
    rings, counts = np.unique(radii.round(6), return_counts=True)
    assert (counts == 10).all()
    assert len(rings) == 7
    assert rings[-1] / rings[0] == pytest.approx(7250 / 500)
    assert (positions[:, 2] > 40).all()
    azimuths = np.sort(np.arctan2(*positions[:, 1::-1].T))
    np.testing.assert_allclose(np.diff(azimuths), 2 * np.pi / 70, atol=1e-9)  # from all sides
    # All cameras look at one point.
    target = np.array([0, 0, 20.0])
    for camera in cameras:
        line_of_sight = target - camera.position
        assert np.linalg.norm(np.cross(line_of_sight, camera.direction)) < 1e-9
        assert line_of_sight @ camera.direction > 0
    assert [c.name for c in cameras[:2]] == ["0001.png", "0002.png"]


def test_grid_oblique_and_drone_rigs():
    site, k = Site(400.0, 0.0, 40.0), Intrinsics.from_fov(960, 540, 40.0)
    nadir = rig("grid", 40, site, k)
    for camera in nadir:
        np.testing.assert_allclose(camera.direction, [0, 0, -1], atol=1e-12)
        np.testing.assert_allclose(-camera.cam_from_world.rotation[1], [0, 1, 0], atol=1e-12)  # north is up
    positions = np.array([c.position for c in nadir])
    footprint = positions[0, 2] * np.array([960 / k.fx, 540 / k.fy])
    steps = [np.diff(np.unique(positions[:, axis].round(6))).max() for axis in (0, 1)]
    assert (steps < 0.3 * footprint).all()  # at least 70 % of overlap
    oblique = rig("oblique", 40, site, k)
    tilts = np.degrees(np.arccos([-c.direction[2] for c in oblique]))
    np.testing.assert_allclose(tilts, 40, atol=1e-9)
    sides = {tuple(np.sign(c.direction[:2].round(6)).astype(int)) for c in oblique}
    assert sides == {(0, 1), (1, 0), (0, -1), (-1, 0)}
    drone = rig("drone", 42, site, k)
    tilts = np.degrees(np.arccos([-c.direction[2] for c in drone]))
    assert (tilts[:35] < 7).all()
    assert np.median(tilts[:35]) > 1  # Rayleigh's distribution of 1.5 degrees a side has 1.8
    np.testing.assert_allclose(tilts[35:], 25, atol=1e-6)
    northward = np.array([-c.cam_from_world.rotation[1, 1] for c in drone[:35]])
    assert (np.abs(northward) > 0.97).all()
    assert 5 < (northward < 0).sum() < 30  # every second strip
    assert len(rig("orbit", 5, site, k)) == 5
    with check_error():
        rig("spiral", 5, site, k)


def test_gps_errors():
    cameras = rig("grid", 900, Site(400.0, 0.0, 40.0), Intrinsics.from_fov(96, 54, 40.0))
    errors = perturbed_positions(cameras, 0.5, seed=1) - np.array([c.position for c in cameras])
    np.testing.assert_allclose(errors.std(axis=0), [0.5, 0.5, 1.0], rtol=0.08)  # 900 draws: 2.4 % each, 3 of these


# ---- truth ----


def test_depths_match_brute_force_ray_casting(city):
    camera = rig("circles", 7, Site(120.0, 0.0, city.plan.top), Intrinsics.from_fov(96, 54, 50.0))[5]
    depth = depth_map(MeshIndex(city.mesh), camera)
    rng = np.random.default_rng(1)
    rows, columns = rng.integers(0, 54, 60), rng.integers(0, 96, 60)
    k = camera.intrinsics
    directions = np.stack([(columns + 0.5 - k.cx) / k.fx, (rows + 0.5 - k.cy) / k.fy, np.ones(60)], axis=1)
    origins = np.broadcast_to(camera.position, (60, 3))
    expected = first_hits(origins, directions @ camera.cam_from_world.rotation, city.mesh.vertices, city.mesh.faces)
    expected[np.isinf(expected)] = 0
    np.testing.assert_allclose(depth[rows, columns], expected, rtol=1e-6)  # float32


@pytest.mark.long
def test_view_counts_match_brute_force_ray_casting(city):
    site, k = Site(120.0, 0.0, city.plan.top), Intrinsics.from_fov(96, 54, 40.0)
    cameras = rig("circles", 7, site, k)[::2]
    cloud = city.mesh.sample(30, seed=2)
    counts = views(MeshIndex(city.mesh), cameras, cloud.points, cloud.normals)
    expected = np.zeros(30, dtype=int)
    for camera in cameras:
        (u, v), z = camera.project(cloud.points)[0].T, camera.project(cloud.points)[1]
        in_image = (z > 0) & (u >= 0) & (u < 96) & (v >= 0) & (v < 54)
        sight_lines = camera.position - cloud.points
        in_image &= np.einsum("ni,ni->n", sight_lines, cloud.normals) > 0
        starts = cloud.points + 1e-4 * cloud.normals
        is_unoccluded = first_hits(starts, camera.position - starts, city.mesh.vertices, city.mesh.faces) > 1
        expected += in_image & is_unoccluded
    np.testing.assert_array_equal(counts, expected)
    assert len(set(expected)) > 2
