"""Clouds side by side, tiles, the upward axis and cameras of `report.html`, in a real browser."""

import importlib
from dataclasses import replace

import numpy as np
import pytest
import shapes
from browser import CHROMIUM, Browser
from viewed_pages import click_on, corner, picture_hash, pixel_of, plainly, press_key, shown_colors, write_page

from pcbench import Cloud, Settings, compare

pytestmark = pytest.mark.skipif(CHROMIUM is None, reason="needs Chromium: apt-get install chromium")

UNTESTED = Settings(register="none", deformation=False)
PLAIN = (150, 154, 160)  # the reference, where it has no colours
WHITE, ORANGE = (255, 255, 255), (255, 160, 20)  # cameras, the outline of a tile
LABELS = "[...document.querySelectorAll('.pane-name')].map((name) => name.textContent)"


@pytest.fixture(scope="module")
def comparison():
    """Compare three noisy clouds far from the origin, the second with a bump in a corner."""
    points = shapes.terrain(4000, seed=1)[0] + [500_000, 5_000_000, 100]
    rng = np.random.default_rng(2)
    a, b, c = (points + rng.normal(0, 0.02, points.shape) for _ in range(3))
    b[(b[:, :2] < [500_004, 5_000_004]).all(axis=1), 2] += 0.5
    return compare(Cloud(points, unit="m"), {"a": Cloud(a), "b": Cloud(b), "c": Cloud(c)}, UNTESTED)


@pytest.fixture(scope="module")
def path(comparison, tmp_path_factory):
    target = tmp_path_factory.mktemp("page") / "report.html"
    write_page(target, comparison)
    return target


@pytest.fixture(scope="module")
def browser():
    with Browser() as opened:
        yield opened


@pytest.fixture(params=["", "?painter"])
def beside(browser, path, request):
    """Open the page with the reference beside the first candidate, in both renderers."""
    browser.open(path, query=request.param)
    switch(browser, "side-by-side")
    return browser


def switch(browser, name):
    """Click a control and wait for the picture."""
    browser.run(f"(byId('{name}').click(), new Promise((done) => setTimeout(done, 200)))")


def test_the_reference_is_beside_the_candidate(beside):
    assert beside.run(LABELS) == ["reference", "a"]
    plainly(beside, "plane_distance")
    assert shown_colors(beside, 0) == {PLAIN}
    assert PLAIN not in shown_colors(beside, 1) and len(shown_colors(beside, 1)) > 20
    plainly(beside, "distance")
    assert beside.run(LABELS) == ["reference, distance to a", "a"]
    assert len(shown_colors(beside, 0)) > 20
    switch(beside, "side-by-side")
    assert beside.run("pcbenchReport.page.panes.length") == 1 and beside.run(LABELS) == [""]
    assert beside.problems == []


def test_the_legend_is_that_of_the_panes(browser, comparison, tmp_path):
    """The fifth cloud is far off: it has no pane, so its wide range is neither used nor explained."""
    a, far = comparison["a"], comparison["b"]
    scalars = {key: 50 * values for key, values in far.deviation.scalars.items()}
    far = replace(far, name="far", deviation=replace(far.deviation, scalars=scalars))
    many = (*(replace(a, name=f"near {k}") for k in range(4)), far)
    write_page(tmp_path / "page.html", replace(comparison, candidates=many, differences=()))
    browser.open(tmp_path / "page.html")
    near = float(browser.run("byId('legend-high').value"))
    for k in range(1, 5):
        switch(browser, f"view-{k}")
    assert float(browser.run("byId('legend-high').value")) > 10 * near
    assert (
        browser.run("byId('legend-note').textContent")
        == "the range of far: up to the 95th percentile, of this candidate only"
    )
    switch(browser, "side-by-side")
    assert browser.run(LABELS) == [f"near {k}" for k in range(4)]
    assert float(browser.run("byId('legend-high').value")) == near
    assert "shared by 4 of 5 candidates" in browser.run("byId('legend-note').textContent")


def test_an_empty_view_says_that_no_cloud_is_selected(browser, path):
    browser.open(path)
    switch(browser, browser.run("document.querySelector('.cloud input:checked').id"))
    assert browser.run(LABELS) == ["No cloud is selected."]
    assert browser.problems == []


