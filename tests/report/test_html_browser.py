"""`report.html` in a real browser: headless Chromium, WebGL2 in software, no network."""

import re
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
import shapes
from browser import CHROMIUM, Browser
from viewed_pages import GROUND, click_on, pixel_of, plainly, press_key, shown_colors, write_page

from pcbench import Cloud, Settings, compare
from pcbench.deformation import Field
from pcbench.report.colors import SEQUENTIAL, Range

pytestmark = pytest.mark.skipif(CHROMIUM is None, reason="needs Chromium: apt-get install chromium")


@pytest.fixture(scope="module")
def comparison():
    """Compare a noisy cloud far from the origin; a few points are far apart from all others, to click on."""
    points = shapes.terrain(4000, seed=1)[0] + [500_000, 5_000_000, 100]
    a = points[::2] + np.random.default_rng(2).normal(0, 0.02, points[::2].shape)
    towers = a[:4] + np.array([[0, 0, 6], [0, 0, 7], [0, 0, 8], [0, 0, 9]])
    return compare(Cloud(points, unit="m"), {"a": Cloud(np.vstack([a, towers]))}, Settings(register="none"))


@pytest.fixture(scope="module")
def path(comparison, tmp_path_factory):
    folder = tmp_path_factory.mktemp("page") / "report"
    comparison.save(folder, figures=False)
    return folder / "report.html"


@pytest.fixture(scope="module")
def browser():
    with Browser() as opened:
        yield opened


@pytest.fixture
def opened(browser, path):
    browser.open(path)
    return browser


def test_it_opens_from_disk_without_errors_or_requests(opened, path):
    assert opened.problems == []
    assert opened.requests == [path.as_uri()]
    assert opened.run("pcbenchReport.renderer.constructor.name") == "WebglRenderer"
    assert opened.run("document.querySelectorAll('h1, h2').length") > 4
    assert len(shown_colors(opened)) > 20


@pytest.mark.parametrize("query", ["", "?painter"])
@pytest.mark.parametrize("key", ["distance", "plane_distance"])
def test_points_have_the_colors_of_the_legend(browser, path, comparison, key, query):
    browser.open(path, query=query)
    browser.run(
        f"(byId('scalar').value = {key!r}, byId('scalar').dispatchEvent(new Event('change')),"
        " new Promise((done) => setTimeout(done, 100)))"
    )
    plainly(browser, key)
    values = comparison["a"].deviation.scalars[key]
    described = next(
        scalar for scalar in browser.run("pcbenchReport.scene.layers[0].head.scalars") if scalar["key"] == key
    )
    scale = Range(described["low"], described["high"], signed=described["signed"])
    assert scale.signed == (key == "plane_distance")
    legend = {tuple(c) for c in scale.colors(np.array(described["levels"])).tolist()}
    # The two languages may round a half differently.
    near = {tuple(np.add(c, d)) for c in legend for d in np.indices((3, 3, 3)).reshape(3, -1).T - 1}
    found = shown_colors(browser)
    assert found and found <= near
    for row in np.argsort(np.abs(values))[-4:]:  # the towers, which no other point hides
        x, y = map(round, pixel_of(browser, comparison["a"].deviation.points[row]))
        color = browser.run(f"pcbenchReport.renderer.pixel({x}, {y})")
        assert color == scale.colors(values[row : row + 1])[0].tolist()
    bar = browser.run("byId('legend-bar').style.background")
    stops = [tuple(map(int, stop.split(","))) for stop in re.findall(r"rgb\(([^)]*)\)", bar)]
    expected = scale.colors(np.linspace(scale.low, scale.high, len(stops)))
    assert len(stops) > 8 and np.abs(np.array(stops) - expected).max() <= 1
    ends = [float(browser.run(f"byId('legend-{end}').value")) for end in ("low", "high")]
    assert ends == pytest.approx([scale.low, scale.high], rel=1e-3)


def test_the_limits_of_the_legend_can_be_set(opened):
    plainly(opened)
    before = shown_colors(opened)
    opened.run(
        """(async () => {
          const input = document.getElementById("legend-high");
          input.value = "1000";
          input.dispatchEvent(new Event("change"));
          await pcbenchReport.ready;
          await new Promise((done) => setTimeout(done, 100));
        })()"""
    )
    after = shown_colors(opened)
    assert len(after) < len(before)
    assert all(np.abs(np.subtract(color, SEQUENTIAL[0])).max() < 12 for color in after)  # all are near zero now


