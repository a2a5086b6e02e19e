"""Gaussian splats in compact formats: values of other programs, known bytes, damage, and what is written."""

import gzip
import runpy
import struct
from types import SimpleNamespace

import numpy as np
import pytest
from optional import import_or_skip
from ply_bytes import XYZ, ply
from refusals import refusal
from repository import TESTS
from splat_bytes import FOREIGN, SPLAT_ROW, ksplat, packed_spz, spz
from splat_models import make_gaussians
from wording import check_error, check_text

from pcbench import Cloud, read_cloud, write_cloud
from pcbench.geometry.splats import splat_model
from pcbench.io.pieces import open_cloud, read_piece

WRITTEN = SimpleNamespace(**runpy.run_path(str(TESTS / "foreign" / "make.py")))
SH_DC = 0.28209479177387814
# Largest errors of positions, harmonics, and rotations (as 1 - |cos| of half the angle) by the format's definition.
EXACT, HALF = 1e-6, 2.0**-11  # float32 of values up to 3; half a step of float16 from 0.5 to 1
ERRORS = {
    "ply2splat.splat": (EXACT, None, 1e-4),  # bytes of quaternions, truncated: 4 steps of 1/128 squared, halved
    "playcanvas_3.spz": (2.0**-13, 0.07, 2e-6),  # half a step; buckets of 16 in 256, half of them in each direction
    "playcanvas_4.spz": (2.0**-13, 0.07, 2e-6),
    "playcanvas.compressed.ply": (3 / 1023 / 2, 8 / 256, 2e-6),  # 10 bits of 3 units; bytes of -4 to 4
    "mkkellogg_0.ksplat": (EXACT, EXACT, EXACT),
    "mkkellogg_1.ksplat": (2.5 / 32767, HALF, 1e-6),  # half a block in 32767 steps; halves
    "mkkellogg_2.ksplat": (2.5 / 32767, 3 / 255, 1e-6),  # bytes of -1.5 to 1.5
}


def unit(quaternions):
    return quaternions / np.linalg.norm(quaternions, axis=1, keepdims=True)


def stacked(columns, name, count):
    return np.stack([columns[f"{name}_{k}"] for k in range(count)], axis=1).astype(np.float64)


@pytest.mark.parametrize("name", ERRORS)
def test_splats_of_other_programs(name):
    if name == "playcanvas_4.spz":
        import_or_skip("zstandard")
    position_error, harmonics_error, rotation_error = ERRORS[name]
    cloud = read_cloud(FOREIGN / name)
    # Programs sort splats; no two of these are near one another.
    order = np.square(WRITTEN.POINTS[:, None] - cloud.points).sum(axis=2).argmin(axis=1)
    cloud = cloud.select(order)
    np.testing.assert_allclose(cloud.points, WRITTEN.POINTS, atol=position_error)
    # SPZ has steps of 1 / (0.15 * 255) in the coefficients, 1.9 in the colours; others have bytes of colours.
    np.testing.assert_allclose(cloud.colors.astype(int), WRITTEN.COLORS, atol=2 if "spz" in name else 1)
    model = splat_model(cloud)
    assert model is not None and model.dimensions == 3
    opacities = 1 / (1 + np.exp(-WRITTEN.SPLATS["opacity"]))
    np.testing.assert_allclose(model.opacities, opacities, atol=1.01 / 255)
    scales = stacked(WRITTEN.SPLATS, "scale", 3)
    np.testing.assert_allclose(np.log(model.axes), scales, atol=1 / 32 + 1e-6)  # half a step of SPZ; others less
    cosines = (unit(stacked(cloud.attributes, "rot", 4)) * unit(stacked(WRITTEN.SPLATS, "rot", 4))).sum(axis=1)
    np.testing.assert_allclose(np.abs(cosines), 1, atol=rotation_error)
    if harmonics_error is None:
        assert model.sh_degree == 0
    else:
        assert model.sh_degree == 1
        harmonics = stacked(WRITTEN.SPLATS, "f_rest", 9)
        np.testing.assert_allclose(stacked(cloud.attributes, "f_rest", 9), harmonics, atol=harmonics_error)


@pytest.mark.parametrize("name", [name for name in ERRORS if name != "playcanvas_4.spz"])
def test_pieces_are_the_cloud(name):
    on_disk = open_cloud(FOREIGN / name)
    (piece,) = on_disk.pieces
    np.testing.assert_array_equal(read_piece(on_disk, piece).points, read_cloud(FOREIGN / name).points)
    assert on_disk.count == 8


