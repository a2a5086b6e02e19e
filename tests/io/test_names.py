"""Names and scalings of the fields of points, equal for all readers, and what writers cannot store."""

import re

import numpy as np
import pytest
from optional import import_or_skip
from pcd_bytes import pcd
from ply_bytes import ply
from refusals import refusal
from wording import check_text

from pcbench.geometry.cloud import Cloud
from pcbench.io import names, read_cloud, write_cloud
from pcbench.io.source import Source

XYZ = (1.0, 2.0, 3.0)
COLOR_NAMES = ["red green blue", "r g b", "R G B", "diffuse_red diffuse_green diffuse_blue", "Red Green Blue"]
NORMAL_NAMES = ["nx ny nz", "normal_x normal_y normal_z", "NormalX NormalY NormalZ", "normalx normaly normalz"]
# Types of channels in PLY and PCD, values and the 8-bit colours that they mean.
SCALES = {
    "8 bits": ("uchar U1", (255, 0, 7), [255, 0, 7]),
    "16 bits": ("ushort U2", (65535, 0, 1799), [255, 0, 7]),
    "8 bits in 16": ("ushort U2", (255, 0, 7), [255, 0, 7]),
    "integers": ("int I4", (255, 0, 7), [255, 0, 7]),
    "16 bits in integers": ("int I4", (65535, 0, 1799), [255, 0, 7]),
    "from 0 to 1": ("float F4", (1.0, 0.0, 0.5), [255, 0, 128]),
    "floats to 255": ("float F4", (255.0, 0.0, 6.6), [255, 0, 7]),
    "double": ("double F8", (0.2, 0.0, 0.4), [51, 0, 102]),
    "interpolated": ("float F4", (1.02, -1e-7, 0.4), [255, 0, 102]),
}
UNSCALED = {
    **{"float F4": (300.0, 0.0, 7.0), "short I2": (-1, 0, 7), "double F8": (float("nan"), 0.0, 1.0)},
    **{"uint U4": (300, 0, 7), "int16 I2": (300, 0, 7)},  # only unsigned numbers of 16 bits may be as small
}


def read(path, data, **options):
    path.write_bytes(data if isinstance(data, bytes) else data.encode())
    return read_cloud(path, **options)


def files(tmp_path, kinds, columns, values):
    """Yield (name, data) of a point with further columns in each format; `kinds` are the types in PLY and PCD."""
    ply_kind, pcd_kind = kinds.split()
    words, row = columns.split(), (*XYZ, *values)
    for form in ("ascii", "binary_big_endian"):
        properties = ["double x", "double y", "double z", *(f"{ply_kind} {word}" for word in words)]
        yield f"{form}.ply", ply(form, ("vertex", properties, [row]))
    for form in ("ascii", "binary"):
        yield f"{form}.pcd", pcd(form, ["X F8", "y F8", "z F8", *(f"{word} {pcd_kind}" for word in words)], [row])
    yield "a.csv", f"X,Y,Z,{','.join(words)}\n" + ",".join(map(repr, row))
    yield "a.txt", f"# x y z {columns}\n" + " ".join(map(repr, row))


@pytest.mark.parametrize("columns", COLOR_NAMES)
@pytest.mark.parametrize("scale", SCALES)
def test_colors(tmp_path, scale, columns):
    kinds, values, expected = SCALES[scale]
    for name, data in files(tmp_path, kinds, columns, values):
        cloud = read(tmp_path / name, data)
        assert (cloud.points.tolist(), cloud.attributes) == ([list(XYZ)], {}), name
        assert cloud.colors.tolist() == [expected], name


def test_line_ends_of_old_macs(tmp_path):
    for name, data in files(tmp_path, "uchar U1", "r g b", (255, 0, 7)):
        header, body = data, b""
        if isinstance(data, bytes):
            *_, last = (match.end() for match in re.finditer(rb"end_header\n|DATA [a-z]+\n", data))
            header, body = data[:last].replace(b"\n", b"\r"), data[last:]
            body = body.replace(b"\n", b"\r") if b"ascii" in header else body
        cloud = read(tmp_path / name, header.replace("\n", "\r") if isinstance(header, str) else header + body)
        assert (cloud.points.tolist(), cloud.colors.tolist()) == ([list(XYZ)], [[255, 0, 7]]), name