def test_one_camera_moves_all_panes(beside, comparison):
    corners = [comparison["a"].deviation.points[row] for row in (0, 1000, 2000)]

    def places():
        left, right = ([pixel_of(beside, at, pane) for at in corners] for pane in (0, 1))
        shift = np.subtract(right, left)
        assert np.ptp(shift, axis=0).max() <= 1  # panes may differ by a pixel
        return np.array(left)

    before = places()
    pictures = [picture_hash(beside, pane) for pane in (0, 1)]
    x, y = pixel_of(beside, corners[0], 1)
    left, top = corner(beside)
    beside.press("mousePressed", left + x, top + y)
    beside.press("mouseMoved", left + x + 60, top + y + 30, buttons=1)
    beside.press("mouseReleased", left + x + 60, top + y + 30)
    beside.run("new Promise((done) => setTimeout(done, 200))")
    assert np.abs(places() - before).max() > 10
    assert all(picture_hash(beside, pane) != pictures[pane] for pane in (0, 1))


ALL_IN_VIEW = """pcbenchReport.page.panes.every((pane) => pcbenchReport.scene.outline.every((at) => {
  const [x, y] = pcbenchReport.camera.project(at, pane.width, pane.height);
  return x >= 0 && y >= 0 && x <= pane.width && y <= pane.height;
}))"""


@pytest.mark.parametrize("key", [None, "r", "t", "f", "s"])
def test_all_that_was_in_view_stays_in_view(beside, key):
    if key:
        press_key(beside, key)
    assert beside.run(ALL_IN_VIEW)
    distance = beside.run("pcbenchReport.camera.distance")
    switch(beside, "side-by-side")
    assert beside.run(ALL_IN_VIEW)
    switch(beside, "side-by-side")
    assert beside.run("pcbenchReport.camera.distance") == pytest.approx(distance)


@pytest.mark.parametrize("pane", [0, 1])
def test_each_pane_is_picked_in(beside, comparison, pane):
    map_ = (comparison["a"].completeness, comparison["a"].deviation)[pane]
    point = map_.points[np.argmax(map_.points[:, 2])]
    x, y = pixel_of(beside, point, pane)
    click_on(beside, x, y)
    found = beside.run(f"(({{ view, at }}) => ({{ name: view.name, at }}))(pcbenchReport.page.pick({x}, {y}))")
    assert found["name"] == ("", "a")[pane]
    step = beside.run("pcbenchReport.scene.layers.map((layer) => layer.head.step)")[-1 if pane == 0 else 0]
    nearest = np.abs(map_.points - found["at"]).max(axis=1)
    assert (np.abs(map_.points[np.argmin(nearest)] - found["at"]) <= 0.51 * np.array(step)).all()
    said = beside.run("byId('picked').textContent")
    assert said.startswith(("reference, distance to a at (", "a at (")[pane])
    rings = beside.run(
        """[...document.querySelectorAll(".marker")].map((ring) => {
          const [box, canvas] = [ring.getBoundingClientRect(), byId("canvas").getBoundingClientRect()];
          return [(box.left + box.right) / 2 - canvas.left, (box.top + box.bottom) / 2 - canvas.top];
        })"""
    )
    assert np.allclose(rings, [pixel_of(beside, found["at"], k) for k in (0, 1)], atol=0.5)  # the same place in both


def test_four_of_the_checked_clouds_are_shown(beside):
    for name in ("view-1", "view-2", "view-4"):
        switch(beside, name)
    assert beside.run(LABELS) == ["reference", "reference", "a", "b"]
    assert beside.run("byId('pane-note').textContent") == "4 of 5 clouds"
    assert beside.run("gridOf(4, 800, 600)") == {"columns": 2, "rows": 2}
    switch(beside, "view-3")
    assert beside.run(LABELS) == ["reference", "a", "b", "c"]
    assert all(shown_colors(beside, pane) for pane in range(4))
    assert beside.problems == []


def test_the_keyboard_switches_panes(browser, path):
    browser.open(path)
    press_key(browser, "b")
    assert browser.run("byId('side-by-side').checked") and len(browser.run(LABELS)) == 2
    press_key(browser, "2")
    assert labels_after(browser, 2, "b") == ["reference", "b"]
    assert browser.run("pcbenchReport.scene.visible().map((view) => view.name || view.of)") == ["b", "b"]
    press_key(browser, "6")  # the reference, by its distance to c
    assert labels_after(browser, 2, "c") == ["reference, distance to c", "c"]
    press_key(browser, "b")
    assert len(labels_after(browser, 1, "")) == 1


def labels_after(browser, count, last):
    """Return the labels of the panes, once their number and the last one are as expected, or after ten seconds.

    A busy machine draws later than `press_key` waits.
    """
    for _ in range(50):
        labels = browser.run(LABELS)
        if len(labels) == count and labels[-1] == last:
            break
        browser.run("new Promise((done) => setTimeout(done, 200))")
    return labels


