"""Cameras from all formats, round trips, conversions by the formats' authors, and damaged files."""

import json
import struct
from dataclasses import replace

import numpy as np
import pytest
from data_folder import data_folder
from optional import import_or_skip
from PIL import Image
from scene_folders import NAMES, K, orbit
from wording import check_error, check_text

from pcbench import Cloud
from pcbench.errors import InputError
from pcbench.geometry.cameras import Intrinsics, look_at, nearest_rotation
from pcbench.geometry.geodesy import Gps, enu_axes
from pcbench.geometry.transform import Similarity
from pcbench.io.colmap_model import read_colmap_cameras, write_colmap_model
from pcbench.io.earth_studio import EARTH_RADIUS, read_earth_studio, wgs84_from_sphere
from pcbench.io.strecha import read_strecha
from pcbench.io.transforms_json import read_transforms, write_transforms
from pcbench.scenes import read_scene, write_cameras


def check_cameras(cameras, expected, atol=1e-12):
    # Quaternions and inverses differ by rounding.
    assert [c.name for c in cameras] == [c.name for c in expected]
    for a, b in zip(cameras, expected, strict=True):
        np.testing.assert_allclose(a.cam_from_world.matrix, b.cam_from_world.matrix, atol=atol)
        np.testing.assert_allclose(a.intrinsics.matrix, b.intrinsics.matrix, rtol=1e-12)
        assert a.intrinsics.distortion == pytest.approx(b.intrinsics.distortion)


def scene_cameras(scene):
    return [scene.cameras[name] for name in scene.images]


@pytest.mark.parametrize("intrinsics", [K, Intrinsics(64, 48, 50, 50, 32, 24)])
def test_colmap_text_round_trip(photographs, intrinsics):
    cameras = orbit(NAMES, intrinsics)
    write_colmap_model(photographs / "sparse/0", cameras, Cloud([[1.0, 2.0, 3.0]], colors=[[1, 2, 3]]))
    scene = read_scene(photographs)
    check_cameras(scene_cameras(scene), cameras)
    np.testing.assert_array_equal(scene.points.points, [[1, 2, 3]])
    np.testing.assert_array_equal(scene.points.colors, [[1, 2, 3]])


def test_colmap_agrees_with_pycolmap(photographs, tmp_path):
    pycolmap = import_or_skip("pycolmap")
    cameras = orbit(NAMES)
    write_colmap_model(tmp_path / "text", cameras)
    (tmp_path / "binary").mkdir()
    model = pycolmap.Reconstruction(str(tmp_path / "text"))
    by_name = {image.name: image for image in model.images.values()}
    for camera in cameras:
        image = by_name[camera.name]
        np.testing.assert_allclose(image.cam_from_world().matrix(), camera.cam_from_world.matrix[:3], atol=1e-12)
        assert list(model.cameras[image.camera_id].params) == [50, 51, 31, 25, 0.01, -0.02, 0.001, 0.002]
        # The same point has the same pixel, including distortion.
        point = np.array([0.3, -0.2, 0.4])
        expected = model.cameras[image.camera_id].img_from_cam(image.cam_from_world() * point)
        np.testing.assert_allclose(camera.project(point[None])[0][0], expected, atol=1e-9)
    model.write_binary(str(tmp_path / "binary"))
    check_cameras(read_colmap_cameras(tmp_path / "binary"), cameras)


LENSES = {
    "SIMPLE_PINHOLE": (50, 31, 25),
    "SIMPLE_RADIAL": (50, 31, 25, 0.1),
    "RADIAL": (50, 31, 25, 0.1, 0.2),
    "OPENCV": (50, 51, 31, 25, 0.1, 0.02, 0.003, -0.004),
    "FULL_OPENCV": (50, 51, 31, 25, 0.1, 0.02, 0.003, -0.004, 0.01, 0.05, 0.02, -0.01),
    "SIMPLE_FISHEYE": (40, 31, 25),
    "FISHEYE": (40, 41, 31, 25),
    "SIMPLE_RADIAL_FISHEYE": (40, 31, 25, 0.02),
    "RADIAL_FISHEYE": (40, 31, 25, 0.02, -0.01),
    "OPENCV_FISHEYE": (40, 41, 31, 25, 0.02, -0.01, 0.003, -0.0004),
}


