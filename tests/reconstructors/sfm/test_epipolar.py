"""Agreement of image pairs with cameras, with known matches, and messages about contradicting pairs."""

import re
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import textured_corner as corner
from optional import import_or_skip
from wording import check_error, check_text

from pcbench.errors import ReconstructionError
from pcbench.geometry.cameras import look_at
from pcbench.geometry.transform import Similarity
from reconstructors.sfm.alignment import transform_camera
from reconstructors.sfm.epipolar import (
    Agreement,
    VerifiedPair,
    ambiguity_warning,
    check_cameras,
    epipolar_agreement,
    write_pairs,
)
from reconstructors.sfm.features import DATABASE
from reconstructors.sfm.matches import remove_pairs
from reconstructors.sfm.solve import SolvedModel, best_solution, describe_differences

pycolmap = import_or_skip("pycolmap")

K = corner.standard_intrinsics()
WRONG = {(0, 3): 150, (1, 4): 120, (0, 5): 110, (2, 3): 40}  # false matches


@pytest.fixture
def known(tmp_path):
    """Create a database of six images whose pairs, except `WRONG`, have 200 true matches; and the true cameras."""
    rng = np.random.default_rng(3)
    cameras = corner.cameras(6, K)
    points = rng.uniform(0.1, 1.5, (200, 3))
    database = pycolmap.Database.open(tmp_path / DATABASE)
    lens = pycolmap.Camera(model="PINHOLE", width=480, height=360, params=[K.fx, K.fy, K.cx, K.cy])
    lens_id = database.write_camera(lens)
    numbers = []
    for camera in cameras:
        numbers.append(database.write_image(pycolmap.Image(name=camera.name, camera_id=lens_id)))
        database.write_keypoints(numbers[-1], camera.project(points)[0].astype(np.float32))
    for a in range(6):
        for b in range(a + 1, 6):
            count = WRONG.get((a, b))
            true = np.arange(200)
            matches = np.stack([true, true] if count is None else [true[:count], rng.permutation(200)[:count]], axis=1)
            geometry = pycolmap.TwoViewGeometry()
            geometry.config = pycolmap.TwoViewGeometryConfiguration.CALIBRATED
            geometry.inlier_matches = matches.astype(np.uint32)
            database.write_matches(numbers[a], numbers[b], matches.astype(np.uint32))
            database.write_two_view_geometry(numbers[a], numbers[b], geometry)
    database.close()
    (tmp_path / "stage.json").write_text("{}")
    return tmp_path, {camera.name: camera for camera in cameras}


def test_pairs_that_contradict_the_cameras_are_counted(known, tmp_path):
    folder, cameras = known
    found = check_cameras(folder / DATABASE, cameras)
    assert len(found.pairs) == 15
    wrong = {(f"{a:03}.png", f"{b:03}.png") for a, b in WRONG}
    assert {(pair.a, pair.b) for pair in found.pairs if not pair.agrees} == wrong
    assert all(pair.share == 1 for pair in found.pairs if (pair.a, pair.b) not in wrong)
    assert found.share_of_pairs == pytest.approx(11 / 15)
    # Of 2,200 true and 420 false matches; some of the false ones lie on their epipolar lines by chance.
    assert 0.84 < found.share < 0.87
    assert "73% of the 15 pairs" in check_text(found.describe("given"))
    assert [pair.matches for pair in found.contradicting_pairs] == [150, 110, 120]  # that of 40 matches is weak
    assert not found.is_sound
    (note,) = ambiguity_warning(found, "solved")
    for value in ("3 of 14 pairs", "000.png with 003.png (150), 005.png (110); 001.png with 004.png (120)"):
        assert value in note
    assert "6 (000.png to 005.png)" in check_text(note)
    write_pairs(tmp_path / "pairs.csv", found)
    lines = (tmp_path / "pairs.csv").read_text().splitlines()
    assert lines[0] == "image_a,image_b,matches,share_that_agrees"
    assert lines[1] == '"000.png","001.png",200,1.000'
    assert len(lines) == 16


def test_images_without_a_camera_are_left_out_and_few_wrong_pairs_tolerated(known):
    folder, cameras = known
    found = epipolar_agreement(
        folder / DATABASE, {name: camera for name, camera in cameras.items() if name != "000.png"}
    )
    assert len(found.pairs) == 10
    assert len(found.contradicting_pairs) == 1
    assert found.is_sound
    assert not ambiguity_warning(found, "solved")
    others = dict(zip(cameras, reversed(cameras.values()), strict=True))
    with check_error(ReconstructionError, masked=True):
        check_cameras(folder / DATABASE, others)


