"""Scenes: photographs and cameras from every format, and what is said when they do not go together."""

import json
import shutil
import struct

import numpy as np
import pytest
from data_folder import data_folder
from PIL import Image

from pcbench import Cloud
from pcbench.errors import InputError
from pcbench.geometry.cameras import Camera, Intrinsics, look_at, rotation_from
from pcbench.geometry.transform import Similarity
from pcbench.io.colmap_model import read_colmap_cameras, write_colmap_model
from pcbench.io.earth_studio import EARTH_RADIUS, read_earth_studio
from pcbench.io.image_header import read_image_header
from pcbench.io.strecha import read_strecha
from pcbench.io.transforms_json import read_transforms, write_transforms
from pcbench.scenes import read_scene, write_cameras

K = Intrinsics(64, 48, 50.0, 51.0, 31.0, 25.0, (0.01, -0.02, 0.001, 0.002))


def orbit(names, intrinsics=K):
    angles = 2 * np.pi * np.arange(len(names)) / len(names)
    return [
        Camera(name, intrinsics, look_at([5 * np.cos(a), 5 * np.sin(a), 2 + 0.1 * a], [0, 0, 0]))
        for name, a in zip(names, angles, strict=True)
    ]


def picture(path, size=(64, 48), value=0):
    path.parent.mkdir(parents=True, exist_ok=True)
    rng = np.random.default_rng(value)
    Image.fromarray(rng.integers(0, 255, (size[1], size[0], 3), dtype=np.uint8)).save(path)


@pytest.fixture
def photographs(tmp_path):
    """A folder with images/0.png to 9.png of 64 x 48 pixels."""
    for number in range(10):
        picture(tmp_path / "images" / f"{number}.png", value=number)
    return tmp_path


NAMES = [f"{number}.png" for number in range(10)]


def same(cameras, expected, atol=1e-12):
    # Quaternions and inverses round in the last digits.
    assert [c.name for c in cameras] == [c.name for c in expected]
    for a, b in zip(cameras, expected, strict=True):
        np.testing.assert_allclose(a.cam_from_world.matrix, b.cam_from_world.matrix, atol=atol)
        np.testing.assert_allclose(a.intrinsics.matrix, b.intrinsics.matrix, rtol=1e-12)
        assert a.intrinsics.distortion == pytest.approx(b.intrinsics.distortion)


def scene_cameras(scene):
    return [scene.cameras[name] for name in scene.images]


def test_images_alone(photographs):
    scene = read_scene(photographs)
    assert scene.images == tuple(NAMES)
    assert scene.sizes["3.png"] == (64, 48)
    assert not scene.cameras
    assert scene.read_image("3.png").shape == (48, 64, 3)


@pytest.mark.parametrize("intrinsics", [K, Intrinsics(64, 48, 50, 50, 32, 24)])
def test_colmap_text_round_trip(photographs, intrinsics):
    cameras = orbit(NAMES, intrinsics)
    write_colmap_model(photographs / "sparse/0", cameras, Cloud([[1.0, 2.0, 3.0]], colors=[[1, 2, 3]]))
    scene = read_scene(photographs)
    same(scene_cameras(scene), cameras)
    np.testing.assert_array_equal(scene.points.points, [[1, 2, 3]])
    np.testing.assert_array_equal(scene.points.colors, [[1, 2, 3]])


def test_colmap_agrees_with_pycolmap(photographs, tmp_path):
    pycolmap = pytest.importorskip("pycolmap")
    cameras = orbit(NAMES)
    write_colmap_model(tmp_path / "text", cameras)
    (tmp_path / "binary").mkdir()
    model = pycolmap.Reconstruction(str(tmp_path / "text"))
    by_name = {image.name: image for image in model.images.values()}
    for camera in cameras:
        image = by_name[camera.name]
        np.testing.assert_allclose(image.cam_from_world().matrix(), camera.cam_from_world.matrix[:3], atol=1e-12)
        assert list(model.cameras[image.camera_id].params) == [50, 51, 31, 25, 0.01, -0.02, 0.001, 0.002]
        # The same pixel of the same point, distortion and all.
        point = np.array([0.3, -0.2, 0.4])
        expected = model.cameras[image.camera_id].img_from_cam(image.cam_from_world() * point)
        np.testing.assert_allclose(camera.project(point[None])[0][0], expected, atol=1e-9)
    model.write_binary(str(tmp_path / "binary"))
    same(read_colmap_cameras(tmp_path / "binary"), cameras)