@pytest.mark.parametrize("model", LENSES)
def test_lenses_of_colmap(photographs, tmp_path, model):
    """A pixel has the ray that pycolmap gives, and the ray the pixel; both formats keep the lens."""
    pycolmap = import_or_skip("pycolmap")
    params = LENSES[model]
    write_colmap_model(tmp_path, orbit(["3.png"]))
    (tmp_path / "cameras.txt").write_text(f"1 {model} 64 48 {' '.join(map(str, params))}\n")
    (camera,) = read_colmap_cameras(tmp_path)
    pixels = np.random.default_rng(0).uniform((0, 0), (64, 48), (50, 2))
    theirs = pycolmap.Camera(model=model, width=64, height=48, params=params)
    rays = camera.intrinsics.directions(pixels)
    np.testing.assert_allclose(camera.intrinsics.distort(rays[:, :2]), pixels, atol=1e-9)
    for ray, pixel in zip(rays, pixels, strict=True):
        np.testing.assert_allclose(theirs.img_from_cam(ray), pixel, atol=1e-9)
    write_colmap_model(tmp_path / "again", [camera])
    assert read_colmap_cameras(tmp_path / "again")[0].intrinsics == camera.intrinsics
    if model == "FULL_OPENCV":
        with check_error():
            write_transforms(photographs / "transforms.json", [camera])
        k = replace(camera.intrinsics, distortion=(*camera.intrinsics.distortion[:5], 0.0, 0.0, 0.0))
        camera = replace(camera, intrinsics=k)
    write_transforms(photographs / "transforms.json", [camera])
    scene = read_scene(photographs, cameras=str(photographs / "transforms.json"), on_warning=lambda _: None)
    assert scene.cameras["3.png"].intrinsics == camera.intrinsics


def test_transforms_round_trip(photographs):
    cameras = orbit(NAMES)
    write_transforms(photographs / "transforms.json", cameras)
    check_cameras(scene_cameras(read_scene(photographs)), cameras)
    mixed_cameras = [*cameras[:5], *orbit(NAMES, Intrinsics(64, 48, 40, 40, 32, 24))[5:]]
    write_transforms(photographs / "transforms.json", mixed_cameras)
    check_cameras(scene_cameras(read_scene(photographs)), mixed_cameras)


def test_transforms_with_a_field_of_view_and_names_without_extension(photographs):
    """As in the synthetic scenes of NeRF: camera_angle_x, no image size, file names without .png."""
    matrix = np.eye(4)
    matrix[:3, 3] = [1, 2, 3]
    document = {
        "camera_angle_x": np.pi / 2,
        "frames": [{"file_path": "./images/3", "transform_matrix": matrix.tolist()}],
    }
    (photographs / "transforms.json").write_text(json.dumps(document))
    warnings = []
    scene = read_scene(photographs, on_warning=warnings.append)
    camera = scene.cameras["3.png"]
    k = camera.intrinsics
    assert (k.width, k.height, k.fx, k.fy, k.cx, k.cy) == pytest.approx((64, 48, 32, 32, 32, 24))
    np.testing.assert_allclose(camera.position, [1, 2, 3])
    np.testing.assert_allclose(camera.direction, [0, 0, -1], atol=1e-15)  # OpenGL's identity looks along -z
    check_text(warnings[0])


def test_frames_without_a_size_and_image_are_left_out_with_a_warning(photographs):
    def write(*names):
        frames = [{"file_path": name, "transform_matrix": np.eye(4).tolist()} for name in names]
        (photographs / "transforms.json").write_text(json.dumps({"camera_angle_x": 1, "frames": frames}))

    write("images/3.png", "images/30.png", "images/31.png")
    notes = []
    assert list(read_scene(photographs, on_warning=notes.append).cameras) == ["3.png"]
    check_text("\n".join(notes))
    for names in (["images/30.png"], []):
        write(*names)
        with check_error():
            read_scene(photographs)


def test_transforms_apply_the_pose(tmp_path):
    """The expected pixel is computed from the axes of the format: x right, y up, z backwards."""
    document = {
        "w": 64,
        "h": 48,
        "fl_x": 50,
        "fl_y": 50,
        "frames": [{"file_path": "a", "transform_matrix": np.eye(4).tolist()}],
    }
    (tmp_path / "transforms.json").write_text(json.dumps(document))
    (camera,) = read_transforms(tmp_path / "transforms.json", lambda _: None)
    pixels, depths = camera.project(np.array([[0.2, 0.4, -2.0]]))
    np.testing.assert_allclose(pixels, [[32 + 50 * 0.1, 24 - 50 * 0.2]])
    np.testing.assert_allclose(depths, [2.0])
    assert isinstance(camera.cam_from_world, Similarity)


