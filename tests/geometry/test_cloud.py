"""Cloud: checked at birth, selected, moved, and each refusal."""

import dataclasses

import numpy as np
import pytest

from pcbench.errors import InputError, PcbenchError
from pcbench.geometry.cloud import Cloud, as_cloud
from pcbench.geometry.transform import Affine, Similarity

POINTS = np.arange(12.0).reshape(4, 3)
QUARTER_TURN = Similarity(np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]]), np.array([10.0, 0, 0]), 2.0)


def full_cloud():
    return Cloud(
        POINTS,
        normals=np.tile([1.0, 0, 0], (4, 1)),
        colors=np.arange(12, dtype=np.uint8).reshape(4, 3),
        attributes={"intensity": np.arange(4), "rot_0": np.ones(4), "scale_2": np.ones(4), "f_rest_44": np.ones(4)},
        crs="EPSG:25832",
        unit="m",
    )


def test_keeps_float64_in_c_order():
    for given in (POINTS.astype(np.float32), POINTS.tolist(), np.asfortranarray(POINTS), POINTS.astype(">f8")):
        points = Cloud(given).points
        assert points.dtype == np.float64
        assert points.dtype.isnative
        assert points.flags.c_contiguous
        assert (points == POINTS).all()


def test_length_bounds_and_name():
    cloud = full_cloud()
    assert len(cloud) == 4
    assert [corner.tolist() for corner in cloud.bounds] == [[0, 1, 2], [9, 10, 11]]
    assert repr(cloud) == "Cloud(4 points, normals, colors, intensity, rot_0, scale_2, f_rest_44)"
    assert repr(Cloud(POINTS)) == "Cloud(4 points)"


def test_is_frozen():
    with pytest.raises(dataclasses.FrozenInstanceError):
        full_cloud().points = POINTS


@pytest.mark.parametrize("which", [np.array([True, False, False, True]), np.array([0, 3])])
def test_select_takes_everything_along(which):
    picked = full_cloud().select(which)
    assert picked.points.tolist() == [[0, 1, 2], [9, 10, 11]]
    assert picked.normals.shape == (2, 3)
    assert picked.colors.tolist() == [[0, 1, 2], [9, 10, 11]]
    assert picked.attributes["intensity"].tolist() == [0, 3]
    assert (picked.crs, picked.unit) == ("EPSG:25832", "m")


def test_select_may_reorder_and_repeat():
    assert full_cloud().select(np.array([3, 3, 0])).attributes["intensity"].tolist() == [3, 3, 0]


def test_select_of_a_bare_cloud():
    picked = Cloud(POINTS).select(np.array([1]))
    assert picked.normals is None
    assert picked.colors is None


def test_transformed():
    cloud = full_cloud()
    moved = cloud.transformed(QUARTER_TURN)
    assert moved.points[1].tolist() == [10 - 2 * 4, 2 * 3, 2 * 5]
    assert moved.normals[0].tolist() == [0, 1, 0]
    assert moved.colors is cloud.colors
    assert list(moved.attributes) == ["intensity"]  # a splat's own axes do not survive
    assert (cloud.points == POINTS).all()  # the caller's data stay as they were
    assert len(cloud.attributes) == 4


def test_transformed_by_an_affine_map():
    # Stretching x by 2 turns the plane x + y = const, and with it the normal, towards y.
    cloud = Cloud(POINTS, normals=np.tile([1.0, 1.0, 0.0], (4, 1)))
    moved = cloud.transformed(Affine(np.diag([2.0, 1, 1]), np.zeros(3)))
    expected = np.sqrt(2) * np.array([0.5, 1, 0]) / np.sqrt(1.25)
    np.testing.assert_allclose(moved.normals, np.tile(expected, (4, 1)), rtol=1e-15)


def test_as_cloud():
    cloud = full_cloud()
    assert as_cloud(cloud) is cloud
    assert (as_cloud(POINTS).points == POINTS).all()


def test_sums_that_overflow_are_still_finite_points():
    assert len(Cloud(np.full((3, 3), 1.7e308))) == 3
    assert Cloud.from_finite(np.full((3, 3), 1.7e308))[1] == 0