@pytest.mark.parametrize("model, params", [("SIMPLE_RADIAL", (50, 31, 25, 0.1)), ("RADIAL", (50, 31, 25, 0.1, 0.2))])
def test_colmap_lens_models(tmp_path, model, params):
    write_colmap_model(tmp_path, orbit(["a.png"]))
    (tmp_path / "cameras.txt").write_text(f"1 {model} 64 48 {' '.join(map(str, params))}\n")
    found = read_colmap_cameras(tmp_path)[0].intrinsics
    assert (found.fx, found.fy, found.cx, found.cy) == (50, 50, 31, 25)
    assert found.distortion == (*params[3:], *[0] * (7 - len(params)))


def test_transforms_round_trip(photographs):
    cameras = orbit(NAMES)
    write_transforms(photographs / "transforms.json", cameras)
    same(scene_cameras(read_scene(photographs)), cameras)
    mixed = [*cameras[:5], *orbit(NAMES, Intrinsics(64, 48, 40, 40, 32, 24))[5:]]
    write_transforms(photographs / "transforms.json", mixed)
    same(scene_cameras(read_scene(photographs)), mixed)


def test_transforms_with_an_angle_alone_and_no_endings(photographs):
    """The synthetic sets of NeRF: camera_angle_x, no size, names without .png."""
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
    assert "9 of 10 images have no camera" in warnings[0]


def test_write_cameras(photographs, tmp_path):
    cameras = orbit(NAMES)
    write_colmap_model(photographs / "sparse", cameras)
    scene = read_scene(photographs)
    write_cameras(photographs / "transforms.json", scene.cameras, scene.folder)
    same(scene_cameras(read_scene(photographs, cameras=photographs / "transforms.json")), cameras)
    write_cameras(tmp_path / "model", scene.cameras, scene.folder)
    same(read_colmap_cameras(tmp_path / "model"), cameras)


def test_strecha_is_camera_to_world(tmp_path):
    pose = look_at([1, 2, 3], [0, 0, 0])
    rows = [[50, 0, 32], [0, 51, 24], [0, 0, 1], [0, 0, 0], *pose.rotation.T.tolist(), [1, 2, 3], [64, 48]]
    path = tmp_path / "a.jpg.camera"
    path.write_text("\n".join(" ".join(f"{v:.6g}" for v in row) for row in rows))
    camera = read_strecha(path)
    assert camera.name == "a.jpg"
    assert camera.intrinsics == Intrinsics(64, 48, 50, 51, 32, 24)
    # Six digits were printed.
    np.testing.assert_allclose(camera.cam_from_world.matrix, pose.matrix, atol=2e-5)


def test_fountain_fox_and_brighton():
    fountain = read_scene(data_folder("fountain"))
    assert len(fountain.cameras) == 11
    k = fountain.cameras["0000.jpg"].intrinsics
    assert (k.width, k.height, k.fx, k.cx) == (1536, 1024, 2759.48 / 2, 1520.69 / 2)  # K is for twice the size
    np.testing.assert_allclose(fountain.cameras["0000.jpg"].position, [-7.28137, -7.57667, 0.204446])
    warnings = []
    fox = read_scene(data_folder("fox"), on_warning=warnings.append, image_scale=0.5)
    assert len(fox.cameras) == 50
    assert "17 of 67 cameras are left out" in warnings[0]
    assert fox.cameras["0001.jpg"].intrinsics.fx == 1375.52 / 4
    assert fox.read_image("0001.jpg").shape == (480, 270, 3)
    brighton = read_scene(data_folder("brighton"))
    assert len(brighton.gps) == 18
    # A second reader of the same EXIF block.
    for name, gps in brighton.gps.items():
        with Image.open(brighton.folder / name) as file:
            tags = file.getexif().get_ifd(0x8825)
        latitude, longitude = (sum(float(v) / 60**i for i, v in enumerate(tags[t])) for t in (2, 4))
        assert (tags[1], tags[3]) == ("N", "W")
        assert gps == pytest.approx((latitude, -longitude, float(tags[6])), abs=1e-12)


