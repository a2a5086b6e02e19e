"""Sparse structure from motion: compared with exact truth, on real photographs, and failures."""

import re
import shutil
from dataclasses import replace

import courtyard
import numpy as np
import pytest
import textured_corner as corner
from data_folder import data_folder
from optional import import_or_skip
from PIL import Image
from wording import check_error, check_text

from pcbench.errors import InputError, ReconstructionError
from pcbench.geometry.cameras import Camera, look_at
from pcbench.geometry.geodesy import Gps, enu_from_wgs84
from pcbench.geometry.transform import fit_similarity
from pcbench.io.colmap_model import write_colmap_model
from pcbench.plugins import find_plugin
from pcbench.scenes import read_scene
from reconstructors.sfm import solve
from reconstructors.sfm.alignment import camera_errors
from reconstructors.sfm.features import DATABASE, count_features, extract_features
from reconstructors.sfm.mapping import largest_component, map_images
from reconstructors.sfm.matches import match_pairs, verify_matches
from reconstructors.sfm.pairs import choose_pairs
from reconstructors.sfm.sfm import ColmapSfm

import_or_skip("pycolmap")

K = corner.standard_intrinsics()
QUICK = {"upsample": False, "features": 2000}


@pytest.fixture(scope="module")
def photographs(tmp_path_factory):
    """Render seven images of the corner, 480 x 360 pixels, with their true cameras."""
    return corner.write_scene(tmp_path_factory.mktemp("corner"), corner.cameras(7, K))


@pytest.fixture(scope="module")
def workspace(tmp_path_factory):
    """Workspace shared by tests of the same photographs: features and matches are computed once."""
    return tmp_path_factory.mktemp("workspace")


def find_note(reconstruction, part):
    """Return the only note that contains a text."""
    (note,) = [note for note in reconstruction.notes if part in note]
    return check_text(note)


def test_points_triangulated_from_given_poses_are_accurate(photographs, workspace):
    scene = read_scene(photographs)
    reconstruction = ColmapSfm(**QUICK).reconstruct(scene, workspace)
    assert reconstruction.gauge == "georeferenced"
    assert "21 pairs" in find_note(reconstruction, "matching")
    assert len(reconstruction.cloud) > 500
    assert int(re.search(r"(\d+)% of the verified", " ".join(reconstruction.notes))[1]) > 95
    # SIFT is good to some tenths of a pixel; a pixel at 5 m is 12 mm.
    error = corner.distances(reconstruction.cloud.points)
    assert np.median(error) < 0.006
    assert np.quantile(error, 0.9) < 0.03
    positions, angles = camera_errors(reconstruction.cameras, scene.cameras)
    assert len(positions) == 7
    assert positions.max() < 1e-12
    assert angles.max() < 1e-6
    assert set(reconstruction.cloud.attributes) == {"reprojection_error", "track_length"}
    # A point has the colour of the surface.
    pixels, _ = scene.cameras["003.png"].project(reconstruction.cloud.points)
    inside = ((pixels > 5) & (pixels < [475, 355])).all(axis=1)
    x, y = pixels[inside].astype(int).T
    photograph_colors = scene.read_image("003.png")[y, x].astype(float)
    assert np.median(np.abs(photograph_colors - reconstruction.cloud.colors[inside])) < 10


@pytest.mark.parametrize("mapping", ["incremental", "global"])
def test_solved_poses_are_accurate(photographs, workspace, mapping):
    scene = read_scene(photographs)
    reconstruction = ColmapSfm(poses="solve", mapping=mapping, refine="none", **QUICK).reconstruct(scene, workspace)
    assert reconstruction.gauge == "georeferenced"
    positions, angles = camera_errors(reconstruction.cameras, scene.cameras)
    assert len(positions) == 7
    # Tenths of a pixel over the whole image: 1 mm at 5 m, 0.01 degrees; ten times that would be an error.
    assert positions.max() < 0.02
    assert angles.max() < 0.2
    assert f"{np.median(positions):.3g} (median)" in find_note(reconstruction, "position errors")
    assert np.median(corner.distances(reconstruction.cloud.points)) < 0.008


