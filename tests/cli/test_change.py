"""The command `pcbench change`: its answer, --json, its folder, and errors of one line."""

import json

import numpy as np
import pytest
from command_line import is_one_line
from site_epochs import survey, write_surveys, write_zones
from wording import check_text

from pcbench import Cloud, write_cloud


@pytest.fixture
def site(tmp_path, monkeypatch):
    """Write site_2020.xyz, site_2022.xyz and zones.geojson to the current folder."""
    monkeypatch.chdir(tmp_path)
    write_surveys(tmp_path, (2020, 2022), lambda path, points: np.savetxt(path, points, fmt="%.3f"))
    write_zones(tmp_path / "zones.geojson")
    return tmp_path


def test_the_answer_comes_first(site, run):
    arguments = ("site_2020.xyz", "site_2022.xyz", "--cell", "1", "--zones", "zones.geojson", "--out", "out")
    code, out, err = run("change", *arguments, "--no-figures", "--json", "copy.json", "--datum-sigma", "0.01")
    assert code == 0, err
    assert out.startswith("Between site_2020 and site_2022: net +")
    assert "cubic units" in out and "cells of 1 (as given;" in out and "report: out/" in out
    values = json.loads((site / "copy.json").read_text())
    assert values == json.loads((site / "out" / "change.json").read_text())
    assert values["changes"][0]["errors"]["datum_sigma"] == 0.01
    assert [zone["name"] for zone in values["changes"][0]["zones"]] == ["heap", "hole"]


def test_a_stated_unit_is_that_of_clouds_without_one(site, run):
    write_cloud("metres.ply", Cloud(survey(0, 9, 400), unit="m"))
    write_cloud("none.las", Cloud(survey(1, 8, 400)))
    for clouds in (("metres.ply", "none.las"), ("none.las", "site_2022.xyz")):
        code, out, err = run("change", *clouds, "--cell", "2", "--unit", "metre", "--json", "change.json")
        assert code == 0, err
        assert " m³" in out and "cubic units" not in out
        check_text(out.splitlines()[-1])
        assert json.loads((site / "change.json").read_text())["unit"] == "m"


def test_one_survey_given_twice_gets_a_warning(site, run):
    code, out, err = run("change", "site_2020.xyz", "site_2020.xyz", "--cell", "2")
    assert code == 0, err
    assert "net +0 cubic units" in out
    assert "site_2020_2: all heights are those of site_2020: check that it is another survey" in out


def test_voids_of_a_changed_area_get_a_warning(tmp_path, monkeypatch, run):
    monkeypatch.chdir(tmp_path)
    rng = np.random.default_rng(7)
    for year, rise in ((2020, 0.0), (2021, 0.2), (2022, 3.0)):  # of half the site
        places = rng.uniform(0, 40, (9_600, 2))
        heights = rise * (places[:, 0] < 20) + rng.normal(0, 0.02, len(places))
        write_cloud(f"site_{year}.ply", Cloud(np.column_stack([places, heights]), unit="m"))
    code, out, err = run("change", "site_2020.ply", "site_2022.ply", "--cell", "1")
    assert code == 0, err
    (warning,) = (line for line in out.splitlines() if "cells without points" in line)
    assert "would have about +" in check_text(warning) and " m³" in warning
    for arguments in (("site_2022.ply", "--fill-voids"), ("site_2021.ply",)):
        code, out, err = run("change", "site_2020.ply", *arguments, "--cell", "1")
        assert code == 0, err
        assert "cells without points" not in out


def test_dates_may_be_years_as_in_names(site, run):
    trio = ("site_2020.xyz", "site_2022.xyz", "site_2020.xyz")
    code, out, err = run("change", *trio, "--cell", "2", "--dates", "2020,2021-06,2022-01-01")
    assert code == 0, err
    assert "per year" in out
    code, out, err = run("change", *trio, "--cell", "2", "--dates", "2020,2020,2022")
    assert code == 0, err
    assert "two epochs have one date, so that the trend is per epoch" in out


