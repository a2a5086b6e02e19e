"""LAS, LAZ and COPC: hand-made bytes, comparison with laspy, filters, coordinate systems, damage."""

import os
import struct
import subprocess
import sys
from pathlib import Path

import las_bytes
import numpy as np
import pytest
import refusals
from data_folder import data_folder
from las_bytes import OFFSETS, SCALES, UTM, copc, extra, extras, geo_keys, las, vlr, wkt
from optional import break_library, import_or_skip
from wording import check_error, check_text

from pcbench.errors import MissingExtra
from pcbench.geometry.cloud import Cloud
from pcbench.io import las_header, laz, read_cloud, write_cloud

COMPRESSIONS = pytest.mark.parametrize("compress", [None, "chunks"])


def skip_without_lazrs():
    import_or_skip("lazrs")


def read(tmp_path, data, **options):
    path = tmp_path / "a.las"
    path.write_bytes(data)
    return read_cloud(path, **options)


def read_with_notes(tmp_path, data):
    notes = []
    cloud = read(tmp_path, data, on_warning=notes.append)
    return cloud, [note.removeprefix(f"{tmp_path / 'a.las'}: ") for note in notes]


def refusal(tmp_path, data, **options):
    return refusals.refusal(tmp_path / "a.las", data, **options)


# ---- reading ----


@COMPRESSIONS
@pytest.mark.parametrize("form", list(las_bytes.RECORDS))
def test_point_formats(tmp_path, form, compress):
    if compress:
        skip_without_lazrs()
    count = 200
    cloud = read(tmp_path, las(form, count, compress=compress))
    # Exactly integer * scale + offset, in this order, in float64.
    expected = [
        [v * s + o for v, s, o in zip(las_bytes.integers(i), SCALES, OFFSETS, strict=True)] for i in range(count)
    ]
    np.testing.assert_array_equal(cloud.points, expected)
    attributes = {
        "intensity": np.arange(100, 100 + count, dtype=np.uint16),
        "classification": np.where(np.arange(count) % 2, 2, 6).astype(np.uint8),
        "return_number": (np.arange(count) % 3 + 1).astype(np.uint8),
        "number_of_returns": np.full(count, 3, np.uint8),
        "point_source_id": np.arange(40, 40 + count, dtype=np.uint16),
    }
    if form not in (0, 2):
        attributes["gps_time"] = np.arange(count) + 0.25
    assert cloud.attributes.keys() == attributes.keys()
    for name, values in attributes.items():
        np.testing.assert_array_equal(cloud.attributes[name], values)
        assert cloud.attributes[name].dtype == values.dtype
    if form in (2, 3, 7, 8):
        assert cloud.colors[[1, 199]].tolist() == [[1, 7, 255], [199, 7, 255]]
    else:
        assert cloud.colors is None


@pytest.mark.parametrize("minor", range(5))
def test_versions(tmp_path, minor):
    assert len(read(tmp_path, las(1, 7, minor=minor))) == 7


def test_sizes_of_point_formats():
    laspy = import_or_skip("laspy")
    for number, fields in enumerate(las_header.POINT_FORMATS):
        assert np.dtype(fields).itemsize == laspy.PointFormat(number).size


def test_chunks_of_variable_size(tmp_path):
    skip_without_lazrs()
    (tmp_path / "a.copc.laz").write_bytes(copc(300))
    np.testing.assert_array_equal(read_cloud(tmp_path / "a.copc.laz").points, read(tmp_path, las(7, 300)).points)


def test_extra_bytes(tmp_path):
    descriptions = extras(
        extra(b"plain", 9),
        extra(b"scaled", 3, 8 | 16, b"", 0.5, 10.0),
        extra(b"", 0, 2),
        extra(b"gaps", 6, 1, struct.pack("<q", -1)),
        extra(b"pair", 11),
        extra(b"intensity", 1),
    )
    data = las(0, 4, vlrs=[descriptions],
               tail=lambda i: struct.pack("<fHxxiBBB", i / 4, i, -1 if i == 2 else i, i, 2 * i, 9))  # fmt: skip
    cloud, notes = read_with_notes(tmp_path, data)
    assert notes == ["left out the extra bytes 'intensity': the name is already used or not printable"]
    extra_names = ["plain", "scaled", "gaps", "pair[0]", "pair[1]"]
    assert list(cloud.attributes)[-5:] == extra_names
    assert cloud.attributes["plain"].dtype == np.float32
    assert cloud.attributes["plain"].tolist() == [0, 0.25, 0.5, 0.75]
    assert cloud.attributes["scaled"].tolist() == [10, 10.5, 11, 11.5]
    np.testing.assert_array_equal(cloud.attributes["gaps"], [0, 1, np.nan, 3])
    assert cloud.attributes["pair[0]"].tolist() == [0, 1, 2, 3]
    assert cloud.attributes["pair[1]"].tolist() == [0, 2, 4, 6]