@pytest.mark.parametrize("query", ["", "?painter"])
def test_a_click_returns_the_point(browser, path, comparison, query):
    browser.open(path, query=query)
    map_ = comparison["a"].deviation
    row = int(np.argmax(map_.scalars["distance"]))
    x, y = pixel_of(browser, map_.points[row])
    click_on(browser, x, y)
    found = browser.run(f"(({{ at, scalars }}) => ({{ at, scalars }}))(pcbenchReport.page.pick({x}, {y}))")
    step = browser.run("pcbenchReport.scene.layers[0].head.step")
    assert (np.abs(found["at"] - map_.points[row]) <= 0.51 * np.array(step)).all()
    values = {scalar["key"]: scalar["value"] for scalar in found["scalars"]}
    assert values["distance"] == pytest.approx(map_.scalars["distance"][row], rel=0.1)
    said = browser.run("document.getElementById('picked').textContent")
    assert said == "a at ({}): {}".format(
        ", ".join(f"{value:.3f}" for value in found["at"]),
        ", ".join(f"{key.replace('_', ' ')} {value:.3g} m" for key, value in values.items()),
    )
    assert browser.problems == []


@pytest.mark.parametrize("query", ["", "?painter"])
@pytest.mark.parametrize("axis", [0, 1, 2])
def test_sections_cut_where_they_say(browser, path, comparison, axis, query):
    """The text beside the sliders names the slab; points inside it are drawn, those outside are not."""
    browser.open(path, query=query)
    points = comparison["a"].deviation.points
    browser.run(
        f"""(() => {{
          for (const [end, value] of [["low", "400"], ["high", "550"]]) {{
            const input = byId(`clip-${{end}}-{axis}`);
            input.value = value;
            input.dispatchEvent(new Event("input"));
          }}
          Object.assign(pcbenchReport.scene, {{ lighting: false, pointSize: 0.25 }});
          pcbenchReport.page.key("t");
          pcbenchReport.page.draw();
        }})()"""
    )
    low, high = map(float, browser.run(f"byId('clip-text-{axis}').textContent").split(" to "))
    whole = np.ptp(points[:, axis])
    assert 0.1 * whole < high - low < 0.2 * whole
    rounding = 0.06  # of the text
    inside = (points[:, axis] > low + rounding) & (points[:, axis] < high - rounding)
    outside = (points[:, axis] < low - rounding) | (points[:, axis] > high + rounding)
    assert inside.sum() > 100 and outside.sum() > 1000
    drawn = browser.run(
        """(() => {
          const { scene, camera, page } = pcbenchReport;
          let count = 0;
          scene.eachProjected(page.panes[0].views[0].layer, camera, page.panes[0], 1, () => (count += 1));
          return count;
        })()"""
    )
    assert inside.sum() <= drawn <= len(points) - outside.sum()
    ground = list(GROUND)
    rows = np.random.default_rng(0).choice(np.flatnonzero(inside), 20, replace=False)
    spots = [tuple(map(int, pixel_of(browser, points[row]))) for row in rows]
    assert all(browser.run(f"pcbenchReport.renderer.pixel({x}, {y})") != ground for x, y in spots)
    pixels = np.array([pixel_of(browser, point) for point in points[inside]])
    hidden = [
        spot
        for spot in (pixel_of(browser, points[row]) for row in np.flatnonzero(outside)[::40])
        if np.abs(pixels - spot).max(axis=1).min() > 3
    ]
    assert len(hidden) > 10
    assert all(browser.run(f"pcbenchReport.renderer.pixel({int(x)}, {int(y)})") == ground for x, y in hidden)
    assert browser.problems == []


def test_a_clipped_point_cannot_be_picked(opened, comparison):
    map_ = comparison["a"].deviation
    x, y = pixel_of(opened, map_.points[np.argmax(map_.scalars["distance"])])
    assert opened.run(f"pcbenchReport.page.pick({x}, {y})") is not None
    opened.run("(byId('clip-high-2').value = '600', byId('clip-high-2').dispatchEvent(new Event('input')))")
    assert opened.run(f"pcbenchReport.page.pick({x}, {y})") is None
    opened.run("byId('clip-reset').click()")
    assert opened.run(f"pcbenchReport.page.pick({x}, {y})") is not None


@pytest.mark.parametrize("key", ["r", "f", "s", "t"])
def test_the_scene_fills_the_view(opened, comparison, key):
    press_key(opened, key)
    points = comparison["a"].deviation.points[::10]
    size = opened.run("[byId('canvas').clientWidth, byId('canvas').clientHeight]")
    shares = np.array([pixel_of(opened, point) for point in points]) / size
    assert ((shares > 0) & (shares < 1)).all(axis=1).mean() > 0.97
    low, high = np.percentile(shares, [1, 99], axis=0)
    assert 0.75 < max(high - low) < 1