def test_too_little_stable_terrain_gets_a_warning(site, run):
    write_zones(site / "stable.geojson", {"few": (1, 1, 3, 3)})
    code, out, err = run("change", "site_2020.xyz", "site_2022.xyz", "--stable", "stable.geojson")
    assert code == 0, err
    assert "too little named stable terrain" in out
    assert "the mean difference of the named stable terrain" in out


def test_errors_are_one_line(site, run):
    pair = ("site_2020.xyz", "site_2022.xyz")
    np.savetxt("far.xyz", survey(0, 9, 200) + [10_000, 0, 0])
    np.savetxt("outlier.xyz", np.vstack([survey(0, 9, 200), [[1e9, 1e9, 0]]]))
    np.savetxt("line.xyz", survey(0, 9, 200) * [1, 0, 1] + [0, 5_200_007, 0])
    degrees = np.random.default_rng(0).random((200, 3)) + [11.5, 48.1, 0]
    write_cloud("degrees.ply", Cloud(degrees, crs="EPSG:4326", unit="degree"))
    write_cloud("geocentric.ply", Cloud(survey(0, 9, 200), crs="EPSG:4978", unit="m"))
    write_cloud("utm33.ply", Cloud(survey(0, 9, 200), crs="EPSG:32633", unit="m"))
    write_cloud("utm32.ply", Cloud(survey(0, 8, 200), crs="EPSG:32632", unit="m"))
    write_zones(site / "outside.geojson", {"away": (100, 100, 110, 110)})
    write_zones(site / "all.geojson", {"all": (1, 1, 9, 9)})
    (site / "degrees.wkt").write_text("POLYGON((15 46.95,15.0002 46.95,15.0002 46.9502))")
    (site / "utm33.wkt").write_text("SRID=32633;POLYGON((500000 5200000,500020 5200000,500020 5200020))")
    (site / "full").mkdir()
    (site / "full" / "notes.txt").write_text("mine")
    for arguments in (
        pair[:1],
        ("site_2020.xyz", "missing.xyz"),
        ("site_2020.xyz", "far.xyz"),
        ("utm32.ply", "utm33.ply"),
        ("degrees.ply", "degrees.ply"),
        ("geocentric.ply", "geocentric.ply"),
        ("utm32.ply", "site_2020.xyz", "--unit", "ft"),
        (*pair, "--unit", "deg"),
        (*pair, "--surface", "highest"),
        (*pair, "--cell", "0.0000001"),
        (*pair, "--cell", "0.01", "--memory", "500MB"),
        (*pair, "--dates", "2020-01-01"),
        (*pair, "--dates", "2020-01-01,soon"),
        (*pair, "--profile", "1,2,3"),
        (*pair, "--profile", "0,0,1,1"),
        (*pair, "--point", "1"),
        (*pair, "--point", "0,0"),
        (*pair, "--cell", "50"),
        ("site_2020.xyz", "outlier.xyz"),
        ("site_2020.xyz", "line.xyz"),
        (*pair, "--zones", "outside.geojson"),
        (*pair, "--zones", "all.geojson"),
        (*pair, "--stable", "outside.geojson"),
        (*pair, "--stable", "degrees.wkt"),
        ("utm32.ply", "utm32.ply", "--zones", "degrees.wkt"),
        ("utm32.ply", "utm32.ply", "--stable", "utm33.wkt"),
        (*pair, "--out", "full"),
        (*pair, "--out", "."),
        (*pair, "--json", "site_2020.xyz"),
        (*pair, "--memory", "1"),
    ):
        code, out, err = run("change", *arguments)
        assert code == 2 and out == "" and is_one_line(err), (arguments, err)
        check_text(err)
    assert [path.name for path in (site / "full").iterdir()] == ["notes.txt"]
