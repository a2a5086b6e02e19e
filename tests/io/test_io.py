"""Reading and writing by extension, refused files, and cleanup after failed writes."""

import os
import subprocess
import sys
import warnings
from pathlib import Path

import numpy as np
import pytest
from data_folder import data_folder
from ply_bytes import XYZ, corpus, ply, points
from refusals import refusal
from wording import check_error, check_text

import pcbench
from pcbench.errors import InputError
from pcbench.geometry.cloud import Cloud
from pcbench.io import read_cloud, write_cloud
from pcbench.io.meshes import read_mesh
from pcbench.scratch import atomic_write

NAN = float("nan")
HEADER_START = "ply\nformat binary_little_endian 1.0\n"
VERTEX_HEADER = HEADER_START + "element vertex {}\nproperty float x\nproperty float y\nproperty float z\n{}end_header\n"
PLAIN_PLY = {form: corpus()[f"{form} plain"] for form in ("ascii", "binary_little_endian")}
FACES = ("face", ["list uchar int i"], [((0, 1, 2),)] * 4)


@pytest.mark.parametrize("extension", [".ply", ".npz", ".PLY", ".Npz"])
def test_round_trip_by_extension(tmp_path, extension):
    rng = np.random.default_rng(1)
    cloud = Cloud(
        rng.normal(size=(50, 3)) * 1e6,
        colors=rng.integers(0, 256, (50, 3), dtype=np.uint8),
        attributes={"intensity": rng.normal(size=50)},
        crs="EPSG:32617",
        unit="m",
    )
    path = tmp_path / f"cloud{extension}"
    write_cloud(path, cloud)
    result = read_cloud(str(path))
    np.testing.assert_array_equal(result.points, cloud.points)
    np.testing.assert_array_equal(result.colors, cloud.colors)
    np.testing.assert_array_equal(result.attributes["intensity"], cloud.attributes["intensity"])
    assert (result.crs, result.unit, result.normals) == ("EPSG:32617", "m", None)
    assert [p.name for p in tmp_path.iterdir()] == [path.name]


def test_public_names():
    assert pcbench.read_cloud is read_cloud
    assert pcbench.write_cloud is write_cloud


@pytest.mark.parametrize("name", ["small_gicp", "dmetric"])
def test_point_counts_of_real_files(name):
    paths = sorted(data_folder(name).glob("*.ply"))
    assert paths
    for path in paths:
        cloud = read_cloud(path)
        vertex_line = next(line for line in path.read_bytes().split(b"\n") if line.startswith(b"element vertex"))
        assert len(cloud) == int(vertex_line.split()[-1])
        assert np.abs(cloud.points).max() < 1e4


# ---- NaN and Inf ----


def test_points_that_are_not_finite_are_dropped_and_counted(tmp_path):
    path = tmp_path / "a.ply"
    rows = [(NAN, 0.0, 0.0, 1), (1.0, 2.0, 3.0, 2), (0.0, float("inf"), 0.0, 3), (4.0, 5.0, 6.0, 4)]
    path.write_bytes(ply("binary_little_endian", ("vertex", [*XYZ, "int id"], rows)))
    notes = []
    cloud = read_cloud(path, on_warning=notes.append)
    assert notes == [f"{path}: dropped 2 of 4 points with NaN or Inf coordinates"]
    np.testing.assert_array_equal(cloud.points, [[1, 2, 3], [4, 5, 6]])
    np.testing.assert_array_equal(cloud.attributes["id"], [2, 4])
    with pytest.warns(UserWarning) as caught:
        read_cloud(path)
    assert caught[0].filename == __file__


def test_cloud_with_only_nan_is_refused(tmp_path):
    path = tmp_path / "a.ply"
    path.write_bytes(ply("ascii", ("vertex", XYZ, [(NAN, NAN, NAN)] * 3)).replace(b"nan", b"NaN"))
    refusal(path)


@pytest.mark.parametrize(
    ("nulls", "others", "is_warned"), [(200, 1000, True), (99, 1000, False), (200, 500_000, False)]
)
def test_many_points_at_the_origin_are_a_warning(tmp_path, nulls, others, is_warned):
    points = np.concatenate([np.zeros((nulls, 3)), np.random.default_rng(0).normal(size=(others, 3))])
    write_cloud(tmp_path / "scan.ply", points)
    warnings = []
    assert len(read_cloud(tmp_path / "scan.ply", on_warning=warnings.append)) == nulls + others
    assert bool(warnings) == is_warned
    for text in warnings:
        check_text(text)


def test_signalling_nan_gives_no_numpy_warning(tmp_path):
    path = tmp_path / "a.ply"
    path.write_bytes(VERTEX_HEADER.format(2, "").encode() + bytes.fromhex("0100807f") * 3 + bytes(12))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert len(read_cloud(path, on_warning=lambda note: None)) == 1


# ---- unreadable files ----


