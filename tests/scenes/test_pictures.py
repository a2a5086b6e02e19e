"""Images of the city: geometry, supersampling, and effects of lens, glass and water."""

from dataclasses import replace

import numpy as np
import pytest
from children_here import rendering_here
from optional import import_or_skip

from pcbench.geometry.cameras import Camera, Intrinsics, look_at
from pcbench.geometry.mesh import Mesh, MeshIndex
from pcbench.scenes.synthetic.plan import CitySettings
from pcbench.scenes.synthetic.render import Optics, render
from pcbench.scenes.synthetic.render_worker import vignette
from pcbench.scenes.synthetic.rigs import Site, rig
from pcbench.scenes.synthetic.surface import CitySurface, build_city
from pcbench.scenes.synthetic.truth import depth_map

SMALL_CITY = CitySettings(extent=120.0, seed=3)
DISTORTION = (-0.08, 0.01, 0.002, -0.001)


@pytest.fixture(autouse=True)
def _rendered_here():
    with rendering_here():
        yield


def build_plates(corners):
    """Build white quadrilaterals (Q, 4, 3) on black ground."""
    ground = np.array([[[-200, -200, 0], [200, -200, 0], [200, 200, 0], [-200, 200, 0]]], dtype=float)
    quads = np.concatenate([ground, corners])
    faces = (4 * np.arange(len(quads))[:, None, None] + [[0, 1, 2], [0, 2, 3]]).reshape(-1, 3)
    mesh = Mesh(quads.reshape(-1, 3), faces)
    shade = np.full((len(faces), 3), 255, dtype=np.uint8)
    shade[:2] = 0
    uv, page = np.full((len(faces), 3, 2), 0.5, dtype=np.float32), np.zeros(len(faces), dtype=np.int64)
    return CitySurface(None, mesh, uv, page, shade, [np.full((8, 8, 3), 255, dtype=np.uint8)], [None])


def centroid(outline):
    """Return the centroid of a polygon (N, 2)."""
    x, y = (outline - outline[0]).T
    cross = x * np.roll(y, -1) - np.roll(x, -1) * y
    return outline[0] + [((p + np.roll(p, -1)) * cross).sum() / (3 * cross.sum()) for p in (x, y)]


def test_images_and_depths_agree_with_the_camera(renderer, tmp_path):
    from PIL import Image

    rng = np.random.default_rng(0)
    x, y = np.meshgrid(np.linspace(-60, 60, 7), np.linspace(-40, 40, 5))
    centres = np.stack([x.ravel(), y.ravel(), rng.uniform(0.5, 12, x.size)], axis=1)
    square = np.array([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]]) * 2.5
    surface = build_plates(centres[:, None] + square)
    k = replace(Intrinsics.from_fov(480, 320, 45.0), distortion=DISTORTION, cx=233.0, cy=166.5)
    camera = Camera("a.png", k, look_at([30, -80, 130], [0, 0, 0]))
    render(surface, [camera], tmp_path, optics=Optics(0, 0, 0))
    image = np.asarray(Image.open(tmp_path / "a.png")).astype(float)[..., 0] / 255
    depth = depth_map(MeshIndex(surface.mesh), camera)
    u, v = np.meshgrid(np.arange(480) + 0.5, np.arange(320) + 0.5)
    sides = zip(square, np.roll(square, -1, axis=0), strict=True)
    outline_samples = np.concatenate([np.linspace(a, b, 16, endpoint=False) for a, b in sides])
    centroid_errors = []
    for centre in centres:
        outline = camera.project(np.concatenate([centre + square, [centre]]))[0]
        lower, upper = np.floor(outline.min(axis=0)).astype(int) - 2, np.ceil(outline.max(axis=0)).astype(int) + 2
        if (lower < 0).any() or (upper > [480, 320]).any():
            continue
        window = np.s_[lower[1] : upper[1], lower[0] : upper[0]]
        weight = image[window]
        image_centroid = np.array([(weight * u[window]).sum(), (weight * v[window]).sum()]) / weight.sum()
        centroid_errors.append(image_centroid - centroid(camera.project(centre + outline_samples)[0]))
        # The depth of the pixel at the centre is that of the plate's plane.
        pixel = np.floor(outline[-1]).astype(int)
        ray = camera.intrinsics.directions(pixel[None] + 0.5)[0] * depth[pixel[1], pixel[0]]
        assert camera.cam_from_world.inverse().apply(ray[None])[0, 2] == pytest.approx(centre[2], abs=2e-5)  # float32
    assert len(centroid_errors) > 20
    # With sixteen samples per pixel, each centroid is accurate to about 0.05 pixels and their mean to 0.01.
    assert np.abs(centroid_errors).max() < 0.08
    np.testing.assert_allclose(np.mean(centroid_errors, axis=0), 0, atol=0.01)