def test_extra_bytes_that_do_not_fit_are_left_out(tmp_path):
    cloud, notes = read_with_notes(tmp_path, las(0, 4, vlrs=[extras(extra(b"a", 10))], tail=lambda i: b"1234"))
    assert notes == ["left out the extra bytes: the descriptions need 8 bytes, a point has 4"]
    assert "a" not in cloud.attributes
    cloud, notes = read_with_notes(tmp_path, las(0, 4, vlrs=[extras(extra(b"a", 31))], tail=lambda i: b"1234"))
    assert notes == ["left out the extra bytes: expected a type from 0 to 30, got 31"]


def test_withheld_points_are_reported(tmp_path):
    data = bytearray(las(0, 4))
    data[227 + 15] |= 128
    cloud, notes = read_with_notes(tmp_path, data)
    assert (len(cloud), notes) == (4, ["kept 1 of 4 points that are marked as withheld"])
    assert cloud.attributes["classification"][0] == 6


@pytest.mark.parametrize("name", ["autzen-bmx-2010", "autzen-bmx-2023", "autzen-thin", "autzen_trim"])
def test_real_files_agree_with_laspy(name):
    laspy = import_or_skip("laspy")
    path = data_folder("autzen") / f"{name}.las"
    cloud, laspy_file = read_cloud(path, on_warning=lambda note: None), laspy.read(path)
    np.testing.assert_array_equal(cloud.points, np.stack([laspy_file.x, laspy_file.y, laspy_file.z], axis=1))
    for dimension, values in cloud.attributes.items():
        np.testing.assert_array_equal(values, laspy_file[dimension])


# ---- filters ----


def test_filters(tmp_path):
    data = las(6, 12)
    full_cloud = read(tmp_path, data)
    return_numbers, classes = full_cloud.attributes["return_number"], full_cloud.attributes["classification"]
    for options, mask in [
        ({"classes": (2,)}, classes == 2),
        ({"classes": [2, 6, 9]}, classes > 0),
        ({"returns": "first"}, return_numbers == 1),
        ({"returns": "last"}, return_numbers == 3),
        ({"returns": (1, 2)}, return_numbers < 3),
        ({"returns": "1,2"}, return_numbers < 3),
        ({"classes": {6}, "returns": "first"}, (classes == 6) & (return_numbers == 1)),
    ]:
        cloud = read(tmp_path, data, **options)
        np.testing.assert_array_equal(cloud.points, full_cloud.points[mask])
        np.testing.assert_array_equal(cloud.attributes["gps_time"], full_cloud.attributes["gps_time"][mask])


def test_filters_without_matches_report_the_contents(tmp_path):
    for options in ({"classes": (9,)}, {"classes": [9], "returns": "last"}):
        message = refusal(tmp_path, las(0, 12), **options)
        assert "class 2 (6 points), class 6 (6 points); return 1 (4 points), return 2 (4 points)" in message


@pytest.mark.parametrize("options", [{"classes": ()}, {"classes": (300,)}, {"classes": 2}, {"classes": ("ground",)}])
def test_invalid_classes_are_refused(tmp_path, options):
    refusal(tmp_path, las(0, 3), **options)


@pytest.mark.parametrize("returns", ["firts", (), (-1,)])
def test_invalid_returns_are_refused(tmp_path, returns):
    refusal(tmp_path, las(0, 3), returns=returns)


def test_filters_are_refused_for_other_formats(tmp_path):
    np.save(tmp_path / "a.npy", np.ones((2, 3)))
    with check_error():
        read_cloud(tmp_path / "a.npy", classes=(2,))


# ---- colours ----


