"""NumPy files: supported and refused arrays; damaged files raise only InputError."""

import io
import random
import warnings
import zipfile

import numpy as np
import pytest
from ply_bytes import damage
from refusals import refusal
from wording import check_error

from pcbench.errors import InputError
from pcbench.geometry.cloud import Cloud
from pcbench.io import read_cloud, write_cloud


def npy_bytes(array, version=None):
    buffer = io.BytesIO()
    np.lib.format.write_array(buffer, np.asarray(array), version=version)
    return buffer.getvalue()


def npz_bytes(**arrays):
    return zip_bytes({f"{name}.npy": npy_bytes(array) for name, array in arrays.items()})


def zip_bytes(members, compression=zipfile.ZIP_STORED):
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w", compression) as file:
        for name, data in members.items():
            file.writestr(name, data)
    return buffer.getvalue()


def npy_header(descr="'<f8'", shape="(4, 3)"):
    text = f"{{'descr': {descr}, 'fortran_order': False, 'shape': {shape}, }}\n".encode()
    return b"\x93NUMPY\x01\x00" + len(text).to_bytes(2, "little") + text


# ---- npy ----


@pytest.mark.parametrize("dtype", ["<f2", "<f4", ">f4", "<f8", ">f8", "<i1", "<u2", ">i4", "<i8"])
@pytest.mark.parametrize("order", ["C", "F"])
@pytest.mark.parametrize("version", [(1, 0), (2, 0)])
def test_npy_types_and_orders(tmp_path, dtype, order, version):
    points = np.array(np.arange(12).reshape(4, 3), dtype=dtype, order=order)
    (tmp_path / "a.npy").write_bytes(npy_bytes(points, version))
    cloud = read_cloud(tmp_path / "a.npy")
    np.testing.assert_array_equal(cloud.points, np.arange(12).reshape(4, 3))
    assert cloud.normals is None
    assert cloud.points.flags.c_contiguous and cloud.points.flags.aligned


def test_npy_with_normals(tmp_path):
    np.save(tmp_path / "a.npy", np.arange(12.0).reshape(2, 6) / 2)
    cloud = read_cloud(tmp_path / "a.npy")
    assert cloud.points.tolist() == [[0, 0.5, 1], [3, 3.5, 4]]
    assert cloud.normals.tolist() == [[1.5, 2, 2.5], [4.5, 5, 5.5]]


def test_npy_with_colors(tmp_path):
    np.save(tmp_path / "a.npy", np.array([[0.5, 1, 2, 255, 0, 7]]))
    assert read_cloud(tmp_path / "a.npy").colors.tolist() == [[255, 0, 7]]


def test_npy_drops_nan(tmp_path):
    np.save(tmp_path / "a.npy", np.array([[1, 2, 3], [np.nan, 0, 0]], dtype=np.float32))
    with pytest.warns(UserWarning):
        assert read_cloud(tmp_path / "a.npy").points.tolist() == [[1, 2, 3]]


def test_numpy_reads_written_npy(tmp_path):
    points = np.random.default_rng(5).normal(size=(7, 3))
    with pytest.warns(UserWarning, match=r"left out what \.npy cannot store: the normals"):
        write_cloud(tmp_path / "a.npy", Cloud(points, normals=points))
    np.testing.assert_array_equal(np.load(tmp_path / "a.npy", allow_pickle=False), points)
    np.testing.assert_array_equal(read_cloud(tmp_path / "a.npy").points, points)


def test_six_columns_with_colors_or_normals(tmp_path):
    path, points = tmp_path / "a.npy", np.arange(12.0).reshape(4, 3)
    normals = np.array([[0, 0, 1.0], [0, 0, 0], [0.6, 0.8, 0], [1, 0, 0]])
    colors = np.array([[0.1, 0.2, 0.3], [1, 1, 1], [0, 0, 1], [0.5, 0.5, 0]])
    path.write_bytes(npy_bytes(np.hstack([points, normals])))
    np.testing.assert_array_equal(read_cloud(path).normals, normals)
    for scale in (1, 255, 65535):
        path.write_bytes(npy_bytes(np.hstack([points, np.rint(colors * scale) if scale > 1 else colors])))
        assert read_cloud(path).normals is None
        np.testing.assert_allclose(read_cloud(path).colors, colors * 255, atol=1)  # whole numbers