def test_narrow_windows_stack_the_panes(browser, path):
    browser.open(path, width=360, height=780)
    switch(browser, "side-by-side")
    panes = browser.run("pcbenchReport.page.panes.map(({ x, y }) => [x, y])")
    assert panes[0] == [0, 0] and panes[1][0] == 0 and panes[1][1] > 100
    assert all(shown_colors(browser, pane) for pane in (0, 1))
    assert browser.run("document.documentElement.scrollWidth") == 360


def test_tables_scroll_on_a_phone_and_keep_their_names(browser, path):
    """On 360 pixels each column can be scrolled into view, beside the first one."""
    browser.open(path, width=360, height=780)
    browser.run("document.querySelectorAll('details').forEach((part) => (part.open = true))")
    tables = browser.run(
        """[...document.querySelectorAll(".scroll")].map((scroll) => {
          const shown = scroll.getBoundingClientRect();
          const seen = [...scroll.querySelectorAll("tbody tr:first-child > *")].map((cell) => {
            scroll.scrollLeft = 0;
            scroll.scrollLeft = cell.offsetLeft + cell.offsetWidth - scroll.clientWidth;
            const box = cell.getBoundingClientRect();
            return box.width > 0 && box.left >= shown.left - 1 && box.right <= shown.right + 1;
          });
          scroll.scrollLeft = 1e5;
          const name = scroll.querySelector("tbody th").getBoundingClientRect();
          return { all: seen.every(Boolean), moved: scroll.scrollLeft, name: name.left - shown.left };
        })"""
    )
    assert len(tables) >= 4 and all(table["all"] for table in tables)
    assert any(table["moved"] > 100 for table in tables)
    assert all(abs(table["name"]) <= 1 for table in tables)
    assert browser.run("document.documentElement.scrollWidth") == 360


def test_a_click_shows_a_tile(beside, comparison):
    beside.call("Emulation.setEmulatedMedia", features=[{"name": "prefers-reduced-motion", "value": "reduce"}])
    shown = beside.run("pcbenchReport.scene.data.tiles")
    at, size = np.array(shown["at"][:3]), shown["size"]
    assert shown["names"][shown["of"][0]] == "b" and shown["sides"] == [[1, 0, 0], [0, 1, 0]]  # its bump
    map_ = comparison["b"].deviation
    inside = (np.abs(map_.points[:, :2] - at[:2]) <= size / 2).all(axis=1)
    median = np.median(map_.scalars["plane_distance"][inside])
    for name in ("tile-0", "tile-map-0"):
        beside.run("pcbenchReport.page.resetView()")
        plainly(beside, "plane_distance")
        assert ORANGE not in shown_colors(beside, 0)
        beside.run(f"byId('{name}').dispatchEvent(new MouseEvent('click'))")
        beside.run("new Promise((done) => setTimeout(done, 200))")
        target = np.array(beside.run("pcbenchReport.camera.target")) + beside.run("pcbenchReport.scene.center")
        assert np.allclose(target, at)
        assert beside.run(LABELS) == ["reference", "b"]
        said = beside.run("byId('picked').textContent")
        assert said.startswith(f"b, tile 1: {inside.sum():,} points, median {median:.3g} m, NMAD ")
        assert ORANGE in shown_colors(beside, 0) & shown_colors(beside, 1)
    assert beside.problems == []


def opened_with(browser, comparison, folder, monkeypatch, **values):
    """Open a page whose 3D view reads these values for `up` and `cameras`."""
    module = importlib.import_module("pcbench.report.html.page")
    plain = module._view

    def view(*arguments):
        others = {key: value for key, value in plain(*arguments).items() if key not in ("up", "cameras")}
        return {**others, **values}

    monkeypatch.setattr(module, "_view", view)
    write_page(folder / "page.html", comparison)
    browser.open(folder / "page.html")


AHEAD = "pcbenchReport.camera.axes().ahead"


@pytest.mark.parametrize("up", [[0, 0, 1], [0, 1, 0], [-1, 0, 0], [0, 0, -1], [0.6, 0, 0.8], None])
def test_the_camera_turns_about_the_upward_axis(browser, comparison, tmp_path, monkeypatch, up):
    opened_with(browser, comparison, tmp_path, monkeypatch, up=up, cameras=None)
    axis = np.array(up or [0, 0, 1])
    for _ in range(3):
        right, above = (np.array(browser.run(f"pcbenchReport.camera.axes().{name}")) for name in ("right", "up"))
        ahead = np.array(browser.run(AHEAD))
        assert np.allclose([right @ above, right @ ahead, above @ ahead], 0, atol=1e-9)
        assert np.allclose(np.cross(right, above), -ahead)  # not mirrored
        assert right @ axis == pytest.approx(0, abs=1e-9) and above @ axis > 0
        press_key(browser, "ArrowRight")
    press_key(browser, "t")
    assert np.allclose(browser.run(AHEAD), -axis)
    assert len(shown_colors(browser)) > 20
    assert browser.problems == []


