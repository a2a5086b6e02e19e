"""The photographed city: laid out as asked, drawn where cameras say, its truth checked without the tree."""

from dataclasses import replace

import numpy as np
import pytest
from oracles import first_hits

from pcbench.errors import InputError
from pcbench.geometry.cameras import Camera, Intrinsics, look_at
from pcbench.geometry.mesh import Mesh, MeshIndex
from pcbench.geometry.visibility import views
from pcbench.scenes.synthetic.layout import lay_out
from pcbench.scenes.synthetic.paint import Grid, Painter
from pcbench.scenes.synthetic.plan import CitySettings
from pcbench.scenes.synthetic.render import Optics, render
from pcbench.scenes.synthetic.rigs import Site, perturbed_positions, rig
from pcbench.scenes.synthetic.surface import CitySurface, build_city
from pcbench.scenes.synthetic.truth import depth_map

SMALL = CitySettings(extent=120.0, seed=3)
DISTORTION = (-0.08, 0.01, 0.002, -0.001)


@pytest.fixture(scope="module")
def city():
    return build_city(SMALL, texel=0.5)


# ---- the plan ----


def test_a_plan_follows_its_settings():
    one, two = lay_out(SMALL), lay_out(SMALL)
    assert one.solids == two.solids
    assert one.trees == two.trees
    assert lay_out(replace(SMALL, seed=4)).solids != one.solids
    buildings = [s for s in lay_out(CitySettings()).solids if s.kind in ("house", "block", "tower", "hall")]
    corners = np.concatenate([s.footprint() for s in buildings])
    assert np.abs(corners).max() < 200
    assert {"house", "block", "tower"} <= {s.kind for s in buildings}
    assert 0 < np.mean([s.rise > 0 for s in buildings]) < 1  # gables and flat roofs
    sparse = lay_out(CitySettings(density=0.2)).solids
    assert len([s for s in sparse if s.kind == "house"]) < 0.5 * len([s for s in buildings if s.kind == "house"])
    assert not [s for s in lay_out(CitySettings(density=0)).solids if s.kind != "car"]
    assert not any(block.kind == "lake" for block in lay_out(CitySettings()).blocks)


def test_water_is_level():
    plan = lay_out(CitySettings().hard())
    lakes = [block for block in plan.blocks if block.kind == "lake"]
    assert lakes
    for lake in lakes:
        x, y = np.random.default_rng(0).uniform(lake.low, lake.high, (200, 2)).T
        assert np.ptp(plan.terrain.at(x, y)) < 1e-12
    land = next(block for block in plan.blocks if block.kind == "houses")
    assert np.ptp(plan.terrain.at(*np.random.default_rng(0).uniform(land.low, land.high, (200, 2)).T)) > 0.05


@pytest.mark.parametrize("extent", [100, 130, 250])
def test_every_city_can_be_built(extent):
    """Narrow blocks, lone blocks, blocks about the origin: nothing has a negative size or leaves the city."""
    for seed in range(12):
        for symmetric in (False, True):
            plan = lay_out(CitySettings(extent=extent, seed=seed, symmetric=symmetric))
            assert all(min(s.width, s.depth, s.eaves - s.bottom) > 0.3 for s in plan.solids)
            footing = [s for s in plan.solids if s.kind in ("house", "block", "hall")]
            assert np.abs([s.footprint() for s in footing]).max() < extent / 2
            for solid in footing:  # no corner or middle of one is inside another
                marks = [np.concatenate([s.footprint(), [[s.x, s.y]]]) for s in footing if s is not solid]
                inside = np.abs(solid.local(np.concatenate(marks))) < [0.49 * solid.width, 0.49 * solid.depth]
                assert not inside.all(axis=1).any()
            assert all(np.subtract(b.high, b.low).min() > 10 for b in plan.blocks)