@pytest.mark.long
def test_the_gauge_is_arbitrary_without_cameras_or_positions(photographs, workspace):
    scene = read_scene(photographs, cameras="none")
    reconstruction = ColmapSfm(**QUICK).reconstruct(scene, workspace)
    assert reconstruction.gauge == "arbitrary"
    assert reconstruction.cloud.unit is None
    assert "look in the same direction" not in " ".join(reconstruction.notes)
    assert len(reconstruction.cameras) == 7
    # Origin, scale and azimuth are arbitrary; up is that of the corner, as its photographs are upright.
    truth = read_scene(photographs).cameras
    names = list(reconstruction.cameras)
    fit = fit_similarity(*(np.stack([c[name].position for name in names]) for c in (truth, reconstruction.cameras)))
    up = fit.rotation[:, 2]
    assert np.degrees(np.arctan2(np.linalg.norm(up[:2]), up[2])) < 1.0  # solved rolls are good to some tenths
    find_note(reconstruction, "levelled")
    with check_error():
        ColmapSfm(poses="given", **QUICK).reconstruct(scene, workspace)
    with check_error():
        ColmapSfm(align="gps", **QUICK).reconstruct(scene, workspace)


@pytest.mark.long
@pytest.mark.parametrize("settings", [{}, {"poses": "solve"}, {"poses": "solve", "mapping": "global"}])
def test_the_same_input_gives_the_same_cloud(photographs, workspace, tmp_path, settings):
    scene = read_scene(photographs)
    reconstructions = [ColmapSfm(**QUICK, **settings).reconstruct(scene, folder) for folder in (workspace, tmp_path)]
    np.testing.assert_array_equal(reconstructions[0].cloud.points, reconstructions[1].cloud.points)
    for name, camera in reconstructions[0].cameras.items():
        np.testing.assert_array_equal(
            camera.cam_from_world.matrix, reconstructions[1].cameras[name].cam_from_world.matrix
        )


def test_finished_stages_are_reused(photographs, workspace):
    scene = read_scene(photographs)
    first = ColmapSfm(**QUICK).reconstruct(scene, workspace)
    times = {stage: (workspace / stage / "stage.json").stat().st_mtime_ns for stage in ("features", "matches")}
    second = ColmapSfm(**QUICK).reconstruct(scene, workspace)
    np.testing.assert_array_equal(first.cloud.points, second.cloud.points)
    assert times == {stage: (workspace / stage / "stage.json").stat().st_mtime_ns for stage in times}


@pytest.mark.long
def test_gps_gives_a_metric_frame(photographs, workspace):
    truth = read_scene(photographs).cameras
    origin = Gps(48.0, 11.0, 500.0)
    # Scaled by 30, so that rounded degrees are precise enough; the corner's axes are east, north and up.
    metres = {"lat": 111_200.0, "lon": 111_320.0 * np.cos(np.radians(48))}
    gps = {}
    for name, camera in truth.items():
        east, north, up = 30 * camera.position
        gps[name] = Gps(48 + north / metres["lat"], 11 + east / metres["lon"], 500 + up)
    scene = replace(read_scene(photographs, cameras="none"), gps=gps)
    reconstruction = ColmapSfm(**QUICK).reconstruct(scene, workspace)
    assert (reconstruction.gauge, reconstruction.cloud.unit) == ("georeferenced", "m")
    assert "7 images" in find_note(reconstruction, "aligned to the GPS")
    # The frame is east-north-up about the first image's position.
    expected = enu_from_wgs84([gps[name] for name in truth], gps["000.png"])
    solved_positions = np.stack([reconstruction.cameras[name].position for name in truth])
    # The intrinsics are solved for: the tolerance is a hundredth of 150 m.
    np.testing.assert_allclose(solved_positions, expected, atol=1.5)
    corner_position = enu_from_wgs84([origin], gps["000.png"])[0]
    assert np.median(np.abs(reconstruction.cloud.points - corner_position).min(axis=1)) < 0.5


@pytest.mark.long
def test_given_positions_define_the_frame(photographs, workspace):
    truth = read_scene(photographs).cameras
    positions = {name: 10 * camera.position + [100, 200, 300] for name, camera in truth.items()}
    positions["002.png"] = positions["002.png"] + [30, 0, 0]  # one is wrong
    scene = replace(read_scene(photographs), positions=positions)
    reconstruction = ColmapSfm(poses="solve", align="gps", refine="none", **QUICK).reconstruct(scene, workspace)
    assert (reconstruction.gauge, reconstruction.cloud.unit) == ("georeferenced", "m")
    assert np.median(corner.distances((reconstruction.cloud.points - [100, 200, 300]) / 10)) < 0.02