def sample_image(surface, camera, window, samples):
    """Return a camera's image of white plates on black ground in the rows and columns of `window`.

    Each pixel is the mean of `samples` x `samples` rays.
    """
    (top, bottom), (left, right) = window
    u, v = ((np.arange(samples * n) + 0.5) / samples for n in (right - left, bottom - top))
    ray_pixels = np.stack(np.meshgrid(left + u, top + v), axis=2).reshape(-1, 2)
    rays = camera.intrinsics.directions(ray_pixels) @ camera.cam_from_world.rotation
    hits = MeshIndex(surface.mesh).cast(camera.position, rays)
    is_white = (hits.faces >= 2).reshape(bottom - top, samples, right - left, samples)
    return is_white.mean(axis=(1, 3))


PLATE_CORNERS = np.array([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]]) * 2.5
OBLIQUE_POSE = look_at([30, -80, 130], [0, 0, 0])


@pytest.mark.parametrize(
    "distortion",
    [pytest.param((0, 0, 0, 0), id="pinhole"), pytest.param(DISTORTION, id="distorted", marks=pytest.mark.long)],
)
def test_pixels_average_over_their_area(distortion, renderer, tmp_path):
    """Compared with 256 rays per pixel: sixteen samples leave a third of the error of four."""
    from PIL import Image

    rng = np.random.default_rng(5)
    centres = np.column_stack([rng.uniform(-40, 40, (30, 2)), rng.uniform(1, 20, 30)])
    rotated_plates = [PLATE_CORNERS @ look_at([0, 0, 0], rng.normal(size=3)).rotation for _ in centres]
    surface = build_plates(centres[:, None] + np.array(rotated_plates))
    k = replace(Intrinsics.from_fov(120, 80, 45.0), distortion=distortion)
    camera = Camera("a.png", k, OBLIQUE_POSE)
    render(surface, [camera], tmp_path, optics=Optics(0, 0, 0))
    image = np.asarray(Image.open(tmp_path / "a.png")).astype(float)[..., 0] / 255
    expected = sample_image(surface, camera, ((0, 80), (0, 120)), 16)
    is_edge = (expected > 0) & (expected < 1)
    assert is_edge.sum() > 200
    assert np.sqrt(np.mean((image - expected)[is_edge] ** 2)) < 0.05  # 0.09 with four samples, 0.03 with sixteen
    assert np.abs((image - expected)[~is_edge]).max() < 0.1


def test_large_images_are_rendered_in_tiles(renderer, tmp_path):
    from PIL import Image

    x = np.linspace(-60, 60, 41)
    surface = build_plates(np.column_stack([x, 0 * x, 1 + 0 * x])[:, None] + 0.4 * PLATE_CORNERS)
    camera = Camera("a.png", Intrinsics(2100, 40, 1600, 1600, 1050, 20), look_at([0, 0, 100], [0, 0, 0]))
    render(surface, [camera], tmp_path, optics=Optics(0, 0, 0))
    image = np.asarray(Image.open(tmp_path / "a.png")).astype(float)[..., 0] / 255
    expected = sample_image(surface, camera, ((0, 40), (0, 2100)), 4)
    assert np.abs(image - expected).mean() < 0.002
    assert np.abs(image - expected).max() < 0.3


