"""Scenes: images and cameras from all formats, and messages if they do not match."""

import json
import shutil
import warnings

import numpy as np
import pytest
from data_folder import data_folder
from optional import import_or_skip
from PIL import Image
from scene_folders import NAMES, orbit, picture
from wording import check_error, check_text

from pcbench.errors import InputError
from pcbench.io.colmap_model import write_colmap_model
from pcbench.io.image_header import no_pixel_limit, read_image_header
from pcbench.scenes import read_scene


def test_images_without_cameras(photographs):
    scene = read_scene(photographs)
    assert scene.images == tuple(NAMES)
    assert scene.sizes["3.png"] == (64, 48)
    assert not scene.cameras
    assert scene.read_image("3.png").shape == (48, 64, 3)


def test_real_scenes():
    fountain = read_scene(data_folder("fountain"))
    assert len(fountain.cameras) == 11
    k = fountain.cameras["0000.jpg"].intrinsics
    assert (k.width, k.height, k.fx, k.cx) == (1536, 1024, 2759.48 / 2, 1520.69 / 2)  # K is for twice the size
    np.testing.assert_allclose(fountain.cameras["0000.jpg"].position, [-7.28137, -7.57667, 0.204446])
    notes = []
    fox = read_scene(data_folder("fox"), on_warning=notes.append, image_scale=0.5)
    assert len(fox.cameras) == 50
    assert "17 of 67" in notes[0]
    check_text(notes[0])
    assert fox.cameras["0001.jpg"].intrinsics.fx == 1375.52 / 4
    assert fox.read_image("0001.jpg").shape == (480, 270, 3)
    brighton = read_scene(data_folder("brighton"))
    assert len(brighton.gps) == 18
    # Pillow reads the same EXIF block.
    for name, gps in brighton.gps.items():
        with Image.open(brighton.folder / name) as file:
            tags = file.getexif().get_ifd(0x8825)
        latitude, longitude = (sum(float(v) / 60**i for i, v in enumerate(tags[t])) for t in (2, 4))
        assert (tags[1], tags[3]) == ("N", "W")
        assert gps == pytest.approx((latitude, -longitude, float(tags[6])), abs=1e-12)


def test_masks(photographs):
    mask = np.full((48, 64), 255, np.uint8)
    mask[:24] = 0
    (photographs / "masks").mkdir()
    Image.fromarray(mask).save(photographs / "masks/3.png.png")
    scene = read_scene(photographs, image_scale=0.5)
    np.testing.assert_array_equal(scene.read_mask("3.png"), mask[::2, ::2] > 0)
    assert scene.read_mask("4.png") is None
    Image.fromarray(mask[:, :60]).save(photographs / "masks/4.png")
    with check_error():
        read_scene(photographs)


def test_transparent_pixels_count_as_masked(photographs):
    """Colors are composited over black; an alpha channel that is opaque everywhere changes nothing."""
    images = photographs / "images"
    rgb = np.asarray(Image.open(images / "3.png"))
    alpha = np.full((48, 64), 255, np.uint8)
    Image.fromarray(np.dstack([rgb, alpha])).save(images / "4.png")
    alpha[:24], alpha[24:26] = 0, 128
    Image.fromarray(np.dstack([rgb, alpha])).save(images / "3.png")
    mask = np.full((48, 64), 255, np.uint8)
    mask[:, :32] = 0
    scene = read_scene(photographs)
    assert scene.with_alpha == {"3.png", "4.png"}
    assert scene.select(["0.png", "3.png"]).with_alpha == {"3.png"}
    check_text("\n".join(scene.describe()[1:]))
    np.testing.assert_array_equal(scene.read_alpha("3.png"), alpha)
    np.testing.assert_array_equal(scene.read_mask("3.png"), alpha > 0)
    shown = scene.read_image("3.png")
    assert not shown[:24].any()
    np.testing.assert_allclose(shown[24:26], rgb[24:26] * (128 / 255), atol=1)
    np.testing.assert_array_equal(shown[26:], rgb[26:])
    for name in ("4.png", "0.png"):
        assert scene.read_alpha(name) is scene.read_mask(name) is None
    (photographs / "masks").mkdir()
    Image.fromarray(mask).save(photographs / "masks/3.png")
    np.testing.assert_array_equal(read_scene(photographs).read_mask("3.png"), (alpha > 0) & (mask > 0))


