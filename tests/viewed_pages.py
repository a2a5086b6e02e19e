"""The 3D view of a page in a browser: its colours, and the positions of points on it."""

from pcbench.report.html import page

GROUND = (20, 22, 27)
CANVAS = "document.getElementById('canvas')"


def write_page(path, comparison, text="-"):
    provenance = dict.fromkeys(("version", "commit", "machine", "created", "command"), text)
    path.write_text(page(comparison, provenance), encoding="utf-8")


def shown_colors(browser, pane=0):
    """Return the colours of a pane that are not its ground."""
    colors = _of_pixels(browser, pane, "[...new Set(pixels)]")
    triples = {(c & 255, c >> 8 & 255, c >> 16 & 255) for c in colors}
    return triples - {GROUND}


def picture_hash(browser, pane=0):
    """Return a number that changes with the picture of a pane."""
    return _of_pixels(browser, pane, "pixels.reduce((hash, color) => (31 * hash + color) | 0, 0)")


def _of_pixels(browser, pane, expression):
    """Return the value of an expression of the `pixels` of a pane, 32 bits each."""
    return browser.run(
        f"""(() => {{
          const {{ x, y, width, height }} = pcbenchReport.page.panes[{pane}];
          const copy = document.createElement("canvas");
          [copy.width, copy.height] = [width, height];
          const context = copy.getContext("2d");
          context.drawImage({CANVAS}, -x, -y);
          const pixels = new Uint32Array(context.getImageData(0, 0, width, height).data.buffer);
          return {expression};
        }})()"""
    )


def pixel_of(browser, at, pane=0):
    """Return the position of a point in a pane, in CSS pixels of the canvas."""
    return browser.run(
        f"""(() => {{
          const {{ scene, camera, page }} = pcbenchReport;
          const {{ x, y, width, height }} = page.panes[{pane}];
          const spot = camera.project(scene.local({list(map(float, at))}), width, height);
          return [(x + spot[0]) / scene.pixelRatio, (y + spot[1]) / scene.pixelRatio];
        }})()"""
    )


def plainly(browser, key="distance"):
    """Colour by a scalar, without shading, which would darken the colours."""
    browser.run(f"(pcbenchReport.scene.lighting = false, pcbenchReport.scene.key = {key!r}, pcbenchReport.page.draw())")


def corner(browser):
    """Scroll to the canvas, and return its upper left corner in the window."""
    return browser.run(
        f"({CANVAS}.scrollIntoView(), (({{ left, top }}) => [left, top])({CANVAS}.getBoundingClientRect()))"
    )


def click_on(browser, x, y):
    """Click into the canvas, at a position in its CSS pixels."""
    left, top = corner(browser)
    for kind in ("mousePressed", "mouseReleased"):
        browser.press(kind, left + x, top + y)


def press_key(browser, key):
    """Press a key in the view, and wait for the picture."""
    browser.run(f"{CANVAS}.focus()")
    browser.call("Input.dispatchKeyEvent", type="keyDown", key=key)
    browser.run("new Promise((done) => setTimeout(done, 200))")
