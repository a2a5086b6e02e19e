"""Ladders of photographs: their start changes nothing, and each level is what its unit says."""

from dataclasses import replace

import numpy as np
import pytest
from repository import ROOT
from wording import check_error

from pcbench.geometry.cameras import Camera, Intrinsics, look_at
from pcbench.scenes import read_scene
from pcbench.studies.stress.reconstructors.ladders import PHOTO_LADDERS, Photographs, linear_light, selected, srgb
from pcbench.studies.stress.reconstructors.scenes import base_settings, write_photographs

COUNT, WIDTH, HEIGHT = 400, 24, 16


@pytest.fixture(scope="module")
def photographs():
    """Many small photographs on a circle, so that statistics of random errors are precise."""
    rng = np.random.default_rng(0)
    intrinsics = Intrinsics.from_fov(WIDTH, HEIGHT, 50.0)
    cameras = []
    for k, angle in enumerate(np.linspace(0, 2 * np.pi, COUNT, endpoint=False)):
        at = [50 * np.cos(angle), 50 * np.sin(angle), 30.0]
        cameras.append(Camera(f"{k:04d}.png", intrinsics, look_at(at, [0.0, 0.0, 0.0])))
    images = {c.name: rng.integers(40, 120, (HEIGHT, WIDTH, 3)).astype(np.uint8) for c in cameras}
    return Photographs(tuple(cameras), images)


def climbed(photographs, name, level, seed=0):
    return PHOTO_LADDERS[name].apply(photographs, level, np.random.default_rng(seed))


def state(photographs):
    return [
        (c.name, c.intrinsics, c.cam_from_world.matrix.tobytes(), photographs.images[c.name].tobytes())
        for c in photographs.cameras
    ]


@pytest.mark.parametrize("name", PHOTO_LADDERS)
def test_start_changes_nothing_and_levels_change_something_but_never_the_input(name, photographs):
    ladder = PHOTO_LADDERS[name]
    before = state(photographs)
    base = base_settings(0, quick=True)
    if ladder.render is not None:
        scenes = [ladder.scene(base, level) for level in ladder.levels]
        assert len({repr(scene) for scene in (base, *scenes)}) == len(ladder.levels) + 1
        assert all(scene.intrinsics == base.intrinsics and scene.images == base.images for scene in scenes)
        if not ladder.level_names:
            assert ladder.scene(base, ladder.start) == base
        assert climbed(photographs, name, ladder.levels[0]) is photographs
    else:
        assert ladder.scene(base, ladder.levels[0]) == base
        assert state(climbed(photographs, name, ladder.start)) == before
        levels = [state(climbed(photographs, name, level)) for level in ladder.levels]
        assert all(one != other for one, other in zip([before, *levels], levels, strict=False))
        assert state(climbed(photographs, name, ladder.levels[-1])) == levels[-1]
    assert state(photographs) == before


@pytest.mark.parametrize("name", PHOTO_LADDERS)
def test_levels_are_ordered_and_those_of_the_quick_plan_lie_between_them(name):
    ladder = PHOTO_LADDERS[name]
    sign = np.sign(ladder.levels[-1] - ladder.start)
    assert (np.diff([ladder.start, *ladder.levels]) * sign > 0).all()
    if ladder.quick:
        assert (np.diff([ladder.start, *ladder.quick]) * sign > 0).all()
    assert ladder.info(quick=False).subjects == ("reconstruction",)
    assert len(ladder.level_names) in (0, len(ladder.levels))


def test_fewer_images_are_nested_shares(photographs):
    kept = [{c.name for c in climbed(photographs, "fewer-images", level).cameras} for level in (75, 50, 10)]
    assert [len(names) for names in kept] == [300, 200, 40]
    assert kept[0] > kept[1] > kept[2]
    few = climbed(photographs, "fewer-images", 10)
    assert set(few.images) == kept[2]
    assert [c.name for c in few.cameras] == sorted(kept[2])  # the order of the flight
    assert len(climbed(photographs, "fewer-images", 0.01).cameras) == 1


