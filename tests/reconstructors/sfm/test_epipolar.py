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
FALSE_MATCH_COUNTS = {(0, 3): 150, (1, 4): 120, (0, 5): 110, (2, 3): 40}  # by pair of images


@pytest.fixture
def database_and_cameras(tmp_path):
    """Return the folder of a database of six images and the true cameras.

    All pairs have 200 true matches except those of `FALSE_MATCH_COUNTS`.
    """
    rng = np.random.default_rng(3)
    cameras = corner.cameras(6, K)
    points = rng.uniform(0.1, 1.5, (200, 3))
    database = pycolmap.Database.open(tmp_path / DATABASE)
    lens = pycolmap.Camera(model="PINHOLE", width=480, height=360, params=[K.fx, K.fy, K.cx, K.cy])
    lens_id = database.write_camera(lens)
    image_ids = []
    for camera in cameras:
        image_ids.append(database.write_image(pycolmap.Image(name=camera.name, camera_id=lens_id)))
        database.write_keypoints(image_ids[-1], camera.project(points)[0].astype(np.float32))
    for a in range(6):
        for b in range(a + 1, 6):
            count = FALSE_MATCH_COUNTS.get((a, b))
            indices = np.arange(200)
            matches = np.stack(
                [indices, indices] if count is None else [indices[:count], rng.permutation(200)[:count]], axis=1
            )
            geometry = pycolmap.TwoViewGeometry()
            geometry.config = pycolmap.TwoViewGeometryConfiguration.CALIBRATED
            geometry.inlier_matches = matches.astype(np.uint32)
            database.write_matches(image_ids[a], image_ids[b], matches.astype(np.uint32))
            database.write_two_view_geometry(image_ids[a], image_ids[b], geometry)
    database.close()
    (tmp_path / "stage.json").write_text("{}")
    return tmp_path, {camera.name: camera for camera in cameras}


def test_pairs_that_contradict_the_cameras_are_counted(database_and_cameras, tmp_path):
    folder, cameras = database_and_cameras
    agreement = check_cameras(folder / DATABASE, cameras)
    assert len(agreement.pairs) == 15
    false_pairs = {(f"{a:03}.png", f"{b:03}.png") for a, b in FALSE_MATCH_COUNTS}
    assert {(pair.a, pair.b) for pair in agreement.pairs if not pair.agrees} == false_pairs
    assert all(pair.share == 1 for pair in agreement.pairs if (pair.a, pair.b) not in false_pairs)
    assert agreement.share_of_pairs == pytest.approx(11 / 15)
    # Of 2,200 true and 420 false matches; some of the false ones lie on their epipolar lines by chance.
    assert 0.84 < agreement.share < 0.87
    assert "73% of the 15 pairs" in check_text(agreement.describe("given"))
    assert [pair.matches for pair in agreement.contradicting_pairs] == [150, 110, 120]  # 40 matches are too few
    assert not agreement.is_sound
    (note,) = ambiguity_warning(agreement, "solved")
    for value in ("3 of 14 pairs", "000.png with 003.png (150), 005.png (110); 001.png with 004.png (120)"):
        assert value in note
    assert "6 (000.png to 005.png)" in check_text(note)
    write_pairs(tmp_path / "pairs.csv", agreement)
    lines = (tmp_path / "pairs.csv").read_text().splitlines()
    assert lines[0] == "image_a,image_b,matches,share_that_agrees"
    assert lines[1] == '"000.png","001.png",200,1.000'
    assert len(lines) == 16


def test_images_without_a_camera_are_left_out_and_few_wrong_pairs_tolerated(database_and_cameras):
    folder, cameras = database_and_cameras
    agreement = epipolar_agreement(
        folder / DATABASE, {name: camera for name, camera in cameras.items() if name != "000.png"}
    )
    assert len(agreement.pairs) == 10
    assert len(agreement.contradicting_pairs) == 1
    assert agreement.is_sound
    assert not ambiguity_warning(agreement, "solved")
    reversed_cameras = dict(zip(cameras, reversed(cameras.values()), strict=True))
    with check_error(ReconstructionError):
        check_cameras(folder / DATABASE, reversed_cameras)