def test_write_cameras(photographs, tmp_path):
    cameras = orbit(NAMES)
    write_colmap_model(photographs / "sparse", cameras)
    scene = read_scene(photographs)
    write_cameras(photographs / "transforms.json", scene.cameras, scene.folder)
    check_cameras(scene_cameras(read_scene(photographs, cameras=photographs / "transforms.json")), cameras)
    write_cameras(tmp_path / "model", scene.cameras, scene.folder)
    check_cameras(read_colmap_cameras(tmp_path / "model"), cameras)


def test_strecha_poses_are_camera_to_world(tmp_path):
    pose = look_at([1, 2, 3], [0, 0, 0])
    rows = [[50, 0, 32], [0, 51, 24], [0, 0, 1], [0, 0, 0], *pose.rotation.T.tolist(), [1, 2, 3], [64, 48]]
    path = tmp_path / "a.jpg.camera"
    path.write_text("\n".join(" ".join(f"{v:.6g}" for v in row) for row in rows))
    camera = read_strecha(path)
    assert camera.name == "a.jpg"
    assert camera.intrinsics == Intrinsics(64, 48, 50, 51, 32, 24)
    # The file has six digits.
    np.testing.assert_allclose(camera.cam_from_world.matrix, pose.matrix, atol=2e-5)


def test_hidden_files_of_other_systems_are_not_cameras(photographs):
    for name in NAMES:
        rows = [50, 0, 32, 0, 50, 24, 0, 0, 1, 0, 0, 0, 1, 0, 0, 0, 1, 0, 0, 0, 1, 1, 2, 3, 64, 48]
        (photographs / f"{name}.camera").write_text(" ".join(map(str, rows)))
        for hidden in (
            f"._{name}.camera",
            f"images/._{name}",
            "._scene.mvs",
            "._export.json",
            ".DS_Store",
            "Thumbs.db",
        ):
            (photographs / hidden).write_bytes(b"\0\5\x16\7")
    notes = []
    assert len(read_scene(photographs, on_warning=notes.append).cameras) == len(NAMES)
    assert not notes


def test_earth_studio_agrees_with_its_authors_conversion():
    folder = data_folder("ges")
    cameras, origin = read_earth_studio(folder / "fiumicino5_ges_export.json")
    frames = json.loads((folder / "fiumicino_enu_animation.json").read_text())["Frames"]
    assert len(cameras) == len(frames) == 97
    assert (origin.latitude_deg, origin.longitude_deg) == (
        pytest.approx(41.8033, abs=1e-3),
        pytest.approx(12.2469, abs=1e-3),
    )
    for camera, frame in zip(cameras, frames, strict=True):
        # The author's axes: x east, y up, z south. The earth's radius of 6.4e6 m limits the precision to about 1e-9 m.
        east, up, south = (frame["position"][axis] for axis in "xyz")
        np.testing.assert_allclose(camera.position, [east, -south, up], atol=1e-8)
        # Pan increases from north to west; a tilt of 90 degrees is level; there is no roll.
        pan = np.radians(frame["rotation"]["pan"])
        np.testing.assert_allclose(camera.direction, [-np.sin(pan), np.cos(pan), 0], atol=2e-4)
        np.testing.assert_allclose(camera.cam_from_world.rotation[1], [0, 0, -1], atol=2e-4)  # image down is down
    # The author's focal length and height of the sensor, in millimetres.
    focal = frames[0]["focale"] / frames[0]["sensore"]["vertical"]
    assert cameras[0].intrinsics.fy == pytest.approx(1080 * focal, rel=1e-9)


def point_on_sphere(latitude, longitude, altitude):
    a, b = np.radians(latitude), np.radians(longitude)
    return (EARTH_RADIUS + altitude) * np.array([np.cos(a) * np.cos(b), np.cos(a) * np.sin(b), np.sin(a)])