def test_points_of_two_images_are_left_out(photographs, workspace):
    scene = read_scene(photographs)
    three_view_points, two_view_points = (ColmapSfm(min_views=n, **QUICK).reconstruct(scene, workspace) for n in (3, 2))
    assert three_view_points.cloud.attributes["track_length"].min() == 3
    assert two_view_points.cloud.attributes["track_length"].min() == 2
    left_out = len(two_view_points.cloud) - len(three_view_points.cloud)
    assert find_note(three_view_points, "points observed by fewer").startswith(f"{left_out} ")
    with check_error(ReconstructionError):
        ColmapSfm(min_views=8, **QUICK).reconstruct(scene, workspace)


def test_control_points_define_the_frame(photographs, workspace, tmp_path):
    truth = read_scene(photographs).cameras
    positions = {"A": [0, 0, 0.5], "B": [1, 0, 1], "C": [0, 1.5, 1], "D": [1, 1, 0], "check*": [1.2, 0, 0.4]}
    lines = []
    for name, point in positions.items():
        for image in ("001.png", "003.png", "005.png"):
            (pixel,), _ = truth[image].project(np.array([point], dtype=float))
            assert (pixel > 0).all()
            lines.append(f"{name} {' '.join(map(str, 10 * np.array(point)))} {image} {pixel[0]} {pixel[1]}")
    (tmp_path / "control.txt").write_text("\n".join(lines))
    scene = read_scene(photographs, cameras="none")
    reconstruction = ColmapSfm(control=tmp_path / "control.txt", **QUICK).reconstruct(scene, workspace)
    assert reconstruction.gauge == "georeferenced"
    assert " 4 " in find_note(reconstruction, "aligned to")
    residuals = reconstruction.residuals
    assert [point.name for point in residuals.control] == ["A", "B", "C", "D"]
    assert [point.name for point in residuals.check] == ["check"]
    assert residuals.rmse(residuals.control).total < 0.03  # a pixel is 0.12 in this frame
    assert residuals.rmse(residuals.check).total < 0.1
    assert residuals.rmse(residuals.check).vertical is None
    assert np.median(corner.distances(reconstruction.cloud.points)) < 0.1  # the frame is scaled by ten
    with check_error(ValueError):
        ColmapSfm(align="control")


def control_lines(cameras, positions, names=("001.png", "003.png", "005.png")):
    """Return lines of a control file: observations of positions in images."""
    for name, point in positions.items():
        for image in names:
            (pixel,), _ = cameras[image].project(np.array([point], dtype=float))
            yield f"{name} {' '.join(map(str, point))} {image} {pixel[0]} {pixel[1]}"


def test_check_points_alone_score_given_cameras(photographs, workspace, tmp_path):
    """Surveyed positions with a known error: the residuals equal it."""
    cameras = read_scene(photographs).cameras
    lines = [*control_lines(cameras, {"p*": [0, 0, 0.5], "q*": [1, 0, 1]})]
    lines = [re.sub(r"^(.\*) (\S+) (\S+) (\S+)", _shift_by(-0.03, -0.04, 0.12), line) for line in lines]
    (tmp_path / "control.txt").write_text("\n".join(["# z is up", *lines]))
    reconstruction = ColmapSfm(control=tmp_path / "control.txt", **QUICK).reconstruct(
        read_scene(photographs), workspace
    )
    # Rays through exact pixels meet in their point up to rounding.
    assert reconstruction.residuals.rmse(reconstruction.residuals.check) == pytest.approx(
        (2, 0.13, 0.05, 0.12), abs=1e-9
    )
    assert reconstruction.residuals.control == ()
    lines = [*control_lines(cameras, {"p": [0, 0, 0.5]})]
    (tmp_path / "control.txt").write_text("\n".join(lines))
    with check_error():
        ColmapSfm(control=tmp_path / "control.txt", **QUICK).reconstruct(read_scene(photographs), workspace)


def _shift_by(dx, dy, dz):
    def move(match):
        x, y, z = map(float, match.groups()[1:])
        return f"{match[1]} {x + dx!r} {y + dy!r} {z + dz!r}"

    return move