def test_all_files_are_tested():
    assert {file.name for file in FOREIGN.iterdir()} == set(ERRORS)


def test_filters_are_those_of_ply():
    cloud = read_cloud(FOREIGN / "playcanvas_3.spz", min_opacity=0.5, max_axis=0.2)
    opacities = 1 / (1 + np.exp(-WRITTEN.SPLATS["opacity"]))
    keep = (opacities >= 0.5) & (np.exp(WRITTEN.SPLATS["scale_0"]) <= 0.2)
    assert 0 < np.count_nonzero(keep) < 4
    np.testing.assert_allclose(np.sort(cloud.points[:, 0]), np.sort(WRITTEN.POINTS[keep, 0]), atol=2.0**-13)


def test_rows_of_splat_are_decoded(tmp_path):
    (tmp_path / "a.splat").write_bytes(SPLAT_ROW)
    cloud = read_cloud(tmp_path / "a.splat")
    assert (cloud.points.tolist(), cloud.colors.tolist()) == ([[1, -2, 3]], [[255, 0, 128]])
    model = splat_model(cloud)
    np.testing.assert_allclose(model.axes, [[0.5, 0.25, 1]], rtol=1e-6)
    np.testing.assert_allclose(model.opacities, [0.2], rtol=1e-6)
    assert stacked(cloud.attributes, "rot", 4).tolist() == [[1, 0, 0, 0]]


def test_splat_is_written_as_another_program_does(tmp_path):
    """ply2splat truncates what is rounded here, and keeps the order of the splats."""
    columns = {name: values.astype(np.float32) for name, values in WRITTEN.SPLATS.items() if len(name) > 2}
    notes = []
    write_cloud(tmp_path / "a.splat", Cloud(WRITTEN.POINTS, attributes=columns), on_warning=notes.append)
    check_text("\n".join(notes))
    ours, theirs = (
        np.frombuffer(path.read_bytes(), np.uint8).reshape(-1, 32)
        for path in (tmp_path / "a.splat", FOREIGN / "ply2splat.splat")
    )
    importance = np.exp(stacked(columns, "scale", 3).sum(axis=1)) / (1 + np.exp(-columns["opacity"]))
    theirs = theirs[np.argsort(-importance)]
    np.testing.assert_allclose(ours[:, :24].copy().view("<f4"), theirs[:, :24].copy().view("<f4"), rtol=1e-6)
    steps = ours[:, 24:].astype(int) - theirs[:, 24:]
    assert steps.min() >= 0 and steps.max() <= 1


@pytest.mark.parametrize("dimensions", [2, 3])
def test_splat_keeps_splats(tmp_path, dimensions):
    cloud = make_gaussians(dimensions=dimensions, degree=0)
    turns = np.random.default_rng(0).normal(size=(5, 4))
    turned = Cloud(cloud.points, attributes=cloud.attributes | {f"rot_{k}": turns[:, k] for k in range(4)})
    write_cloud(tmp_path / "a.splat", turned, on_warning=lambda _: None)
    result = read_cloud(tmp_path / "a.splat")
    result = result.select(np.argsort(result.points[:, 0]))
    np.testing.assert_array_equal(result.points, cloud.points)  # whole numbers
    before, after = splat_model(cloud), splat_model(result)
    np.testing.assert_allclose(after.opacities, before.opacities, atol=0.501 / 255)
    np.testing.assert_allclose(after.axes[:, :dimensions], before.axes, rtol=1e-6)  # float32
    cosines = (stacked(result.attributes, "rot", 4) * unit(turns)).sum(axis=1)
    assert cosines.min() > 1 - 4 * (0.5 / 128) ** 2 / 2 - 1e-6  # half a step of each of four numbers


def test_splat_far_from_the_origin(tmp_path):
    splats = make_gaussians()
    for far in (1e39, 5e6):  # beyond float32, and beyond its precision
        with check_error() as caught:
            write_cloud(tmp_path / "a.splat", Cloud(splats.points + far, attributes=splats.attributes))
    assert "--shift -5000006,-5000007,-5000008`" in str(caught.value)
    assert not (tmp_path / "a.splat").exists()