def test_without_cameras_z_is_up(browser, path):
    browser.open(path)
    assert browser.run("byId('cameras')") is None
    assert browser.run("pcbenchReport.scene.up") == [0, 0, 1]
    assert browser.run("pcbenchReport.camera.yaw") == -0.6 and browser.problems == []


# The share of a pane's width or height that the scene fills.
SPAN = """(() => {
  const { scene, camera, page } = pcbenchReport;
  const { width, height } = page.panes[0];
  const spots = scene.outline.map((at) => camera.project(at, width, height));
  const [x, y] = [0, 1].map((k) => spots.map((spot) => spot[k]));
  const span = (values) => Math.max(...values) - Math.min(...values);
  return Math.max(span(x) / width, span(y) / height);
})()"""


def test_distant_cameras_are_in_view(browser, comparison, tmp_path, monkeypatch):
    looking = np.array([0, 0.8, -0.6])
    centers = comparison["a"].deviation.points.mean(axis=0) - 3000 * looking + np.arange(5)[:, None] * [10, 0, 0]
    cameras = {"centers": centers.ravel().tolist(), "directions": np.tile(looking, 5).tolist()}
    opened_with(browser, comparison, tmp_path, monkeypatch, up=[0, 0, 1], cameras=cameras)
    switch(browser, "cameras")
    browser.run("pcbenchReport.page.draw()")
    width, height = browser.run("[byId('canvas').clientWidth, byId('canvas').clientHeight]")
    pixels = np.array([pixel_of(browser, center) for center in centers])
    assert (pixels >= 0).all() and (pixels <= [width, height]).all()


@pytest.mark.parametrize("side", [[1, 0], [-0.6, 0.8]])
def test_the_view_begins_on_the_side_of_the_cameras(browser, comparison, tmp_path, monkeypatch, side):
    """Cameras south-west of the scene look north-east and down: so does the view, which shows them when asked."""
    middle = comparison["a"].deviation.points.mean(axis=0)
    looking = np.array([*side, -0.5]) / np.hypot(1, 0.5)
    centers = middle - 60 * looking + np.linspace(-10, 10, 5)[:, None] * [-side[1], side[0], 0]
    cameras = {"centers": centers.ravel().tolist(), "directions": np.tile(looking, 5).tolist()}
    opened_with(browser, comparison, tmp_path, monkeypatch, up=[0, 0, 1], cameras=cameras)
    assert np.allclose(browser.run(AHEAD), looking)
    plainly(browser, "plane_distance")
    assert browser.run("byId('cameras').checked") is False and WHITE not in shown_colors(browser)
    switch(browser, "cameras")
    assert WHITE in shown_colors(browser)
    width, height = browser.run("[byId('canvas').clientWidth, byId('canvas').clientHeight]")
    pixels = np.array([pixel_of(browser, center) for center in centers])
    assert (pixels >= 0).all() and (pixels <= [width, height]).all()
    switch(browser, "side-by-side")  # distant cameras would make the panes nearly empty
    assert browser.run(SPAN) > 0.5
    switch(browser, "side-by-side")
    switch(browser, "cameras")
    assert WHITE not in shown_colors(browser)
    press_key(browser, "r")
    assert np.allclose(browser.run(AHEAD), looking)
    press_key(browser, "f")  # the front is the side of the cameras
    assert np.allclose(np.array(browser.run(AHEAD))[:2] / np.hypot(*browser.run(AHEAD)[:2]), side / np.hypot(*side))
    assert browser.problems == []


@pytest.mark.parametrize("height", [1, -1])
def test_cameras_all_around_only_tell_whether_the_view_is_from_above(
    browser, comparison, tmp_path, monkeypatch, height
):
    angles = np.linspace(0, 2 * np.pi, 12, endpoint=False)
    looking = np.stack([np.cos(angles), np.sin(angles), np.full(12, -0.7 * height)], axis=1)
    centers = comparison["a"].deviation.points.mean(axis=0) - 50 * looking
    cameras = {"centers": centers.ravel().tolist(), "directions": looking.ravel().tolist()}
    opened_with(browser, comparison, tmp_path, monkeypatch, up=[0, 0, 1], cameras=cameras)
    assert np.sign(browser.run("pcbenchReport.camera.pitch")) == height
    assert browser.run("pcbenchReport.camera.yaw") == -0.6