@pytest.mark.parametrize("mode", ["L", "P", "RGB"])
def test_a_transparent_color_counts_as_alpha(photographs, mode):
    """PNG files of all color types may have one; a palette alone is opaque."""
    image = Image.fromarray(np.where(np.arange(64) < 32, np.uint8(10), np.uint8(200))[None].repeat(48, axis=0))
    image = image.convert(mode)
    image.save(photographs / "images/3.png", transparency=(10, 10, 10) if mode == "RGB" else image.getpixel((0, 0)))
    image.save(photographs / "images/4.png")
    scene = read_scene(photographs)
    assert scene.with_alpha == {"3.png"}
    assert (scene.read_mask("3.png") == (np.arange(64) >= 32)).all()


def test_image_scale_scales_cameras_and_images(photographs, tmp_path):
    write_colmap_model(photographs / "sparse/0", orbit(NAMES))
    full_scene, half_scene = read_scene(photographs), read_scene(photographs, image_scale=0.5)
    assert half_scene.read_image("0.png").shape == (24, 32, 3)
    point = np.array([[0.1, 0.2, 0.3]])
    pixel = full_scene.cameras["0.png"].project(point)[0]
    np.testing.assert_allclose(half_scene.cameras["0.png"].project(point)[0], pixel / 2)
    half_scene.write_images(tmp_path / "small")
    small_scene = read_scene(tmp_path / "small")
    assert small_scene.sizes["0.png"] == (32, 24)
    np.testing.assert_array_equal(small_scene.read_image("0.png"), half_scene.read_image("0.png"))


def test_scene_name_is_its_folder_name(photographs, tmp_path):
    assert read_scene(photographs).name == photographs.name
    assert read_scene(photographs / "images").name == photographs.name
    picture(tmp_path / "plain" / "0.png")
    assert read_scene(tmp_path / "plain").name == "plain"


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
    for split in (lambda: scene.split_every(1), lambda: scene.split_every(8)[1].split_blocks(8)):
        with check_error():
            split()
    with check_error():
        scene.select(["x"])


def test_fingerprint_depends_on_pixels_scale_and_poses(photographs):
    write_colmap_model(photographs / "sparse/0", orbit(NAMES))
    scene = read_scene(photographs)
    assert scene.fingerprint() == read_scene(photographs).fingerprint()
    assert scene.fingerprint() != scene.fingerprint(cameras=False)
    assert scene.fingerprint() != read_scene(photographs, image_scale=0.5).fingerprint()
    write_colmap_model(photographs / "sparse/0", orbit(NAMES[:5]) + orbit(NAMES)[5:])
    moved_scene = read_scene(photographs)
    assert scene.fingerprint() != moved_scene.fingerprint()
    assert scene.fingerprint(cameras=False) == moved_scene.fingerprint(cameras=False)
    old_fingerprint = moved_scene.fingerprint()
    picture(photographs / "images/3.png", value=77)
    assert old_fingerprint != read_scene(photographs).fingerprint()