def test_earth_studio_against_its_authors_conversion():
    folder = data_folder("ges")
    cameras, origin = read_earth_studio(folder / "fiumicino5_ges_export.json")
    frames = json.loads((folder / "fiumicino_enu_animation.json").read_text())["Frames"]
    assert len(cameras) == len(frames) == 97
    assert (origin.latitude_deg, origin.longitude_deg) == (
        pytest.approx(41.8033, abs=1e-3),
        pytest.approx(12.2469, abs=1e-3),
    )
    for camera, frame in zip(cameras, frames, strict=True):
        # The author's axes: x east, y up, z south. A nanometre: the earth's radius has nine digits before that.
        east, up, south = (frame["position"][axis] for axis in "xyz")
        np.testing.assert_allclose(camera.position, [east, -south, up], atol=1e-8)
        # Pan counts from north to west, tilt 90 is level, there is no roll.
        pan = np.radians(frame["rotation"]["pan"])
        np.testing.assert_allclose(camera.direction, [-np.sin(pan), np.cos(pan), 0], atol=2e-4)
        np.testing.assert_allclose(camera.cam_from_world.rotation[1], [0, 0, -1], atol=2e-4)  # image down is down
    # The author's focal length and height of the sensor, in millimetres.
    lens = frames[0]["focale"] / frames[0]["sensore"]["vertical"]
    assert cameras[0].intrinsics.fy == pytest.approx(1080 * lens, rel=1e-9)


def sphere(latitude, longitude, altitude):
    a, b = np.radians(latitude), np.radians(longitude)
    return (EARTH_RADIUS + altitude) * np.array([np.cos(a) * np.cos(b), np.cos(a) * np.sin(b), np.sin(a)])


def earth_studio(turn, origin, coordinates, *, local):
    """An export with one track point as its origin, positions in axes that `turn` brings to the earth's."""
    frames = []
    for latitude, longitude, altitude in coordinates:
        centred = sphere(latitude, longitude, altitude)
        position = turn.T @ (centred - sphere(*origin)) if local else centred
        # Looking at the earth's centre, with Rx Ry Rz of the matrix in these axes.
        forward = -centred / np.linalg.norm(centred)
        right = np.cross(forward, [0, 0, 1.0])
        right /= np.linalg.norm(right)
        m = np.stack([right, np.cross(forward, right), forward], axis=1)
        m = turn.T @ m if local else m
        angles = np.degrees([np.arctan2(-m[1, 2], m[2, 2]), np.arcsin(m[0, 2]), np.arctan2(-m[0, 1], m[0, 0])])
        frames.append(
            {
                "position": dict(zip("xyz", position, strict=True)),
                "rotation": dict(zip("xyz", angles, strict=True)),
                "coordinate": {"latitude": latitude, "longitude": longitude, "altitude": altitude},
                "fovVertical": 40,
            }
        )
    sliders = []
    for name, value, reach in zip(("latitude", "longitude", "altitude"), origin, (90, 180, 1e4), strict=True):
        relative = (value + reach) / (2 * reach)
        sliders.append({"type": name, "value": {"minValueRange": -reach, "maxValueRange": reach, "relative": relative}})
    at = np.zeros(3) if local else sphere(*origin)
    point = {"position": dict(zip("xyz", at, strict=True)), "coordinate": {"isOrigin": True}}
    point["coordinate"]["position"] = {"attributes": sliders}
    return {"width": 64, "height": 48, "numFrames": 10, "cameraFrames": frames, "trackPoints": [point]}


COORDINATES = [(48 + 0.01 * np.cos(a), 11 + 0.01 * np.sin(a), 500 + 40 * a) for a in np.linspace(0, 3, 11)]


@pytest.mark.parametrize("turned", [False, True])
def test_earth_studio_local_is_the_same_as_global(tmp_path, turned):
    turn = look_at([1, 2, 3], [0, 0, 0]).rotation if turned else np.eye(3)
    found = []
    for local in (False, True):
        path = tmp_path / f"{local}.json"
        path.write_text(json.dumps(earth_studio(turn, (48.0, 11.0, 100.0), COORDINATES, local=local)))
        found.append(read_earth_studio(path))
    (cameras, origin), (from_local, origin_too) = found
    assert tuple(origin_too) == pytest.approx(tuple(origin), abs=1e-8)
    # 1e-6 m on a sphere of 6.4e6 m: half of float64's digits are left for the fit.
    same(from_local, cameras, atol=1e-5)
    np.testing.assert_allclose(cameras[0].position[2], 400, atol=1)  # 500 m over the sea, the origin is at 100
    assert cameras[0].direction[2] < -0.999


