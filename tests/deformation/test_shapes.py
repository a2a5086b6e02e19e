"""Deformations are called by their shape, with figures."""

import numpy as np
import pytest
from bent_clouds import add_dome, add_noise, sample_city, verdict
from wording import check_text

from pcbench.deformation import Field
from pcbench.deformation.shapes import shape_of

X, Y, Z = (
    values.ravel() for values in np.meshgrid(np.linspace(-50, 50, 12), np.linspace(-40, 40, 10), [0.0, 3.0, 9.0])
)
NOTHING = np.zeros(len(X))


def field(*displacements):
    """Return a field on a grid of places, moved and turned as a whole."""
    places = np.stack([X, Y, Z], axis=1) + [300.0, 500.0, 20.0]
    moved = np.stack(displacements, axis=1) + [0.2, -0.1, 0.4] + np.cross([0.0, 0.0, 0.001], places)
    count = len(places)
    return Field(places, moved, NOTHING, NOTHING, NOTHING, np.zeros(count, bool), np.full(count, 10, dtype=np.int64))


@pytest.mark.parametrize(
    ("name", "displacements"),
    [
        ("dome", (NOTHING, NOTHING, -(X**2 + Y**2))),
        ("bowl", (NOTHING, NOTHING, X**2 + Y**2)),
        ("saddle", (NOTHING, NOTHING, X * Y + 0.3 * X**2 - 0.3 * Y**2)),
        ("S-bend", (NOTHING, NOTHING, X**3 - 900 * X)),
        ("twist", (-Y * X, X * X, NOTHING)),
        ("growth with distance", (X * (X**2 + Y**2), Y * (X**2 + Y**2), NOTHING)),
        ("growth with height", (NOTHING, NOTHING, Z)),
        ("growth with height", (NOTHING, NOTHING, Z * (Z - 9))),
        ("growth with height", ((Z - Z.mean()) ** 2, 2 * (Z - Z.mean()) ** 2, NOTHING)),
        ("stretch or shear", (Y, X, NOTHING)),
    ],
)
def test_shapes_are_recognised_beyond_a_rigid_motion(name, displacements):
    size = max(float(np.abs(values).max()) for values in displacements)
    found = shape_of(field(*(0.1 * values / size for values in displacements)))
    assert found.name == name
    assert found.share > 0.9


def test_a_field_without_a_simple_shape_has_no_name():
    assert shape_of(field(NOTHING, NOTHING, np.random.default_rng(1).normal(size=len(X)))) is None
    assert shape_of(field(np.full(len(X), np.nan), NOTHING, NOTHING)) is None


def test_a_dome_is_called_a_dome_with_its_figures():
    rng = np.random.default_rng(1)
    result = verdict(sample_city(60_000, rng), add_noise(add_dome(sample_city(20_000, rng), 0.2), rng), "none")
    centre, edge = result.shape.figures
    assert (result.shape.name, centre.where, edge.where) == ("dome", "in the centre", "at the edge")
    # 0.2 RMS of x^2 + y^2 over a square: 1.58 RMS above the mean in the centre, about 2.2 below it near the corners.
    assert centre.value == pytest.approx(0.32, rel=0.25)
    assert edge.value == pytest.approx(-0.43, rel=0.25)
    check_text(result.sentence("a.ply", "m"))