@pytest.mark.long
def test_vignetting_is_the_fourth_power_of_the_cosine(renderer, tmp_path):
    from PIL import Image

    surface = build_plates(np.array([[[-90, -90, 1], [90, -90, 1], [90, 90, 1], [-90, 90, 1.0]]]))
    k = Intrinsics(120, 80, 100.0, 90.0, 50.0, 44.0)
    camera = Camera("a.png", k, look_at([0, 0, 40], [0, 0, 0]))
    images = []
    for strength in (0.0, 1.0):
        render(surface, [camera], tmp_path, optics=Optics(0, 0, 0, strength))
        images.append(np.asarray(Image.open(tmp_path / "a.png")).astype(float)[..., 0])
    plain_image, vignetted_image = images
    assert (plain_image == 255).all()
    u, v = np.meshgrid(np.arange(120) + 0.5, np.arange(80) + 0.5)
    angle = np.arctan(np.hypot((u - 50) / 100, (v - 44) / 90))
    np.testing.assert_allclose(vignetted_image, 255 * np.cos(angle) ** 4, atol=0.51)  # rounded
    assert vignetted_image.min() < 0.6 * 255
    np.testing.assert_allclose(vignette(k, 0.5), 0.5 + 0.5 * np.cos(angle) ** 4, rtol=1e-6)


@pytest.mark.long
def test_water_reflects_by_the_law_of_reflection(renderer, tmp_path):
    """Water before a red wall: pixel colours computed from the law of reflection and Schlick's formula."""
    from PIL import Image

    pond = np.array([[-50, 0, 0], [50, 0, 0], [50, 60, 0], [-50, 60, 0]], dtype=float)
    wall = np.array([[-50, 60, -1], [50, 60, -1], [50, 60, 12], [-50, 60, 12]], dtype=float)
    mesh = Mesh(np.concatenate([pond, wall]), np.array([[0, 1, 2], [0, 2, 3], [4, 5, 6], [4, 6, 7]]))
    water, red = np.array([40, 70, 80]), np.array([210, 60, 30])
    pages = [np.full((8, 8, 3), color, dtype=np.uint8) for color in (water, red)]
    mirrors = [np.full((8, 8), 20, dtype=np.uint8), None]
    uv, shade = np.full((4, 3, 2), 0.5, dtype=np.float32), np.full((4, 3), 255, dtype=np.uint8)
    surface = CitySurface(None, mesh, uv, np.array([0, 0, 1, 1]), shade, pages, mirrors)
    k = Intrinsics.from_fov(120, 90, 40.0)
    camera = Camera("a.png", k, look_at([0, -20, 12], [0, 20, 0]))
    camera_away = Camera("b.png", k, look_at([0, -20, 12], [0, -40, 12]))  # with nothing to mirror in sight
    render(surface, [camera, camera_away], tmp_path, optics=Optics(0, 0, 0), reflections=True)
    image = np.asarray(Image.open(tmp_path / "a.png")).astype(float)
    render(surface, [camera], tmp_path, optics=Optics(0, 0, 0))
    plain_image = np.asarray(Image.open(tmp_path / "a.png")).astype(float)
    counts = {"wall": 0, "sky": 0}
    for row in range(5, 90, 4):
        _, y, z = ray = k.directions(np.array([[60.5, row + 0.5]]))[0] @ camera.cam_from_world.rotation
        distance = -20 - 12 * y / z  # of the water's surface
        if z >= 0 or not 2 < distance < 58:
            continue
        cosine = -z / np.linalg.norm(ray)
        reflectance = 0.02 + 0.98 * (1 - cosine) ** 5
        height = (60 - distance) * -z / y  # at which the reflected ray meets the wall
        if abs(height - 12) < 1:
            continue
        target = "wall" if height < 12 else "sky"
        horizon_color, zenith_color = np.array([0.86, 0.90, 0.94]), np.array([0.52, 0.68, 0.86])
        sky_color = 255 * (
            horizon_color + cosine * (zenith_color - horizon_color)
        )  # at the height of the reflected ray
        reflected_color = red if target == "wall" else sky_color
        np.testing.assert_array_equal(plain_image[row, 60], water)
        np.testing.assert_allclose(image[row, 60], (1 - reflectance) * water + reflectance * reflected_color, atol=1.5)
        counts[target] += 1
    assert min(counts.values()) >= 2
    np.testing.assert_array_equal(image[0], plain_image[0])  # the wall itself