def test_earth_studio_frames_find_their_images(photographs):
    (photographs / "export.json").write_text(json.dumps(earth_studio(np.eye(3), (48, 11, 0), COORDINATES, local=False)))
    cameras = read_earth_studio(photographs / "export.json").cameras
    scene = read_scene(photographs)  # eleven frames, ten images
    np.testing.assert_array_equal(scene.cameras["7.png"].position, cameras[7].position)
    assert scene.origin.latitude_deg == pytest.approx(48)
    for name in ("0.png", "1.png", "4.png"):
        (photographs / "images" / name).unlink()
    scene = read_scene(photographs)  # now by number
    np.testing.assert_array_equal(scene.cameras["7.png"].position, cameras[7].position)


def test_masks(photographs):
    mask = np.full((48, 64), 255, np.uint8)
    mask[:24] = 0
    (photographs / "masks").mkdir()
    Image.fromarray(mask).save(photographs / "masks/3.png.png")
    scene = read_scene(photographs, image_scale=0.5)
    np.testing.assert_array_equal(scene.read_mask("3.png"), mask[::2, ::2] > 0)
    assert scene.read_mask("4.png") is None
    Image.fromarray(mask[:, :60]).save(photographs / "masks/4.png")
    with pytest.raises(InputError, match="mask of 64 x 48 pixels"):
        read_scene(photographs)


def test_image_scale_scales_cameras_and_pictures(photographs, tmp_path):
    write_colmap_model(photographs / "sparse/0", orbit(NAMES))
    full, half = read_scene(photographs), read_scene(photographs, image_scale=0.5)
    assert half.read_image("0.png").shape == (24, 32, 3)
    point = np.array([[0.1, 0.2, 0.3]])
    pixel = full.cameras["0.png"].project(point)[0]
    np.testing.assert_allclose(half.cameras["0.png"].project(point)[0], pixel / 2)
    half.write_images(tmp_path / "small")
    written = read_scene(tmp_path / "small")
    assert written.sizes["0.png"] == (32, 24)
    np.testing.assert_array_equal(written.read_image("0.png"), half.read_image("0.png"))


def test_splits(photographs):
    write_colmap_model(photographs / "sparse/0", orbit(NAMES))
    scene = read_scene(photographs)
    train, test = scene.split_every(8)
    assert test.images == ("0.png", "8.png")
    assert set(train.images) | set(test.images) == set(scene.images)
    assert set(test.cameras) == set(test.images)
    train, test = scene.split_blocks(4, blocks=1)
    assert test.images == ("4.png", "5.png")
    assert len(train) == 8
    for refused in (lambda: scene.split_every(1), lambda: scene.split_every(8)[1].split_blocks(8)):
        with pytest.raises(InputError, match="for training and for testing"):
            refused()
    with pytest.raises(InputError, match="got 'x'"):
        scene.select(["x"])


def test_fingerprint_sees_pixels_scale_and_poses(photographs):
    write_colmap_model(photographs / "sparse/0", orbit(NAMES))
    first = read_scene(photographs)
    assert first.fingerprint() == read_scene(photographs).fingerprint()
    assert first.fingerprint() != first.fingerprint(cameras=False)
    assert first.fingerprint() != read_scene(photographs, image_scale=0.5).fingerprint()
    write_colmap_model(photographs / "sparse/0", orbit(NAMES[:5]) + orbit(NAMES)[5:])
    moved = read_scene(photographs)
    assert first.fingerprint() != moved.fingerprint()
    assert first.fingerprint(cameras=False) == moved.fingerprint(cameras=False)
    before = moved.fingerprint()
    picture(photographs / "images/3.png", value=77)
    assert before != read_scene(photographs).fingerprint()