def test_relief_is_what_was_asked_for():
    terrain = lay_out(CitySettings(relief=3.0)).terrain
    inner = terrain.heights[40:121, 40:121]  # the city is half as wide as the terrain
    assert inner.std() == pytest.approx(3.0)
    np.testing.assert_array_equal(lay_out(CitySettings(relief=0.0)).terrain.heights, 0.0)


def test_a_symmetric_city_looks_the_same_after_half_a_turn():
    plan = lay_out(CitySettings(symmetric=True, seed=1))
    places = np.array([(s.x, s.y, s.width, s.depth, s.eaves) for s in plan.solids])
    turned = places * [-1, -1, 1, 1, 1]
    order, other = np.lexsort(places.T.round(6)), np.lexsort(turned.T.round(6))
    np.testing.assert_allclose(places[order], turned[other], atol=1e-9)
    np.testing.assert_allclose(plan.terrain.heights, plan.terrain.heights[::-1, ::-1], atol=1e-9)
    at = np.arange(400) + 0.5
    ground = Painter(plan.settings).town(plan, Grid(at, at, 400.0, 400.0))
    np.testing.assert_array_equal(ground, ground[::-1, ::-1])


@pytest.mark.parametrize(
    "wrong", [{"extent": 10}, {"density": 1.5}, {"texture": -1}, {"height": 0}, {"relief": 100}, {"seed": -1}]
)
def test_settings_out_of_range(wrong):
    with pytest.raises(InputError, match="expected"):
        CitySettings(**wrong)


def test_textures_go_down_to_blank(city):
    blank = build_city(replace(SMALL, texture=0.0), texel=0.5)

    def detail(pages):  # what changes from texel to texel
        return np.mean([np.abs(np.diff(p.astype(float), axis=1)).mean() for p in pages])

    assert detail(blank.pages) < 0.5 * detail(city.pages)


# ---- rigs ----


def test_the_papers_circles():
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
    # All look at one point: every axis passes it.
    target = np.array([0, 0, 20.0])
    for camera in cameras:
        away = target - camera.position
        assert np.linalg.norm(np.cross(away, camera.direction)) < 1e-9
        assert away @ camera.direction > 0
    assert [c.name for c in cameras[:2]] == ["0001.png", "0002.png"]


def test_surveys():
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
    with pytest.raises(InputError, match="circles, grid, oblique, drone, orbit"):
        rig("spiral", 5, site, k)


def test_gps_errors():
    cameras = rig("grid", 900, Site(400.0, 0.0, 40.0), Intrinsics.from_fov(96, 54, 40.0))
    errors = perturbed_positions(cameras, 0.5, seed=1) - np.array([c.position for c in cameras])
    np.testing.assert_allclose(errors.std(axis=0), [0.5, 0.5, 1.0], rtol=0.08)  # 900 draws: 2.4 % each, 3 of these


# ---- pictures ----


def plate(corners):
    """White quadrilaterals (Q, 4, 3) on a black ground."""
    ground = np.array([[[-200, -200, 0], [200, -200, 0], [200, 200, 0], [-200, 200, 0]]], dtype=float)
    quads = np.concatenate([ground, corners])
    faces = (4 * np.arange(len(quads))[:, None, None] + [[0, 1, 2], [0, 2, 3]]).reshape(-1, 3)
    mesh = Mesh(quads.reshape(-1, 3), faces)
    shade = np.full((len(faces), 3), 255, dtype=np.uint8)
    shade[:2] = 0
    uv, page = np.full((len(faces), 3, 2), 0.5, dtype=np.float32), np.zeros(len(faces), dtype=np.int64)
    return CitySurface(None, mesh, uv, page, shade, [np.full((8, 8, 3), 255, dtype=np.uint8)])


def centroid(outline):
    """Of a polygon (N, 2)."""
    x, y = (outline - outline[0]).T
    cross = x * np.roll(y, -1) - np.roll(x, -1) * y
    return outline[0] + [((p + np.roll(p, -1)) * cross).sum() / (3 * cross.sum()) for p in (x, y)]


