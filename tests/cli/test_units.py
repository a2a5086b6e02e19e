"""Degrees, units and coordinate systems on the command line and in Python."""

import json
from pathlib import Path

import numpy as np
import pytest
from las_bytes import geo_keys, las
from optional import import_or_skip
from wording import check_error, check_text

import pcbench
from pcbench import Cloud, read_cloud, write_cloud
from pcbench.geometry.crs import axis_units
from pcbench.geometry.datums import StatedSystem
from pcbench.measure.tiled.settings import TilingSettings


@pytest.fixture
def degrees(tmp_path, monkeypatch):
    """Two clouds in EPSG:4326 with heights in metres, 0.1 m apart, as a.ply and b.las."""
    import_or_skip("pyproj")
    monkeypatch.chdir(tmp_path)
    x, y = np.random.default_rng(0).uniform(-0.001, 0.001, (2, 4000))
    points = np.stack([x - 81, y + 40, 150 + 10 * np.sin(4000 * x) * np.cos(3000 * y)], axis=1)
    write_cloud("a.ply", Cloud(points, crs="EPSG:4326"))
    write_cloud("b.las", Cloud(points + [0, 0, 0.1], crs="EPSG:4326"))
    write_cloud("lonlat.xyz", points)
    return points


@pytest.mark.parametrize(
    "words",
    [
        ("compare", "a.ply", "b.las", "--register", "none"),
        ("compare", "b.las", "a.ply", "--register", "none", "--tiles", "1000"),
        ("register", "b.las", "a.ply"),
        ("deform", "b.las", "a.ply"),
        ("tradeoff", "a.ply", "b.las", "--out", "tradeoff"),
        ("stress", "a.ply", "b.las", "--out", "stress"),
        ("synth", "warp", "a.ply", "warped.ply", "--kind", "dome", "--rms", "0.1"),
        ("plot", "b.las", "--out", "picture.png"),
    ],
)
def test_degrees_are_not_measured(degrees, run, words):
    code, _, error = run(*words)
    assert code == 2
    assert "pcbench convert FILE OUT --to-crs EPSG:32617" in check_text(error)


def test_degrees_are_not_measured_in_python(degrees):
    first, second = Cloud(degrees, crs="EPSG:4326"), Cloud(degrees, unit="deg")
    metric = Cloud(degrees, unit="m")
    for call in (
        lambda: pcbench.compare(first, metric),
        lambda: pcbench.compare(metric, {"b": second}),
        lambda: pcbench.compare("a.ply", "b.las", tiling=TilingSettings(1000)),
        lambda: pcbench.register(metric, second),
        lambda: pcbench.deform(first, metric),
    ):
        with check_error():
            call()


def test_projected_clouds_are_compared(degrees, run):
    """The command of the message, and the distance of 0.1 m between the clouds in metres."""
    assert run("convert", "a.ply", "ref.ply", "--to-crs", "EPSG:32617")[0] == 0
    assert run("convert", "b.las", "moved.las", "--to-crs", "EPSG:32617")[0] == 0
    found = pcbench.compare("ref.ply", "moved.las", register="none")
    assert found.reference.unit == "m"
    found.save("report", figures=False)
    values = json.loads(Path("report/comparison.json").read_text())
    for file in (values["reference"], *values["candidates"]):
        assert file["system"]["crs"] == "WGS 84 / UTM zone 17N (EPSG:32617)"
        assert (file["system"]["unit"], file["system"]["vertical_datum"]) == ("m", None)
    assert Path("report/report.html").read_text().count(StatedSystem.of("EPSG:32617", "m").describe()) == 2
    assert np.median(found.candidates[0].deviation.scalars["distance"]) == pytest.approx(0.1, abs=1e-3)
    code, _, error = run("convert", "lonlat.xyz", "c.ply", "--crs", "EPSG:4326", "--to-crs", "EPSG:32617")
    assert (code, error) == (0, "")
    np.testing.assert_allclose(read_cloud("c.ply").points, read_cloud("ref.ply").points, atol=1e-6)


def test_what_convert_changes_is_printed(degrees, run):
    """Points are removed, coordinates are scaled, the unit is stated, and then the coordinates are converted."""
    Path("mm.xyz").write_text("0 0 0\n1000 2000 3000\n1000 2000 3000\n0 1000 0\n")
    words = ("--drop-zero", "--drop-duplicates", "--scale", "0.001", "--unit", "ft", "--to-unit", "m")
    code, out, error = run("convert", "mm.xyz", "out.ply", *words)
    assert (code, error) == (0, "")
    check_text(out)
    np.testing.assert_allclose(read_cloud("out.ply").points, np.array([[1, 2, 3], [0, 1, 0]]) * 0.3048, rtol=1e-12)
    code, out, error = run("convert", "a.ply", "out.las", "--crs", "EPSG:4979", "--to-crs", "EPSG:32617+4979")
    assert (code, error) == (0, "")
    check_text(out)
    assert read_cloud("out.las").unit == "m"


def test_info_states_the_unit_of_each_axis(degrees, run):
    code, out, error = run("info", "a.ply", "b.las")
    assert code == 0
    check_text(out + error)
    Path("mixed.las").write_bytes(las(0, 3, vlrs=[geo_keys(projected=26917, vertical_unit=9003)]))
    code, out, error = run("info", "mixed.las")
    assert code == 0
    check_text(out + error)


def test_mixed_units_become_one(degrees, run):
    Path("mixed.las").write_bytes(las(0, 3, vlrs=[geo_keys(projected=26917, vertical_unit=9003)]))
    assert run("convert", "mixed.las", "metres.las", "--to-unit", "m")[0] == 0
    before, after = read_cloud("mixed.las", on_warning=lambda note: None), read_cloud("metres.las")
    assert (before.unit, after.unit, axis_units(after.crs)) == (None, "m", ("m", "m"))
    np.testing.assert_allclose(after.points, before.points * [1, 1, 1200 / 3937], rtol=1e-9, atol=1e-6)


def test_options_that_do_not_fit(degrees, run):
    for words in (
        ("--accuracy", "1"),
        ("--unit", "m"),
        ("--to-unit", "m"),
        ("--crs", "nowhere"),
        ("--crs", "EPSG:5703"),
        ("--to-crs", "nowhere"),
        ("--scale", "0"),
        ("--scale", "nan"),
        ("--color-depth", "12"),
    ):
        code, _, error = run("convert", "a.ply", "out.las", *words)
        assert code == 2
        check_text(error)
    assert not Path("out.las").exists()


def test_color_depth(degrees, run):
    Path("c.las").write_bytes(las(2, 10, color=1))  # the brightest value is 255
    assert run("convert", "c.las", "d.ply", "--color-depth", "16")[0] == 0
    assert read_cloud("d.ply").colors.max() == 0
    code, _, error = run("crop", "c.las", "e.ply", "--crop", "quantile:1")
    assert code == 0
    check_text(error)
    assert read_cloud("e.ply").colors.max() == 255
