"""`report.html` in a real browser: headless Chromium, WebGL2 in software, no network."""

from dataclasses import replace

import numpy as np
import pytest
import shapes
from browser import CHROMIUM, Browser

from pcbench import Cloud, Settings, compare
from pcbench.deformation import Field
from pcbench.report.colors import SEQUENTIAL, Range
from pcbench.report.html import page

pytestmark = pytest.mark.skipif(CHROMIUM is None, reason="needs Chromium: apt-get install chromium")

CANVAS = "document.getElementById('canvas')"


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


def shown_colors(browser):
    """Return the colours of the picture that are not its ground."""
    colors = browser.run(
        f"""(() => {{
          const copy = document.createElement("canvas");
          [copy.width, copy.height] = [{CANVAS}.width, {CANVAS}.height];
          const context = copy.getContext("2d");
          context.drawImage({CANVAS}, 0, 0);
          const data = new Uint32Array(context.getImageData(0, 0, copy.width, copy.height).data.buffer);
          return [...new Set(data)];
        }})()"""
    )
    triples = {(c & 255, c >> 8 & 255, c >> 16 & 255) for c in colors}
    return triples - {(20, 22, 27)}


def write_page(path, comparison, text="-"):
    provenance = dict.fromkeys(("version", "commit", "machine", "created", "command"), text)
    path.write_text(page(comparison, provenance), encoding="utf-8")


def pixel_of(browser, at):
    """Return the position of a point in CSS pixels of the canvas."""
    return browser.run(
        f"""(() => {{
          const {{ scene, camera }} = pcbenchReport;
          return camera.project(scene.local({list(map(float, at))}), {CANVAS}.clientWidth, {CANVAS}.clientHeight);
        }})()"""
    )[:2]


def plainly(browser, key="distance"):
    """Colour by a scalar, without shading, which would darken the colours."""
    browser.run(f"(pcbenchReport.scene.lighting = false, pcbenchReport.scene.key = {key!r}, pcbenchReport.draw())")


def test_it_opens_from_disk_without_errors_or_requests(opened, path):
    assert opened.problems == []
    assert opened.requests == [path.as_uri()]
    assert opened.run("pcbenchReport.renderer.constructor.name") == "WebglRenderer"
    assert opened.run("document.querySelectorAll('h1, h2').length") > 4
    assert len(shown_colors(opened)) > 20


def test_points_have_the_colors_of_the_legend(opened, comparison):
    plainly(opened)
    map_ = comparison["a"].deviation
    scalar = opened.run("pcbenchReport.scene.layers[0].head.scalars[0]")
    levels = np.array(scalar["levels"])
    legend = {tuple(c) for c in Range(0.0, scalar["high"]).colors(levels).tolist()}
    # The two languages may round a half differently.
    near = {tuple(np.add(c, d)) for c in legend for d in np.indices((3, 3, 3)).reshape(3, -1).T - 1}
    found = shown_colors(opened)
    assert found and found <= near
    tower = map_.points[np.argmax(map_.scalars["distance"])]
    x, y = map(round, pixel_of(opened, tower))
    assert opened.run(f"pcbenchReport.renderer.pixel({x}, {y})") == SEQUENTIAL[-1].tolist()


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
    left, top = browser.run(
        f"({CANVAS}.scrollIntoView(), (({{ left, top }}) => [left, top])({CANVAS}.getBoundingClientRect()))"
    )
    for kind in ("mousePressed", "mouseReleased"):
        browser.press(kind, left + x, top + y)
    found = browser.run(f"(({{ at, scalars }}) => ({{ at, scalars }}))(pcbenchReport.pick({x}, {y}))")
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


def test_clipping_hides_points(opened, comparison):
    map_ = comparison["a"].deviation
    tower = map_.points[np.argmax(map_.scalars["distance"])]
    x, y = map(round, pixel_of(opened, tower))
    assert opened.run(f"pcbenchReport.renderer.pixel({x}, {y})") != [20, 22, 27]
    opened.run(
        """(() => {
          const input = document.getElementById("clip-high-2");
          input.value = "600";
          input.dispatchEvent(new Event("input"));
          pcbenchReport.draw();
        })()"""
    )
    assert opened.run(f"pcbenchReport.renderer.pixel({x}, {y})") == [20, 22, 27]
    assert opened.run(f"pcbenchReport.pick({x}, {y})") is None
    assert shown_colors(opened)


def test_keys_choose_clouds_and_turn_the_view(opened):
    before = opened.run("pcbenchReport.camera.yaw")
    opened.run(f"{CANVAS}.focus()")
    for key in ("ArrowRight", "2"):
        opened.call("Input.dispatchKeyEvent", type="keyDown", key=key)
    opened.run("new Promise((done) => setTimeout(done, 200))")
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
    browser.run("(document.getElementById('arrows').click(), pcbenchReport.draw())")
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