def colored(count, color, classification):
    """Return a LAS file whose points have one colour and one class."""
    data = bytearray(las(7, count, color=1))
    for k in range(count):
        struct.pack_into("<B", data, 375 + 36 * k + 16, classification)
        struct.pack_into("<3H", data, 375 + 36 * k + 30, color, color, color)
    return bytes(data)


@pytest.fixture
def dark_water(tmp_path):
    """A 16-bit file: 50 points of class 9 with the colour 200, and others with 40,000."""
    water, ground = colored(50, 200, 9), colored(150, 40_000, 2)
    data = bytearray(colored(200, 0, 2))
    data[375:] = water[375:] + ground[375:]
    (tmp_path / "a.las").write_bytes(data)
    return tmp_path / "a.las"


def test_filters_do_not_change_colors(dark_water):
    whole = read_cloud(dark_water)
    assert (np.unique(whole.colors).tolist(), whole.stored.color_depth) == ([0, 156], 16)
    for classes in ((9,), (2, 9)):
        cloud = read_cloud(dark_water, classes=classes)
        np.testing.assert_array_equal(cloud.colors, whole.colors[np.isin(whole.attributes["classification"], classes)])


def test_tiles_of_a_cloud_have_one_color_depth(tmp_path):
    (tmp_path / "a.las").write_bytes(colored(20, 40_000, 2))
    (tmp_path / "b.las").write_bytes(colored(20, 200, 9))
    notes = []
    cloud = read_cloud(tmp_path / "*.las", on_warning=notes.append)
    assert cloud.colors[:, 0].tolist() == [156] * 20 + [0] * 20
    assert len(notes) == 1
    check_text(notes[0])
    assert read_cloud(tmp_path / "*.las", classes=(9,), on_warning=notes.append).colors.max() == 0


def test_color_depth_can_be_given(tmp_path):
    (tmp_path / "a.las").write_bytes(colored(20, 200, 9))
    notes = []
    cloud = read_cloud(tmp_path / "a.las", on_warning=notes.append)
    assert (cloud.colors.max(), cloud.stored.color_depth, len(notes)) == (200, 8, 1)
    check_text(notes[0])
    notes.clear()
    assert read_cloud(tmp_path / "a.las", color_depth=16, on_warning=notes.append).colors.max() == 0
    assert read_cloud(tmp_path / "a.las", color_depth=8, on_warning=notes.append).colors.max() == 200
    assert notes == []
    (tmp_path / "a.las").write_bytes(colored(20, 300, 9))
    for depth in (8, 12):
        with check_error():
            read_cloud(tmp_path / "a.las", color_depth=depth)


# ---- coordinate reference systems ----


def read_crs(tmp_path, *vlrs):
    cloud, notes = read_with_notes(tmp_path, las(0, 3, vlrs=vlrs))
    return cloud.crs, cloud.unit, notes


@pytest.mark.parametrize(
    ("record", "crs", "unit"),
    [
        (wkt(UTM), "EPSG:32617", "m"),
        (geo_keys(model=1, projected=32617), "EPSG:32617", "m"),
        (geo_keys(model=1, projected=2992), "EPSG:2992", "ft"),
        (geo_keys(model=1, projected=2256), "EPSG:2256", "ft"),
        (geo_keys(model=1, projected=2225), "EPSG:2225", "US-ft"),
        (geo_keys(model=2, geographic=4326), "EPSG:4326", "deg"),
        (geo_keys(model=1, projected=32617, vertical=5703), "EPSG:32617+5703", "m"),
        (geo_keys(), None, None),
    ],
)
def test_crs(tmp_path, record, crs, unit):
    import_or_skip("pyproj")
    result = read_crs(tmp_path, record)
    assert result[:2] == (crs, unit)


def test_unknown_coordinate_systems_give_warnings(tmp_path):
    import_or_skip("pyproj")
    crs, unit, notes = read_crs(tmp_path, wkt("PROJCS[hello"))
    assert (crs, unit, len(notes)) == (None, None, 1)
    assert notes[0].startswith("could not interpret the coordinate reference system: ")
    crs, unit, notes = read_crs(tmp_path, geo_keys(model=1, projected=32767, unit=9002))
    assert (crs, unit) == (None, "ft")
    assert notes == ["could not interpret the coordinate reference system: its GeoTIFF keys contain no EPSG code"]