def test_pairs_are_dropped_from_a_copy(database_and_cameras, tmp_path):
    folder, cameras = database_and_cameras
    agreement = epipolar_agreement(folder / DATABASE, cameras)
    reduced_folder = remove_pairs(folder, tmp_path, "kept", dropped=[("003.png", "000.png")], min_matches=100)
    remaining_pairs = {(pair.a, pair.b) for pair in epipolar_agreement(reduced_folder / DATABASE, cameras).pairs}
    dropped_pairs = {("000.png", "003.png"), ("002.png", "003.png")}
    assert remaining_pairs == {(pair.a, pair.b) for pair in agreement.pairs} - dropped_pairs
    assert len(epipolar_agreement(folder / DATABASE, cameras).pairs) == 15


def test_connected_groups_are_described_by_size():
    pairs = [
        VerifiedPair("a", "b", 200, 1.0),
        VerifiedPair("c", "d", 200, 1.0),
        VerifiedPair("d", "e", 200, 1.0),
        VerifiedPair("a", "c", 200, 0.1),
    ]
    assert "3 (c to e), 2 (a to b)" in check_text(Agreement(tuple(pairs)).describe_graph())


def make_solution(images, contradicting_pairs):
    pairs = tuple(VerifiedPair("a", f"{n}", 150, 0.0 if n < contradicting_pairs else 1.0) for n in range(20))
    return SolvedModel(
        f"{images}, {contradicting_pairs}", None, dict.fromkeys(map(str, range(images))), Agreement(pairs), []
    )


@pytest.mark.parametrize(
    "counts, selected",
    [
        ([(30, 0), (30, 0)], 0),  # the requested solution
        ([(25, 0), (30, 0)], 0),
        ([(12, 0), (30, 0)], 1),  # but not of less than half of the images
        ([(30, 9), (26, 0), (28, 0)], 2),
        ([(30, 9), (30, 5), (10, 0)], 1),
        ([(30, 2), (30, 0)], 0),  # a few are tolerated
    ],
)
def test_the_solution_with_the_fewest_contradicting_pairs_is_selected(counts, selected):
    solutions = [make_solution(*pair) for pair in counts]
    assert best_solution(solutions) is solutions[selected]


def cameras_on_circle(seed, noise):
    """Return twelve cameras on a circle of radius 5 about the origin, with position noise."""
    rng = np.random.default_rng(seed)
    cameras = {}
    for name, angle in zip("abcdefghijkl", np.linspace(0, 2 * np.pi, 12, endpoint=False), strict=True):
        eye = [5 * np.cos(angle), 5 * np.sin(angle), 0.5 * np.sin(3 * angle)] + rng.normal(0, noise, 3)
        cameras[name] = replace(corner.cameras(1, K)[0], name=name, cam_from_world=look_at(eye, [0, 0, 0]))
    return cameras


def model_with_common_points(cameras):
    """Build a solved model in which all cameras observe the same points about the origin."""
    track = [SimpleNamespace(has_point3D=lambda: True, point3D_id=number) for number in range(20)]
    points = np.random.default_rng(4).uniform(-1, 1, (20, 3))
    return SimpleNamespace(
        find_image_with_name=lambda name: SimpleNamespace(points2D=track),
        points3D={number: SimpleNamespace(xyz=point) for number, point in enumerate(points)},
    )


def test_significantly_different_cameras_are_named():
    reference_cameras = cameras_on_circle(0, 0.0)
    rotation = look_at([1, 2, 3], [0, 0, 0]).rotation
    frame = Similarity(rotation, np.array([10.0, 20.0, 30.0]), 2.5)

    def solution_in_other_frame(cameras):
        return SolvedModel(
            "global mapping", None, {n: transform_camera(c, frame) for n, c in cameras.items()}, Agreement(()), []
        )

    reference = SolvedModel(
        "incremental mapping", model_with_common_points(reference_cameras), reference_cameras, Agreement(()), []
    )
    noisy_cameras = cameras_on_circle(1, 0.002)  # a pixel at 5 is 0.0116
    assert describe_differences(reference, solution_in_other_frame(noisy_cameras)) == []
    pose = noisy_cameras["c"].cam_from_world
    noisy_cameras["c"] = replace(
        noisy_cameras["c"], cam_from_world=Similarity(pose.rotation, pose.translation + [0.1, 0, 0])
    )
    (note,) = describe_differences(reference, solution_in_other_frame(noisy_cameras))
    match = re.search(r" c ([0-9.]+) .* 0\.00", check_text(note))
    assert float(match[1]) == pytest.approx(0.1, abs=0.01)
    (note,) = describe_differences(reference, solution_in_other_frame(cameras_on_circle(2, 0.3)))
    check_text(note)
    assert (
        describe_differences(
            reference, solution_in_other_frame({"a": reference_cameras["a"], "b": reference_cameras["b"]})
        )
        == []
    )