def test_shifted_splats_stay_splats(tmp_path, run):
    splats = make_gaussians()
    far = Cloud(splats.points + 5e6, attributes=splats.attributes, crs="EPSG:32632", unit="m")
    write_cloud(tmp_path / "a.ply", far)
    shifted = ["--shift", "-5000000,-5000000,-5000001"]
    code, _, err = run("convert", str(tmp_path / "a.ply"), str(tmp_path / "a.splat"), *shifted)
    assert code == 0
    check_text(err)
    cloud = read_cloud(tmp_path / "a.splat")
    np.testing.assert_array_equal(np.sort(cloud.points, axis=0), splats.points - [0, 0, 1])
    assert len(splat_model(cloud).opacities) == 5
    err = run("convert", str(tmp_path / "a.ply"), str(tmp_path / "b.ply"), "--shift", "1e12,0,0")[2]
    assert "rounded to 0.00012" in err
    for wrong in ("1,2", "1,2,nan"):
        assert run("convert", str(tmp_path / "a.ply"), str(tmp_path / "b.ply"), "--shift", wrong)[0] == 2


@pytest.mark.parametrize("version", [1, 2, 3])
def test_versions_of_spz(tmp_path, version):
    """Its axes are x right, y up, z back: y and z have the other sign in PLY, and so have odd harmonics in them."""
    (tmp_path / "a.spz").write_bytes(packed_spz(version, degree=1))
    cloud = read_cloud(tmp_path / "a.spz")
    assert cloud.points.tolist() == [[1, -2, -3], [-1, 2, 3]]
    model = splat_model(cloud)
    np.testing.assert_allclose(np.log(model.axes), [[0, -1, -2], [-10, 5.9375, -9.9375]], atol=1e-6)
    np.testing.assert_allclose(model.opacities, [1, 0.2], atol=0.0011)  # a quarter of a step of 1 / 255 from 1
    np.testing.assert_allclose(
        stacked(cloud.attributes, "f_dc", 3)[0], [(k / 255 - 0.5) / 0.15 for k in (128, 0, 255)], rtol=1e-6
    )
    # 0.07: in versions 1 and 2, bytes have no zero, and w is what is left of a length of 1.
    np.testing.assert_allclose(np.abs(stacked(cloud.attributes, "rot", 4)), [[1, 0, 0, 0], [0, 0, 1, 0]], atol=0.07)
    # Coefficients -1, 0, 1 in y, z, x; red, green, blue of each are adjacent in the file.
    signs = np.array([-1, -1, 1])
    stored = (np.arange(100, 118).reshape(2, 3, 3) - 128) / 128
    harmonics = stacked(cloud.attributes, "f_rest", 9).reshape(2, 3, 3)
    np.testing.assert_allclose(harmonics, (stored * signs[:, None]).transpose(0, 2, 1), atol=1e-6)


def test_spz_is_written_as_its_library_does(tmp_path):
    columns = {name: values.astype(np.float32) for name, values in WRITTEN.SPLATS.items() if len(name) > 2}
    notes = []
    write_cloud(tmp_path / "a.spz", Cloud(WRITTEN.POINTS, attributes=columns), on_warning=notes.append)
    ours, theirs = (gzip.decompress(path.read_bytes()) for path in (tmp_path / "a.spz", FOREIGN / "playcanvas_3.spz"))
    assert ours == theirs
    check_text("\n".join(notes))


@pytest.mark.parametrize(("degree", "dimensions"), [(0, 3), (1, 3), (2, 3), (3, 3), (3, 2)])
def test_spz_keeps_splats(tmp_path, degree, dimensions):
    cloud = make_gaussians(dimensions=dimensions, degree=degree)
    write_cloud(tmp_path / "a.spz", cloud, on_warning=lambda _: None)
    result = read_cloud(tmp_path / "a.spz")
    np.testing.assert_array_equal(result.points, cloud.points)  # whole numbers
    before, after = splat_model(cloud), splat_model(result)
    assert after.sh_degree == degree
    np.testing.assert_allclose(after.opacities, before.opacities, atol=0.501 / 255)
    np.testing.assert_allclose(np.log(after.axes[:, :dimensions]), np.log(before.axes), atol=1 / 32 + 1e-6)
    np.testing.assert_allclose(stacked(result.attributes, "f_dc", 3), 0.5, atol=0.5 / 255 / 0.15)


def test_what_is_lost_is_said(tmp_path):
    splats = make_gaussians(degree=4)
    cloud = Cloud(splats.points, splats.points, None, {**splats.attributes, "label": np.arange(5)}, "EPSG:32632", "m")
    notes = []
    for name in ("a.spz", "a.splat"):
        write_cloud(tmp_path / name, cloud, on_warning=notes.append)
    check_text("\n".join(notes))
    assert splat_model(read_cloud(tmp_path / "a.spz")).sh_degree == 3


