"""Options of pictures, and the same pictures when a report is drawn again."""

import json
from pathlib import Path

import numpy as np
import pytest
from children_here import drawing_here
from command_line import is_one_line
from optional import import_or_skip
from wording import check_error, check_text

from pcbench import read_cloud
from pcbench.report import Figures
from pcbench.report.colors import Range
from pcbench.report.figures import ink, recorded_figures


@pytest.mark.parametrize(
    "options",
    [{"background": "mauve"}, {"background": "#12345"}, {"background": 3}, {"range": 0.0}, {"range": -1}]
    + [{"range": float("nan")}, {"range": "1"}, {"format": "gif"}, {"format": None}],
)
def test_invalid_options_of_figures_are_refused(options):
    with check_error():
        Figures(**options)


def test_the_range_may_be_a_number_of_numpy():
    figures = Figures(range=np.float32(0.5))
    assert json.loads(json.dumps(figures.plain()))["range"] == 0.5
    assert Figures(range=np.int64(2)) == Figures(range=2)


def test_text_is_readable_on_every_background():
    assert ink("#ffffff") == ink("#f0e442") != ink("#000000") == ink("#1a1c20")
    assert Figures().ground("dark") == "#1a1c20"
    assert Figures(background="white").ground("dark") == "#ffffff"
    assert Figures(background="#123456").ground("white") == "#123456"


def test_picture_options_are_recorded_and_repeated(files, run):
    options = ("--background", "white", "--range", "0.25", "--format", "svg")
    assert run("compare", "ref.ply", "b.ply", *options, "--out", "one", "-q")[0] == 0
    figures = Figures("white", 0.25, "svg")
    assert recorded_figures(Path("one/settings.json")) == figures
    assert run("compare", "--settings", "one/settings.json", "--out", "two", "-q")[0] == 0
    assert recorded_figures(Path("two/settings.json")) == figures
    rerun = ("--settings", "one/settings.json", "--range", "0.5")  # outputs may be chosen anew
    assert run("compare", *rerun, "--out", "three", "-q")[0] == 0
    assert recorded_figures(Path("three/settings.json")) == Figures("white", 0.5, "svg")
    # The clouds of a report are coloured as its pictures are.
    for kind in ("deviation", "completeness"):
        cloud = read_cloud(f"one/b_{kind}.ply")
        expected = Range(0.0, 0.25).colors(np.asarray(cloud.attributes["distance"], float)).astype(int)
        assert np.abs(expected - np.asarray(cloud.colors)).max() <= 1


@pytest.mark.long
def test_plot_uses_the_recorded_options_unless_overridden(files, run):
    import_or_skip("matplotlib")
    assert run("compare", "ref.ply", "a.ply", "--format", "svg", "--out", "one", "-q")[0] == 0
    assert run("plot", "one", "distribution")[1] == "one/figures/distribution.svg\n"
    assert run("plot", "one", "distribution", "--format", "pdf")[1] == "one/figures/distribution.pdf\n"
    assert run("plot", "one", "distribution.png")[1] == "one/figures/distribution.png\n"
    assert "svg" in json.loads(Path("one/settings.json").read_text())["figures"]["format"]
    # A new report in the folder leaves no picture of the old one.
    assert run("compare", "ref.ply", "b.ply", "--out", "one", "-q")[0] == 0
    assert not list(Path("one").glob("figures/*"))


@pytest.mark.parametrize(
    "text",
    [
        '{"figures": {"background": "mauve"}}',
        '{"figures": {"range": -1}}',
        '{"figures": {"format": ["png"]}}',
        '{"figures": {"colour\\u202e\\n": "red"}}',
        '{"figures": "white"}',
        "[]",
        "{",
        "[" * 100_000,
        "\x00\ud800",
    ],
    ids=["background", "range", "format", "name", "text", "list", "cut", "deep", "binary"],
)
def test_damaged_records_of_options_are_one_line(bend, run, text):
    """The pictures are not drawn in another appearance than the user has recorded; without a record, in the default."""
    assert recorded_figures(Path("bend/settings.json")) == Figures()
    Path("bend/settings.json").write_text("{}")
    assert recorded_figures(Path("bend/settings.json")) == Figures()
    Path("bend/settings.json").write_bytes(text.encode("utf-8", "surrogatepass"))
    with drawing_here():
        code, out, err = run("plot", "bend", "--background", "white")
    assert (code, out, is_one_line(err)) == (2, "", True)
    check_text(err)


@pytest.mark.parametrize(
    ("option", "value"),
    [("--background", "mauve"), ("--background", ""), ("--range", "0"), ("--range", "nan"), ("--format", "gif")],
)
def test_invalid_options_are_refused_before_measuring(files, run, option, value):
    code, out, err = run("compare", "ref.ply", "a.ply", option, value, "--out", "one")
    assert code == 2
    assert not out
    assert option in err or is_one_line(err)
    assert not Path("one").exists()


def test_deform_records_its_picture_options_for_plot(files, run):
    import_or_skip("matplotlib")
    options = ("--background", "#fafafa", "--format", "svg")
    with drawing_here():
        assert run("deform", "ref.ply", "b.ply", *options, "--out", "bend", "-q")[0] == 0
    assert recorded_figures(Path("bend/settings.json")) == Figures("#fafafa", None, "svg")
    (figure,) = Path("bend/figures").glob("deformation.*")
    assert figure.suffix == ".svg"
    assert "#fafafa" in figure.read_text()
    with drawing_here():
        assert run("plot", "bend", "deformation")[1] == "bend/figures/deformation.svg\n"
    code, _, err = run("deform", "ref.ply", "a.ply", "--format", "gif", "--out", "other")
    assert code == 2
    assert is_one_line(err)