def test_crs_without_an_epsg_code_is_unchanged(tmp_path):
    import_or_skip("pyproj")
    text = UTM.replace(',AUTHORITY["EPSG","32617"]', "").replace('central_meridian",-81', 'central_meridian",-80.3')
    assert read_crs(tmp_path, wkt(text))[:2] == (text, "m")


def test_heights_in_another_unit_give_a_warning():
    import_or_skip("pyproj")
    notes = []
    cloud = read_cloud(data_folder("autzen") / "autzen-bmx-2010.las", on_warning=notes.append)
    assert cloud.unit is None  # distances have no single unit
    assert len(notes) == 1
    check_text(notes[0])


def test_without_pyproj(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "pyproj", None)
    assert read_crs(tmp_path, wkt(UTM)) == (UTM, None, [])
    assert read_crs(tmp_path, geo_keys(model=1, projected=2992, unit=9002)) == ("EPSG:2992", "ft", [])
    with check_error(MissingExtra):
        write_cloud(tmp_path / "b.las", Cloud(np.zeros((1, 3)), crs="EPSG:32617"))
    assert not (tmp_path / "b.las").exists()


# ---- damage ----


def patch(data, offset, code, *values):
    data = bytearray(data)
    struct.pack_into(f"<{code}", data, offset, *values)
    return bytes(data)


FORMAT_0, FORMAT_6 = las(0, 10), las(6, 10)
ONE_VLR = las(0, 10, vlrs=[vlr(b"x", 1, b"12")])
DAMAGED_HEADERS = {
    "magic": b"ply\n" + FORMAT_0,
    "random": b"LASF" + bytes(range(7, 250)) * 2,
    "short": FORMAT_0[:100],
    "version": patch(FORMAT_0, 25, "B", 5),
    "header size": patch(FORMAT_6, 94, "H", 227),
    "start": patch(FORMAT_0, 96, "I", 100),
    "start behind": patch(FORMAT_0, 96, "I", 2**31),
    "records": patch(FORMAT_0, 100, "I", 2**32 - 1),
    "record length": patch(ONE_VLR, 227 + 20, "H", 3),
    "format": patch(FORMAT_0, 104, "B", 11),
    "point size": patch(FORMAT_0, 105, "H", 19),
    "scale": patch(FORMAT_0, 131, "d", 0.0),
    "scale nan": patch(FORMAT_0, 139, "d", float("nan")),
    "offset": patch(FORMAT_0, 155, "d", float("inf")),
    "none": patch(FORMAT_0, 107, "I", 0),
    "absurd": patch(FORMAT_6, 247, "Q", 2**63),
    "truncated": FORMAT_0[:-101],
    "header only": FORMAT_0[:227],
}  # fmt: skip


@pytest.mark.parametrize("name", DAMAGED_HEADERS)
def test_damaged_headers(tmp_path, name):
    refusal(tmp_path, DAMAGED_HEADERS[name])


@pytest.mark.parametrize("compress", [None, "chunks"])
@pytest.mark.parametrize("beyond", [1, 2, 50])
def test_too_many_stated_records_give_one_warning(tmp_path, beyond, compress):
    if compress:
        skip_without_lazrs()
    data = las(7, 10, vlrs=[wkt(UTM)], compress=compress)
    count = struct.unpack_from("<I", data, 100)[0]
    cloud, notes = read_with_notes(tmp_path, patch(data, 100, "I", count + beyond))
    expected = read(tmp_path, data)
    np.testing.assert_array_equal(cloud.points, expected.points)
    assert (cloud.crs, cloud.unit) == (expected.crs, expected.unit)
    assert notes == [f"the header states {count + beyond} variable length records, the file has {count}: read these"]


def test_too_many_stated_extended_records_give_one_warning(tmp_path):
    data = las(6, 10, evlrs=[vlr(b"LASF_Projection", 2112, UTM.encode(), extended=True)])
    expected = read(tmp_path, data).crs
    cloud, notes = read_with_notes(tmp_path, patch(data, 243, "I", 2))
    assert (len(cloud), cloud.crs, len(notes)) == (10, expected, 1)
    check_text(notes[0])


def test_the_count_for_new_readers_is_used(tmp_path):
    cloud, notes = read_with_notes(tmp_path, patch(FORMAT_6, 107, "I", 9))
    assert (len(cloud), len(notes)) == (10, 1)
    check_text(notes[0])