def test_image_headers(tmp_path):
    for name in ("a.png", "a.jpg"):
        picture(tmp_path / name, size=(33, 17))
        assert read_image_header(tmp_path / name)[:2] == (33, 17)
    exif = Image.Exif()
    exif[0x8825] = {1: "S", 2: (33.0, 30.0, 36.0), 3: "E", 4: (151.0, 0.0, 0.0), 5: b"\x01", 6: 12.5}
    Image.new("RGB", (5, 4)).save(tmp_path / "gps.jpg", exif=exif)
    Image.new("RGB", (5, 4)).save(tmp_path / "gps.png", exif=exif)
    Image.new("RGB", (5, 4)).save(tmp_path / "gps.webp", exif=exif)
    Image.new("RGB", (5, 4)).save(tmp_path / "gps.tif", exif=exif.tobytes())
    with no_pixel_limit():
        Image.new("1", (20_000, 20_000)).save(tmp_path / "large.tif", compression="group4")
    assert read_image_header(tmp_path / "large.tif")[:2] == (20_000, 20_000)  # more than Pillow opens by default
    for name in ("gps.jpg", "gps.png", "gps.webp", "gps.tif"):
        assert read_image_header(tmp_path / name).gps == pytest.approx((-33.51, 151.0, -12.5))
    data = (tmp_path / "a.jpg").read_bytes()
    for length in range(1, 200, 7):  # truncation never hangs and is reported
        (tmp_path / "cut.jpg").write_bytes(data[:length])
        try:
            assert read_image_header(tmp_path / "cut.jpg")[:2] == (33, 17)
        except InputError as error:
            assert "truncated" in str(error) or "another format" in str(error)


def test_invalid_scenes_are_refused(photographs, tmp_path):
    def check_refusal(**options):
        with check_error():
            read_scene(photographs, **options)

    def write_transforms(frames, **values):
        (photographs / "transforms.json").write_text(
            json.dumps({"fl_x": 50, "w": 64, "h": 48, **values, "frames": frames})
        )

    identity = np.eye(4).tolist()
    check_refusal(image_scale=0)
    check_refusal(cameras=tmp_path / "nowhere")
    check_refusal(cameras=photographs / "images")
    write_transforms([{"file_path": "images/77.png", "transform_matrix": identity}])
    check_refusal()
    write_transforms([{"file_path": "3.png", "transform_matrix": (2 * np.eye(4)).tolist()}])
    check_refusal()
    write_transforms([{"file_path": "3.png", "transform_matrix": identity}], w=64, h=40)
    check_refusal()
    write_transforms(
        [
            {"file_path": "3.png", "transform_matrix": identity},
            {"file_path": "images/3.png", "transform_matrix": identity},
        ]
    )
    check_refusal()
    write_transforms([{"file_path": "3.png"}])
    check_refusal()
    write_transforms([{"file_path": "3.png", "transform_matrix": identity}], k4=0.1)
    check_refusal()
    (photographs / "transforms.json").write_text("{")
    with pytest.raises(InputError, match=r"transforms\.json: "):  # the rest of the message comes from Python's parser
        read_scene(photographs)
    (photographs / "transforms.json").unlink()

    model = photographs / "sparse/0"
    write_colmap_model(model, orbit(NAMES))
    text = (model / "images.txt").read_text()
    lines = text.splitlines()
    lines[3] = "1 0.5 0.5 0.5 0 " + lines[3].split(maxsplit=5)[5]
    (model / "images.txt").write_text("\n".join([*lines, ""]))
    check_refusal()
    (model / "images.txt").write_text(text)
    (model / "cameras.txt").write_text("1 THIN_PRISM_FISHEYE 64 48 50 50 32 24 0 0 0 0 0 0 0 0\n")
    check_refusal()
    shutil.rmtree(photographs / "sparse")

    for file in (photographs / "images").iterdir():
        file.write_bytes(b"")
    check_refusal()
    shutil.rmtree(photographs / "images")
    check_refusal()
    picture(photographs / "images/a.png")
    (photographs / "images/a.png").rename(photographs / "images/a.bmp")
    check_refusal()


