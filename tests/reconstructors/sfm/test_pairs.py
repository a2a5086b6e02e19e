"""Selection of image pairs."""

from pathlib import Path

import numpy as np
from wording import check_error

from pcbench.geometry.cameras import Camera, Intrinsics, look_at
from pcbench.geometry.geodesy import Gps
from pcbench.scenes import Scene
from reconstructors.sfm.pairs import choose_pairs

K = Intrinsics(40, 30, 35, 35, 20, 15)


def make_scene(count, name="{:03}.png", **known):
    names = tuple(name.format(number) for number in range(count))
    return Scene(Path("photos"), names, dict.fromkeys(names, (40, 30)), **known)


def posed_scene(count):
    scene = make_scene(count)
    angles = 2 * np.pi * np.arange(count) / count
    cameras = {
        name: Camera(name, K, look_at([np.cos(a), np.sin(a), 1], [0, 0, 0]))
        for name, a in zip(scene.images, angles, strict=True)
    }
    return make_scene(count, cameras=cameras)


def test_few_images_are_all_paired():
    method, pairs = choose_pairs(make_scene(5), "auto")
    assert method == "exhaustive"
    assert len(pairs) == len(set(pairs)) == 10


def test_numbered_images_are_paired_with_the_following_ones():
    method, pairs = choose_pairs(make_scene(60), "auto")
    assert method == "sequential"
    steps = {int(b[:3]) - int(a[:3]) for a, b in pairs}
    assert steps == {*range(1, 11), 16, 32}
    assert len(pairs) == sum(60 - step for step in steps)


def test_many_images_without_numbers_are_all_paired():
    assert choose_pairs(make_scene(40, "{:03}x.png"), "auto")[0] == "exhaustive"


def test_posed_images_are_paired_with_their_neighbours():
    method, pairs = choose_pairs(posed_scene(80), "auto")
    assert method == "spatial"
    gaps = [min((int(b[:3]) - int(a[:3])) % 80, (int(a[:3]) - int(b[:3])) % 80) for a, b in pairs]
    assert len(pairs) == 80 * 10  # ten to either side; each pair once
    assert max(gaps) == 10


def test_images_with_gps_are_paired_with_their_neighbours():
    scene = make_scene(40, gps={f"{n:03}.png": Gps(48 + 1e-4 * n, 11.0, 500.0) for n in range(40)})
    method, pairs = choose_pairs(scene, "auto")
    assert method == "spatial"
    assert ("000.png", "020.png") in pairs
    assert ("000.png", "021.png") not in pairs


def test_spatial_pairing_without_positions_is_refused():
    with check_error():
        choose_pairs(make_scene(40), "spatial")