def test_refuses_paths_that_are_not_files(tmp_path):
    refusal(tmp_path / "none.ply")
    refusal(tmp_path)
    with pytest.raises(InputError, match="NUL"):
        read_cloud(tmp_path / "a\0.ply")
    (tmp_path / "empty.ply").touch()
    refusal(tmp_path / "empty.ply")
    (tmp_path / "file").touch()
    refusal(tmp_path / "file" / "a.ply")
    os.mkfifo(tmp_path / "pipe.ply")
    refusal(tmp_path / "pipe.ply")


@pytest.mark.parametrize("name", ["a.xyz9", "a"])
def test_unknown_extension_lists_supported_extensions(tmp_path, name):
    (tmp_path / name).write_text("1 2 3")
    for message in (refusal(tmp_path / name), write_refusal(tmp_path / name)):
        assert ".ply" in message and ".npz" in message and f"; got {Path(name).suffix or 'none'}: " in message


def write_refusal(path):
    with check_error() as caught:
        write_cloud(path, Cloud(np.zeros((1, 3))))
    return str(caught.value).removeprefix(f"{path}: ")


def test_permission_denied(tmp_path, monkeypatch):
    path = tmp_path / "a.ply"
    path.write_bytes(PLAIN_PLY["ascii"])

    def deny_access(*args, **kwargs):
        raise PermissionError(13, "Permission denied", str(path))

    monkeypatch.setattr(Path, "open", deny_access)  # root ignores the mode bits
    refusal(path)


def test_out_of_memory_gives_a_one_line_error(tmp_path, monkeypatch):
    path = tmp_path / "a.ply"
    path.write_bytes(PLAIN_PLY["ascii"])

    def run_out_of_memory(file):
        raise MemoryError

    monkeypatch.setattr("pcbench.io.ply_body.read_rest", run_out_of_memory)
    refusal(path)


# ---- damaged PLY ----

DAMAGED_HEADERS = {
    "wrong magic": b"LASF" + bytes(200),
    "magic only": b"ply\n",
    "no end": b"ply\nformat ascii 1.0\n",
    "too long": b"ply\n" + b"comment long\n" * 100_000,
    "one long line": b"ply\ncomment " + b"a" * 2_000_000,
    "nul": b"ply\ncomment \0\nend_header\n",
    "not ascii": "ply\nforma\u00e9 ascii 1.0\n".encode("latin-1"),
    "junk": b"ply\nformat ascii 1.0\nhello world\n",
    "no format": b"ply\nelement vertex 1\nproperty float x\nproperty float y\nproperty float z\nend_header\n",
    "two formats": b"ply\nformat ascii 1.0\nformat ascii 1.0\n",
    "format": b"ply\nformat binary 1.0\n",
    "version": b"ply\nformat ascii 2.0\n",
    "negative": VERTEX_HEADER.format(-5, "").encode(),
    "no number": VERTEX_HEADER.format("1e3", "").encode(),
    "overflow": VERTEX_HEADER.format(2**64, "").encode(),
    "absurd": VERTEX_HEADER.format(10**17, "").encode() + bytes(24),
    "type": VERTEX_HEADER.format(1, "property int64 id\n").encode(),
    "list of float length": VERTEX_HEADER.format(1, "property list float int a\n").encode(),
    "half a list": VERTEX_HEADER.format(1, "property list uchar a\n").encode(),
    "orphan": b"ply\nformat ascii 1.0\nproperty float x\n",
    "two vertex elements": VERTEX_HEADER.format(1, "element vertex 2\n").encode(),
    "duplicate": VERTEX_HEADER.format(1, "property float x\n").encode(),
    "no z": (HEADER_START + "element vertex 1\nproperty float x\nproperty float y\nend_header\n").encode(),
    "x is a list": VERTEX_HEADER.format(1, "").encode().replace(b"float x", b"list uchar float x"),
    "no vertex": (HEADER_START + "element face 0\nelement edge 0\nend_header\n").encode(),
    "no element": (HEADER_START + "end_header\n").encode(),
    "no points": VERTEX_HEADER.format(0, "").encode(),
    "header and no body": VERTEX_HEADER.format(9, "").encode(),
    "header cut at its end": VERTEX_HEADER.format(9, "").encode().rstrip(),
}  # fmt: skip