def test_files_that_cannot_be_used_are_left_out(photographs):
    images = photographs / "images"
    (images / "b.png").write_bytes(b"")
    (images / "c.jpg").write_bytes(b"text, not pixels")
    (images / "d.jpg").symlink_to("nowhere.jpg")
    (images / "e.heic").write_bytes(b"text")
    pages = [Image.new("L", (64, 48), value) for value in (1, 2)]
    pages[0].save(images / "f.tif", save_all=True, append_images=pages[1:])
    Image.fromarray(np.zeros((48, 64), np.float32)).save(images / "g.tif")
    (images / "h.webp").write_bytes(b"RIFF\x10\0\0\0WEBPVP8 ")
    notes = []
    scene = read_scene(photographs, on_warning=notes.append)
    assert list(scene.images) == NAMES
    assert len(notes) == 1
    assert "(7)" in notes[0]
    check_text(
        notes[0].partition("; " + str(images / "h.webp"))[0].replace(str(images), "images")
    )  # then Pillow's words


@pytest.mark.parametrize("depth", [8, 16])
@pytest.mark.parametrize("kind", ["L", "RGB"])
def test_tiff_and_webp_images_are_read(tmp_path, kind, depth):
    """Pillow cannot write colours of 16 bits, so that tifffile writes all."""
    tifffile = pytest.importorskip("tifffile")
    rng = np.random.default_rng(depth)
    pixels = rng.integers(0, 256, (17, 33) if kind == "L" else (17, 33, 3), dtype=np.uint8)
    tifffile.imwrite(tmp_path / "a.tif", pixels if depth == 8 else pixels.astype(np.uint16) * 257)
    Image.fromarray(pixels).save(tmp_path / "b.webp", lossless=True)
    scene = read_scene(tmp_path)
    assert scene.sizes == {"a.tif": (33, 17), "b.webp": (33, 17)}
    expected = np.broadcast_to(pixels.reshape(17, 33, -1), (17, 33, 3))
    scene.write_images(tmp_path / "copies")
    for name in scene.images:
        np.testing.assert_array_equal(scene.read_image(name), expected)
        with Image.open(tmp_path / "copies" / name) as copy:
            assert copy.format == "PNG"
            np.testing.assert_array_equal(copy.convert("RGB"), expected)


def test_undecodable_pixels_are_reported_on_reading(photographs):
    path = photographs / "images/0.png"
    path.write_bytes(path.read_bytes()[:200])  # the header is complete
    with pytest.raises(InputError, match=r"0\.png: "):  # the rest of the message comes from Pillow
        read_scene(photographs).read_image("0.png")


def test_positions_from_a_file(photographs):
    (photographs / "gps.txt").write_text("# NAME X Y Z\n3.png 1 2 3.5\n77.png 0 0 0\n")
    notes = []
    scene = read_scene(photographs, on_warning=notes.append)
    check_text(notes[0])
    positions, frame = scene.measured_positions()
    assert list(positions) == ["3.png"]
    np.testing.assert_array_equal(positions["3.png"], [1, 2, 3.5])
    assert frame == "in the frame of gps.txt"
    assert "GPS 1" in scene.describe()[1]
    assert not scene.select(["4.png"]).positions
    for line in ("3.png 1 2", "3.png 1 2 x", "3.png 1 2 nan"):
        (photographs / "gps.txt").write_text(line)
        with check_error():
            read_scene(photographs)


def make_exif(make, model, focal_35mm=None, focal_mm=None, pixels_per_cm=None):
    """Return an EXIF block with a focal length in one of the forms that cameras write."""
    from PIL.TiffImagePlugin import IFDRational

    exif = Image.Exif()
    exif[0x10F], exif[0x110] = make, model
    fields = exif.get_ifd(0x8769)
    if focal_35mm:
        fields[0xA405] = focal_35mm
    if focal_mm:
        fields[0x920A] = IFDRational(round(100 * focal_mm), 100)
    if pixels_per_cm:
        fields |= {0xA20E: IFDRational(pixels_per_cm), 0xA20F: IFDRational(pixels_per_cm), 0xA210: 3}
        fields |= {0xA002: 640, 0xA003: 480}
    return exif