def test_four_columns_have_intensity(tmp_path):
    rows = np.array([[1, 2, 3, 40], [5, 6, 7, 80]], dtype=np.float32)
    np.save(tmp_path / "a.npy", rows)
    np.savez(tmp_path / "a.npz", points=rows, ring=np.arange(2))
    for name in ("a.npy", "a.npz"):
        cloud = read_cloud(tmp_path / name)
        np.testing.assert_array_equal(cloud.points, rows[:, :3])
        assert cloud.attributes["intensity"].tolist() == [40, 80]
        assert cloud.attributes["intensity"].dtype == np.float32
    assert cloud.attributes["ring"].tolist() == [0, 1]


def test_columns_by_name(tmp_path):
    columns = {"X": np.arange(2.0), "Y": np.array([3, 4], ">i4"), "z": np.array([5.5, 6], "f4")}
    columns |= {"R": np.array([0.2, 1]), "G": np.zeros(2), "B": np.ones(2), "Classification": np.array([2, 6], "u1")}
    records = np.empty(2, [(name, column.dtype) for name, column in columns.items()])
    for name, column in columns.items():
        records[name] = column
    np.save(tmp_path / "a.npy", records)
    np.savez(tmp_path / "a.npz", **columns)
    for name in ("a.npy", "a.npz"):
        cloud = read_cloud(tmp_path / name)
        assert cloud.points.tolist() == [[0, 3, 5.5], [1, 4, 6]]
        assert cloud.colors.tolist() == [[51, 0, 255], [255, 0, 255]]
        assert {key: values.tolist() for key, values in cloud.attributes.items()} == {"classification": [2, 6]}


POINTS = np.arange(12.0).reshape(4, 3)
DAMAGED_NPY = {
    "magic": b"ply\n" + bytes(40),
    "version": b"\x93NUMPY\x03\x00" + npy_bytes(POINTS)[8:],
    "no header": npy_bytes(POINTS)[:9],
    "half a header": npy_bytes(POINTS)[:60],
    "huge header": b"\x93NUMPY\x02\x00\xff\xff\xff\xff",
    "no dictionary": b"\x93NUMPY\x01\x00\x04\x00abc\n",
    "truncated": npy_bytes(POINTS)[:-30],
    "absurd": npy_header(shape=f"({10**17}, 3)"),
    "overflow": npy_header(shape=f"({2**64}, 3)"),
    "negative": npy_header(shape="(-4, 3)"),
    "pickle": npy_header("'|O'"),
    "text": npy_header("'<U5'"),
    "complex": npy_header("'<c16'"),
    "odd float": npy_header("'<f3'"),
    "deep": npy_header(shape="(" * 9000),  # may crash Python's parser
    "signs": npy_header(shape="-" * 9000 + "4"),
    "sum": npy_header(shape="1+" * 4500 + "1"),
    "digits": npy_header(shape=f"({'9' * 9000}, 3)"),
    "fields": npy_header("[('x', '<f8'), ('y', '<f8')]"),
    "records": npy_header("[('x', '<f8')]"),
    "text field": npy_header("[('x', '<f8'), ('y', '<f8'), ('z', '<f8'), ('a', '<U5')]"),
    "rows of fields": npy_header("[('x', '<f8'), ('y', '<f8'), ('z', '<f8')]", shape="(4, 3)"),
    "rows of rows": npy_header("'(2,)<f8'"),
    "bool": npy_bytes(np.ones((4, 3), bool)),
    "flat": npy_bytes(np.arange(12.0)),
    "wide": npy_bytes(np.zeros((3, 5))),
    "no points": npy_bytes(np.zeros((0, 3))),
    "nan": npy_bytes(np.full((2, 3), np.nan)),
}