def test_marks_in_missing_images_are_reported(photographs, workspace, tmp_path):
    scene = read_scene(photographs)
    (tmp_path / "control.txt").write_text("p* 0 0 0 elsewhere.jpg 1 2\np* 0 0 0 nowhere.jpg 1 2\n")
    with check_error():
        ColmapSfm(control=tmp_path / "control.txt", **QUICK).reconstruct(scene, workspace)
    lines = [*control_lines(scene.cameras, {"p*": [0, 0, 0.5]}), "p* 0 0 0.5 elsewhere.jpg 1 2"]
    (tmp_path / "control.txt").write_text("\n".join(lines))
    reconstruction = ColmapSfm(control=tmp_path / "control.txt", **QUICK).reconstruct(scene, workspace)
    find_note(reconstruction, "elsewhere.jpg")
    assert reconstruction.residuals.check[0].error < 1e-9


def test_image_scale_masks_and_undistortion_are_applied(photographs, tmp_path):
    masks_folder = tmp_path / "masked"
    masks_folder.mkdir()
    mask = np.full((360, 480), 255, np.uint8)
    mask[:, :240] = 0
    for number in range(7):
        Image.fromarray(mask).save(masks_folder / f"{number:03}.png.png")
    scene = read_scene(photographs, masks=masks_folder, image_scale=0.75)
    settings = {**QUICK, "undistort": True}
    reconstruction = ColmapSfm(**settings).reconstruct(scene, tmp_path)
    assert reconstruction.cameras["000.png"].intrinsics.width == 360
    assert np.median(corner.distances(reconstruction.cloud.points)) < 0.01
    # Each point is in the unmasked right half of at least two images.
    right = [scene.cameras[name].project(reconstruction.cloud.points)[0][:, 0] > 180 for name in scene.images]
    assert np.sum(right, axis=0).min() >= 2
    with Image.open(tmp_path / "undistorted/images/000.png") as image:
        assert abs(image.width - 360) <= 2
    assert len(read_scene(tmp_path / "undistorted", cameras=tmp_path / "undistorted/sparse").cameras) == 7


def test_images_without_a_mask_keep_their_features(photographs, tmp_path):
    masks_folder = tmp_path / "masked"
    masks_folder.mkdir()
    Image.fromarray(np.zeros((360, 480), np.uint8)).save(masks_folder / "003.png.png")
    scene = read_scene(photographs, masks=masks_folder)
    counts = count_features(extract_features(scene, tmp_path, 500, upsample=False))
    assert [name for name in scene.images if not counts[name]] == ["003.png"]


def test_transparent_pixels_have_no_features(photographs, tmp_path):
    import pycolmap

    shutil.copytree(photographs, tmp_path / "scene")
    for path in (tmp_path / "scene/images").iterdir():
        alpha = np.full((360, 480), 255, np.uint8)
        alpha[:, :240] = 0
        Image.fromarray(np.dstack([np.asarray(Image.open(path).convert("RGB")), alpha])).save(path)
    scene = read_scene(tmp_path / "scene").select(["002.png", "003.png", "004.png"])
    features = extract_features(scene, tmp_path, 2000, upsample=False)
    assert min(count_features(features).values()) > 100
    database = pycolmap.Database.open(features / DATABASE)
    for image in database.read_all_images():
        assert database.read_keypoints(image.image_id)[:, 0].min() >= 240
    database.close()
    check_text(next(note for note in ColmapSfm(**QUICK).reconstruct(scene, tmp_path).notes if "alpha" in note))


def write_scene(folder, images):
    folder.mkdir()
    for name, pixels in images.items():
        Image.fromarray(pixels).save(folder / name)
    return read_scene(folder)


def check_failure(scene, workspace, error=ReconstructionError, **settings):
    workspace.mkdir(exist_ok=True)
    with check_error(error):
        ColmapSfm(**{**QUICK, **settings}).reconstruct(scene, workspace)


def test_failures_are_reported(tmp_path):
    blank = {f"{n}.png": np.full((240, 320, 3), 90 + n, np.uint8) for n in range(3)}
    check_failure(write_scene(tmp_path / "blank", blank), tmp_path / "a")
    noise = {f"{n}.png": (255 * corner.texture(n, 320)).astype(np.uint8) for n in range(3)}
    check_failure(write_scene(tmp_path / "noise", noise), tmp_path / "b")
    copies = dict.fromkeys(("0.png", "1.png", "2.png"), noise["0.png"])
    check_failure(write_scene(tmp_path / "copies", copies), tmp_path / "c")
    single_image = write_scene(tmp_path / "one", {"0.png": noise["0.png"]})
    check_failure(single_image, tmp_path / "d", InputError)


