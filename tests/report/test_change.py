"""The folder, texts and pictures of a change between epochs."""

import csv
import json
import sqlite3
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from optional import import_or_skip
from site_epochs import MOUND, PIT, write_surveys, write_zones
from wording import check_text

from pcbench import Cloud, write_cloud
from pcbench.comparison.change import change_files, open_epochs
from pcbench.io import read_cloud
from pcbench.io.json_values import from_json
from pcbench.measure.dem.epochs import date_of
from pcbench.measure.dem.settings import ChangeSettings
from pcbench.measure.dem.volumes import CutFill, EstimatedChange
from pcbench.report.article import markdown
from pcbench.report.change.article import article
from pcbench.report.change.charts import draw_profile, draw_series, draw_volumes
from pcbench.report.change.document import ChangeDocument, ErrorRecord, NormalsRecord, RangedError, date_in_name
from pcbench.report.change.layers import change_range, hillshade, read_document, read_layers
from pcbench.report.change.pictures import pictures
from pcbench.report.change.plan import change_image
from pcbench.report.change.terminal import change_lines
from pcbench.report.change.words import (
    answer,
    decimals_for,
    error_sentences,
    measured_text,
    number_text,
    uncertainty_sentence,
)
from pcbench.report.figures import Figures
from pcbench.report.plot.panels import new_figure