def test_a_cropped_image_shows_the_same_rays(photographs):
    cut = climbed(photographs, "crop", 50)
    for before, after in zip(photographs.cameras[:5], cut.cameras[:5], strict=True):
        assert (after.intrinsics.width, after.intrinsics.height) == (WIDTH // 2, HEIGHT // 2)
        assert cut.images[after.name].shape == (HEIGHT // 2, WIDTH // 2, 3)
        assert after.intrinsics.fx == before.intrinsics.fx
        points = before.position + 40 * before.direction + np.random.default_rng(1).normal(size=(20, 3))
        pixels, _ = before.project(points)
        moved, _ = after.project(points)
        np.testing.assert_allclose(pixels - moved, np.broadcast_to([WIDTH / 4, HEIGHT / 4], (20, 2)), atol=1e-9)
        left, top = WIDTH // 4, HEIGHT // 4
        part = photographs.images[before.name][top : top + HEIGHT // 2, left : left + WIDTH // 2]
        np.testing.assert_array_equal(cut.images[after.name], part)


def test_blur_is_a_gaussian_of_linear_light():
    size, sigma = 61, 2.0
    image = np.zeros((size, size, 3), np.uint8)
    image[size // 2, size // 2] = 255
    camera = Camera("a.png", Intrinsics.from_fov(size, size, 50.0), look_at([0, 0, 10], [0, 0, 0]))
    blurred = climbed(Photographs((camera,), {"a.png": image}), "blur", sigma).images["a.png"]
    x = np.arange(size) - size // 2
    expected = np.exp(-0.5 * (x[:, None] ** 2 + x[None] ** 2) / sigma**2) / (2 * np.pi * sigma**2)
    light = linear_light(blurred)[..., 0]
    assert light[size // 2, size // 2] == pytest.approx(expected.max(), rel=0.02)
    np.testing.assert_allclose(light, expected, atol=5e-4)  # a step of 8-bit sRGB near black is 3e-4
    flat = np.full((9, 9, 3), 77, np.uint8)  # edges are continued
    scene = Photographs((camera,), {"a.png": flat})
    np.testing.assert_array_equal(climbed(scene, "blur", 8).images["a.png"], flat)


def test_exposure_multiplies_linear_light_by_powers_of_two(photographs):
    level = 0.5
    jittered = climbed(photographs, "exposure", level)
    stops = np.array(
        [
            np.log2(np.median(linear_light(jittered.images[name]) / linear_light(photographs.images[name])))
            for name in photographs.images
        ]
    )
    assert stops.std() == pytest.approx(level, rel=0.1)  # 400 images: a standard error of 3.5 %
    assert abs(stops.mean()) < 0.1
    twice = climbed(photographs, "exposure", 2 * level)
    name = photographs.cameras[int(np.argmin(stops))].name
    darker = np.median(linear_light(twice.images[name]) / linear_light(photographs.images[name]))
    assert np.log2(darker) == pytest.approx(2 * stops.min(), abs=0.15)  # the same random numbers


def test_srgb_and_linear_light_are_inverse():
    grey = np.arange(256, dtype=np.uint8)[:, None, None].repeat(3, axis=2)
    np.testing.assert_array_equal(srgb(linear_light(grey)), grey)
    assert linear_light(grey)[188, 0, 0] == pytest.approx(0.5029, abs=1e-4)  # IEC 61966-2-1
    assert srgb(np.array([[[0.0, 1.0, 4.0]]], np.float32)).tolist() == [[[0, 255, 255]]]


def test_position_errors_have_the_standard_deviation_of_the_level(photographs):
    moved = climbed(photographs, "positions", 3.0)
    pairs = list(zip(photographs.cameras, moved.cameras, strict=True))
    errors = np.array([b.position - a.position for a, b in pairs])
    assert errors.std(axis=0) == pytest.approx([3.0] * 3, rel=0.12)
    for a, b in pairs:
        np.testing.assert_array_equal(b.cam_from_world.rotation, a.cam_from_world.rotation)
    small = climbed(photographs, "positions", 0.3)
    np.testing.assert_allclose(
        [b.position - a.position for a, b in zip(photographs.cameras, small.cameras, strict=True)],
        0.1 * errors,
        atol=1e-9,
    )


def test_rotation_errors_keep_the_positions(photographs):
    turned = climbed(photographs, "rotations", 1.0)
    angles = []
    for a, b in zip(photographs.cameras, turned.cameras, strict=True):
        np.testing.assert_allclose(b.position, a.position, atol=1e-9)
        error = b.cam_from_world.rotation @ a.cam_from_world.rotation.T
        np.testing.assert_allclose(error @ error.T, np.eye(3), atol=1e-12)
        angles.append(np.degrees(np.arccos(np.clip((np.trace(error) - 1) / 2, -1, 1))))
    assert np.sqrt(np.square(angles).mean() / 3) == pytest.approx(1.0, rel=0.1)  # three axes


def test_focal_length_is_enlarged_and_images_stay(photographs):
    zoomed = climbed(photographs, "focal-length", 10)
    for a, b in zip(photographs.cameras, zoomed.cameras, strict=True):
        assert b.intrinsics == replace(a.intrinsics, fx=1.1 * a.intrinsics.fx, fy=1.1 * a.intrinsics.fy)
    assert zoomed.images is photographs.images


def test_rendered_levels_set_one_property_of_the_city():
    base = base_settings(3, quick=False)
    texture = PHOTO_LADDERS["texture"]
    assert texture.scene(base, 0.25) == replace(base, city=replace(base.city, texture=0.25))
    cases = PHOTO_LADDERS["difficult"]
    named = {name: cases.scene(base, level) for name, level in zip(cases.level_names, cases.levels, strict=True)}
    assert named["repeated facades"] == replace(base, city=replace(base.city, repeated=True))
    assert named["lakes"] == replace(base, city=replace(base.city, water=True))
    assert named["lakes that reflect"] == replace(named["lakes"], reflections=True)
    assert named["half-turn symmetry"] == replace(base, city=replace(base.city, symmetric=True))
    assert named["hard city"] == replace(base, city=base.city.hard())


def test_written_photographs_are_read_as_they_are(photographs, tmp_path):
    pytest.importorskip("PIL")
    few = climbed(climbed(photographs, "fewer-images", 1), "rotations", 3.0)
    few = climbed(few, "crop", 50)
    write_photographs(tmp_path, few)
    scene = read_scene(tmp_path)
    assert scene.images == tuple(camera.name for camera in few.cameras)
    for camera in few.cameras:
        found = scene.cameras[camera.name]
        assert found.intrinsics == camera.intrinsics
        np.testing.assert_allclose(found.cam_from_world.matrix, camera.cam_from_world.matrix, atol=1e-9)
        np.testing.assert_array_equal(scene.read_image(camera.name), few.images[camera.name])


def test_selection_by_name_and_kind():
    assert [ladder.name for ladder in selected("cameras,blur", quick=False)] == [
        "blur", "positions", "rotations", "focal-length",
    ]  # fmt: skip
    assert [ladder.name for ladder in selected(None, quick=True)] == ["fewer-images", "blur", "positions"]
    assert len(selected(None, quick=False)) == len(PHOTO_LADDERS)
    with check_error():
        selected("texture", quick=True)


def test_page_lists_all_ladders():
    page = (ROOT / "docs" / "howto" / "stress.md").read_text()
    _, _, section = page.partition("| ladder of photographs |")
    rows = [line.strip("| ").split(" | ") for line in section.splitlines() if line.startswith("| `")]
    documented = {row[0].strip("`"): row[1:] for row in rows if row[0].strip("`") in PHOTO_LADDERS}
    assert list(documented) == list(PHOTO_LADDERS)
    for name, (title, levels) in documented.items():
        ladder = PHOTO_LADDERS[name]
        texts = ladder.level_names or [f"{level:g}" for level in ladder.levels]
        assert (title, levels) == (ladder.title, f"{', '.join(texts)} {ladder.unit}".rstrip())