def test_image_names_may_have_spaces(photographs, tmp_path):
    """COLMAP splits its list of pairs at spaces."""
    names = ["one two.png", "1 2 3.png", "éä ü.png", "3.png"]
    cameras = corner.cameras(7, K)[1:5]
    (tmp_path / "work").mkdir()
    for name, camera in zip(names, cameras, strict=True):
        shutil.copyfile(photographs / "images" / camera.name, tmp_path / name)
    known_cameras = {name: replace(camera, name=name) for name, camera in zip(names, cameras, strict=True)}
    reconstruction = ColmapSfm(poses="solve", refine="none", **QUICK).reconstruct(
        replace(read_scene(tmp_path), cameras=known_cameras), tmp_path / "work"
    )
    assert sorted(reconstruction.cameras) == sorted(names)
    positions, _ = camera_errors(reconstruction.cameras, known_cameras)
    assert positions.max() < 0.02


@pytest.mark.long
def test_other_intrinsics_reuse_features_and_matches(photographs, tmp_path):
    scene = read_scene(photographs)
    wrong_intrinsics = replace(K, distortion=(-0.2, 0.0, 0.0, 0.0))
    wrong_scene = replace(
        scene, cameras={name: replace(c, intrinsics=wrong_intrinsics) for name, c in scene.cameras.items()}
    )
    reference = ColmapSfm(poses="solve", refine="none", **QUICK).reconstruct(scene, tmp_path)
    times = {name: (tmp_path / name / "stage.json").stat().st_mtime_ns for name in ("features", "matches", "verified")}
    distorted = ColmapSfm(poses="solve", refine="none", **QUICK).reconstruct(wrong_scene, tmp_path)
    new_times = {name: (tmp_path / name / "stage.json").stat().st_mtime_ns for name in times}
    assert [name for name in times if times[name] == new_times[name]] == ["features", "matches"]
    assert distorted.cameras["003.png"].intrinsics == wrong_intrinsics
    errors = [np.median(corner.distances(reconstruction.cloud.points)) for reconstruction in (reference, distorted)]
    assert errors[1] > 3 * errors[0]


@pytest.mark.long
def test_wrong_poses_are_refused(photographs, tmp_path):
    scene = read_scene(photographs)
    names = list(scene.images)
    # Cameras in reverse order: each is a true one, but of another image.
    reversed_cameras = {
        name: replace(scene.cameras[other], name=name) for name, other in zip(names, reversed(names), strict=True)
    }
    check_failure(replace(scene, cameras=reversed_cameras), tmp_path)


@pytest.mark.long
def test_a_solution_contradicted_by_strong_pairs_is_not_aligned(photographs, tmp_path, monkeypatch):
    import pycolmap

    verify = pycolmap.geometric_verification

    def verify_wrongly(file, **options):
        """Simulate repeated structure: four pairs get matches of unrelated features."""
        verify(file, **options)
        database = pycolmap.Database.open(file)
        rng = np.random.default_rng(0)
        for a, b in ((1, 5), (2, 6), (3, 7), (1, 7)):
            geometry = database.read_two_view_geometry(a, b)
            counts = [database.num_keypoints_for_image(number) for number in (a, b)]
            geometry.inlier_matches = np.stack([rng.permutation(n)[:150] for n in counts], axis=1).astype(np.uint32)
            database.update_two_view_geometry(a, b, geometry)
        database.close()

    scene = read_scene(photographs)
    settings = {"poses": "solve", "refine": "none", **QUICK}
    first = ColmapSfm(**settings).reconstruct(scene, tmp_path)
    assert first.gauge == "georeferenced"
    assert not any(note.startswith("warning: ") for note in first.notes)
    monkeypatch.setattr(pycolmap, "geometric_verification", verify_wrongly)
    shutil.rmtree(tmp_path / "verified")
    reconstruction = ColmapSfm(**settings).reconstruct(scene, tmp_path)
    assert (reconstruction.gauge, reconstruction.cloud.unit) == ("arbitrary", None)
    (note,) = [note for note in reconstruction.notes if note.startswith("warning: ")]
    assert note.startswith("warning: 4 of ")
    find_note(reconstruction, "not aligned")
    assert "000.png" in (tmp_path / "pairs.csv").read_text()
    with check_error(ReconstructionError):
        ColmapSfm(align="cameras", **settings).reconstruct(scene, tmp_path)
    # Given cameras keep their frame; a note reports that pairs contradict them.
    with_given_poses = ColmapSfm(**QUICK).reconstruct(scene, tmp_path)
    assert with_given_poses.gauge == "georeferenced"
    find_note(with_given_poses, "contradict the given cameras")