def test_more_points_than_the_header_states(tmp_path):
    cloud, notes = read_with_notes(tmp_path, las(0, 10, stated_count=4))
    assert len(cloud) == 4
    assert notes == ["the header states 4 points, the file has space for 10: left out the rest"]


def test_damaged_extended_records_give_a_warning(tmp_path):
    data = las(6, 10, evlrs=[vlr(b"LASF_Projection", 2112, UTM.encode(), extended=True)])
    assert read(tmp_path, data).crs in ("EPSG:32617", UTM)
    cloud, notes = read_with_notes(tmp_path, data[:-5])
    assert (len(cloud), cloud.crs, len(notes)) == (10, None, 1)
    check_text(notes[0])


def test_damaged_laz(tmp_path):
    skip_without_lazrs()
    data = las(3, 1000, compress="chunks")
    points_start = struct.unpack_from("<I", data, 96)[0]
    (table_start,) = struct.unpack_from("<q", data, points_start)
    chunk_size = points_start - struct.calcsize("<IqqH") - 3 * 6
    assert struct.unpack_from("<I", data, chunk_size) == (50_000,)
    for damaged_data in (
        data[: table_start - 100],
        data[:points_start],  # before its points
        patch(data, 227 + 18, "H", 1),  # no LASzip record
        patch(data, 227 + 54, "H", 7),  # another compressor
        patch(data, points_start - 20, "H", 99),
        patch(data, 105, "H", 35),
        patch(data, table_start + 4, "I", 2**31),
        patch(data, 107, "I", 50_001),
        patch(data, 107, "I", 9000),
    ):
        refusal(tmp_path, damaged_data)


def test_failing_decompressor_gives_a_one_line_error(tmp_path, monkeypatch):
    skip_without_lazrs()
    for line in ("import os; os.abort()", "import time; time.sleep(60)", "import sys; sys.stdout.write('1234')"):
        worker = tmp_path / "worker.py"
        worker.write_text(line)
        monkeypatch.setattr(laz, "_WORKER", str(worker))
        monkeypatch.setattr(laz, "_MAX_WORKER_SECONDS", 0.5)
        refusal(tmp_path, las(0, 10, compress="chunks"))


def test_memory_of_the_decompressor_is_limited(tmp_path, monkeypatch):
    skip_without_lazrs()
    worker, limit_file = tmp_path / "worker.py", tmp_path / "seen"
    worker.write_text(
        f"import resource\nopen({str(limit_file)!r}, 'w').write(str(resource.getrlimit(resource.RLIMIT_AS)[0]))"
    )
    monkeypatch.setattr(laz, "_WORKER", str(worker))
    refusal(tmp_path, las(0, 10, compress="chunks"))
    assert int(limit_file.read_text()) == (1 << 30) + 2 * 10 * 20  # points of 20 bytes


def test_lazrs_that_cannot_be_imported(tmp_path, monkeypatch):
    skip_without_lazrs()
    worker = tmp_path / "worker.py"
    worker.write_text("import sys\nsys.path[:] = []\n" + Path(laz._WORKER).read_text())
    monkeypatch.setattr(laz, "_WORKER", str(worker))
    (tmp_path / "a.laz").write_bytes(las(0, 10, compress="chunks"))
    with check_error(MissingExtra):
        read_cloud(tmp_path / "a.laz")


def test_decompressor_runs_on_windows(tmp_path, monkeypatch):
    """The decompressor uses no module and no function of `os` that Windows lacks."""
    skip_without_lazrs()
    worker = tmp_path / "worker.py"
    worker.write_text(
        "import os, sys\n"
        "for name in ('fcntl', 'resource', 'posix'):\n    sys.modules[name] = None\n"
        "for name in ('pread', 'preadv', 'fork', 'posix_fadvise', 'sched_getaffinity', 'sendfile'):\n"
        "    delattr(os, name)\n" + Path(laz._WORKER).read_text()
    )
    monkeypatch.setattr(laz, "_WORKER", str(worker))
    assert len(read(tmp_path, las(0, 10, compress="chunks"))) == 10