@pytest.mark.parametrize("distortion", [(0, 0, 0, 0), DISTORTION], ids=["pinhole", "distorted"])
def test_pictures_and_depths_are_where_the_camera_says(distortion, renderer, tmp_path):
    from PIL import Image

    rng = np.random.default_rng(0)
    x, y = np.meshgrid(np.linspace(-60, 60, 7), np.linspace(-40, 40, 5))
    centres = np.stack([x.ravel(), y.ravel(), rng.uniform(0.5, 12, x.size)], axis=1)
    square = np.array([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]]) * 2.5
    surface = plate(centres[:, None] + square)
    k = replace(Intrinsics.from_fov(480, 320, 45.0), distortion=distortion, cx=233.0, cy=166.5)
    camera = Camera("a.png", k, look_at([30, -80, 130], [0, 0, 0]))
    render(surface, [camera], tmp_path, optics=Optics(0, 0, 0))
    image = np.asarray(Image.open(tmp_path / "a.png")).astype(float)[..., 0] / 255
    depth = depth_map(MeshIndex(surface.mesh), camera)
    u, v = np.meshgrid(np.arange(480) + 0.5, np.arange(320) + 0.5)
    sides = zip(square, np.roll(square, -1, axis=0), strict=True)
    rim = np.concatenate([np.linspace(a, b, 16, endpoint=False) for a, b in sides])
    misses = []
    for centre in centres:
        outline = camera.project(np.concatenate([centre + square, [centre]]))[0]
        low, high = np.floor(outline.min(axis=0)).astype(int) - 2, np.ceil(outline.max(axis=0)).astype(int) + 2
        if (low < 0).any() or (high > [480, 320]).any():
            continue
        part = np.s_[low[1] : high[1], low[0] : high[0]]
        weight = image[part]
        found = np.array([(weight * u[part]).sum(), (weight * v[part]).sum()]) / weight.sum()
        misses.append(found - centroid(camera.project(centre + rim)[0]))
        # The pixel that holds the centre sees the plate at the height of its plane.
        pixel = np.floor(outline[-1]).astype(int)
        ray = camera.intrinsics.directions(pixel[None] + 0.5)[0] * depth[pixel[1], pixel[0]]
        assert camera.cam_from_world.inverse().apply(ray[None])[0, 2] == pytest.approx(centre[2], abs=2e-5)  # float32
    assert len(misses) > 20
    # Four samples a pixel put the outline of one plate to a tenth of a pixel, all of them to a hundredth.
    assert np.abs(misses).max() < 0.15
    np.testing.assert_allclose(np.mean(misses, axis=0), 0, atol=0.02)


def test_the_citys_outline_is_that_of_its_depths(city, renderer, tmp_path):
    from PIL import Image

    camera = rig("orbit", 3, Site(120.0, 0.0, city.plan.top), Intrinsics.from_fov(480, 270, 60.0))[1]
    camera = replace(camera, cam_from_world=look_at(camera.position * [1, 1, 0.4], [0, 0, 20]))
    black = replace(city, shade=np.zeros_like(city.shade))
    render(black, [camera], tmp_path, optics=Optics(0, 0, 0))
    image = np.asarray(Image.open(tmp_path / camera.name)).astype(float)[..., 2]
    sky = np.median(image[:5])
    covered = 1 - np.clip(image / sky, 0, 1)
    solid = (depth_map(MeshIndex(city.mesh), camera) > 0).astype(float)
    assert 0.1 < solid.mean() < 0.9
    slope = np.stack([np.gradient(solid, axis=1), np.gradient(solid, axis=0)], axis=-1)
    edge = np.abs(slope).sum(axis=-1) > 0
    shift = np.linalg.lstsq(slope[edge], (covered - solid)[edge], rcond=None)[0]
    assert np.abs(shift).max() < 0.1  # pixels
    assert (np.abs(covered - solid)[~edge] < 0.1).all()  # the sky is brighter towards the upper side