def earth_studio_export(rotation, origin, coordinates, *, local):
    """Return an export with one track point as its origin; `rotation` maps its local axes to those of the earth."""
    frames = []
    for latitude, longitude, altitude in coordinates:
        from_centre = point_on_sphere(latitude, longitude, altitude)
        position = rotation.T @ (from_centre - point_on_sphere(*origin)) if local else from_centre
        # The camera looks at the earth's centre; its angles are those of Rx Ry Rz in these axes.
        forward = -from_centre / np.linalg.norm(from_centre)
        right = np.cross(forward, [0, 0, 1.0])
        right /= np.linalg.norm(right)
        axes = np.stack([right, np.cross(forward, right), forward], axis=1)
        axes = rotation.T @ axes if local else axes
        angles = np.degrees(
            [np.arctan2(-axes[1, 2], axes[2, 2]), np.arcsin(axes[0, 2]), np.arctan2(-axes[0, 1], axes[0, 0])]
        )
        frames.append(
            {
                "position": dict(zip("xyz", position, strict=True)),
                "rotation": dict(zip("xyz", angles, strict=True)),
                "coordinate": {"latitude": latitude, "longitude": longitude, "altitude": altitude},
                "fovVertical": 40,
            }
        )
    sliders = []
    for name, value, bound in zip(("latitude", "longitude", "altitude"), origin, (90, 180, 1e4), strict=True):
        relative = (value + bound) / (2 * bound)
        sliders.append({"type": name, "value": {"minValueRange": -bound, "maxValueRange": bound, "relative": relative}})
    origin_position = np.zeros(3) if local else point_on_sphere(*origin)
    point = {"position": dict(zip("xyz", origin_position, strict=True)), "coordinate": {"isOrigin": True}}
    point["coordinate"]["position"] = {"attributes": sliders}
    return {"width": 64, "height": 48, "numFrames": 10, "cameraFrames": frames, "trackPoints": [point]}


COORDINATES = [(48 + 0.01 * np.cos(a), 11 + 0.01 * np.sin(a), 500 + 40 * a) for a in np.linspace(0, 3, 11)]


@pytest.mark.parametrize("is_rotated", [False, True])
def test_earth_studio_local_and_global_positions_agree(tmp_path, is_rotated):
    rotation = look_at([1, 2, 3], [0, 0, 0]).rotation if is_rotated else np.eye(3)
    results = []
    for local in (False, True):
        path = tmp_path / f"{local}.json"
        path.write_text(json.dumps(earth_studio_export(rotation, (48.0, 11.0, 100.0), COORDINATES, local=local)))
        results.append(read_earth_studio(path))
    (cameras, origin), (local_cameras, local_origin) = results
    assert tuple(local_origin) == pytest.approx(tuple(origin), abs=1e-8)
    # Positions on a sphere of 6.4e6 m leave a precision of about 1e-6 m for the fit of the axes.
    check_cameras(local_cameras, cameras, atol=1e-5)
    np.testing.assert_allclose(cameras[0].position[2], 400, atol=1)  # 500 m above sea level, with the origin at 100 m
    assert cameras[0].direction[2] < -0.999


def wgs84_to_enu(coordinates, origin):
    """Convert rows of latitude, longitude and altitude to east, north and up with PROJ."""
    pyproj = import_or_skip("pyproj")
    cartesian = pyproj.Transformer.from_crs(4979, 4978)
    pipeline = f"+proj=topocentric +ellps=WGS84 +lat_0={origin[0]} +lon_0={origin[1]} +h_0={origin[2]}"
    local = pyproj.Transformer.from_pipeline(pipeline)
    return np.stack(local.transform(*cartesian.transform(*np.array(coordinates).T)), axis=1)


def test_earth_studio_in_wgs84_metres(tmp_path):
    source = data_folder("ges") / "fiumicino5_ges_export.json"
    document = json.loads(source.read_text())
    names = [f"{number:03}.png" for number in range(97)]
    for name in names:
        Image.new("RGB", (192, 108)).save(tmp_path / name)
    (tmp_path / "export.json").write_text(json.dumps(document | {"width": 192, "height": 108}))
    notes = []
    scene = read_scene(tmp_path, on_warning=notes.append)
    check_text(notes[0])
    assert "-0.26 %" in notes[0]
    assert "+0.11 %" in notes[0]
    wgs84_scene = scene.in_wgs84()
    check_text("\n".join(wgs84_scene.describe()))
    coordinates = [
        [f["coordinate"][k] for k in ("latitude", "longitude", "altitude")] for f in document["cameraFrames"]
    ]
    positions = np.stack([wgs84_scene.cameras[name].position for name in names])
    np.testing.assert_allclose(positions, wgs84_to_enu(coordinates, scene.origin), atol=1e-6)
    # The author's conversion is on the sphere, like the images; it differs by the reported percentages.
    frames = json.loads((data_folder("ges") / "fiumicino_enu_animation.json").read_text())["Frames"]
    author_positions = np.array([[frame["position"]["x"], -frame["position"]["z"]] for frame in frames])
    for axis, percent in ((0, -0.26), (1, 0.11)):
        ratio = np.ptp(author_positions[:, axis]) / np.ptp(positions[:, axis])
        assert 100 * (ratio - 1) == pytest.approx(percent, abs=0.01)
    for name in names:  # directions are the same: east is east on either
        rotations = (cameras[name].cam_from_world.rotation for cameras in (wgs84_scene.cameras, scene.cameras))
        np.testing.assert_array_equal(*rotations)
    with check_error():
        wgs84_scene.in_wgs84()