def test_from_finite_drops_rows_of_everything():
    broken = POINTS.copy()
    broken[1, 2], broken[2, 0] = np.nan, -np.inf
    colors = np.arange(12).reshape(4, 3)
    cloud, dropped = Cloud.from_finite(
        broken, normals=POINTS, colors=colors.tolist(), attributes={"a": [5, 6, 7, 8]}, unit="ft"
    )
    assert dropped == 2
    assert cloud.points.tolist() == cloud.normals.tolist() == POINTS[[0, 3]].tolist()
    assert cloud.colors.tolist() == colors[[0, 3]].tolist()
    assert cloud.attributes["a"].tolist() == [5, 8]
    assert cloud.unit == "ft"


def test_from_finite_of_finite_points():
    cloud, dropped = Cloud.from_finite(POINTS.tolist(), attributes={"a": np.arange(4)}, normals=None)
    assert dropped == 0
    assert cloud.attributes["a"].tolist() == [0, 1, 2, 3]


NAN = np.full((4, 3), np.nan)
ONE_NAN = np.vstack([POINTS[:3], NAN[:1]])


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: Cloud(np.empty((0, 3))), "expected a point cloud with at least one point, got none"),
        (lambda: Cloud(np.zeros(3)), "expected points of shape (N, 3), got (3,)"),
        (lambda: Cloud(np.zeros((4, 2))), "expected points of shape (N, 3), got (4, 2)"),
        (lambda: Cloud("cloud.ply"), "expected points as an (N, 3) array of numbers, got str"),
        (lambda: Cloud([[1, 2, 3], [4, 5]]), "expected points as an (N, 3) array of numbers, got list"),
        (lambda: Cloud([{}, {}]), "expected points as an (N, 3) array of numbers, got list"),
        (lambda: Cloud(ONE_NAN), "expected finite coordinates, got NaN or Inf in 1 of 4 points: drop them first"),
        (lambda: Cloud([[np.inf, 0, 0], [-np.inf, 0, 0]]), "got NaN or Inf in 2 of 2 points"),
        (lambda: Cloud(POINTS, normals=POINTS[:3]), "expected normals of shape (4, 3), got (3, 3)"),
        (lambda: Cloud(POINTS, normals=np.zeros(4)), "expected normals of shape (N, 3), got (4,)"),
        (lambda: Cloud(POINTS, colors=np.zeros((4, 4), np.uint8)), "expected colors of shape (4, 3), got (4, 4)"),
        (lambda: Cloud(POINTS, colors=np.full((4, 3), 0.5)), "expected colors as whole numbers 0 to 255"),
        (lambda: Cloud(POINTS, colors=np.full((4, 3), 256)), "expected colors as whole numbers 0 to 255"),
        (lambda: Cloud(POINTS, colors=[[-1, 0, 0]] * 4), "expected colors as whole numbers 0 to 255"),
        (lambda: Cloud(POINTS, colors=NAN), "expected colors as whole numbers 0 to 255"),
        (lambda: Cloud(POINTS, colors="red"), "expected colors as whole numbers 0 to 255, got str of"),
        (lambda: Cloud(POINTS, attributes={"a": np.zeros(3)}), "expected attribute 'a' of shape (4,), got (3,)"),
        (lambda: Cloud(POINTS, attributes={"a": 1.0}), "expected attribute 'a' of shape (4,), got ()"),
        (lambda: Cloud.from_finite(NAN), "all 4 points are NaN or Inf"),
        (lambda: Cloud.from_finite(np.empty((0, 3))), "expected a point cloud with at least one point, got none"),
        (lambda: Cloud.from_finite(ONE_NAN, normals=POINTS[:2]), "expected normals of shape (4, 3), got (2, 3)"),
        (lambda: Cloud.from_finite(ONE_NAN, attributes={"a": [1]}), "expected attribute 'a' of shape (4,), got (1,)"),
        (lambda: full_cloud().select(np.zeros(4, dtype=bool)), "at least one point, got none"),
        (lambda: as_cloud(np.zeros((2, 2))), "expected points of shape (N, 3), got (2, 2)"),
    ],
)
def test_refusals(make, message):
    with pytest.raises(InputError) as caught:
        make()
    assert message in str(caught.value)
    assert "\n" not in str(caught.value)
    assert isinstance(caught.value, PcbenchError)


def test_colors_of_other_types_with_whole_values():
    for kind in (np.uint16, np.int64, np.float32):
        colors = Cloud(POINTS, colors=np.full((4, 3), 255, kind)).colors
        assert colors.dtype == np.uint8
        assert (colors == 255).all()