def test_a_solution_contradicted_by_known_cameras_is_not_aligned_to_them(photographs, workspace):
    scene = read_scene(photographs)
    order = np.random.default_rng(1).permutation(list(scene.images))
    shuffled_cameras = {
        name: replace(scene.cameras[other], name=name) for name, other in zip(scene.images, order, strict=True)
    }
    scene = replace(scene, cameras=shuffled_cameras)
    reconstruction = ColmapSfm(poses="solve", refine="none", **QUICK).reconstruct(scene, workspace)
    assert reconstruction.gauge == "arbitrary"
    find_note(reconstruction, "not aligned to cameras")
    with check_error(ReconstructionError):
        ColmapSfm(poses="solve", align="cameras", refine="none", **QUICK).reconstruct(scene, workspace)


@pytest.mark.long
def test_the_largest_component_is_kept(photographs, tmp_path):
    folder = tmp_path / "two"
    folder.mkdir()
    for number, camera in enumerate(corner.cameras(9, K)):
        if number != 5:
            seed = 0 if number < 5 else 50  # another corner
            Image.fromarray(corner.photograph(camera, seed)).save(folder / camera.name)
    (tmp_path / "work").mkdir()
    reconstruction = ColmapSfm(**QUICK).reconstruct(read_scene(folder), tmp_path / "work")
    assert sorted(reconstruction.cameras) == ["000.png", "001.png", "002.png", "003.png", "004.png"]
    assert "006.png, 007.png, 008.png" in find_note(reconstruction, "separate model")
    assert "3 of 8 images" in find_note(reconstruction, "not registered")


@pytest.mark.parametrize("failing", [["incremental"], ["incremental", "global"]])
def test_the_other_mapper_is_kept_if_the_requested_one_fails(photographs, workspace, monkeypatch, failing):
    def largest_or_none(mapped, scene):
        if mapped.name in failing:
            raise ReconstructionError("no image registers")
        return largest_component(mapped, scene)

    monkeypatch.setattr(solve, "largest_component", largest_or_none)
    sfm = ColmapSfm(poses="solve", refine="none", **QUICK)
    if "global" in failing:
        with pytest.raises(ReconstructionError, match="no image registers"):
            sfm.reconstruct(read_scene(photographs), workspace)
    else:
        reconstruction = sfm.reconstruct(read_scene(photographs), workspace)
        assert len(reconstruction.cameras) == 7
        find_note(reconstruction, "incremental mapping fails")


@pytest.mark.long
def test_a_walk_straight_ahead_is_solved(tmp_path):
    """COLMAP starts from no pair of which one image lies ahead of the other."""
    (tmp_path / "images").mkdir()
    for number in range(6):
        eye = np.array([-10 + 0.4 * number, 0.3 * np.sin(2 * number), 1.7])
        camera = Camera(f"{number}.png", courtyard.standard_intrinsics(), look_at(eye, eye + [20, 0, 0]))
        Image.fromarray(courtyard.photograph(camera, 0.6)).save(tmp_path / "images" / camera.name)
    scene = read_scene(tmp_path)
    features = extract_features(scene, tmp_path, 2000, upsample=False)
    pairs = choose_pairs(scene, "auto")[1]
    verified = verify_matches(match_pairs(features, pairs, tmp_path), scene, tmp_path, 0)
    model, _ = largest_component(map_images(verified, scene, tmp_path, "incremental", "all", 0), scene)
    assert model.num_reg_images() == 6