def test_pairs_are_dropped_from_a_copy(known, tmp_path):
    folder, cameras = known
    before = epipolar_agreement(folder / DATABASE, cameras)
    kept = remove_pairs(folder, tmp_path, "kept", dropped=[("003.png", "000.png")], min_matches=100)
    left = {(pair.a, pair.b) for pair in epipolar_agreement(kept / DATABASE, cameras).pairs}
    dropped = {("000.png", "003.png"), ("002.png", "003.png")}
    assert left == {(pair.a, pair.b) for pair in before.pairs} - dropped
    assert len(epipolar_agreement(folder / DATABASE, cameras).pairs) == 15


def test_groups_of_the_graph():
    pairs = [
        VerifiedPair("a", "b", 200, 1.0),
        VerifiedPair("c", "d", 200, 1.0),
        VerifiedPair("d", "e", 200, 1.0),
        VerifiedPair("a", "c", 200, 0.1),
    ]
    assert "3 (c to e), 2 (a to b)" in check_text(Agreement(tuple(pairs)).describe_graph())


def solution(images, contradicting_pairs):
    pairs = tuple(VerifiedPair("a", f"{n}", 150, 0.0 if n < contradicting_pairs else 1.0) for n in range(20))
    return SolvedModel(
        f"{images}, {contradicting_pairs}", None, dict.fromkeys(map(str, range(images))), Agreement(pairs), []
    )


@pytest.mark.parametrize(
    "found, kept",
    [
        ([(30, 0), (30, 0)], 0),  # the requested solution
        ([(25, 0), (30, 0)], 0),
        ([(12, 0), (30, 0)], 1),  # but not of less than half of the images
        ([(30, 9), (26, 0), (28, 0)], 2),
        ([(30, 9), (30, 5), (10, 0)], 1),
        ([(30, 2), (30, 0)], 0),  # a few are tolerated
    ],
)
def test_the_solution_that_the_fewest_pairs_contradict_is_kept(found, kept):
    solutions = [solution(*numbers) for numbers in found]
    assert best_solution(solutions) is solutions[kept]


def ring(seed, noise):
    """Return twelve cameras on a circle of radius 5 about the origin, with position noise."""
    rng = np.random.default_rng(seed)
    found = {}
    for name, angle in zip("abcdefghijkl", np.linspace(0, 2 * np.pi, 12, endpoint=False), strict=True):
        eye = [5 * np.cos(angle), 5 * np.sin(angle), 0.5 * np.sin(3 * angle)] + rng.normal(0, noise, 3)
        found[name] = replace(corner.cameras(1, K)[0], name=name, cam_from_world=look_at(eye, [0, 0, 0]))
    return found


def seen_by(cameras):
    """Build a solved model in which all cameras observe the same points about the origin."""
    track = [SimpleNamespace(has_point3D=lambda: True, point3D_id=number) for number in range(20)]
    points = np.random.default_rng(4).uniform(-1, 1, (20, 3))
    return SimpleNamespace(
        find_image_with_name=lambda name: SimpleNamespace(points2D=track),
        points3D={number: SimpleNamespace(xyz=point) for number, point in enumerate(points)},
    )


def test_significantly_different_cameras_are_named():
    kept = ring(0, 0.0)
    turn = look_at([1, 2, 3], [0, 0, 0]).rotation
    elsewhere = Similarity(turn, np.array([10.0, 20.0, 30.0]), 2.5)

    def other(cameras):
        return SolvedModel(
            "global mapping", None, {n: transform_camera(c, elsewhere) for n, c in cameras.items()}, Agreement(()), []
        )

    here = SolvedModel("incremental mapping", seen_by(kept), kept, Agreement(()), [])
    noisy = ring(1, 0.002)  # a pixel at 5 is 0.0116
    assert describe_differences(here, other(noisy)) == []
    pose = noisy["c"].cam_from_world
    noisy["c"] = replace(noisy["c"], cam_from_world=Similarity(pose.rotation, pose.translation + [0.1, 0, 0]))
    (note,) = describe_differences(here, other(noisy))
    apart = re.search(r" c ([0-9.]+) .* 0\.00", check_text(note))
    assert float(apart[1]) == pytest.approx(0.1, abs=0.01)
    (note,) = describe_differences(here, other(ring(2, 0.3)))
    check_text(note)
    assert describe_differences(here, other({"a": kept["a"], "b": kept["b"]})) == []