LIST_VERTICES = ("vertex", [*XYZ, "list uchar uint v"], [(*p, tuple(range(i % 3))) for i, p in enumerate(points(6))])
LIST_AND_ID_VERTICES = ("vertex", [*LIST_VERTICES[1], "short id"], [(*row, 7) for row in LIST_VERTICES[2]])
MESH_PLY = {form: ply(form, ("vertex", XYZ, points(4)), FACES) for form in ("ascii", "binary_big_endian")}
NEGATIVE_LIST = ply("binary_little_endian", ("vertex", [*XYZ, "list char int v"], [(1.0, 2.0, 3.0, ())]))[:-1] + b"\xff"
ASCII_HEADER = b"ply\nformat ascii 1.0\nelement vertex 2\nproperty float x\nproperty float y\nproperty float z\n"
DAMAGED_BODIES = {
    "truncated": PLAIN_PLY["binary_little_endian"][:-120],
    "truncated inside a row": PLAIN_PLY["binary_little_endian"][:-1],
    "truncated ascii": b"\n".join(PLAIN_PLY["ascii"].split(b"\n")[:17]),
    "truncated lists": ply("binary_big_endian", LIST_VERTICES)[:-1],
    "truncated after a list": ply("binary_big_endian", LIST_AND_ID_VERTICES)[:-1],
    "truncated faces": MESH_PLY["binary_big_endian"][:-14],
    "truncated ascii faces": MESH_PLY["ascii"][:-9],
    "truncated unknown": ply("binary_big_endian", ("box", ["int a"], [(1,)]))[:-2].replace(
        b"end_header", b"element vertex 1\nproperty int x\nproperty int y\nproperty int z\nend_header"),
    "negative list": NEGATIVE_LIST,
    "short line": ASCII_HEADER + b"end_header\n1 2 3\n4 5\n",
    "long lines": ASCII_HEADER + b"end_header\n1 2 3 4\n4 5 6 7\n",
    "word": ASCII_HEADER + b"end_header\n1 2 3\n4 five 6\n",
    "underscore": ASCII_HEADER + b"end_header\n1 2 3\n4 5_0 6\n",
    "nul in ascii": ASCII_HEADER + b"end_header\n1 2 3\n4 5\0 6\n",
    "not ascii": ASCII_HEADER + b"end_header\n1 2 3\n4 5\xe9 6\n",
    "uchar 300": ASCII_HEADER + b"property uchar a\nend_header\n1 2 3 4\n4 5 6 300\n",
    "fraction": ASCII_HEADER + b"property int id\nend_header\n1 2 3 4.5\n4 5 6 3\n",
    "nan integer": ASCII_HEADER + b"property int id\nend_header\n1 2 3 nan\n4 5 6 3\n",
    "ascii list": ASCII_HEADER + b"property list uchar int v\nend_header\n1 2 3 0\n4 5 6 3 1 2\n",
    "negative ascii": ASCII_HEADER + b"property list char int v\nend_header\n1 2 3 0\n4 5 6 -1\n",
}  # fmt: skip


@pytest.mark.parametrize("name", [*DAMAGED_HEADERS, *DAMAGED_BODIES])
def test_damaged_ply(tmp_path, name):
    refusal(tmp_path / "a.ply", {**DAMAGED_HEADERS, **DAMAGED_BODIES}[name])


# ---- atomic writing ----


def test_failed_write_keeps_existing_file(tmp_path):
    path = tmp_path / "a.bin"
    path.write_bytes(b"old")
    with pytest.raises(KeyboardInterrupt):
        with atomic_write(path) as file:
            file.write(b"new")
            raise KeyboardInterrupt
    assert path.read_bytes() == b"old"
    assert [p.name for p in tmp_path.iterdir()] == ["a.bin"]


def test_write_follows_links_and_umask(tmp_path):
    (tmp_path / "real").mkdir()
    link = tmp_path / "a.npy"
    link.symlink_to(tmp_path / "real" / "b.npy")
    write_cloud(link, Cloud(np.ones((2, 3))))
    assert link.is_symlink()
    assert np.load(tmp_path / "real" / "b.npy").shape == (2, 3)
    new_file = tmp_path / "plain"
    new_file.touch()
    assert (tmp_path / "real" / "b.npy").stat().st_mode == new_file.stat().st_mode


def test_write_errors_are_os_errors(tmp_path):
    cloud = Cloud(np.ones((2, 3)))
    with pytest.raises(FileNotFoundError):
        write_cloud(tmp_path / "none" / "a.ply", cloud)
    (tmp_path / "folder.ply").mkdir()
    with pytest.raises(OSError, match="it is a folder or a device"):
        write_cloud(tmp_path / "folder.ply", cloud)
    assert [p.name for p in tmp_path.iterdir()] == ["folder.ply"]


FULL_DISK_SCRIPT = """
import resource, sys
import numpy as np
from pcbench.geometry.cloud import Cloud
from pcbench.io import write_cloud
resource.setrlimit(resource.RLIMIT_FSIZE, (100_000, 100_000))
try:
    write_cloud(sys.argv[1], Cloud(np.ones((100_000, 3))))
except OSError as error:
    sys.exit(0 if error.strerror else "an OSError without its reason")
sys.exit("written past the limit")
"""


@pytest.mark.parametrize("name", ["a.ply", "a.npy", "a.npz"])
def test_full_disk_keeps_the_existing_file(tmp_path, name):
    write_cloud(tmp_path / name, Cloud(np.zeros((5, 3))))
    old_bytes = (tmp_path / name).read_bytes()
    subprocess.run([sys.executable, "-c", FULL_DISK_SCRIPT, str(tmp_path / name)], check=True, timeout=60)
    assert (tmp_path / name).read_bytes() == old_bytes
    assert [p.name for p in tmp_path.iterdir()] == [name]


@pytest.mark.parametrize("call", [read_cloud, lambda path: write_cloud(path, np.zeros((1, 3))), read_mesh])
@pytest.mark.parametrize("path", [None, 3, b"a.ply"])
def test_arguments_that_are_not_paths_are_refused(call, path):
    with check_error():
        call(path)