def test_other_components_of_the_same_images_are_not_counted(photographs, workspace, tmp_path):
    scene = read_scene(photographs)
    ColmapSfm(poses="solve", refine="none", **QUICK).reconstruct(scene, workspace)
    mapped = tmp_path / "mapped"
    for number in "01":
        shutil.copytree(workspace / "incremental" / "0", mapped / number)
    model, notes = largest_component(mapped, scene)
    assert (model.num_reg_images(), notes) == (7, [])


def test_images_without_cameras_are_left_out_and_reported(photographs, tmp_path):
    scene = read_scene(photographs)
    known_cameras = {name: camera for name, camera in scene.cameras.items() if name != "003.png"}
    reconstruction = ColmapSfm(**QUICK).reconstruct(replace(scene, cameras=known_cameras), tmp_path)
    assert "1 of 7 images" in find_note(reconstruction, "003.png")
    assert "003.png" not in reconstruction.cameras


def test_sfm_is_an_installed_plugin():
    plugin = find_plugin("sfm")
    assert plugin.origin.startswith("pcbench ")
    assert plugin.missing is None
    with check_error():
        plugin.configure({"features": "3"})


@pytest.mark.long
def test_fountain_small(tmp_path):
    """Images at a quarter of the size; the data set's cameras were measured by laser."""
    scene = read_scene(data_folder("fountain"), image_scale=0.25)
    reconstruction = ColmapSfm(poses="solve", refine="none").reconstruct(scene, tmp_path)
    positions, angles = camera_errors(reconstruction.cameras, scene.cameras)
    assert len(positions) == 11
    assert np.median(positions) < 0.02  # metres, at 8 m: a pixel is 20 mm
    assert angles.max() < 0.2


@pytest.mark.slow
def test_fountain(tmp_path):
    scene = read_scene(data_folder("fountain"))
    reconstruction = ColmapSfm(poses="solve").reconstruct(scene, tmp_path)
    positions, angles = camera_errors(reconstruction.cameras, scene.cameras)
    assert len(positions) == 11
    assert np.median(positions) < 0.005
    assert angles.max() < 0.1


@pytest.mark.slow
def test_fox(tmp_path):
    scene = read_scene(data_folder("fox"), on_warning=lambda _: None)
    with_given_poses = ColmapSfm().reconstruct(scene, tmp_path)
    assert with_given_poses.gauge == "georeferenced"
    assert len(with_given_poses.cameras) == 50
    assert len(with_given_poses.cloud) > 5000
    with_solved_poses = ColmapSfm(poses="solve").reconstruct(scene, tmp_path)
    positions, angles = camera_errors(with_solved_poses.cameras, scene.cameras)
    assert len(positions) == 50
    # The given poses came from COLMAP too, from more and larger images; the path is 7 units long.
    assert np.median(positions) < 0.02
    assert np.median(angles) < 0.2


@pytest.mark.slow
def test_brighton(tmp_path):
    scene = read_scene(data_folder("brighton"))
    reconstruction = ColmapSfm().reconstruct(scene, tmp_path)
    assert (reconstruction.gauge, reconstruction.cloud.unit) == ("georeferenced", "m")
    assert len(reconstruction.cameras) == 18
    expected = enu_from_wgs84([scene.gps[name] for name in scene.images], scene.gps[scene.images[0]])
    solved_positions = np.stack([reconstruction.cameras[name].position for name in scene.images])
    # Consumer GPS is accurate to metres; relative to the other images of a flight it is better.
    assert np.median(np.linalg.norm(solved_positions - expected, axis=1)) < 2
    # The drone looks down: it is above the points.
    assert np.median(reconstruction.cloud.points[:, 2]) < solved_positions[:, 2].min() - 20


def test_images_from_one_place_give_no_point(tmp_path):
    folder = tmp_path / "scene"
    (folder / "images").mkdir(parents=True)
    camera = corner.cameras(7, K)[3]
    photograph = corner.photograph(camera)
    cameras = []
    for k, left in enumerate((0, 40, 80)):  # crops of one photograph, with their cameras
        intrinsics = replace(K, width=400, cx=K.cx - left)
        cameras.append(replace(camera, name=f"{k}.png", intrinsics=intrinsics))
        Image.fromarray(photograph[:, left : left + 400]).save(folder / "images" / f"{k}.png")
    write_colmap_model(folder / "sparse", cameras)
    with check_error(ReconstructionError):
        ColmapSfm(**QUICK).reconstruct(read_scene(folder), tmp_path)