def test_points_on_the_sphere_keep_their_geographic_position():
    origin = Gps(-33.9, 151.2, 20.0)
    coordinates = np.array(origin) + np.random.default_rng(1).uniform(-1, 1, (200, 3)) * [0.01, 0.01, 300]
    axes = enu_axes(origin)
    points = (np.stack([point_on_sphere(*row) for row in coordinates]) - point_on_sphere(*origin)) @ axes.T
    np.testing.assert_allclose(wgs84_from_sphere(points, origin), wgs84_to_enu(coordinates, origin), atol=1e-6)


def test_earth_studio_frames_match_images(photographs):
    (photographs / "export.json").write_text(
        json.dumps(earth_studio_export(np.eye(3), (48, 11, 0), COORDINATES, local=False))
    )
    cameras = read_earth_studio(photographs / "export.json").cameras
    notes = []
    scene = read_scene(photographs, on_warning=notes.append)  # eleven frames, ten images
    check_text(notes[0])
    np.testing.assert_array_equal(scene.cameras["7.png"].position, cameras[7].position)
    assert scene.origin.latitude_deg == pytest.approx(48)
    for name in ("0.png", "1.png", "4.png"):
        (photographs / "images" / name).unlink()
    scene = read_scene(photographs, on_warning=notes.append)  # now by number
    np.testing.assert_array_equal(scene.cameras["7.png"].position, cameras[7].position)


def test_deeply_nested_json_gives_a_one_line_error(photographs):
    nested_json = photographs / "deep.json"
    nested_json.write_text("[" * 100_000)
    for read in (read_earth_studio, lambda path: read_transforms(path, lambda _: None)):
        with check_error():
            read(nested_json)
    assert not read_scene(photographs).cameras  # an unrelated file next to the images


def test_matrices_that_are_not_rotations_are_refused():
    rotation = look_at([1, 2, 3], [0, 0, 0]).rotation
    result = nearest_rotation(np.round(rotation, 5))
    np.testing.assert_allclose(result @ result.T, np.eye(3), atol=1e-14)
    np.testing.assert_allclose(result, rotation, atol=2e-5)
    for matrix in (
        2 * rotation,
        np.diag([1.0, 1, -1]),  # no rounding, which would appear in the message
        rotation + np.eye(3)[::-1] * 0.01,
        np.full((3, 3), np.nan),
    ):
        with check_error():
            nearest_rotation(matrix)


def test_damaged_binary_models_give_a_one_line_error(tmp_path):
    pycolmap = import_or_skip("pycolmap")
    write_colmap_model(tmp_path / "text", orbit(NAMES))
    (tmp_path / "model").mkdir()
    pycolmap.Reconstruction(str(tmp_path / "text")).write_binary(str(tmp_path / "model"))
    for name in ("cameras.bin", "images.bin"):
        data = (tmp_path / "model" / name).read_bytes()
        for length in range(0, len(data), 37):
            (tmp_path / "model" / name).write_bytes(data[:length])
            with pytest.raises(InputError, match=name):  # many cases, so only the file name is checked
                read_colmap_cameras(tmp_path / "model")
        (tmp_path / "model" / name).write_bytes(data)
    for number in (10, 16, 99):
        (tmp_path / "model/cameras.bin").write_bytes(struct.pack("<QiiQQ12d", 1, 1, number, 64, 48, *range(1, 13)))
        with check_error():
            read_colmap_cameras(tmp_path / "model")
    with check_error():
        write_colmap_model(tmp_path / "model", orbit(NAMES))