@pytest.mark.parametrize("kinds", UNSCALED)
def test_values_that_are_no_colors_are_attributes_with_a_warning(tmp_path, kinds):
    for name, data in files(tmp_path, kinds, "r g b", UNSCALED[kinds]):
        notes = []
        cloud = read(tmp_path / name, data, on_warning=notes.append)
        assert (cloud.colors, list(cloud.attributes), len(notes)) == (None, ["red", "green", "blue"], 1), name
    check_text(notes[0])


@pytest.mark.parametrize("columns", NORMAL_NAMES)
def test_normals(tmp_path, columns):
    for name, data in files(tmp_path, "float F4", columns, (0.0, 0.0, 1.0)):
        cloud = read(tmp_path / name, data)
        assert (cloud.normals.tolist(), cloud.attributes) == ([[0, 0, 1]], {}), name


def test_obj_points(tmp_path):
    notes = []
    lines = ["v 1 2 3 0.2 0 1", "v 4 5 6 0 0.4 1", "vn 0 0 1", "vn 1 0 0"]
    cloud = read(tmp_path / "a.obj", "\n".join(lines), on_warning=notes.append)
    assert (cloud.points.tolist(), cloud.normals.tolist()) == ([[1, 2, 3], [4, 5, 6]], [[0, 0, 1], [1, 0, 0]])
    assert (cloud.colors.tolist(), notes) == ([[51, 0, 255], [0, 102, 255]], [])
    assert not Source.open(tmp_path / "a.obj").holds_mesh
    lines += ["v 7 8 9", "f 1//1 2//1 3//2"]
    cloud = read(tmp_path / "a.obj", "\n".join(lines), on_warning=notes.append)
    assert (len(cloud), cloud.colors, cloud.normals) == (3, None, None)
    for note in notes:
        check_text(note)
    assert Source.open(tmp_path / "a.obj").holds_mesh
    for text in ("v 1 2\n", "v 1 2 three\n", "vn 1 0 0\n"):
        refusal(tmp_path / "b.obj", text)


@pytest.mark.parametrize("code", ["F4", "U4", "I4"])
@pytest.mark.parametrize("field", ["rgb", "rgba", "RGB"])
def test_packed_colors(tmp_path, field, code):
    color = int(np.array([0x0A141E28], "<u4").view(f"<{code[0].lower()}4")[0]) if code != "F4" else None
    value = float(np.array([0x0A141E28], "<u4").view("<f4")[0]) if color is None else color
    cloud = read(tmp_path / "a.pcd", pcd("binary", ["x F4", "y F4", "z F4", f"{field} {code}"], [(*XYZ, value)]))
    assert (cloud.colors.tolist(), cloud.attributes) == ([[0x14, 0x1E, 0x28]], {})


def test_standard_names():
    def renamed(text, taken=()):
        return " ".join(names.standard_names(text.split(), taken))

    assert renamed("X Y Z Scalar_Intensity Class GpsTime") == "x y z intensity classification gps_time"
    assert renamed("Easting Northing Height r") == "x y z r"  # one channel is no colour
    assert renamed("z height x y") == "z height x y"
    assert renamed("x X y z") == "x X y z"
    assert renamed("x y z red r g b") == "x y z red r g b"
    assert renamed("intensity Intensity") == "intensity Intensity"
    assert renamed("height r g b", taken=(*names.XYZ, *names.COLORS)) == "height r g b"


def test_colors_are_scaled_by_all_values_of_a_file(tmp_path):
    from pcbench.io.pieces import open_cloud, read_piece

    rows = [(0.0, 0.0, 0.0, 9, 9, 9)] * 60 + [(1.0, 1.0, 1.0, 9000, 9000, 9000)] * 60
    properties = ["float x", "float y", "float z", *(f"ushort {name}" for name in names.COLORS)]
    whole = read(tmp_path / "a.ply", ply("binary_little_endian", ("vertex", properties, rows)))
    assert whole.colors[[0, -1], 0].tolist() == [0, 35]
    cloud = open_cloud(tmp_path / "a.ply", piece_points=50)
    pieces = [read_piece(cloud, piece).points for piece in cloud.pieces]
    np.testing.assert_array_equal(np.concatenate(pieces), whole.points)