def test_decompressor_goes_on_after_an_interrupted_write(tmp_path, monkeypatch):
    """A stopped process writes only a part to a pipe that is full."""
    skip_without_lazrs()
    expected = read(tmp_path, las(0, 500, compress="chunks")).points
    worker = tmp_path / "worker.py"
    worker.write_text(
        "import os, sys\n"
        "class Output:\n"
        "    buffer = property(lambda self: self)\n"
        "    def write(self, data):\n        return os.write(1, data[:999])\n"
        "    def flush(self):\n        pass\n"
        "sys.stdout = Output()\n" + Path(laz._WORKER).read_text()
    )
    monkeypatch.setattr(laz, "_WORKER", str(worker))
    np.testing.assert_array_equal(read(tmp_path, las(0, 500, compress="chunks")).points, expected)


def test_laz_is_read_from_any_script(tmp_path):
    """LAZ can be read by a script without a main guard, in a folder with modules of conflicting names."""
    skip_without_lazrs()
    (tmp_path / "a.laz").write_bytes(las(0, 10, compress="chunks"))
    for name in ("lazrs", "json", "resource"):
        (tmp_path / f"{name}.py").write_text("raise SystemExit('the wrong module')")
    (tmp_path / "sub").mkdir()
    script = tmp_path / "sub" / "script.py"
    script.write_text("import pcbench\nprint(len(pcbench.read_cloud('a.laz')))\n")
    environment = os.environ | {"PYTHONSTARTUP": "none.py", "PYTHONWARNINGS": "ignore"}
    process = subprocess.run(
        [sys.executable, str(script)], cwd=tmp_path, env=environment, capture_output=True, text=True, timeout=60
    )
    assert (process.stdout, process.stderr) == ("10\n", "")


def test_without_lazrs(tmp_path, monkeypatch):
    skip_without_lazrs()
    data = las(0, 10, compress="chunks")
    break_library(monkeypatch, tmp_path / "packages", "lazrs", None)
    with check_error(MissingExtra):
        read(tmp_path, data)
    with pytest.raises(MissingExtra):
        write_cloud(tmp_path / "b.laz", Cloud(np.zeros((1, 3))))
    assert not (tmp_path / "b.laz").exists()
    assert len(read(tmp_path, las(0, 10))) == 10


def test_wrong_points_of_damaged_laz_lie_outside_the_bounds(tmp_path):
    skip_without_lazrs()
    write_cloud(tmp_path / "a.laz", Cloud(np.random.default_rng(0).uniform(0, 50, (3000, 3))))
    data = (tmp_path / "a.laz").read_bytes()
    start = struct.unpack_from("<I", data, 96)[0]
    for offset in range(start + 1000, start + 16_000, 3000):
        damaged_data = bytearray(data)
        damaged_data[offset] ^= 4
        _, notes = read_with_notes(tmp_path, bytes(damaged_data))
        assert any("outside the header's bounds" in note for note in notes)


@COMPRESSIONS
def test_points_that_contradict_the_header_give_warnings(tmp_path, compress):
    if compress:
        skip_without_lazrs()
    data, expected = las(1, 9, compress=compress), read(tmp_path, las(1, 9))
    (low_x, low_y, low_z), (high_x, high_y, high_z) = expected.bounds
    consistent_data = patch(data, 179, "6d", high_x, low_x, high_y, low_y, high_z, low_z)
    consistent_data = patch(consistent_data, 111, "5I", 3, 3, 3, 0, 0)
    assert read_with_notes(tmp_path, consistent_data)[1] == []
    explanation = "the header was not updated, or points are damaged"
    assert read_with_notes(tmp_path, patch(consistent_data, 195, "d", high_y - 0.5))[1] == [
        f"points lie up to 0.5 units outside the header's bounds in y: {explanation}"
    ]
    assert read_with_notes(tmp_path, patch(consistent_data, 219, "d", low_z + 2))[1] == [
        f"points lie up to 2 units outside the header's bounds in z: {explanation}"
    ]
    assert read_with_notes(tmp_path, patch(consistent_data, 111, "5I", 3, 4, 2, 0, 0))[1] == [
        f"3 points are return 2, the header states 4: {explanation}"
    ]


def test_impossible_returns_give_a_warning(tmp_path):
    data = patch(las(6, 10), 375 + 14, "B", 5 | 3 << 4)  # the first point: return 5 of 3
    assert read_with_notes(tmp_path, data)[1] == [
        "1 of 10 points have a return number above the returns of their pulse: damaged returns"
    ]