def test_every_picture_has_its_own_gain_and_noise(city, renderer, tmp_path):
    from PIL import Image

    camera = rig("grid", 1, Site(120.0, 0.0, city.plan.top), Intrinsics.from_fov(240, 160, 40.0))[0]
    cameras = [replace(camera, name=name) for name in ("a.png", "b.png", "c.png")]
    render(city, cameras, tmp_path, optics=Optics(0.1, 0, 2.0), seed=1)
    a, b, c = (np.asarray(Image.open(tmp_path / x.name)).astype(float) for x in cameras)
    inner = (a > 30) & (a < 200) & (b > 30) & (b < 200)
    gain = np.median(b[inner] / a[inner])
    assert gain != pytest.approx(1, abs=1e-3)
    # Two images' noise: sqrt(1 + gain^2) of 2 grey levels, and the rounding's 0.29 each.
    assert np.std((b - gain * a)[inner]) == pytest.approx(np.hypot(2, 0.29) * np.sqrt(1 + gain**2), rel=0.05)
    assert not np.array_equal(b, c)


def test_features_enough_for_sfm(city, renderer, tmp_path):
    pycolmap = pytest.importorskip("pycolmap")
    from PIL import Image

    site, k = Site(120.0, 0.0, city.plan.top), Intrinsics.from_fov(960, 540, 40.0)
    counts = {}
    for name, surface in (("rich", city), ("hard", build_city(SMALL.hard(), texel=0.5))):
        camera = replace(rig("circles", 7, site, k)[5], name=f"{name}.png")
        render(surface, [camera], tmp_path)
        gray = np.asarray(Image.open(tmp_path / camera.name).convert("L")).astype(np.float32) / 255
        counts[name] = len(pycolmap.Sift(device=pycolmap.Device.cpu).extract(gray)[0])
    assert counts["rich"] > 1000
    assert counts["hard"] < 0.7 * counts["rich"]


# ---- truth ----


def test_depths_against_every_triangle(city):
    camera = rig("circles", 7, Site(120.0, 0.0, city.plan.top), Intrinsics.from_fov(96, 54, 50.0))[5]
    depth = depth_map(MeshIndex(city.mesh), camera)
    rng = np.random.default_rng(1)
    rows, columns = rng.integers(0, 54, 60), rng.integers(0, 96, 60)
    k = camera.intrinsics
    towards = np.stack([(columns + 0.5 - k.cx) / k.fx, (rows + 0.5 - k.cy) / k.fy, np.ones(60)], axis=1)
    origins = np.broadcast_to(camera.position, (60, 3))
    expected = first_hits(origins, towards @ camera.cam_from_world.rotation, city.mesh.vertices, city.mesh.faces)
    expected[np.isinf(expected)] = 0
    np.testing.assert_allclose(depth[rows, columns], expected, rtol=1e-6)  # float32


def test_views_against_every_triangle(city):
    site, k = Site(120.0, 0.0, city.plan.top), Intrinsics.from_fov(96, 54, 40.0)
    cameras = rig("circles", 7, site, k)[::2]
    cloud = city.mesh.sample(30, seed=2)
    found = views(MeshIndex(city.mesh), cameras, cloud.points, cloud.normals)
    expected = np.zeros(30, dtype=int)
    for camera in cameras:
        (u, v), z = camera.project(cloud.points)[0].T, camera.project(cloud.points)[1]
        inside = (z > 0) & (u >= 0) & (u < 96) & (v >= 0) & (v < 54)
        lines = camera.position - cloud.points
        inside &= np.einsum("ni,ni->n", lines, cloud.normals) > 0
        starts = cloud.points + 1e-4 * cloud.normals
        free = first_hits(starts, camera.position - starts, city.mesh.vertices, city.mesh.faces) > 1
        expected += inside & free
    np.testing.assert_array_equal(found, expected)
    assert len(set(expected)) > 2
