"""Views with pyvista, compared with golden pictures where OpenGL works."""

import numpy as np
import pytest
from coloured_cities import coloured_city
from optional import import_or_skip
from pictures import check_picture, is_similar, reduced

import pcbench
from pcbench import Mesh

import_or_skip("pyvista")
pytestmark = pytest.mark.usefixtures("off_screen")
HOW = {"off_screen": True, "window_size": (600, 450)}


def hills():
    x, y = np.meshgrid(np.linspace(0, 50, 40), np.linspace(0, 50, 40))
    vertices = np.stack([x.ravel(), y.ravel(), 3 * np.sin(x.ravel() / 6) * np.cos(y.ravel() / 8)], axis=1)
    number = np.arange(1600).reshape(40, 40)
    a, b, c, d = (rows.ravel() for rows in (number[:-1, :-1], number[:-1, 1:], number[1:, 1:], number[1:, :-1]))
    return Mesh(vertices, np.concatenate([np.stack([a, b, c], axis=1), np.stack([a, c, d], axis=1)]))


@pytest.fixture(scope="module")
def comparison():
    return pcbench.compare(coloured_city(40_000, 1), {"bent": coloured_city(15_000, 2, bowl=1e-3)})


def picture_of(plotter):
    picture = plotter.screenshot(return_img=True)
    plotter.close()
    return picture


VIEWS = {
    "plane_distance": lambda comparison: comparison.plot("bent", **HOW),
    "completeness": lambda comparison: comparison.plot("bent", "completeness", background="white", **HOW),
    "deformation": lambda comparison: comparison.plot("bent", "deformation", **HOW),
    "colors": lambda _: pcbench.plot.cloud(coloured_city(15_000, 2), background="white", **HOW),
    "mesh": lambda _: pcbench.plot.cloud(hills(), unit="m", **HOW),
}


@pytest.mark.parametrize("name", VIEWS)
def test_views_look_as_before(comparison, name, renew_pictures):
    check_picture(f"view_{name}", picture_of(VIEWS[name](comparison)), renew=renew_pictures)


def test_another_colour_range_looks_different(comparison):
    """A range twice as large is another picture, so that a wrong scale of colours is found."""
    pictures = [reduced(picture_of(comparison.plot("bent", range=end, **HOW))) for end in (None, 1.1)]
    assert not is_similar(*pictures)