def test_city_outline_matches_its_depths(city, renderer, tmp_path):
    from PIL import Image

    camera = rig("orbit", 3, Site(120.0, 0.0, city.plan.top), Intrinsics.from_fov(480, 270, 60.0))[1]
    camera = replace(camera, cam_from_world=look_at(camera.position * [1, 1, 0.4], [0, 0, 20]))
    black_city = replace(city, shade=np.zeros_like(city.shade))
    render(black_city, [camera], tmp_path, optics=Optics(0, 0, 0))
    image = np.asarray(Image.open(tmp_path / camera.name)).astype(float)[..., 2]
    sky = np.median(image[:5])
    coverage = 1 - np.clip(image / sky, 0, 1)
    city_mask = (depth_map(MeshIndex(city.mesh), camera) > 0).astype(float)
    assert 0.1 < city_mask.mean() < 0.9
    gradient = np.stack([np.gradient(city_mask, axis=1), np.gradient(city_mask, axis=0)], axis=-1)
    is_edge = np.abs(gradient).sum(axis=-1) > 0
    shift = np.linalg.lstsq(gradient[is_edge], (coverage - city_mask)[is_edge], rcond=None)[0]
    assert np.abs(shift).max() < 0.1  # pixels
    assert (np.abs(coverage - city_mask)[~is_edge] < 0.1).all()  # the sky is brighter towards the upper side


def test_each_image_has_its_own_gain_and_noise(city, renderer, tmp_path):
    from PIL import Image

    camera = rig("grid", 1, Site(120.0, 0.0, city.plan.top), Intrinsics.from_fov(240, 160, 40.0))[0]
    cameras = [replace(camera, name=name) for name in ("a.png", "b.png", "c.png")]
    render(city, cameras, tmp_path, optics=Optics(0.1, 0, 2.0), seed=1)
    a, b, c = (np.asarray(Image.open(tmp_path / x.name)).astype(float) for x in cameras)
    is_unclipped = (a > 30) & (a < 200) & (b > 30) & (b < 200)
    gain = np.median(b[is_unclipped] / a[is_unclipped])
    assert gain != pytest.approx(1, abs=1e-3)
    # Each image has noise of 2 grey levels and rounding of 0.29; their difference has sqrt(1 + gain^2) times that.
    assert np.std((b - gain * a)[is_unclipped]) == pytest.approx(np.hypot(2, 0.29) * np.sqrt(1 + gain**2), rel=0.05)
    assert not np.array_equal(b, c)


@pytest.mark.slow
def test_images_have_enough_features_for_sfm(city, renderer, tmp_path):
    pycolmap = import_or_skip("pycolmap")
    from PIL import Image

    site, k = Site(120.0, 0.0, city.plan.top), Intrinsics.from_fov(960, 540, 40.0)
    counts = {}
    for name, surface in (("rich", city), ("hard", build_city(SMALL_CITY.hard(), texel=0.5))):
        camera = replace(rig("circles", 7, site, k)[5], name=f"{name}.png")
        render(surface, [camera], tmp_path)
        gray = np.asarray(Image.open(tmp_path / camera.name).convert("L")).astype(np.float32) / 255
        counts[name] = len(pycolmap.Sift(device=pycolmap.Device.cpu).extract(gray)[0])
    assert counts["rich"] > 1000
    assert counts["hard"] < 0.7 * counts["rich"]