# ---- writing ----

FULL = Cloud(
    np.random.default_rng(0).normal(size=(5, 3)),
    normals=np.tile([0.0, 0.6, 0.8], (5, 1)),
    colors=np.random.default_rng(1).integers(0, 256, (5, 3), dtype=np.uint8),
    attributes={
        "intensity": np.linspace(0, 1, 5),
        "classification": np.arange(5, dtype=np.uint8),
        "red": np.linspace(-1, 300, 5),
        "point number": np.arange(5),
        "Höhe": np.arange(5.0),
        "x": np.arange(5.0),
        "rgb": np.arange(5, dtype=np.float32),
        "": np.arange(5, dtype=np.int16),
        "flag": np.arange(5) % 2 == 0,
        "=cmd|calc!A1": np.arange(5),
    },
    crs="EPSG:32617",
    unit="m",
)


@pytest.mark.parametrize("extension", ["ply", "pcd", "txt", "csv", "npz", "las", "laz"])
def test_all_formats_store_all_attributes(tmp_path, extension):
    """Values survive in every format, under another name where the format does not allow theirs, which is said."""
    if extension in ("las", "laz"):
        import_or_skip("pyproj")
    if extension == "laz":
        import_or_skip("lazrs")
    path, notes = tmp_path / f"a.{extension}", []
    write_cloud(path, FULL, on_warning=notes.append)
    for note in notes:
        check_text(note)
    cloud = read_cloud(path)
    np.testing.assert_allclose(cloud.points, FULL.points, atol=1e-6)  # the step of LAS
    np.testing.assert_allclose(cloud.normals, FULL.normals, atol=1e-7)  # float32
    np.testing.assert_array_equal(cloud.colors, FULL.colors)
    check_text(", ".join(cloud.attributes))
    stored = [cloud.attributes[name] for name in cloud.attributes]
    for name, values in FULL.attributes.items():
        assert any(np.array_equal(values, column) for column in stored), name
    assert cloud.crs is None if extension in ("pcd", "csv") else "32617" in cloud.crs


def test_what_a_format_cannot_store_is_left_out_with_a_line(tmp_path):
    for name, cloud in (
        ("a.npy", FULL),
        ("a.pcd", Cloud(FULL.points, crs="EPSG:32617", unit="m")),
        ("a.csv", Cloud(FULL.points, unit="m")),
        ("a.las", Cloud(FULL.points, unit="m")),
    ):
        with pytest.warns(UserWarning) as caught:
            write_cloud(tmp_path / name, cloud)
        check_text(str(caught[0].message))
    import_or_skip("pyproj")
    with pytest.warns(UserWarning) as caught:
        write_cloud(tmp_path / "a.las", Cloud(FULL.points, crs="the village"))
    check_text(str(caught[0].message))


def test_names_that_become_equal_stay_apart(tmp_path):
    attributes = {"a b": np.array([1]), "a_b": np.array([2]), "a\tb": np.array([3])}
    for name in ("a.ply", "a.las", "a.txt"):
        write_cloud(tmp_path / name, Cloud(np.zeros((1, 3)), attributes=attributes), on_warning=lambda _: None)
        values = [int(v[0]) for key, v in read_cloud(tmp_path / name).attributes.items() if key.startswith("a")]
        assert values == [1, 2, 3]
    long = {"a" * 40: np.array([1]), "a" * 41: np.array([2])}
    write_cloud(tmp_path / "b.las", Cloud(np.zeros((1, 3)), attributes=long), on_warning=lambda _: None)
    assert [k for k in read_cloud(tmp_path / "b.las").attributes if "aa" in k] == ["a" * 32, "a" * 31 + "_"]