@pytest.mark.parametrize("extension", ["jpg", "png"])
@pytest.mark.parametrize(
    "exif",
    [
        make_exif("Any", "thing", focal_35mm=24),
        make_exif("Any", "thing", focal_mm=10, pixels_per_cm=500),
        make_exif("DJI", "FC6310", focal_mm=8.8),  # by COLMAP's table of sensors
    ],
)
def test_smaller_images_keep_the_focal_length_of_their_exif(tmp_path, extension, exif):
    pycolmap = import_or_skip("pycolmap")
    picture(tmp_path / f"a.{extension}", size=(640, 480))
    with Image.open(tmp_path / f"a.{extension}") as image:
        image.save(tmp_path / f"a.{extension}", exif=exif)
    read_scene(tmp_path, image_scale=0.5).write_images(tmp_path / "small")
    full_camera, small_camera = (
        pycolmap.infer_camera_from_image(f / f"a.{extension}") for f in (tmp_path, tmp_path / "small")
    )
    assert full_camera.has_prior_focal_length
    assert small_camera.has_prior_focal_length
    assert small_camera.focal_length == pytest.approx(full_camera.focal_length / 2, rel=1e-3)


def test_damaged_exif_is_left_out_of_smaller_images(tmp_path):
    exif_bytes = make_exif("Any", "thing", focal_35mm=24).tobytes()
    for length in (7, 12, 20, 40, len(exif_bytes) - 3):
        Image.new("RGB", (64, 48)).save(tmp_path / f"{length}.jpg", exif=exif_bytes[:length])
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        read_scene(tmp_path, image_scale=0.5).write_images(tmp_path / "small")
    assert len(read_scene(tmp_path / "small").images) == 5


def test_names_are_in_natural_order(tmp_path):
    names = [f"frame_{number}.png" for number in (1, 2, 9, 10, 11, 100)]
    for name in [*reversed(names), "frame_002.png"]:
        picture(tmp_path / name)
    assert read_scene(tmp_path).images == ("frame_1.png", "frame_002.png", *names[1:])


@pytest.mark.parametrize("folder", ["images", "train", "rgb", "footage"])
def test_common_folder_layouts(tmp_path, folder):
    for number in range(3):
        picture(tmp_path / folder / f"r_{number}.png")
    picture(tmp_path / "overview.png")  # next to the images folder, so ignored
    frames = [{"file_path": f"./{folder}/r_{n}", "transform_matrix": np.eye(4).tolist()} for n in range(3)]
    (tmp_path / "transforms_train.json").write_text(json.dumps({"camera_angle_x": 0.9, "frames": frames}))
    scene = read_scene(tmp_path)
    assert scene.folder == tmp_path / folder
    assert scene.images == tuple(scene.cameras) == ("r_0.png", "r_1.png", "r_2.png")


@pytest.mark.parametrize(
    "path_format",
    [
        "cam1/{}.png",
        "cam1/{}",
        "./images/cam1/{}.jpg",
        "cam1\\{}.png",
        "C:\\scene\\images\\cam1\\{}.png",
        "/data/cam1/{}",
    ],
)
def test_image_paths_from_another_machine(tmp_path, path_format):
    for camera in ("cam1", "cam2"):  # the last part alone is ambiguous
        picture(tmp_path / "images" / camera / "0.5.png")
    frame = {"file_path": path_format.format("0.5"), "transform_matrix": np.eye(4).tolist()}
    (tmp_path / "transforms.json").write_text(json.dumps({"fl_x": 50, "w": 64, "h": 48, "frames": [frame]}))
    assert list(read_scene(tmp_path, on_warning=lambda _: None).cameras) == ["cam1/0.5.png"]


@pytest.mark.parametrize(
    "values",
    [
        {"fl_x": 35.7, "camera_angle_x": 0.86},
        {"fl_x": 50, "fl_y": 50, "camera_angle_y": 1.2},
        {"fl_x": 0.8, "fl_y": 0.8, "cx": 0.5, "cy": 0.5},
        {"fl_x": 50, "cx": 0.5, "cy": 0.5},
        {"fl_x": 50, "cx": 70, "cy": 24},
        {"fl_x": 50, "cx": 32, "cy": -3},
        {},
    ],
)
def test_implausible_intrinsics_are_refused(photographs, values):
    frames = [{"file_path": "3.png", "transform_matrix": np.eye(4).tolist()}]
    (photographs / "transforms.json").write_text(json.dumps({"w": 64, "h": 48, **values, "frames": frames}))
    with check_error() as caught:
        read_scene(photographs)
    assert "3.png" in str(caught.value)