@pytest.mark.parametrize("name", DAMAGED_NPY)
def test_damaged_npy(tmp_path, name):
    refusal(tmp_path / "a.npy", DAMAGED_NPY[name])


# ---- npz ----


def test_npz_stores_all_data(tmp_path):
    rng = np.random.default_rng(7)
    cloud = Cloud(
        rng.normal(size=(9, 3)),
        normals=rng.normal(size=(9, 3)),
        colors=rng.integers(0, 256, (9, 3), dtype=np.uint8),
        attributes={
            "time ns": rng.integers(2**60, 2**62, 9),
            "file": rng.random(9) < 0.5,
            "q": np.arange(9, dtype=">f4"),
        },
        crs='PROJCRS["Höhe",\n  ID["EPSG",32617]]',
        unit="US survey foot",
    )
    path = tmp_path / "a.npz"
    write_cloud(path, cloud)
    result = read_cloud(path)
    for name in ("points", "normals", "colors"):
        np.testing.assert_array_equal(getattr(result, name), getattr(cloud, name))
    assert list(result.attributes) == list(cloud.attributes)
    for name, values in cloud.attributes.items():
        np.testing.assert_array_equal(result.attributes[name], values)
        assert result.attributes[name].dtype == values.dtype.newbyteorder("=")
    assert (result.crs, result.unit) == (cloud.crs, cloud.unit)
    with np.load(path, allow_pickle=False) as arrays:
        np.testing.assert_array_equal(arrays["points"], cloud.points)
        assert str(arrays["crs"]) == cloud.crs
    first_bytes = path.read_bytes()
    write_cloud(path, cloud)
    assert path.read_bytes() == first_bytes


@pytest.mark.parametrize("save", [np.savez, np.savez_compressed])
def test_npz_written_by_numpy(tmp_path, save):
    save(tmp_path / "a.npz", points=POINTS.astype(np.float32), gps=np.arange(4))
    cloud = read_cloud(tmp_path / "a.npz")
    np.testing.assert_array_equal(cloud.points, POINTS)
    assert cloud.attributes["gps"].tolist() == [0, 1, 2, 3]


def test_npz_of_a_single_array(tmp_path):
    np.savez(tmp_path / "a.npz", np.hstack([POINTS, POINTS - 0.5]))
    cloud = read_cloud(tmp_path / "a.npz")
    np.testing.assert_array_equal(cloud.normals, POINTS - 0.5)
    np.savez(tmp_path / "a.npz", xyz=POINTS, unit="m", crs="")
    cloud = read_cloud(tmp_path / "a.npz")
    np.testing.assert_array_equal(cloud.points, POINTS)
    assert (cloud.unit, cloud.crs) == ("m", None)


def test_npz_arrays_of_other_shapes_are_left_out(tmp_path):
    path = tmp_path / "a.npz"
    np.savez(path, points=POINTS, K=np.eye(3))
    notes = []
    assert not read_cloud(path, on_warning=notes.append).attributes
    assert notes == [f"{path}: left out 'K': expected an attribute of shape (4,), got (3, 3)"]