def test_a_first_picture_is_painted_before_webgl_starts(browser, path):
    """The preview disappears when all points are drawn, so a script notes its colours at that time."""
    script = """{
      const remove = Element.prototype.remove;
      Element.prototype.remove = function () {
        if (this.className === "preview") {
          const { data } = this.getContext("2d").getImageData(0, 0, this.width, this.height);
          window.previewColors = new Set(new Uint32Array(data.buffer)).size;
          window.previewWidth = this.clientWidth;
        }
        return remove.call(this);
      };
    }"""
    added = browser.call("Page.addScriptToEvaluateOnNewDocument", source=script)["identifier"]
    browser.open(path)
    browser.call("Page.removeScriptToEvaluateOnNewDocument", identifier=added)
    assert browser.run("previewColors") > 20
    assert browser.run("previewWidth") == browser.run("byId('canvas').clientWidth")
    assert browser.run("document.querySelector('.preview')") is None
    assert browser.run("pcbenchReport.firstPictureMs <= pcbenchReport.allPointsMs")


def test_names_with_markup_are_only_text(browser, comparison, tmp_path):
    name = "<img src=x onerror=alert(1)>\u202e"
    write_page(tmp_path / "page.html", replace(comparison, candidates=(replace(comparison["a"], name=name),)), name)
    browser.open(tmp_path / "page.html")
    switch(browser, "side-by-side")
    assert browser.run(LABELS) == ["reference", name]
    assert browser.run("document.querySelectorAll('img').length") == 0
    assert browser.problems == []


@pytest.fixture(scope="module")
def facade():
    """Compare a wall of 20 x 8 m that runs to the north-east with a copy that has a bump."""
    rng = np.random.default_rng(0)
    along, height = rng.uniform(0, 20, 8000), rng.uniform(0, 8, 8000)
    turn = np.radians(30)

    def wall(depth):
        across = rng.normal(0, 0.004, len(along)) + depth
        x, y = along * np.cos(turn) - across * np.sin(turn), along * np.sin(turn) + across * np.cos(turn)
        return Cloud(np.column_stack([x, y, height]) + [446_123, 5_380_456, 410], unit="m")

    bump = -0.3 * np.exp(-((along - 15) ** 2 + (height - 5) ** 2) / 2)
    return compare(wall(0.0), {"a": wall(bump)}, Settings(register="none", crop="none"))


def test_a_wall_is_seen_from_its_front_and_fills_the_view(browser, facade, tmp_path):
    write_page(tmp_path / "page.html", facade)
    browser.open(tmp_path / "page.html")

    def is_seen_from_its_front():
        ahead = browser.run(AHEAD)
        assert np.allclose(ahead, [-np.sin(np.radians(30)), np.cos(np.radians(30)), 0], atol=0.06)
        points = facade["a"].deviation.points[::20]
        x, y = np.transpose([pixel_of(browser, point) for point in points])
        size = browser.run("[byId('canvas').clientWidth, byId('canvas').clientHeight]")
        assert (x > 0).all() and (x < size[0]).all() and (y > 0).all() and (y < size[1]).all()
        assert max(np.ptp(x) / size[0], np.ptp(y) / size[1]) > 0.9

    is_seen_from_its_front()
    press_key(browser, "s")
    assert abs(browser.run(AHEAD)[2]) < 0.1
    press_key(browser, "f")
    is_seen_from_its_front()


@pytest.mark.long
def test_a_tile_of_a_wall_is_outlined_on_the_wall(browser, facade, tmp_path):
    write_page(tmp_path / "page.html", facade)
    browser.open(tmp_path / "page.html")
    browser.call("Emulation.setEmulatedMedia", features=[{"name": "prefers-reduced-motion", "value": "reduce"}])
    browser.run("byId('tile-0').click()")
    ends = np.reshape(browser.run("[...tileLines(pcbenchReport.scene)]"), (-1, 3))
    ends += browser.run("pcbenchReport.scene.center")
    normal = np.array([-np.sin(np.radians(30)), np.cos(np.radians(30)), 0])
    assert np.ptp(ends @ normal) < 0.01 and np.ptp(ends[:, 2]) == pytest.approx(2)
    deepest = facade["a"].deviation.points[np.argmax(facade["a"].deviation.scalars["distance"])]
    assert np.abs(ends.mean(axis=0) - deepest).max() < 2