def test_ignored_keys_are_reported(photographs):
    identity = np.eye(4).tolist()
    frames = [{"file_path": f"{n}.png", "transform_matrix": identity} for n in range(10)]
    neutral_values = {
        "k5": 0,
        "k6": 0.0,
        "rolling_shutter": [0, 0, 0, 0],
        "applied_transform": identity[:3],
        "applied_scale": 1.0,
    }
    for values, names in (
        (neutral_values, []),
        ({"k5": 0.1, "k6": -0.2}, ["k5, k6"]),
        ({"rolling_shutter": [0, 0, 0.03, 0]}, ["rolling_shutter"]),
        ({"applied_transform": [[0, 1, 0, 0], [1, 0, 0, 0], [0, 0, -1, 0]]}, ["applied_transform"]),
    ):
        document = {"fl_x": 50, "w": 64, "h": 48, **values, "frames": frames}
        (photographs / "transforms.json").write_text(json.dumps(document))
        notes = []
        read_scene(photographs, on_warning=notes.append)
        assert len(notes) == len(names)
        for note, name in zip(notes, names, strict=True):
            assert f"ignored {name}:" in note
            check_text(note)
    frames[4]["applied_scale"] = 0.3  # in one frame only
    (photographs / "transforms.json").write_text(json.dumps({"fl_x": 50, "w": 64, "h": 48, "frames": frames}))
    notes = []
    read_scene(photographs, on_warning=notes.append)
    assert "applied_scale" in notes[0]


def test_earth_studio_project_is_not_an_export(photographs):
    (photographs / "rome.esp").write_text('{"scenes": []}')
    notes = []
    assert not read_scene(photographs, on_warning=notes.append).cameras
    check_text(notes[0])
    with check_error():
        read_scene(photographs, cameras=photographs / "rome.esp")


def test_repeated_frame_is_refused_before_poses_are_read(photographs, monkeypatch):
    """Many repetitions stay fast, since parsing a pose takes 0.2 ms."""
    frame = {"file_path": "images/3.png", "transform_matrix": np.eye(4).tolist()}
    document = {"fl_x": 50, "w": 64, "h": 48, "frames": [frame] * 1000}
    (photographs / "transforms.json").write_text(json.dumps(document))
    monkeypatch.setattr("pcbench.io.transforms_json._pose", lambda _: pytest.fail("a pose was read"))
    with check_error():
        read_scene(photographs)


@pytest.mark.parametrize("name", ["K.txt", "intrinsics.json", "calib.yml", "calibration_left.xml", "fountain_par.txt"])
def test_unread_calibration_is_reported(photographs, name):
    (photographs / "images" / name).write_text("50 0 32\n0 50 24\n0 0 1\n")
    (photographs / "images" / "readme.txt").write_text("photographs of a kiosk")
    notes = []
    read_scene(photographs, on_warning=notes.append)
    assert len(notes) == (name != "K.txt")  # K.txt is read if images have no camera
    check_text("\n".join(notes))
    write_colmap_model(photographs / "sparse", orbit(NAMES))
    notes.clear()
    read_scene(photographs, on_warning=notes.append)
    assert [str(photographs / "sparse") in note for note in notes] == [True]
    notes.clear()
    read_scene(photographs, cameras="none", on_warning=notes.append)
    assert not notes


def test_cameras_among_the_images_are_read_without_warning(photographs):
    write_colmap_model(photographs / "images", orbit(NAMES))
    notes = []
    assert len(read_scene(photographs, cameras=photographs / "images", on_warning=notes.append).cameras) == len(NAMES)
    assert not notes