def test_image_headers(tmp_path):
    for name in ("a.png", "a.jpg"):
        picture(tmp_path / name, size=(33, 17))
        assert read_image_header(tmp_path / name)[:2] == (33, 17)
    exif = Image.Exif()
    exif[0x8825] = {1: "S", 2: (33.0, 30.0, 36.0), 3: "E", 4: (151.0, 0.0, 0.0), 5: b"\x01", 6: 12.5}
    Image.new("RGB", (5, 4)).save(tmp_path / "gps.jpg", exif=exif)
    header = read_image_header(tmp_path / "gps.jpg")
    assert header.gps == pytest.approx((-33.51, 151.0, -12.5))
    data = (tmp_path / "a.jpg").read_bytes()
    for cut in range(1, 200, 7):  # a cut never hangs, and is said
        (tmp_path / "cut.jpg").write_bytes(data[:cut])
        try:
            assert read_image_header(tmp_path / "cut.jpg")[:2] == (33, 17)
        except InputError as error:
            assert "cut off" in str(error) or "something else" in str(error)


def test_rotations_are_told_from_other_matrices():
    rotation = look_at([1, 2, 3], [0, 0, 0]).rotation
    found = rotation_from(np.round(rotation, 5))
    np.testing.assert_allclose(found @ found.T, np.eye(3), atol=1e-14)
    np.testing.assert_allclose(found, rotation, atol=2e-5)
    for wrong in (
        2 * rotation,
        rotation @ np.diag([1, 1, -1]),
        rotation + np.eye(3)[::-1] * 0.01,
        np.full((3, 3), np.nan),
    ):
        with pytest.raises(InputError, match="rotation"):
            rotation_from(wrong)


def test_refusals(photographs, tmp_path):
    def refuses(match, **options):
        with pytest.raises(InputError, match=match) as raised:
            read_scene(photographs, **options)
        assert "\n" not in str(raised.value)

    def transforms(frames, **values):
        (photographs / "transforms.json").write_text(
            json.dumps({"fl_x": 50, "w": 64, "h": 48, **values, "frames": frames})
        )

    eye = np.eye(4).tolist()
    refuses("image scale", image_scale=0)
    refuses("does not exist", cameras=tmp_path / "nowhere")
    refuses("COLMAP model", cameras=photographs / "images")
    transforms([{"file_path": "images/77.png", "transform_matrix": eye}])
    refuses("missing images: none of 1 cameras.*77.png")
    transforms([{"file_path": "3.png", "transform_matrix": (2 * np.eye(4)).tolist()}])
    refuses(r"frame 0 \(3.png\): expected a rotation .*determinant 8")
    transforms([{"file_path": "3.png", "transform_matrix": eye}], w=64, h=40)
    refuses("64 x 48 pixels, but its camera in .* is for 64 x 40")
    transforms(
        [{"file_path": "3.png", "transform_matrix": eye}, {"file_path": "images/3.png", "transform_matrix": eye}]
    )
    refuses("two cameras for the image 3.png")
    transforms([{"file_path": "3.png"}])
    refuses("transform_matrix")
    transforms([{"file_path": "3.png", "transform_matrix": eye}], k3=0.1)
    refuses("undistort")
    (photographs / "transforms.json").write_text("{")
    refuses("expected a transforms.json")
    (photographs / "transforms.json").unlink()

    model = photographs / "sparse/0"
    write_colmap_model(model, orbit(NAMES))
    text = (model / "images.txt").read_text()
    (model / "images.txt").write_text(text.replace("\n\n", "\n"))
    refuses("x, y, point triples")
    lines = text.splitlines()
    lines[3] = "1 0.5 0.5 0.5 0 " + lines[3].split(maxsplit=5)[5]
    (model / "images.txt").write_text("\n".join(lines))
    refuses("images.txt: image 0.png: expected a rotation as a unit quaternion")
    (model / "images.txt").write_text(text)
    (model / "cameras.txt").write_text("1 OPENCV_FISHEYE 64 48 50 50 32 24 0 0 0 0\n")
    refuses("cameras.txt: camera model OPENCV_FISHEYE is not supported")
    shutil.rmtree(photographs / "sparse")

    (photographs / "images/a.png").write_bytes(b"")
    refuses(r"a.png: expected an image, got an empty file \(0 bytes\)")
    (photographs / "images/a.png").write_bytes(b"text, not pixels")
    refuses("a.png: expected a JPEG or PNG image")
    (photographs / "images/a.png").rename(photographs / "images/a.tif")
    refuses("a.tif: expected JPEG or PNG images")
    shutil.rmtree(photographs / "images")
    refuses("expected a folder with images")


