"""Coordinate systems and units of LAS files: GeoTIFF keys that state units, and axes with different units."""

import numpy as np
import pytest
from data_folder import data_folder
from las_bytes import geo_doubles, geo_keys, las
from optional import import_or_skip
from wording import check_text

from pcbench.geometry.cloud import Cloud
from pcbench.geometry.crs import axis_units, crs_label
from pcbench.io import read_cloud, write_cloud
from pcbench.io.pieces import open_cloud

METRE, FOOT, SURVEY_FOOT, USER = 9001, 9002, 9003, 32767


def read(path, *vlrs):
    """Return the cloud of a file with these records, and its warnings without the path."""
    path.write_bytes(las(0, 3, vlrs=vlrs))
    notes = []
    cloud = read_cloud(path, on_warning=notes.append)
    disk = open_cloud(path)
    assert (disk.crs, disk.unit, list(disk.warnings)) == (cloud.crs, cloud.unit, notes)
    return cloud, [note.removeprefix(f"{path}: ") for note in notes]


KEYS = [  # keys, unit, units of the axes
    ({"projected": 26917, "vertical_unit": SURVEY_FOOT}, None, ("m", "US-ft")),
    ({"projected": 26917, "vertical": 5703, "vertical_unit": FOOT}, None, ("m", "ft")),
    ({"projected": 26917, "vertical": 6360}, None, ("m", "US-ft")),
    ({"projected": 26917, "vertical_unit": METRE}, "m", ("m", None)),
    ({"projected": 26917, "unit": METRE, "vertical": 5703, "vertical_unit": METRE}, "m", ("m", "m")),
    ({"projected": 26995, "unit": SURVEY_FOOT}, "US-ft", ("US-ft", None)),  # the code says metres
    ({"projected": 26995, "unit": SURVEY_FOOT, "vertical_unit": SURVEY_FOOT}, "US-ft", ("US-ft", None)),
    ({"projected": 2225, "unit": SURVEY_FOOT, "vertical_unit": METRE}, None, ("US-ft", "m")),
    ({"projected": USER, "unit": FOOT}, "ft", None),
    ({"projected": USER, "unit": FOOT, "vertical_unit": FOOT}, "ft", None),
    ({"projected": USER, "unit": METRE, "vertical_unit": SURVEY_FOOT}, None, ("m", "US-ft")),
    ({"model": 2, "geographic": 4326}, "deg", ("deg", None)),
    ({"model": 2, "geographic": 4326, "vertical_unit": FOOT}, "deg", ("deg", "ft")),
    ({"model": 2, "geographic": USER}, "deg", None),
    ({"model": 1, "geographic": 4269, "projected": 26917}, "m", ("m", None)),
]


@pytest.mark.parametrize(("keys", "unit", "units"), KEYS)
def test_units_of_geo_keys(tmp_path, keys, unit, units):
    import_or_skip("pyproj")
    cloud, notes = read(tmp_path / "a.las", geo_keys(**keys))
    assert (cloud.unit, axis_units(cloud.crs)) == (unit, units)
    is_mixed = unit is None
    assert sum("distances have no unit" in note for note in notes) == is_mixed
    if is_mixed and USER not in keys.values():
        check_text(notes[0])
    # Other files keep the system and so the units.
    for name in ("b.las", "b.ply"):
        if cloud.crs is not None:
            write_cloud(tmp_path / name, cloud)
            again = read_cloud(tmp_path / name, on_warning=lambda note: None)
            assert (again.unit, axis_units(again.crs)) == (unit, units)


@pytest.mark.parametrize(("size", "unit"), [(1.0, "m"), (0.3048, "ft"), (0.30480060960121924, "US-ft"), (0.7, None)])
def test_a_unit_may_be_given_by_its_size(tmp_path, size, unit):
    import_or_skip("pyproj")
    keys = geo_keys(projected=USER, unit=USER, unit_size=(1, 1))  # the second number
    assert read(tmp_path / "a.las", keys, geo_doubles(9.0, size))[0].unit == unit
    assert read(tmp_path / "a.las", keys)[0].unit is None  # without the numbers


def test_a_real_file_in_feet_whose_code_says_metres():
    import_or_skip("pyproj")
    cloud = read_cloud(data_folder("halves") / "mvk.las", on_warning=lambda note: None)
    assert (cloud.unit, crs_label(cloud.crs)) == ("US-ft", "NAD83 / Mississippi West (US-ft)")


def test_a_stated_system_gives_the_unit_of_every_format(tmp_path):
    import_or_skip("pyproj")
    notes = []
    for crs, unit in (("EPSG:32617", "m"), ("EPSG:2225", "US-ft"), ("EPSG:26917+6360", None)):
        write_cloud(tmp_path / "a.ply", Cloud(np.eye(3), crs=crs))
        assert read_cloud(tmp_path / "a.ply", on_warning=notes.append).unit == unit
        assert open_cloud(tmp_path / "a.ply").unit == unit
    assert len(notes) == 1
    check_text(notes[0])