YEARS = (2019, 2021, 2023)


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Measure three epochs with zones, a profile and a place, and return the folder."""
    home = tmp_path_factory.mktemp("site")
    write_surveys(
        home,
        YEARS,
        lambda path, points: write_cloud(path.with_suffix(".ply"), Cloud(points, crs="EPSG:32632", unit="m")),
    )
    write_zones(home / "zones.geojson")
    settings = ChangeSettings(
        cell=1.0,
        zones=home / "zones.geojson",
        profiles=((500001.0, 5200007.0, 500031.0, 5200007.0),),
        points=((500009.0, 5200007.0),),
    )
    epochs = open_epochs([home / f"site_{year}.ply" for year in YEARS], settings)
    outcome = change_files(epochs, settings, home / "out", memory=4 << 30, figures=None, step=lambda _: None)
    assert outcome.without_page is None
    return home / "out"


@pytest.fixture(scope="module")
def document(folder):
    return read_document(folder)


def test_the_document_has_the_volumes(document):
    last = document.changes[-1]
    assert [epoch.date for epoch in document.epochs] == ["2019", "2021", "2023"]
    assert last.whole.volumes.net.low < MOUND - PIT < last.whole.volumes.net.high
    heap, hole = last.zones
    # The cells at the borders of the boxes are known to their mean: both boxes end at borders of cells.
    assert heap.volumes.fill.value == pytest.approx(MOUND, rel=0.05)
    assert hole.volumes.cut.value == pytest.approx(PIT, rel=0.1)
    assert last.part_count == len(last.parts) == 2
    assert document.changes[0].whole.volumes.net.value == pytest.approx((MOUND - PIT) / 2, rel=0.1)
    assert document.trend.rising_share == pytest.approx(48 / 640, abs=0.06)


def test_the_document_reads_back(folder, document):
    values = json.loads((folder / "change.json").read_text())
    assert values["schema"] == "pcbench.change/1"
    assert from_json(ChangeDocument, values).values() == document.values()
    assert set(values) == {"schema", *ChangeDocument.__dataclass_fields__}


def with_errors(document, **others):
    """Return the document with errors that do not depend on the estimates."""
    errors = ErrorRecord(
        0.04, RangedError(0.02, 6.0), RangedError(0.01, 40.0), RangedError(0.005, 90.0), 0, 0.1, 500, None
    )
    changes = tuple(replace(change, errors=replace(errors, **others)) for change in document.changes)
    return replace(document, changes=changes)


def test_texts(document):
    check_text("\n".join(change_lines(with_errors(document))))
    check_text(markdown(article(with_errors(document))))


def test_assumptions_of_the_intervals_in_words(document):
    none = RangedError(0.0, 0.0)
    for others in ({"datum_sigma": 0.02}, {"offset": 0.013}, {"whole": none, "short": none}):
        changed = with_errors(document, **others)
        check_text("\n".join(error_sentences(changed, changed.changes[-1])))
    changed = replace(document, changes=tuple(replace(change, errors=None) for change in document.changes))
    check_text(uncertainty_sentence(changed))


def test_volumes_along_normals_in_words(document):
    last = document.changes[-1]
    volumes = CutFill(EstimatedChange(90.0, np.nan, np.nan), EstimatedChange(20.0, np.nan, np.nan), last.whole.mean)
    for steep, void in ((0.0, 0.0), (0.3, 3.0)):
        normals = NormalsRecord(volumes, last.whole.mean, 700.0, void, 2.0, 8.0, steep, 0.8)
        changed = replace(document, changes=(*document.changes[:-1], replace(last, along_normals=normals)))
        check_text(list(answer(changed))[-2])


def test_the_table_has_a_row_per_area_and_epoch(folder, document):
    rows = list(csv.DictReader((folder / "volumes.csv").read_text().splitlines()))
    assert [row["kind"] for row in rows].count("zone") == 4
    assert len(rows) == sum(1 + len(change.zones) + len(change.parts) for change in document.changes)
    last = next(row for row in rows if row["epoch"] == "site_2023" and row["kind"] == "all")
    assert float(last["net"]) == document.changes[-1].whole.volumes.net.value
    assert float(last["net_low"]) < float(last["net"]) < float(last["net_high"])
    assert last["unit"] == "m"


def test_the_map_opens_in_other_readers(folder, document):
    """Tifffile reads the bands and the place, pyproj the coordinate system."""
    tifffile = import_or_skip("tifffile")
    with tifffile.TiffFile(folder / "maps" / "site_2023.tif") as file:
        page = file.pages[0]
        bands = page.asarray()
        place = file.geotiff_metadata
        text = page.tags["GDAL_METADATA"].value
    names = ("dz", "sigma", "lod", "significance", "count_before", "count_after", "filled", "part", "height_after")
    positions = [text.index(f'role="description">{name}<') for name in names]
    assert positions == sorted(positions)
    bands = np.moveaxis(bands, int(np.argmin(bands.shape)), 0)
    dz, sigma, lod, significance, before, after, filled, part, _ = bands
    assert dz.shape == document.grid.shape
    assert np.nansum(dz) * document.cell_area == pytest.approx(document.changes[-1].whole.volumes.net.value, rel=1e-5)
    assert np.allclose(lod, 1.96 * sigma, equal_nan=True, rtol=1e-6)
    assert np.allclose(significance, dz / sigma, equal_nan=True, rtol=1e-5)
    assert before.sum() <= document.epochs[0].points and after.sum() <= document.epochs[2].points
    assert not filled.any() and part.max() == 2
    assert place["ModelPixelScale"][:2] == [1.0, 1.0]
    assert place["ModelTiepoint"][3:5] == [document.grid.west, document.grid.north]
    assert int(place["ProjectedCSTypeGeoKey"]) == 32632


def test_the_cells_are_points_with_their_change(folder, document):
    import_or_skip("laspy")
    cloud = read_cloud(folder / "maps" / "site_2023.laz")
    assert len(cloud.points) * document.cell_area == document.changes[-1].whole.area
    assert cloud.attributes["dz"].max() == pytest.approx(document.changes[-1].whole.largest, rel=1e-6)
    assert {"dz", "sigma", "lod"} <= set(cloud.attributes)


def test_parts_and_zones_are_polygons(folder, document):
    last = document.changes[-1]
    with sqlite3.connect(folder / "change.gpkg") as database:
        parts = database.execute("SELECT part, epoch, net, net_low, net_high, area, peak FROM parts").fetchall()
        zones = database.execute("SELECT zone, fill FROM zones WHERE epoch = 'site_2023'").fetchall()
        places = database.execute("SELECT epoch, dz, dz_low, dz_high, unit FROM places").fetchall()
        assert database.execute("SELECT profile FROM profiles").fetchall() == [("P1",)]
    database.close()
    assert parts[-2:] == [
        (number, "site_2023", *part.volumes.net, part.area, peak)
        for number, part, peak in zip((1, 2), last.parts, (last.parts[0].largest, last.parts[1].lowest), strict=True)
    ]
    assert zones == [(zone.name, zone.volumes.fill.value) for zone in last.zones]
    (place,) = document.places
    assert places == [
        (name, *change, "m") for name, change in zip(("site_2021", "site_2023"), place.changes, strict=True)
    ]
    features = json.loads((folder / "parts.geojson").read_text())["features"]
    assert len(features) == len(parts)


def test_the_page_has_the_answer_and_the_tables(folder, document):
    page = (folder / "report.html").read_text()
    net = measured_text(document.changes[-1].whole.volumes.net, signed=True)
    assert net.partition(" [")[0] in page and "WGS 84 / UTM zone 32N (EPSG:32632)" in page
    assert "heap" in page and "unit of lengths: m" in page
    assert (folder / "change.md").read_text().startswith("# Change from site_2019 to site_2023")


def test_pictures_and_sheets_are_drawn(folder, tmp_path):
    import_or_skip("matplotlib.figure")
    drawn = pictures(folder, Figures())
    epochs = [f"{kind}_site_{year}" for year in YEARS[1:] for kind in ("plan", "volumes", "sigma")]
    assert list(drawn) == [*epochs, "profile_1", "series", "trend", "sheets"]
    for name in ("profile_1", "series"):
        assert drawn[name].draw(tmp_path / f"{name}.png")
        assert (tmp_path / f"{name}.png").read_bytes()[:4] == b"\x89PNG"
    assert drawn["sheets"].file == "change.pdf"
    assert drawn["sheets"].draw(tmp_path / "change.pdf")
    content = (tmp_path / "change.pdf").read_bytes()
    assert content.count(b"/Type /Page\n") + content.count(b"/Type /Page ") == 5  # two plans, profile, series, parts
    assert b"/Creator (pcbench)" in content


def test_an_epoch_keeps_its_map_whatever_its_name(tmp_path):
    paths = [tmp_path / "trend.xyz", tmp_path / "reference.xyz"]
    for path in paths:
        path.write_text("0 0 0\n1 1 1\n")
    assert [name for _, name, _ in open_epochs(paths, ChangeSettings())] == ["trend_2", "reference"]


def test_names_are_no_formulas(folder, tmp_path):
    """Text between dollars would be set as mathematics, and stop the drawing if it is no formula."""
    import_or_skip("matplotlib.figure")
    document = read_document(folder)
    last = document.changes[-1]
    zones = tuple(replace(zone, name="$\\foo{$") for zone in last.zones)
    epochs = tuple(replace(epoch, name="$_$") for epoch in document.epochs)
    named = replace(document, epochs=epochs, changes=(*document.changes[:-1], replace(last, zones=zones)))
    figure = new_figure(6, 6)
    axes = figure.subplots(4, 1)
    draw_volumes(axes[0], named, named.changes[-1], most=5)
    draw_profile(axes[1:3], named, 1)
    draw_series(axes[3:], replace(named, years=None, places=()))
    figure.savefig(tmp_path / "charts.png")


def test_cells_below_the_level_of_detection_are_grey(folder):
    layers = read_layers(folder, "site_2023")
    image = change_image(layers, change_range(layers, None), "#ffffff")
    red, green, blue = np.moveaxis(image.astype(int), 2, 0)
    is_grey = (red == green) & (green == blue)
    assert is_grey[~layers.significant & np.isfinite(layers.dz)].all()
    raised = layers.significant & (layers.dz > 1)
    assert raised.any() and (red > blue)[raised].all()
    assert (image[~np.isfinite(layers.dz)] == 255).all()


def test_relief_is_lit_from_the_north_west():
    """A slope that faces the north-west is lighter than flat terrain, and one that faces the south-east is darker."""
    east, south = np.meshgrid(np.arange(8.0), np.arange(8.0))
    inner = (slice(1, -1), slice(1, -1))
    assert (hillshade(east + south, 1.0)[inner] > 0.5).all()  # it rises to the south-east
    assert (hillshade(-east - south, 1.0)[inner] < 0.5).all()
    assert (hillshade(np.zeros((8, 8)), 1.0)[inner] == 0.5).all()


def test_dates_are_as_precise_as_the_names():
    for name, text in (("site_2023.laz", "2023"), ("a-2023-05.laz", "2023-05"), ("20230101.xyz", "2023-01-01")):
        assert date_in_name(date_of(name), name) == text


def test_numbers_have_three_significant_digits():
    assert [decimals_for(size) for size in (0.0123, 1.5, 99.9, 100, 4.6e6)] == [4, 2, 1, 0, 0]
    assert measured_text(EstimatedChange(375.98, 125.36, 626.6), signed=True) == "+376 [125, 627]"
    assert measured_text(EstimatedChange(0.0266, 0.0089, 0.0444)) == "0.0266 [0.0089, 0.0444]"
    assert measured_text(EstimatedChange(1848.2, np.nan, np.nan)) == "1,848"
    assert measured_text(EstimatedChange(0.0, -6.12e-7, 6.12e-7), signed=True) == "+0 [-6.12e-07, 6.12e-07]"
    assert measured_text(EstimatedChange(-0.2, -150, 150), signed=True) == "+0 [-150, 150]"
    assert number_text(-0.543, signed=True) == "-0.543"


def test_a_folder_without_figures_names_none(folder):
    assert not (Path(folder) / "figures").exists() and not (folder / "change.pdf").exists()