def test_spz_far_from_the_origin(tmp_path):
    splats = make_gaussians()
    write_cloud(tmp_path / "a.spz", Cloud(splats.points + 9e4, attributes=splats.attributes), on_warning=lambda _: None)
    np.testing.assert_allclose(read_cloud(tmp_path / "a.spz").points, splats.points + 9e4, atol=1 / 128)
    edge = Cloud(np.full_like(splats.points, 2048 - 1e-5), attributes=splats.attributes)  # would round to 2^23 steps
    write_cloud(tmp_path / "a.spz", edge, on_warning=lambda _: None)
    np.testing.assert_allclose(read_cloud(tmp_path / "a.spz").points, edge.points, atol=2**-12)
    for far in (5e6, 1e8):
        with check_error():
            write_cloud(tmp_path / "b.spz", Cloud(splats.points + far, attributes=splats.attributes))
    assert not (tmp_path / "b.spz").exists()


@pytest.mark.parametrize("name", ["a.splat", "a.spz"])
def test_other_clouds_are_not_written_as_splats(tmp_path, name):
    splats = make_gaussians()
    moved = {name: values for name, values in splats.attributes.items() if not name.startswith(("rot_", "scale_"))}
    for attributes in ({}, moved):
        with check_error():
            write_cloud(tmp_path / name, Cloud(splats.points, attributes=attributes))


@pytest.mark.parametrize("name", ["a.splat", "a.spz"])
def test_values_that_are_not_finite(tmp_path, name):
    splats = make_gaussians()
    damaged = {name: np.array([np.nan, np.inf, -np.inf, *values[3:]]) for name, values in splats.attributes.items()}
    write_cloud(tmp_path / name, Cloud(splats.points, attributes=damaged), on_warning=lambda _: None)
    points = read_cloud(tmp_path / name).points
    np.testing.assert_array_equal(points[np.argsort(points[:, 0])], splats.points)


def test_rows_of_splat_that_are_not_finite(tmp_path):
    rows = np.frombuffer(SPLAT_ROW * 3, "<f4").reshape(3, 8).copy()
    rows[0, 0], rows[1, 4] = np.nan, np.inf
    (tmp_path / "a.splat").write_bytes(rows.tobytes())
    with pytest.warns(UserWarning, match="dropped 1 of 3 points"):
        assert len(read_cloud(tmp_path / "a.splat")) == 2


def test_extensions_of_spz_are_left_out(tmp_path):
    (tmp_path / "a.spz").write_bytes(packed_spz(3, flags=2, extra=struct.pack("<II3f", 0xADBE0002, 12, 0, 1, 2)))
    with pytest.warns(UserWarning, match="left out extensions"):
        assert len(read_cloud(tmp_path / "a.spz")) == 2


SPZ = {
    "empty header": gzip.compress(b""),
    "magic": packed_spz(3, magic=1),
    "version 5": packed_spz(5),
    "version 4 in gzip": packed_spz(4),
    "no splats": packed_spz(3, count=0),
    "2^31 splats": packed_spz(3, count=2**31),
    "five splats": packed_spz(3, count=5),
    "degree": packed_spz(3, degree=5),
    "fractional bits": gzip.compress(spz(3)[:13] + b"\xff" + spz(3)[14:]),
    "cut in the stream": packed_spz(3, degree=3)[:-20],
    "without checksum": packed_spz(3)[:-8],
    "checksum": packed_spz(3)[:-8] + bytes(8),
    "no gzip": b"\x1f\x8b" + bytes(30),
    "other file": b"ply\nformat ascii 1.0\n",
    "bomb": gzip.compress(spz(3, count=2**21) + bytes(42 << 20)),
    "version 4, header": struct.pack("<IIIBBBB", 0x5053474E, 4, 2, 0, 12, 0, 5),
    "version 4, 2^32 splats": struct.pack("<IIIBBBBI12x", 0x5053474E, 4, 2**32 - 1, 0, 12, 0, 5, 32) + bytes(80),
}


@pytest.mark.parametrize("name", SPZ)
def test_damaged_spz(tmp_path, name):
    refusal(tmp_path / "a.spz", SPZ[name])


@pytest.mark.parametrize(
    "data",
    [SPLAT_ROW[:-1], SPLAT_ROW + b"1234", b"ply\n" + bytes(28), struct.pack("<6f8x", 1, 2, 3, -1, 1, 1)],
    ids=["truncated", "half a row", "PLY", "negative axis"],
)
def test_damaged_splat(tmp_path, data):
    refusal(tmp_path / "a.splat", data)