def test_damaged_binary_models_are_one_line(tmp_path):
    pycolmap = pytest.importorskip("pycolmap")
    write_colmap_model(tmp_path / "text", orbit(NAMES))
    (tmp_path / "model").mkdir()
    pycolmap.Reconstruction(str(tmp_path / "text")).write_binary(str(tmp_path / "model"))
    for name in ("cameras.bin", "images.bin"):
        data = (tmp_path / "model" / name).read_bytes()
        for length in range(0, len(data), 37):
            (tmp_path / "model" / name).write_bytes(data[:length])
            with pytest.raises(InputError, match=name):
                read_colmap_cameras(tmp_path / "model")
        (tmp_path / "model" / name).write_bytes(data)
    (tmp_path / "model/cameras.bin").write_bytes(struct.pack("<QiiQQ", 1, 1, 5, 64, 48))
    with pytest.raises(InputError, match="model 5 is not supported"):
        read_colmap_cameras(tmp_path / "model")
    with pytest.raises(InputError, match="binary COLMAP model"):
        write_colmap_model(tmp_path / "model", orbit(NAMES))


def test_undecodable_pixels_are_said_when_they_are_read(photographs):
    path = photographs / "images/0.png"
    path.write_bytes(path.read_bytes()[:200])  # the header is whole
    with pytest.raises(InputError, match=r"0.png: cannot be decoded"):
        read_scene(photographs).read_image("0.png")


def test_transforms_apply_the_pose(tmp_path):
    """One point, projected by hand: x right, y up, z backwards."""
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


@pytest.mark.parametrize("count", [1, 2, 10])
def test_the_camera_plot_is_drawn(photographs, count):
    matplotlib_image = pytest.importorskip("matplotlib.image")
    from pcbench.report.plot.cameras import draw_cameras

    write_colmap_model(photographs / "sparse/0", orbit(NAMES), Cloud(np.random.default_rng(0).normal(size=(500, 3))))
    draw_cameras(read_scene(photographs).select(NAMES[:count]), photographs / "cameras.png")
    image = matplotlib_image.imread(photographs / "cameras.png")
    assert image.shape == (768, 1680, 4)
    blue = (np.abs(image[..., :3] - [0, 0x72 / 255, 0xB2 / 255]).max(axis=2) < 0.1).sum()
    assert blue > 100  # both panels have cameras in their colour
    with pytest.raises(InputError, match="no cameras to draw"):
        draw_cameras(read_scene(photographs, cameras="none"), photographs / "none.png")
    assert not (photographs / "none.png").exists()


def test_rings_are_told_apart_and_closed():
    from pcbench.report.plot.cameras import _rings

    angles = np.linspace(0, 2 * np.pi, 12, endpoint=False)
    circle = np.stack([np.cos(angles), np.sin(angles), 0 * angles], axis=1)
    rings = _rings(np.concatenate([500 * circle, 1500 * circle + [0, 0, 300], 2500 * circle]))
    assert [len(ring) for ring in rings] == [13, 13, 13]
    for ring in rings:
        np.testing.assert_array_equal(ring[0], ring[-1])
    assert [len(ring) for ring in _rings(np.arange(15.0).reshape(5, 3))] == [5]
    walk = np.random.default_rng(0).normal(size=(40, 3)).cumsum(axis=0)
    assert [len(ring) for ring in _rings(walk)] == [40]
    assert not _rings(np.zeros((1, 3)))


def test_positions_of_a_file(photographs):
    (photographs / "gps.txt").write_text("# NAME X Y Z\n3.png 1 2 3.5\n77.png 0 0 0\n")
    warnings = []
    scene = read_scene(photographs, on_warning=warnings.append)
    assert "1 positions are left out, their images are missing: 77.png" in warnings[0]
    found, frame = scene.measured_positions()
    assert list(found) == ["3.png"]
    np.testing.assert_array_equal(found["3.png"], [1, 2, 3.5])
    assert frame == "in the frame of gps.txt"
    assert "GPS 1" in scene.describe()[1]
    assert not scene.select(["4.png"]).positions
    for line in ("3.png 1 2", "3.png 1 2 x", "3.png 1 2 nan"):
        (photographs / "gps.txt").write_text(line)
        with pytest.raises(InputError, match=r"gps.txt: line 1: expected a name and x y z"):
            read_scene(photographs)