def test_keys_choose_clouds_and_turn_the_view(opened):
    before = opened.run("pcbenchReport.camera.yaw")
    for key in ("ArrowRight", "2"):
        press_key(opened, key)
    assert opened.run("pcbenchReport.camera.yaw") > before
    assert opened.run("pcbenchReport.scene.visible().map((view) => view.of)") == ["a"]
    assert opened.run("document.getElementById('scalar').value") == "distance"
    assert opened.problems == []


def test_a_worst_place_is_flown_to(opened, comparison):
    opened.call("Emulation.setEmulatedMedia", features=[{"name": "prefers-reduced-motion", "value": "reduce"}])
    opened.run("document.getElementById('place-0').click()")
    target = np.array(opened.run("pcbenchReport.camera.target")) + opened.run("pcbenchReport.scene.center")
    assert np.allclose(target, comparison["a"].metrics.hausdorff.accuracy.worst_point)
    assert "off the reference" in opened.run("document.getElementById('picked').textContent")


def test_displacements_are_drawn(browser, comparison, tmp_path):
    """The arrows of a deformed candidate start hidden, and appear with an exaggeration that makes them visible."""
    candidate = comparison.candidates[0]
    places, none = candidate.deviation.points[::40], np.zeros(len(candidate.deviation.points[::40]))
    field = Field(places, np.tile([0, 0, 0.01], (len(places), 1)), none, none, none, none > 0, none.astype(int))
    bent = replace(candidate, deformation=replace(candidate.deformation, verdict="non-affine", field=field))
    write_page(tmp_path / "page.html", replace(comparison, candidates=(bent,)))
    browser.open(tmp_path / "page.html")
    plainly(browser, key="")
    assert (255, 80, 240) not in shown_colors(browser)
    browser.run("(document.getElementById('arrows').click(), pcbenchReport.page.draw())")
    assert (255, 80, 240) in shown_colors(browser)
    assert browser.run("document.getElementById('exaggeration-text').textContent").startswith("× ")
    assert browser.problems == []


def test_without_webgl_the_cloud_is_painted(browser, path):
    browser.open(path, query="?painter")
    assert browser.run("pcbenchReport.renderer.constructor.name") == "Painter"
    assert browser.run("document.getElementById('renderer-note').hidden") is False
    assert len(shown_colors(browser)) > 20
    assert browser.problems == []


def test_hostile_names_run_no_script(browser, comparison, tmp_path):
    name = "</script><img src=x onerror=document.title='broken'><script>document.title='broken'</script>"
    hostile = replace(comparison, candidates=(replace(comparison.candidates[0], name=name),))
    write_page(tmp_path / "page.html", hostile, name)
    browser.open(tmp_path / "page.html")
    assert "broken" not in browser.run("document.title").replace("'broken'", "")
    assert browser.run("document.querySelectorAll('img').length") == 0
    assert browser.problems == [] and len(browser.requests) == 1
    assert len(shown_colors(browser)) > 20


def test_collapsed_sections_are_printed_and_nothing_is_cut(browser, comparison, tmp_path):
    """A browser prints a page of 740 px on a sheet of A4, and shrinks wider ones a little."""
    many = tuple(replace(comparison["a"], name=f"candidate {k}") for k in range(5))
    write_page(tmp_path / "page.html", replace(comparison, candidates=many, differences=()), "/a/long/path" * 20)
    browser.open(tmp_path / "page.html", width=740)
    browser.call("Emulation.setEmulatedMedia", media="print")
    try:
        sizes = browser.run(
            "[...document.querySelectorAll('main details:not(.panel *) table')].map((e) => e.offsetHeight)"
        )
        assert sizes and min(sizes) > 50
        assert browser.run("document.querySelectorAll('.verdict')[4].offsetHeight") > 30
        cells = "[...document.querySelectorAll('main td, main code')]"
        ends = browser.run(f"{cells}.map((cell) => cell.getBoundingClientRect().right)")
        assert max(ends) <= 1.15 * 740
    finally:
        browser.call("Emulation.setEmulatedMedia", media="")


@pytest.mark.long
def test_buttons_cover_no_values_on_a_phone(browser, path):
    browser.open(path, width=380, height=800)
    rows = browser.run(
        """[...document.querySelectorAll('.places tbody tr')].map((row) => {
          const boxes = [...row.children].slice(1).map((cell) => cell.getBoundingClientRect());
          const end = row.querySelector("button").getBoundingClientRect().right;
          return boxes.map(({ left, right }) => [left, right, end]);
        })"""
    )
    assert len(rows) > 3
    for row in rows:
        for (_, right, _), (left, _, _) in pairwise(row):
            assert right <= left + 0.5
        assert row[0][2] <= 385  # the button is in view