KSPLAT = {
    "short": bytes(4000),
    "version": ksplat(0, changes={0: 1}),
    "level 3": ksplat(0, changes={20: 3}),
    "2^31 sections": ksplat(0, changes={4: 2**31}),
    "2^31 splats": ksplat(0, changes={4096: 2**31, 4100: 2**31}),
    "more splats than places": ksplat(0, changes={4096: 9}),
    "2^31 buckets": ksplat(1, changes={4108: 2**31}),
    "2^31 full buckets": ksplat(1, changes={4128: 2**31}),
    "2^31 partial buckets": ksplat(1, changes={4132: 2**31}),
    "no buckets": ksplat(1, changes={4108: 0, 4116: 0}),
    "degree": ksplat(0, changes={4136: 7}),
    "no splats": ksplat(0, changes={4096: 0}),
    "cut": ksplat(2, changes={})[:-10],
}


@pytest.mark.parametrize("name", KSPLAT)
def test_damaged_ksplat(tmp_path, name):
    refusal(tmp_path / "a.ksplat", KSPLAT[name])


RANGES = [f"float {end}_{name}" for end in ("min", "max") for name in ("x", "y", "z", "scale_x", "scale_y", "scale_z")]
PACKED = ["uint packed_position", "uint packed_rotation", "uint packed_scale", "uint packed_color"]
CHUNK = (-1.0, -2.0, -3.0, -5.0, -6.0, -7.0, 1.0, 2.0, 3.0, -4.0, -3.0, -2.0)
CORNER = (2**32 - 1, 3 << 30 | 0x1FF7FDFF, 0, 0xFF00807F)


@pytest.mark.parametrize("form", ["ascii", "binary_little_endian", "binary_big_endian"])
def test_packed_ply_without_ranges_of_colours(tmp_path, form):
    (tmp_path / "a.ply").write_bytes(ply(form, ("chunk", RANGES, [CHUNK]), ("vertex", PACKED, [CORNER])))
    cloud = read_cloud(tmp_path / "a.ply")
    assert (cloud.points.tolist(), cloud.colors.tolist()) == ([[1, 2, 3]], [[255, 0, 128]])
    model = splat_model(cloud)
    np.testing.assert_allclose(np.log(model.axes), [[-5, -6, -7]], atol=1e-6)
    np.testing.assert_allclose(model.opacities, [127 / 255], rtol=1e-6)
    np.testing.assert_allclose(stacked(cloud.attributes, "rot", 4), [[0, 0, 0, 1]], atol=1e-3)  # 10 bits have no zero


HARMONICS = [f"uchar f_rest_{k}" for k in range(9)]
PACKED_PLY = {
    "one range": (("chunk", RANGES[:1], [CHUNK[:1]]), ("vertex", PACKED, [CORNER])),
    "no chunks": (("vertex", PACKED, [CORNER]),),
    "two chunks": (("chunk", RANGES, [CHUNK] * 2), ("vertex", PACKED, [CORNER])),
    "too few chunks": (("chunk", RANGES, [CHUNK]), ("vertex", PACKED, [CORNER] * 257)),
    "floats": (("chunk", RANGES, [CHUNK]), ("vertex", [p.replace("uint", "float") for p in PACKED], [CORNER])),
    "no splats": (("chunk", RANGES, []), ("vertex", PACKED, [])),
    "harmonics of other splats": (
        ("chunk", RANGES, [CHUNK]), ("vertex", PACKED, [CORNER]), ("sh", HARMONICS, [tuple(range(9))] * 2)
    ),
    "a harmonic twice": (
        ("chunk", RANGES, [CHUNK]), ("vertex", PACKED, [CORNER]),
        ("sh", [*HARMONICS[1:], "uchar f_rest_1"], [tuple(range(9))]),
    ),
    "two harmonics": (("chunk", RANGES, [CHUNK]), ("vertex", PACKED, [CORNER]), ("sh", HARMONICS[:2], [(1, 2)])),
}  # fmt: skip


@pytest.mark.parametrize("name", PACKED_PLY)
def test_damaged_packed_ply(tmp_path, name):
    refusal(tmp_path / "a.ply", ply("binary_little_endian", *PACKED_PLY[name]))


def test_colours_of_splats_in_ply(tmp_path):
    properties = [*XYZ, "float f_dc_0", "float f_dc_1", "float f_dc_2"]
    rows = [(0.0, 0.0, 0.0, 0.5 / SH_DC, 0.0, -9.0), (1.0, 0.0, 0.0, float("nan"), 0.1 / SH_DC, -0.5 / SH_DC)]
    (tmp_path / "a.ply").write_bytes(ply("binary_little_endian", ("vertex", properties, rows)))
    assert read_cloud(tmp_path / "a.ply").colors.tolist() == [[255, 128, 0], [0, 153, 0]]