LARGE_NPY = npy_bytes(np.zeros((4_000_000, 3)))
ENCRYPTED_NPZ = bytearray(npz_bytes(points=POINTS))
ENCRYPTED_NPZ[ENCRYPTED_NPZ.index(b"PK\x01\x02") + 8] |= 1
WRONG_CHECKSUM_NPZ = bytearray(npz_bytes(points=POINTS))
WRONG_CHECKSUM_NPZ[WRONG_CHECKSUM_NPZ.index(npy_bytes(POINTS)[-20:]) + 3] ^= 1
DAMAGED_NPZ = {
    "no zip": b"ply\n" + bytes(100),
    "truncated": npz_bytes(points=POINTS)[:-30],
    "check sum": bytes(WRONG_CHECKSUM_NPZ),
    "encrypted": bytes(ENCRYPTED_NPZ),
    "empty": zip_bytes({}),
    "no points": npz_bytes(a=POINTS, b=POINTS),
    "columns of two lengths": npz_bytes(x=POINTS[:, 0], y=POINTS[:, 0], z=POINTS[:3, 0]),
    "columns and a matrix": npz_bytes(x=POINTS[:, 0], y=POINTS[:, 0], z=POINTS[:, 0], faces=POINTS),
    "empty columns": npz_bytes(**dict.fromkeys("xyz", POINTS[:0, 0])),
    "records": npz_bytes(points=np.zeros(4, [(name, "f8") for name in "xyz"])),
    "no array": zip_bytes({"readme.txt": b"hello"}),
    "bzip2": zip_bytes({"points.npy": npy_bytes(POINTS)}, zipfile.ZIP_BZIP2),
    "shape and size": zip_bytes({"points.npy": npy_header(shape="(10000000, 3)")}),
    "trailing": zip_bytes({"points.npy": npy_bytes(POINTS) + b"a" * 24}),
    "pickle": npz_bytes(points=POINTS, a=np.array([{}] * 4)),
    "normals": npz_bytes(points=POINTS, normals=POINTS[:2]),
    "colors": npz_bytes(points=POINTS, colors=POINTS - 9),
    "crs": npz_bytes(points=POINTS, crs=np.arange(4)),
    "unit": npz_bytes(points=POINTS, unit=np.array(["m", "m"])),
    "no code point": zip_bytes({"points.npy": npy_bytes(POINTS), "unit.npy": npy_header("'<U1'", "()") + b"\xff" * 4}),
}


@pytest.mark.parametrize("name", DAMAGED_NPZ)
def test_damaged_npz(tmp_path, name):
    refusal(tmp_path / "a.npz", DAMAGED_NPZ[name])


def test_zip_bomb_is_refused(tmp_path):
    (tmp_path / "a.npz").write_bytes(zip_bytes({"points.npy": LARGE_NPY}, zipfile.ZIP_DEFLATED))
    with pytest.raises(
        InputError, match=f"decompress to {len(LARGE_NPY)} bytes"
    ):  # the compressed size depends on zlib
        read_cloud(tmp_path / "a.npz")


def test_npz_refuses_repeated_array_names(tmp_path):
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w") as file, warnings.catch_warnings():
        warnings.simplefilter("ignore")
        file.writestr("points.npy", npy_bytes(POINTS))
        file.writestr("points.npy", npy_bytes(POINTS))
    refusal(tmp_path / "a.npz", buffer.getvalue())


@pytest.mark.parametrize("values", [["text"], [None]])
def test_npz_refuses_attributes_that_are_not_numbers(tmp_path, values):
    with check_error():
        write_cloud(tmp_path / "a.npz", Cloud(np.zeros((1, 3)), attributes={"a": np.array(values)}))
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("extension", ["npy", "npz"])
def test_damaged_files_raise_only_input_errors(tmp_path, extension):
    """400 damaged files give a cloud or InputError, never another error or a warning."""
    rng = random.Random(11)
    if extension == "npy":
        corpus = [npy_bytes(POINTS), npy_bytes(POINTS.astype("<f4")), npy_bytes(np.arange(24).reshape(4, 6))]
    else:
        members = {
            "points.npy": npy_bytes(POINTS),
            "a.npy": npy_bytes(np.arange(4)),
            "unit.npy": npy_bytes("m"),
            "colors.npy": npy_bytes(np.ones((4, 3), np.uint8)),
        }
        corpus = [zip_bytes(members), zip_bytes(members, zipfile.ZIP_DEFLATED)]
    path = tmp_path / f"a.{extension}"
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        for _ in range(400):
            path.write_bytes(damage(rng.choice(corpus), rng))
            try:
                read_cloud(path, on_warning=lambda note: None)
            except InputError as error:
                assert str(error).startswith(f"{path}: ") and str(error).isprintable()
